"""Every verb judges a log alike, and each is bounded:
a log with right checksums may still be made up.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.opcode import Opcode

from daq.cli.app import main
from daq.config.cell import Cell
from daq.errors import DataError, ExitCode, LogIncomplete, LogUnreadable
from daq.log.bag_writer import export_bag
from daq.log.container import RECORDS
from daq.log.conversion import load_run
from daq.log.export import TableFormat, column_names, export_log
from daq.log.message import event_bytes
from daq.log.metadata import (
    READBACK,
    RUN,
    STATISTICS,
    RunStatistics,
    readback_bytes,
    run_record,
    sealed,
    statistics_record,
)
from daq.log.reader import BLOCK_SAMPLES, LARGEST_ENTRIES, LogReader, read_log
from daq.log.salvage import salvage
from daq.report.log import info_report
from drivers.messages import CellEvent, EventKind
from tests.daq.log.records import (
    HEADER,
    TOPICS,
    attachment_record,
    chunk_record,
    finished_file,
    metadata_record,
    raw_record,
    sample_records,
)
from tests.daq.logs import START_NS, demo_content

SAMPLES = 300
CHUNK_SAMPLES = 50
FIRST_CYCLE = 10
ATTACKER_DIGITS = "1" + 400 * "0"
LONG_TEXT_BYTES = 30_000_000
EVENT_CHANNEL = 2  #: in TOPICS
UNKNOWN_CHANNEL = 9
UNKNOWN_OPCODE = 0x80


def _cycles(count: int = SAMPLES) -> list[int]:
    return list(range(FIRST_CYCLE, FIRST_CYCLE + count))


def _times_ns(count: int = SAMPLES, start_ns: int = START_NS) -> list[int]:
    """Stamps at 1 kHz."""
    end_ns = start_ns + count * 1_000_000
    return list(range(start_ns, end_ns, 1_000_000))


@dataclass
class MadeUp:
    """A log of the demo cell at rest, 6 chunks of 50 samples at 1 kHz, for a test to change."""

    checkout: Path
    cycle: list[int] = field(default_factory=_cycles)
    time_ns: list[int] = field(default_factory=_times_ns)
    extra: list[bytes] = field(default_factory=list)  #: records before the samples
    after: list[bytes] = field(default_factory=list)  #: records behind the samples
    run: dict[str, str] = field(default_factory=dict)  #: entries instead of the genuine ones
    statistics: dict[str, str] = field(default_factory=dict)
    readback: bytes | None = None

    def cut(self, first: int, last: int) -> None:
        """Leave out some samples."""
        del self.cycle[first:last]
        del self.time_ns[first:last]

    def repeat(self, first: int, last: int) -> None:
        """Write some samples twice."""
        for column in (self.cycle, self.time_ns):
            column[last:last] = column[first:last]

    def counted(self, lost: int = 0) -> None:
        """Make the recorder's counts fit the samples."""
        self.statistics["samples"] = str(len(self.cycle))
        self.statistics["lost_cycles"] = str(lost)

    def write(self, path: Path) -> Path:
        """The file, with right checksums."""
        content = demo_content(self.checkout)
        readback = self.readback or readback_bytes(content.readback)
        run = run_record(content.run) | self.run
        no_missing = (0,) * 6
        genuine = RunStatistics(SAMPLES, lost_cycles=0, missing=no_missing, valid=True)
        statistics = statistics_record(genuine) | self.statistics
        records = [HEADER]
        for name, data in content.files.items():
            records.append(attachment_record(name, data))
        records.append(attachment_record(READBACK, readback))
        records.append(metadata_record(RUN, sealed(run)))
        records += self.extra
        records += self._chunks()
        records.append(metadata_record(STATISTICS, sealed(statistics)))
        records += self.after
        return finished_file(path, records)

    def _chunks(self) -> Iterator[bytes]:
        for first in range(0, len(self.cycle), CHUNK_SAMPLES):
            last = first + CHUNK_SAMPLES
            cycle = self.cycle[first:last]
            time_ns = self.time_ns[first:last]
            samples = sample_records(cycle, time_ns)
            yield chunk_record(TOPICS + samples)


@pytest.fixture
def made(checkout: Path) -> MadeUp:
    """A sound log, not yet written."""
    return MadeUp(checkout)


def _read(log: Path, _: Path) -> None:
    read_log(log)


def _info(log: Path, _: Path) -> None:
    info_report(log)


def _load(log: Path, _: Path) -> None:
    load_run(log)


def _export_table(log: Path, folder: Path) -> None:
    export_log(log, folder / "table.csv", TableFormat.CSV)


def _export_bag(log: Path, folder: Path) -> None:
    export_bag(log, folder / "bag")


#: What reads a log; an export goes into the folder
READERS: dict[str, Callable[[Path, Path], None]] = {
    "read": _read,
    "info": _info,
    "fit and validate": _load,
    "export log": _export_table,
    "export bag": _export_bag,
}


@pytest.mark.parametrize("reader", READERS)
def test_the_log_that_the_others_are_made_of_is_sound(
    reader: str, made: MadeUp, tmp_path: Path
) -> None:
    log = made.write(tmp_path / "a.mcap")
    READERS[reader](log, tmp_path)
    assert info_report(log).valid


@pytest.mark.parametrize("start_ns", [0, START_NS])
def test_a_log_of_several_blocks_lasts_from_its_first_stamp_on(
    start_ns: int, checkout: Path, tmp_path: Path
) -> None:
    count = 2 * BLOCK_SAMPLES
    cycles = list(range(count))
    made = MadeUp(checkout, cycles, _times_ns(count, start_ns))
    made.counted()
    log = made.write(tmp_path / "a.mcap")
    described = info_report(log)
    duration_s = (count - 1) * 1e-3
    assert described.samples == count
    assert described.stamped_duration_s == pytest.approx(duration_s)


Change = Callable[[MadeUp], None]


def _cut_out(made: MadeUp) -> None:
    made.cut(50, 250)


def _cut_and_counted(made: MadeUp) -> None:
    made.cut(100, 200)
    made.counted()


def _without_samples(made: MadeUp) -> None:
    made.cut(0, SAMPLES)


def _lost_cycles(made: MadeUp) -> None:
    made.cut(100, 200)


def _chunk_twice(made: MadeUp) -> None:
    made.repeat(100, 150)


def _renumbered(made: MadeUp) -> None:
    made.cut(100, 200)
    made.cycle = _cycles(len(made.cycle))


def _counted_missing(made: MadeUp) -> None:
    made.statistics["missing"] = "[0, 1, 0, 0, 0, 0]"


def _second_readback(made: MadeUp) -> None:
    record = attachment_record(READBACK, b'{"axes": []}')
    made.extra.append(record)


def _second_run(made: MadeUp) -> None:
    run = sealed({"rate_hz": "1"})
    made.extra.append(metadata_record(RUN, run))


def _second_summary(made: MadeUp) -> None:
    statistics = sealed({"valid": "true"})
    made.after.append(metadata_record(STATISTICS, statistics))


@dataclass(frozen=True)
class Refused:
    """A change of a sound log, and the message that refuses it."""

    change: Change
    message: str


CHUNKS_NOT_COUNTED = Refused(
    _cut_and_counted, "100 lost cycles; expected 0, as its recorder counted"
)
NOT_MISSING = Refused(
    _counted_missing, r"\[0, 0, 0, 0, 0, 0\] missing answers of its axes; expected \[0, 1"
)
CONTRADICTIONS = {
    "chunks cut out": Refused(_cut_out, "100 samples; expected 300, as its recorder counted"),
    "chunks cut out and not counted": CHUNKS_NOT_COUNTED,
    "a chunk twice": Refused(_chunk_twice, "350 samples; expected 300"),
    "renumbered cycles": Refused(_renumbered, "200 samples; expected 300"),
    "answers that were not missing": NOT_MISSING,
    "no samples": Refused(_without_samples, "no samples"),
    "a second readback": Refused(_second_readback, "a second attachment 'readback.json'"),
    "a second run": Refused(_second_run, "a second metadata 'drivegain.run'"),
    "a second summary": Refused(_second_summary, "a second metadata 'drivegain.statistics'"),
}
WITH_SAMPLES = [kind for kind in CONTRADICTIONS if kind != "no samples"]


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("kind", CONTRADICTIONS)
def test_a_log_that_contradicts_itself_is_refused_by_all(
    kind: str, reader: str, made: MadeUp, tmp_path: Path
) -> None:
    case = CONTRADICTIONS[kind]
    case.change(made)
    log = made.write(tmp_path / "a.mcap")
    with pytest.raises(LogUnreadable, match=case.message):
        READERS[reader](log, tmp_path)
    assert list(tmp_path.iterdir()) == [log]


@pytest.mark.parametrize("kind", WITH_SAMPLES)
def test_a_salvage_of_a_log_that_contradicts_itself_is_not_valid_or_refused(
    kind: str, made: MadeUp, tmp_path: Path
) -> None:
    CONTRADICTIONS[kind].change(made)
    try:
        damaged = made.write(tmp_path / "a.mcap")
        saved = salvage(damaged, tmp_path / "saved.mcap")
    except LogUnreadable as refused:
        assert "a second" in str(refused)  # nothing of a sound log comes before it
        return
    assert saved.damage or not saved.statistics.valid
    assert read_log(saved.log).partial


@dataclass(frozen=True)
class Loss:
    """A change of a sound log, the lost cycles that are counted, and why it is invalid."""

    change: Change
    lost: int
    reason: str


RENUMBERED = Loss(_renumbered, 0, "cycle 110 101 ms after cycle 109, its most uneven step")
LOSSES = {
    "lost cycles": Loss(_lost_cycles, 100, "cycle 210 after 109 (1 gaps)"),
    "a chunk twice, counted": Loss(_chunk_twice, 0, "cycle 110 after 159 (1 gaps)"),
    "renumbered and counted": RENUMBERED,
}


class Judgement(Protocol):
    """What a verb says of a log."""

    @property
    def valid(self) -> bool: ...

    @property
    def reason(self) -> str: ...


def _assert_invalid(judgement: Judgement, reason: str) -> None:
    assert judgement.valid is False
    assert judgement.reason == reason


@pytest.mark.parametrize("kind", LOSSES)
def test_a_log_that_no_fit_takes_is_called_invalid_by_all(
    kind: str, made: MadeUp, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    loss = LOSSES[kind]
    loss.change(made)
    made.counted(loss.lost)
    log = made.write(tmp_path / "a.mcap")
    with pytest.raises(DataError) as refused:
        load_run(log)
    assert refused.value.found == loss.reason

    described = info_report(log)
    _assert_invalid(described, loss.reason)
    table = export_log(log, tmp_path / "a.csv", TableFormat.CSV)
    _assert_invalid(table, loss.reason)
    bag = export_bag(log, tmp_path / "bag")
    _assert_invalid(bag, loss.reason)
    part = log.rename(tmp_path / "a.mcap.part")
    saved = salvage(part, tmp_path / "saved.mcap")
    _assert_invalid(saved.statistics, loss.reason)
    out = tmp_path / "b.csv"
    arguments = ["export", "log", str(part), "--csv", "--out", str(out)]
    assert main(arguments) == ExitCode.OK
    assert "INVALID" in capsys.readouterr().err


# -- bounds


@pytest.mark.parametrize(
    "key", ["rate_hz", "speed", "payload_entered_kg", "started_wall_ns", "started_monotonic_ns"]
)
def test_a_number_of_400_digits_in_the_metadata_is_refused(
    key: str, made: MadeUp, tmp_path: Path
) -> None:
    made.run[key] = ATTACKER_DIGITS
    log = made.write(tmp_path / "a.mcap")
    for read in READERS.values():
        with pytest.raises(LogIncomplete):
            read(log, tmp_path)


@pytest.mark.parametrize("key", ["samples", "lost_cycles", "wall_minus_monotonic_ns"])
def test_a_number_of_400_digits_in_the_summary_is_refused(
    key: str, made: MadeUp, tmp_path: Path
) -> None:
    made.statistics[key] = ATTACKER_DIGITS
    log = made.write(tmp_path / "a.mcap")
    for read in READERS.values():
        with pytest.raises(LogIncomplete):
            read(log, tmp_path)


def test_a_serial_number_of_400_digits_is_none(made: MadeUp, tmp_path: Path) -> None:
    content = demo_content(made.checkout)
    readback = json.loads(readback_bytes(content.readback))
    drive = readback["axes"][0]["drive"]
    drive["serial"] = int(ATTACKER_DIGITS)
    made.readback = json.dumps(readback).encode()
    log = made.write(tmp_path / "a.mcap")
    run, _ = load_run(log)
    assert run.recording is not None
    assert run.recording.serials == (None, 7, 7, 7, 7, 7)


def _many_attachments(made: MadeUp) -> None:
    for number in range(LARGEST_ENTRIES):
        made.extra.append(attachment_record(f"a{number}", b""))


def _many_metadata(made: MadeUp) -> None:
    for number in range(LARGEST_ENTRIES):
        made.extra.append(metadata_record(f"a{number}", {}))


def _long_operator(made: MadeUp) -> None:
    made.run["operator"] = "x" * LONG_TEXT_BYTES


def _long_reason(made: MadeUp) -> None:
    made.statistics["reason"] = "x" * LONG_TEXT_BYTES


def _long_attachment(made: MadeUp) -> None:
    notes = b"x" * LONG_TEXT_BYTES
    made.extra.append(attachment_record("notes", notes))


TOO_MANY = f"more than {LARGEST_ENTRIES} attachments"
TOO_LONG = "of 30000[0-9]+ bytes"
LARGE = {
    "attachments": Refused(_many_attachments, TOO_MANY),
    "metadata": Refused(_many_metadata, TOO_MANY),
    "a text among the metadata": Refused(_long_operator, TOO_LONG),
    "a text as its reason": Refused(_long_reason, TOO_LONG),
    "an attachment": Refused(_long_attachment, "'notes' of 30000000 bytes"),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", LARGE)
def test_a_log_has_no_more_and_no_larger_texts_than_a_recorder_writes(
    kind: str, made: MadeUp, tmp_path: Path
) -> None:
    case = LARGE[kind]
    case.change(made)
    log = made.write(tmp_path / "a.mcap")
    for read in READERS.values():
        with pytest.raises(LogUnreadable, match=case.message):
            read(log, tmp_path)


def _message(channel: int, data: bytes) -> bytes:
    """A message record: its channel, a number and two times that are zero, and its data."""
    channel_bytes = channel.to_bytes(2, "little")
    number_and_times = bytes(20)
    return raw_record(Opcode.MESSAGE, channel_bytes + number_and_times + data)


def _event(text: str) -> bytes:
    event = CellEvent(START_NS, None, EventKind.STATE, 1, text)
    return _message(EVENT_CHANNEL, event_bytes(event))


@pytest.mark.parametrize(
    ("message", "allowed"),
    [
        (_event(""), RECORDS // 2),
        (_event("x" * 6_400), RECORDS // 100),
        (_message(UNKNOWN_CHANNEL, b""), RECORDS),
        (raw_record(UNKNOWN_OPCODE, b""), RECORDS),
    ],
    ids=["events", "texts", "messages of no topic", "records of no kind"],
)
def test_few_bytes_of_equal_messages_take_neither_gigabytes_nor_minutes(
    message: bytes, allowed: int, made: MadeUp, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The budget is that of a file; a hundredth of it keeps the test short."""
    monkeypatch.setattr("daq.log.container.RECORDS", RECORDS // 100)
    count = 2 * allowed // 100
    chunk = chunk_record(TOPICS + message * count)
    made.extra.append(chunk)
    log = made.write(tmp_path / "a.mcap")
    assert log.stat().st_size < 100_000
    reader = LogReader(log)
    with pytest.raises(LogUnreadable, match="too many messages for a file of its size"):
        list(reader)
    assert len(reader.events) <= count


# -- columns of an export

_names = st.text("A1_+-.", min_size=1, max_size=4)
NAMES = st.lists(_names, min_size=6, max_size=6, unique=True)


@given(NAMES)
def test_every_axis_keeps_columns_of_its_own(cell: Cell, names: Sequence[str]) -> None:
    axes = []
    for axis, name in zip(cell.axes, names, strict=True):
        axes.append(replace(axis, name=name))
    renamed_cell = replace(cell, axes=tuple(axes))
    columns = column_names(renamed_cell)
    assert len(set(columns)) == 6
