"""Runs of many clean simulated cells, for the coverage of the error bars.

    python -m tests.studies.coverage_runs --check       the direct path against one recording over the bus
    python -m tests.studies.coverage_runs --cells 100   two runs without load and two with the disc of each cell

Each cell has a truth of its own (study_cells.py) and each of its runs a noise of its own; plans are shared by the
cells in turn, because a plan is no part of what an error bar has to cover. Layout: out/coverage/<cell>.npz, counts as
the amplifiers report them. `load_coverage` gives them back as runs with their truth.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from daq.config.bus import bus_address
from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.log.conversion import load_run
from daq.workflow.plan import Plan, plan
from daq.workflow.record import record
from drivers.canopen.bus import open_bus
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.spec import CellSpec
from ident.data.run import Run
from tests.studies.direct_cell import RawRun, run_of, simulate_run
from tests.studies.raw_runs import read_runs, write_runs
from tests.studies.side_by_side import side_by_side
from tests.studies.study_cells import Truth, declared_payload, spec_of, study_cell, truth_of

OUT = Path("out/coverage")
CELLS = 100
DURATION_S = 20.0
PROCESSES = 2
CELL = shipped_configurations() / "cells" / "demo.yaml"
FIRST_SEED = 1001
"""Cells of this study are none of the estimator study's."""
PLAN_PAIRS = 10
RUNS = (("bare-1", None, 0), ("disc-1", "disc", 0), ("bare-2", None, 1), ("disc-2", "disc", 1))
"""Name, payload and plan (the first or second of the cell's pair) of each run."""


@dataclass(frozen=True, slots=True)
class CoverageCell:
    """The runs of one cell, and what its error bars should cover."""

    seed: int
    truth: Truth
    runs: tuple[Run, ...]


@dataclass(frozen=True, slots=True)
class _PlanTask:
    seed: int
    duration_s: float


@dataclass(frozen=True, slots=True)
class _Task:
    out: Path
    seed: int
    plans: tuple[Plan, Plan]


def simulate_runs(cell: Cell, seed: int, plans: tuple[Plan, Plan]) -> tuple[RawRun, ...]:
    """The four runs of one cell.

    Args:
        cell: as declared.
        seed: of its truth and its noise.
        plans: of its first and of its second pair of runs.
    """
    truth = study_cell(seed)
    return tuple(
        simulate_run(
            cell,
            spec_of(truth, payload, number),
            plans[moves],
            name,
            None if payload is None else declared_payload(payload),
        )
        for number, (name, payload, moves) in enumerate(RUNS)
    )


def load_coverage(out: Path = OUT) -> Iterator[CoverageCell]:
    """The saved cells, one at a time: a hundred together would fill the memory.

    Raises:
        FileNotFoundError: there are none.
    """
    cell = load_cell(CELL)
    paths = sorted(out.glob("*.npz"))
    if not paths:
        raise FileNotFoundError(f"found no cell in {out}; run `python -m tests.studies.coverage_runs` first")
    for path in paths:
        seed = int(path.stem)
        runs = tuple(run_of(raw, cell) for raw in read_runs(path))
        yield CoverageCell(seed, truth_of(study_cell(seed)), runs)


def make_coverage(
    cells: int,
    *,
    out: Path = OUT,
    duration_s: float = DURATION_S,
    processes: int = PROCESSES,
    report_line: Callable[[str], None] = lambda _: None,
) -> None:
    """Simulate and save cells; earlier ones in the folder are replaced.

    Args:
        cells: how many.
        out: folder, made if it is not there.
        duration_s: of each run [s].
        processes: side by side.
        report_line: what was done, a line a cell.

    Raises:
        TaskFailed: planning or simulating failed.
    """
    out.mkdir(parents=True, exist_ok=True)
    for left in out.glob("*.npz"):
        left.unlink()
    pairs = min(PLAN_PAIRS, cells)
    seeds = range(FIRST_SEED, FIRST_SEED + 2 * pairs)
    plans = tuple(side_by_side(_plan, [_PlanTask(seed, duration_s) for seed in seeds], processes))
    tasks = []
    for number in range(cells):
        first = 2 * (number % pairs)
        tasks.append(_Task(out, FIRST_SEED + number, (plans[first], plans[first + 1])))
    for line in side_by_side(_simulate, tasks, processes):
        report_line(line)


def difference(cell: Cell, spec: CellSpec, moves: Plan, folder: Path) -> tuple[str, ...]:
    """Fields of a run that differ between the direct path and a recording over the bus; none if both are the same.

    Args:
        cell: as declared.
        spec: its truth, with the disc mounted.
        moves: to make.
        folder: for the log.
    """
    declared = declared_payload("disc")
    direct = run_of(simulate_run(cell, spec, moves, "check", declared), cell)
    bus = open_bus(bus_address(cell))
    try:
        with SimulatedCell(spec, bus):
            record(
                CELL,
                cell,
                moves,
                folder / "check.mcap",
                payload=declared,
                operator="study",
                granted_by="the study of coverage: a simulated cell",
                run_id="coverage-check",
            )
    finally:
        bus.shutdown()
    recorded, _ = load_run(folder / "check.mcap")
    arrays = ("time_s", "position_rad", "current_a", "move", "valid")
    differing = [name for name in arrays if not np.array_equal(getattr(direct, name), getattr(recorded, name))]
    if direct.payload != recorded.payload:
        differing.append("payload")
    return tuple(differing)


def _plan(task: _PlanTask) -> Plan:
    return plan(load_cell(CELL), seed=task.seed, duration_s=task.duration_s)


def _simulate(task: _Task) -> str:
    begun_s = time.process_time()
    raw = simulate_runs(load_cell(CELL), task.seed, task.plans)
    path = task.out / f"{task.seed}.npz"
    write_runs(path, raw)
    samples = sum(len(run.move) for run in raw)
    spent_s = time.process_time() - begun_s
    limited = max(float(run.limited.mean(axis=0).max()) for run in raw)
    size_mb = path.stat().st_size / 1e6
    return f"cell {task.seed}: {samples} samples, at a limit {limited:.1%}, {spent_s:.1f} s, {size_mb:.2f} MB"


def _print_line(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main(arguments: list[str] | None = None) -> int:
    """Check the direct path, or simulate the cells."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.coverage_runs", description=__doc__)
    parser.add_argument("--check", action="store_true", help="compare the direct path with the bus, and end")
    parser.add_argument("--cells", type=int, default=CELLS)
    parser.add_argument("--duration", type=float, default=DURATION_S, help="of each run [s]")
    parser.add_argument("--processes", type=int, default=PROCESSES)
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args(arguments)
    if options.check:
        cell = load_cell(CELL)
        moves = plan(cell, seed=FIRST_SEED, duration_s=10.0)
        with tempfile.TemporaryDirectory() as folder:
            differing = difference(cell, spec_of(study_cell(FIRST_SEED), "disc", 0), moves, Path(folder))
        sys.stdout.write(f"direct path and bus differ in: {', '.join(differing) or 'nothing, to the count'}\n")
        return 1 if differing else 0
    make_coverage(
        options.cells,
        out=options.out,
        duration_s=options.duration,
        processes=options.processes,
        report_line=_print_line,
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
