"""Processor time and memory of `drivegain residual` on four runs of 40 s and a held-out one, 1 kHz,
six axes.

    python -m tests.bench.residual FOLDER [REPEATS]     simulates what is missing in FOLDER first

The cells have no, one or three undeclared effects. They move without a bus
(tests/studies/direct_cell.py); the logs are written by the recorder's own writer.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from daq.config.cell_file import bundle, load_cell
from daq.workflow.plan import load_plan, plan, save_plan
from tests.bench.fleet_cells import START_NS, print_line, write_log
from tests.studies.direct_cell import simulate_run
from tests.studies.effect_cells import SINGLE_EFFECTS, EffectCase
from tests.studies.study_cells import declared_payload
from tests.studies.study_plans import CELL

DURATION_S = 40.0
SEED = 2001
RUNS = (
    ("bare-1", None, 0),
    ("disc-1", "disc", 0),
    ("bare-2", None, 1),
    ("disc-2", "disc", 1),
    ("held-out", "disc", 2),
)
"""Name, payload and plan of each run."""
EFFECTS = (SINGLE_EFFECTS[3][0], SINGLE_EFFECTS[0][0], SINGLE_EFFECTS[13][0])
CASES = tuple(EffectCase(f"{count}-effects", SEED, EFFECTS[:count]) for count in (0, 1, 3))


@dataclass(frozen=True, slots=True)
class Usage:
    """Time and memory of one whole command."""

    seconds: float  #: of processor time
    peak_mb: float  #: largest resident memory


def make_logs(folder: Path, case: EffectCase) -> tuple[Path, ...]:
    """Simulate the runs of a case that are missing, and name their logs."""
    cell = load_cell(CELL)
    files = bundle(CELL)
    (folder / case.name).mkdir(parents=True, exist_ok=True)
    logs = []
    for number, (name, payload, letter) in enumerate(RUNS):
        planned = folder / f"plan-{letter}.yaml"
        if not planned.exists():
            save_plan(plan(cell, seed=SEED + letter, duration_s=DURATION_S), planned)
        log = folder / case.name / f"{name}.mcap"
        logs.append(log)
        if log.exists():
            continue
        log.with_name(log.name + ".part").unlink(missing_ok=True)
        if payload is None:
            mounted = None
        else:
            mounted = declared_payload(payload)
        raw = simulate_run(
            cell, case.spec("measurement", payload, number), load_plan(planned, cell), name, mounted
        )
        write_log(log, raw, cell, files, START_NS + number * 60_000_000_000)
    return tuple(logs)


def search(logs: tuple[Path, ...]) -> Usage:
    """Search all logs but the last, which is held out, by the command,
    with one thread for linear algebra.
    """
    used = map(str, logs[:-1])
    held_out = str(logs[-1])
    command = [sys.executable, "-m", "daq", "residual", *used, "--holdout", held_out, "--json"]
    with subprocess.Popen(
        command, stdout=subprocess.DEVNULL, env=os.environ | {"OMP_NUM_THREADS": "1"}
    ) as child:
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise SystemExit(f"`{' '.join(command)}` ended with {child.returncode}")
    return Usage(usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024.0)


def main(folder: str, repeats: str = "1") -> None:
    """Print a row for each case."""
    print_line("| undeclared effects | processor time s | peak MB |\n|---|---|---|")
    for case in CASES:
        logs = make_logs(Path(folder), case)
        usages = [search(logs) for _ in range(int(repeats))]
        best = min(usages, key=lambda usage: usage.seconds)
        print_line(
            f"| {len(case.effects)} | {best.seconds:.1f} | "
            f"{max(usage.peak_mb for usage in usages):.0f} |"
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
