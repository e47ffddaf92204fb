"""From a calibration to the controller file: what would change, which gates are closed, and the change itself."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from itertools import combinations
from pathlib import Path

from daq.config.cell import Cell
from daq.config.controller import ControllerFormat
from daq.config.policy import ApplyPolicy
from daq.errors import CalibrationRefused, ConfigurationInconsistent, ControllerUnfit
from daq.files import sha256
from daq.ledger.audit import AuditRecorder
from daq.writeback.file_access import require_existing, resolve_links
from daq.writeback.file_target import Written, write
from daq.writeback.formats.document import decode, read_bytes
from daq.writeback.formats.scalar import Scalar, rewrite_gain
from daq.writeback.gates.fit import fit_refusals
from daq.writeback.gates.logs import source_refusals
from daq.writeback.gates.signature import signature_refusals
from daq.writeback.gates.table import GateContext, Refusal, gate_context, refusal_error
from daq.writeback.gates.target import GainChange, base_refusals, gain_refusals
from daq.writeback.request import Request, change_digest, changed_since_review, evidence_of, parse_base
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
        before_content, after_content: what stands, and would stand, in the file.
        format: of the file; None where its name tells.
        evidence: what the change rests on, for the audit: digests of calibration, configuration and logs.
    """

    file: Path
    base_sha256: str
    before: str
    after: str
    changes: tuple[GainChange, ...]
    refusals: tuple[Refusal, ...]
    before_content: bytes
    after_content: bytes
    format: ControllerFormat | None = None
    evidence: Mapping[str, object] = field(default_factory=dict)

    @property
    def looked_at(self) -> str:
        """What --base takes from whoever has looked at this change: they want this one and no other."""
        return change_digest(self.before_content, self.after_content)

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


def propose_for(declared: Cell, request: Request, file: Path | None = None) -> Proposal:
    """Work out what a calibration changes in the controller file of a cell, with every gate there is; reads only.

    Args:
        declared: the cell as it is now.
        request: what is to be applied.
        file: the controller's file, where it is not the one that the cell names.

    Raises:
        ConfigurationInconsistent: the cell names no controller file, or no keys in it.
        ControllerUnfit, CalibrationRefused: see `propose`.
    """
    target = file or declared.controller_path
    if declared.controller is None or not declared.controller.gains or target is None:
        raise ConfigurationInconsistent(
            f"cell {declared.name!r}: controller",
            found="none" if declared.controller is None else "no file, or no key of each gain in it",
            expected="the controller's file and the key of each gain",
            remedy="add `controller: {file: ..., gains: [...]}` to the cell file",
        )
    names, controller = declared.axis_names, declared.controller
    return propose(
        replace(request, policy=request.policy or declared.apply),
        target,
        dict(zip(names, controller.gains, strict=True)),
        cell=declared.name,
        configuration_sha256=declared.digest,
        recording_configuration_sha256=declared.recording_digest,
        held=gate_context(declared, request.now, request.entered_kg),
        format=controller.format,
        factors=dict(zip(names, controller.factors, strict=True)) if controller.factors else {},
    )


def propose(
    request: Request,
    file: Path,
    keys: Mapping[str, str],
    *,
    cell: str,
    configuration_sha256: str | None = None,
    recording_configuration_sha256: str | None = None,
    held: GateContext | None = None,
    format: ControllerFormat | None = None,  # noqa: A002 - as the cell file calls it
    factors: Mapping[str, float] | None = None,
) -> Proposal:
    """Work out what a calibration changes in a controller file; reads only. `propose_for` takes all of it from a cell.

    Args:
        request: what is to be applied; the default bounds where it has none.
        file: the controller's file.
        keys: key of each axis's gain in it, by the axis's name.
        cell: name of the cell that the controller drives.
        configuration_sha256: digest of that cell's configuration, None where it is not to be compared.
        recording_configuration_sha256: of what of it a recording depends on.
        held: what the logs are held against; what it does not tell is not compared.
        format: of the controller's file; None where its name tells.
        factors: number in the file = gain × factor, by the axis's name; 1 where it is not there.

    Raises:
        ControllerUnfit: the file cannot be read, does not parse, or lacks a gain that can be changed on its own.
        CalibrationRefused: the calibration has other axes than the cell.
        ConfigurationInconsistent: a signer's public key is none.
    """
    calibration, policy, factors = request.calibration, request.policy or ApplyPolicy(), factors or {}
    _check_axes(calibration, keys)
    require_existing(file)
    content = read_bytes(file)
    now = decode(content, str(file), format)
    base_sha256 = sha256(content)
    scalars = now.locate(tuple(keys[gain.axis] for gain in calibration.gains))
    changes = tuple(
        _change(gain, scalar, factors.get(gain.axis, 1.0))
        for gain, scalar in zip(calibration.gains, scalars, strict=True)
    )
    _check_apart(str(file), scalars)
    after = now.with_values({change.key: change.spelling for change in changes if change.spelling})
    reviewed = parse_base(request.looked_at, content)
    # Who has looked at the file matters where something is lost: not where these gains stand in it already.
    base = (
        ()
        if after.content == content and all(change.spelling for change in changes)
        else (
            *base_refusals(calibration, str(file), base_sha256, reviewed.base_sha256),
            *changed_since_review(reviewed, str(file), content, after.content),
        )
    )
    refusals = (
        *fit_refusals(
            calibration,
            cell,
            None if request.configuration_changed else configuration_sha256,
            policy,
            recording_configuration_sha256,
        ),
        *source_refusals(calibration, policy, held or GateContext()),
        *base,
        *signature_refusals(request.file, request.signed, policy, request.appliers),
        *(refusal for change in changes for refusal in gain_refusals(change, policy)),
    )
    return Proposal(
        file,
        base_sha256,
        now.text,
        after.text,
        changes,
        refusals,
        content,
        after.content,
        format,
        evidence_of(calibration, request.signed, request.file),
    )


def apply(proposal: Proposal, now: datetime, *, audit: Path | None = None, who: str = "") -> Written | None:
    """Make a proposed change.

    Args:
        proposal: without refusals.
        now: time for the backup's name and the audit.
        audit: where it is written down that it begins, before anything is replaced, how it ended, and what was refused;
            None for nowhere.
        who: in whose name.

    Returns:
        what was written, None where the file had these gains already.

    Raises:
        CalibrationRefused: a gate is closed, with every one of them.
        ControllerChanged, CalibrationRefused, AuditUnusable: see `daq.writeback.file_target.write`.
        OSError: from the file system; the file stands as it was.
    """
    details = {"changes": [_documented(change) for change in proposal.changes], **proposal.evidence}
    if proposal.refusals:
        AuditRecorder(audit, who, now).record_refusal(resolve_links(proposal.file), proposal.refusals, details)
        raise refused(proposal)
    if proposal.after_content == proposal.before_content:
        AuditRecorder(audit, who, now).record_no_change(resolve_links(proposal.file), proposal.before_content, details)
        return None
    spelling = {change.key: change.spelling for change in proposal.changes}
    before = decode(proposal.before_content, str(proposal.file), proposal.format)

    def check(content: bytes) -> None:
        decode(content, str(proposal.file), proposal.format).check_against(before, spelling)

    return write(
        proposal.file, proposal.after_content, proposal.base_sha256, check, now, audit=audit, who=who, details=details
    )


def refused(proposal: Proposal) -> CalibrationRefused:
    """The error for a proposal with closed gates."""
    return refusal_error(str(proposal.file), proposal.refusals)


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


def _check_apart(file: str, scalars: Sequence[Scalar]) -> None:
    """Two keys may be two names of one place: one axis would get the gain of the other."""
    for one, other in combinations(scalars, 2):
        if one.start < other.end and other.start < one.end:
            raise ControllerUnfit(
                f"{file}, line {one.line}",
                found=f"{one.key} and {other.key}, which name the same number",
                expected="a number of its own for each axis",
                remedy="correct `controller.gains` of the cell configuration; nothing was written",
            )


def _change(gain: Gain, scalar: Scalar, factor: float) -> GainChange:
    writable = math.isfinite(gain.value) and math.isfinite(gain.std) and gain.value != 0
    put = rewrite_gain(scalar, gain.value, gain.std, factor) if writable else None
    return GainChange(
        axis=gain.axis,
        key=scalar.key,
        line=scalar.line,
        old=scalar.value / factor,
        new=gain.value if put is None else put.new,
        std=gain.std,
        unit=gain.unit,
        nameplate=gain.nameplate,
        spelling="" if put is None else put.spelling,
    )


def _documented(change: GainChange) -> dict[str, object]:
    """For the audit, which takes finite numbers only."""
    numbers = {"old": change.old, "new": change.new, "std": change.std}
    finite = {name: value if math.isfinite(value) else None for name, value in numbers.items()}
    return {"axis": change.axis, "key": change.key, "unit": change.unit, **finite}
