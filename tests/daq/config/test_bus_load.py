"""How much of a bus a recording takes:
by the standard, by real stuffing, and by what a move sends.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from math import cos, pi, sin

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from daq.config.cell import PacingMode, Sync
from daq.config.cell_buses import (
    LARGEST_MEAN,
    SETPOINTS,
    answer_us,
    bus_load,
    bus_loads,
    frame_bits,
    load_warnings,
    polling_fits,
    polling_warnings,
    shortest_period_us,
    split_answers,
    usual_bits,
)
from daq.config.cell_file import bundle, cell_from_bundle, load_cell
from daq.environment import shipped_configurations
from daq.report.bus_views import load_lines
from drivers.motion.execute import execute
from drivers.move import Move
from drivers.profiles.profile import DriveProfile, ObjectEntry
from drivers.stream.stream import SyncStream
from drivers.stream.sync import LockstepSync
from tests.conftest import CHECKOUT
from tests.drivers.scripted import PERIOD_NS, cell, permission
from tests.two_buses import on_two_buses

CELL = load_cell(CHECKOUT / "configs/cells/demo.yaml")
PROFILE = next(axis.profile for axis in CELL.axes if axis.profile is not None)
BITRATE = 1_000_000


def _crc(bits: list[int]) -> int:
    """CRC-15 of CAN (ISO 11898-1): x¹⁵ + x¹⁴ + x¹⁰ + x⁸ + x⁷ + x⁴ + x³ + 1."""
    register = 0
    for bit in bits:
        register = (register << 1 ^ (0x4599 if bit ^ register >> 14 else 0)) & 0x7FFF
    return register


def _digits(value: int, width: int) -> list[int]:
    places = reversed(range(width))
    return [value >> place & 1 for place in places]


def _bits_on_the_wire(identifier: int, data: bytes) -> int:
    """Length of a data frame, its real stuff bits and the space after it counted."""
    head = [0, *_digits(identifier, 11), 0, 0, 0, *_digits(len(data), 4)]
    for byte in data:
        head += _digits(byte, 8)
    head += _digits(_crc(head), 15)
    stuffed = 0
    run = 0
    last = -1
    for bit in head:
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:
            stuffed = stuffed + 1
            last = 1 - bit
            run = 1
    return len(head) + stuffed + 13


def _answers_of_a_moving_arm(cycles: int, size: int) -> Iterator[int]:
    """Bits of SYNC and six answers, cycle by cycle:
    positions within some turns, currents around their rated value.
    """
    for cycle in range(cycles):
        bits = _bits_on_the_wire(0x080, b"")
        for axis in range(6):
            phase = 2 * pi * cycle / 1000.0 / (1.3 + 0.4 * axis) + axis
            position = round(65536 * (10 + 5 * axis) * sin(phase)) * (-1) ** axis
            phase_rad = 0.9 * cycle + axis
            current = round(600 * cos(phase) + 37 * sin(phase_rad))
            packed = struct.pack("<ihH", position, current, 0x1237)
            data = packed[:size]
            identifier = 0x181 + axis
            bits += _bits_on_the_wire(identifier, data)
        yield bits


@pytest.mark.parametrize(("size", "mean", "worst"), [(6, 0.66, 0.75), (8, 0.76, 0.87)])
def test_six_axes_at_a_kilohertz_take_what_was_measured(
    size: int, mean: float, worst: float
) -> None:
    """The project's measured figures of one bus of 1 Mbit/s, and frames with real stuffing."""
    usual = (usual_bits(0) + 6 * usual_bits(size)) / 1000.0
    assert usual == pytest.approx(mean, abs=0.006)
    assert (frame_bits(0) + 6 * frame_bits(size)) / 1000.0 == pytest.approx(worst, abs=0.006)
    real = list(_answers_of_a_moving_arm(2000, size))
    assert usual - 0.02 < sum(real) / len(real) / 1000.0 <= usual
    assert max(real) <= frame_bits(0) + 6 * frame_bits(size)


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_no_frame_is_longer_than_the_longest(identifier: int, data: bytes) -> None:
    bits = _bits_on_the_wire(identifier, data)
    assert 47 + 8 * len(data) <= bits <= frame_bits(len(data))
    assert 47 + 8 * len(data) < usual_bits(len(data)) < frame_bits(len(data))


def test_the_longest_frame_is_nearly_reached() -> None:
    """A stuff bit begins the next run: five equal bits, then four of each kind in turn (3Ch)
    are all doubled.
    """
    lower_limit = frame_bits(8) - 6
    assert (
        max(_bits_on_the_wire(0x078, bytes((first, *[0x3C] * 7))) for first in range(256))
        >= lower_limit
    )


@given(
    st.integers(1, 12),
    st.sampled_from((125_000, 250_000, 500_000, 1_000_000)),
    st.integers(0, 5000),
)
def test_the_shortest_period_is_just_allowed(axes: int, bitrate: int, longer_us: int) -> None:
    used = [PROFILE] * axes
    shortest = shortest_period_us(used, bitrate)
    assert shortest is not None
    period_us = shortest + longer_us
    assert bus_load(used, bitrate, period_us).allowed
    allowed = bus_load(used, bitrate, shortest - 1).allowed
    assert not allowed


@given(st.integers(1, 11), st.integers(500, 20_000))
def test_more_axes_and_shorter_periods_load_a_bus_more(axes: int, period_us: int) -> None:
    profiles = [PROFILE] * axes
    load = bus_load(profiles, BITRATE, period_us)
    more = bus_load([PROFILE] * (axes + 1), BITRATE, period_us)
    faster = bus_load([PROFILE] * axes, BITRATE, 400)
    for other in (more, faster):
        lower_limit = (load.mean, load.worst, load.start)
        assert (other.mean, other.worst, other.start) > lower_limit
    assert load.start > load.worst * 0.8
    expected = answer_us([PROFILE] * axes, BITRATE)
    assert load.worst * period_us == pytest.approx(expected)


@given(st.integers(1, 10), st.integers(1, 10), st.integers(500, 5000))
def test_two_buses_share_what_one_would_carry(left: int, right: int, period_us: int) -> None:
    profiles = [PROFILE] * (left + right)
    one = bus_load(profiles, BITRATE, period_us)
    two = [bus_load([PROFILE] * axes, BITRATE, period_us) for axes in (left, right)]
    # Only SYNC and the recorder's heartbeat are there twice.
    twice = usual_bits(0) / period_us + usual_bits(1) * 10 / BITRATE
    expected = one.mean + twice
    assert sum(load.mean for load in two) == pytest.approx(expected)


@given(st.integers(10_000, 30_000), st.integers(1, 32))
def test_a_bus_that_heartbeats_fill_has_no_period(bitrate: int, axes: int) -> None:
    profiles = [PROFILE] * axes
    shortest = shortest_period_us(profiles, bitrate)
    assume(shortest is None)
    allowed = bus_load([PROFILE] * axes, bitrate, 1_000_000).allowed
    assert not allowed


def test_a_current_of_32_bits_takes_a_second_frame() -> None:
    object_entry = ObjectEntry(0x30D0, 0, 32, signed=True)
    wide = DriveProfile(
        **{
            **{name: getattr(PROFILE, name) for name in PROFILE.__dataclass_fields__},
            "current": object_entry,
        }
    )
    assert split_answers(wide)
    assert not split_answers(PROFILE)
    mean = bus_load([PROFILE], BITRATE, 1000).mean
    lower_limit = mean + usual_bits(2) / 1000 - 0.01
    assert bus_load([wide], BITRATE, 1000).mean > lower_limit


def test_a_move_sends_no_more_than_is_counted() -> None:
    network, bus = cell(2)
    velocity_counts_s = (20_000,) * 2
    acceleration_counts_s2 = (100_000,) * 2
    move = Move((0, 0), velocity_counts_s, acceleration_counts_s2)
    target_counts = (1000, -1000)
    moves = (
        Move(target_counts, (20_000, 20_000), (100_000, 100_000)),
        move,
    )
    with network:
        network.prepare()
        pacing = LockstepSync(PERIOD_NS, clock=bus.clock)
        stream = SyncStream(network, pacing)
        for _ in execute(network, stream, (), permission()):
            pass
        bus.sent.clear()
        reported = Counter[int]()
        for sample in execute(network, stream, moves, permission()):
            assert not sample.missing
        reported.update(message.arbitration_id for message in bus.sent)
    enabling = 3 + 2  # three commands up; the stop's quick stop and power off
    for node_id in (1, 2):
        assert reported[0x300 + node_id] == reported[0x400 + node_id] == len(moves)
        limit = SETPOINTS * len(moves) + enabling
        assert reported[0x200 + node_id] <= limit


def test_the_demo_cell_may_be_sampled_by_the_clock_and_its_starts_are_warned_of() -> None:
    ((bus, load),) = bus_loads(CELL)
    assert bus.name == "demo"
    assert load.allowed
    assert 0.76 < load.mean < LARGEST_MEAN
    # Six set-points of six bytes beside six answers: not within a millisecond of a wire of 1
    # Mbit/s.
    assert load.start == pytest.approx(1.37, abs=0.01)
    assert load_lines(CELL) == (
        "demo (virtual:demo): in lockstep; a real bus would be loaded by 77 % on average, 86 "
        "% at worst",
    )
    assert load_warnings(CELL) == ()
    path = shipped_configurations() / "cells/demo.yaml"
    files = bundle(path)
    text = files["cell.yaml"].decode()
    timed = text.replace("pacing: lockstep", "pacing: timed")
    (warning,) = load_warnings(cell_from_bundle({**files, "cell.yaml": timed.encode()}))
    assert warning.startswith("demo: when all its axes start, set-points and answers take 137 %")
    two = cell_from_bundle(
        {**files, "cell.yaml": on_two_buses(timed, "socketcand", "a", "b").encode()}
    )
    assert load_warnings(two) == ()
    assert [line.partition(": ")[2] for line in load_lines(two)] == [
        "loaded by 41 % on average, 46 % at worst"
    ] * 2


def test_torque_and_temperature_are_read_only_where_a_period_has_room_for_an_sdo() -> None:
    """Six axes at 1 ms fill up to 87 % of a bus;
    a request and its answer take up to 27 % of such a period.
    """
    assert CELL.sync is not None
    sync = replace(CELL.sync, pacing=PacingMode.TIMED)
    timed = replace(CELL, sync=sync)
    assert not polling_fits(timed)
    (warning,) = polling_warnings(timed)
    assert "sync.period_us of 1200 has room" in warning
    slower = replace(timed, sync=Sync(1200))
    assert polling_fits(slower)
    assert polling_warnings(slower) == ()
    changed_slower = replace(slower, sync=Sync(1100))
    assert not polling_fits(changed_slower)
    # A simulated cell waits for its frames.
    assert CELL.sync.pacing is PacingMode.LOCKSTEP
    assert polling_fits(CELL)
