"""Motion: what moves, when, and that every way out ends without power."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext, suppress
from dataclasses import replace

import can
import pytest

from drivers.canopen.network import CanopenNetwork
from drivers.errors import (
    BusError,
    DriveFault,
    DriverError,
    MotionRefused,
    MotionTimeout,
    NodeMisplaced,
    NodeMissing,
    SampleLost,
    StateRefused,
)
from drivers.messages import CellEvent, EventKind, Sample
from drivers.motion.execute import MotionBounds, execute
from drivers.move import AxisLimits, Move, synchronised_move
from drivers.profiles.profile import Axis
from drivers.stream.stream import MAX_MISSING_CYCLES, SyncStream
from drivers.stream.sync import LockstepSync
from tests.drivers.scripted import PERIOD_NS, ScriptedBus, cell, permission

Moving = tuple[CanopenNetwork, SyncStream, ScriptedBus, list[CellEvent]]
BOUNDS = MotionBounds(
    enable_s=0.1,
    acknowledge_s=0.05,
    settle_s=0.05,
    stop_s=0.1,
    standstill_cycles=5,
)
NO_POWER = (0x40, 0x08, 0x28)
"""Bits 0 to 3, 5 and 6 of the statusword in the states without power."""
MARKS = (EventKind.MOVE_START, EventKind.MOVE_END)
FAR = Move((50_000, -40_000), (100_000, 80_000), (1_000_000, 800_000))


@pytest.fixture
def moving() -> Iterator[Moving]:
    network, bus = cell(2)
    events: list[CellEvent] = []
    with network:
        network.prepare()
        bus.cycle = -1
        pacing = LockstepSync(PERIOD_NS, 0.005, clock=bus.clock)
        stream = SyncStream(network, pacing, events.append)
        yield network, stream, bus, events
        bus.tamper = lambda message: (message,)
        bus.broken = False
        for node in bus.nodes:
            node.beats = True


def powerless(bus: ScriptedBus) -> bool:
    states = {node.statusword & 0x6F for node in bus.nodes}
    is_moving = any(node.moving for node in bus.nodes)
    return states <= set(NO_POWER) and not is_moving


def events_of(events: list[CellEvent], kind: EventKind) -> list[CellEvent]:
    return [event for event in events if event.kind is kind]


def powered_cycles(bus: ScriptedBus) -> list[int]:
    return [node.powered_cycles for node in bus.nodes]


def setpoint_counts(bus: ScriptedBus) -> list[int]:
    return [len(node.setpoint_cycles) for node in bus.nodes]


def both_by(counts: int, acceleration: int = 1_000_000) -> Move:
    """A move of both axes to one position."""
    return Move((counts, counts), (100_000, 100_000), (acceleration, acceleration))


def run(moving: Moving, *moves: Move) -> list[Sample]:
    network, stream, _, _ = moving
    return list(execute(network, stream, moves, permission(), BOUNDS))


def test_axes_start_together_arrive_and_end_without_power(moving: Moving) -> None:
    _, stream, bus, events = moving
    limits = permission().limits
    first = synchronised_move((0, 0), (50_000, -40_000), limits, dwell_cycles=7)
    second = synchronised_move((50_000, -40_000), (0, 10_000), limits, dwell_cycles=3)
    samples = run(moving, first, second)
    position_counts = samples[-1].position_counts
    assert position_counts == (0, 10_000)
    cycles = [sample.cycle for sample in samples]
    assert cycles == list(range(len(samples)))
    expected = bus.nodes[1].setpoint_cycles
    assert bus.nodes[0].setpoint_cycles == expected
    assert len(bus.nodes[0].setpoint_cycles) == 2
    marks = [event for event in events if event.kind in MARKS]
    kinds = [mark.kind for mark in marks]
    assert kinds == [*MARKS, *MARKS]
    codes = [mark.code for mark in marks]
    assert codes == [0, 0, 1, 1]
    start_marks = events_of(marks, EventKind.MOVE_START)
    starts = [mark.time_ns // PERIOD_NS for mark in start_marks]
    assert starts == bus.nodes[0].setpoint_cycles
    assert powerless(bus)
    assert stream.statistics.missing == 0


def test_the_time_limit_of_a_stop_ends_with_a_stop_that_is_confirmed(moving: Moving) -> None:
    """Slow readings and another motion may follow in the same network;
    a closing network keeps its limit.
    """
    network, _, _, _ = moving
    run(moving, FAR)
    assert network.link.allowed_s(3600.0) == 3600.0
    network.begin_closing()
    assert network.link.allowed_s(3600.0) < 3600.0
    network.end_closing()
    assert network.link.allowed_s(3600.0) == 3600.0


def test_the_time_limit_of_a_stop_after_an_error_ends_with_it_as_well(moving: Moving) -> None:
    """Settings are restored with a limit of their own, after a log on a slow disk is closed."""
    network, _, bus, _ = moving
    bus.nodes[1].ignores_setpoint = True
    with pytest.raises(MotionTimeout):
        run(moving, FAR)
    assert powerless(bus)
    assert network.link.allowed_s(3600.0) == 3600.0


def test_an_axis_that_creeps_before_it_has_power_stays_where_the_moves_leave_it(
    moving: Moving,
) -> None:
    """It was checked without a profile for those counts, and would take a second for each."""
    _, _, bus, _ = moving

    def creep(cycle: int) -> None:
        if cycle == 1:
            bus.nodes[1].position = 7.0

    bus.on_cycle = creep
    of_first_axis = Move((5_000, 0), (100_000, 1), (1_000_000, 1))
    back = Move((0, 0), (100_000, 1), (1_000_000, 1))
    of_both = Move((5_000, -5_000), (100_000, 100_000), (1_000_000, 1_000_000))
    samples = run(moving, of_first_axis, back, of_both)
    assert [sample.position_counts[1] for sample in samples][5:100] == [7] * 95
    assert samples[-1].position_counts == (5_000, -5_000)
    assert setpoint_counts(bus) == [3, 1]
    assert len(samples) * PERIOD_NS < 2_000_000_000


def test_the_profile_objects_are_those_of_the_move(moving: Moving) -> None:
    _, _, bus, _ = moving
    run(moving, FAR)
    written = []
    for node in bus.nodes:
        velocity = node.value(0x6081, 0)
        acceleration = node.value(0x6083, 0)
        deceleration = node.value(0x6084, 0)
        written.append((velocity, acceleration, deceleration))
    expected = [(100_000, 1_000_000, 1_000_000), (80_000, 800_000, 800_000)]
    assert written == expected


def test_an_axis_with_no_way_to_go_gets_no_setpoint(moving: Moving) -> None:
    _, _, bus, _ = moving
    of_first_axis = Move((5_000, 0), (100_000, 1), (1_000_000, 1))
    of_none = Move((5_000, 0), (1, 1), (1, 1), 4)
    samples = run(moving, of_first_axis, of_none)
    position_counts = samples[-1].position_counts
    assert position_counts == (5_000, 0)
    assert bus.nodes[1].setpoint_cycles == []


def test_a_drive_that_needs_its_controlword_twice_still_moves(moving: Moving) -> None:
    _, _, bus, _ = moving
    bus.nodes[0].second_controlword = bus.nodes[1].second_controlword = True
    position_counts = run(moving, FAR)[-1].position_counts
    assert position_counts == (50_000, -40_000)


def test_nothing_is_sent_to_an_axis_whose_position_is_unknown(moving: Moving) -> None:
    _, _, bus, _ = moving
    for node in bus.nodes:
        node.position = 30_000.0

    def drop_two(message: can.Message) -> tuple[can.Message, ...]:
        is_dropped = message.arbitration_id == 0x182 and bus.cycle < 2
        return () if is_dropped else (message,)

    bus.tamper = drop_two
    run(moving, Move((30_000, 20_000), (100_000, 100_000), (1_000_000, 1_000_000)))
    targets = []
    for frame in bus.sent:
        if frame.arbitration_id == 0x202:
            target = int.from_bytes(frame.data[:4], "little", signed=True)
            targets.append(target)
    assert min(targets) == 20_000


def test_without_permission_nothing_is_even_enabled(moving: Moving) -> None:
    network, stream, bus, _ = moving
    narrow = permission(span=40_000)
    of_three_axes = permission(axes=3)
    with pytest.raises(MotionRefused, match="motion is disabled; pass a MotionPermission"):
        list(execute(network, stream, (FAR,), None, BOUNDS))
    with pytest.raises(
        MotionRefused, match="J1: move 0 goes to 50000 counts, allowed is -40000 to 40000"
    ):
        list(execute(network, stream, (FAR,), narrow, BOUNDS))
    with pytest.raises(MotionRefused, match="limits for 3 axes"):
        list(execute(network, stream, (FAR,), of_three_axes, BOUNDS))
    assert powered_cycles(bus) == [0, 0]


def test_a_drive_in_fault_is_not_enabled(moving: Moving) -> None:
    _, _, bus, _ = moving
    bus.nodes[1].fault()
    with pytest.raises(StateRefused, match=r"J2 \(node 2\): asked for OPERATION ENABLED.*FAULT"):
        run(moving, FAR)
    assert powered_cycles(bus) == [0, 0]


def break_at(bus: ScriptedBus, cycle: int, what: str) -> None:
    """Let something go wrong in the middle of the move."""

    def act(now: int) -> None:
        if now != cycle:
            return
        if what == "fault":
            bus.nodes[1].fault()
        elif what == "following error":
            bus.nodes[1].fault(following_error=True)
        elif what == "emcy":
            bus.inject(bus.nodes[1].emcy(0x8611))
        elif what == "power lost":
            bus.nodes[1].control(0, now)
        elif what == "silent":
            bus.tamper = lambda message: () if message.arbitration_id == 0x182 else (message,)
        elif what == "heartbeat":
            bus.nodes[1].beats = False

    def tick(now: int) -> None:
        bus.clock.now_ns += PERIOD_NS
        act(now)

    bus.on_cycle = tick


@pytest.mark.parametrize("quick_stop_stays", [False, True], ids=["605Ah=2", "605Ah=6"])
@pytest.mark.parametrize(
    ("what", "error"),
    [
        ("fault", DriveFault),
        ("following error", DriveFault),
        ("emcy", DriveFault),
        ("power lost", DriveFault),
        ("silent", SampleLost),
        ("heartbeat", DriveFault),
    ],
)
def test_every_failure_stops_all_axes(
    moving: Moving, what: str, error: type[Exception], quick_stop_stays: bool
) -> None:
    _, _, bus, events = moving
    bus.nodes[0].quick_stop_stays = bus.nodes[1].quick_stop_stays = quick_stop_stays
    break_at(bus, 60, what)
    with pytest.raises(error):
        run(moving, FAR)
    assert powerless(bus)
    assert 0 < bus.nodes[0].position < 50_000
    assert EventKind.STOP in [event.kind for event in events]
    assert EventKind.STOP_UNCONFIRMED not in [event.kind for event in events]


@pytest.mark.parametrize("interrupt", [GeneratorExit, KeyboardInterrupt, ZeroDivisionError])
def test_leaving_the_loop_stops_all_axes(moving: Moving, interrupt: type[BaseException]) -> None:
    network, stream, bus, events = moving
    execution = execute(network, stream, (FAR,), permission(), BOUNDS)
    with pytest.raises(interrupt), closing(execution) as samples:
        for sample in samples:
            if sample.cycle == 60:
                raise interrupt
    assert powerless(bus)
    (ended,) = events_of(events, EventKind.ENDED)
    assert ended.text == "its caller took no more samples"
    assert 0 < bus.nodes[0].position < 50_000


def test_an_interrupt_inside_of_a_cycle_stops_all_axes(moving: Moving) -> None:
    _, _, bus, events = moving

    def interrupt(cycle: int) -> None:
        if cycle == 60:
            raise KeyboardInterrupt

    bus.on_cycle = interrupt
    with pytest.raises(KeyboardInterrupt):
        run(moving, FAR)
    assert powerless(bus)
    (ended,) = events_of(events, EventKind.ENDED)
    assert ended.text == "interrupted"


def test_a_fault_during_the_last_stop_is_not_forgotten(moving: Moving) -> None:
    _, _, bus, events = moving

    def fault_at_stop(cycle: int) -> None:
        node = bus.nodes[1]
        has_stopped = events_of(events, EventKind.STOP) != []
        has_no_power = node.statusword & 0x6F == 0x40
        if has_stopped and has_no_power:
            node.fault()

    bus.on_cycle = fault_at_stop
    with pytest.raises(DriveFault, match="node 2"):
        run(moving, FAR)
    assert powerless(bus)


def test_a_setpoint_that_is_never_acknowledged_ends_in_a_timeout(moving: Moving) -> None:
    _, _, bus, _ = moving
    bus.nodes[1].ignores_setpoint = True
    with pytest.raises(MotionTimeout, match=r"move 0: J2 \(node 2\) did not set statusword bit 12"):
        run(moving, FAR)
    assert powerless(bus)


def test_a_drive_that_holds_its_acknowledge_until_it_has_arrived_makes_every_move(
    moving: Moving,
) -> None:
    """A drive without a buffer of set-points:
    bit 12 came too late for the time limit of the acknowledgement.
    """
    _, _, bus, _ = moving
    for node in bus.nodes:
        node.holds_acknowledge = True
    back = Move((0, 0), (100_000, 80_000), (1_000_000, 800_000))
    samples = run(moving, FAR, back, FAR)
    position_counts = samples[-1].position_counts
    assert position_counts == (50_000, -40_000)
    assert setpoint_counts(bus) == [3, 3]


def test_an_acknowledge_that_stays_for_ever_is_named_and_the_axes_lose_power(
    moving: Moving,
) -> None:
    _, _, bus, _ = moving
    bus.nodes[1].keeps_acknowledge = True
    with pytest.raises(
        MotionTimeout,
        match=r"move 0: J2 \(node 2\) did not clear statusword bit 12.*earlier "
        r"set-point",
    ):
        run(moving, FAR)
    assert powerless(bus)


def test_an_acknowledge_of_before_the_first_setpoint_starts_no_move(moving: Moving) -> None:
    """By that bit the first set-point would be taken as accepted,
    and the time of the move waited for.
    """
    _, _, bus, _ = moving
    bus.nodes[1].keeps_acknowledge = True
    bus.nodes[1].statusword |= 0x1000
    with pytest.raises(
        MotionTimeout,
        match=r"move 0: J2 \(node 2\) did not clear "
        r"statusword bit 12",
    ):
        run(moving, FAR)
    assert [node.setpoint_cycles for node in bus.nodes] == [[], []]
    assert powerless(bus)


def test_a_drive_whose_rpdos_act_before_sync_makes_the_same_moves(moving: Moving) -> None:
    """Target and controlword are in one frame, the target first, and velocities come before:
    no order is assumed.
    """
    _, _, bus, _ = moving
    for node in bus.nodes:
        node.acts_at_once = True
    back = Move((0, 0), (100_000, 80_000), (1_000_000, 800_000))
    samples = run(moving, FAR, back)
    position_counts = samples[-1].position_counts
    assert position_counts == (0, 0)
    assert setpoint_counts(bus) == [2, 2]
    for sample in samples:
        assert not sample.missing
    assert powerless(bus)


def test_a_target_reached_bit_of_the_move_before_is_not_believed(moving: Moving) -> None:
    _, _, bus, _ = moving
    break_at(bus, 60, "nothing")

    def stuck(cycle: int) -> None:
        bus.nodes[1].moving = False
        bus.nodes[1].statusword |= 0x0400
        # A live current: what stands still is the axis, not its data
        bus.nodes[1].store(0x6074, 0, cycle & 1)

    bus.on_cycle = stuck
    with pytest.raises(MotionTimeout, match="J2"):
        run(moving, FAR)
    assert powerless(bus)


@pytest.mark.parametrize("way", [40, 1000, 2500])
def test_a_short_move_does_not_end_by_a_bit_of_the_move_before(moving: Moving, way: int) -> None:
    _, _, bus, events = moving
    limits = (AxisLimits(0, 0, 20_000, 200_000),) * 2
    out = synchronised_move((0, 0), (way, way), limits)
    duration_s = max(out.duration_s((0, 0)))

    def hold_bit(_: int) -> None:
        for node in bus.nodes:
            node.statusword |= 0x0400

    bus.on_cycle = hold_bit
    stay = Move((way, way), (1, 1), (1, 1))
    samples = run(moving, out, stay)
    start = events_of(events, EventKind.MOVE_START)[0]
    end = events_of(events, EventKind.MOVE_END)[0]
    assert start.code == 0
    assert end.code == 0
    took_s = (end.time_ns - start.time_ns) * 1e-9
    assert took_s == pytest.approx(duration_s, abs=2e-3)
    position_counts = samples[-1].position_counts
    assert position_counts == (way, way)
    at_end, *_ = [sample for sample in samples if sample.time_ns >= end.time_ns]
    assert at_end.position_counts == (way, way)


def test_a_setpoint_that_still_waits_is_dropped_by_the_stop(
    moving: Moving, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, _, bus, _ = moving
    receive = bus.recv
    last_profile = 0x302

    def interrupt(timeout: float | None = None) -> can.Message | None:
        # The set-points are queued right after the SYNC that follows the last profile.
        sent_before_sync = [frame.arbitration_id for frame in bus.sent[-4:-1]]
        if not timeout and last_profile in sent_before_sync:
            monkeypatch.setattr(bus, "recv", receive)
            raise KeyboardInterrupt
        return receive(timeout)

    monkeypatch.setattr(bus, "recv", interrupt)
    with pytest.raises(KeyboardInterrupt):
        run(moving, FAR)
    identifiers = [frame.arbitration_id for frame in bus.sent]
    assert last_profile in identifiers
    for frame in bus.sent:
        if frame.arbitration_id in (0x201, 0x202):
            controlword = frame.data[4]
            assert not controlword & 0x10
    assert setpoint_counts(bus) == [0, 0]
    assert powerless(bus)


def stop_with(moving: Moving, drift_counts: tuple[float, ...]) -> list[int]:
    """Cycles from the stop to its end of drives that stay in QUICK STOP ACTIVE while their encoders
    show this.
    """
    _, _, bus, events = moving
    stopping: list[int] = []

    def drift(cycle: int) -> None:
        if events_of(events, EventKind.STOP):
            stopping.append(cycle)
            number = len(stopping) % len(drift_counts)
            for node in bus.nodes:
                node.position += drift_counts[number]

    for node in bus.nodes:
        node.quick_stop_stays = True
    bus.on_cycle = drift
    run(moving, both_by(5_000))
    return stopping


def test_an_encoder_that_flickers_stands_still(moving: Moving) -> None:
    drift_counts = (3.0, -5.0, 2.0, 0.0)
    stopping = stop_with(moving, drift_counts)
    assert len(stopping) < 20
    assert powerless(moving[2])


@pytest.mark.slow
def test_an_axis_that_creeps_does_not_stand_still(moving: Moving) -> None:
    bound_cycles = round(BOUNDS.stop_s * 1e9 / PERIOD_NS)
    assert len(stop_with(moving, (7.0,))) >= bound_cycles


@pytest.mark.slow
def test_every_axis_that_could_not_be_stopped_is_reported(
    moving: Moving, monkeypatch: pytest.MonkeyPatch
) -> None:
    network, _, bus, _ = moving
    for node in bus.nodes:
        node.quick_stop_stays = True

    def refuse(axis: Axis, ramp_end_ns: int) -> None:
        raise StateRefused(axis.node_id, "SWITCH ON DISABLED", "QUICK STOP ACTIVE", 0x07)

    def coast(_cycle: int) -> None:
        for node in bus.nodes:
            node.position += 50

    bus.on_cycle = coast
    near = Move((5_000, 5_000), (100_000, 100_000), (10_000_000, 10_000_000))
    with monkeypatch.context() as patched:
        patched.setattr(network, "disable", refuse)
        with pytest.raises(StateRefused, match="node 1") as error:
            run(moving, near)
    (note,) = error.value.__notes__
    assert "node 2" in note
    bus.on_cycle = lambda _cycle: None


@pytest.mark.parametrize(("confirmed", "periods"), [(True, MAX_MISSING_CYCLES + 2), (False, 1)])
def test_late_answers_are_waited_for_once_no_axis_has_power(
    moving: Moving, monkeypatch: pytest.MonkeyPatch, confirmed: bool, periods: int
) -> None:
    network, stream, bus, _ = moving
    waits = list[tuple[int, bool]]()

    def read_on(seconds: float, lag_s: float) -> None:
        wait_ns = round(seconds * 1e9)
        has_lag = lag_s > 0
        waits.append((wait_ns // PERIOD_NS, has_lag))

    monkeypatch.setattr(stream, "read_on", read_on)
    bus.nodes[0].quick_stop_stays = not confirmed
    near = both_by(500, acceleration=10_000_000)
    bounds = replace(BOUNDS, standstill_cycles=10_000)
    with suppress(StateRefused):
        list(execute(network, stream, (near,), permission(), bounds))
    assert waits == [(periods, confirmed)]


def test_a_stop_that_cannot_be_said_is_noted_on_the_error(moving: Moving) -> None:
    network, stream, bus, events = moving

    def cut(cycle: int) -> None:
        bus.broken = cycle >= 60

    bus.on_cycle = cut
    with pytest.raises(Exception, match="wire was cut") as error:
        list(execute(network, stream, (FAR,), permission(), BOUNDS))
    assert any("while stopping" in note for note in error.value.__notes__)
    assert events[-1].kind is EventKind.STOP_UNCONFIRMED
    bus.on_cycle = lambda cycle: None


class FullSink:
    """A receiver of events that takes none of a stop from a moment on, as a log on a full disk."""

    def __init__(self) -> None:
        self.full = False
        self._stops = False

    def __call__(self, event: CellEvent) -> None:
        if event.kind in (EventKind.ENDED, EventKind.STOP):
            self._stops = True
        if self.full and self._stops:
            raise ValueError("the log takes no event")


def test_events_that_cannot_be_logged_delay_no_stop_and_do_not_hide_its_cause(
    moving: Moving,
) -> None:
    network, stream, bus, _ = moving
    stream.bus.emit = sink = FullSink()

    def act(cycle: int) -> None:
        if cycle == 60:
            bus.nodes[1].fault()
            sink.full = True

    bus.on_cycle = act
    with pytest.raises(DriveFault) as error:
        list(execute(network, stream, (FAR,), permission(), BOUNDS))
    assert powerless(bus)
    assert not network.powered
    assert error.value.__notes__ == [
        "while stopping: its events are not all reported: ValueError('the log takes no event')"
    ]


def test_events_of_the_last_stop_that_cannot_be_logged_are_an_error_after_it(
    moving: Moving,
) -> None:
    network, stream, bus, _ = moving
    stream.bus.emit = sink = FullSink()
    near = Move((2_000, 2_000), (100_000, 80_000), (1_000_000, 800_000))
    samples = execute(network, stream, (near,), permission(), BOUNDS)
    with pytest.raises(ValueError, match="the log takes no event"):
        for sample in samples:
            sink.full = sample.position_counts == near.target_counts
    assert powerless(bus)


def test_why_the_moves_end_is_in_the_log(moving: Moving) -> None:
    _, _, bus, events = moving
    bus.nodes[1].ignores_setpoint = True
    with pytest.raises(MotionTimeout):
        run(moving, FAR)
    kinds = [event.kind for event in events]
    (ended,) = events_of(events, EventKind.ENDED)
    assert ended.text.startswith("MotionTimeout: move 0: J2 (node 2) did not")
    limit = kinds.index(EventKind.STOP)
    assert kinds.index(EventKind.ENDED) < limit


def test_moves_that_were_made_end_for_no_reason(moving: Moving) -> None:
    _, _, _, events = moving
    run(moving, FAR)
    assert events_of(events, EventKind.ENDED) == []


def test_a_stop_that_a_fault_began_is_undisturbed(moving: Moving) -> None:
    """Interrupts are deferred from its first frame to its last."""
    network, _, bus, events = moving
    inside: list[bool] = []

    @contextmanager
    def block_signals() -> Iterator[None]:
        assert EventKind.STOP not in [event.kind for event in events]
        inside.append(True)
        yield
        assert powerless(bus)
        inside.clear()

    def act(cycle: int) -> None:
        if cycle == 60:
            bus.nodes[1].fault()
        if EventKind.STOP in [event.kind for event in events]:
            assert inside

    network.block_signals = block_signals
    bus.on_cycle = act
    with pytest.raises(DriveFault):
        run(moving, FAR)
    bus.on_cycle = lambda _cycle: None
    network.block_signals = nullcontext


def test_a_stop_that_is_cut_short_says_so(moving: Moving) -> None:
    _, _, bus, events = moving

    def act(cycle: int) -> None:
        if cycle == 60:
            bus.nodes[1].fault()
        if EventKind.STOP in [event.kind for event in events]:
            bus.on_cycle = lambda _cycle: None
            raise KeyboardInterrupt

    bus.on_cycle = act
    with pytest.raises(KeyboardInterrupt) as cut:
        run(moving, FAR)
    assert cut.value.__notes__ == ["while stopping: the stop was cut short"]
    assert isinstance(cut.value.__context__, DriveFault)


def test_amplifiers_that_were_not_seen_to_stop_go_on_watching_us(
    moving: Moving, monkeypatch: pytest.MonkeyPatch
) -> None:
    network, _, bus, events = moving

    def refuse(axis: Axis, ramp_end_ns: int) -> None:
        raise StateRefused(axis.node_id, "SWITCH ON DISABLED", "OPERATION ENABLED", 0x27)

    def deaf(cycle: int) -> None:
        if cycle == 60:
            bus.nodes[1].fault()
        if EventKind.STOP in [event.kind for event in events]:
            statusword = bus.nodes[0].statusword
            bus.nodes[0].statusword = statusword & ~0x6F | 0x27

    bus.on_cycle = deaf
    ended: list[str] = []
    with monkeypatch.context() as patched:
        patched.setattr(network, "disable", refuse)
        patched.setattr(network.link, "stop_heartbeat", lambda: ended.append("heartbeat"))
        with pytest.raises(DriveFault):
            run(moving, FAR)
    assert not ended
    bus.on_cycle = lambda _cycle: None


@pytest.mark.slow
def test_what_is_stopped_by_sdo_is_reported_before_one_is_waited_for(
    moving: Moving, monkeypatch: pytest.MonkeyPatch
) -> None:
    network, _, bus, events = moving
    disable = network.disable
    reported = []

    def note(axis: Axis, ramp_end_ns: int) -> None:
        reported.append([node.statusword & 0x6F for node in bus.nodes])
        disable(axis, ramp_end_ns=ramp_end_ns)

    def deaf(_cycle: int) -> None:
        if EventKind.STOP in [event.kind for event in events] and not reported:
            for node in bus.nodes:
                node.statusword = node.statusword & ~0x6F | 0x27

    for node in bus.nodes:
        node.quick_stop_stays = True
    bus.on_cycle = deaf
    monkeypatch.setattr(network, "disable", note)
    run(moving, Move((5_000, 5_000), (100_000, 100_000), (1_000_000, 1_000_000)))
    assert reported[0] == [0x07, 0x07]
    assert powerless(bus)


@pytest.mark.slow
@pytest.mark.parametrize(
    "error", [BusError("bus B", "bus-off"), NodeMisplaced(9, "A", "B")], ids=["bus", "misplaced"]
)
def test_a_bus_that_ends_the_stop_by_pdo_does_not_keep_the_others_from_being_stopped(
    moving: Moving, error: DriverError
) -> None:
    """A failure of one of several buses is reported once."""
    _, _, bus, events = moving

    def fail(_cycle: int) -> None:
        if EventKind.STOP in [event.kind for event in events]:
            bus.on_cycle = lambda _cycle: None
            raise error

    for node in bus.nodes:
        node.quick_stop_stays = True
    bus.on_cycle = fail
    with pytest.raises(type(error)):
        run(moving, Move((5_000, 5_000), (100_000, 100_000), (1_000_000, 1_000_000)))
    assert powerless(bus)
    assert EventKind.BUS_LOST in [event.kind for event in events]
    assert EventKind.STOP_UNCONFIRMED in [event.kind for event in events]


def test_a_second_failure_during_a_stop_does_not_keep_the_axes_from_being_stopped(
    moving: Moving, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each failure is raised once; the stop then goes on by SDO on the buses that are left."""
    network, _, bus, events = moving
    find_silent = network.find_silent
    misplaced = NodeMisplaced(9, "A", "B")
    bus_off = BusError("bus B", "bus-off")

    def fail_by_pdo(_cycle: int) -> None:
        if EventKind.STOP in [event.kind for event in events]:
            bus.on_cycle = lambda _cycle: None
            raise misplaced

    def fail_once(_axes: Sequence[Axis]) -> NodeMissing | None:
        monkeypatch.setattr(network, "find_silent", find_silent)
        raise bus_off

    bus.on_cycle = fail_by_pdo
    monkeypatch.setattr(network, "find_silent", fail_once)
    with pytest.raises(NodeMisplaced) as stopped:
        run(moving, both_by(5_000))
    assert powerless(bus)
    assert str(bus_off) in " ".join(stopped.value.__notes__)


def test_an_axis_that_answers_nothing_gets_a_quick_stop_by_sdo_all_the_same(
    moving: Moving,
) -> None:
    network, _, bus, events = moving
    dumb = bus.nodes[1]

    def without_answers(message: can.Message) -> tuple[can.Message, ...]:
        if message.arbitration_id in (0x182, 0x282, 0x582, 0x702):
            return ()
        return (message,)

    def deaf(cycle: int) -> None:
        if cycle == 60:
            bus.tamper = without_answers
        if EventKind.STOP in [event.kind for event in events]:
            dumb.nmt = 127  # it has booted: no PDO acts any more
            dumb.statusword = dumb.statusword & ~0x6F | 0x27

    bus.on_cycle = deaf
    with pytest.raises(DriverError):
        run(moving, FAR)
    assert dumb.statusword & 0x6F == 0x07
    network.link.silent.clear()  # the end of the test asks it again
    bus.on_cycle = lambda _cycle: None


def test_axes_of_a_good_bus_are_stopped_behind_three_failures(
    moving: Moving, monkeypatch: pytest.MonkeyPatch
) -> None:
    network, _, bus, events = moving
    find_silent = network.find_silent
    failures = [
        BusError("bus B", "bus-off"),
        BusError("bus C", "no answer"),
        NodeMisplaced(9, "A", "B"),
    ]

    def fail_by_pdo(_cycle: int) -> None:
        if EventKind.STOP in [event.kind for event in events]:
            bus.on_cycle = lambda _cycle: None
            raise failures.pop()

    def fail_twice(axes: Sequence[Axis]) -> NodeMissing | None:
        if failures:
            raise failures.pop()
        assert bus.nodes[0].statusword & 0x6F not in NO_POWER
        return find_silent(axes)

    bus.on_cycle = fail_by_pdo
    with monkeypatch.context() as patched:
        patched.setattr(network, "find_silent", fail_twice)
        with pytest.raises(NodeMisplaced):
            run(moving, FAR)
    assert powerless(bus)
