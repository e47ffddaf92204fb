"""Where total least squares is as good as maximum likelihood, and where it is not.

    python -m tests.studies.tls_study

Twelve clean cells, then a cell for each undeclared effect of the effects study, which the model of
the fit lacks, then cells with an undeclared effect on every axis. All estimators see the same rows.
Run by `make tls-study`; the runs of the first two are those of `make coverage-study`, and all are
kept in out/coverage-cases. Writes docs/evidence/data/tls-model-errors.csv.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from daq.config.cell import model_of
from daq.config.cell_file import load_cell
from drivers.simulation.spec import UndeclaredEffect
from ident.arrays import FloatArray
from ident.equations.reduction import reduce_runs, regrouped
from ident.equations.system import System
from ident.estimators.estimate import Estimate
from ident.estimators.least_squares import Scaling, parameters_over_noise, tls, wls
from ident.estimators.maximum_likelihood import ml
from tests.studies.coverage_cases import EFFECTS, OUT, CaseTask, make_runs
from tests.studies.direct_cell import run_of
from tests.studies.output import as_csv, print_line
from tests.studies.raw_runs import read_runs
from tests.studies.side_by_side import side_by_side
from tests.studies.study_cells import world_cell
from tests.studies.study_plans import CELL

TABLE = Path("docs/evidence/data/tls-model-errors.csv")
CLEAN_CELLS = 12
CROWDED_CELLS = 6
ON_EVERY_AXIS = (
    "nonlinear-viscous",
    "stribeck",
    "load-friction",
    "coupling",
    "position-friction",
    "cogging",
)
"""Effects of J1 to J6 in the cells that have one on every axis."""
WORLD = "measurement"
ESTIMATORS: dict[str, Callable[[System], Estimate]] = {
    "ml": ml,
    "tls": tls,
    "tls, residual weights": lambda system: tls(system, Scaling.RESIDUALS),
    "wls": wls,
}


class CrowdedTask(CaseTask):
    """A cell with an undeclared effect on every axis."""

    @property
    def effects(self) -> tuple[UndeclaredEffect, ...]:
        """One effect for each axis."""
        by_place = {(effect.name, effect.axis): effect for effect in EFFECTS}
        return tuple(by_place[name, axis] for axis, name in enumerate(ON_EVERY_AXIS))

    @property
    def path(self) -> Path:
        """File of the runs."""
        crowded_folder = self.out / "crowded"
        return crowded_folder / f"{self.seed}.npz"


@dataclass(frozen=True, slots=True)
class CellErrors:
    """Errors of the gains of one cell.

    Attributes:
        title: undeclared effects and their axes, empty for a clean cell.
        relative_error_percent: of the fit by ml.
        gain_errors_percent: of each gain, by estimator.
        tls_shift_sigmas: |tls − ml| of each gain, in σ of ml.
        tls_shift_percent: the same, in per cent of ml.
        scores: error of each gain over its σ, by estimator; eqs. (10) and (23) for wls and tls.
        parameters_over_noise: of each joint.
    """

    title: str
    relative_error_percent: float
    gain_errors_percent: dict[str, FloatArray]
    tls_shift_sigmas: FloatArray
    tls_shift_percent: FloatArray
    scores: dict[str, FloatArray]
    parameters_over_noise: FloatArray


def errors_of(task: CaseTask) -> CellErrors:
    """Errors of every estimator on one cell, whose runs are made if they are missing."""
    cell = load_cell(CELL)
    make_runs(task, cell)
    runs = [run_of(raw, cell) for raw in read_runs(task.path)]
    standard = reduce_runs(model_of(cell), runs, cell.conditioning)
    system = regrouped(standard)
    axes = world_cell(task.seed, WORLD).bare.axes
    gain_nm_per_a = [axis.gain_nm_per_a for axis in axes]
    true_gains = np.array(gain_nm_per_a)
    estimates = {name: estimator(system) for name, estimator in ESTIMATORS.items()}
    title = ", ".join(f"{effect.name} on {cell.axis_names[effect.axis]}" for effect in task.effects)
    gain_difference = estimates["tls"].gains - estimates["ml"].gains
    shift = np.abs(gain_difference)
    relative_error_percent = estimates["ml"].relative_error(system).total
    gain_errors_percent = {
        name: 100.0 * np.abs(estimate.gains / true_gains - 1.0)
        for name, estimate in estimates.items()
    }
    scores = {
        name: (estimate.gains - true_gains) / estimate.gains_std
        for name, estimate in estimates.items()
    }
    absolute_gain = np.abs(estimates["ml"].gains)
    tls_shift_percent = 100.0 * shift / absolute_gain
    tls_shift_sigmas = shift / estimates["ml"].gains_std
    return CellErrors(
        title=title,
        relative_error_percent=relative_error_percent,
        gain_errors_percent=gain_errors_percent,
        tls_shift_sigmas=tls_shift_sigmas,
        tls_shift_percent=tls_shift_percent,
        scores=scores,
        parameters_over_noise=parameters_over_noise(system),
    )


def table(
    clean: Sequence[CellErrors], bent: Sequence[CellErrors], crowded: Sequence[CellErrors]
) -> str:
    """Mean and largest gain errors as a Markdown table:
    a row for the clean cells, for each effect, for all effects.
    """
    headings = (
        "undeclared effect",
        "fit %",
        *(f"{name}, mean / max %" for name in ESTIMATORS),
        "tls − ml, max σ / %",
    )
    lines = ["| " + " | ".join(headings) + " |", "|---" * len(headings) + "|"]
    groups = [(f"none, {len(clean)} cells", list(clean))]
    groups += [(cell.title, [cell]) for cell in bent]
    groups += [(f"any one of these, {len(bent)} cells", list(bent))]
    groups += [(f"one on every axis, {len(crowded)} cells", list(crowded))]
    for title, cells in groups:
        relative_error_percent = [cell.relative_error_percent for cell in cells]
        fit_percent = float(np.mean(relative_error_percent))
        sizes = []
        for name in ESTIMATORS:
            gain_errors_percent = [cell.gain_errors_percent[name] for cell in cells]
            errors = np.concatenate(gain_errors_percent)
            sizes.append(f"{errors.mean():.2f} / {errors.max():.2f}")
        sigmas = max(float(cell.tls_shift_sigmas.max()) for cell in cells)
        percents = max(float(cell.tls_shift_percent.max()) for cell in cells)
        sizes.append(f"{sigmas:.1f} / {percents:.2f}")
        lines.append(f"| {title} | {fit_percent:.1f} | " + " | ".join(sizes) + " |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Make what is missing, print the table and write it for the page."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.tls_study", description=__doc__)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--table", type=Path, default=TABLE)
    options = parser.parse_args(arguments)
    clean_tasks = [CaseTask(options.out, "clean", number) for number in range(CLEAN_CELLS)]
    bent_tasks = [CaseTask(options.out, "after-loop", number) for number in range(len(EFFECTS))]
    crowded_tasks = [CrowdedTask(options.out, "clean", number) for number in range(CROWDED_CELLS)]
    tasks = [*clean_tasks, *bent_tasks, *crowded_tasks]
    found = list(side_by_side(errors_of, tasks, options.processes))
    clean = found[:CLEAN_CELLS]
    bent = found[CLEAN_CELLS:-CROWDED_CELLS]
    text = table(clean, bent, found[-CROWDED_CELLS:])
    print_line(text)
    means = {}
    for name in ESTIMATORS:
        means[name] = float(np.mean([cell.gain_errors_percent[name] for cell in clean]))
    line = f"clean cells: tls / ml = {means['tls'] / means['ml']:.2f}"
    print_line(line)
    for name in ("ml", "tls"):
        scores = np.concatenate([cell.scores[name] for cell in clean])
        print_line(
            f"clean cells: error / σ of {name}, root mean square {np.sqrt(np.mean(scores**2)):.2f}"
        )
    parameters_over_noises = [cell.parameters_over_noise for cell in found]
    ratios = np.concatenate(parameters_over_noises)
    print_line(
        f"smallest singular values without and with the currents: ratio {ratios.min():.1f} to "
        f"{ratios.max():.1f}"
    )
    options.table.write_text(as_csv(text), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
