"""An encoder glitch in a log of our own is judged as in an import,
wherever the log is read or called valid.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import radians
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.cli.app import main
from daq.config.cell import Cell, model_of
from daq.config.cell_file import load_cell
from daq.documents.calibration_file import save_calibration
from daq.errors import CurrentImplausible, DataError, ExitCode, PositionImplausible
from daq.log.bag_writer import export_bag
from daq.log.conversion import load_run
from daq.log.export import TableFormat, export_log
from daq.log.impossible import impossible_current, impossible_step
from daq.log.metadata import AxisReadback, Readback
from daq.log.motion import RecordedMotion
from daq.log.reader import LossyLogs
from daq.log.salvage import salvage
from daq.report.log import info_report
from drivers.messages import Sample
from ident.arrays import FloatArray
from ident.data.channel_faults import ChannelKind, FaultKind
from ident.data.conditioning import Conditioning
from ident.data.dataset import Dataset, differentiate
from ident.data.run import Run
from tests.conftest import CHECKOUT
from tests.daq.calibrations import demo_calibration
from tests.daq.logs import START_NS, demo_content, write

COUNT = 5000
RATE_HZ = 1000.0
AXES = 6
GLITCH_RAD = 0.9
CELL = load_cell(CHECKOUT / "configs/cells/demo.yaml")
REST_RAD = np.zeros(AXES)
REST_RAD[2] = radians(60.0)  # the elbow's limits leave zero out


def _joints(*, resting: int | None = None) -> FloatArray:
    """Smooth motion of every joint within its limits [rad], shape (COUNT, AXES); one may rest."""
    time_s = np.arange(COUNT) / RATE_HZ
    wave = np.pi * time_s
    phase = wave[:, None] + np.arange(AXES)
    joint_rad = REST_RAD + 0.2 * np.sin(phase)
    if resting is not None:
        joint_rad[:, resting] = REST_RAD[resting]
    return joint_rad


def _rounded(values: FloatArray) -> list[list[int]]:
    """Nearest integers, row by row."""
    rows: list[list[int]] = np.rint(values).astype(np.int64).tolist()
    return rows


def _none_missing(_: int) -> int:
    return 0


def _samples(joint_rad: FloatArray, missing: Callable[[int], int] = _none_missing) -> list[Sample]:
    """Samples of the demo cell at these positions, with a smooth current."""
    motor_turns = joint_rad @ CELL.ratio.T / (2.0 * np.pi)
    counts = _rounded(65536 * motor_turns)
    wave = np.arange(COUNT) / 90.0
    phase = wave[:, None] + np.arange(AXES)
    current = _rounded(200.0 * np.cos(phase))
    samples = []
    for k in range(COUNT):
        sample = Sample(
            cycle=10 + k,
            time_ns=START_NS + k * 1_000_000,
            position_counts=tuple(counts[k]),
            current_raw=tuple(current[k]),
            statusword=(0x1237,) * AXES,
            missing=missing(k),
        )
        samples.append(sample)
    return samples


def _verdict_while_recording(rows: list[Sample]) -> str:
    """Why the recorder calls samples invalid; empty where they are valid."""
    recorded = RecordedMotion(AXES)
    for row in rows:
        recorded.take(row)
    axes = [AxisReadback(name, 0.002) for name in CELL.axis_names]
    readback = Readback(tuple(axes))
    return recorded.reason(CELL, readback, RATE_HZ)


def _said(capsys: pytest.CaptureFixture[str]) -> str:
    """What was printed to standard error, in one line."""
    printed = capsys.readouterr().err
    return " ".join(printed.split())


def _glitch(rows: slice, axis: int = 1) -> Callable[[FloatArray], None]:
    def change(joint_rad: FloatArray) -> None:
        joint_rad[rows, axis] += GLITCH_RAD

    return change


@dataclass(frozen=True)
class Glitch:
    """A change of the recorded positions of J2, or of it at rest, and its time in the message."""

    change: Callable[[FloatArray], None]
    when: str
    resting: int | None = None


GLITCHES = {
    "one sample": Glitch(_glitch(slice(1500, 1501)), "at 1.5 s"),
    "the first sample": Glitch(_glitch(slice(0, 1)), "at 0.001 s"),
    "the last sample": Glitch(_glitch(slice(-1, None)), "at 4.999 s"),
    "a run of wrong samples": Glitch(_glitch(slice(1500, 1507)), "at 1.5"),
    "a step that stays": Glitch(_glitch(slice(1500, None)), "at 1.5 s"),
    "one sample of an axis that rests": Glitch(_glitch(slice(1500, 1501)), "at 1.5", resting=1),
    "a step of an axis that rests": Glitch(_glitch(slice(1500, None)), "at 1.5 s", resting=1),
    "between two blocks": Glitch(_glitch(slice(4096, 4097)), "at 4.09"),
}


def _log(path: Path, rows: list[Sample]) -> Path:
    return write(path, demo_content(CHECKOUT), rows)


@pytest.mark.slow
@pytest.mark.parametrize("kind", GLITCHES)
def test_a_glitch_of_the_encoder_is_refused_and_called_invalid_by_all(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    glitch = GLITCHES[kind]
    joint_rad = _joints(resting=glitch.resting)
    path = tmp_path / "sound.mcap"
    sound = _log(path, _samples(joint_rad))
    load_run(sound)
    assert info_report(sound).valid
    glitch.change(joint_rad)
    rows = _samples(joint_rad)
    a_path = tmp_path / "a.mcap"
    log = _log(a_path, rows)

    with pytest.raises(PositionImplausible) as refused:
        load_run(log)

    assert refused.value.subject == f"{log}, axis J2"
    assert "deg in one sample, 51" in refused.value.found  # 0.9 rad in 1 ms
    assert glitch.when in refused.value.found
    assert refused.value.expected == (
        "at most 600 deg/s, 3 times 200 deg/s, the limit in the cell configuration"
    )
    reason = f"axis J2: {refused.value.found}"
    described = info_report(log)
    assert not described.valid
    assert described.reason == reason
    table = export_log(log, tmp_path / "a.csv", TableFormat.CSV)
    assert not table.valid
    assert table.reason == reason
    bag = export_bag(log, tmp_path / "bag")
    assert not bag.valid
    assert bag.reason == reason
    assert _verdict_while_recording(rows) == reason

    damaged = log.rename(tmp_path / "b.mcap.part")
    saved = salvage(damaged, tmp_path / "saved.mcap")
    assert not saved.statistics.valid
    assert saved.statistics.reason == reason
    assert main(["fit", str(sound), str(saved.log)]) == ExitCode.DATA_UNFIT
    assert "axis J2: a step of" in _said(capsys)


@pytest.mark.parametrize("verb", ["fit", "residual", "validate", "weigh", "contact"])
def test_every_verb_refuses_a_glitch(
    verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], full_calibration: Path
) -> None:
    joint_rad = _joints()
    joint_rad[1500, 1] += GLITCH_RAD
    path = tmp_path / "a.mcap"
    log = str(_log(path, _samples(joint_rad)))
    if verb in {"fit", "residual"}:
        arguments = [log, log]
    else:
        arguments = [str(full_calibration), log]
    assert main([verb, *arguments]) == ExitCode.DATA_UNFIT
    said = _said(capsys)
    assert "a step of" in said
    assert "axis J2" in said


SMALL_GLITCH_RAD = 0.002
"""Less than J2 may move within a sample by its velocity limit, 3.5 mrad."""


@pytest.mark.slow
def test_a_glitch_that_no_limit_rules_out_is_filled_in_and_the_log_valid(tmp_path: Path) -> None:
    joint_rad = _joints()
    sound_path = tmp_path / "sound.mcap"
    path = _log(sound_path, _samples(joint_rad))
    sound_run, cell = load_run(path)
    joint_rad[1500:1503, 1] += SMALL_GLITCH_RAD
    a_path = tmp_path / "a.mcap"
    log = _log(a_path, _samples(joint_rad))
    run, _ = load_run(log)
    sound = _differentiated(sound_run, cell)
    data = _differentiated(run, cell)
    (fault,) = data.faults
    assert fault.kind is FaultKind.GLITCH
    assert fault.quantity is ChannelKind.POSITION
    assert fault.axis == 1
    assert fault.stretches.tolist() == [[1500, 1503]]
    size_rad = SMALL_GLITCH_RAD * CELL.ratio[1, 1]
    assert fault.size == pytest.approx(size_rad, rel=0.01)
    assert sound.faults == ()
    position_difference_rad = data.position_rad - sound.position_rad
    assert np.abs(position_difference_rad).max() < 1e-4
    assert info_report(log).valid


def _differentiated(run: Run, cell: Cell) -> Dataset:
    drive_train = model_of(cell).drive_train
    standstill_rad_s = (0.03,) * AXES
    conditioning = Conditioning(standstill_rad_s=standstill_rad_s)
    return differentiate(run, drive_train, conditioning)


def _frozen(joint_rad: FloatArray, current: NDArray[np.int64]) -> None:
    joint_rad[3500:4400, 1] = joint_rad[3500, 1]


def _without_sign(joint_rad: FloatArray, current: NDArray[np.int64]) -> None:
    current[:, 1] = np.mod(current[:, 1], 2**16)


def _slipped(joint_rad: FloatArray, current: NDArray[np.int64]) -> None:
    joint_rad[1500:, 1] += 0.004


FAULTS = {"frozen": _frozen, "without its sign": _without_sign, "slipped": _slipped}


@pytest.mark.slow
@pytest.mark.parametrize("kind", FAULTS)
def test_a_log_that_a_fit_refuses_is_called_invalid_by_all(kind: str, tmp_path: Path) -> None:
    """None of these has a step that is too fast for the robot."""
    joint_rad = _joints()
    rows = _samples(joint_rad)
    current = np.array([row.current_raw for row in rows])
    FAULTS[kind](joint_rad, current)
    rows = []
    for moved, of_axes in zip(_samples(joint_rad), current.tolist(), strict=True):
        row = replace(moved, current_raw=tuple(of_axes))
        rows.append(row)
    path = tmp_path / "a.mcap"
    log = _log(path, rows)
    with pytest.raises(DataError) as refused:
        load_run(log)
    assert refused.value.subject == f"{log}, axis J2"
    described = info_report(log)
    reason = f"axis J2: {refused.value.found}"
    assert not described.valid
    assert described.reason == reason
    assert _verdict_while_recording(rows) == reason


def test_a_current_that_no_amplifier_sets_is_refused_and_called_invalid(tmp_path: Path) -> None:
    rows = _samples(_joints())
    first, *others = rows[1000].current_raw
    assert abs(first) <= 200
    rows[1000] = replace(rows[1000], current_raw=(2**30, *others))
    path = tmp_path / "a.mcap"
    log = _log(path, rows)
    with pytest.raises(
        CurrentImplausible,
        match=r"axis J1: found a current of .*at 1 s; expected "
        r"a current",
    ):
        load_run(log)
    described = info_report(log)
    assert not described.valid
    assert described.reason.startswith("axis J1: a current of")


def test_a_short_motion_after_a_long_rest_is_no_outlier() -> None:
    current = np.ones((COUNT, 2))
    current[100:120] = 1500.0
    assert impossible_current(current) is None
    current[100:120] = 1.0
    current[100, 1] = 1500.0
    found = impossible_current(current)
    assert found is not None
    assert found.axis == 1
    assert found.row == 100


def test_answers_that_are_missing_are_no_steps(tmp_path: Path) -> None:
    """Where an axis did not answer, a log has a number that means nothing;
    the next answer is some periods away.
    """

    def missing(k: int) -> int:
        if 1500 <= k < 1540:
            return 0b10
        return 0

    joint_rad = _joints()
    joint_rad[1500:1540, 1] = 0.0
    rows = _samples(joint_rad, missing)
    path = tmp_path / "a.mcap"
    log = write(path, demo_content(CHECKOUT), rows, verdict=(False, "40 missing answers"))
    run, _ = load_run(log, lossy=LossyLogs.ACCEPTED)
    assert run.valid is not None
    assert not run.valid[1500:1540, 1].any()
    # 22 mrad for each of the 41 periods are too fast all the same
    joint_rad[1540:, 1] += GLITCH_RAD
    b_path = tmp_path / "b.mcap"
    wrong_rows = _samples(joint_rad, missing)
    verdict = (False, "40 missing answers")
    wrong = write(b_path, demo_content(CHECKOUT), wrong_rows, verdict=verdict)
    with pytest.raises(PositionImplausible, match="in one sample"):
        load_run(wrong, lossy=LossyLogs.ACCEPTED)


def test_a_counter_that_wraps_at_32_bits_is_no_step() -> None:
    joint_rad = _joints()
    rows = []
    for row in _samples(joint_rad):
        # The counter of the first motor begins just below its end.
        first, *others = row.position_counts
        counter = (first + 2**31 - 10) % 2**32
        if counter >= 2**31:
            counter -= 2**32
        wrapped = replace(row, position_counts=(counter, *others))
        rows.append(wrapped)
    assert _verdict_while_recording(rows) == ""


def test_a_coarse_encoder_that_hardly_moves_has_no_glitch() -> None:
    """Few steps of one degree on an axis at rest are its resolution; one of a radian is not."""
    joint_rad = np.zeros((COUNT, AXES))
    joint_rad[1000:2000, 0] = radians(1.0)
    assert impossible_step(joint_rad, RATE_HZ, CELL) is None
    joint_rad[1000:2000, 0] = 1.0
    found = impossible_step(joint_rad, RATE_HZ, CELL)
    assert found is not None
    assert found.axis == 0
    assert found.row == 1000


def test_an_import_and_a_recording_are_judged_by_one_function(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Both refuse what `impossible_step` refuses, whatever it is."""
    path = tmp_path / "a.mcap"
    rows = _samples(_joints())
    log = _log(path, rows)
    load_run(log)

    def refuse(*_: Any) -> Any:
        raise DataError("the one function", found="", expected="", remedy="")

    monkeypatch.setattr("daq.log.impossible.impossible_step", refuse)
    with pytest.raises(DataError, match="the one function"):
        load_run(log)


@pytest.fixture
def full_calibration(tmp_path: Path) -> Path:
    """A calibration of the demo cell, with every setting of its filter."""
    file = tmp_path / "calibration.yaml"
    standstill_rad_s = (0.03,) * AXES
    document = Conditioning(standstill_rad_s=standstill_rad_s).document()
    calibration = replace(demo_calibration(), filter=document)
    save_calibration(calibration, file)
    return file
