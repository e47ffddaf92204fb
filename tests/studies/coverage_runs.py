"""Runs of many clean simulated cells, for the coverage of the error bars and the bias of the
estimators.

    python -m tests.studies.coverage_runs --check       the direct path against one recording over the bus
    python -m tests.studies.coverage_runs --cells 100   two runs without load and two with the disc of each cell

Each cell has a truth of its own (study_cells.py) and each of its runs a noise of its own; plans are
shared by the cells in turn, because a plan is no part of what an error bar has to cover. Layout:
out/coverage/<world>/<cell>.npz, counts as the amplifiers report them, with the demand that the
position loops followed. What is there is kept. `load_coverage` gives cells back as runs with their
truth.
"""  # noqa: E501

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np

from daq.config.cell import Cell
from daq.config.cell_buses import bus_address
from daq.config.cell_file import load_cell
from daq.log.conversion import load_run
from daq.workflow.plan import Plan, plan
from daq.workflow.record import RecordingRequest, record
from drivers.canopen.bus import open_bus
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.spec import CellSpec
from ident.arrays import FloatArray
from ident.data.run import Run
from tests.studies.direct_cell import MOVING, RawRun, demand_rad, run_of, simulate_run
from tests.studies.fingerprint import digest, digest_of_source, finish, is_finished
from tests.studies.output import print_line
from tests.studies.raw_runs import read_runs, write_runs
from tests.studies.side_by_side import Shard, shard, side_by_side
from tests.studies.study_cells import (
    WORLDS,
    Truth,
    declared_payload,
    spec_of,
    study_cell,
    truth_of,
    world_cell,
)
from tests.studies.study_plans import CELL, PlanTask, kept_plan, make_plan

OUT = Path("out/coverage")
CELLS = 100
DURATION_S = 20.0
PROCESSES = 2
FIRST_SEED = 1001
"""Cells of this study are none of the estimator study's."""
PLAN_PAIRS = 5
RUNS = (("bare-1", None, 0), ("disc-1", "disc", 0), ("bare-2", None, 1), ("disc-2", "disc", 1))
"""Name, payload and plan (the first or second of the cell's pair) of each run."""


@dataclass(frozen=True, slots=True)
class CoverageCell:
    """The runs of one cell, and what its error bars should cover.

    Attributes:
        seed: of the cell.
        truth: of the cell.
        runs: as recorded.
        demand_rad: position demand of the joints in each run [rad], of the shape of its positions.
    """

    seed: int
    truth: Truth
    runs: tuple[Run, ...]
    demand_rad: tuple[FloatArray, ...]


@dataclass(frozen=True, slots=True)
class RunsTask:
    """A cell whose runs are to be simulated.

    Attributes:
        out: folder of the study.
        world: of WORLDS.
        number: of the cell, from 0.
        duration_s: of each run [s].
    """

    out: Path
    world: str
    number: int
    duration_s: float

    @property
    def seed(self) -> int:
        """Seed of the cell's truth and noise."""
        return FIRST_SEED + self.number

    @property
    def path(self) -> Path:
        """File of the runs."""
        return self.out / self.world / f"{self.seed}.npz"

    @property
    def plans(self) -> tuple[PlanTask, PlanTask]:
        """Plans of the first and of the second pair of runs."""
        first = FIRST_SEED + 2 * (self.number % PLAN_PAIRS)
        seed = first + 1
        plan_task = PlanTask(self.out, seed, self.duration_s)
        return PlanTask(self.out, first, self.duration_s), plan_task


def tasks_of(
    cells: int,
    world: str,
    *,
    out: Path = OUT,
    duration_s: float = DURATION_S,
    part: Shard | None = None,
) -> tuple[RunsTask, ...]:
    """The cells of a world, or of one shard of it."""
    tasks = [RunsTask(out, world, number, duration_s) for number in range(cells)]
    return (part or Shard()).of(tasks)


def simulate_runs(
    cell: Cell, seed: int, world: str, plans: tuple[Plan, Plan]
) -> tuple[RawRun, ...]:
    """The four runs of one cell.

    Args:
        cell: as declared.
        seed: of its truth and its noise.
        world: of WORLDS.
        plans: of its first and of its second pair of runs.
    """
    truth = world_cell(seed, world)
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


def load_coverage(tasks: Iterable[RunsTask]) -> Iterator[CoverageCell]:
    """The saved cells, one at a time: a hundred together would fill the memory.

    Raises:
        FileNotFoundError: one was not simulated.
    """
    cell = load_cell(CELL)
    for task in tasks:
        if not task.path.is_file():
            raise FileNotFoundError(
                f"found no {task.path}; run `python -m tests.studies.coverage_runs` first"
            )
        raw = read_runs(task.path)
        runs = tuple(run_of(run, cell) for run in raw)
        demands = tuple(demand_rad(run, cell) for run in raw)
        truth = truth_of(world_cell(task.seed, task.world))
        yield CoverageCell(task.seed, truth, runs, demands)


def make_coverage(
    tasks: Sequence[RunsTask],
    *,
    processes: int = PROCESSES,
    report_line: Callable[[str], None] = lambda _: None,
) -> None:
    """Simulate and save the cells that are missing.

    Args:
        tasks: cells to have.
        processes: side by side.
        report_line: what was done, a line a cell.

    Raises:
        TaskFailed: planning or simulating failed.
    """
    plans = dict.fromkeys(chain.from_iterable(task.plans for task in tasks))
    for line in chain(
        side_by_side(make_plan, plans, processes), side_by_side(make_runs, tasks, processes)
    ):
        report_line(line)


def difference(cell: Cell, spec: CellSpec, moves: Plan, folder: Path) -> tuple[str, ...]:
    """Fields of a run that differ between the direct path and a recording over the bus;
    none if both are the same.

    Args:
        cell: as declared.
        spec: its truth, with the disc mounted.
        moves: to make.
        folder: for the log.
    """
    declared = declared_payload("disc")
    run = simulate_run(cell, spec, moves, "check", declared)
    direct = run_of(run, cell)
    bus = open_bus(bus_address(cell))
    try:
        with SimulatedCell(spec, bus):
            request = RecordingRequest(
                CELL,
                cell,
                moves,
                folder / "check.mcap",
                payload=declared,
                operator="study",
                granted_by="the study of coverage: a simulated cell",
                run_id="coverage-check",
            )
            record(request)
    finally:
        bus.shutdown()
    path = folder / "check.mcap"
    recorded, _ = load_run(path)
    arrays = ("time_s", "position_rad", "current_a", "move", "valid")
    differing = [
        name
        for name in arrays
        if not np.array_equal(getattr(direct, name), getattr(recorded, name))
    ]
    if direct.payload != recorded.payload:
        differing.append("payload")
    return tuple(differing)


def make_runs(task: RunsTask) -> str:
    """Simulate the runs of a cell unless the same ones are there; return what was done."""
    cell = load_cell(CELL)
    path = task.path
    first, second = (kept_plan(made, cell) for made in task.plans)
    moving = digest_of_source("tests.studies.direct_cell", MOVING)
    truth = world_cell(task.seed, task.world)
    sorted_bodies = sorted(truth.bodies.items())
    fingerprint = digest(
        moving,
        cell.digest,
        first.moves,
        second.moves,
        truth.bare.urdf,
        truth.bare.axes,
        sorted_bodies,
    )
    if is_finished(path, fingerprint):
        return f"cell {task.seed}, {task.world}: kept"
    begun_s = time.process_time()
    raw = simulate_runs(cell, task.seed, task.world, (first, second))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_runs(path, raw)
    finish(path, fingerprint)
    samples = sum(len(run.move) for run in raw)
    spent_s = time.process_time() - begun_s
    limited = max(float(run.limited.mean(axis=0).max()) for run in raw)
    size_mb = path.stat().st_size / 1e6
    return (
        f"cell {task.seed}, {task.world}: {samples} samples, at a limit {limited:.1%}, "
        f"{spent_s:.1f} s, {size_mb:.2f} MB"
    )


def main(arguments: list[str] | None = None) -> int:
    """Check the direct path, or simulate the cells."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.coverage_runs", description=__doc__
    )
    parser.add_argument(
        "--check", action="store_true", help="compare the direct path with the bus, and end"
    )
    parser.add_argument("--cells", type=int, default=CELLS)
    parser.add_argument("--world", choices=WORLDS, default="measurement")
    parser.add_argument(
        "--shard", type=shard, default=Shard(), help="i/n: every n-th cell from the i-th on"
    )
    parser.add_argument("--duration", type=float, default=DURATION_S, help="of each run [s]")
    parser.add_argument("--processes", type=int, default=PROCESSES)
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args(arguments)
    if options.check:
        cell = load_cell(CELL)
        moves = plan(cell, seed=FIRST_SEED, duration_s=10.0)
        with tempfile.TemporaryDirectory() as folder:
            spec = spec_of(study_cell(FIRST_SEED), "disc", 0)
            differing = difference(cell, spec, moves, Path(folder))
        sys.stdout.write(
            f"direct path and bus differ in: {', '.join(differing) or 'nothing, to the count'}\n"
        )
        return 1 if differing else 0
    tasks = tasks_of(
        options.cells,
        options.world,
        out=options.out,
        duration_s=options.duration,
        part=options.shard,
    )
    make_coverage(tasks, processes=options.processes, report_line=print_line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
