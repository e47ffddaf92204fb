"""What a table tells of a calibration: small enough to be sent, kept and read back for thousands of cells."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from ident.calibration import Calibration, Gain


@dataclass(frozen=True, slots=True)
class Summary:
    """Of one calibration.

    Attributes:
        gains: one an axis.
        effects: family and axis of each accepted effect.
        error_percent: ‖ρ‖/‖Y‖ in total on the run held out, of the fit where there is none [%].
        held_out: whether it is that of a run held out.
        partial: it rests on a log that was never finished, or with losses.
    """

    gains: tuple[Gain, ...]
    effects: tuple[tuple[str, str], ...]
    error_percent: float
    held_out: bool
    partial: bool

    @property
    def worst(self) -> Gain:
        """The gain that is known least well."""
        return max(self.gains, key=lambda gain: gain.std_percent)


def summary_of(calibration: Calibration) -> Summary:
    """What the table tells of it."""
    unseen = calibration.holdout_error_percent
    return Summary(
        gains=calibration.gains,
        effects=tuple((effect.name, effect.axis) for effect in calibration.effects),
        error_percent=(unseen or calibration.relative_error_percent).total,
        held_out=unseen is not None,
        partial=any(source.partial for source in calibration.sources),
    )


def summary_document(summary: Summary) -> dict[str, Any]:
    """As lists, mappings and numbers."""
    return asdict(summary)


def summary_from(document: dict[str, Any]) -> Summary:
    """What `summary_document` made, through JSON.

    Raises:
        KeyError, TypeError, ValueError: it is something else.
    """
    return Summary(
        gains=tuple(Gain(**gain) for gain in document["gains"]),
        effects=tuple((str(name), str(axis)) for name, axis in document["effects"]),
        error_percent=float(document["error_percent"]),
        held_out=bool(document["held_out"]),
        partial=bool(document["partial"]),
    )
