"""Logs for tests."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from daq.config.cell_file import bundle, load_cell
from daq.log.metadata import AxisReadback, Readback, RunInfo
from daq.log.writer import LogContent, LogWriter
from drivers.messages import CellEvent, Sample
from ident.model.bodies import Payload

START_NS = 1_700_000_000_123_456_789
DISC = Payload("disc", "flange-a", {"m": 4.59})


def content(
    axes: int, payload: Payload | None = None, files: dict[str, bytes] | None = None
) -> LogContent:
    """The start of a log of so many axes: 1 kHz, 2 mA a unit."""
    names = tuple(f"J{i + 1}" for i in range(axes))
    run = RunInfo("run-1", 1000.0, payload, "Ada", "test 1", START_NS, 55)
    readback = Readback(tuple(AxisReadback(name, 0.002, drive={"serial": 7}) for name in names))
    return LogContent(run, {"cell.yaml": b"name: x\n"} if files is None else files, readback, names)


def demo_content(checkout: Path, payload: Payload | None = None) -> LogContent:
    """The start of a log of the demo cell."""
    path = checkout / "configs/cells/demo.yaml"
    urdf = load_cell(path).urdf
    return replace(content(6, payload, bundle(path)), urdf=urdf)


def samples(rows: Sequence[Sequence[int]], status: int = 0x1237, missing: int = 0) -> list[Sample]:
    """One sample a millisecond with these counts; the current is the negative count."""
    found = []
    for k, row in enumerate(rows):
        time_ns = START_NS + k * 1_000_000
        current_raw = tuple(-count for count in row)
        statusword = (status,) * len(row)
        found.append(Sample(10 + k, time_ns, tuple(row), current_raw, statusword, missing))
    return found


def rising_counts(rows: int, axes: int) -> list[list[int]]:
    """Counts of so many rows: row k begins with 100 k, and each axis has one count more."""
    found = []
    for row in range(rows):
        found.append(list(range(100 * row, 100 * row + axes)))
    return found


def joints(counts: Sequence[int]) -> list[float]:
    """Some joint positions."""
    return [count * 1e-3 for count in counts]


def write(
    path: Path,
    start: LogContent,
    rows: Sequence[Sample],
    events: Sequence[CellEvent] = (),
    verdict: tuple[bool, str] = (True, ""),
) -> Path:
    """A whole log."""
    with LogWriter(path, start, joints, clock_ns=lambda: 0) as log:
        for event in events:
            log.event(event)
        for sample in rows:
            log.write(sample)
        log.conclude(*verdict)
    return path


def damaged(data: bytes, kind: str, at: int, rng: random.Random, junk_bytes: int) -> bytes:
    """A file with a bit flipped ("flip"), its end lost ("cut") or some bytes replaced ("junk"),
    from an offset on.
    """
    hurt = bytearray(data)
    if kind == "flip":
        hurt[at] ^= 1 << rng.randrange(8)
    elif kind == "cut":
        del hurt[at:]
    else:
        hurt[at : at + junk_bytes] = rng.randbytes(junk_bytes)
    return bytes(hurt)
