"""From a calibration to the controller file: what would change, which gates are closed, and the change itself."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from daq.configuration.apply_policy import ApplyPolicy
from daq.errors import CalibrationRefused, ControllerUnfit
from daq.write_back.controller_file import ControllerFile, Scalar, decode, read_bytes
from daq.write_back.controller_write import Written, sha256, write
from daq.write_back.gain_spelling import spell
from daq.write_back.gates import GainChange, Refusal, calibration_refusals, gain_refusals
from ident.calibration import Calibration, Gain


@dataclass(frozen=True, slots=True)
class Proposal:
    """A change that has been worked out and not made.

    Attributes:
        file: the controller file, as it was named.
        base_sha256: digest of its content when the change was worked out.
        before, after: its text; equal where there is nothing to change.
        changes: one a gain, in the order of the calibration.
        refusals: closed gates; only a proposal without any can be applied.
    """

    file: Path
    base_sha256: str
    before: str
    after: str
    changes: tuple[GainChange, ...]
    refusals: tuple[Refusal, ...]

    @property
    def diff(self) -> str:
        """The change as a unified diff, empty where there is none."""
        lines = difflib.unified_diff(
            self.before.splitlines(keepends=True),
            self.after.splitlines(keepends=True),
            f"{self.file.name} (now)",
            f"{self.file.name} (calibrated)",
            n=1,
        )
        return "".join(line if line.endswith("\n") else f"{line}\n" for line in lines)


def propose(
    calibration: Calibration,
    file: Path,
    keys: Mapping[str, str],
    *,
    cell: str,
    configuration_sha256: str | None = None,
    policy: ApplyPolicy | None = None,
) -> Proposal:
    """Work out what a calibration changes in a controller file; reads only.

    Args:
        calibration: with the identified gains.
        file: the controller's YAML file.
        keys: dotted path of each axis's gain in it, by the axis's name.
        cell: name of the cell that the controller drives.
        configuration_sha256: digest of that cell's configuration, None where it is not to be compared.
        policy: bounds; the default ones when None.

    Raises:
        ControllerUnfit: the file cannot be read, does not parse, or lacks a gain that can be changed on its own.
        CalibrationRefused: the calibration has other axes than the cell.
    """
    policy = policy or ApplyPolicy()
    _check_axes(calibration, keys)
    content = read_bytes(file)
    now = decode(content, str(file))
    scalars = now.locate(tuple(keys[gain.axis] for gain in calibration.gains))
    changes = tuple(_change(gain, scalar) for gain, scalar in zip(calibration.gains, scalars, strict=True))
    refusals = calibration_refusals(calibration, cell, configuration_sha256, policy) + tuple(
        r for c in changes for r in gain_refusals(c, policy)
    )
    spelling = {change.key: change.spelling for change in changes if change.spelling}
    return Proposal(file, sha256(content), now.text, now.with_values(spelling).text, changes, refusals)


def apply(proposal: Proposal, now: datetime) -> Written | None:
    """Make a proposed change.

    Args:
        proposal: without refusals.
        now: time for the backup's name.

    Returns:
        what was written, None where the file had these gains already.

    Raises:
        CalibrationRefused: a gate is closed, with every one of them.
        ControllerChanged, ControllerBusy: see `daq.write_back.controller_write.write`.
        OSError: from the file system; the file stands as it was.
    """
    if proposal.refusals:
        raise refused(proposal)
    if proposal.after == proposal.before:
        return None
    spelling = {change.key: change.spelling for change in proposal.changes}
    before = ControllerFile(str(proposal.file), proposal.before)

    def check(content: bytes) -> None:
        decode(content, str(proposal.file)).check_against(before, spelling)

    return write(proposal.file, proposal.after.encode(), proposal.base_sha256, check, now)


def refused(proposal: Proposal) -> CalibrationRefused:
    """The error for a proposal with closed gates; several are listed one a line."""
    if len(proposal.refusals) == 1:
        only = proposal.refusals[0]
        return CalibrationRefused(only.subject, found=only.found, expected=only.expected, remedy=only.remedy)
    listed = "".join(f"\n  {refusal}" for refusal in proposal.refusals)
    return CalibrationRefused(
        str(proposal.file),
        found=f"{len(proposal.refusals)} closed gates{listed}\n ",
        expected="none",
        remedy="nothing was written",
    )


def _check_axes(calibration: Calibration, keys: Mapping[str, str]) -> None:
    axes = [gain.axis for gain in calibration.gains]
    if sorted(axes) != sorted(keys):
        raise CalibrationRefused(
            "calibration",
            found=f"gains of {', '.join(axes) or 'no axis'}",
            expected=f"one of each axis that the controller file takes: {', '.join(keys) or 'none'}",
            remedy="give the calibration and the configuration of the same cell",
        )
    doubled = sorted({key for key in keys.values() if list(keys.values()).count(key) > 1})
    if doubled:
        raise ControllerUnfit(
            "controller.gains",
            found=f"{', '.join(doubled)} for more than one axis",
            expected="a key of its own for each axis",
            remedy="correct the cell configuration",
        )


def _change(gain: Gain, scalar: Scalar) -> GainChange:
    writable = math.isfinite(gain.value) and math.isfinite(gain.std) and gain.value != 0
    spelling = spell(gain.value, gain.std, scalar.text) if writable else ""
    if spelling and float(spelling) == scalar.value:
        spelling = scalar.text  # the same number in the human's own spelling is no change
    return GainChange(
        axis=gain.axis,
        key=scalar.key,
        line=scalar.line,
        old=scalar.value,
        new=float(spelling) if spelling else gain.value,
        std=gain.std,
        unit=gain.unit,
        nameplate=gain.nameplate,
        spelling=spelling,
    )
