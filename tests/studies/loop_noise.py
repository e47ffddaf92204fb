"""Bias of an estimator and truth of its σ where the noise goes round the position loop.

Run by `make loop-noise-study`; simulates what is missing (coverage_runs.py), identifies every cell
of each world and prints a table a world. `--shard 2/4` takes every fourth cell from the second on,
and prints what is there of all.

    python -m tests.studies.loop_noise --world loop3 --cells 8 --method ml wls

Errors are of the gains against the truth of each cell; z is error / σ. Runs and scores are kept:
another estimator reads the same samples, and finds the position demand of every run in
`CoverageCell.demand_rad`.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path

import numpy as np

from daq.config.cell import model_of
from daq.config.cell_file import load_cell
from daq.files import replace_file
from ident.estimators.identify import identify
from ident.estimators.method import Method
from tests.studies.coverage_runs import (
    DURATION_S,
    OUT,
    PROCESSES,
    RunsTask,
    load_coverage,
    make_coverage,
    tasks_of,
)
from tests.studies.fingerprint import digest, digest_of_source, finish, is_finished, mark_of
from tests.studies.side_by_side import Shard, shard, side_by_side
from tests.studies.study_cells import WORLDS
from tests.studies.study_plans import CELL

CELLS = 8
NORMAL_95 = 1.959964
"""Half-width of a 95 % interval in standard deviations:
some hundred moves leave nothing of Student's t.
"""


@dataclass(frozen=True, slots=True)
class GainScore:
    """One estimator on one cell.

    Attributes:
        seed: of the cell.
        error_percent: of each gain.
        z: error of each gain in its σ.
        relative_error_percent: of the fit.
        processor_s: of the identification.
        effects: in the model, where they were searched for.
    """

    seed: int
    error_percent: tuple[float, ...]
    z: tuple[float, ...]
    relative_error_percent: float
    processor_s: float
    effects: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _Task:
    runs: RunsTask
    method: str

    @property
    def path(self) -> Path:
        return self.runs.path.with_suffix(f".{self.method}.json")


def make_score(task: _Task) -> str:
    """Identify a cell unless it was done with the same runs and software; return what was done."""
    fingerprint = digest(
        digest_of_source("ident.estimators.identify"), mark_of(task.runs.path).read_text()
    )
    if is_finished(task.path, fingerprint):
        return f"{task.path.name}, {task.runs.world}: kept"
    (case,) = load_coverage([task.runs])
    cell = load_cell(CELL)
    begun_s = time.process_time()
    found = identify(model_of(cell), case.runs, cell.conditioning, method=Method(task.method))
    spent_s = time.process_time() - begun_s
    true = np.array(case.truth.gains_nm_per_a)
    error = found.estimate.gains - true
    error_percent = tuple((100.0 * error / true).tolist())
    score = GainScore(
        seed=case.seed,
        error_percent=error_percent,
        z=tuple((error / found.estimate.gains_std).tolist()),
        relative_error_percent=found.training_error.total,
        processor_s=spent_s,
    )
    content = json.dumps(asdict(score)).encode()
    replace_file(task.path, content)
    finish(task.path, fingerprint)
    return (
        f"{task.path.name}, {task.runs.world}: worst gain "
        f"{np.abs(score.error_percent).max():.2f} %, {spent_s:.1f} s"
    )


def table(scores: Sequence[GainScore], axes: Sequence[str]) -> str:
    """Errors, scores and coverage by axis and of all."""
    error_percent = [one.error_percent for one in scores]
    error = np.array(error_percent)
    z = np.array([one.z for one in scores])
    columns = [*((error[:, i], z[:, i]) for i in range(len(axes))), (error, z)]
    rows = (
        ("mean absolute error of the gain, %", [f"{np.abs(e).mean():.2f}" for e, _ in columns]),
        ("largest, %", [f"{np.abs(e).max():.2f}" for e, _ in columns]),
        ("mean error (bias), %", [f"{e.mean():+.2f}" for e, _ in columns]),
        ("mean z", [f"{s.mean():+.2f}" for _, s in columns]),
        ("z, root mean square", [f"{np.sqrt(np.mean(s**2)):.2f}" for _, s in columns]),
        (
            "95 % intervals that hold the truth, %",
            [f"{100.0 * (np.abs(s) <= NORMAL_95).mean():.0f}" for _, s in columns],
        ),
    )
    lines = [f"| | {' | '.join(axes)} | all |", "|---" * (len(axes) + 2) + "|"]
    return "\n".join([*lines, *(f"| {name} | {' | '.join(texts)} |" for name, texts in rows)])


def _print_line(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main(arguments: list[str] | None = None) -> int:
    """Simulate and identify what is missing, then print a table a world."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.loop_noise", description=__doc__)
    parser.add_argument("--world", nargs="+", choices=WORLDS, default=list(WORLDS))
    parser.add_argument("--cells", type=int, default=CELLS)
    parser.add_argument(
        "--shard", type=shard, default=Shard(), help="i/n: every n-th cell from the i-th on"
    )
    choices = [one.value for one in Method]
    default = [Method.ML.value]
    parser.add_argument("--method", nargs="+", choices=choices, default=default)
    parser.add_argument("--duration", type=float, default=DURATION_S, help="of each run [s]")
    parser.add_argument("--processes", type=int, default=PROCESSES)
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args(arguments)
    axes = load_cell(CELL).axis_names
    for world in options.world:
        tasks = tasks_of(options.cells, world, out=options.out, duration_s=options.duration)
        mine = options.shard.of(tasks)
        make_coverage(mine, processes=options.processes, report_line=_print_line)
        scoring = [_Task(task, method) for method, task in product(options.method, mine)]
        for line in side_by_side(make_score, scoring, options.processes):
            _print_line(line)
        for method in options.method:
            paths = [_Task(task, method).path for task in tasks]
            scores = [GainScore(**json.loads(path.read_text())) for path in paths if path.is_file()]
            relative_error_percent = [score.relative_error_percent for score in scores]
            noise = float(np.mean(relative_error_percent))
            _print_line(f"\n{world}, {method}: {len(scores)} cells, relative error {noise:.2f} %\n")
            _print_line(table(scores, axes) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
