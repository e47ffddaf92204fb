"""What a frame costs drivegain, candump and a plain listener: the end of `make bench-stream`.

    python -m tests.bench.stream_cost        prints the table of docs/evidence/stream.md, after tests.bench.stream

A guest counts processor time by its ticks, and what wakes up with the ticks escapes them. So the
time is that of the whole guest as its host counts it: a long run less a short one, which cost the
same to start, and of that the part beyond the same frames without a listener.
"""  # noqa: E501

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from pathlib import Path

from tests.bench.stream import COMPARED_HZ
from tests.bench.stream_sender import FRAMES_A_CYCLE, NODES
from tests.vcan.run import OUT

SHORT_S = 8
LONG_S = 40
ASKED_RATIO = 3
ASKED_HZ = 250


def cost_us(name: str) -> float:
    """Processor time of a frame of the whole guest, sender and kernel included."""
    short_s, long_s = (_processor_s(name, COMPARED_HZ * seconds) for seconds in (SHORT_S, LONG_S))
    return 1e6 * (long_s - short_s) / (COMPARED_HZ * FRAMES_A_CYCLE * (LONG_S - SHORT_S))


def _processor_s(name: str, cycles: int) -> float:
    command = (sys.executable, "-m", "tests.bench.stream", "--hear", name, "--cycles", str(cycles))
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run((sys.executable, "-m", "tests.vcan.run", *command), check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> int:
    """Measure, add it to the results of the bench, and print the table."""
    path = Path(os.environ.get(OUT, "out")) / "bench-stream.json"
    bench = json.loads(path.read_text(encoding="utf-8"))
    rates = bench["compared_hz_without_loss"]
    stopped = bench["capture_stopped_for_30_100_300_ms"]
    alone = cost_us("nothing")
    costs = {name: cost_us(name) - alone for name in rates}
    path.write_text(
        json.dumps(bench | {"processor_us_a_frame": costs, "sender_us_a_frame": alone}, indent=2)
        + "\n"
    )
    lines = [
        f"| listener | processor time a frame | of candump's (asked: ≤ {ASKED_RATIO}) | highest "
        f"rate × {NODES} axes without loss (asked: ≥ {ASKED_HZ} Hz) |",
        "|---|---|---|---|",
    ]
    for name, cost in costs.items():
        if "candump" in costs:
            ratio = f"{cost / costs['candump']:.1f}"
        else:
            ratio = "–"
        lines.append(f"| {name} | {cost:.0f} µs | {ratio} | {rates[name] or 'none'} Hz |")
    lines.append(
        f"\nCapture stopped for 30, 100, 300 ms: {stopped['lost']} of {stopped['sent']} "
        "frames lost, "
        f"{stopped['missing_answers']} answers missing"
    )
    sys.stdout.write("\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
