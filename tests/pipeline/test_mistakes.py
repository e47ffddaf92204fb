"""Mistakes of a tired technician at the end of the job:
nothing is lost, and each of them is named.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from daq.cli.app import main
from daq.documents.calibration_file import load_calibration
from daq.errors import ExitCode
from tests.pipeline.next_step import next_step

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def tx40_log(tmp_path_factory: pytest.TempPathFactory, checkout: Path, shared_data: Path) -> bytes:
    log = tmp_path_factory.mktemp("tx40") / "tx40.mcap"
    description = checkout / "configs" / "imports" / "tx40.yaml"
    assert (
        main(["import", str(description), "--data", str(shared_data / "tx40"), "--out", str(log)])
        == ExitCode.OK
    )
    return log.read_bytes()


@pytest.fixture
def copied_log(tmp_path: Path, tx40_log: bytes) -> Path:
    log = tmp_path / "tx40.mcap"
    log.write_bytes(tx40_log)
    return log


def test_no_output_over_an_input_or_another_file(
    copied_log: Path, tmp_path: Path, checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = copied_log.read_bytes()
    fixed = ["fit", str(copied_log), "--gains", "fixed", "--out"]
    assert main([*fixed, str(copied_log)]) == ExitCode.USAGE
    assert "one of the input files" in capsys.readouterr().err
    assert copied_log.read_bytes() == recording
    notes = tmp_path / "notes.txt"
    notes.write_text("mine")
    assert main([*fixed, str(notes)]) == ExitCode.USAGE
    assert notes.read_text() == "mine"
    cell = tmp_path / "cell.yaml"
    cell.write_bytes((checkout / "configs" / "cells" / "demo.yaml").read_bytes())
    assert main(["plan", str(cell), "--out", str(cell)]) == ExitCode.USAGE
    assert cell.read_bytes() == (checkout / "configs" / "cells" / "demo.yaml").read_bytes()


def test_an_earlier_calibration_and_its_certificate_may_be_replaced(
    copied_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "calibration.yaml"
    report = tmp_path / "report"
    fit = ["fit", str(copied_log), "--gains", "fixed", "--out", str(out), "--report", str(report)]
    for _ in range(2):
        assert main(fit) == ExitCode.OK
    said = capsys.readouterr()
    assert f"Written: {report}/" in said.out
    for file in (out, report / "report.html"):
        assert said.err.count(f"Replaced: {file} (of") == 1
    assert next_step(said.err.splitlines()[-1]) == "residual"
    assert "--gains fixed" in said.err.splitlines()[-1]
    page = (report / "report.html").read_text()
    assert all(f"{gain.value:.4g}" in page for gain in load_calibration(out).gains)
    (report / "report.html").write_text("mine")
    assert main(fit) == ExitCode.USAGE
    assert (report / "report.html").read_text() == "mine"


def test_one_recording_counts_once(
    copied_log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    twin = tmp_path / "twin.mcap"
    twin.write_bytes(copied_log.read_bytes())
    for arguments in ([str(copied_log), str(twin)], [str(copied_log), "--holdout", str(twin)]):
        assert main(["fit", *arguments, "--gains", "fixed"]) == ExitCode.DATA_UNFIT
        assert "the same recording" in capsys.readouterr().err


def test_the_demonstration_takes_no_other_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = tmp_path / "bare-1.mcap.part"
    recording.write_bytes(b"precious")
    assert main(["demo", "--out", str(tmp_path)]) == ExitCode.USAGE
    assert "no folder of a demonstration" in capsys.readouterr().err
    assert recording.read_bytes() == b"precious"
