"""From a calibration to objects in the drives of a cell: what would change, and which gates are closed."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from daq.config.cell import Cell
from daq.config.controller import GainObject
from daq.errors import CalibrationRefused, ConfigurationInconsistent, ControllerUnfit
from daq.writeback.drive_record import record_folder
from daq.writeback.gates.fit import fit_refusals
from daq.writeback.gates.logs import source_refusals
from daq.writeback.gates.signature import signature_refusals
from daq.writeback.gates.table import Refusal, gate_context, refusal_error
from daq.writeback.gates.target import GainChange, drive_base_refusals, gain_refusals
from daq.writeback.request import Request, change_digest, changed_since_review, evidence_of, parse_base
from drivers.canopen.network import CanopenNetwork
from drivers.canopen.parameters import ParameterValue, ParameterWrite, read_parameters
from ident.calibration import Gain


@dataclass(frozen=True, slots=True)
class DriveProposal:
    """A change of the drives that has been worked out and not made.

    Attributes:
        cell: its name.
        folder: of the records.
        base: what stands in the drives.
        writes: what would stand there.
        changes: one a gain, in the order of the axes.
        refusals: closed gates; only a proposal without any can be applied.
        evidence: what the change rests on, for the audit.
    """

    cell: str
    folder: Path
    base: tuple[ParameterValue, ...]
    writes: tuple[ParameterWrite, ...]
    changes: tuple[GainChange, ...]
    refusals: tuple[Refusal, ...]
    evidence: Mapping[str, object] = field(default_factory=dict)

    @property
    def base_sha256(self) -> str:
        """Digest of what stands in the drives, and of which drives they are."""
        return digest(self.base)

    @property
    def contents(self) -> tuple[bytes, bytes]:
        """What stands, and would stand, in the drives."""
        return canonical(self.base), canonical(self.base, tuple(write.word for write in self.writes))

    @property
    def looked_at(self) -> str:
        """What --base takes from whoever has looked at this change: they want this one and no other."""
        return change_digest(*self.contents)

    @property
    def unchanged(self) -> bool:
        """Whether the drives have these gains already, in their RAM at least."""
        return all(value.word == write.word for value, write in zip(self.base, self.writes, strict=True))


def drives_of(cell: str) -> str:
    """What the audit and the history call the drives of a cell."""
    return f"drives of cell {cell}"


def propose_to_drives(declared: Cell, request: Request, network: CanopenNetwork) -> DriveProposal:
    """Work out what a calibration changes in the drives of a cell, with the gates of a controller file; reads only.

    Args:
        declared: the cell as it is now, with `controller.objects`.
        request: what is to be applied; `DriveProposal.looked_at` stands for the change that somebody has looked at.
        network: of all axes of the cell, open, and not prepared for recording.

    Raises:
        ConfigurationInconsistent: the cell has no objects for the gains.
        CalibrationRefused: the calibration has other axes than the cell.
        ControllerUnfit: an object holds no such gain, or only one that is farther off than σ.
        DriverError: see `drivers.canopen.parameters.read_parameters`.
    """
    objects, calibration = _objects(declared), request.calibration
    gains = {gain.axis: gain for gain in calibration.gains}
    if sorted(gains) != sorted(declared.axis_names) or len(gains) != len(calibration.gains):
        raise CalibrationRefused(
            "calibration",
            found=f"gains of {', '.join(gain.axis for gain in calibration.gains) or 'no axis'}",
            expected=f"one of each axis of the cell: {', '.join(declared.axis_names)}",
            remedy="give the calibration and the configuration of the same cell",
        )
    policy = request.policy or declared.apply
    pairs = [(axis, gain_object.parameter) for axis, gain_object in zip(network.axes, objects, strict=True)]
    base = read_parameters(network, pairs)
    changes, writes = [], []
    for value, gain_object in zip(base, objects, strict=True):
        change, word = _change(gains[value.axis.name], value, gain_object)
        changes.append(change)
        writes.append(ParameterWrite(value.axis, gain_object.parameter, word))
    configuration = None if request.configuration_changed else declared.digest
    subject, folder = drives_of(declared.name), record_folder(declared)
    before, after = canonical(base), canonical(base, tuple(write.word for write in writes))
    reviewed = parse_base(request.looked_at, before)
    refusals = (
        *fit_refusals(calibration, declared.name, configuration, policy, declared.recording_digest),
        *source_refusals(calibration, policy, gate_context(declared, request.now, request.entered_kg)),
        *drive_base_refusals(subject, base, digest(base), folder, reviewed.base_sha256),
        *changed_since_review(reviewed, subject, before, after),
        *signature_refusals(request.file, request.signed, policy, request.appliers),
        *(refusal for change in changes for refusal in gain_refusals(change, policy)),
    )
    evidence = evidence_of(calibration, request.signed, request.file)
    return DriveProposal(declared.name, folder, base, tuple(writes), tuple(changes), refusals, evidence)


def refused(proposal: DriveProposal) -> CalibrationRefused:
    """The error for a proposal with closed gates."""
    return refusal_error(drives_of(proposal.cell), proposal.refusals)


def _objects(declared: Cell) -> tuple[GainObject, ...]:
    objects = () if declared.controller is None else declared.controller.objects
    if not objects:
        raise ConfigurationInconsistent(
            f"cell {declared.name!r}: controller",
            found="no objects in the drives",
            expected="the object of each axis's gain",
            remedy="add `controller: {objects: [{index: ..., subindex: ..., type: ..., factor: ...}, ...]}` to the "
            "cell file, one for each axis (docs/how-to/write-gains.md)",
        )
    return objects


def _change(gain: Gain, value: ParameterValue, gain_object: GainObject) -> tuple[GainChange, int]:
    """The change, and the bits to write; those of now where there is no gain to write, which a gate refuses."""
    key = f"node {value.axis.node_id}, {gain_object.parameter}"
    writable = math.isfinite(gain.value) and math.isfinite(gain.std) and gain.value != 0
    word = _word(key, gain, gain_object) if writable else value.word
    new = gain_object.parameter.value(word) / gain_object.factor
    change = GainChange(
        axis=gain.axis,
        key=key,
        line=0,
        old=value.value / gain_object.factor,
        new=new if writable else gain.value,
        std=gain.std,
        unit=gain.unit,
        nameplate=gain.nameplate,
        spelling=f"{gain_object.parameter.value(word):.9g}" if writable else "",
    )
    return change, word


def _word(key: str, gain: Gain, gain_object: GainObject) -> int:
    wanted = gain_object.factor * gain.value
    try:
        word = gain_object.parameter.word(wanted)
    except ValueError as error:
        raise ControllerUnfit(
            key,
            found=str(error),
            expected="a gain that fits",
            remedy="check `type` and `factor` in `controller.objects` of the cell file; nothing was written",
        ) from error
    held = gain_object.parameter.value(word)
    if held == 0 or 0 < abs(gain_object.factor) * gain.std < abs(held - wanted):
        raise ControllerUnfit(
            key,
            found=f"{wanted:.6g} ± {abs(gain_object.factor) * gain.std:.2g}, which the number {held:.9g} does not tell",
            expected="a rounding below σ",
            remedy="this object is too coarse for the gain: use another one, or another factor in "
            "`controller.objects`; nothing was written",
        )
    return word


def canonical(base: tuple[ParameterValue, ...], words: tuple[int, ...] | None = None) -> bytes:
    """Which drives they are and what stands in them, or the given bits in its place, as bytes."""
    listed = [
        [value.axis.name, value.axis.node_id, value.identity.serial, str(value.parameter), word]
        for value, word in zip(base, words or [value.word for value in base], strict=True)
    ]
    return json.dumps(listed).encode()


def digest(base: tuple[ParameterValue, ...]) -> str:
    """By which it is recognised what stands in some drives."""
    return hashlib.sha256(canonical(base)).hexdigest()
