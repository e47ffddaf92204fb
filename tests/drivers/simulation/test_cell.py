"""Whole simulated cell: it follows moves, stops on faults,
and gives equal answers to equal frames.
"""

from __future__ import annotations

import struct
from dataclasses import replace

import can
import numpy as np
import pytest

from drivers.simulation.amplifier import AmplifierSet
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.plant import Plant
from drivers.simulation.spec import CellSpec, FrictionUnsolved, UndeclaredEffect
from tests.drivers.simulation.cells import STOPPED_CLOCK, FloatArray, Master, clean_cell, running

SIX = range(1, 7)
LIMIT_SPEED = np.deg2rad([200, 200, 260, 340, 300, 420])  # of configs/cells/demo.yaml
LIMIT_ACCELERATION = np.deg2rad([800, 800, 1100, 2000, 1800, 3000])
REACHED = 1 << 10
LIMITED = 1 << 11
ACKNOWLEDGED = 1 << 12
FOLLOWING_ERROR = 1 << 13


def counts(spec: CellSpec, joint: FloatArray) -> list[int]:
    """Motor counts of a joint position or rate."""
    per_rad = np.array([axis.counts_per_revolution for axis in spec.axes]) / (2 * np.pi)
    return [int(value) for value in np.rint(spec.ratio @ joint * per_rad)]


def begin_move(
    master: Master, spec: CellSpec, target: FloatArray, duration_s: float, ramp_s: float
) -> None:
    """A synchronised trapezoid; it starts with the next SYNC."""
    travel_rad = target - spec.start_rad
    speed = travel_rad / (duration_s - ramp_s)
    rows = zip(counts(spec, target), counts(spec, speed), counts(spec, speed / ramp_s), strict=True)
    for node_id, (place, velocity, acceleration) in enumerate(rows, start=1):
        settings = [(0x607A, "i", place), (0x6081, "I", abs(velocity))]
        settings += [(index, "I", abs(acceleration)) for index in (0x6083, 0x6084)]
        for index, kind, value in settings:
            assert master.write(node_id, index, 0, kind, value) == 0
    master.control(SIX, 0x1F)


@pytest.mark.slow
@pytest.mark.parametrize("payload", [None, "disc"])
@pytest.mark.parametrize(
    "effects", [(), (UndeclaredEffect("load-friction", 2, {"coefficient": 0.12}),)]
)
def test_a_fast_move_is_followed_and_reached(
    payload: str | None, effects: tuple[UndeclaredEffect, ...], request: pytest.FixtureRequest
) -> None:
    spec = clean_cell(payload, effects)
    target = spec.start_rad + np.deg2rad([90.0, 60.0, -90.0, 90.0, 90.0, -45.0])
    distance = np.abs(target - spec.start_rad)
    ramp_s = float(np.max(LIMIT_SPEED / LIMIT_ACCELERATION))
    duration_s = float(np.max(distance / LIMIT_SPEED)) + ramp_s
    with running(spec, request.node.name) as (_, master):
        master.set_up(SIX)
        master.enable(SIX)
        begin_move(master, spec, target, duration_s, ramp_s)
        words = []
        errors = []
        for cycle in range(int(1000 * duration_s) + 60):
            answer = master.sync()
            words.append([word for _, _, word in answer])
            if cycle % 20 == 0:
                errors.append([master.read(node_id, 0x60F4, 0, "i") for node_id in SIX])
        ends = np.array(counts(spec, target))
        positions = [position for position, _, _ in answer]
        found = np.array(positions)
    moving = np.array(words)[: int(1000 * duration_s) - 1]
    assert (moving & ACKNOWLEDGED).all()
    assert not (moving & REACHED).any()
    assert (np.array(words)[-1] & REACHED).all()
    assert not (np.array(words) & (LIMITED | FOLLOWING_ERROR | 0x08)).any()
    absolute_ratio = np.abs(spec.ratio)
    largest_absolute_ratio = np.max(absolute_ratio, axis=1)
    reduction = np.abs(largest_absolute_ratio)
    assert (np.abs(errors).max(axis=0) < np.deg2rad(1.0) * reduction * 65536 / (2 * np.pi)).all()
    difference = np.abs(found - ends)
    assert (difference <= 655).all()


def test_equal_frames_give_equal_bytes_and_another_seed_gives_others(
    request: pytest.FixtureRequest,
) -> None:
    def story(spec: CellSpec) -> list[tuple[int, bytes]]:
        with running(spec, request.node.name) as (_, master):
            master.set_up(SIX)
            master.enable(SIX)
            target = spec.start_rad + 0.3
            begin_move(master, spec, target, 0.25, 0.1)
            for _ in range(120):
                master.sync()
            return master.answers

    spec = clean_cell("disc")
    first = story(spec)
    assert len(first) == 6 * 123
    assert story(spec) == first
    changed_spec = replace(spec, seed=2)
    assert story(changed_spec) != first


def test_brakes_hold_until_operation_is_enabled(request: pytest.FixtureRequest) -> None:
    spec = clean_cell("disc")
    with running(spec, request.node.name) as (_, master):
        master.set_up(SIX)
        start = [position for position, _, _ in master.sync()]
        assert start == counts(spec, spec.start_rad)
        for controlword in (0x06, 0x07):
            master.control(SIX, controlword)
            for _ in range(50):
                positions = [position for position, _, _ in master.sync()]
                assert positions == start


def test_one_sync_is_one_sample_period(request: pytest.FixtureRequest) -> None:
    with running(clean_cell(), request.node.name) as (cell, master):
        master.set_up(SIX)
        for _ in range(25):
            master.sync()
        assert cell.cycles == 25
        assert cell.plant.time_s == pytest.approx(0.025)
        assert cell.time_us == 25_000


def test_a_following_error_is_a_fault_with_its_emergency_and_can_be_reset(
    request: pytest.FixtureRequest,
) -> None:
    spec = clean_cell()
    with running(spec, request.node.name) as (_, master):
        master.set_up(SIX)
        master.enable(SIX)
        assert master.write(2, 0x6065, 0, "I", 3) == 0
        assert master.write(2, 0x6066, 0, "H", 2) == 0
        target = spec.start_rad + 0.5
        begin_move(master, spec, target, 0.3, 0.1)
        for _ in range(100):
            answer = master.sync()
        packed = struct.pack("<HB5x", 0x8611, 1)
        assert (0x082, packed) in master.others
        assert answer[1][2] & 0x4F == 0x08
        assert answer[1][2] & FOLLOWING_ERROR
        assert master.read(2, 0x603F, 0, "H") == 0x8611
        found = master.read(2, 0x1003, 1, "I") & 0xFFFF
        assert found == 0x8611
        held = answer[1][0]
        for _ in range(50):
            answer = master.sync()
        answer_difference = answer[1][0] - held
        assert abs(answer_difference) <= 2  # its brake holds it while the other axes move on
        master.send(0x202, struct.pack("<H", 0x80))
        assert master.sync()[1][2] & 0x6F == 0x40
        assert master.read(2, 0x1001, 0, "B") == 0
        assert (0x082, bytes(8)) in master.others


def test_saturation_is_reported_in_bit_11_and_the_reference_stays_at_the_limit(
    request: pytest.FixtureRequest,
) -> None:
    spec = clean_cell()
    with running(spec, request.node.name) as (_, master):
        master.set_up(SIX)
        assert master.write(1, 0x6073, 0, "H", 200) == 0  # 0.4 A cannot follow such a move
        master.enable(SIX)
        target = spec.start_rad + 0.5
        begin_move(master, spec, target, 0.3, 0.1)
        words = [master.sync()[0][2] for _ in range(60)]
        actual = master.read(1, 0x6077, 0, "h")
    assert any(word & LIMITED for word in words)
    assert abs(actual) == 200


@pytest.mark.parametrize(("option", "ends_in"), [(2, 0x40), (6, 0x07)])
def test_quick_stop_stops_and_ends_as_its_option_says(
    option: int, ends_in: int, request: pytest.FixtureRequest
) -> None:
    spec = clean_cell()
    with running(spec, request.node.name) as (cell, master):
        master.set_up(SIX)
        for node_id in SIX:
            assert master.write(node_id, 0x605A, 0, "h", option) == 0
        master.enable(SIX)
        target = spec.start_rad + 0.8
        begin_move(master, spec, target, 0.5, 0.1)
        for _ in range(200):
            master.sync()
        absolute_velocity_rad_s = np.abs(cell.plant.velocity_rad_s)
        assert absolute_velocity_rad_s.min() > 0.5
        master.control(SIX, 0x02)
        assert all(word & 0x6F == 0x07 for _, _, word in master.sync())
        for _ in range(300):
            answer = master.sync()
        assert all(word & 0x6F == ends_in for _, _, word in answer)
        largest_error = np.abs(cell.plant.velocity_rad_s).max()
        assert largest_error < 1e-3


def test_a_waiting_set_point_follows_the_first(request: pytest.FixtureRequest) -> None:
    spec = clean_cell()
    with running(spec, request.node.name) as (_, master):
        master.set_up(SIX)
        master.enable(SIX)
        target = spec.start_rad + 0.1
        begin_move(master, spec, target, 0.2, 0.1)
        master.sync()
        master.control(SIX, 0x0F)
        assert not any(word & ACKNOWLEDGED for _, _, word in master.sync())
        joint = spec.start_rad - 0.05
        for node_id, place in zip(SIX, counts(spec, joint), strict=True):
            assert master.write(node_id, 0x607A, 0, "i", place) == 0
        master.control(SIX, 0x1F)
        assert all(word & ACKNOWLEDGED for _, _, word in master.sync())
        for _ in range(600):
            answer = master.sync()
        start_rad_joint = spec.start_rad - 0.05
        ends = counts(spec, start_rad_joint)
        assert all(word & REACHED for _, _, word in answer)
        largest_difference = max(abs(a[0] - end) for a, end in zip(answer, ends, strict=True))
        assert largest_difference <= 655


def test_nmt_stop_while_enabled_is_a_fault_and_the_brake_holds(
    request: pytest.FixtureRequest,
) -> None:
    with running(clean_cell("disc"), request.node.name) as (cell, master):
        master.set_up(SIX)
        master.enable(SIX)
        master.send(0x000, bytes([2, 0]))
        master.send(0x000, bytes([0x80, 0]))
        found = master.read(1, 0x6041, 0, "H") & 0x4F
        assert found == 0x08
        master.send(0x000, bytes([1, 0]))
        for _ in range(20):
            master.sync()
        assert (cell.plant.velocity_rad_s == 0.0).all()


def test_noise_of_the_reference_is_as_declared_and_on_nothing_else() -> None:
    spec = clean_cell()
    plant = Plant(spec)
    amplifiers = AmplifierSet(spec, plant)
    reported = []
    for _ in range(20_000):
        amplifiers.report()
        reported.append(amplifiers.reported_a.copy())
    noise = np.array(reported)
    current_noise_a = [axis.current_noise_a for axis in spec.axes]
    sigma = np.array(current_noise_a)
    noise_std = noise.std(axis=0)
    np.testing.assert_allclose(noise_std, sigma, rtol=0.08)
    noise_variance = noise.var(axis=0)
    lag_one = (noise[1:] * noise[:-1]).mean(axis=0) / noise_variance
    expected = np.exp(-0.001 / 0.005)
    np.testing.assert_allclose(lag_one, expected, atol=0.02)
    difference = np.corrcoef(noise.T) - np.eye(6)
    assert np.abs(difference).max() < 0.1
    assert (amplifiers.loops["current_a"] == 0.0).all()


def test_a_failure_in_the_thread_reaches_the_owner(request: pytest.FixtureRequest) -> None:
    channel = request.node.name
    with (
        can.Bus(interface="virtual", channel=channel) as near,
        can.Bus(interface="virtual", channel=channel) as far,
    ):
        cell = SimulatedCell(clean_cell(), far, STOPPED_CLOCK)
        cell.plant.velocity_rad_s[0] = np.nan
        with pytest.raises(FrictionUnsolved), cell:
            Master(near).send(0x080, b"")
            thread = cell._thread
            assert thread is not None
            thread.join(30.0)
            assert not thread.is_alive()


def test_a_controlword_acts_on_the_target_in_the_same_frame(request: pytest.FixtureRequest) -> None:
    spec = clean_cell()
    with running(spec, request.node.name) as (_, master):
        master.set_up(SIX)
        for step in (
            (0x1400, 1, "I", 0x80000201),
            (0x1600, 0, "B", 0),
            (0x1600, 1, "I", 0x60400010),  # before its target, as CiA 402 maps them
            (0x1600, 2, "I", 0x607A0020),
            (0x1600, 0, "B", 2),
            (0x1400, 1, "I", 0x00000201),
        ):
            assert master.write(1, *step) == 0
        for controlword, target in ((0x06, 0), (0x07, 0), (0x0F, 0), (0x1F, 30_000)):
            packed = struct.pack("<Hi", controlword, target)
            master.send(0x201, packed)
            master.sync()
        for _ in range(500):
            answer = master.sync()
        assert answer[0][0] == pytest.approx(30_000, abs=655)
        assert answer[0][2] & REACHED
