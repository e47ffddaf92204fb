"""Gates of one gain: its size, its sign, its uncertainty."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from daq.config.cell import Axis
from daq.config.policy import ApplyPolicy
from daq.errors import ControllerUnfit
from daq.writeback.drive_record import read_record, read_records
from daq.writeback.gates.table import Gate, Refusal
from drivers.canopen.parameters import ParameterValue
from ident.calibration import Calibration, Gain


@dataclass(frozen=True, slots=True)
class GainChange:
    """One gain before and after.

    Attributes:
        axis: name of the axis.
        key: of the number in the controller file.
        line: of the number in the file, from 1.
        old, new: gain in the file now, and as it will be written [unit]; new is NaN where there is none to write.
        std: standard deviation of the identified gain [unit].
        unit: Nm at the joint per unit of the current-loop reference.
        nameplate: the manufacturer's gain [unit].
        spelling: the new number as it will stand in the file, in the file's own unit.
    """

    axis: str
    key: str
    line: int
    old: float
    new: float
    std: float
    unit: str
    nameplate: float
    spelling: str

    @property
    def change_percent(self) -> float:
        """Change from the gain in the file [%]; inf from zero."""
        return _percent(self.new - self.old, self.old)

    @property
    def nameplate_percent(self) -> float:
        """Distance from the nameplate [%]; inf from zero."""
        return _percent(self.new - self.nameplate, self.nameplate)

    @property
    def std_percent(self) -> float:
        """Relative standard deviation [%]; inf for a gain of zero."""
        return _percent(self.std, abs(self.new))


def gain_refusals(change: GainChange, policy: ApplyPolicy) -> tuple[Refusal, ...]:
    """Closed gates of one gain; a gain that is no number at all closes only that gate."""
    numbers = (change.new, change.std, change.old, change.nameplate)
    if not all(map(math.isfinite, numbers)) or change.new == 0 or change.std < 0:
        found = f"gain {change.new:g} ± {change.std:g}, {change.old:g} in the file, nameplate {change.nameplate:g}"
        return (Refusal(Gate.NOT_FINITE, change.axis, found, "finite numbers, not zero", "fit the logs again"),)
    closed = []
    if change.std == 0:
        closed.append(
            Refusal(
                Gate.NOT_IDENTIFIED,
                change.axis,
                "a gain that the fit held fixed (σ = 0)",
                "an identified one",
                "fit with a loaded run and free gains",
            )
        )
    if change.std_percent > policy.max_std_percent:
        closed.append(
            Refusal(
                Gate.UNCERTAINTY,
                change.axis,
                f"σ {change.std_percent:.2f} %",
                f"at most {policy.max_std_percent:g} %",
                "record longer or more exciting moves, or a heavier payload",
            )
        )
    if change.new * change.old <= 0 or change.new * change.nameplate <= 0:
        closed.append(
            Refusal(
                Gate.SIGN,
                change.axis,
                f"gain {change.new:g}, {change.old:g} in the file, nameplate {change.nameplate:g}",
                "the same sign",
                "check the directions of encoder and current in the cell configuration",
            )
        )
        return tuple(closed)
    if abs(change.change_percent) > policy.max_change_percent:
        closed.append(
            Refusal(
                Gate.CHANGE,
                change.axis,
                f"a change of {change.change_percent:+.1f} % from the file",
                f"at most ±{policy.max_change_percent:g} %",
                "check scale and amplitude (RMS or peak) of the current in the drive profile, and the payload's mass",
            )
        )
    bound = policy.max_change.get(change.axis)
    if bound is not None and abs(change.new - change.old) > bound:
        closed.append(
            Refusal(
                Gate.CHANGE,
                change.axis,
                f"a change of {change.new - change.old:+.4g} {change.unit} from the file",
                f"at most ±{bound:g} {change.unit}",
                "check scale and amplitude (RMS or peak) of the current in the drive profile, and the payload's mass",
            )
        )
    if abs(change.nameplate_percent) > policy.max_nameplate_percent:
        closed.append(
            Refusal(
                Gate.NAMEPLATE,
                change.axis,
                f"{change.nameplate_percent:+.1f} % from the nameplate",
                f"at most ±{policy.max_nameplate_percent:g} %",
                "check the drive profile, the nameplate gain and the payload's mass",
            )
        )
    return tuple(closed)


def _percent(part: float, whole: float) -> float:
    return 100.0 * part / whole if whole else math.inf


# Gates of what a calibration says of the axes, held against the cell: unit and nameplate of each gain.


_SPELLING = 1e-9
"""Two spellings of one number are one number."""


def axis_refusals(calibration: Calibration, axes: tuple[Axis, ...]) -> Iterator[Refusal]:
    """Closed where the calibration speaks of other axes than the cell has.

    Its own nameplate bounds the gain and is what the hold-out is compared with, so it must be the cell's.

    Args:
        calibration: to be written.
        axes: of the cell as it is now.
    """
    declared = {axis.name: axis for axis in axes}
    for gain in calibration.gains:
        axis = declared.get(gain.axis)
        if axis is not None:
            yield from _refusals(gain, axis)


def _refusals(gain: Gain, axis: Axis) -> Iterator[Refusal]:
    if gain.unit != axis.gain_unit:
        yield Refusal(
            Gate.UNIT,
            gain.axis,
            f"a gain in {gain.unit!r}",
            f"{axis.gain_unit!r}, as the cell file has it",
            "fit the logs again with --cell",
        )
    # A nameplate that is no number has a gate of its own.
    if math.isfinite(gain.nameplate) and not math.isclose(gain.nameplate, axis.nameplate_gain, rel_tol=_SPELLING):
        yield Refusal(
            Gate.NAMEPLATE,
            gain.axis,
            f"compared with a nameplate of {gain.nameplate:g}",
            f"{axis.nameplate_gain:g} {axis.gain_unit}, the cell's",
            "fit the logs again with --cell: bounds and hold-out are compared with the nameplate",
        )


# The gate of the controller's file: it is still the one that was there when the logs were recorded, or looked at.


def base_refusals(calibration: Calibration, file: str, base_sha256: str, looked_at: str | None) -> tuple[Refusal, ...]:
    """Closed where somebody has changed the file and nobody has looked at it since.

    Args:
        calibration: whose logs may tell the digest of the file at their time.
        file: what to call the controller's file.
        base_sha256: of its content now.
        looked_at: digest of the content that somebody has looked at, in a dry run; it outweighs the logs'.
    """
    if looked_at is not None:
        if looked_at == base_sha256:
            return ()
        return (
            Refusal(
                Gate.BASE,
                file,
                f"content {base_sha256[:12]}…",
                f"{looked_at[:12]}…, as --base says",
                "the file was changed since that look: take a new dry run, without --base",
            ),
        )
    logged = [(one.name, one.recording.controller_sha256) for one in calibration.sources if one.recording is not None]
    others = [(name, digest) for name, digest in logged if digest is not None and digest != base_sha256]
    return tuple(
        Refusal(
            Gate.BASE,
            file,
            f"content {base_sha256[:12]}…",
            f"{digest[:12]}…, as when {name} was recorded",
            "the file was changed since, by hand or by an earlier write: look at its gains and at the diff of this dry "
            f"run, and where both are as they should be, repeat it with --base {base_sha256}",
        )
        for name, digest in others[:1]
    )


# The gate of what stands in the drives: it is still what drivegain left there, or what somebody has looked at.


_LOOK = "look at a dry run and repeat it with the --base that it tells"


def drive_base_refusals(
    subject: str, base: tuple[ParameterValue, ...], base_sha256: str, folder: Path, looked_at: str | None
) -> tuple[Refusal, ...]:
    """Closed where somebody has changed a gain in a drive and nobody has looked at it since.

    The logs do not tell what stood in the drives. The newest record of a write does: a drive has what was written, or
    what stood there before, where the write was taken back or was never saved. Before the first write there is no
    record, and nothing to compare with.

    Args:
        subject: what to call the drives.
        base: what stands in them.
        base_sha256: its digest.
        folder: of the records.
        looked_at: digest of what somebody has looked at, in a dry run; it outweighs the record.
    """
    if looked_at is not None:
        if looked_at == base_sha256:
            return ()
        found, expected = f"content {base_sha256[:12]}…", f"{looked_at[:12]}…, as --base says"
        return (Refusal(Gate.BASE, subject, found, expected, "somebody has changed a gain: look at a new dry run"),)
    records = read_records(folder)
    if not records:
        return ()
    try:
        notes = {(note.axis, note.parameter): note for note in read_record(records[-1]).drives}
    except ControllerUnfit as error:
        return (Refusal(Gate.BASE, error.subject, error.found, error.expected, _LOOK),)
    changed = [
        (value, notes[value.axis.name, value.parameter])
        for value in base
        if (value.axis.name, value.parameter) in notes
        and value.word not in {(note := notes[value.axis.name, value.parameter]).old, note.new}
    ]
    return tuple(
        Refusal(
            Gate.BASE,
            f"{value.axis.name}, {value.parameter}",
            f"{value.value:.9g}",
            f"{value.parameter.value(note.new):.9g}, as {records[-1].name} says that it was written, or "
            f"{value.parameter.value(note.old):.9g} as before",
            f"somebody has changed it since, or exchanged the drive: {_LOOK}",
        )
        for value, note in changed
    )
