"""Raw counts to SI: by the cell in the log, and refused where they cannot be."""

from __future__ import annotations

from collections.abc import Callable
from math import pi
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from daq.configuration.cell_file import load_cell
from daq.conversion import load_run, scaling
from daq.errors import ClockImplausible, CurrentSaturated, CyclesLost, LogIncomplete, PositionImplausible, RunInvalid
from daq.log.readback import AxisReadback, Readback, readback_of_drives
from drivers.event import CellEvent, EventKind
from drivers.sample import Sample
from tests.conftest import CHECKOUT
from tests.daq.logs import DISC, START_NS, content, demo_content, samples, write

CELL = load_cell(CHECKOUT / "configs/cells/demo.yaml")
DEMO_SCALING = scaling(CELL, Readback(tuple(AxisReadback(name, 0.002) for name in CELL.axis_names)))
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
        return write(tmp_path / "a.mcap", demo_content(checkout, payload), rows, events, verdict)

    return _record


@given(st.lists(st.integers(-(2**31), 2**31 - 1), min_size=6, max_size=6))
def test_joint_positions_are_those_of_the_drive_train(counts: list[int]) -> None:
    """q_motor = R q_joint (eq. 24), so R q must give the counts back."""
    joint_rad = DEMO_SCALING.joint_position(np.array(counts))
    np.testing.assert_allclose(CELL.ratio @ joint_rad / (2 * pi) * 65536, counts, rtol=1e-9, atol=1e-3)


def test_motor_six_also_turns_with_joint_five() -> None:
    turn_of_motor_6 = DEMO_SCALING.joint_position(np.array([0, 0, 0, 0, 0, 65536]))
    np.testing.assert_allclose(turn_of_motor_6, [0, 0, 0, 0, 0, 2 * pi / 32], atol=1e-12)
    turn_of_motor_5 = DEMO_SCALING.joint_position(np.array([0, 0, 0, 0, 65536, 0]))
    np.testing.assert_allclose(turn_of_motor_5, [0, 0, 0, 0, 2 * pi / 45, -2 * pi / 45], atol=1e-12)


def test_a_run_comes_from_the_log_alone(record: Recorder) -> None:
    events = (
        CellEvent(START_NS + 20_000_000, None, EventKind.MOVE_START, 4, ""),
        CellEvent(START_NS + 50_000_000, None, EventKind.MOVE_END, 4, ""),
        CellEvent(START_NS + 60_000_000, None, EventKind.MOVE_START, 5, ""),
    )
    run, cell = load_run(record(samples([[1000 * k] * 6 for k in range(100)]), events=events, loaded=True))
    assert cell.digest == CELL.digest
    assert run.payload == DISC
    assert run.rate_hz == pytest.approx(1000.0)
    assert run.time_s[0] == 0.0
    np.testing.assert_allclose(run.current_a[3], [-6.0] * 6)
    np.testing.assert_allclose(run.position_rad[1, :4], 1000 * 2 * pi / 65536 / np.array([32, 32, 45, -48]))
    assert run.move is not None
    assert run.move.tolist() == [4] * 60 + [5] * 40
    assert run.valid is not None
    assert run.valid.all()
    assert len(run.digest) == 64


def test_no_moves_written_down_is_none(record: Recorder) -> None:
    assert load_run(record(samples([[0] * 6] * 3)))[0].move is None


def test_missing_and_saturated_samples_are_masked(record: Recorder) -> None:
    rows = samples([[0] * 6] * 20)
    rows[3] = Sample(13, rows[3].time_ns, (0,) * 6, (0,) * 6, (0x1237,) * 6, missing=0b100100)
    rows[7] = Sample(17, rows[7].time_ns, (0,) * 6, (0,) * 6, (0x1A37,) + (0x1237,) * 5)
    valid = load_run(record(rows))[0].valid
    assert valid is not None
    assert np.argwhere(~valid).tolist() == [[3, 2], [3, 5], [7, 0]]


def test_a_run_at_the_limit_is_refused(record: Recorder) -> None:
    rows = samples([[0] * 6] * 17) + samples([[0] * 6] * 20, status=0x1A37)[17:]
    with pytest.raises(CurrentSaturated, match=r"axis J1: found a limit acting in 15\.0 %"):
        load_run(record(rows))


def test_a_gap_is_refused(record: Recorder) -> None:
    rows = samples([[0] * 6] * 20)
    with pytest.raises(CyclesLost, match="cycle 16 after 14 "):
        load_run(record(rows[:5] + rows[6:]))


def test_a_clock_that_disagrees_is_refused(record: Recorder) -> None:
    rows = [Sample(k, START_NS + k * 1_100_000, (0,) * 6, (0,) * 6, (0,) * 6) for k in range(20)]
    with pytest.raises(ClockImplausible, match=r"909\.091 Hz; expected 1000 Hz"):
        load_run(record(rows))


def test_an_invalid_run_is_refused(record: Recorder) -> None:
    with pytest.raises(RunInvalid, match="heartbeat of node 3"):
        load_run(record(samples([[0] * 6] * 20), verdict=(False, "heartbeat of node 3 lost")))


def test_positions_outside_the_limits_are_refused(record: Recorder) -> None:
    turned = round(65536 * 32 * 0.8)
    with pytest.raises(PositionImplausible, match=r"axis J1: found joint positions from 0 to 288 deg; .*radians"):
        load_run(record(samples([[0] * 6, [turned, 0, 0, 0, 0, 0]])))


def test_a_log_of_another_cell_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "b.mcap", content(2), samples([[0, 0]] * 3))
    with pytest.raises(LogIncomplete, match="a readback of J1, J2; expected one of J1, J2, J3"):
        load_run(path, CELL)


def test_the_readback_of_drives_keeps_their_answers() -> None:
    readback = readback_of_drives(("J1", "J2"), (0.1, 0.2), {"J2": {"serial": 2}, "J1": {"serial": 1}})
    assert [(a.name, a.current_per_unit, a.drive) for a in readback.axes] == [
        ("J1", 0.1, {"serial": 1}),
        ("J2", 0.2, {"serial": 2}),
    ]
