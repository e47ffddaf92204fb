"""Gates of one gain: its size, its sign, its uncertainty."""

from __future__ import annotations

import math
from dataclasses import dataclass

from daq.configuration.apply_policy import ApplyPolicy
from daq.write_back.gates import Gate, Refusal


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
