"""Is σ that the planner predicts for further recordings the σ of a fit that has them?

    python -m tests.studies.planner_study --recordings 8

The arm of `pairs_study`, without undeclared effects: two runs of 20 s without load, two with the
disc. A fit of the first two gives gains, parameters and noise; from them and from the motion of all
four the planner predicts σ of every gain, as a session does for its next blocks
(`daq.workflow.outlook`): its own σ, times σ of the fit over its own σ for what was fitted. Then all
four are fitted. Worlds `loop3` and `loop8` disturb the joints slowly, by 3 and 8 % of their torque.
Printed are predicted σ over that of the fit, by axis: geometric means over recordings, and the
extremes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from daq.config.cell import Cell, model_of
from daq.config.cell_file import load_cell
from daq.files import replace_file
from daq.workflow.verdicts import design_after
from ident.arrays import FloatArray
from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.estimators.estimate import Identification
from ident.estimators.identify import identify
from ident.planning.excitation import Excitation, recorded
from ident.planning.target import recorded_information
from tests.studies.output import as_csv, print_line
from tests.studies.pairs_study import record_runs
from tests.studies.study_plans import CELL

WORLDS = ("quiet", "measurement", "loop3", "loop8")
RECORDINGS = 8  #: Of each world
FITTED_FIRST = 2  #: Runs that the prediction is made from


@dataclass(frozen=True, slots=True, eq=False)
class PredictedStd:
    """Predicted over fitted σ of one recording."""

    alone: FloatArray  #: by the noise of the first fit alone, shape (n,)
    scaled: FloatArray  #: times σ of the first fit over the prediction for its own runs, shape (n,)


def predicted_std(cell: Cell, runs: Sequence[Run]) -> PredictedStd:
    """Predict σ of all runs from the first of them, and compare it with the fit of all.

    Args:
        cell: of the arm.
        runs: with and without load in turn.
    """
    model = model_of(cell)
    first = identify(model, runs[:FITTED_FIRST], cell.conditioning)
    everything = identify(model, runs, cell.conditioning)
    design = design_after(first)
    motions = [_motion_of(run, first) for run in runs]
    for_first = design.std_percent(recorded_information(design, motions[:FITTED_FIRST]))
    for_all = design.std_percent(recorded_information(design, motions))
    alone = for_all / _std_percent(everything)
    scaled = alone * _std_percent(first) / for_first
    return PredictedStd(alone, scaled)


def _motion_of(run: Run, fitted: Identification) -> tuple[Excitation, tuple[int | None, ...]]:
    mountings = [payload.mounting for payload in fitted.system.payloads]
    data = differentiate(run, fitted.model.drive_train, fitted.conditioning)
    if run.payload is None:
        mounted = None
    else:
        mounted = mountings.index(run.payload.mounting)
    return recorded(fitted.model, data, fitted.conditioning), (mounted,)


def _std_percent(fitted: Identification) -> FloatArray:
    estimate = fitted.estimate
    absolute_gain = np.abs(estimate.gains)
    return np.asarray(100.0 * estimate.gains_std / absolute_gain)


def table_rows(world: str, found: Sequence[PredictedStd]) -> list[str]:
    """Rows of the Markdown table of one world."""
    rows: list[str] = []
    for name, ratios in (
        ("scaled by the fit", np.array([one.scaled for one in found])),
        ("by the noise alone", np.array([one.alone for one in found])),
    ):
        means = np.exp(np.mean(np.log(ratios), axis=0))
        numbers = " | ".join(f"{mean:.2f}" for mean in means)
        rows.append(f"| {world} | {name} | {numbers} | {ratios.min():.2f} to {ratios.max():.2f} |")
    return rows


def main(arguments: list[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.planner_study", description=__doc__
    )
    parser.add_argument("--world", nargs="+", choices=WORLDS, default=list(WORLDS))
    parser.add_argument("--recordings", type=int, default=RECORDINGS, help="of each world")
    parser.add_argument("--tables", type=Path, help="folder for the table as CSV")
    options = parser.parse_args(arguments)
    cell = load_cell(CELL)
    axes = cell.axis_names
    lines = [
        f"| world | predicted over fitted σ | {' | '.join(axes)} | all |",
        "|---" * (len(axes) + 3) + "|",
    ]
    for world in options.world:
        found: list[PredictedStd] = []
        for number in range(options.recordings):
            runs = record_runs(cell, world, number, effects=())
            found.append(predicted_std(cell, runs))
            line = f"{world} {number}: {np.round(found[-1].scaled, 2)}"
            print_line(line)
        lines += table_rows(world, found)
    shown = "\n".join(lines)
    print_line(shown)
    if options.tables is not None:
        path = options.tables / "planner-std.csv"
        content = as_csv(shown).encode()
        replace_file(path, content)
    return 0


if __name__ == "__main__":
    sys.exit(main())
