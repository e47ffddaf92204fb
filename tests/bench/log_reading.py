"""A log into arrays, by chunk and message by message; and an hour of it in bounded memory.

Three ways over one log of 60 s at 1 kHz and six axes: ours, which takes a chunk of samples as one
array with every checksum checked; the messages of the `mcap` package, each unpacked as the fixed
struct that it is, checksums checked too; and the messages decoded by their schema, as a program
does that knows nothing of our layout (`mcap-ros2-support`, on a tenth of the log). An hour is
passed through a process of its own, whose memory is what it says at its end.
"""

from __future__ import annotations

import argparse
import json
import re
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from daq.log.message import SAMPLES_TOPIC, sample_struct
from daq.log.reader import LogReader, read_log
from daq.log.writer import LogWriter
from drivers.messages import Sample
from tests.daq.logs import START_NS, content, joints

AXES = 6
RATE_HZ = 1000
MINUTE_S = 60
HOUR_S = 3600
REPEATS = 5
PROMISED_RATIO = 8.0


def write_log(path: Path, seconds: int) -> Path:
    """Moves and noise as a cell has them, the same every time."""
    chance = np.random.default_rng(1)
    with LogWriter(path, content(AXES), joints, clock_ns=lambda: 0) as log:
        for second in range(seconds):
            time_s = second + np.arange(RATE_HZ)[:, None] / RATE_HZ
            phase = time_s * np.arange(1, AXES + 1) * 0.3
            position = (
                np.rint(5e4 * np.sin(phase) + 2.0 * chance.standard_normal(phase.shape))
                .astype(int)
                .tolist()
            )
            current = (
                np.rint(500.0 * np.cos(phase) + 8.0 * chance.standard_normal(phase.shape))
                .astype(int)
                .tolist()
            )
            for k in range(RATE_HZ):
                cycle = second * RATE_HZ + k
                stamp_ns = START_NS + cycle * 1_000_000
                log.write(
                    Sample(cycle, stamp_ns, tuple(position[k]), tuple(current[k]), (0x1237,) * AXES)
                )
        log.conclude(valid=True)
    return path


def by_chunk(path: Path) -> int:
    """Our reader; number of samples."""
    return len(read_log(path).samples.cycle)


def by_message(path: Path) -> int:
    """Every message, unpacked as a struct, into arrays; number of samples."""
    layout = sample_struct(AXES)
    with path.open("rb") as stream:
        messages = make_reader(stream, validate_crcs=True).iter_messages(
            topics=[SAMPLES_TOPIC], log_time_order=False
        )
        rows = [layout.unpack(message.data) for _, _, message in messages]
    return len(np.array([row[1:] for row in rows], dtype=np.int64))


def by_schema(path: Path, messages_wanted: int) -> int:
    """Messages decoded by the schema in the log; number of samples."""
    found = 0
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _ in reader.iter_decoded_messages(topics=[SAMPLES_TOPIC], log_time_order=False):
            found += 1
            if found == messages_wanted:
                break
    return found


def hour(path: Path) -> dict[str, float]:
    """Pass a log through, keeping nothing but sums; in a process of its own."""
    begun = time.process_time()
    total = np.zeros(AXES, dtype=np.int64)
    count = 0
    for block in LogReader(path):
        total += block.position_counts.sum(axis=0)
        count += len(block.cycle)
    return {"samples": count, "seconds": time.process_time() - begun, "peak_mb": _peak_mb()}


def _peak_mb() -> float:
    """Peak memory of this program alone [MB]:
    in `getrusage` Linux counts what a parent held before it started us.
    """
    status = Path("/proc/self/status")
    if status.exists():
        return float(re.findall(r"VmHWM:\s+(\d+) kB", status.read_text())[0]) / 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def _in_a_process_of_its_own(path: Path) -> dict[str, float]:
    command = [sys.executable, "-m", "tests.bench.log_reading", "--pass-through", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found: dict[str, float] = json.loads(done.stdout)
    return found


def _median_s(work: Callable[[], int], expected: int, repeats: int) -> float:
    taken = []
    for _ in range(repeats):
        begun = time.process_time()
        if work() != expected:
            raise SystemExit("samples are missing")
        taken.append(time.process_time() - begun)
    return statistics.median(taken)


def measure(folder: Path, hour_s: int = HOUR_S) -> dict[str, Any]:
    """All figures, of processor time, which other programs on the machine disturb least."""
    samples = MINUTE_S * RATE_HZ
    minute = write_log(folder / "minute.mcap", MINUTE_S)
    long = write_log(folder / "hour.mcap", hour_s)
    passes = {"minute": _in_a_process_of_its_own(minute), "hour": _in_a_process_of_its_own(long)}
    chunk_s = _median_s(lambda: by_chunk(minute), samples, REPEATS)
    message_s = _median_s(lambda: by_message(minute), samples, REPEATS)
    schema_s = 10.0 * _median_s(lambda: by_schema(minute, samples // 10), samples // 10, 1)
    return {
        "minute_mb": minute.stat().st_size / 1e6,
        "hour_s": hour_s,
        "hour_mb": long.stat().st_size / 1e6,
        "by_chunk_s": chunk_s,
        "by_message_s": message_s,
        "by_schema_s": schema_s,
        "ratio": message_s / chunk_s,
        "ratio_by_schema": schema_s / chunk_s,
        "passed_through": passes,
    }


def summary_text(found: dict[str, Any]) -> str:
    """The figures of `measure`, for a person."""
    minute = found["passed_through"]["minute"]
    long = found["passed_through"]["hour"]
    return (
        f"60 s at 1 kHz, {AXES} axes, {found['minute_mb']:.1f} MB, processor time:\n"
        f"  by chunk into arrays        {1e3 * found['by_chunk_s']:8.0f} ms\n"
        f"  message by message, struct  {1e3 * found['by_message_s']:8.0f} ms, "
        f"{found['ratio']:.1f} times\n"
        f"  message by message, schema  {1e3 * found['by_schema_s']:8.0f} ms, "
        f"{found['ratio_by_schema']:.1f} times\n"
        f"a log of {found['hour_s']} s, {found['hour_mb']:.0f} MB, passed through: "
        f"{long['samples']:.0f} samples, "
        f"{long['seconds']:.1f} s\n"
        f"  most memory of the process  {long['peak_mb']:8.0f} MB, {minute['peak_mb']:.0f} MB for "
        "the minute"
    )


def main() -> int:
    """Print the figures; 1 when the ratio is below what is promised."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--pass-through", type=Path, help="a log to read block by block, as the child process does"
    )
    parser.add_argument("--hour", type=int, default=HOUR_S, help="seconds of the long log")
    parser.add_argument("--json", action="store_true", help="print one line of JSON")
    arguments = parser.parse_args()
    if arguments.pass_through is not None:
        sys.stdout.write(json.dumps(hour(arguments.pass_through)) + "\n")
        return 0
    with TemporaryDirectory(prefix="log-reading-") as name:
        found = measure(Path(name), arguments.hour)
    sys.stdout.write((json.dumps(found) if arguments.json else summary_text(found)) + "\n")
    return 0 if found["ratio"] >= PROMISED_RATIO else 1


if __name__ == "__main__":
    sys.exit(main())
