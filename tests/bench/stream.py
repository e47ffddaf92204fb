"""`make bench-stream`: what the stream loses of six axes on SocketCAN, and what a frame costs,
beside candump.

Writes out/bench-stream.json and asserts nothing but that every frame is accounted for: sent =
received + counted lost. The frames come from a process of their own (tests/bench/stream_sender.py)
at the rate asked for, and go through the real SyncStream into a log and a feed, as `record` does
it; the highest rate without a loss is looked for downwards from 1 kHz, with a busy Python thread
beside it. Then drivegain, candump (can-utils) and a plain listener receive the same frames, one
after the other and alone, and drivegain's capture process is stopped for 30, 100 and 300 ms. What a
frame costs is measured from outside, by stream_cost.py, which prints the table for
docs/evidence/stream.md.

    python -m tests.bench.stream --hear candump --cycles 5000     one listener at the compared rate, and nothing else
"""  # noqa: E501

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from daq.config.cell_file import load_cell
from daq.log.conversion import scaling
from daq.log.feed import Feed
from daq.log.motion import RecordedMotion
from daq.log.writer import LogWriter
from daq.workflow.record import SPACE_CHECK_S, LogAndFeed, _facts
from daq.workflow.safeguards import DiskRoom, free_bytes
from drivers.canopen.bus import BusAddress
from drivers.canopen.network import CanopenNetwork
from drivers.canopen.socketcan import SocketcanBus, open_socketcan
from drivers.profiles.profile import Axis
from drivers.stream.stream import SyncStream
from drivers.stream.sync import FollowedSync, Producer
from tests.bench.stream_sender import FRAMES_A_CYCLE, LAST, NODES
from tests.daq.logs import demo_content
from tests.drivers.scripted import PROFILE
from tests.vcan.run import INTERFACE, OUT

RATES_HZ = (1000, 900, 800, 700, 600, 500, 400, 300, 200, 100)
COMPARED_HZ = 250
STOPS_S = (0.03, 0.1, 0.3)
CHECKOUT = Path(__file__).parents[2]
DEMO = CHECKOUT / "configs" / "cells" / "demo.yaml"
LISTENER = """
import socket, sys
end = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
end.setsockopt(socket.SOL_SOCKET, 33, 4 << 20)  # SO_RCVBUFFORCE
end.bind((sys.argv[1],))
frame = bytearray(16)
while True:
    end.recv_into(frame)
    sys.stdout.write("x\\n")
    sys.stdout.flush()
"""
LISTENERS = {
    "nothing": ("sleep", "1000000"),
    "candump": ("candump", "-L", INTERFACE),
    "plain listener": (sys.executable, "-S", "-c", LISTENER, INTERFACE),
}
FLOOD_CYCLES = 20_000
PATIENCE_S = 20.0
ADDRESS = BusAddress("socketcan", INTERFACE)
AXES = tuple(Axis(f"J{node}", node, PROFILE, None) for node in range(1, 1 + NODES))
WIRE_QUEUE = Path("/proc/sys/net/core/netdev_max_backlog")
CPUCLOCK_SCHED = 2  # linux/posix-timers.h: the clock of another process is made from its id


Beside = Callable[[], AbstractContextManager[list[int]]]
"""What runs in the same interpreter as the stream; counts its turns."""


def main() -> int:
    """Downwards to the first rate without a loss, then more frames than can be taken."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="of each run")
    parser.add_argument(
        "--hear", choices=("drivegain", *LISTENERS), help=f"this one alone, at {COMPARED_HZ} Hz"
    )
    parser.add_argument("--cycles", type=int, default=COMPARED_HZ, help="with --hear")
    arguments = parser.parse_args()
    # The wire is a queue of the kernel here (vcan), and a thousand frames in it are a seventh of a
    # second.
    with suppress(OSError):
        WIRE_QUEUE.write_text("10000\n")
    if arguments.hear:
        heard = hear(arguments.hear, 1_000_000 // COMPARED_HZ, arguments.cycles)
        if arguments.hear == "nothing" or heard["lost"] == 0:
            return 0
        return 1
    runs = []
    for rate_hz in RATES_HZ:
        runs.append(one_run(1_000_000 // rate_hz, round(rate_hz * arguments.seconds), busy))
        if runs[-1]["lost"] == 0 and runs[-1]["rate_held"]:
            break
    held_hz = round(runs[-1]["asked_hz"])
    quiet = one_run(1_000_000 // held_hz, round(held_hz * arguments.seconds / 4), nothing)
    flood = one_run(0, FLOOD_CYCLES, busy)
    stopped = one_run(1_000_000 // COMPARED_HZ, COMPARED_HZ * 12, nothing, STOPS_S)
    compared = compare(arguments.seconds / 4)
    result = {
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": machine(),
        "highest_rate_hz_without_loss": runs[-1]["asked_hz"] if runs[-1]["lost"] == 0 else None,
        "runs": runs,
        "without_busy_thread": quiet,
        "flood": flood,
        "capture_stopped_for_30_100_300_ms": stopped,
        "compared_hz_without_loss": compared,
    }
    path = Path(os.environ.get(OUT, "out")) / "bench-stream.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(result, indent=2) + "\n")
    _print_line(f"written: {path}")
    if all(run["identity_holds"] for run in (*runs, quiet, flood, stopped)):
        return 0
    return 1


def compare(seconds: float) -> dict[str, int | None]:
    """Highest rate without a loss of each listener alone [Hz];
    None for one that loses at every rate.
    """
    rates = dict[str, int | None]()
    for name in ("drivegain", *LISTENERS):
        if name == "nothing" or (name == "candump" and shutil.which(name) is None):
            continue
        rates[name] = None
        for rate_hz in RATES_HZ:
            run = hear(name, 1_000_000 // rate_hz, round(rate_hz * seconds))
            if run["lost"] == 0 and run["rate_held"]:
                rates[name] = rate_hz
                break
        _print_line(f"{name}: {rates[name]} Hz without a loss")
    return rates


def hear(name: str, period_us: int, cycles: int) -> dict[str, Any]:
    """So many cycles to one of the listeners, or to none."""
    if name == "drivegain":
        return one_run(period_us, cycles, nothing)
    return listen(LISTENERS[name], period_us, cycles)


def listen(command: tuple[str, ...], period_us: int, cycles: int) -> dict[str, Any]:
    """So many cycles to a program that writes a line for each frame."""
    with tempfile.TemporaryFile() as out, _sender(period_us, cycles) as sender:
        with subprocess.Popen(command, stdout=out) as process:
            time.sleep(1.0)  # until it listens
            sent_text, sending_s = sender.communicate("go\n")[0].split()
            time.sleep(1.0)
            process.terminate()
        out.seek(0)
        received = sum(1 for _ in out)
        sent = int(sent_text)
        sent_hz = cycles / float(sending_s)
    return {"lost": sent - received, "rate_held": sent_hz > 0.99 * 1e6 / period_us}


def _stop_for(pid: int, stops_s: Sequence[float]) -> None:
    """Stop a process for these times, two seconds apart."""
    for stop_s in stops_s:
        time.sleep(2.0)
        os.kill(pid, signal.SIGSTOP)
        time.sleep(stop_s)
        os.kill(pid, signal.SIGCONT)


def one_run(
    period_us: int, cycles: int, beside: Beside, stops_s: Sequence[float] = ()
) -> dict[str, Any]:
    """So many cycles through the stream; a period of 0 sends them as fast as the sender can.

    The capture process is stopped meanwhile for the given times.
    """
    ends: list[SocketcanBus] = []

    def opened(_address: object) -> SocketcanBus:
        ends.append(open_socketcan(INTERFACE))
        return ends[0]

    stamps = np.zeros(cycles + 1, dtype=np.int64)
    waits = np.zeros(cycles + 1, dtype=np.int64)
    count = wrong = 0

    class Sender(Producer):
        def seen(self, monotonic_ns: int, periods: int) -> None:
            nonlocal count
            stamps[count], waits[count] = monotonic_ns, time.monotonic_ns() - monotonic_ns
            count += 1

    pacing = FollowedSync(
        1000 * (period_us or 1000), Sender("the sender", period_us), timeout_s=PATIENCE_S
    )
    # No node beats here: 0 is no supervision of heartbeats.
    with (
        tempfile.TemporaryDirectory() as folder,
        CanopenNetwork(ADDRESS, AXES, heartbeat_ms=0, opener=opened) as network,
        _kept(Path(folder) / "run.mcap", 1e6 / (period_us or 1000)) as (kept, room),
        _sender(period_us, cycles) as sender,
    ):
        stream = SyncStream(network, pacing, kept.event)
        check_every = max(1, round(SPACE_CHECK_S * 1e6 / (period_us or 1000)))
        capture_before = _processor_s(ends[0].capture_pid)
        begun_s = time.monotonic()
        main_before = time.thread_time()
        all_before = time.process_time()
        with beside() as turns:
            begin = sender.stdin
            if begin is not None:
                begin.write("go\n")
                begin.flush()
            stopping = threading.Thread(
                target=_stop_for, args=(ends[0].capture_pid, stops_s), name="stop"
            )
            stopping.start()
            sample = stream.advance()
            regular = stream.statistics
            while sample.position_counts[0] != LAST:
                # The position is the number of the cycle: an answer in another cycle's sample would
                # show.
                wrong += sample.missing == 0 and len(set(sample.position_counts)) != 1
                kept.sample(sample)
                if count % check_every == 0:
                    room.check()
                regular = stream.statistics
                sample = stream.advance()
            stopping.join()
        seconds = time.monotonic() - begun_s
        main_s = time.thread_time() - main_before
        all_s = time.process_time() - all_before
        capture_s = _processor_s(ends[0].capture_pid) - capture_before
        reported = stream.statistics
        losses = ends[0].losses
        sent_text, sending_s = sender.communicate()[0].split()
    sent = int(sent_text)
    received = (
        reported.cycles + reported.frames + reported.late + reported.duplicate + reported.foreign
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
def _kept(path: Path, rate_hz: float) -> Iterator[tuple[LogAndFeed, DiskRoom]]:
    """A log and a feed, as those of `record`, and the disk that is watched meanwhile."""
    content = demo_content(CHECKOUT)
    cell = load_cell(DEMO)
    scale = scaling(cell, content.readback)
    with (
        LogWriter(path, content, scale.joint_position_of, time.monotonic_ns) as log,
        Feed(DEMO) as feed,
    ):
        feed.begin(
            replace(_facts(cell, scale, content.run, path, 0), rate_hz=rate_hz),
            lambda: log.statistics,
        )
        yield (
            LogAndFeed(log, feed, lambda _moves: None, RecordedMotion(len(cell.axes))),
            DiskRoom(path, free_bytes),
        )
        log.conclude(valid=False, reason="a benchmark")


@contextmanager
def _sender(period_us: int, cycles: int) -> Iterator[subprocess.Popen[str]]:
    command = [
        sys.executable,
        "-m",
        "tests.bench.stream_sender",
        INTERFACE,
        str(period_us),
        str(cycles),
    ]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
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
    """A thread of this process that never waits;
    it holds the interpreter for its 5 ms whenever it can.
    """
    turns = [0]
    stop = threading.Event()

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
    """Return the processor time of a process [s], to the nanosecond;
    /proc counts ticks, which a guest misses.
    """
    return time.clock_gettime(~process << 3 | CPUCLOCK_SCHED)


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
