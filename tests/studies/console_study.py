"""`make console-study`: recordings on SocketCAN with the console alternately open and closed.

Blocks of recordings follow one another, without and with a console whose page is read. Of each
block: cycles lost, the jitter of SYNC by the kernel's stamps, and the console's processor time and
memory. The rate is the highest of RATES_HZ that is lossless without a console: in some recordings
before the blocks, and in every block without one. A block without a console that loses a cycle
starts the study again at the next rate. Written to out/console-study.json.

A machine that stalls longer than a period loses cycles at every rate, whatever runs on it.
`--despite-losses` goes on at the first rate. Every gap of SYNC is written with its time, to be
compared with what a sleeper of the highest priority saw on the host (`python -m
tests.studies.stalls`).
"""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from http.client import HTTPConnection, HTTPException
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.cli.app import main as drivegain
from daq.log.reader import read_log
from tests.vcan.cells import record_once, simulated, write_cell, write_simulation
from tests.vcan.run import OUT

IntArray = NDArray[np.int64]
RATES_HZ = (500, 400, 250, 200, 125, 100, 80, 50, 40, 25)
TICKS = os.sysconf("SC_CLK_TCK")
PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


@contextmanager
def console(cell: Path, *, unread: bool = False) -> Iterator[subprocess.Popen[str]]:
    """A console in a process of its own, and a reader of its page in this one;
    `unread`: one more page, which nobody reads.
    """
    command = [sys.executable, "-m", "daq", "console", str(cell)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        found = re.search(r"http://([^/]+)(/\S+/)", process.stdout.readline())
        assert found is not None
        thread = threading.Thread(target=_read, args=(found[1], found[2]), daemon=True)
        thread.start()
        connection = HTTPConnection(found[1])
        try:
            if unread:
                connection.request("GET", f"{found[2]}curves")
            yield process
        finally:
            connection.close()
            process.send_signal(signal.SIGINT)
            process.wait(timeout=60)
            thread.join(10)


def _read(host: str, path: str) -> None:
    with suppress(OSError, HTTPException, ValueError):
        connection = HTTPConnection(host)
        connection.request("GET", f"{path}curves")
        answer = connection.getresponse()
        while answer.read1(65536):
            pass


def used(pid: int) -> tuple[float, float]:
    """Processor time [s] and resident memory [MB] of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return (int(fields[11]) + int(fields[12])) / TICKS, pages * PAGE_BYTES / 1e6


def recording(cell: Path, plan: Path, log: Path) -> dict[str, Any]:
    """One recording: its losses and the deviations of its SYNC intervals from the period [µs]."""
    log.unlink(missing_ok=True)
    log.with_name(log.name + ".part").unlink(missing_ok=True)
    document = record_once(cell, plan, log)
    if not log.exists():
        return {
            "ended_early": 1,
            "lost": 0,
            "missing": 0,
            "samples": 0,
            "jitter_us": [],
            "gaps": [],
        }
    found = read_log(log)
    interval_ns = np.diff(found.samples.time_ns)
    jitter_us = 1e-3 * np.abs(interval_ns - 1e9 / found.head.run.rate_hz)
    return {
        "ended_early": 0,
        "lost": document["lost_cycles"],
        "missing": sum(document["missing"]),
        "samples": document["samples"],
        "jitter_us": jitter_us.tolist(),
        "gaps": gaps_of(found.samples.time_ns, found.head.run.rate_hz),
    }


def gaps_of(time_ns: IntArray, rate_hz: float) -> list[tuple[float, float]]:
    """Time [s since 1970] and length [ms] of every interval that is half a period too long."""
    interval_ms = 1e-6 * np.diff(time_ns)
    late = np.flatnonzero(interval_ms > 1.5e3 / rate_hz)
    return [(round(1e-9 * float(time_ns[i]), 3), round(float(interval_ms[i]), 1)) for i in late]


def block(
    cell: Path, plan: Path, log: Path, seconds: float, process: subprocess.Popen[str] | None
) -> dict[str, Any]:
    """Recordings one after the other for a time."""
    began_s = time.monotonic()
    parts = []
    start = (0.0, 0.0) if process is None else used(process.pid)
    while time.monotonic() - began_s < seconds:
        parts.append(recording(cell, plan, log))
    lasted_s = time.monotonic() - began_s
    jitter = np.concatenate([part.pop("jitter_us") for part in parts])
    gaps = list(chain.from_iterable(part.pop("gaps", ()) for part in parts))
    summed = {}
    for key in ("ended_early", "lost", "missing", "samples"):
        summed[key] = sum(part[key] for part in parts)
    found = {
        "open": process is not None,
        "recordings": len(parts),
        "seconds": round(lasted_s, 1),
        **summed,
    }
    found["gaps"] = gaps
    if jitter.size:
        found |= {
            f"jitter_us_p{share:g}": round(float(np.percentile(jitter, share)), 1)
            for share in (50, 99, 99.9)
        }
    if process is not None:
        end = used(process.pid)
        found |= {
            "console_percent": round(100.0 * (end[0] - start[0]) / lasted_s, 2),
            "console_mb": [start[1], end[1]],
        }
    return found


def cell_at(folder: Path, rate_hz: int, seconds: float) -> tuple[Path, Path, Path]:
    """Cell, simulation and plan at a rate; the kernel sends SYNC,
    so that a recorder that has to wait loses nothing.
    """
    folder.mkdir()
    cell = write_cell(folder, 1_000_000 // rate_hz, "timed\n  producer: kernel")
    plan = folder / "plan.yaml"
    assert (
        drivegain(
            ["plan", str(cell), "--out", str(plan), "--duration", str(seconds), "--exchanges", "0"]
        )
        == 0
    )
    return cell, write_simulation(folder, 1_000_000 // rate_hz), plan


def is_lossless(found: dict[str, Any]) -> bool:
    """Return whether a recording or block has every sample of every cycle."""
    return not (found["lost"] or found["missing"] or found["ended_early"])


def blocks_at(
    folder: Path, rate_hz: int, options: argparse.Namespace
) -> list[dict[str, Any]] | None:
    """All blocks at one rate; None where a recording without a console lost a sample."""
    cell, simulation, plan = cell_at(folder / str(rate_hz), rate_hz, options.seconds)
    log = folder / "run.mcap"
    blocks: list[dict[str, Any]] = []
    with simulated(simulation):
        for _ in range(options.tries):
            tried = recording(cell, plan, log)
            if not is_lossless(tried) and not options.despite_losses:
                _show({"rate_hz": rate_hz, "lossless": False, **tried, "jitter_us": None})
                return None
        for number in range(round(options.minutes / options.block)):
            is_open = number % 2 == 1
            with console(cell) if is_open else nullcontext() as process:
                blocks.append(block(cell, plan, log, 60.0 * options.block, process))
            _show({"rate_hz": rate_hz, **blocks[-1]})
            if not (is_open or is_lossless(blocks[-1]) or options.despite_losses):
                return None
    return blocks


def _show(row: dict[str, Any]) -> None:
    sys.stdout.write(f"{json.dumps(row)}\n")
    sys.stdout.flush()


def main(arguments: list[str] | None = None) -> int:
    """Go down the rates until one is lossless without a console;
    1 where a console cost a cycle, or none is.
    """
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.console_study", description=__doc__
    )
    parser.add_argument("--minutes", type=float, default=60.0, help="of all blocks together")
    parser.add_argument("--block", type=float, default=10.0, help="minutes of a block")
    parser.add_argument("--seconds", type=float, default=60.0, help="of the plan")
    parser.add_argument("--tries", type=int, default=3, help="recordings before the blocks")
    parser.add_argument(
        "--rates",
        type=int,
        nargs="+",
        default=list(RATES_HZ),
        metavar="HZ",
        help="the highest first",
    )
    parser.add_argument("--despite-losses", action="store_true", help="go on at the first rate")
    options = parser.parse_args(arguments)
    out = Path(os.environ.get(OUT, "out")) / "console-study.json"
    out.parent.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        for rate_hz in options.rates:
            blocks = blocks_at(Path(name), rate_hz, options)
            if blocks is not None:
                break
        else:
            _show({"lossless_at_no_rate_of_hz": options.rates})
            return 1
    out.write_text(
        json.dumps({"rate_hz": rate_hz, "blocks": blocks}, indent=1) + "\n", encoding="utf-8"
    )
    return int(not all(map(is_lossless, blocks)))


if __name__ == "__main__":
    sys.exit(main())
