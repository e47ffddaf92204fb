"""Raw counts to SI: by the cell in the log, and refused where they cannot be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import pi
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.errors import (
    ClockImplausible,
    CurrentSaturated,
    CyclesLost,
    LogIncomplete,
    LogsDiffer,
    PositionImplausible,
    RunInvalid,
)
from daq.log.conversion import load_run, run_from_log, scaling, temperatures, unwrapped
from daq.log.metadata import AxisReadback, Readback, readback_of_drives
from daq.log.reader import read_log
from drivers.messages import CellEvent, EventKind, Quantity, Sample, SlowReading
from ident.data import dataset
from ident.data.dataset import differentiate
from ident.errors import CurrentUnsigned
from ident.model.model import DriveTrain
from tests.conftest import CHECKOUT
from tests.daq.logs import DISC, START_NS, content, demo_content, samples, write

CELL = load_cell(CHECKOUT / "configs/cells/demo.yaml")
READBACK_AXES = tuple(AxisReadback(name, 0.002) for name in CELL.axis_names)
DEMO_SCALING = scaling(CELL, Readback(READBACK_AXES))
Recorder = Callable[..., Path]


@pytest.fixture
def record(checkout: Path, tmp_path: Path) -> Recorder:
    """Writes a log of the demo cell."""

    def _record(rows: list[Sample], **options: object) -> Path:
        events = options.get("events", ())
        verdict = options.get("verdict", (True, ""))
        payload = DISC if options.get("loaded") else None
        assert isinstance(events, tuple)
        assert isinstance(verdict, tuple)
        path = tmp_path / "a.mcap"
        return write(path, demo_content(checkout, payload), rows, events, verdict)

    return _record


ZEROS = (0,) * 6
COUNTER_END = 2**31  #: first number that a counter of 32 bits does not have
COUNTER_NUMBERS = 2**32
TURN_COUNTS = 65536  #: of a motor
FIRST_RATIO = 32  #: of J1


def resting(count: int) -> list[Sample]:
    """Samples of a cell that stands at zero."""
    return samples([ZEROS] * count)


def steady(count: int) -> list[Sample]:
    """Samples of axes that all turn by 1000 counts a cycle."""
    rows = [(1000 * cycle,) * 6 for cycle in range(count)]
    return samples(rows)


@given(st.lists(st.integers(-(2**31), 2**31 - 1), min_size=6, max_size=6))
def test_joint_positions_are_those_of_the_drive_train(counts: list[int]) -> None:
    """q_motor = R q_joint (eq. 24), so R q must give the counts back."""
    joint_rad = DEMO_SCALING.joint_position(np.array(counts))
    motor_rad = CELL.ratio @ joint_rad
    motor_counts = motor_rad / (2 * pi) * TURN_COUNTS
    np.testing.assert_allclose(motor_counts, counts, rtol=1e-9, atol=1e-3)


def test_motor_six_also_turns_with_joint_five() -> None:
    def joints_by_turn_of(motor: int) -> NDArray[np.float64]:
        counts = np.zeros(6, dtype=int)
        counts[motor] = TURN_COUNTS
        return DEMO_SCALING.joint_position(counts)

    turn_rad = 2 * pi
    sixth_rad = turn_rad / 32
    expected = [0, 0, 0, 0, 0, sixth_rad]
    np.testing.assert_allclose(joints_by_turn_of(5), expected, atol=1e-12)

    fifth_rad = turn_rad / 45
    expected = [0, 0, 0, 0, fifth_rad, -fifth_rad]
    np.testing.assert_allclose(joints_by_turn_of(4), expected, atol=1e-12)


def test_a_run_comes_from_the_log_alone(record: Recorder) -> None:
    def event(after_ms: int, kind: EventKind, move: int) -> CellEvent:
        time_ns = START_NS + after_ms * 1_000_000
        return CellEvent(time_ns, None, kind, move, "")

    start_of_4 = event(20, EventKind.MOVE_START, 4)
    end_of_4 = event(50, EventKind.MOVE_END, 4)
    start_of_5 = event(60, EventKind.MOVE_START, 5)
    events = (start_of_4, end_of_4, start_of_5)
    path = record(steady(100), events=events, loaded=True)

    run, cell = load_run(path)

    # A name is as good as a path
    by_name, _ = load_run(str(path))
    assert np.array_equal(by_name.position_rad, run.position_rad)
    assert cell.digest == CELL.digest
    assert run.payload == DISC
    assert run.rate_hz == pytest.approx(1000.0)
    assert run.time_s[0] == 0.0
    fourth_a = run.current_a[3]
    np.testing.assert_allclose(fourth_a, [-6.0] * 6)
    motor_rad = 1000 * 2 * pi / TURN_COUNTS
    ratios = np.array([32, 32, 45, -48])
    joint_rad = run.position_rad[1, :4]
    np.testing.assert_allclose(joint_rad, motor_rad / ratios)
    assert run.move is not None
    moves = run.move.tolist()
    assert moves == [4] * 60 + [5] * 40
    assert run.valid is not None
    assert run.valid.all()
    assert len(run.digest) == 64


def test_the_channels_of_a_log_are_judged_once(
    record: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    phase_rad = np.arange(2_500) / 80.0
    swinging = 20_000.0 * np.sin(phase_rad)
    counts = np.round(swinging).astype(int)
    counts[300] += 2_000  # a glitch
    rows = [[count] * 6 for count in counts.tolist()]
    path = record(samples(rows))
    run, _ = load_run(path)
    train = DriveTrain(CELL.ratio)
    changed_run = replace(run, judged_channels=None)
    again = differentiate(changed_run, train, CELL.conditioning)
    with monkeypatch.context() as patch:
        patch.setattr(dataset, "find_faults", _judged_again)
        once = differentiate(run, train, CELL.conditioning)
    assert once.faults
    assert len(once.faults) == len(again.faults)
    for own, expected in zip(once.faults, again.faults, strict=True):
        assert own.kind is expected.kind
        assert own.axis == expected.axis
        stretches = expected.stretches.tolist()
        assert own.stretches.tolist() == stretches
    assert np.array_equal(once.position_rad, again.position_rad)

    without_glitch = run.position_rad.copy()
    neighbours = without_glitch[[299, 301]]
    without_glitch[300] = neighbours.mean(axis=0)
    other = replace(run, position_rad=without_glitch)
    faults = differentiate(other, train, CELL.conditioning).faults
    assert faults == ()


def _judged_again(*_: object) -> None:
    raise AssertionError("the channels were judged when the log was read")


def with_payloads(**changes: Any) -> Cell:
    """The demo cell, with each of its payloads changed."""
    payloads = []
    for payload in CELL.payloads:
        payloads.append(replace(payload, **changes))
    return replace(CELL, payloads=tuple(payloads))


def test_another_cell_file_corrects_the_mass_that_was_typed_in(record: Recorder) -> None:
    """And what is printed of the payload is what was used."""
    log = record(steady(100), loaded=True)
    heavier = with_payloads(mass_kg=5.049)
    run, _ = load_run(log, heavier)
    assert run.payload is not None
    assert run.payload.known == {"m": 5.049}

    other = with_payloads(mounting="elsewhere")
    with pytest.raises(
        LogsDiffer, match="payload disc on flange-a, which the given description does not have"
    ):
        load_run(log, other)


def test_no_moves_recorded_is_none(record: Recorder) -> None:
    path = record(resting(3))
    run, _ = load_run(path)
    assert run.move is None


def test_missing_and_saturated_samples_are_masked(record: Recorder) -> None:
    rows = resting(20)
    time_ns = rows[3].time_ns
    statusword = (0x1237,) * 6
    rows[3] = Sample(13, time_ns, ZEROS, ZEROS, statusword, missing=0b100100)
    time_ns = rows[7].time_ns
    limit_active = (0x1A37, *statusword[1:])
    rows[7] = Sample(17, time_ns, ZEROS, ZEROS, limit_active)
    path = record(rows)

    run, _ = load_run(path)

    assert run.valid is not None
    masked = [tuple(place) for place in np.argwhere(~run.valid)]
    missing = [(3, 2), (3, 5)]
    saturated = [(7, 0)]
    assert masked == missing + saturated


def test_a_run_at_the_limit_is_refused(record: Recorder) -> None:
    at_limit = samples([ZEROS] * 20, status=0x1A37)
    rows = resting(17) + at_limit[17:]
    with pytest.raises(CurrentSaturated, match=r"axis J1: found a limit active in 15\.0 %"):
        load_run(record(rows))


def test_a_gap_is_refused(record: Recorder) -> None:
    rows = resting(20)
    del rows[5]
    with pytest.raises(CyclesLost, match="cycle 16 after 14 "):
        load_run(record(rows))


def test_a_clock_that_disagrees_is_refused(record: Recorder) -> None:
    rows = []
    for k in range(20):
        time_ns = START_NS + k * 1_100_000
        rows.append(Sample(k, time_ns, ZEROS, ZEROS, ZEROS))
    with pytest.raises(ClockImplausible, match=r"909\.091 Hz; expected 1000 Hz"):
        load_run(record(rows))


def test_one_late_sync_is_refused(record: Recorder) -> None:
    """The mean rate of such a run is right, and its derivatives are not."""
    rows = resting(400)
    time_ns = rows[7].time_ns + 510_000
    rows[7] = replace(rows[7], time_ns=time_ns)
    with pytest.raises(
        ClockImplausible,
        match=r"cycle 18 0\.49 ms after cycle 17, its most uneven step; "
        r"expected 1 ms",
    ):
        load_run(record(rows))


HOUR_NS = 3600 * 10**9


@pytest.mark.parametrize(
    ("later_ns", "step"),
    [
        pytest.param(HOUR_NS, r"3600 s after", id="an hour ahead"),
        pytest.param(-HOUR_NS, r"-3600 s after", id="an hour back"),
        pytest.param(-START_NS, r"-\S+ s after", id="1970"),
        pytest.param(-1_000_000, r"0 ms after", id="twice"),
        pytest.param(-3_000_000, r"-2 ms after", id="back"),
    ],
)
def test_stamps_that_jump_are_no_late_sync(record: Recorder, later_ns: int, step: str) -> None:
    """The remedy was to record with less load on the computer."""
    rows = resting(400)
    for number in range(200, 400):
        time_ns = rows[number].time_ns + later_ns
        rows[number] = replace(rows[number], time_ns=time_ns)
    path = record(rows)

    with pytest.raises(ClockImplausible, match=step) as caught:
        load_run(path)

    assert "another tool has changed the log" in caught.value.remedy
    assert "SYNC came late" not in caught.value.remedy


def test_a_sync_within_half_of_its_period_is_taken(record: Recorder) -> None:
    rows = resting(400)
    time_ns = rows[7].time_ns - 490_000
    rows[7] = replace(rows[7], time_ns=time_ns)
    path = record(rows)
    run, _ = load_run(path)
    assert run.rate_hz == 1000.0


@given(
    st.integers(-(2**31), 2**31 - 1),
    st.lists(
        st.one_of(st.integers(-(2**31) + 1, 2**31 - 1), st.integers(-1000, 1000)), max_size=30
    ),
)
def test_a_counter_that_ran_over_gives_the_way_that_was_gone(start: int, steps: list[int]) -> None:
    way = np.cumsum([start, *steps], dtype=np.int64)
    wrapped = (way + COUNTER_END) % COUNTER_NUMBERS - COUNTER_END
    counter = wrapped.astype(np.int32)
    resting_axis = np.full_like(counter, 7)
    counts = np.stack((counter, resting_axis), axis=1)
    found = unwrapped(counts)[:, 0]
    np.testing.assert_array_equal(found, way)


def test_a_wrap_in_a_log_is_no_turn_of_the_joint(record: Recorder) -> None:
    """With an offset that puts the end of the counter in the middle of the joint's range."""
    rad_per_count = 2 * pi / TURN_COUNTS / FIRST_RATIO
    end_rad = COUNTER_END * rad_per_count
    first, *others = CELL.axes
    changed_axis = replace(first, zero_offset_rad=-end_rad)
    cell = replace(CELL, axes=(changed_axis, *others))
    before_wrap = range(COUNTER_END - 3, COUNTER_END)
    after_wrap = range(-COUNTER_END, -COUNTER_END + 3)
    counts = [*before_wrap, *after_wrap]
    rows = samples([(count, 0, 0, 0, 0, 0) for count in counts])
    rows = [replace(row, current_raw=ZEROS) for row in rows]
    path = record(rows)

    run, _ = load_run(path, cell)

    expected_rad = np.arange(-3, 3) * rad_per_count
    joint_rad = run.position_rad[:, 0]
    np.testing.assert_allclose(joint_rad, expected_rad, atol=1e-9)


def test_the_scaled_numbers_of_an_import_do_not_wrap(checkout: Path, tmp_path: Path) -> None:
    start = demo_content(checkout)
    top = 2**31 - 1
    quantum = 0.01 / top
    axes = []
    for axis in start.readback.axes:
        axes.append(replace(axis, position_rad_per_count=quantum))
    changed_start = replace(start, readback=Readback(tuple(axes)))
    first = Sample(0, 0, (top,) * 6, ZEROS, ZEROS)
    second = Sample(1, 1_000_000, (-top,) * 6, ZEROS, ZEROS)
    i_path = tmp_path / "i.mcap"
    path = write(i_path, changed_start, [first, second])

    run, _ = load_run(path)

    joint_rad = 0.01 / FIRST_RATIO
    found_rad = run.position_rad[:, 0]
    np.testing.assert_allclose(found_rad, [joint_rad, -joint_rad])


def test_an_invalid_run_is_refused(record: Recorder) -> None:
    verdict = (False, "heartbeat of node 3 lost")
    path = record(resting(20), verdict=verdict)
    with pytest.raises(RunInvalid, match="heartbeat of node 3"):
        load_run(path)


def test_positions_outside_the_limits_are_refused(record: Recorder) -> None:
    turned = round(TURN_COUNTS * FIRST_RATIO * 0.8)
    rows = [ZEROS, (turned, 0, 0, 0, 0, 0)]
    with pytest.raises(
        PositionImplausible,
        match=r"axis J1: found joint positions from 0 to 288 deg; .*the zero "
        r"is wrong.*units",
    ):
        load_run(record(samples(rows)))


def test_a_log_of_another_cell_is_refused(tmp_path: Path) -> None:
    b_path = tmp_path / "b.mcap"
    rows = samples([[0, 0]] * 3)
    path = write(b_path, content(2), rows)
    with pytest.raises(LogsDiffer, match="a log of cell 'x'; expected one of cell 'demo'"):
        load_run(path, CELL)
    with pytest.raises(LogIncomplete, match="a readback of J1, J2; expected one of J1, J2, J3"):
        run_from_log(read_log(path), CELL)


def test_the_readback_of_drives_keeps_their_answers() -> None:
    answers = {"J2": {"serial": 2}, "J1": {"serial": 1}}
    readback = readback_of_drives(("J1", "J2"), (0.1, 0.2), answers)
    first, second = readback.axes
    assert first.name == "J1"
    assert first.current_per_unit == 0.1
    assert first.drive == {"serial": 1}
    assert second.name == "J2"
    assert second.current_per_unit == 0.2
    assert second.drive == {"serial": 2}


def bouncing(count: int = 3000, size: bool = True) -> list[Sample]:
    """Moves both ways, and currents of 2 Hz, of which the second is a size, or has its sign."""
    time_s = np.arange(count) / 1000.0
    phase_rad = 2.0 * pi * 0.7 * time_s
    swinging = 20000.0 * np.sin(phase_rad)
    position = np.rint(swinging).astype(int)
    current_phase_rad = 2.0 * pi * 2.0 * time_s + 0.3
    alternating = 400.0 * np.sin(current_phase_rad)
    current = np.rint(alternating)
    position_counts = [(count,) * 6 for count in position.tolist()]
    rows = samples(position_counts)
    found = []
    for row, value in zip(rows, current, strict=True):
        signed = int(value)
        second = abs(signed) if size else signed
        current_raw = (signed, second, *[signed] * 4)
        found.append(replace(row, current_raw=current_raw))
    return found


def test_a_current_without_its_sign_is_refused_by_axis(record: Recorder) -> None:
    with pytest.raises(
        CurrentUnsigned, match="axis J2: found currents that are never negative"
    ) as caught:
        load_run(record(bouncing()))
    assert caught.value.axes == ("J2",)


def test_a_current_with_its_sign_is_taken(record: Recorder) -> None:
    path = record(bouncing(size=False))
    run, _ = load_run(path)
    assert len(run.time_s) == 3000


def test_a_temperature_that_no_motor_has_is_left_out() -> None:
    """The first sensor fails once, the second always, and the third axis has none."""
    fails_once = (30.0, 6553.5, 32.0)
    fails_always = (-127.0, -127.0, -127.0)
    celsius = {0: fails_once, 1: fails_always}
    readings: list[SlowReading] = []
    for axis, values in celsius.items():
        for second, value in enumerate(values):
            at_ns = START_NS + second * 10**9
            slow_reading = SlowReading(at_ns, axis, Quantity.TEMPERATURE, value)
            readings.append(slow_reading)
    after_s = np.array([0, 1, 2], dtype=np.int64)
    time_ns = START_NS + after_s * 10**9
    position_counts = np.zeros((3, 3))
    samples_of_log = SimpleNamespace(time_ns=time_ns, position_counts=position_counts)
    log: Any = SimpleNamespace(readings=readings, samples=samples_of_log)
    nothing = [np.nan] * 3
    interpolated = [30.0, 31.0, 32.0]
    expected = np.column_stack([interpolated, nothing, nothing])
    celsius_of_samples = temperatures(log)
    assert celsius_of_samples is not None
    np.testing.assert_allclose(celsius_of_samples, expected)
