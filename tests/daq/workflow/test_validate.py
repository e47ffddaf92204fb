"""Validation: a calibration that was saved and read predicts as the fit did,
and says what it cannot predict.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from daq.cli import main
from daq.cli.next_step import cell_of
from daq.config.cell_file import load_cell
from daq.documents.calibration_file import load_calibration, save_calibration
from daq.errors import CalibrationUnreadable
from daq.workflow.validate import (
    DataUse,
    _masses,
    conditioning_of,
    together,
    validate,
    warn_without_temperature,
)
from ident.calibration import AcceptedEffect, Calibration
from tests.daq.calibrations import demo_calibration
from tests.daq.logs import demo_content, samples, write


@pytest.mark.slow
def test_the_file_gives_the_errors_of_the_fit(
    real: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    file, log = real
    assert main(["validate", str(file), str(log), "--json"]) == 0
    output = capsys.readouterr()
    assert output.err == ""
    found = json.loads(output.out)
    calibration = load_calibration(file)
    expected = ["J1", "J2", "J3", "J4", "J5", "J6"]
    assert found["axes"] == expected
    (entry,) = found["logs"]
    error = entry["relative_error_percent"]
    assert error["axes"] == pytest.approx(calibration.relative_error_percent.axes, rel=1e-6)
    assert error["total"] == pytest.approx(calibration.relative_error_percent.total, rel=1e-6)
    assert (entry["seen_by_fit"], entry["held_out"], entry["same_configuration"]) == (
        True,
        False,
        True,
    )
    assert entry["rows"] == calibration.rows
    assert entry["picture"] is None
    assert found["filter"]["position_cutoff_hz"] == 100.0


@pytest.mark.slow
def test_text_and_picture(
    real: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, log = real
    folder_folder = tmp_path / "new" / "folder"
    assert main(["validate", str(file), str(log), "--pictures", str(folder_folder)]) == 0
    text, said = capsys.readouterr()
    assert "Next:" not in said  # its gains were held fixed
    assert f"{load_calibration(file).relative_error_percent.total:.2f}" in text
    assert "seen by the fit" in text
    expected = f"Written: {tmp_path / 'new' / 'folder' / 'tx40.svg'}"
    last_line = text.splitlines()[-1]
    assert last_line == expected
    tx40_path = tmp_path / "new" / "folder" / "tx40.svg"
    assert tx40_path.read_bytes().startswith(b"<svg")
    (tmp_path / "occupied").write_text("", encoding="utf-8")
    assert main(["validate", str(file), str(log), "--pictures", str(tmp_path / "occupied")]) == 1
    error = capsys.readouterr().err
    assert f"error:    {tmp_path / 'occupied'}\n" in error
    assert "expected: a folder" in error


@pytest.mark.slow
def test_identified_gains_that_apply_refuses_are_not_applied_next(
    real: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, log = real
    held = load_calibration(file)
    gains = tuple(replace(gain, std=0.01 * abs(gain.value)) for gain in held.gains)
    free = replace(held, gains=gains)
    save_calibration(free, tmp_path / "free.yaml")
    assert main(["validate", str(tmp_path / "free.yaml"), str(log)]) == 0
    said = capsys.readouterr().err
    assert (
        "`drivegain apply` refuses this calibration: calibration: no payload in any log that "
        "was fitted"
    ) in said


def test_the_next_step_names_the_cell_file_that_the_logs_carry(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, checkout: Path
) -> None:
    shipped = (checkout / "configs/cells/demo.yaml").read_text(encoding="utf-8")
    shipped = shipped.replace("../", f"{checkout}/configs/")
    other = tmp_path / "a/cells/demo.yaml"
    own = tmp_path / "mine/own.yaml"
    for file, kg in ((other, "4.59"), (own, "4.58")):
        file.parent.mkdir(parents=True)
        changed_shipped = shipped.replace("mass_kg: 4.59", f"mass_kg: {kg}")
        file.write_text(changed_shipped, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    fitted = replace(
        demo_calibration(),
        cell="demo",
        recording_configuration_sha256=load_cell(own).recording_digest,
    )
    logs = [Path("mine/log.mcap")]
    assert cell_of(fitted, logs) == Path("mine/own.yaml")
    unknown = replace(fitted, recording_configuration_sha256=None)
    assert cell_of(unknown, logs) == Path("CELL")
    cell = cell_of(unknown, [Path("log.mcap")])
    assert cell == Path("a/cells/demo.yaml")
    # One that cannot be read is no reason to fail
    own.write_text("name: demo\nrobot:\n", encoding="utf-8")
    assert cell_of(fitted, logs) == Path("CELL")


@pytest.mark.slow
def test_what_a_calibration_has_met_and_what_it_was_made_with(real: tuple[Path, Path]) -> None:
    file, log = real
    calibration = load_calibration(file)
    (source,) = calibration.sources
    sources = (replace(source, role="holdout"),)
    configuration_sha256 = "0" * 64
    changed = replace(calibration, sources=sources, configuration_sha256=configuration_sha256)
    (held_out,) = validate(changed, [log])
    assert (held_out.data_use, held_out.same_configuration) == (DataUse.HOLDOUT, False)
    sha256 = "0" * 64
    changed_source = replace(source, sha256=sha256)
    changed_calibration = replace(calibration, sources=(changed_source,))
    (new,) = validate(changed_calibration, [log])
    assert new.data_use is DataUse.NEW
    # Twice the same rows weigh the same.
    assert together((new, new)).total == pytest.approx(new.error.total)


@pytest.mark.slow
def test_a_wrong_gain_shows_on_its_axis_alone(real: tuple[Path, Path]) -> None:
    file, log = real
    calibration = load_calibration(file)
    first, *others = calibration.gains
    (right,) = validate(calibration, [log])
    gains = (replace(first, value=1.2 * first.value), *others)
    changed_calibration = replace(calibration, gains=gains)
    (wrong,) = validate(changed_calibration, [log])
    # ‖1.2 Y − W χ‖/‖1.2 Y‖ with a residual that is nearly orthogonal to W χ.
    expected = np.hypot(100.0 * 0.2 / 1.2, right.error.axes[0] / 1.2)
    assert wrong.error.axes[0] == pytest.approx(expected, rel=0.05)
    assert wrong.error.axes[1:] == pytest.approx(right.error.axes[1:])


@pytest.mark.slow
def test_the_filter_is_that_of_the_calibration(real: tuple[Path, Path]) -> None:
    file, log = real
    calibration = load_calibration(file)
    (as_fitted,) = validate(calibration, [log])
    changed_calibration = replace(
        calibration, filter={**calibration.filter, "decimation_cutoff_hz": 5.0}
    )
    (slower,) = validate(changed_calibration, [log])
    assert len(slower.time_s) < 0.3 * len(as_fitted.time_s)
    assert slower.error.total < as_fitted.error.total


@pytest.mark.parametrize(
    "spoilt",
    [{}, {"position_cutoff_hz": 40.0}, {**demo_calibration().filter, "standstill_rad_s": 0.1}],
)
def test_a_calibration_without_its_filter_is_unreadable(
    spoilt: dict[str, float | list[float]],
) -> None:
    calibration = replace(demo_calibration(), filter=spoilt)
    with pytest.raises(CalibrationUnreadable, match="position_cutoff_hz"):
        conditioning_of(calibration)


@pytest.fixture
def complete() -> Calibration:
    """Calibration of the demo cell, with a filter, and with parameters of no robot."""
    whole: dict[str, float | list[float]] = {
        "position_cutoff_hz": 40.0,
        "position_order": 4.0,
        "decimation_cutoff_hz": 20.0,
        "standstill_rad_s": [0.03] * 6,
        "standstill_share": 0.1,
    }
    return replace(demo_calibration(), filter=whole, effects=())


def _calibrated(calibration: Calibration, tmp_path: Path) -> list[str]:
    save_calibration(calibration, tmp_path / "calibration.yaml")
    return ["validate", str(tmp_path / "calibration.yaml")]


@pytest.mark.slow
def test_refusals_have_their_exit_codes(
    complete: Calibration, checkout: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    angle = np.rint(20000.0 * np.sin(np.arange(3000)[:, None] / 200.0 + np.arange(6))).astype(int)
    path = tmp_path / "a.mcap"
    log = write(path, demo_content(checkout), samples(angle.tolist()))
    calibration = replace(complete, cell="other")
    assert main([*_calibrated(calibration, tmp_path), str(log)]) == 4
    assert "cell 'other' with the axes J1" in capsys.readouterr().err
    assert main([*_calibrated(complete, tmp_path), str(log), "--json"]) == 4
    output = capsys.readouterr()
    assert output.out == ""
    assert "'ZZ1R'" in output.err
    changed_complete = replace(complete, parameters=())
    assert main([*_calibrated(changed_complete, tmp_path), str(log)]) == 0
    assert "100.00" in capsys.readouterr().out  # a model without parameters predicts nothing
    assert main([*_calibrated(complete, tmp_path), str(tmp_path / "none.mcap")]) == 4
    assert "none.mcap" in capsys.readouterr().err
    assert main(["validate", str(tmp_path / "none.yaml"), str(log)]) == 4
    assert "none.yaml" in capsys.readouterr().err


def test_a_robot_that_was_at_rest_reports_nothing(
    complete: Calibration, checkout: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "still.mcap"
    log = write(path, demo_content(checkout), samples([[0] * 6] * 3000))
    calibration = replace(complete, parameters=())
    assert main([*_calibrated(calibration, tmp_path), str(log)]) == 4
    assert "did the robot move" in capsys.readouterr().err


def test_a_run_without_the_temperature_that_an_effect_needs_is_warned_of(
    caplog: pytest.LogCaptureFixture,
) -> None:
    effect = AcceptedEffect("temperature-friction", "J2", {}, (), 5.0, 4.0)
    calibration = replace(demo_calibration(), effects=(effect,))
    bare = np.zeros((3, 6))
    partly = np.where(np.arange(6) == 1, np.nan, 30.0) + bare
    for temperature_c in (None, partly):
        caplog.clear()
        warn_without_temperature(calibration, "monday", temperature_c)
        assert "monday has no temperature of J2: its friction is predicted at 40 °C" in caplog.text
    caplog.clear()
    bare_temperature_c = bare + 30.0
    warn_without_temperature(calibration, "monday", bare_temperature_c)
    warn_without_temperature(demo_calibration(), "monday", None)
    assert not caplog.records


def test_what_keeps_rows_from_being_weighed_is_said_of_every_calibration() -> None:
    calibrations = {"first": demo_calibration(), "second": demo_calibration()}
    masses = _masses(calibrations, "no rows without load", 4.59)
    assert masses == {"first": "no rows without load", "second": "no rows without load"}
