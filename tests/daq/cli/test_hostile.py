"""Inputs of an attacker and of a dying disk, and the messages that they cause."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from daq.cli.app import main
from daq.cli.failure import ErrorParts, show_failure
from daq.config.yaml_file import MAX_EXPLAINED, StrictModel, parse_yaml, read_model
from daq.errors import ExitCode, OutputFailed, SchemaMismatch
from daq.log.metadata import (
    RunStatistics,
    readback_from_bytes,
    run_from_record,
    run_record,
    statistics_from_record,
    statistics_record,
)
from daq.log.writer import LogWriter
from drivers.errors import DriveFault
from tests.daq.command_line import run_verb
from tests.daq.logs import DISC, content, demo_content, joints, samples, write


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("payload_known", '{"m": [1]}'),
        ("payload_known", '{"m": NaN}'),
        ("payload_known", '{"m": -4.59}'),
        ("payload_known", '{"m": 0}'),
        ("payload_known", '{"m": {"m": 1}}'),
        ("payload_known", '{"m": null}'),
        ("payload_known", '{"m": true}'),
        ("payload_known", '{"m": "4.59"}'),
        ("payload_known", '{"m": 1' + 400 * "0" + "}"),
        ("started_wall_ns", "-99999999999999999999999"),
        ("started_wall_ns", "9" * 40),
        ("rate_hz", "nan"),
    ],
)
def test_hostile_metadata_is_a_value_error(key: str, value: str) -> None:
    info = content(6, DISC).run
    record = run_record(info)
    assert run_from_record(record).payload == DISC
    with pytest.raises(ValueError, match=r".+"):
        run_from_record({**record, key: value})


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("samples", "-1"),
        ("samples", "9" * 30),
        ("lost_cycles", "-3"),
        ("missing", "[-1, 0]"),
        ("missing", "[true, 0]"),
        ("missing", "[0, 0.5]"),
        ("missing", "[101, 0]"),
        ("missing", "[1" + 400 * "0" + ", 0]"),
        ("valid", '"yes"'),
    ],
)
def test_hostile_counts_are_a_value_error(key: str, value: str) -> None:
    statistics = RunStatistics(100, 2, (0, 3), valid=True)
    record = statistics_record(statistics)
    assert statistics_from_record(record) == statistics
    with pytest.raises(ValueError, match=r".+"):
        statistics_from_record({**record, key: value})


@pytest.mark.parametrize(
    "number", ["0", "-1e-9", "NaN", "Infinity", "1" + 400 * "0", "true", "null", '"1"']
)
def test_a_hostile_quantum_is_a_value_error(number: str) -> None:
    text = '{"axes": [{"name": "J1", "current_per_unit": %s}]}'
    readback = readback_from_bytes((text % "0.002").encode())
    assert readback.axes[0].current_per_unit == 0.002
    with pytest.raises(
        ValueError,
        match=r"current_per_unit is .+, expected "
        r".*(number|greater than 0)",
    ):
        readback_from_bytes((text % number).encode())


@pytest.mark.parametrize(
    ("statistics", "says"),
    [
        ({"samples": "7"}, "7, as its recorder counted"),
        ({"missing": "[0, 0]"}, "losses of 2 axes"),
        ({"missing": "[0, 0, 0, 0, 0, -1]"}, "drivegain.statistics"),
    ],
)
def test_info_refuses_the_counts_that_a_fit_refuses(
    statistics: dict[str, str],
    says: str,
    checkout: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    genuine = statistics_record
    monkeypatch.setattr(
        "daq.log.writer.statistics_record", lambda given: {**genuine(given), **statistics}
    )
    path = tmp_path / "a.mcap"
    log = write(path, demo_content(checkout), samples([[k] * 6 for k in range(300)]))
    assert run_verb("info", log, "--json") == ExitCode.DATA_UNFIT
    output = capsys.readouterr()
    assert output.out == ""
    assert says in output.err


def test_very_many_unknown_keys_are_counted_and_not_all_explained() -> None:
    class Small(StrictModel):
        name: str

    keys = "\n".join(f"key{number}: 1" for number in range(20_000))
    text = f"name: x\n{keys}".encode()
    with pytest.raises(SchemaMismatch, match=f"{20_000 - MAX_EXPLAINED} more faults"):
        read_model(parse_yaml(text, "file.yaml"), Small)


def test_a_disk_that_is_full_from_the_start_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = OSError(28, os.strerror(28))
    path = tmp_path / "run.mcap"

    def refuse(*_: object) -> None:
        raise full

    class FullStream:
        write = flush = close = fileno = staticmethod(refuse)

        def tell(self) -> int:
            return 0

    real_open = Path.open

    def open_part(self: Path, mode: str = "r", *_: object) -> object:
        real_open(self, "xb").close()
        return FullStream()

    monkeypatch.setattr(Path, "open", open_part)
    with (
        pytest.raises(OutputFailed, match="no space left"),
        LogWriter(path, content(2), joints, lambda: 0),
    ):
        pytest.fail("the writer opened on a full disk")
    assert list(tmp_path.iterdir()) == []


def test_a_stop_that_was_not_confirmed_is_shouted(capsys: pytest.CaptureFixture[str]) -> None:
    error = DriveFault(3, "fault")
    error.add_note("while stopping: node 3: object 6041h:00: no answer")
    failure = ErrorParts.of(error)
    show_failure(failure, json_wanted=False)
    # It was stopped, and confirmed by other means
    assert "emergency stop" not in capsys.readouterr().err
    error.add_note("not confirmed without power: node 3")
    show_failure(ErrorParts.of(error), json_wanted=False)
    output = capsys.readouterr().err
    assert "node 3: object 6041h:00: no answer" in output
    assert "emergency stop" in output
    assert "all axes were stopped" not in output


def test_a_stop_that_was_confirmed_is_not(capsys: pytest.CaptureFixture[str]) -> None:
    failure = ErrorParts.of(DriveFault(3, "fault"))
    show_failure(failure, json_wanted=False)
    assert "emergency" not in capsys.readouterr().err


def test_an_unwritable_standard_output_is_no_traceback(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: object) -> None:
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr("daq.log.importing.import_recording", lambda *_, **__: full(None))
    code = run_verb("import", "x.yaml", "--data", ".", "--out", "y.mcap")
    assert code == ExitCode.UNEXPECTED
    assert "no space left" in capsys.readouterr().err


@pytest.mark.parametrize("verb", ["fit", "residual"])
@pytest.mark.parametrize("name", ["report.html", "residual.json"])
def test_a_calibration_is_no_file_of_the_report(
    verb: str, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The one that is written last would replace the other."""
    folder = tmp_path / "report"
    folder.mkdir()
    words = [verb, str(tmp_path / "no.mcap"), "--out", str(folder / name), "--report", str(folder)]
    assert main(words) == ExitCode.USAGE
    assert "a file of the report as --out" in capsys.readouterr().err
    assert not list(folder.iterdir())


@pytest.mark.parametrize("verb", ["fit", "residual"])
@pytest.mark.parametrize("other", ["--report", "--pictures"])
def test_one_name_for_two_outputs_is_refused_before_any_log_is_read(
    verb: str, other: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    same = str(tmp_path / "same")
    code = run_verb(verb, tmp_path / "no.mcap", "--out", same, other, same)
    assert code == ExitCode.USAGE
    error_output = capsys.readouterr().err
    assert f"the same name for --out and {other}" in error_output
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("verb", ["fit", "residual"])
def test_a_missing_folder_is_named_before_any_log_is_read(
    verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = run_verb(verb, tmp_path / "no.mcap", "--out", tmp_path / "missing/c.yaml")
    assert code == ExitCode.UNEXPECTED
    assert "no such folder" in capsys.readouterr().err
