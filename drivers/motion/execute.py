"""Make a list of moves in CiA 402 profile position mode, one Sample after the other.

Source: CiA 402-2, profile position mode: a set-point is taken on the rising edge of controlword bit
4, acknowledged by statusword bit 12, and reached at bit 10. Set-points go by synchronous RPDOs, so
that all axes start on the same SYNC.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from drivers.canopen.bus import base_frame
from drivers.canopen.network import FAILURES_OF_A_STOP, CanopenNetwork
from drivers.canopen.pdo import (
    CONTROLWORD,
    PROFILE_ACCELERATION,
    PROFILE_DECELERATION,
    PROFILE_VELOCITY,
    TARGET_POSITION,
)
from drivers.errors import (
    WHILE,
    DriveFault,
    DriverError,
    MotionRefused,
    MotionTimeout,
    NodeMissing,
    StateRefused,
    node_label,
    text_of,
)
from drivers.messages import CellEvent, EventKind, Sample
from drivers.move import MotionPermission, Move, check_moves
from drivers.profiles.cia402 import (
    CONTROL_CHANGE_IMMEDIATELY,
    CONTROL_NEW_SETPOINT,
    POWERLESS,
    STATUS_SETPOINT_ACKNOWLEDGE,
    STATUS_TARGET_REACHED,
    ControlCommand,
    Goal,
    State,
    decode,
    next_command,
)
from drivers.profiles.profile import Axis, ObjectEntry
from drivers.stream.cycles import LARGEST_LAG_NS, nothing_to_send
from drivers.stream.stream import MAX_MISSING_CYCLES, SyncStream
from drivers.stream.watch import FrozenData

#: Cycles in which a controlword is sent with every SYNC; after them with every tenth
_URGENT_CYCLES = 10
_NEW_SETPOINT = ControlCommand.ENABLE_OPERATION | CONTROL_NEW_SETPOINT | CONTROL_CHANGE_IMMEDIATELY


@dataclass(frozen=True, slots=True)
class MotionBounds:
    """Time limits in the time of the samples [s], and distances that count as standstill and as
    arrival.
    """

    enable_s: float = 3.0  #: from the first controlword to OPERATION ENABLED
    acknowledge_s: float = 0.5  #: from a set-point to bit 12, and from its end to bit 12 cleared
    settle_s: float = 3.0  #: added to a move's computed duration
    stop_s: float = 3.0  #: from the quick stop to standstill without power
    #: An axis that stays in QUICK STOP ACTIVE is at standstill, and loses its power, when its
    #: position has kept within this many counts for this many cycles. An encoder of 20 bits a turn
    #: flickers by several counts at rest. 16 counts in 20 cycles of 1 ms are at most 800 counts/s,
    #: 0.3 deg/s of such a motor, which is harmless to a brake.
    standstill_cycles: int = 20
    standstill_counts: int = 16  #: largest distance from its position at their begin
    #: Largest distance from a target that bit 10 reports as reached: these counts plus
    #: `arrival_fraction` of the way. It catches a drive whose bit 10 is still that of the move
    #: before. A short way lies within it from the start, so no move ends before the duration of its
    #: profile either.
    arrival_counts: int = 2000
    arrival_fraction: float = 0.05  #: see `arrival_counts`


DEFAULT_BOUNDS = MotionBounds()


def execute(
    network: CanopenNetwork,
    stream: SyncStream,
    moves: Sequence[Move],
    permission: MotionPermission | None,
    bounds: MotionBounds = DEFAULT_BOUNDS,
) -> Generator[Sample, None, None]:
    """Enable all axes, make the moves, disable all axes; yields every Sample on the way.

    However it ends, all axes get quick stop, then power off, confirmed as far as the bus allows.
    Close it (``contextlib.closing``) when the loop around it may be left early; leaving the network
    stops the axes as well.

    Raises:
        MotionRefused: no permission, or a move outside of it; nothing has moved.
        StateRefused: an axis did not become OPERATION ENABLED, or could not be stopped.
        MotionTimeout: a move did not end in time.
        DriveFault: position and current of a moving axis do not change; or as the stream.
        SampleLost, BusError, BusBusy, NodeMisplaced: as the stream.
    """
    if permission is None:
        raise MotionRefused("motion is disabled; pass a MotionPermission that names the operator")
    first = next(stream)
    yield first
    while first.missing:  # the position of every axis must be known before it gets a target
        first = next(stream)
        yield first
    check_moves(first.position_counts, moves, permission, tuple(axis.name for axis in network.axes))
    if not moves:
        return
    execution = _Execution(network, stream, bounds, first)
    network.guard()
    try:
        yield from execution.enable(permission.granted_by)
        for number, move in enumerate(moves):
            yield from execution.move(number, move)
        yield from execution.stop()
        execution.end_watch()
    except BaseException as error:
        # Also a closed generator and an interrupt, during the stop above as well: it then runs
        # without yielding.
        with network.block_signals():
            try:
                execution.report_end(error)
                for _ in execution.stop():
                    pass
            except BaseException as cut:
                cut.add_note(f"{WHILE}stopping: the stop was cut short")
                raise
            execution.end_watch()
        execution.note_failures(error)
        raise
    execution.raise_failures()
    stream.check()  # faults during the stop


class _Standstill:
    """Detection of axes at standstill, from samples one after the other."""

    def __init__(self, bounds: MotionBounds, position_counts: Sequence[int]) -> None:
        self._bounds = bounds
        self._rest_counts = list(position_counts)  # by axis
        self._cycles = [0] * len(position_counts)  # in a row near that position, by axis

    def add(self, sample: Sample) -> None:
        """Compare positions with those of rest; a missing axis is not known to stand still."""
        for axis, position in enumerate(sample.position_counts):
            # Not with the cycle before: creeping is no standstill.
            distance = abs(position - self._rest_counts[axis])
            is_near = distance <= self._bounds.standstill_counts
            is_missing = sample.missing >> axis & 1
            if is_near and not is_missing:
                self._cycles[axis] += 1
            else:
                self._cycles[axis] = 0
            if not is_near:
                self._rest_counts[axis] = position

    def is_reached(self, axis: int) -> bool:
        """Return whether an axis has stood still for long enough."""
        return self._cycles[axis] >= self._bounds.standstill_cycles


class _Execution:
    """One run of ``execute``: the stream, the last sample and the last command of each axis."""

    def __init__(
        self, network: CanopenNetwork, stream: SyncStream, bounds: MotionBounds, first: Sample
    ) -> None:
        self.problems: list[DriverError] = []  #: Failures to confirm the last stop
        self.unreported: Exception | None = None  #: First failure to report an event of a stop
        self._network = network
        self._stream = stream
        self._bus = stream.bus
        self._bounds = bounds
        self._sample = first
        self._pdos = network.pdos
        self._nodes = network.axes
        self._axes = range(len(network.axes))
        self._targets = list(first.position_counts)
        #: Where the moves have the axes before the next of them, as their permission was checked
        self._planned_counts = first.position_counts
        self._sent: list[tuple[int, int] | None] = [None] * len(network.axes)

    def _cycles(self, seconds: float) -> int:
        return max(1, round(seconds * 1e9 / self._stream.pacing.period_ns))

    def _state(self, axis: int) -> State:
        return decode(self._sample.statusword[axis])

    def _send_command(self, axis: int, controlword: int, repeat: bool = False) -> None:
        """Send controlword and target of one axis with the next SYNC;
        an unchanged pair only on request.
        """
        command = (controlword, self._targets[axis])
        if repeat or self._sent[axis] != command:
            self._sent[axis] = command
            self._send(axis, {TARGET_POSITION: self._targets[axis], CONTROLWORD: controlword})

    def _send(self, axis: int, values: Mapping[ObjectEntry, int]) -> None:
        """Send values of one axis with the next SYNC, in its RPDOs;
        those of objects that it does not have are left.
        """
        self._bus.outgoing += [
            base_frame(cob_id, data) for cob_id, data in self._pdos[axis].payloads(values)
        ]

    @contextmanager
    def _events_may_fail(self) -> Iterator[None]:
        """Go on where an event, of the stream as well, cannot be logged or shown."""
        emit = self._bus.emit

        def emit_guarded(event: CellEvent) -> None:
            try:
                emit(event)
            except Exception as failure:  # noqa: BLE001 - whatever the receiver raises, the axes are stopped first
                self.unreported = self.unreported or failure

        self._bus.emit = emit_guarded
        try:
            yield
        finally:
            self._bus.emit = emit

    def report_end(self, cause: BaseException) -> None:
        """Report why the moves end before the last one."""
        with self._events_may_fail():
            self._bus.report(None, EventKind.ENDED, 0, _cause(cause))

    def end_watch(self) -> None:
        """End the amplifiers' watch, and the time limit of the stop, where the stop is confirmed.

        Amplifiers without confirmed standstill go on watching the recorder.
        """
        if not self.problems:
            self._network.unguard()
            self._network.end_closing()

    def note_failures(self, error: BaseException) -> None:
        """Note on the error that a stop was made for what the stop could not confirm or report."""
        for problem in self.problems:
            error.add_note(f"{WHILE}stopping: {problem}")
        if self.unreported is not None:
            error.add_note(f"{WHILE}stopping: its events are not all reported: {self.unreported!r}")

    def raise_failures(self) -> None:
        """Raise what the stop at the end of all moves could not confirm or report."""
        for problem in self.problems[1:]:
            self.problems[0].add_note(f"{WHILE}stopping: {problem}")
        if self.problems:
            raise self.problems[0]
        if self.unreported is not None:
            raise self.unreported

    def enable(self, granted_by: str) -> Iterator[Sample]:
        """Bring all axes to OPERATION ENABLED, each holding where it is."""
        self._bus.report(None, EventKind.STATE, 0, f"enabling all axes, permission by {granted_by}")
        for axis in self._axes:
            if self._state(axis) in (State.FAULT, State.FAULT_REACTION_ACTIVE):
                raise self._refusal(axis)
        self._network.powered.update(self._network.node_ids)
        for cycle in range(self._cycles(self._bounds.enable_s)):
            waiting = [
                axis for axis in self._axes if self._state(axis) is not State.OPERATION_ENABLED
            ]
            if not waiting:
                return
            for axis in waiting:
                # A target that is not the position would be a jump on enabling.
                self._targets[axis] = self._sample.position_counts[axis]
                command = next_command(self._state(axis), Goal.OPERATION_ENABLED)
                self._send_command(axis, command, repeat=cycle % 10 == 0)
            self._sample = next(self._stream)
            yield self._sample
        for axis in self._axes:
            if self._state(axis) is not State.OPERATION_ENABLED:
                raise self._refusal(axis)

    def _refusal(self, axis: int) -> StateRefused:
        word = self._sample.statusword[axis]
        node = self._nodes[axis]
        return StateRefused(
            node,
            str(State.OPERATION_ENABLED),
            str(decode(word)),
            word,
            reported=self._network.link.reported.get(node.node_id, ""),
        )

    def move(self, number: int, move: Move) -> Iterator[Sample]:
        """Make one move of all axes with a distance to go, and the dwell after it."""
        moving = self._moved_by(move)
        start = list(move.target_counts)
        for axis in moving:
            start[axis] = self._targets[axis]
            # One axis a cycle: a whole set would not fit between two SYNCs of a classic bus.
            velocity = move.velocity_counts_s[axis]
            acceleration = move.acceleration_counts_s2[axis]
            profile = {
                PROFILE_VELOCITY: velocity,
                PROFILE_ACCELERATION: acceleration,
                PROFILE_DECELERATION: acceleration,
            }
            self._send(axis, profile)
            yield self._checked()
        acknowledging = yield from self._release(moving)
        if acknowledging:
            raise self._timeout(number, acknowledging, self._bounds.acknowledge_s, acknowledge=0)
        for axis in moving:
            self._targets[axis] = move.target_counts[axis]
            self._send_command(axis, _NEW_SETPOINT)
        sample = self._checked()
        self._bus.report(
            None, EventKind.MOVE_START, number, f"move {number} to {move.target_counts}"
        )
        yield sample
        yield from self._handshake(number, moving)
        duration_s = max(move.duration_s(start))
        first_end_cycle = sample.cycle + self._cycles(duration_s)
        allowed_s = 2 * duration_s + self._bounds.settle_s
        data = FrozenData(move, start, moving, self._stream.pacing.period_ns)
        for _ in range(self._cycles(allowed_s)):
            for axis in data.frozen(self._sample):
                # A stiff axis may be there before its profile ends
                if not self._arrived(axis, start[axis]):
                    raise self._frozen(number, axis)
            late = self._late(moving, start)
            acknowledging = self._acknowledging(moving)
            if self._sample.cycle >= first_end_cycle and not late and not acknowledging:
                break
            yield self._checked()
        else:
            late = self._late(moving, start)
            if late:
                raise self._timeout(number, late, allowed_s)
            acknowledging = self._acknowledging(moving)
            if acknowledging:
                raise self._timeout(number, acknowledging, allowed_s, acknowledge=0)
        self._bus.report(
            None,
            EventKind.MOVE_END,
            number,
            f"move {number} ended at {self._sample.position_counts}",
        )
        self._planned_counts = move.target_counts
        for _ in range(move.dwell_cycles):
            yield self._checked()

    def _moved_by(self, move: Move) -> tuple[int, ...]:
        """Return the axes that a move takes elsewhere.

        An axis that it leaves where the move before left it has no profile that was checked. It
        stays where it got power, even if it had crept some counts until then.
        """
        moving = []
        for axis, target in enumerate(move.target_counts):
            if target not in (self._planned_counts[axis], self._targets[axis]):
                moving.append(axis)
        return tuple(moving)

    def _frozen(self, number: int, axis: int) -> DriveFault:
        """Report an axis whose data do not change during a move; return the fault."""
        position = self._sample.position_counts[axis]
        current = self._sample.current_raw[axis]
        reason = (
            f"move {number}: position {position} and current {current} do not "
            "change during the move"
        )
        remedy = "is its data frozen, its encoder or its motor cable off?"
        fault = DriveFault(self._nodes[axis], reason, remedy=remedy)
        self._bus.report(axis, EventKind.FROZEN, number, str(fault))
        return fault

    def _handshake(self, number: int, moving: Sequence[int]) -> Iterator[Sample]:
        """Wait until all axes acknowledge the new set-point, then clear it with one SYNC.

        A drive without a buffer holds its acknowledgement until it has arrived; the move waits for
        that at its end.
        """
        waiting = tuple(moving)
        for _ in range(self._cycles(self._bounds.acknowledge_s)):
            if not waiting:
                break
            for axis in waiting:
                # Repeated every cycle until acknowledged: some drives act on the second controlword
                # only.
                self._send_command(axis, _NEW_SETPOINT, repeat=True)
            yield self._checked()
            acknowledging = self._acknowledging(moving)
            waiting = tuple(axis for axis in moving if axis not in acknowledging)
        if waiting:
            raise self._timeout(number, waiting, self._bounds.acknowledge_s, acknowledge=1)
        for axis in moving:
            self._send_command(axis, int(ControlCommand.ENABLE_OPERATION), repeat=True)
        yield self._checked()
        yield from self._release(moving)

    def _release(self, moving: Sequence[int]) -> Generator[Sample, None, tuple[int, ...]]:
        """Clear the new set-point until no axis acknowledges one;
        return those that still do in the end.
        """
        acknowledging = self._acknowledging(moving)
        for cycle in range(self._cycles(self._bounds.acknowledge_s)):
            if not acknowledging:
                break
            for axis in acknowledging:
                # Less often after a while: where a drive acknowledges until it has arrived, the bus
                # has other work.
                is_due = cycle < _URGENT_CYCLES or cycle % _URGENT_CYCLES == 0
                self._send_command(axis, int(ControlCommand.ENABLE_OPERATION), repeat=is_due)
            yield self._checked()
            acknowledging = self._acknowledging(moving)
        return acknowledging

    def _acknowledging(self, axes: Sequence[int]) -> tuple[int, ...]:
        """Return the axes that acknowledge a set-point now."""
        return tuple(
            axis for axis in axes if self._sample.statusword[axis] & STATUS_SETPOINT_ACKNOWLEDGE
        )

    def _late(self, axes: Sequence[int], start: Sequence[int]) -> tuple[int, ...]:
        """Return the axes that have not arrived; `start` has the targets of all axes before."""
        return tuple(axis for axis in axes if not self._arrived(axis, start[axis]))

    def _timeout(
        self, number: int, late: tuple[int, ...], waited_s: float, acknowledge: int | None = None
    ) -> MotionTimeout:
        """Return the error for axes that a move waited for.

        `acknowledge` is the value of bit 12 that did not come; None where the axes did not arrive.
        """
        nodes = [self._nodes[axis] for axis in late]
        other_master = self._network.other_master()
        return MotionTimeout(number, late, nodes, waited_s, acknowledge, other_master)

    def _arrived(self, axis: int, start: int) -> bool:
        """Return whether an axis is near its target and its bit 10 is set.

        On a short way both may be so before the axis moves: see `MotionBounds.arrival_counts`.
        """
        target = self._targets[axis]
        way = abs(target - start)
        tolerance = self._bounds.arrival_counts + self._bounds.arrival_fraction * way
        is_near = abs(self._sample.position_counts[axis] - target) <= tolerance
        is_reached = bool(self._sample.statusword[axis] & STATUS_TARGET_REACHED)
        return is_near and is_reached

    def _checked(self) -> Sample:
        """Return the next sample, in which all axes are still enabled."""
        sample = next(self._stream)
        self._sample = sample
        for axis in self._axes:
            is_missing = sample.missing >> axis & 1
            state = self._state(axis)
            if not is_missing and state is not State.OPERATION_ENABLED:
                self._stream.check()  # the drive's own report says more
                word = sample.statusword[axis]
                raise DriveFault(self._nodes[axis], f"left OPERATION ENABLED, is {state}", word)
        return sample

    def stop(self) -> Iterator[Sample]:
        """Quick stop all axes, then remove their power;
        failures to confirm it are in `problems`.

        The stop goes on where its events cannot be logged or shown.
        """
        with self._events_may_fail():
            yield from self._stop()

    def _stop(self) -> Iterator[Sample]:
        self._bus.outgoing.clear()  # a set-point that was not sent yet must not start a move now
        self._bus.low_priority = nothing_to_send
        self._bus.report(None, EventKind.STOP, 0, "quick stop, then power off, on all axes")
        self.problems = []
        self._network.begin_closing()
        unconfirmed = tuple(self._axes)
        try:
            unconfirmed = yield from self._stop_by_pdo()
            # What is left is counted before SDO answers are read; axes that may have power do not
            # wait for it.
            if unconfirmed:
                periods = 1
                lag_s = 0.0
            else:
                periods = MAX_MISSING_CYCLES + 2
                lag_s = LARGEST_LAG_NS * 1e-9
            self._stream.read_on(periods * self._stream.pacing.period_ns * 1e-9, lag_s)
        except DriverError as error:
            # One of several buses may have failed, or a node is misplaced: the others are stopped
            # by SDO.
            self._bus.report(
                None, EventKind.STOP_UNCONFIRMED, 0, f"the bus ended the stop by PDO: {error}"
            )
            self.problems.append(error)
        nodes = [self._nodes[axis] for axis in unconfirmed]
        try:
            silent = self._find_silent(nodes)
        except DriverError as error:
            self._add_problem(error)
            return
        unheard: tuple[int, ...] = ()
        if silent is not None:
            unheard = silent.node_ids
            self.problems.append(silent)
            self._network.stop_unheard(unheard)
        heard = [node for node in nodes if node.node_id not in unheard]
        ramp_end_ns = self._network.begin_stop(heard)
        for axis, node in zip(unconfirmed, nodes, strict=True):
            try:
                if node.node_id not in unheard:
                    self._network.disable(node, ramp_end_ns=ramp_end_ns)
                    continue
                text = f"{node_label(node)} does not answer: its standstill is not confirmed"
            except DriverError as error:
                text = str(error)
                self.problems.append(error)
            self._bus.report(axis, EventKind.STOP_UNCONFIRMED, self._sample.statusword[axis], text)

    def _find_silent(self, nodes: Sequence[Axis]) -> NodeMissing | None:
        """Return the error for the nodes that do not answer; None where all do.

        A failure of one of several buses, or a misplaced node, is raised once, and then the others
        go on. So the nodes are asked again after a failure, and those of the other buses stopped.
        """
        for _ in range(FAILURES_OF_A_STOP):
            try:
                return self._network.find_silent(nodes)
            except DriverError as error:
                text = f"the bus ended the stop: {error}"
                self._bus.report(None, EventKind.STOP_UNCONFIRMED, 0, text)
                self._add_problem(error)
        return self._network.find_silent(nodes)

    def _add_problem(self, error: DriverError) -> None:
        """Add an error to `problems`, unless the same one is there already."""
        if str(error) not in map(str, self.problems):
            self.problems.append(error)

    def _stop_by_pdo(self) -> Generator[Sample, None, tuple[int, ...]]:
        """Stop by synchronous RPDOs; returns the axes whose statusword does not confirm the
        stop.
        """
        standstill = _Standstill(self._bounds, self._sample.position_counts)
        missing_cycles = 0  # in a row, with an axis without an answer
        powered = list(self._axes)
        for cycle in range(self._cycles(self._bounds.stop_s)):
            for axis in powered:
                state = self._state(axis)
                if state is State.QUICK_STOP_ACTIVE and standstill.is_reached(axis):
                    goal = Goal.SWITCH_ON_DISABLED
                else:
                    goal = Goal.QUICK_STOP
                self._send_command(axis, next_command(state, goal), repeat=cycle % 10 == 0)
            self._sample = self._stream.advance()
            yield self._sample
            standstill.add(self._sample)
            missing = self._sample.missing
            if missing:
                missing_cycles += 1
            else:
                missing_cycles = 0
            powered = [
                axis
                for axis in self._axes
                if missing >> axis & 1 or self._state(axis) not in POWERLESS
            ]
            for axis in self._axes:
                if axis not in powered:
                    self._network.powered.discard(self._nodes[axis].node_id)
            if self._bus.silent and self._stream.pacing.waits_for_answers:
                # Such a stream has waited long enough in one cycle.
                tolerated_cycles = 0
            else:
                tolerated_cycles = MAX_MISSING_CYCLES
            if not powered or missing_cycles > tolerated_cycles:
                break
        return tuple(powered)


def _cause(error: BaseException) -> str:
    """Say for the log what ended a motion: an error by its class and text, others in words."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    if isinstance(error, GeneratorExit):
        return "its caller took no more samples"
    return f"{type(error).__name__}: {text_of(error)}".removesuffix(": ")
