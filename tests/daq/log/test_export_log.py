"""`drivegain export log`: a table with the numbers of the log, whole or not at all."""

from __future__ import annotations

import csv
import importlib
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daq.cli.app import main
from daq.errors import ExitCode
from daq.log.conversion import load_run
from daq.log.export import TableFormat, export_log
from daq.log.reader import BLOCK_SAMPLES
from daq.log.writer import LogWriter
from drivers.messages import CellEvent, EventKind, Quantity, Sample, SlowReading
from tests.daq.command_line import run_verb
from tests.daq.logs import START_NS, demo_content, joints, samples, write

ROWS = 2 * BLOCK_SAMPLES + 100
"""Three blocks."""


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory, checkout: Path) -> Path:
    """Slow motion of six axes, two moves, one answer missing."""
    rng = np.random.default_rng(3)
    steps = rng.integers(-20, 20, size=(ROWS, 6))
    counts = np.cumsum(steps, axis=0)
    rows = samples(counts.tolist())
    rows[7] = replace(rows[7], missing=0b100)
    moves = []
    for number, at in ((0, 5), (1, 5000)):
        time_ns = START_NS + at * 1_000_000
        moves.append(CellEvent(time_ns, None, EventKind.MOVE_START, number, ""))
    path = tmp_path_factory.mktemp("log") / "bare.mcap"
    return write(path, demo_content(checkout), rows, moves)


def _table(path: Path) -> dict[str, list[str]]:
    with path.open(encoding="utf-8", newline="") as stream:
        header, *rows = csv.reader(stream)
    return dict(zip(header, map(list, zip(*rows, strict=True)), strict=True))


def _numbers(column: Sequence[str]) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array([float(text) for text in column])


@pytest.mark.slow
def test_csv_has_the_numbers_that_a_fit_gets(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "bare.csv"
    assert main(["export", "log", str(log), "--csv", "--out", str(out), "--json"]) == ExitCode.OK
    said = json.loads(capsys.readouterr().out)
    table = _table(out)
    run, _ = load_run(log)
    expected = (ROWS, list(table), True)
    assert (said["rows"], said["columns"], said["valid"]) == expected
    assert list(table)[:4] == ["cycle", "time_ns", "time_s", "move"]
    assert list(table)[4:10] == [
        f"J1.{name}"
        for name in (
            "position_rad",
            "current_A",
            "motor_counts",
            "current_raw",
            "statusword",
            "answered",
        )
    ]
    # repr gives back the very numbers.
    for index in range(6):
        column = table[f"J{index + 1}.position_rad"]
        assert (_numbers(column) == run.position_rad[:, index]).all()
        assert (_numbers(table[f"J{index + 1}.current_A"]) == run.current_a[:, index]).all()
    assert run.move is not None
    assert (_numbers(table["move"]) == run.move).all()
    rows = [row for row, text in enumerate(table["J3.answered"]) if text == "0"]
    assert rows == [7]
    assert set(table["J2.answered"]) == {"1"}
    assert [int(text) for text in table["time_ns"][:2]] == [START_NS, START_NS + 1_000_000]
    j6_statusword = set(table["J6.statusword"])
    assert j6_statusword == {str(0x1237)}
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.slow
def test_a_counter_that_wraps_goes_on_from_block_to_block(tmp_path: Path, checkout: Path) -> None:
    step = 2**20
    true = [step * row for row in range(ROWS)]
    rows = [[(count + 2**31) % 2**32 - 2**31] * 6 for count in true]
    bare = [
        Sample(10 + k, START_NS + k * 1_000_000, tuple(row), (0,) * 6, (0,) * 6, 0)
        for k, row in enumerate(rows)
    ]
    path = tmp_path / "wrapping.mcap"
    log = write(path, demo_content(checkout), bare)
    export_log(log, tmp_path / "out.csv", TableFormat.CSV)
    out_path = tmp_path / "out.csv"
    j4_motor_counts = _table(out_path)["J4.motor_counts"]
    assert [int(text) for text in j4_motor_counts] == true


@pytest.mark.slow
def test_torques_and_temperatures_are_in_the_row_of_their_sync(
    tmp_path: Path, checkout: Path
) -> None:
    """Also where blocks meet, and before and after the samples."""
    path = tmp_path / "warm.mcap"
    last = START_NS + (ROWS - 1) * 1_000_000
    edge = START_NS + (BLOCK_SAMPLES - 1) * 1_000_000 + 500_000
    with LogWriter(path, demo_content(checkout), joints, clock_ns=lambda: 0) as log:
        for time_ns, value in ((START_NS - 5, 20.0), (last + 10**9, 21.0)):
            slow_reading = SlowReading(time_ns, 2, Quantity.TEMPERATURE, value)
            log.reading(slow_reading)
        for time_ns, value in ((START_NS + 3_999_999, 0.5), (edge, 0.75)):
            log.reading(SlowReading(time_ns, 0, Quantity.TORQUE, value))
        rows = [[0] * 6] * ROWS
        for sample in samples(rows):
            log.write(sample)
        log.conclude(True)
    export_log(path, tmp_path / "warm.csv", TableFormat.CSV)
    table = _table(tmp_path / "warm.csv")
    found = {}
    for name in list(table)[-2:]:
        found[name] = {row: text for row, text in enumerate(table[name]) if text}
    expected = {
        "J1.motor_torque_Nm": {3: "0.5", BLOCK_SAMPLES - 1: "0.75"},
        "J3.temperature_degC": {0: "20.0", ROWS - 1: "21.0"},
    }
    assert found == expected


@pytest.mark.slow
def test_parquet_has_the_same_columns(log: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow", reason="the optional extra `parquet`")
    parquet: Any = importlib.import_module("pyarrow.parquet")
    export_log(log, tmp_path / "bare.csv", TableFormat.CSV)
    export_log(log, tmp_path / "bare.parquet", TableFormat.PARQUET)
    read = parquet.read_table(tmp_path / "bare.parquet")
    table = _table(tmp_path / "bare.csv")
    assert read.column_names == list(table)
    for name, column in table.items():
        assert (read[name].to_numpy() == _numbers(column)).all()


def test_without_its_package_parquet_says_what_to_install(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("daq.log.export.find_spec", lambda _name: None)
    code = run_verb("export", "log", log, "--parquet", "--out", tmp_path / "x")
    assert code == ExitCode.CONFIGURATION
    assert "drivegain[parquet]" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kinds", [[], ["--csv", "--parquet"]])
def test_one_kind_of_table_must_be_chosen(
    log: Path, tmp_path: Path, kinds: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    code = run_verb("export", "log", log, *kinds, "--out", tmp_path / "x")
    assert code == ExitCode.USAGE
    assert "one of them" in capsys.readouterr().err


def test_a_damaged_log_leaves_nothing_behind_and_nothing_is_overwritten(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = bytearray(log.read_bytes())
    data[len(data) // 2] ^= 1
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(data)
    out = tmp_path / "out.csv"
    assert run_verb("export", "log", damaged, "--csv", "--out", out) == ExitCode.DATA_UNFIT
    assert sorted(tmp_path.iterdir()) == [damaged]
    out.write_text("mine")
    assert run_verb("export", "log", log, "--csv", "--out", out) == ExitCode.USAGE
    assert out.read_text() == "mine"
    missing = tmp_path / "absent" / "out.csv"
    assert run_verb("export", "log", log, "--csv", "--out", missing) == ExitCode.UNEXPECTED
    assert "expected: a folder that is there" in capsys.readouterr().err


def test_an_invalid_log_is_exported_and_called_invalid(
    tmp_path: Path, checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bad.mcap"
    log = write(
        path,
        demo_content(checkout),
        samples([[0] * 6] * 3),
        verdict=(False, "2 late answers"),
    )
    code = run_verb("export", "log", log, "--csv", "--out", tmp_path / "bad.csv")
    assert code == ExitCode.OK
    assert "INVALID: 2 late answers" in capsys.readouterr().err


def test_a_link_in_the_place_of_the_unfinished_table_is_not_followed(
    log: Path, tmp_path: Path
) -> None:
    target = tmp_path / "elsewhere"
    target.write_text("mine")
    (tmp_path / "bare.csv.part").symlink_to(target)
    rows = export_log(log, tmp_path / "bare.csv", TableFormat.CSV).rows
    assert rows == ROWS
    assert target.read_text() == "mine"
    assert not (tmp_path / "bare.csv").is_symlink()
