"""The rest of a killed recording is salvaged, marked partial, and never written to a controller."""

from __future__ import annotations

import fcntl
import hashlib
import json
import logging
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import yaml

from daq.cli.app import main
from daq.documents.calibration_file import (
    as_document,
    decode_calibration,
    encode_calibration,
    save_calibration,
)
from daq.errors import (
    ExitCode,
    LogCorrupt,
    LogIncomplete,
    LogMissing,
    LogUnreadable,
    OutputFailed,
    UsageError,
)
from daq.log.conversion import load_run
from daq.log.metadata import SEAL, sealed, unsealed
from daq.log.reader import LogReader, SampleBlock, read_log
from daq.log.salvage import salvage
from daq.log.writer import LogWriter
from daq.workflow.fit import LogLoader
from daq.writeback.gates.gate import Gate, GateContext
from daq.writeback.gates.table import check_gates
from daq.writeback.request import Edit, Request
from drivers.messages import CellEvent, EventKind, Quantity, SlowReading
from tests.daq.calibrations import demo_calibration
from tests.daq.logs import DISC, START_NS, demo_content, joints, rising_counts, samples, write

ROWS = samples(rising_counts(700, 6))
MOVES = [
    CellEvent(START_NS + 50_000_000 * k, None, EventKind.MOVE_START, k, f"move {k}")
    for k in range(3)
]

READINGS = [
    SlowReading(START_NS + 300_000_000 * k, 2, Quantity.TEMPERATURE, 25.0 + k) for k in range(2)
]


@pytest.fixture
def part(tmp_path: Path, checkout: Path) -> Path:
    """Return the `.part` of a recording of 700 samples that failed:
    all of it, because the writer caught the error.
    """
    return _broken_off(tmp_path / "run.mcap", checkout)


def _broken_off(path: Path, checkout: Path, *events: CellEvent) -> Path:
    with (
        pytest.raises(RuntimeError),
        LogWriter(path, demo_content(checkout, DISC), joints, clock_ns=lambda: 0) as log,
    ):
        for event in (*MOVES, *events):
            log.event(event)
        log.readings(READINGS)
        for sample in ROWS:
            log.write(sample)
        raise RuntimeError("gone")
    return log.part


def _same(found: SampleBlock, count: int) -> bool:
    cycles = [s.cycle for s in ROWS[:count]]
    cycle = np.array(cycles, dtype=np.uint64)
    position_counts = np.array([s.position_counts for s in ROWS[:count]], dtype=np.int32)
    current_raw = np.array([s.current_raw for s in ROWS[:count]], dtype=np.int32)
    statuswords = [s.statusword for s in ROWS[:count]]
    statusword = np.array(statuswords, dtype=np.uint16)
    missing = np.array([s.missing for s in ROWS[:count]], dtype=np.uint32)
    time_ns = np.array([s.time_ns for s in ROWS[:count]])
    wanted = SampleBlock(
        cycle,
        time_ns,
        position_counts,
        current_raw,
        statusword,
        missing,
    )
    return all(
        np.array_equal(getattr(found, name), getattr(wanted, name))
        for name in SampleBlock.__slots__
    )


def test_what_was_recorded_comes_back_and_is_labelled(part: Path, tmp_path: Path) -> None:
    before = part.read_bytes()
    saved = salvage(part, tmp_path / "saved.mcap")
    assert part.read_bytes() == before
    log = read_log(saved.log)
    assert _same(log.samples, 700)
    assert log.events == tuple(MOVES)
    assert log.readings == tuple(READINGS)
    assert log.partial
    assert (log.statistics.valid, log.statistics.samples) == (True, 700)
    assert log.head.run.payload == DISC
    assert log.head.run.origin == "recorded; salvaged from run.mcap.part"
    assert log.head.files["robot.urdf"]
    assert saved.left_out_bytes == 0


def test_at_most_the_last_150_ms_are_not_on_disk_when_a_recorder_is_killed(
    tmp_path: Path, checkout: Path
) -> None:
    """Whatever the writer has been given, the file alone gives back all but less than 150 samples
    of 1 ms.
    """
    content = demo_content(checkout)
    path = tmp_path / "run.mcap"
    with LogWriter(path, content, joints, clock_ns=lambda: 0) as log:
        for number, sample in enumerate(ROWS, start=1):
            log.write(sample)
            if number in {2, 3, 151, 152, 153, 400, 699}:
                copy = shutil.copy(log.part, tmp_path / f"{number}.mcap.part")
                saved = salvage(Path(copy), tmp_path / f"{number}.mcap.saved")
                assert number - 150 <= saved.statistics.samples < number
                assert _same(read_log(saved.log).samples, saved.statistics.samples)


@pytest.mark.slow
def test_a_process_that_is_killed_loses_no_more(tmp_path: Path, checkout: Path) -> None:
    """The promise itself: SIGKILL, from the process's own hand so that what it had written is
    known.
    """
    out = tmp_path / "run.mcap"
    script = (
        "import os, signal, sys; from pathlib import Path; from daq.log.writer import LogWriter\n"
        "from tests.daq.logs import demo_content, joints, samples\n"
        f"log = LogWriter(Path({str(out)!r}), demo_content(Path({str(checkout)!r})), joints, "
        "clock_ns=lambda: 0)\n"
        "log.__enter__()\n"
        "for row in samples([[100 * k + axis for axis in range(6)] for k in range(437)]): "
        "log.write(row)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=checkout, check=False)
    assert done.returncode == -9
    damaged = tmp_path / "run.mcap.part"
    saved = salvage(damaged, tmp_path / "saved.mcap")
    assert 437 - 150 <= saved.statistics.samples <= 437
    assert _same(read_log(saved.log).samples, saved.statistics.samples)


@pytest.mark.slow
def test_every_cut_gives_a_beginning_or_a_named_error(part: Path, tmp_path: Path) -> None:
    data = part.read_bytes()
    counts = []
    for size in range(0, len(data), 997):
        cut = tmp_path / "cut.mcap.part"
        out = tmp_path / "saved.mcap"
        cut.write_bytes(data[:size])
        out.unlink(missing_ok=True)
        try:
            counts.append(salvage(cut, out).statistics.samples)
        except LogUnreadable:
            counts.append(0)
            assert not out.exists()
            continue
        assert _same(read_log(out).samples, counts[-1])
    assert counts == sorted(counts)
    assert {0, 1, 151} <= set(counts)
    assert not (tmp_path / "saved.mcap.part").exists()


def test_the_damaged_end_of_a_finished_log_is_left_out(tmp_path: Path, checkout: Path) -> None:
    path = tmp_path / "whole.mcap"
    content = write(path, demo_content(checkout), ROWS).read_bytes()
    data = bytearray(content)
    reader = LogReader(tmp_path / "whole.mcap")
    list(reader.until_damage())
    data[reader.whole_bytes * 3 // 4] ^= 1
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(data)
    with pytest.raises(LogCorrupt):
        read_log(broken)
    saved = salvage(broken, tmp_path / "saved.mcap")
    assert 0 < saved.statistics.samples < 700
    assert _same(read_log(saved.log).samples, saved.statistics.samples)
    assert 0 < saved.left_out_bytes < len(data)
    assert "checksum" in saved.damage


def test_damage_is_described_where_the_recording_is_cut_and_not_where_its_summary_is(
    tmp_path: Path, checkout: Path
) -> None:
    path = write(tmp_path / "whole.mcap", demo_content(checkout), ROWS)
    reader = LogReader(path)
    list(reader.until_damage())
    end_of_records = reader.whole_bytes
    content = path.read_bytes()
    # The closing mark is behind these bytes: this file ends between two records.
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(content[:end_of_records])
    saved_of_cut = salvage(cut, tmp_path / "saved-cut.mcap")
    assert saved_of_cut.statistics.samples == len(ROWS)
    assert saved_of_cut.damage.startswith(f"{cut}: {end_of_records} bytes without the closing mark")
    without_summary = tmp_path / "without-summary.mcap"
    without_summary.write_bytes(content[:-20])
    saved = salvage(without_summary, tmp_path / "saved.mcap")
    assert saved.statistics.samples == len(ROWS)
    assert (saved.damage, saved.left_out_bytes) == ("", 0)


def test_a_whole_log_needs_no_salvage(tmp_path: Path, checkout: Path) -> None:
    path = tmp_path / "whole.mcap"
    damaged = write(path, demo_content(checkout), ROWS[:5])
    with pytest.raises(UsageError, match="a whole log"):
        salvage(
            damaged,
            tmp_path / "saved.mcap",
        )


def test_a_recorder_that_died_before_it_gave_the_log_its_name(
    tmp_path: Path, checkout: Path
) -> None:
    """Its own verdict is kept; that the log is partial is kept too,
    because the reason of its death is unknown.
    """
    part = tmp_path / "run.mcap.part"
    path = tmp_path / "whole.mcap"
    write(path, demo_content(checkout), ROWS, verdict=(False, "3 late answers")).rename(part)
    assert read_log(part).partial
    log_path = salvage(part, tmp_path / "saved.mcap").log
    log = read_log(log_path)
    assert (log.partial, log.statistics.valid, log.statistics.reason) == (
        True,
        False,
        "3 late answers",
    )


def test_a_running_recording_is_left_alone(part: Path, tmp_path: Path) -> None:
    with part.open("rb") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        with pytest.raises(UsageError, match="still runs"):
            salvage(part, tmp_path / "saved.mcap")
    salvage(part, tmp_path / "saved.mcap")


def test_the_writer_holds_that_lock(tmp_path: Path, checkout: Path) -> None:
    path = tmp_path / "run.mcap"
    with LogWriter(path, demo_content(checkout), joints, clock_ns=lambda: 0) as log:
        log.write(ROWS[0])
        log.flush()
        with pytest.raises(UsageError, match="still runs"):
            salvage(log.part, tmp_path / "saved.mcap")


def test_the_name_of_the_whole_recording_is_not_taken(part: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"run-partial\.mcap"):
        salvage(part, tmp_path / "run.mcap")
    (tmp_path / "there.mcap").touch()
    with pytest.raises(UsageError, match="a file of that name"):
        salvage(part, tmp_path / "there.mcap")


def test_nothing_can_be_saved_of_nothing(tmp_path: Path, checkout: Path) -> None:
    empty = tmp_path / "empty.mcap.part"
    empty.touch()
    with pytest.raises(LogIncomplete, match="no samples") as refused:
        salvage(empty, tmp_path / "saved.mcap")
    assert "salvage" not in refused.value.remedy  # it is what has just been tried
    path = tmp_path / "none.mcap"
    write(path, demo_content(checkout), []).rename(tmp_path / "none.mcap.part")
    damaged = tmp_path / "none.mcap.part"
    with pytest.raises(LogIncomplete, match="no samples"):
        salvage(damaged, tmp_path / "saved.mcap")


@pytest.mark.parametrize(
    ("kind", "valid"),
    [(EventKind.EMCY, False), (EventKind.HEARTBEAT_LOST, False), (EventKind.STOP, True)],
)
def test_a_recording_that_ended_in_a_fault_is_invalid_too(
    kind: EventKind, valid: bool, tmp_path: Path, checkout: Path
) -> None:
    fault = CellEvent(START_NS, 2, kind, 0x8130, "node 3")
    path = tmp_path / "run.mcap"
    damaged = _broken_off(path, checkout, fault)
    saved = salvage(damaged, tmp_path / "saved.mcap")
    assert saved.statistics.valid is valid
    assert ("node 3" in saved.statistics.reason) is not valid


@pytest.mark.parametrize("key", ["payload_known", "started_wall_ns", "operator", SEAL])
def test_metadata_of_a_log_without_its_end_are_under_a_seal_of_their_own(
    key: str, part: Path, tmp_path: Path
) -> None:
    """The payload's mass scales every gain, and no chunk covers it."""
    record: dict[str, str] = {
        "payload_known": '{"m": 4.59}',
        "started_wall_ns": "1",
        "operator": "Ada",
    }
    whole = sealed(record)
    assert unsealed(whole) == record
    with pytest.raises(ValueError, match="sealed with"):
        unsealed({**whole, key: whole[key] + "1"})
    data = part.read_bytes()
    part.write_bytes(data.replace(b'{"m": 4.59}', b'{"m": 5.59}'))
    assert part.read_bytes() != data
    with pytest.raises(LogUnreadable):
        salvage(part, tmp_path / "saved.mcap")
    part.write_bytes(data.replace(SEAL.encode(), b"crc33"))
    with pytest.raises(LogUnreadable, match="without a seal"):
        salvage(part, tmp_path / "saved.mcap")


def test_the_reader_is_reported_and_the_calibration_says_so(
    part: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    saved = salvage(part, tmp_path / "saved.mcap").log
    with caplog.at_level(logging.WARNING, logger="drivegain"):
        run, _ = load_run(saved)
    assert run.partial
    assert "saved.mcap is PARTIAL" in caplog.text
    reading = LogLoader.of([saved], None)
    list(reading.runs([saved], "fit"))
    assert [(source.name, source.partial) for source in reading.sources] == [("saved", True)]


def test_nothing_of_it_reaches_a_controller() -> None:
    good = demo_calibration()
    changed_source = replace(good.sources[1], partial=True)
    sources = (good.sources[0], changed_source)
    partial = replace(good, sources=sources)
    again = decode_calibration(encode_calibration(partial), "calibration.yaml")
    assert again == partial
    edit = Edit(subject="", before=b"", after=b"")
    now = datetime(2025, 1, 2, tzinfo=UTC)
    request = Request(good, now)
    context = GateContext(request, edit)
    assert not check_gates(context)
    gate_context = GateContext(Request(again, now), edit)
    gates = [refusal.gate for refusal in check_gates(gate_context)]
    assert gates == [Gate.PARTIAL]
    assert [source["partial"] for source in as_document(again)["sources"]] == [False, True]


def test_calibrations_of_earlier_versions_have_no_partial_sources() -> None:
    document = yaml.safe_load(encode_calibration(demo_calibration()))
    for source in document["sources"]:
        del source["partial"]
    text = json.dumps(document["sources"], sort_keys=True, separators=(",", ":"))
    document["digests"]["sources"] = hashlib.sha256(text.encode()).hexdigest()
    content = yaml.safe_dump(document, sort_keys=False).encode()
    assert decode_calibration(content, "calibration.yaml") == demo_calibration()


def test_apply_ends_with_3(
    tmp_path: Path, checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good = demo_calibration()
    changed_source = replace(good.sources[0], partial=True)
    sources = (changed_source,)
    calibration = replace(good, sources=sources)
    save_calibration(
        calibration,
        tmp_path / "calibration.yaml",
    )
    cell = str(checkout / "configs/cells/demo.yaml")
    command = [
        "apply",
        str(tmp_path / "calibration.yaml"),
        "--cell",
        cell,
        "--configuration-changed",
    ]
    assert main(command) == ExitCode.CALIBRATION_REFUSED
    error_output = capsys.readouterr().err
    assert "never finished" in " ".join(error_output.split())


def test_the_verb(part: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "saved.mcap"
    assert main(["info", str(part)]) == ExitCode.DATA_UNFIT
    assert "drivegain salvage" in capsys.readouterr().err
    assert main(["salvage", str(part), "--out", str(out), "--json"]) == ExitCode.OK
    document = json.loads(capsys.readouterr().out)
    expected = (700, True, True, 0)
    assert (
        document["samples"],
        document["partial"],
        document["valid"],
        document["left_out_bytes"],
    ) == expected
    assert main(["info", str(out), "--json"]) == ExitCode.OK
    printed = capsys.readouterr().out
    assert json.loads(printed)["partial"] is True
    assert main(["salvage", str(part), "--out", str(out)]) == ExitCode.USAGE


@pytest.mark.parametrize("what", ["device", "pipe"])
def test_a_log_that_is_no_regular_file_is_refused(what: str, tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    if what == "device":
        log.symlink_to("/dev/null")
    else:
        os.mkfifo(log)
    with pytest.raises(LogMissing, match="no regular file"):
        read_log(log)
    with pytest.raises(LogMissing, match="no regular file"):
        salvage(log, tmp_path / "saved.mcap")


def test_a_salvage_that_cannot_write_does_not_ask_for_a_recording(
    part: Path, tmp_path: Path
) -> None:
    saved_path = tmp_path / "none" / "saved.mcap"
    with pytest.raises(OutputFailed, match="nothing was written") as caught:
        salvage(part, saved_path)
    assert "record again" not in str(caught.value)


def test_an_empty_file_is_called_empty(tmp_path: Path) -> None:
    """It was "8 bytes, whole records up to 8"."""
    damaged = tmp_path / "run.mcap.part"
    damaged.write_bytes(b"")
    with pytest.raises(LogUnreadable, match=r"found 0 bytes .*no samples"):
        salvage(damaged, tmp_path / "saved.mcap")
    assert not (tmp_path / "saved.mcap").exists()
