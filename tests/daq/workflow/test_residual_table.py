"""`drivegain export csv`: the table adds up, and its errors are those of `validate`."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.cli.app import main
from daq.config.cell import model_of
from daq.documents.calibration_file import load_calibration, save_calibration
from daq.log.conversion import load_run
from daq.log.reader import read_log
from daq.workflow.validate import conditioning_of, on_cell
from ident.data.dataset import differentiate
from ident.equations.rows import row_filter
from ident.prediction import predict_current
from tests.daq.calibrations import demo_calibration

FloatArray = NDArray[np.float64]


def _table(path: Path) -> dict[str, FloatArray]:
    with path.open(newline="") as stream:
        names, *rows = csv.reader(stream)
    numbers = np.array(rows, dtype=np.float64)
    return dict(zip(names, numbers.T, strict=True))


@pytest.mark.slow
def test_a_real_log_as_a_table(
    real: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration, log = real
    out = tmp_path / "residual.csv"
    assert main(["export", "csv", str(calibration), str(log), "--out", str(out), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert main(["validate", str(calibration), str(log), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    (validated,) = document["logs"]
    table = _table(out)
    assert list(table) == report["columns"]
    assert len(table["time_s"]) == report["rows"]
    assert report["relative_error_percent"] == validated["relative_error_percent"]
    counted = 0
    axes = validated["relative_error_percent"]["axes"]
    for number, expected in enumerate(axes, start=1):
        name = f"J{number}"
        measured = table[f"{name}.torque_measured_Nm"]
        residual = table[f"{name}.torque_residual_Nm"]
        measured_difference = measured - table[f"{name}.torque_predicted_Nm"]
        assert residual == pytest.approx(measured_difference, abs=1e-12)
        rows = table[f"{name}.counts"] == 1.0
        counted += int(rows.sum())
        residual_norm = np.linalg.norm(residual[rows])
        measured_norm = np.linalg.norm(measured[rows])
        error = 100.0 * residual_norm / measured_norm
        assert error == pytest.approx(expected, rel=1e-9)
    assert counted == validated["rows"]


@pytest.mark.slow
def test_its_currents_are_those_that_a_drive_would_get(
    real: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Motor 6 of the TX-40 turns with joints 5 and 6:
    its current is not the torque of joint 6 over its gain.
    """
    calibration, log = real
    out = tmp_path / "residual.csv"
    assert main(["export", "csv", str(calibration), str(log), "--out", str(out)]) == 0
    assert "relative error" in capsys.readouterr().out
    table = _table(out)
    known = load_calibration(calibration)
    run, cell = load_run(log)
    known, model = on_cell(known, cell)
    conditioning = conditioning_of(known)
    data = differentiate(run, model.drive_train, conditioning)
    filtered = row_filter(data, conditioning)
    expected = filtered(predict_current(known, model, data).T)
    measured = filtered(data.current_a.T)
    unit = "Nm_motor_a_priori_"
    for index in range(6):
        assert table[f"J{index + 1}.current_predicted_{unit}"] == pytest.approx(
            expected[index], abs=1e-9
        )
        assert table[f"J{index + 1}.current_measured_{unit}"] == pytest.approx(
            measured[index], abs=1e-9
        )
    head = read_log(log).head
    drive_train = model_of(head.cell(log)).drive_train
    assert drive_train.coupled == (5,)


def test_a_name_that_is_taken_and_a_foreign_calibration_are_refused(
    real: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration, log = real
    out = tmp_path / "residual.csv"
    out.write_text("mine")
    assert main(["export", "csv", str(calibration), str(log), "--out", str(out)]) == 2
    assert out.read_text() == "mine"
    out.unlink()
    foreign = replace(demo_calibration(), filter=load_calibration(calibration).filter)
    save_calibration(foreign, tmp_path / "demo.yaml")
    assert main(["export", "csv", str(tmp_path / "demo.yaml"), str(log), "--out", str(out)]) == 4
    assert "expected: cell 'demo'" in capsys.readouterr().err
    assert not out.exists()
