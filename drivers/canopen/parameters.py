"""Numbers in the drives of a cell, written while no axis has power: read back, saved, and all of them or none.

Nothing moves: this path sends no NMT command, no PDO and no controlword. Whatever fails, the old values are put back in
every drive that was touched. A save may keep more than what was written: where it would keep the PDO mapping, the
mapping must not be one that a recording left behind.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

from drivers.canopen.network import CanopenNetwork
from drivers.canopen.pdo import (
    PDOS,
    SETPOINT_PDOS,
    STATUSWORD,
    Direction,
    PdoRecord,
    feedback_entries,
    pack,
    read_record,
    records,
)
from drivers.canopen.sdo import ABORT_DOES_NOT_EXIST, ABORT_NO_SUBINDEX, SdoPolicy
from drivers.errors import DriverError, ObjectAccessError, ParametersMixed, PowerNotOff, ReadbackDiffers, SaveRefused
from drivers.motion.guard import CONSUMERS
from drivers.profiles.cia402 import POWERLESS, decode
from drivers.profiles.profile import Axis, Identity, Mapping, ObjectEntry, Parameter

# What a recording that was killed has left in a drive: its power takes it away, a save would keep it.


def recording_leftover(network: CanopenNetwork, axis: Axis) -> str:
    """What a drive still has of a recording that was killed, for a person; empty where it has nothing.

    Raises:
        ObjectAccessError: it does not let it be read.
    """
    watched = _watches_recorder(network, axis)
    if watched:
        return watched
    access = network.link.objects(axis.node_id)
    for ours in _recorded(axis):
        found = read_record(access, ours.direction, ours.number)
        if found is not None and (found.entries, found.transmission) == (ours.entries, ours.transmission):
            return str(found)
    return ""


def _watches_recorder(network: CanopenNetwork, axis: Axis) -> str:
    """Whether the drive waits for a recorder's heartbeat: a recording sets that first, and gives it back last."""
    access = network.link.objects(axis.node_id)
    try:
        for sub in range(1, access.read(CONSUMERS) + 1):
            value = access.read(ObjectEntry(CONSUMERS.index, sub, 32, signed=False))
            if network.was_ours(value):
                return f"{CONSUMERS.index:04X}h:{sub:02X} = {value:08X}h watches the recorder"
    except ObjectAccessError as error:
        # Only one that it does not have is none: whatever else it refuses may hide what was left.
        if error.abort_code not in (ABORT_DOES_NOT_EXIST, ABORT_NO_SUBINDEX):
            raise
    return ""


def _recorded(axis: Axis) -> tuple[PdoRecord, ...]:
    """The PDOs that a recording sets up."""
    try:
        feedback = pack(feedback_entries(axis))[:PDOS]
    except ValueError:
        return ()  # of this drive nothing can be recorded
    node_id = axis.node_id
    return records(Direction.TPDO, node_id, feedback) + records(Direction.RPDO, node_id, SETPOINT_PDOS)


SAVE_TIMEOUT_S = 10.0
"""Drives write their whole memory: 0.4 s and more, and answer when it is done."""


class Saving(Enum):
    """What is to outlive the drives' power.

    KNOWN: every drive saves, and of every one it is known what that keeps. ANY: where it is not known too, as if it
    kept the mapping. RAM: none saves; what is written is gone with the next power-off.
    """

    KNOWN = "known"
    ANY = "any"
    RAM = "ram"


@dataclass(frozen=True, slots=True)
class ParameterValue:
    """What stands in a drive.

    Attributes:
        axis: it belongs to.
        identity: of the drive, as it told.
        parameter: that was read.
        word: its bits.
    """

    axis: Axis
    identity: Identity
    parameter: Parameter
    word: int

    @property
    def value(self) -> float:
        """The number."""
        return self.parameter.value(self.word)


@dataclass(frozen=True, slots=True)
class ParameterWrite:
    """What is to stand in a drive: the bits of a number."""

    axis: Axis
    parameter: Parameter
    word: int


@dataclass(frozen=True, slots=True)
class ParameterChange:
    """What was done to a drive.

    Attributes:
        axis: its name.
        parameter: that was written.
        old, new: its bits before and after.
        saved: whether the drive was told to keep it.
    """

    axis: str
    parameter: Parameter
    old: int
    new: int
    saved: bool


@dataclass
class _Progress:
    """How far a write came: what must be undone when it fails."""

    tried: list[ParameterWrite] = field(default_factory=list)
    saves: list[Axis] = field(default_factory=list)


def read_parameters(network: CanopenNetwork, wanted: Sequence[tuple[Axis, Parameter]]) -> tuple[ParameterValue, ...]:
    """Read a parameter of each axis; changes nothing.

    Args:
        network: open, and not prepared for recording.
        wanted: which parameter of which axis of the network.

    Raises:
        BusBusy: another master commands this bus.
        NodeMissing, IdentityMismatch, ObjectAccessError, BusError: see drivers/errors.py.
    """
    network.require_quiet()
    identities = dict(zip(network.node_ids, network.check_identities(), strict=True))
    return tuple(
        ParameterValue(
            axis, identities[axis.node_id], parameter, network.link.objects(axis.node_id).read(parameter.entry)
        )
        for axis, parameter in wanted
    )


def write_parameters(
    network: CanopenNetwork,
    writes: Sequence[ParameterWrite],
    saving: Saving,
    begin: Callable[[tuple[ParameterValue, ...]], None],
    *,
    save_timeout_s: float = SAVE_TIMEOUT_S,
) -> tuple[ParameterChange, ...]:
    """Write a parameter of each axis, all of them or none.

    Args:
        network: open, and not prepared for recording.
        writes: at most one an axis; how an axis saves, the network's own axes tell.
        saving: whether the drives keep it.
        begin: called with the old values, when nothing more is to be asked and before the first is overwritten; what
            it raises stops the write.
        save_timeout_s: how long a drive may take to save [s].

    Raises:
        PowerNotOff: an axis of the network has power, or may have; looked at before and after each write.
        SaveRefused: see `Saving`.
        BusBusy, NodeMissing, IdentityMismatch, ObjectAccessError, BusError, ReadbackDiffers: see drivers/errors.py; the
            old values stand.
        ParametersMixed: as these, and the old values could not be put back everywhere.
    """
    axes = {axis.node_id: axis for axis in network.axes}
    writes = [replace(write, axis=axes[write.axis.node_id]) for write in writes]
    old = read_parameters(network, [(write.axis, write.parameter) for write in writes])
    for axis in network.axes:
        _require_powerless(network, axis)
    if saving is not Saving.RAM:
        for write in writes:
            _require_savable(network, write.axis, saving)
    network.require_alone()
    begin(old)
    progress = _Progress()
    try:
        for value, write in zip(old, writes, strict=True):
            if value.word != write.word:
                progress.tried.append(write)
                _put(network, write)
        if saving is not Saving.RAM:
            for write in writes:
                _save_noted(network, write.axis, save_timeout_s, progress)
                _check(network, write)
        for axis in network.axes:
            _require_powerless(network, axis)
        network.require_alone()
    except BaseException as error:  # an interrupt too: half of the gains are none
        with network.block_signals():
            _undo(network, old, progress, save_timeout_s, error)
        raise
    return tuple(
        ParameterChange(write.axis.name, write.parameter, value.word, write.word, saving is not Saving.RAM)
        for value, write in zip(old, writes, strict=True)
    )


def _put(network: CanopenNetwork, write: ParameterWrite) -> None:
    _require_powerless(network, write.axis)
    network.link.objects(write.axis.node_id).write(write.parameter.entry, write.word)
    _check(network, write)
    _require_powerless(network, write.axis)
    network.require_alone()


def _check(network: CanopenNetwork, write: ParameterWrite) -> None:
    found = network.link.objects(write.axis.node_id).read(write.parameter.entry)
    if found != write.word:
        written, read = (f"{write.parameter.value(word):.9g} ({word:#x})" for word in (write.word, found))
        raise ReadbackDiffers(write.axis.node_id, str(write.parameter), written, read)


def _save_noted(network: CanopenNetwork, axis: Axis, timeout_s: float, progress: _Progress) -> None:
    progress.saves.append(axis)
    try:
        _save(network, axis, timeout_s)
    except ObjectAccessError as error:
        if error.abort_code is not None:
            progress.saves.remove(axis)  # it says itself that it kept nothing
        raise


def _save(network: CanopenNetwork, axis: Axis, timeout_s: float) -> None:
    save = axis.profile.save
    if save is not None:
        _require_powerless(network, axis)
        # Asked once: a drive that is late is still busy with the first.
        network.link.objects(axis.node_id, SdoPolicy(timeout_s, 1)).write(save.command, save.signature)


def _require_powerless(network: CanopenNetwork, axis: Axis) -> None:
    statusword = network.link.objects(axis.node_id).read(STATUSWORD)
    state = decode(statusword)
    if state not in POWERLESS:
        raise PowerNotOff(axis.node_id, str(state), statusword)


def _require_savable(network: CanopenNetwork, axis: Axis, saving: Saving) -> None:
    save = axis.profile.save
    if save is None:
        raise SaveRefused(
            axis.node_id,
            f"is not described in its profile {axis.profile.name}",
            "describe it there, or write to its RAM alone (--ram-only): the gain is then gone with its power",
        )
    if save.mapping is Mapping.UNKNOWN and saving is Saving.KNOWN:
        raise SaveRefused(
            axis.node_id,
            f"keeps nobody knows what ({axis.profile.name}: {axis.profile.save_semantics})",
            "write to its RAM alone (--ram-only), or let it save all the same (--save-unknown)",
        )
    if save.mapping is not Mapping.SEPARATE and (left := recording_leftover(network, axis)):
        raise SaveRefused(
            axis.node_id,
            f"would keep what a recording that was killed has left there ({left})",
            "switch the drive off and on, so that it comes back with its own settings, and try again",
        )


def _undo(
    network: CanopenNetwork,
    old: tuple[ParameterValue, ...],
    progress: _Progress,
    timeout_s: float,
    error: BaseException,
) -> None:
    """Put the old values back, and save them where the new ones may have been saved.

    Raises:
        ParametersMixed: not everywhere; what was raised before is its cause.
    """
    tried = {write.axis.node_id for write in progress.tried}
    touched = [value for value in old if value.axis.node_id in tried]
    restored, problems = [], []
    try:
        # One bound for all: asked in turn, drives that have gone would keep a person waiting.
        network.find_silent([value.axis for value in touched])
    except DriverError as problem:
        problems.append(str(problem))
    for value in touched:
        try:
            _put_back(network, value, save=value.axis in progress.saves, timeout_s=timeout_s)
            restored.append(value.axis.name)
        except DriverError as problem:
            problems.append(f"{value.axis.name}: {problem}")
    if problems and touched:
        raise ParametersMixed(tuple(restored), tuple(problems)) from error
    if restored:
        error.add_note(f"kept: the old values stand again in {', '.join(restored)}")


def _put_back(network: CanopenNetwork, value: ParameterValue, *, save: bool, timeout_s: float) -> None:
    if value.axis.node_id in network.link.silent:
        raise ObjectAccessError(value.axis.node_id, str(value.parameter), "the node does not answer any more")
    write = ParameterWrite(value.axis, value.parameter, value.word)
    access = network.link.objects(value.axis.node_id)
    if access.read(value.parameter.entry) != value.word:
        _require_powerless(network, value.axis)
        access.write(value.parameter.entry, value.word)
    _check(network, write)
    if save:
        _save(network, value.axis, timeout_s)
        _check(network, write)
