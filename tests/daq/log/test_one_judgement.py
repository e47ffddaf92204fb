"""Every verb judges a log alike, and each is bounded:
a log with right checksums may still be made up.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

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
    return [start_ns + k * 1_000_000 for k in range(count)]


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
        self.statistics |= {"samples": str(len(self.cycle)), "lost_cycles": str(lost)}

    def write(self, path: Path) -> Path:
        """The file, with right checksums."""
        content = demo_content(self.checkout)
        readback = self.readback or readback_bytes(content.readback)
        run = run_record(content.run) | self.run
        genuine = RunStatistics(SAMPLES, lost_cycles=0, missing=(0,) * 6, valid=True)
        statistics = statistics_record(genuine) | self.statistics
        records = [
            HEADER,
            *(attachment_record(name, data) for name, data in content.files.items()),
            attachment_record(READBACK, readback),
            metadata_record(RUN, sealed(run)),
            *self.extra,
            *self._chunks(),
            metadata_record(STATISTICS, sealed(statistics)),
            *self.after,
        ]
        return finished_file(path, records)

    def _chunks(self) -> Iterator[bytes]:
        for first in range(0, len(self.cycle), CHUNK_SAMPLES):
            last = first + CHUNK_SAMPLES
            samples = sample_records(self.cycle[first:last], self.time_ns[first:last])
            yield chunk_record(TOPICS + samples)


@pytest.fixture
def made(checkout: Path) -> MadeUp:
    """A sound log, not yet written."""
    return MadeUp(checkout)


READERS: dict[str, Callable[[Path, Path], object]] = {
    "read": lambda log, _: read_log(log),
    "info": lambda log, _: info_report(log),
    "fit and validate": lambda log, _: load_run(log),
    "export log": lambda log, out: export_log(log, out / "table.csv", TableFormat.CSV),
    "export bag": lambda log, out: export_bag(log, out / "bag"),
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
    made = MadeUp(checkout, list(range(count)), _times_ns(count, start_ns))
    made.counted()
    log = made.write(tmp_path / "a.mcap")
    described = info_report(log)
    assert described.samples == count
    assert described.stamped_duration_s == pytest.approx((count - 1) * 1e-3)


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
    made.extra.append(attachment_record(READBACK, b'{"axes": []}'))


def _second_run(made: MadeUp) -> None:
    made.extra.append(metadata_record(RUN, sealed({"rate_hz": "1"})))


def _second_summary(made: MadeUp) -> None:
    made.after.append(metadata_record(STATISTICS, sealed({"valid": "true"})))


#: a change of a sound log, and the message that refuses it
CONTRADICTIONS: dict[str, tuple[Change, str]] = {
    "chunks cut out": (_cut_out, "100 samples; expected 300, as its recorder counted"),
    "chunks cut out and not counted": (
        _cut_and_counted,
        "100 lost cycles; expected 0, as its recorder counted",
    ),
    "a chunk twice": (_chunk_twice, "350 samples; expected 300"),
    "renumbered cycles": (_renumbered, "200 samples; expected 300"),
    "answers that were not missing": (
        _counted_missing,
        r"\[0, 0, 0, 0, 0, 0\] missing answers of its axes; expected \[0, 1",
    ),
    "no samples": (_without_samples, "no samples"),
    "a second readback": (_second_readback, "a second attachment 'readback.json'"),
    "a second run": (_second_run, "a second metadata 'drivegain.run'"),
    "a second summary": (_second_summary, "a second metadata 'drivegain.statistics'"),
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("kind", CONTRADICTIONS)
def test_a_log_that_contradicts_itself_is_refused_by_all(
    kind: str, reader: str, made: MadeUp, tmp_path: Path
) -> None:
    change, message = CONTRADICTIONS[kind]
    change(made)
    log = made.write(tmp_path / "a.mcap")
    with pytest.raises(LogUnreadable, match=message):
        READERS[reader](log, tmp_path)
    assert list(tmp_path.iterdir()) == [log]


@pytest.mark.parametrize("kind", [kind for kind in CONTRADICTIONS if kind != "no samples"])
def test_a_salvage_of_a_log_that_contradicts_itself_is_not_valid_or_refused(
    kind: str, made: MadeUp, tmp_path: Path
) -> None:
    change, _ = CONTRADICTIONS[kind]
    change(made)
    try:
        damaged = made.write(tmp_path / "a.mcap")
        saved = salvage(damaged, tmp_path / "saved.mcap")
    except LogUnreadable as refused:
        assert "a second" in str(refused)  # nothing of a sound log comes before it
        return
    assert saved.damage or not saved.statistics.valid
    assert read_log(saved.log).partial


#: a change of a sound log, the lost cycles that are counted, and the reason that it is invalid
LOSSES: dict[str, tuple[Change, int, str]] = {
    "lost cycles": (_lost_cycles, 100, "cycle 210 after 109 (1 gaps)"),
    "a chunk twice, counted": (_chunk_twice, 0, "cycle 110 after 159 (1 gaps)"),
    "renumbered and counted": (
        _renumbered,
        0,
        "cycle 110 101 ms after cycle 109, its most uneven step",
    ),
}


@pytest.mark.parametrize("kind", LOSSES)
def test_a_log_that_no_fit_takes_is_called_invalid_by_all(
    kind: str, made: MadeUp, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change, lost, reason = LOSSES[kind]
    change(made)
    made.counted(lost)
    log = made.write(tmp_path / "a.mcap")
    with pytest.raises(DataError) as refused:
        load_run(log)
    assert refused.value.found == reason
    described = info_report(log)
    assert (described.valid, described.reason) == (False, reason)
    table = export_log(log, tmp_path / "a.csv", TableFormat.CSV)
    assert (table.valid, table.reason) == (False, reason)
    bag = export_bag(log, tmp_path / "bag")
    assert (bag.valid, bag.reason) == (False, reason)
    part = log.rename(tmp_path / "a.mcap.part")
    saved = salvage(part, tmp_path / "saved.mcap")
    assert (saved.statistics.valid, saved.statistics.reason) == (False, reason)
    arguments = ["export", "log", str(part), "--csv", "--out", str(tmp_path / "b.csv")]
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
    readback = json.loads(readback_bytes(demo_content(made.checkout).readback))
    readback["axes"][0]["drive"]["serial"] = int(ATTACKER_DIGITS)
    made.readback = json.dumps(readback).encode()
    log = made.write(tmp_path / "a.mcap")
    run, _ = load_run(log)
    assert run.recording is not None
    assert run.recording.serials == (None, 7, 7, 7, 7, 7)


def _many_attachments(made: MadeUp) -> None:
    made.extra.extend(attachment_record(f"a{k}", b"") for k in range(LARGEST_ENTRIES))


def _many_metadata(made: MadeUp) -> None:
    made.extra.extend(metadata_record(f"a{k}", {}) for k in range(LARGEST_ENTRIES))


def _long_operator(made: MadeUp) -> None:
    made.run["operator"] = "x" * LONG_TEXT_BYTES


def _long_reason(made: MadeUp) -> None:
    made.statistics["reason"] = "x" * LONG_TEXT_BYTES


def _long_attachment(made: MadeUp) -> None:
    made.extra.append(attachment_record("notes", b"x" * LONG_TEXT_BYTES))


LARGE: dict[str, tuple[Change, str]] = {
    "attachments": (_many_attachments, f"more than {LARGEST_ENTRIES} attachments"),
    "metadata": (_many_metadata, f"more than {LARGEST_ENTRIES} attachments"),
    "a text among the metadata": (_long_operator, "of 30000[0-9]+ bytes"),
    "a text as its reason": (_long_reason, "of 30000[0-9]+ bytes"),
    "an attachment": (_long_attachment, "'notes' of 30000000 bytes"),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", LARGE)
def test_a_log_has_no_more_and_no_larger_texts_than_a_recorder_writes(
    kind: str, made: MadeUp, tmp_path: Path
) -> None:
    change, message = LARGE[kind]
    change(made)
    log = made.write(tmp_path / "a.mcap")
    for read in READERS.values():
        with pytest.raises(LogUnreadable, match=message):
            read(log, tmp_path)


def _message(channel: int, data: bytes) -> bytes:
    """A message record: its channel, a number and two times that are zero, and its data."""
    channel_bytes = channel.to_bytes(2, "little")
    return raw_record(Opcode.MESSAGE, channel_bytes + bytes(20) + data)


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
    made.extra.append(chunk_record(TOPICS + message * count))
    log = made.write(tmp_path / "a.mcap")
    assert log.stat().st_size < 100_000
    reader = LogReader(log)
    with pytest.raises(LogUnreadable, match="too many messages for a file of its size"):
        list(reader)
    assert len(reader.events) <= count


# -- columns of an export

NAMES = st.lists(st.text("A1_+-.", min_size=1, max_size=4), min_size=6, max_size=6, unique=True)


@given(NAMES)
def test_every_axis_keeps_columns_of_its_own(cell: Cell, names: Sequence[str]) -> None:
    axes = tuple(replace(axis, name=name) for axis, name in zip(cell.axes, names, strict=True))
    renamed_cell = replace(cell, axes=axes)
    columns = column_names(renamed_cell)
    assert len(set(columns)) == 6
