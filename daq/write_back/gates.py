"""What must hold before a gain is written to a controller; each gate closes for a reason of its own."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from enum import Enum

from daq.configuration.apply_policy import ApplyPolicy
from ident.calibration import Calibration

_SHA256 = re.compile(r"[0-9a-f]{64}")
_UNFINISHED = ".part"


class Gate(Enum):
    """Why a calibration is refused."""

    NOT_FINITE = "not finite"
    NOT_IDENTIFIED = "not identified"
    SIGN = "sign"
    CHANGE = "change"
    NAMEPLATE = "nameplate"
    UNCERTAINTY = "uncertainty"
    SOURCES = "sources"
    PARTIAL = "partial"
    HOLDOUT = "hold-out error"
    ERROR = "error"
    CELL = "cell"
    CONFIGURATION = "configuration"


@dataclass(frozen=True, slots=True)
class GainChange:
    """One gain before and after.

    Attributes:
        axis: name of the axis.
        key: dotted path in the controller file.
        line: of the number in the file, from 1.
        old, new: gain in the file now, and as it will be written [unit]; new is NaN where there is none to write.
        std: standard deviation of the identified gain [unit].
        unit: Nm at the joint per unit of the current-loop reference.
        nameplate: the manufacturer's gain [unit].
        spelling: the new number as it will stand in the file.
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


@dataclass(frozen=True, slots=True)
class Refusal:
    """One closed gate: what was found, what would have opened it, what to do."""

    gate: Gate
    subject: str
    found: str
    expected: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.subject}: found {self.found}; expected {self.expected}; {self.remedy}"


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


def calibration_refusals(
    calibration: Calibration, cell: str, configuration_sha256: str | None, policy: ApplyPolicy
) -> tuple[Refusal, ...]:
    """Closed gates of the calibration as a whole.

    Args:
        calibration: to be written.
        cell: name of the cell whose controller it goes to.
        configuration_sha256: digest of that cell's configuration now, None where it is not to be compared.
        policy: bounds.
    """
    closed = []
    if calibration.cell != cell:
        closed.append(
            Refusal(Gate.CELL, "calibration", f"cell {calibration.cell!r}", f"cell {cell!r}", "give its own --cell")
        )
    if configuration_sha256 is not None and calibration.configuration_sha256 != configuration_sha256:
        closed.append(
            Refusal(
                Gate.CONFIGURATION,
                "calibration",
                f"recorded with cell configuration {calibration.configuration_sha256[:12] or 'unknown'}…",
                f"{configuration_sha256[:12]}…, the cell's configuration now",
                "record again, or see what changed since and say so with --configuration-changed",
            )
        )
    closed += _source_refusals(calibration)
    errors = [calibration.relative_error_percent]
    if calibration.holdout_error_percent is not None:
        errors.append(calibration.holdout_error_percent)
    if not all(math.isfinite(number) for error in errors for number in (*error.axes, error.total)):
        closed.append(
            Refusal(
                Gate.NOT_FINITE, "calibration", "a relative error that is no number", "finite", "fit the logs again"
            )
        )
    elif errors[-1].total > policy.max_error_percent:
        closed.append(
            Refusal(
                Gate.ERROR,
                "calibration",
                f"a relative error of {errors[-1].total:.1f} % of the torques",
                f"at most {policy.max_error_percent:g} %",
                "the model does not describe this robot: check drive train, roles, payload and units",
            )
        )
    closed += [
        Refusal(
            Gate.HOLDOUT,
            f"effect {effect.name} on {effect.axis}",
            f"{effect.error_after_percent:.2f} % on held-out data with it, {effect.error_before_percent:.2f} % without",
            "an effect that lowers it",
            "fit without this effect",
        )
        for effect in calibration.effects
        if not effect.error_after_percent < effect.error_before_percent
    ]
    return tuple(closed)


def _source_refusals(calibration: Calibration) -> list[Refusal]:
    if not calibration.sources:
        return [
            Refusal(Gate.SOURCES, "calibration", "no logs it rests on", "at least one", "fit from logs of this cell")
        ]
    closed = [
        Refusal(
            Gate.PARTIAL,
            f"log {source.name}",
            "what was salvaged of a recording that was never finished, or one with losses",
            "a recording that its recorder stands for to the end",
            "record it again and fit",
        )
        for source in calibration.sources
        if source.partial
    ]
    for source in calibration.sources:
        if source.name.endswith(_UNFINISHED):
            problem = "a recording that was never finished"
        elif not _SHA256.fullmatch(source.sha256):
            problem = f"no SHA-256 digest ({source.sha256[:20]!r})"
        else:
            continue
        closed.append(
            Refusal(Gate.SOURCES, f"log {source.name}", problem, "a finished, valid log", "record it again and fit")
        )
    return closed


def _percent(part: float, whole: float) -> float:
    return 100.0 * part / whole if whole else math.inf
