"""The amplifiers of one cell: found, checked, set up for recording and moving, given back as they were."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, field
from functools import partial
from types import TracebackType
from typing import Self

import can

from drivers.canopen.link import HEARTBEAT, SYNC_COB_ID, Link, NmtCommand, NmtState, command_name
from drivers.canopen.pdo import (
    CONTROLWORD,
    NOT_VALID,
    PDOS,
    SETPOINT_PDOS,
    STATUSWORD,
    Direction,
    PdoRecord,
    feedback_entries,
    pack,
    read_record,
    records,
    restore,
    switch_off,
    write_record,
)
from drivers.canopen.scan import FoundNode, answering, read_identity, require, scan, unused
from drivers.canopen.sdo import Clock, SdoPolicy
from drivers.errors import (
    WHILE,
    BusBusy,
    DriverError,
    FeedbackDiffers,
    IdentityMismatch,
    MappingRefused,
    NodeMissing,
    RecorderIdTaken,
    StateRefused,
)
from drivers.motion.guard import Guard, arm, disarm, find_guard, is_left_over, producer_of, read_consumers
from drivers.profiles.cia402 import FAULT_RESET_SEQUENCE, POWERLESS, Goal, State, decode, next_command
from drivers.profiles.profile import Axis, Identity, ObjectEntry
from drivers.profiles.scale import ScaleReading, read_scale
from drivers.stream.sample import Sample
from drivers.stream.split_bus import CellAddress, open_cell_bus

HEARTBEAT_TIME = ObjectEntry(0x1017, 0, 16, signed=False)
MODE_OF_OPERATION = ObjectEntry(0x6060, 0, 8, signed=True)
MODE_DISPLAY = ObjectEntry(0x6061, 0, 8, signed=True)
PROFILE_POSITION_MODE = 1
ASKED_AT_ONCE = 8
"""Node ids that the recorder may take, and that are asked for a device."""
HEARTBEAT_MS = 100
"""Of every node, and of the recorder."""
STANDSTILL_COUNTS = 1024
"""An encoder at rest flickers, and an axis may sink onto its brake between two readings."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """How long the cell may take [s].

    Attributes:
        listen_s: to other masters before the first frame is sent; each SYNC period of theirs must fit.
        answer_s: until every node answered the search.
        silence_s: until nodes that do not answer while the network closes are given up, all of them together.
        nmt_s: until a heartbeat confirms an NMT state.
        mode_s: until 6061h shows the mode asked for.
        disable_s: until an axis is without power when the network closes.
        unused_s: to node ids that the recorder may take. With `listen_s` before it, longer than `guard_ms` of a cell
            whose SYNC has a usual period: a slower heartbeat could not stand in for the recorder's.
    """

    answer_s: float = 1.0
    silence_s: float = 0.5
    listen_s: float = 0.2
    nmt_s: float = 2.0
    mode_s: float = 1.0
    disable_s: float = 2.0
    unused_s: float = 0.35


SignalBlocker = Callable[[], AbstractContextManager[None]]
"""Makes blocks that no signal interrupts for a while: in them the axes are stopped and given back."""
DEFAULT_BOUNDS = Bounds()
DEFAULT_POLICY = SdoPolicy()


@dataclass
class _Original:
    """What a drive had before we came; filled step by step, so that a half-done set-up can be undone."""

    heartbeat_ms: int | None = None
    guard: Guard | None = None
    mode: int | None = None
    pdos: dict[str, PdoRecord] = field(default_factory=dict)


class CanopenNetwork:
    """The axes of a cell. Use as a context manager; leaving it disables all axes and restores all settings.

    Args:
        address: of the bus, or of the buses that share the axes.
        axes: the amplifiers, in the order of the samples' columns.
        heartbeat_ms: what every node is told to send, and we send while axes have power.
        guard_ms: silence of ours after which the amplifiers stop by themselves (drivers/motion/guard.py).
        bounds, policy: how long to wait.
        clock: monotonic time [ns].
        opener: makes the bus of an address, or the one that several make.
        undisturbed: keeps signals from stopping the axes and giving them back.
    """

    def __init__(
        self,
        address: CellAddress,
        axes: tuple[Axis, ...],
        *,
        heartbeat_ms: int = HEARTBEAT_MS,
        guard_ms: int = 500,
        bounds: Bounds = DEFAULT_BOUNDS,
        policy: SdoPolicy = DEFAULT_POLICY,
        clock: Clock = time.monotonic_ns,
        opener: Callable[[CellAddress], can.BusABC] = open_cell_bus,
        block_signals: SignalBlocker = nullcontext,
    ) -> None:
        self.axes = axes
        self.block_signals = block_signals
        self.heartbeat_ms = heartbeat_ms
        self.guard_ms = guard_ms
        self.bounds = bounds
        self.link = Link(address, policy, clock, opener)
        self.node_ids = tuple(axis.node_id for axis in axes)
        self.link.axis_ids = frozenset(self.node_ids)
        # The highest id is the last that anybody gives to a drive; `prepare` looks whether it is free.
        self.recorder_id = next((n for n in range(127, 0, -1) if n not in self.node_ids), 0)
        self._originals: dict[int, _Original] = {}
        self._readback: dict[str, object] = {}
        self._scales: dict[str, ScaleReading] = {}

    def __enter__(self) -> Self:
        self.link.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            with self.block_signals():
                problems = self._give_back() if self._originals else []
        except BaseException as cut:
            cut.add_note(f"{WHILE}closing the network: it was cut short, and not every axis has its settings back")
            raise
        finally:
            self.link.close()
        if error is not None:
            for problem in problems:
                error.add_note(f"{WHILE}closing the network: {problem}")
        elif problems:
            for problem in problems[1:]:
                problems[0].add_note(str(problem))
            raise problems[0]

    def scan(self, node_ids: Sequence[int] = range(1, 128), wait_s: float = 0.5) -> tuple[FoundNode, ...]:
        """Who is on the bus; changes nothing.

        Raises:
            BusError: the bus has gone.
        """
        return scan(self.link, node_ids, wait_s)

    def check_identities(self) -> tuple[Identity, ...]:
        """Compare 1018h of every axis with its configuration.

        Raises:
            NodeMissing: a node does not answer.
            IdentityMismatch: another amplifier than the configured one.
            ObjectAccessError: a node does not tell who it is.
        """
        require(self.link, self.node_ids, self.bounds.answer_s)
        return tuple(self._check_identity(axis) for axis in self.axes)

    def _check_identity(self, axis: Axis) -> Identity:
        found = read_identity(self.link.objects(axis.node_id))
        expected = axis.identity
        if expected is None:
            return found
        pairs = [
            ("vendor id 1018h:01", expected.vendor_id, found.vendor_id),
            ("product code 1018h:02", expected.product_code, found.product_code),
        ]
        if expected.serial is not None:
            pairs.append(("serial number 1018h:04", expected.serial, found.serial or 0))
        for name, want, have in pairs:
            if want != have:
                raise IdentityMismatch(axis.node_id, name, want, have)
        return found

    def prepare(self) -> None:
        """Set every node up: identity, heartbeats, PRE-OPERATIONAL, mapping, profile position mode, OPERATIONAL.

        No axis gets power. The objects' values from before are written back when the network is left.

        Raises:
            BusBusy: another master commands this bus; nothing was sent.
            RecorderIdTaken: no node id is free for the recorder's heartbeat.
            NodeMissing, IdentityMismatch, NmtRefused, MappingRefused, ObjectAccessError, StateRefused, BusError: see
                drivers/errors.py; what was changed until then is restored on leaving the network.
            ScaleImplausible: the ampere of a drive cannot be true (drivers/profiles/scale.py).
        """
        self.require_quiet()
        identities = self.check_identities()
        consumers = [read_consumers(self.link.objects(node_id)) for node_id in self.node_ids]
        if self.link.own_id is None:
            self._take_recorder_id([value for entries in consumers for _, value in entries or ()])
        for axis, entries in zip(self.axes, consumers, strict=True):
            original = self._originals.setdefault(axis.node_id, _Original())
            access = self.link.objects(axis.node_id)
            if original.heartbeat_ms is None:
                original.heartbeat_ms = access.read(HEARTBEAT_TIME)
            access.write(HEARTBEAT_TIME, self.heartbeat_ms)
            if original.guard is None:
                original.guard = find_guard(access, entries, self.was_ours)
            original.guard = arm(access, original.guard, self.recorder_id, self.guard_ms)
        self._command_all(NmtCommand.ENTER_PRE_OPERATIONAL, NmtState.PRE_OPERATIONAL)
        for axis, identity in zip(self.axes, identities, strict=True):
            self.disable(axis)
            mapped = self._map(axis)
            self._set_mode(axis)
            self._readback[axis.name] = self._describe(axis, identity, mapped)
        self._command_all(NmtCommand.START, NmtState.OPERATIONAL)

    def _take_recorder_id(self, watched: Sequence[int]) -> None:
        """Choose the highest node id that no device uses, and that no amplifier waits for.

        Args:
            watched: entries of 1016h of all amplifiers.

        Raises:
            RecorderIdTaken: there is none.
        """
        # One that waits for a device which is off now would take our heartbeat for that device's.
        awaited = {producer_of(value) for value in watched if value & 0xFFFF != self.guard_ms}
        left = [n for n in range(127, 0, -1) if n not in awaited and n not in self.node_ids]
        while left := [n for n in left if n not in self.link.heard]:
            asked, left = left[:ASKED_AT_ONCE], left[ASKED_AT_ONCE:]
            if free := unused(self.link, asked, self.bounds.unused_s):
                self.recorder_id = self.link.own_id = free[0]
                return
        raise RecorderIdTaken(
            "none that is free: all of 1 to 127 belong to axes or other devices, or an axis waits for them (1016h)",
            "nothing has moved; take one of the other devices off the bus while recording",
        )

    def was_ours(self, value: int) -> bool:
        """Whether an entry of 1016h still watches a recorder that was killed."""
        return is_left_over(value, self.recorder_id, self.guard_ms, self.link.heard | self.link.axis_ids)

    def require_quiet(self) -> None:
        """Listen for a while before the first frame is sent.

        Raises:
            BusBusy: another master commands this bus.
        """
        self.link.foreign.clear()
        self.link.wait(self.bounds.listen_s)
        self.require_alone()

    def require_alone(self) -> None:
        """Look back at what came since `require_quiet`.

        Raises:
            BusBusy: a command of another master was among it.
        """
        if self.link.foreign:
            seen = ", ".join(command_name(identifier) for identifier in sorted(self.link.foreign))
            raise BusBusy(str(self.link.address), seen)

    def guard(self) -> None:
        """Let the amplifiers watch us from now on: they quick stop by themselves when we fall silent.

        Raises:
            RecorderIdTaken: a device has come that sends the same heartbeat.
        """
        if HEARTBEAT + self.recorder_id in self.link.foreign:
            raise RecorderIdTaken.by_another(self.recorder_id)
        self.link.start_heartbeat(self.recorder_id, self.heartbeat_ms)

    def unguard(self) -> None:
        """End that once all axes are known to stand, so that what is slow after a run is not taken for our end.

        Without it the guard ends when the network closes, axis by axis, after each was disabled.
        """
        for node_id, original in self._originals.items():
            if original.guard is not None and node_id not in self.link.silent:
                # What fails here is tried again, and told, when the network closes.
                with suppress(DriverError):
                    disarm(self.link.objects(node_id), original.guard)
        self.link.stop_heartbeat()

    def unguarded(self) -> tuple[str, ...]:
        """What the amplifiers of the prepared network lack to stop by themselves when the recorder is killed."""
        guards = [(axis, original.guard) for axis in self.axes if (original := self._originals.get(axis.node_id))]
        return tuple(f"{axis.name}: {guard.lack}" for axis, guard in guards if guard is not None and guard.lack)

    def find_silent(self, axes: Sequence[Axis]) -> NodeMissing | None:
        """Ask all these axes at once who still answers; those that do not are passed over from then on.

        Raises:
            BusError: the bus has gone.
        """
        asked = tuple(axis.node_id for axis in axes)
        answered = answering(self.link, [n for n in asked if n not in self.link.silent], self.bounds.silence_s)
        missing = tuple(node_id for node_id in asked if node_id not in answered)
        self.link.silent.update(missing)
        return NodeMissing(missing, answered, self.bounds.silence_s) if missing else None

    def check_feedback(self, sample: Sample) -> None:
        """Compare the positions in a sample of axes at standstill with what they say by SDO.

        Raises:
            FeedbackDiffers: a PDO carries something else.
            ObjectAccessError: an axis does not answer.
        """
        for axis, by_pdo in zip(self.axes, sample.position_counts, strict=True):
            entry = axis.profile.position
            by_sdo = self.link.objects(axis.node_id).read(entry)
            if abs(by_sdo - by_pdo) > STANDSTILL_COUNTS:
                raise FeedbackDiffers(axis.node_id, str(entry), by_sdo, by_pdo, STANDSTILL_COUNTS)

    def _command_all(self, command: NmtCommand, state: NmtState) -> None:
        """To each node of ours, not to all of the bus: there may be others on it."""
        since = {node_id: self.link.command_nmt(node_id, command) for node_id in self.node_ids}
        for node_id, since_ns in since.items():
            waited_s = (self.link.clock() - since_ns) * 1e-9
            self.link.confirm_nmt(node_id, state, since_ns, max(self.bounds.nmt_s - waited_s, 0.0))

    def _map(self, axis: Axis) -> tuple[PdoRecord, ...]:
        node_id = axis.node_id
        access = self.link.objects(node_id)
        original = self._originals[node_id]
        try:
            feedback = pack(feedback_entries(axis))
        except ValueError as error:
            raise MappingRefused(node_id, "TPDO", f"profile {axis.profile.name}: {error}") from error
        wanted = {
            Direction.TPDO: records(Direction.TPDO, node_id, feedback),
            Direction.RPDO: records(Direction.RPDO, node_id, SETPOINT_PDOS),
        }
        for direction, pdos in wanted.items():
            for number in range(PDOS):
                found = read_record(access, direction, number)
                if number < len(pdos) and found is None:
                    raise MappingRefused(node_id, pdos[number].name, "the drive has no such PDO")
                if found is None:
                    continue
                if number < len(pdos):
                    original.pdos.setdefault(found.name, found)
                    write_record(access, pdos[number])
                elif not found.cob_id & NOT_VALID:
                    original.pdos.setdefault(found.name, found)
                    switch_off(access, found)  # a drive's default PDOs would come between ours
        return wanted[Direction.TPDO] + wanted[Direction.RPDO]

    def _set_mode(self, axis: Axis) -> None:
        access = self.link.objects(axis.node_id)
        original = self._originals[axis.node_id]
        if original.mode is None:
            original.mode = access.read(MODE_OF_OPERATION)
        access.write(MODE_OF_OPERATION, PROFILE_POSITION_MODE)
        deadline = self.link.clock() + round(self.bounds.mode_s * 1e9)
        while (shown := access.read(MODE_DISPLAY)) != PROFILE_POSITION_MODE:
            if self.link.clock() >= deadline:
                found = f"mode {shown} in 6061h"
                raise StateRefused(axis.node_id, "profile position mode (1)", found, access.read(STATUSWORD))
            self._let_time_pass()

    def ampere_per_unit(self) -> tuple[float, ...]:
        """Ampere per raw unit of each axis' current object, from the drives' own scale objects.

        Raises:
            ObjectAccessError: a scale object cannot be read.
            ScaleImplausible: it cannot be true.
        """
        return tuple(reading.ampere_per_unit for reading in self.scales())

    def scales(self) -> tuple[ScaleReading, ...]:
        """What the drives say of their ampere and their motors, in the order of the axes; read once.

        Raises:
            ObjectAccessError, ScaleImplausible: as `drivers.profiles.scale.read_scale`.
        """
        return tuple(self._scale(axis) for axis in self.axes)

    def _scale(self, axis: Axis) -> ScaleReading:
        if axis.name not in self._scales:
            self._scales[axis.name] = read_scale(self.link.objects(axis.node_id), axis.profile)
        return self._scales[axis.name]

    def readback(self) -> dict[str, object]:
        """What the drives said about themselves during ``prepare``, by axis name, for the log."""
        return dict(self._readback)

    def _describe(self, axis: Axis, identity: Identity, mapped: tuple[PdoRecord, ...]) -> dict[str, object]:
        scale = self._scale(axis)
        return {
            "node_id": axis.node_id,
            "vendor_id": identity.vendor_id,
            "product_code": identity.product_code,
            "serial": identity.serial,
            "profile": axis.profile.name,
            # What the recorded current is: without both a gain of this log cannot be compared with another's.
            "amplitude": axis.profile.amplitude.value,
            "tap": axis.profile.tap.value,
            "signal": axis.profile.signal,
            "scale_objects": scale.objects,
            "ampere_per_unit": scale.ampere_per_unit,
            "rated_current_a": scale.rated_current_a,
            "rated_torque_nm": scale.rated_torque_nm,
            "scale_warnings": list(scale.warnings),
            "guard": _guard_text(self._originals[axis.node_id].guard, self.guard_ms),
            "mode_before": self._originals[axis.node_id].mode,
            "mapping": [str(record) for record in mapped],
            "mapping_before": [str(record) for record in self._originals[axis.node_id].pdos.values()],
        }

    def statuswords(self) -> tuple[int, ...]:
        """6041h of every axis, by SDO.

        Raises:
            ObjectAccessError: an axis does not answer.
        """
        return tuple(self.link.objects(node_id).read(STATUSWORD) for node_id in self.node_ids)

    def reset_faults(self) -> None:
        """Reset the faults of all axes that have one; a person's decision, never taken by a recording itself.

        Raises:
            StateRefused: an axis is still in fault.
        """
        for axis in self.axes:
            access = self.link.objects(axis.node_id)
            if decode(access.read(STATUSWORD)) is not State.FAULT:
                continue
            for command in FAULT_RESET_SEQUENCE:
                access.write(CONTROLWORD, command)
                self._let_time_pass()
            statusword = access.read(STATUSWORD)
            if decode(statusword) is State.FAULT:
                raise StateRefused(axis.node_id, "fault reset", str(State.FAULT), statusword)

    def begin_stop(self, axes: Sequence[Axis]) -> None:
        """Say quick stop by SDO to all these axes before `disable` waits for the first; it tells what fails here."""
        for axis in axes:
            access = self.link.objects(axis.node_id)
            with suppress(DriverError):
                state = decode(access.read(STATUSWORD))
                if state not in POWERLESS:
                    access.write(CONTROLWORD, next_command(state, Goal.QUICK_STOP))

    def disable(self, axis: Axis) -> None:
        """Quick stop one axis by SDO, then take its power, and confirm both by its statusword.

        Raises:
            StateRefused: it did not get there in ``bounds.disable_s``.
            ObjectAccessError: it does not answer.
        """
        access = self.link.objects(axis.node_id)
        deadline = self.link.clock() + round(self.bounds.disable_s * 1e9)
        goal = Goal.QUICK_STOP
        while decode(statusword := access.read(STATUSWORD)) not in POWERLESS:
            state = decode(statusword)
            if self.link.clock() >= deadline:
                if goal is Goal.SWITCH_ON_DISABLED:
                    raise StateRefused(axis.node_id, str(State.SWITCH_ON_DISABLED), str(state), statusword)
                # The ramp did not end by itself: some drives stay in QUICK STOP ACTIVE until told (605Ah = 5..8).
                goal, deadline = Goal.SWITCH_ON_DISABLED, deadline + round(self.bounds.disable_s * 1e9)
            access.write(CONTROLWORD, next_command(state, goal))
            self._let_time_pass()

    def _let_time_pass(self) -> None:
        """One SYNC: a cell that lives in lockstep advances by SYNC alone, and a real one is not disturbed by it."""
        self.link.send((can.Message(arbitration_id=SYNC_COB_ID, is_extended_id=False),))
        self.link.wait(0.001)

    def _give_back(self) -> list[DriverError]:
        """Disable, PRE-OPERATIONAL, restore; every step is tried, whatever the one before did."""
        problems: list[DriverError] = []
        axes = [axis for axis in self.axes if axis.node_id in self._originals]
        silent: NodeMissing | None = None
        for attempt in ("first", "last"):
            try:
                # One bound for all: asked in turn, six dead nodes would keep a person waiting for a minute and more.
                silent = self.find_silent(axes)
                break
            except DriverError as problem:
                # One of several buses that fails is told of once, and then the others go on.
                if not problems or str(problem) != str(problems[0]):
                    problems.append(problem)
                if attempt == "last":
                    self._originals.clear()
                    return problems
        if silent is not None:
            silent.add_note("it is not known to stand, and its settings were not restored")
            problems.append(silent)
            axes = [axis for axis in axes if axis.node_id not in silent.node_ids]
        self.begin_stop(axes)
        self._try(problems, [partial(self.disable, axis) for axis in axes])
        since_ns = self.link.clock()
        pre_operational = NmtCommand.ENTER_PRE_OPERATIONAL
        self._try(problems, [partial(self.link.command_nmt, axis.node_id, pre_operational) for axis in axes])
        for axis in axes:
            left_s = self.bounds.nmt_s - (self.link.clock() - since_ns) * 1e-9
            confirm = partial(self.link.confirm_nmt, axis.node_id, NmtState.PRE_OPERATIONAL, since_ns, max(left_s, 0.0))
            self._try(problems, [confirm, *self._restoring(axis)])
        self._originals.clear()
        return problems

    def _try(self, problems: list[DriverError], steps: Sequence[Callable[[], object]]) -> None:
        for step in steps:
            try:
                step()
            except DriverError as problem:
                problems.append(problem)

    def _restoring(self, axis: Axis) -> Iterator[Callable[[], object]]:
        access = self.link.objects(axis.node_id)
        original = self._originals[axis.node_id]
        for record in original.pdos.values():
            yield partial(restore, access, record)
        if original.mode is not None:
            yield partial(access.write, MODE_OF_OPERATION, original.mode)
        if original.guard is not None:
            yield partial(disarm, access, original.guard)
        if original.heartbeat_ms is not None:
            yield partial(access.write, HEARTBEAT_TIME, original.heartbeat_ms)


def _guard_text(guard: Guard | None, silence_ms: int) -> str:
    if guard is None or guard.consumer is None:
        return guard.lack if guard is not None else "none"
    return f"watches the recorder by {guard.consumer}, {silence_ms} ms" + (f"; {guard.lack}" if guard.lack else "")
