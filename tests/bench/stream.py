"""`make bench-stream`: what the stream loses of six axes on SocketCAN, with a busy Python thread beside it.

Writes out/bench-stream.json and asserts nothing but that every frame is accounted for: sent = received + counted lost.
The frames come from a process of their own (tests/bench/stream_sender.py) at the rate asked for, and go through the
real SyncStream; the highest rate that a minute holds without a loss is looked for downwards from 1 kHz.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from drivers.canopen.bus import BusAddress
from drivers.canopen.network import CanopenNetwork
from drivers.canopen.socketcan import SocketcanBus, open_socketcan
from drivers.profiles.profile import Axis
from drivers.stream.stream import SyncStream
from drivers.stream.sync import FollowedSync
from tests.bench.stream_sender import FRAMES_A_CYCLE, LAST, NODES
from tests.drivers.scripted import PROFILE
from tests.vcan.run import INTERFACE, OUT

RATES_HZ = (1000, 900, 800, 700, 600, 500, 400, 300, 200, 100)
FLOOD_CYCLES = 20_000
PATIENCE_S = 20.0
ADDRESS = BusAddress("socketcan", INTERFACE)
AXES = tuple(Axis(f"J{node}", node, PROFILE, None) for node in range(1, 1 + NODES))
WIRE_QUEUE = Path("/proc/sys/net/core/netdev_max_backlog")
TICKS = os.sysconf("SC_CLK_TCK")


Beside = Callable[[], AbstractContextManager[list[int]]]
"""What runs in the same interpreter as the stream; counts its turns."""


def main() -> int:
    """Downwards to the first rate without a loss, then more frames than can be taken."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="of each run")
    arguments = parser.parse_args()
    # The wire is a queue of the kernel here (vcan), and a thousand frames in it are a seventh of a second.
    with suppress(OSError):
        WIRE_QUEUE.write_text("10000\n")
    runs = []
    for rate_hz in RATES_HZ:
        runs.append(one_run(1_000_000 // rate_hz, round(rate_hz * arguments.seconds), busy))
        if runs[-1]["lost"] == 0 and runs[-1]["rate_held"]:
            break
    held_hz = round(runs[-1]["asked_hz"])
    quiet = one_run(1_000_000 // held_hz, round(held_hz * arguments.seconds / 4), nothing)
    flood = one_run(0, FLOOD_CYCLES, busy)
    result = {
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": machine(),
        "highest_rate_hz_without_loss": runs[-1]["asked_hz"] if runs[-1]["lost"] == 0 else None,
        "runs": runs,
        "without_busy_thread": quiet,
        "flood": flood,
    }
    path = Path(os.environ.get(OUT, "out")) / "bench-stream.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(result, indent=2) + "\n")
    _print_line(f"written: {path}")
    return 0 if all(run["identity_holds"] for run in (*runs, quiet, flood)) else 1


def one_run(period_us: int, cycles: int, beside: Beside) -> dict[str, Any]:
    """So many cycles through the stream; a period of 0 sends them as fast as the sender can."""
    ends: list[SocketcanBus] = []

    def opened(_address: object) -> SocketcanBus:
        ends.append(open_socketcan(INTERFACE))
        return ends[0]

    stamps, waits = np.zeros(cycles + 1, dtype=np.int64), np.zeros(cycles + 1, dtype=np.int64)
    count = wrong = 0

    def seen(monotonic_ns: int, _periods: int) -> None:
        nonlocal count
        stamps[count], waits[count] = monotonic_ns, time.monotonic_ns() - monotonic_ns
        count += 1

    pacing = FollowedSync(1000 * (period_us or 1000), "the sender", timeout_s=PATIENCE_S, seen=seen)
    # No node beats here: 0 is no supervision of heartbeats.
    with CanopenNetwork(ADDRESS, AXES, heartbeat_ms=0, opener=opened) as network, _sender(period_us, cycles) as sender:
        stream = SyncStream(network, pacing)
        capture_before = _processor_s(ends[0].capture_pid)
        begun_s, main_before, all_before = time.monotonic(), time.thread_time(), time.process_time()
        with beside() as turns:
            begin = sender.stdin
            if begin is not None:
                begin.write("go\n")
                begin.flush()
            sample = stream.advance()
            regular = stream.statistics
            while sample.position_counts[0] != LAST:
                # The position is the number of the cycle: an answer in another cycle's sample would show.
                wrong += sample.missing == 0 and len(set(sample.position_counts)) != 1
                regular = stream.statistics
                sample = stream.advance()
        seconds = time.monotonic() - begun_s
        main_s, all_s = time.thread_time() - main_before, time.process_time() - all_before
        capture_s = _processor_s(ends[0].capture_pid) - capture_before
        reported, losses = stream.statistics, ends[0].losses
        sent_text, sending_s = sender.communicate()[0].split()
    sent, received = (
        int(sent_text),
        reported.cycles + reported.frames + reported.late + reported.duplicate + reported.foreign,
    )
    lost = sum(losses)
    steps_us = np.diff(stamps[: max(count - 1, 0)]) * 1e-3
    asked_hz = 1e6 / period_us if period_us else None
    sent_hz = cycles / float(sending_s)
    result = {
        "asked_hz": asked_hz,
        "sent_hz": round(sent_hz, 1),
        "frames_per_s": round(FRAMES_A_CYCLE * sent_hz),
        "rate_held": asked_hz is None or sent_hz > 0.99 * asked_hz,
        "seconds": round(float(sending_s), 2),
        "sent": sent,
        "received": received,
        "lost": lost,
        "lost_in_receive_buffer": losses.kernel,
        "lost_by_interface": losses.interface,
        "lost_in_backlog": losses.backlog,
        "identity_holds": sent == received + lost,
        "missing_answers": reported.missing,
        "late_answers": reported.late,
        "samples_of_mixed_cycles": wrong,
        "steps_of_more_than_a_period_and_a_half": regular.skipped_periods,
        "processor_share_capture": round(capture_s / seconds, 3),
        "processor_share_stream": round(main_s / seconds, 3),
        "processor_share_busy_thread": round((all_s - main_s) / seconds, 3),
        "turns_of_the_busy_thread": turns[0],
        "sync_step_us": _spread(steps_us),
        "read_after_sync_ms": _spread(waits[:count] * 1e-6),
    }
    _print_line(json.dumps(result))
    return result


@contextmanager
def _sender(period_us: int, cycles: int) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "tests.bench.stream_sender", INTERFACE, str(period_us), str(cycles)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            if process.stdout is None or process.stdout.readline() != "ready\n":
                raise RuntimeError(f"no sender: {' '.join(command)}")
            yield process
        finally:
            process.kill()


@contextmanager
def nothing() -> Iterator[list[int]]:
    """Beside the stream."""
    yield [0]


@contextmanager
def busy() -> Iterator[list[int]]:
    """A thread of this process that never waits; it holds the interpreter for its 5 ms whenever it can."""
    turns, stop = [0], threading.Event()

    def work() -> None:
        while not stop.is_set():
            sum(range(1000))
            turns[0] += 1

    thread = threading.Thread(target=work, name="busy")
    thread.start()
    try:
        yield turns
    finally:
        stop.set()
        thread.join()


def _processor_s(process: int) -> float:
    fields = Path(f"/proc/{process}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def _spread(values: np.ndarray[Any, Any]) -> dict[str, float]:
    if not len(values):
        return {}
    names = {"least": 0, "p1": 1, "median": 50, "p99": 99, "p999": 99.9, "most": 100}
    return {name: round(float(np.percentile(values, share)), 3) for name, share in names.items()}


def machine() -> dict[str, Any]:
    """Whose figures these are."""
    guest = "User Mode Linux" in Path("/proc/cpuinfo").read_text(encoding="utf-8")
    return {
        "kernel": platform.release(),
        "where": "guest (User-Mode Linux)" if guest else "native",
        "processors": os.cpu_count(),
        "python": platform.python_version(),
    }


def _print_line(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
