"""Coverage of the 95 % intervals of the gains in four cases, over many small simulated cells.

    python -m tests.studies.coverage_cases --case clean disturbance --cells 100

- clean: noise of the measurement, point-to-point moves;
- disturbance: a torque of 3 % of rated inside the position loops;
- after-loop: as clean, with one undeclared effect that the search has to find;
- continuous: as clean, in motion without any rest.

Each cell has a truth, motions and noise of its own: two runs of 20 s without load and two with the
disc. Runs and scores are kept in out/coverage-cases/<case>/; runs outlive any change but of the
simulation, scores any change but of what they measure. A study that was interrupted goes on where
it was; `--shard 2/4` takes every fourth cell from the second on, and the table has all that is
there.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np

from daq.config.cell import Cell, model_of
from daq.config.cell_file import load_cell
from daq.files import replace_file
from drivers.simulation.spec import UndeclaredEffect
from ident.arrays import FloatArray
from ident.discovery.evidence import gather
from ident.discovery.loop import find_effects
from ident.effects.effect import PlacedEffect
from ident.estimators.identify import identify
from ident.estimators.method import Method
from tests.studies.direct_cell import MOVING, RawRun, run_of
from tests.studies.effect_cells import SINGLE_EFFECTS
from tests.studies.fingerprint import digest, digest_of_source, finish, is_finished, mark_of
from tests.studies.followed_cell import Demand, follow, point_to_point, without_rest
from tests.studies.loop_noise import NORMAL_95, GainScore, table
from tests.studies.raw_runs import read_runs, write_runs
from tests.studies.side_by_side import Shard, shard, side_by_side
from tests.studies.study_cells import declared_payload, spec_of, world_cell
from tests.studies.study_plans import CELL

OUT = Path("out/coverage-cases")
CELLS = 100
DURATION_S = 20.0
BETWEEN_S = 60.0  #: From the beginning of one run to that of the next
FIRST_SEED = 6001
RUNS = (("bare-1", None), ("disc-1", "disc"), ("bare-2", None), ("disc-2", "disc"))
EFFECTS = tuple(chain.from_iterable(SINGLE_EFFECTS))


@dataclass(frozen=True, slots=True)
class Case:
    """World, motion and search of a case.

    Attributes:
        world: of WORLDS.
        motion: of every run.
        searched: the cell has one effect of EFFECTS, and the search looks for it.
    """

    world: str
    motion: Callable[[Cell, FloatArray, np.random.Generator, float], Demand]
    searched: bool = False


CASES = {
    "clean": Case("measurement", point_to_point),
    "disturbance": Case("loop3", point_to_point),
    "after-loop": Case("measurement", point_to_point, searched=True),
    "continuous": Case("measurement", without_rest),
}


@dataclass(frozen=True, slots=True)
class CaseTask:
    """One cell of a case, and the estimator that scores it."""

    out: Path
    case: str
    number: int
    method: str = Method.ML.value

    @property
    def seed(self) -> int:
        """Seed of the cell's truth, motions and noise: the same cell in every case."""
        return FIRST_SEED + self.number

    @property
    def effects(self) -> tuple[UndeclaredEffect, ...]:
        """Undeclared effects of the cell; each of EFFECTS comes once before one comes again."""
        if CASES[self.case].searched:
            return (EFFECTS[self.number % len(EFFECTS)],)
        return ()

    @property
    def path(self) -> Path:
        """File of the runs."""
        return self.out / self.case / f"{self.seed}.npz"

    @property
    def score_path(self) -> Path:
        """File of the score."""
        return self.path.with_suffix(f".{self.method}.json")


def simulate(task: CaseTask, cell: Cell) -> tuple[RawRun, ...]:
    """The four runs of a cell."""
    case = CASES[task.case]
    world = CASES[task.case].world
    truth = world_cell(task.seed, world)
    runs = []
    for number, (name, payload) in enumerate(RUNS):
        spec = replace(spec_of(truth, payload, number), effects=task.effects)
        rng = np.random.default_rng([task.seed, number])
        demand = case.motion(cell, spec.start_rad, rng, DURATION_S)
        if payload is None:
            declared = None
        else:
            declared = declared_payload(payload)
        began_s = BETWEEN_S * number
        runs.append(follow(cell, spec, demand, name, declared, began_s))
    return tuple(runs)


def make_runs(task: CaseTask, cell: Cell) -> None:
    """Simulate the runs of a cell unless the same ones are there."""
    world = CASES[task.case].world
    spec = world_cell(task.seed, world).bare
    rooms = (*MOVING, "tests.studies.followed_cell")
    source = digest_of_source("tests.studies.followed_cell", rooms)
    fingerprint = digest(source, cell.digest, DURATION_S, spec.urdf, spec.axes, task.effects)
    if not is_finished(task.path, fingerprint):
        task.path.parent.mkdir(parents=True, exist_ok=True)
        write_runs(task.path, simulate(task, cell))
        finish(task.path, fingerprint)


def make(task: CaseTask) -> str:
    """Simulate and score a cell as far as that was not done; return what was done."""
    cell = load_cell(CELL)
    begun_s = time.process_time()
    make_runs(task, cell)
    simulated_s = time.process_time() - begun_s
    searched = CASES[task.case].searched
    ways = ("ident.discovery.loop" if searched else "ident.estimators.identify",)
    text = mark_of(task.path).read_text()
    fingerprint = digest(*map(digest_of_source, ways), text)
    if is_finished(task.score_path, fingerprint):
        return f"{task.case} {task.seed}: kept"
    score = score_of(task, cell)
    content = json.dumps(asdict(score)).encode()
    replace_file(task.score_path, content)
    finish(task.score_path, fingerprint)
    absolute_error_percent = np.abs(score.error_percent)
    worst = float(absolute_error_percent.max())
    found = ", ".join(score.effects)
    return (
        f"{task.case} {task.seed}: worst gain {worst:.2f} %, simulated in {simulated_s:.1f} s, "
        f"scored in {score.processor_s:.1f} s {found}"
    )


def score_of(task: CaseTask, cell: Cell) -> GainScore:
    """Identify the gains of a cell whose runs are there,
    after the search where the case has one.
    """
    runs = [run_of(raw, cell) for raw in read_runs(task.path)]
    begun_s = time.process_time()
    found = identify(model_of(cell), runs, cell.conditioning, method=Method(task.method))
    estimate = found.estimate
    error = found.training_error.total
    effects: tuple[PlacedEffect, ...] = ()
    if CASES[task.case].searched:
        rng = np.random.default_rng(0)
        last_effect = find_effects(gather(found, runs), rng)[-1]
        end = last_effect.after
        estimate = end.estimate
        effects = end.effects
        system = end.training.system()
        error = estimate.relative_error(system).total
    spent_s = time.process_time() - begun_s
    world = CASES[task.case].world
    bare = world_cell(task.seed, world).bare
    gain_nm_per_a = [axis.gain_nm_per_a for axis in bare.axes]
    true = np.array(gain_nm_per_a)
    error_percent = tuple((100.0 * (estimate.gains / true - 1.0)).tolist())
    gain_difference = estimate.gains - true
    return GainScore(
        seed=task.seed,
        error_percent=error_percent,
        z=tuple((gain_difference / estimate.gains_std).tolist()),
        relative_error_percent=error,
        processor_s=spent_s,
        effects=tuple(placed.name_among(cell.axis_names) for placed in effects),
    )


def pooled(scores: list[GainScore]) -> str:
    """Coverage of all intervals with its standard error:
    the gains of one cell share their noise, cells do not.
    """
    inside = np.abs([one.z for one in scores]) <= NORMAL_95
    share = 100.0 * inside.mean()
    if len(inside) > 1:
        count_root = np.sqrt(len(inside))
        mean_inside = inside.mean(axis=1)
        error = 100.0 * mean_inside.std(ddof=1) / count_root
    else:
        error = float("nan")
    return f"{share:.1f} ± {error:.1f} % of the 95 % intervals hold the truth"


def main(arguments: list[str] | None = None) -> int:
    """Make what is missing, then print a table a case."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.coverage_cases", description=__doc__
    )
    parser.add_argument("--case", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--cells", type=int, default=CELLS)
    parser.add_argument(
        "--shard", type=shard, default=Shard(), help="i/n: every n-th cell from the i-th on"
    )
    choices = (Method.ML.value, Method.IV.value)
    parser.add_argument("--method", choices=choices, default=Method.ML.value)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args(arguments)
    axes = load_cell(CELL).axis_names
    for case in options.case:
        tasks = [
            CaseTask(options.out, case, number, options.method) for number in range(options.cells)
        ]
        for line in side_by_side(make, options.shard.of(tasks), options.processes):
            sys.stdout.write(line + "\n")
            sys.stdout.flush()
        kept = [
            json.loads(task.score_path.read_text()) for task in tasks if task.score_path.is_file()
        ]
        scores = [GainScore(**document) for document in kept]
        sys.stdout.write(
            f"\n{case}, {options.method}, {len(scores)} cells: "
            f"{pooled(scores)}\n\n{table(scores, axes)}\n\n"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
