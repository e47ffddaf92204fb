"""Slow readings beside the stream: they come without a sample that waits,
and never in the way of a set-point.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import product

import can
import pytest

from drivers.canopen.network import CanopenNetwork
from drivers.errors import NodeMisplaced
from drivers.messages import CellEvent, EventKind, Quantity, SlowReading
from drivers.motion.execute import execute
from drivers.move import Move
from drivers.profiles.profile import ObjectEntry, RatedMotor, Thermometer
from drivers.stream.polling import GIVEN_UP_NS, PERIOD_NS, Polling
from drivers.stream.stream import SyncStream
from drivers.stream.sync import LockstepSync
from tests.drivers import scripted
from tests.drivers.motion.test_motion import BOUNDS
from tests.drivers.scripted import PROFILE, ScriptedBus, permission

RATED = RatedMotor(
    ObjectEntry(0x6075, 0, 32, signed=False), torque=ObjectEntry(0x6076, 0, 32, signed=False)
)
TORQUE = ObjectEntry(0x6077, 0, 16, signed=True)
TEMPERATURE = ObjectEntry(0x2005, 0, 16, signed=True)
WARM = replace(PROFILE, rated=RATED, torque=TORQUE, temperature=Thermometer(TEMPERATURE, 0.1))
CYCLES = 1200  #: More than a second


@dataclass
class Bench:
    """Two prepared drives of 1.5 Nm, at 31.5 and -4 °C and with −200 and 300 thousandths of
    torque.
    """

    network: CanopenNetwork
    bus: ScriptedBus
    stream: SyncStream
    readings: list[SlowReading] = field(default_factory=list)
    begun: int = 0

    def poll(self, *, beside_stream: bool = True) -> Polling:
        """Begin."""
        polling = Polling.found(self.network, beside_stream=beside_stream)
        polling.begin(self.stream, self.readings.append)
        self.begun = len(self.bus.sent)
        return polling

    def requests(self) -> list[tuple[int, int]]:
        """Node of each SDO request since the stream began,
        and the frames sent with it before the next SYNC.
        """
        sent = self.bus.sent
        found = []
        since = 0
        for frame in sent[self.begun :]:
            if frame.arbitration_id == 0x80:
                since = 0
            elif 0x200 <= frame.arbitration_id < 0x680:
                since += 1
                if frame.arbitration_id > 0x600:
                    found.append((frame.arbitration_id - 0x600, since))
        return found


@pytest.fixture
def bench() -> Iterator[Bench]:
    network, bus = scripted.cell(2)
    network.axes = tuple(replace(axis, profile=WARM) for axis in network.axes)
    for node, (torque, temperature) in zip(bus.nodes, ((-200, 315), (300, -40)), strict=True):
        node.objects |= {
            (0x6076, 0): (1500, 4),
            (0x6077, 0): (torque, 2),
            (0x2005, 0): (temperature, 2),
        }
    with network:
        network.prepare()
        pacing = LockstepSync(scripted.PERIOD_NS, 0.005, clock=bus.clock)
        stream = SyncStream(network, pacing)
        yield Bench(network, bus, stream)
        bus.tamper = lambda message: (message,)


def test_readings_are_in_si_and_come_at_their_rates(bench: Bench) -> None:
    bench.poll()
    samples = [next(bench.stream) for _ in range(CYCLES)]
    for sample in samples:
        assert sample.missing == 0
    values = {(r.axis, r.quantity): r.value for r in bench.readings}
    assert values == pytest.approx(
        {
            (0, Quantity.TORQUE): -0.3, (1, Quantity.TORQUE): 0.45,
            (0, Quantity.TEMPERATURE): 31.5, (1, Quantity.TEMPERATURE): -4.0,
        }
    )  # fmt: skip
    lasted_ns = CYCLES * scripted.PERIOD_NS
    for quantity, period_ns in PERIOD_NS.items():
        own = [r.time_ns for r in bench.readings if (r.axis, r.quantity) == (0, quantity)]
        expected = -(-lasted_ns // period_ns)
        assert len(own) == expected
        for time_ns in own:
            assert samples[0].time_ns <= time_ns <= samples[-1].time_ns
    # One request a cycle at most: the drives are read in turn.
    assert {before for _, before in bench.requests()} == {1}


def test_a_lost_answer_delays_nothing_and_its_object_is_read_again(bench: Bench) -> None:
    bench.poll()
    lost: list[int] = []

    def lose_one(message: can.Message) -> Iterable[can.Message]:
        if message.arbitration_id == 0x581 and not lost:
            lost.append(bench.bus.cycle)
            return ()
        return (message,)

    bench.bus.tamper = lose_one
    samples = [next(bench.stream) for _ in range(CYCLES)]
    assert lost
    expected = list(range(CYCLES))
    assert [sample.cycle for sample in samples] == expected
    given_up = GIVEN_UP_NS // scripted.PERIOD_NS
    waited = [r for r in bench.readings if r.time_ns < samples[given_up].time_ns]
    assert waited == []
    assert {(r.axis, r.quantity) for r in bench.readings} == set(product((0, 1), Quantity))


def test_no_request_goes_with_a_set_point_and_none_after_the_stop(bench: Bench) -> None:
    bench.poll()
    target_counts = (50_000, -40_000)
    far = Move(target_counts, (100_000, 80_000), (1_000_000, 800_000), dwell_cycles=200)
    samples = list(execute(bench.network, bench.stream, (far,), permission(), BOUNDS))
    for sample in samples:
        assert sample.missing == 0
    assert bench.readings
    beside = [before for node, before in bench.requests() if node <= 2]
    assert beside
    assert set(beside) == {1}
    count = len(bench.readings)
    for _ in range(CYCLES):
        bench.stream.advance()
    assert len(bench.readings) == count


def test_an_object_that_a_drive_lacks_is_named_and_left_also_in_the_run(bench: Bench) -> None:
    events: list[CellEvent] = []
    bench.stream.bus.emit = events.append
    del bench.bus.nodes[1].objects[0x2005, 0]
    polling = bench.poll()
    assert polling.remarks == ("J2: the drive has no temperature in 2005h:00; it is not logged",)
    axes = [r.axis for r in polling.temperatures(5)]
    assert axes == [0]
    del bench.bus.nodes[0].objects[0x6077, 0]
    for _ in range(CYCLES):
        next(bench.stream)
    expected = {(1, Quantity.TORQUE), (0, Quantity.TEMPERATURE)}
    assert {(r.axis, r.quantity) for r in bench.readings} == expected
    gone = "J1: the torque in 6077h:00 is no longer there; it is not logged"
    captured = [event for event in events if event.kind is EventKind.CAPTURE]
    assert [(event.axis, event.code, event.text) for event in captured] == [(0, 0x6077, gone)]
    assert polling.remarks[-1] == gone


def test_an_answer_of_another_size_is_no_reading(bench: Bench) -> None:
    polling = bench.poll()
    bench.bus.nodes[0].objects[0x6077, 0] = (-2, 1)
    for _ in range(CYCLES):
        next(bench.stream)
    assert (0, Quantity.TORQUE) not in {(r.axis, r.quantity) for r in bench.readings}
    assert polling.remarks == (
        "J1: the torque in 6077h:00 answers with 8 bits, expected 16: correct the drive profile; "
        "it is not logged",
    )


def test_more_bytes_than_the_object_has_are_cut_as_at_the_start_of_a_run(bench: Bench) -> None:
    bench.bus.nodes[0].objects[0x6077, 0] = (-2, 4)
    polling = bench.poll()
    for _ in range(CYCLES):
        next(bench.stream)
    torques = {r.value for r in bench.readings if (r.axis, r.quantity) == (0, Quantity.TORQUE)}
    expected = {-2 * 1e-3 * 1.5}
    assert torques == expected
    assert polling.remarks == ()


def test_an_object_of_another_type_costs_no_recording(bench: Bench) -> None:
    bench.bus.nodes[0].objects[0x2005, 0] = (31, 1)
    (remark,) = bench.poll().remarks
    assert remark.startswith("J1: the drive has no temperature in 2005h:00 that can be read")


@pytest.mark.parametrize("begun", [False, True])
def test_an_object_that_a_drive_refuses_once_is_read_again(bench: Bench, begun: bool) -> None:
    """Abort 0800 0022h: because of the present device state."""
    events: list[CellEvent] = []
    bench.stream.bus.emit = events.append
    refused: list[bytes] = []

    def refuse_one(message: can.Message) -> Iterable[can.Message]:
        if message.arbitration_id != 0x581 or refused or bytes(message.data[1:3]) != b"\x77\x60":
            return (message,)
        packed = struct.pack("<B3sL", 0x80, bytes(message.data[1:4]), 0x0800_0022)
        refused.append(packed)
        return (can.Message(arbitration_id=0x581, is_extended_id=False, data=refused[0]),)

    if begun:
        polling = bench.poll()
        bench.bus.tamper = refuse_one
    else:
        bench.bus.tamper = refuse_one
        polling = bench.poll()
    for _ in range(CYCLES):
        next(bench.stream)
    assert refused
    count = -(-CYCLES * scripted.PERIOD_NS // PERIOD_NS[Quantity.TORQUE]) - begun
    assert len([r for r in bench.readings if (r.axis, r.quantity) == (0, Quantity.TORQUE)]) == count
    assert EventKind.CAPTURE not in [event.kind for event in events]
    if begun:
        assert polling.remarks == ()
    else:
        (remark,) = polling.remarks
        assert remark.startswith(
            "J1: the drive refused its torque in 6077h:00 at first (aborted, Code 0x08000022"
        )


def test_a_bus_without_room_is_read_before_and_after_alone(bench: Bench) -> None:
    polling = bench.poll(beside_stream=False)
    before = len(bench.bus.sent)
    for _ in range(CYCLES):
        next(bench.stream)
    frames = [frame for frame in bench.bus.sent[before:] if frame.arbitration_id > 0x600]
    assert not frames
    expected = [
        (9, 0, 31.5),
        (9, 1, -4.0),
    ]
    assert [(r.time_ns, r.axis, r.value) for r in polling.temperatures(9)] == expected


def test_a_misplaced_node_that_is_heard_behind_a_run_costs_no_sample(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Temperatures are read when all samples are there; what cannot be read is missing."""
    polling = Polling.found(bench.network)

    def fail(timeout: float | None = None) -> can.Message | None:
        raise NodeMisplaced(9, "A", "B")

    with monkeypatch.context() as patched:
        patched.setattr(bench.bus, "recv", fail)
        assert polling.temperatures(0) == ()


def test_an_object_that_is_refused_where_the_bus_has_no_room_is_read_after_the_run_alone(
    bench: Bench,
) -> None:
    for index in (0x2005, 0x6077):
        bench.bus.nodes[0].read_aborts[index, 0] = 0x08000022
    remarks = Polling.found(bench.network, beside_stream=False).remarks
    texts = " ".join(remarks)
    assert "it is asked again after the run" in texts
    assert "it is not asked again" in texts
    assert "again in the run" not in texts


def test_a_torque_without_rated_torque_has_no_unit_and_is_not_read(bench: Bench) -> None:
    for node in bench.bus.nodes:
        node.objects[0x6076, 0] = (0, 4)
    bench.network._scales = ()  # read anew
    bench.poll()
    for _ in range(CYCLES):
        next(bench.stream)
    quantities = {r.quantity for r in bench.readings}
    assert quantities == {Quantity.TEMPERATURE}
