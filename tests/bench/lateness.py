"""How late a thread is that wakes every 2 ms, beside a progress bar that another thread draws.

    python -m tests.bench.lateness [SECONDS]

A recorder that sends SYNC itself is such a thread. Next to other work on all processors, the rows
show what each part of `daq.workflow.on_time` is worth.
"""

from __future__ import annotations

import os
import sys
import time
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress

from daq.workflow.on_time import on_time, real_time_priority, switch_threads_soon
from tests.studies.output import print_line

PERIOD_S = 0.002
DRAWN_HZ = 5.0  #: As the progress of `record`
CASES: dict[str, AbstractContextManager[None]] = {
    "as Python has it": nullcontext(),
    "threads that give way soon": switch_threads_soon(),
    "real-time priority": real_time_priority(),
    "all": on_time(),
}


def lateness_ms(seconds: float) -> np.ndarray:
    """Lateness of each wake-up [ms], ascending."""
    begun_s = time.monotonic()
    late_ms = []
    for number in range(1, round(seconds / PERIOD_S)):
        due_s = begun_s + number * PERIOD_S
        time.sleep(max(0.0, due_s - time.monotonic()))
        late_ms.append(1e3 * (time.monotonic() - due_s))
    return np.sort(late_ms)


def main(seconds: str = "12") -> None:
    """Print a row for each case."""
    print_line("| case | 99 % of wake-ups within ms | 99.9 % | latest |\n|---|---|---|---|")
    with Path(os.devnull).open("w", encoding="utf-8") as nowhere:
        for name, case in CASES.items():
            screen = Console(file=nowhere, force_terminal=True, width=100)
            with Progress(console=screen, refresh_per_second=DRAWN_HZ) as bars, case:
                bars.add_task("moves", total=100)
                late_ms = lateness_ms(float(seconds))
            most, nearly_all = np.quantile(late_ms, (0.99, 0.999))
            print_line(f"| {name} | {most:.2f} | {nearly_all:.2f} | {late_ms[-1]:.2f} |")


if __name__ == "__main__":
    main(*sys.argv[1:])
