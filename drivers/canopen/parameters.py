"""Read and write parameters in the drives of a cell while no axis has power: all of them or none.

Nothing moves: no NMT command, no PDO and no controlword is sent. Each write is read back and, where
requested, saved. After a failure the previous values are restored in every drive that was touched.
A save may store more than the parameter: where it would store the PDO mapping, that must not be a
mapping which a recording left behind.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum

from drivers.canopen.network import CanopenNetwork
from drivers.canopen.pdo import STATUSWORD, read_pdo_record, wanted_pdos
from drivers.canopen.sdo import SdoPolicy
from drivers.canopen.setup import CONSUMERS
from drivers.errors import (
    DriverError,
    NodeError,
    ObjectAccessError,
    ParameterRefused,
    ParametersMixed,
)
from drivers.profiles.cia402 import POWERLESS, decode
from drivers.profiles.profile import Axis, DriveParameter, Identity, Mapping, ObjectEntry

#: Drives write their whole memory, which takes 0.4 s and more, and answer when it is done
SAVE_TIMEOUT_S = 10.0


class Saving(Enum):
    """Whether the parameters outlive the drives' power.

    KNOWN: every drive saves, and it is known what that stores. ANY: a drive whose save is not fully
    known saves too, as if it stored the mapping. RAM: no drive saves; the values are lost with its
    power.
    """

    KNOWN = "known"
    ANY = "any"
    RAM = "ram"


@dataclass(frozen=True, slots=True)
class ParameterValue:
    """A parameter read from a drive, with the drive's identity; `word` holds its bits."""

    axis: Axis
    identity: Identity
    parameter: DriveParameter
    word: int

    @property
    def value(self) -> float:
        """The number."""
        return self.parameter.value(self.word)


@dataclass(frozen=True, slots=True)
class ParameterWrite:
    """A parameter to write; `word` holds its bits."""

    axis: Axis
    parameter: DriveParameter
    word: int


@dataclass(frozen=True, slots=True)
class ParameterChange:
    """A parameter that was written: its bits before and after, and whether the drive saved it."""

    axis: str
    parameter: DriveParameter
    old: int
    new: int
    saved: bool


def read_parameters(
    network: CanopenNetwork, wanted: Sequence[tuple[Axis, DriveParameter]]
) -> tuple[ParameterValue, ...]:
    """Read a parameter of each axis; changes nothing.

    Args:
        network: open, and not prepared for recording.
        wanted: parameters of axes of the network.

    Raises:
        BusBusy: another master commands this bus.
        NodeMissing, SetupRefused, ObjectAccessError, BusError: see drivers/errors.py.
    """
    network.require_quiet()
    identities = dict(zip(network.node_ids, network.check_identities(), strict=True))
    found = []
    for axis, parameter in wanted:
        word = network.objects(axis).read(parameter.entry)
        found.append(ParameterValue(axis, identities[axis.node_id], parameter, word))
    return tuple(found)


def write_parameters(
    network: CanopenNetwork,
    writes: Sequence[ParameterWrite],
    saving: Saving,
    begin: Callable[[tuple[ParameterValue, ...]], None],
) -> tuple[ParameterChange, ...]:
    """Write a parameter of each axis, all of them or none.

    Args:
        network: open, and not prepared for recording.
        writes: at most one an axis; the network's own axes define how an axis saves.
        saving: whether the drives save.
        begin: called with the previous values after all checks and before the first write; an
            exception stops it.

    Raises:
        ParameterRefused: an axis has power (checked before and after each write), a drive cannot
            save, or a value reads back differently. The previous values are in force.
        BusBusy, NodeMissing, SetupRefused, ObjectAccessError, BusError: see drivers/errors.py; the
            previous values are in force.
        ParametersMixed: as these, and the previous values could not be restored everywhere.
    """
    axes = {axis.node_id: axis for axis in network.axes}
    writes = [replace(write, axis=axes[write.axis.node_id]) for write in writes]
    old = read_parameters(network, [(write.axis, write.parameter) for write in writes])
    for axis in network.axes:
        _require_powerless(network, axis)
    if saving is not Saving.RAM:
        for write in writes:
            _require_savable(network, write.axis, saving)
    network.link.require_alone()
    begin(old)
    tried: list[ParameterValue] = []
    saved: list[Axis] = []
    try:
        for value, write in zip(old, writes, strict=True):
            if value.word != write.word:
                tried.append(value)
                _require_powerless(network, write.axis)
                network.objects(write.axis).write(write.parameter.entry, write.word)
                _check(network, write)
                _require_powerless(network, write.axis)
                network.link.require_alone()
        if saving is not Saving.RAM:
            for write in writes:
                saved.append(write.axis)
                try:
                    _save(network, write.axis)
                except ObjectAccessError as error:
                    if error.abort_code is not None:
                        saved.remove(write.axis)  # an abort confirms that nothing was saved
                    raise
                _check(network, write)
        for axis in network.axes:
            _require_powerless(network, axis)
        network.link.require_alone()
    # An interrupt too: a cell with half of the new gains has no valid set.
    except BaseException as error:
        with network.block_signals():
            _undo(network, tried, saved, error)
        raise
    return tuple(
        ParameterChange(
            write.axis.name, write.parameter, value.word, write.word, saving is not Saving.RAM
        )
        for value, write in zip(old, writes, strict=True)
    )


def recording_leftover(network: CanopenNetwork, axis: Axis) -> str:
    """Describe settings of a killed recording in a drive; empty where there are none.

    They are lost with the drive's power, and a save would keep them.
    """
    access = network.objects(axis)
    # A recording sets the watch before any PDO or mode. Only a missing 1016h proves that there is
    # none; any other refusal may hide one.
    for sub in range(1, (access.read_optional(CONSUMERS) or 0) + 1):
        value = access.read_optional(ObjectEntry(CONSUMERS.index, sub, 32))
        if value is None:
            break
        if network.was_ours(value):
            return f"{CONSUMERS.index:04X}h:{sub:02X} = {value:08X}h watches the recorder"
    try:
        pdos = wanted_pdos(axis)
    except ValueError:
        return ""  # this drive cannot be recorded
    for ours in pdos.feedback + pdos.setpoints:
        found = read_pdo_record(access, ours.direction, ours.number)
        if found is not None and (found.entries, found.transmission) == (
            ours.entries,
            ours.transmission,
        ):
            return str(found)
    return ""


def _check(network: CanopenNetwork, write: ParameterWrite | ParameterValue) -> None:
    found = network.objects(write.axis).read(write.parameter.entry)
    if found != write.word:
        written, read = (
            f"{write.parameter.value(word):.9g} ({word:#x})" for word in (write.word, found)
        )
        raise ParameterRefused(
            write.axis,
            f"object {write.parameter} reads back as {read}, written was {written}; does the drive "
            "limit or round it, or is it another object?",
        )


def _save(network: CanopenNetwork, axis: Axis) -> None:
    save = axis.profile.save
    if save is not None:
        _require_powerless(network, axis)
        # One attempt: a drive that is late is still busy with the first.
        network.link.objects(axis.node_id, SdoPolicy(SAVE_TIMEOUT_S, 1)).write(
            save.command, save.signature
        )


def _require_powerless(network: CanopenNetwork, axis: Axis) -> None:
    statusword = network.objects(axis).read(STATUSWORD)
    state = decode(statusword)
    if state not in POWERLESS:
        raise ParameterRefused(
            axis,
            f"{state} (statusword {statusword:#06x}): its power stage is not off, and no parameter "
            "is written while it is on; disable the axes with the controller that enabled them, "
            "then try again",
        )


def _require_savable(network: CanopenNetwork, axis: Axis, saving: Saving) -> None:
    save = axis.profile.save
    if save is None:
        reason = f"is not described in its profile {axis.profile.name}"
        remedy = (
            "describe it there, or write to its RAM alone (`Saving.RAM`): the gain is then "
            "lost with its power"
        )
    elif save.mapping is Mapping.UNKNOWN and saving is Saving.KNOWN:
        reason = (
            f"may store more than the gain ({axis.profile.name}: {axis.profile.save_semantics})"
        )
        remedy = "write to its RAM alone (`Saving.RAM`), or let it save all the same (`Saving.ANY`)"
    elif save.mapping is not Mapping.SEPARATE and (left := recording_leftover(network, axis)):
        reason = f"would keep settings of a recording that was killed ({left})"
        remedy = (
            "switch the drive off and on, so that it starts with its own settings, and try again"
        )
    else:
        return
    raise ParameterRefused(axis, f"nothing was written, because saving it {reason}; {remedy}")


def _undo(
    network: CanopenNetwork,
    tried: Sequence[ParameterValue],
    saved: Sequence[Axis],
    error: BaseException,
) -> None:
    """Restore the previous values, and save them where new ones may have been saved;
    ParametersMixed if not all are.
    """
    restored = []
    problems = []
    # What a bus says concerns every drive on it: each reason once, with the axes that have it.
    axes_by_reason: dict[str, list[str]] = {}
    try:
        # One time limit for all drives that do not answer.
        network.find_silent([value.axis for value in tried])
    except DriverError as problem:
        axes_by_reason[str(problem)] = []
    for value in tried:
        try:
            _put_back(network, value, save=value.axis in saved)
            restored.append(value.axis.name)
        except NodeError as problem:
            problems.append(str(problem))
        except DriverError as problem:
            axes_by_reason.setdefault(str(problem), []).append(value.axis.name)
    for reason, axes in axes_by_reason.items():
        if axes:
            problems.append(f"{', '.join(axes)}: {reason}")
        else:
            problems.append(reason)
    if problems and tried:
        raise ParametersMixed(tuple(restored), tuple(problems)) from error
    if restored:
        error.add_note(f"kept: the previous values are restored in {', '.join(restored)}")


def _put_back(network: CanopenNetwork, value: ParameterValue, *, save: bool) -> None:
    if value.axis.node_id in network.link.silent:
        raise ObjectAccessError(
            value.axis, str(value.parameter), "the node does not answer any more"
        )
    access = network.objects(value.axis)
    if access.read(value.parameter.entry) != value.word:
        _require_powerless(network, value.axis)
        access.write(value.parameter.entry, value.word)
    _check(network, value)
    if save:
        _save(network, value.axis)
        _check(network, value)
