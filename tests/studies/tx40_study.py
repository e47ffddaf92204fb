"""Closing the loop on the real TX-40, nested: effects are chosen without the runs that score them.

Run by `make tx40-study`; needs the recording in ../shared/data or $DRIVEGAIN_DATA. The run is cut
into blocks of 0.5 s; each quarter of them, every fourth block, is left out in turn. The rest is a
run of its own: it is fitted, the loop is closed on it with folds of its own blocks, and only then
the left-out blocks are predicted. A row whose filter window touches a block of the other side
belongs to neither.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

from daq.config.cell import model_of
from ident.discovery.evidence import gather
from ident.discovery.loop import find_effects
from ident.estimators.estimate import RelativeError, of_squares
from ident.estimators.identify import identify
from ident.estimators.method import Method
from tests.studies.output import print_line
from tests.studies.real_runs import data_folder, stretches, tx40
from tests.studies.real_splits import squares


def main() -> int:
    """Make the study and print its table."""
    data = data_folder() / "tx40"
    if not data.is_dir():
        print_line(
            f"found no {data}; expected the TX-40's recording there, or DRIVEGAIN_DATA to name the "
            "folder above it"
        )
        return 2
    recording = tx40(data_folder())
    cell = recording.cell
    (run,) = recording.runs
    (fold_of,) = recording.part_of
    block = stretches(run, recording.stretch_s)
    if run.valid is None:
        valid = np.ones_like(run.position_rad, dtype=np.bool_)
    else:
        valid = run.valid
    model = model_of(cell)
    n = len(cell.axes)
    gains = recording.gains
    size = np.zeros(n)
    before = np.zeros(n)
    after = np.zeros(n)
    for fold in range(recording.parts):
        left_out = (fold_of == fold)[:, None]
        training = replace(run, name="the rest", move=block, valid=valid & ~left_out)
        unseen = replace(run, name="left out", move=block, valid=valid & left_out)
        found = identify(model, [training], cell.conditioning, method=Method.ML, fixed_gains=gains)
        start = gather(found, [training], [unseen])
        rng = np.random.default_rng(0)
        steps = find_effects(start, rng)
        end = steps[-1].after
        if start.holdout is None or end.holdout is None:
            raise ValueError("nothing was left out")
        size += squares(start.holdout, start.estimate)[0]
        before += squares(start.holdout, start.estimate)[1]
        after += squares(end.holdout, end.estimate)[1]
        names = ", ".join(
            f"{placed.effect.name} on {cell.axis_names[placed.axis]}" for placed in end.effects
        )
        line = f"fold {fold + 1}: {names or 'nothing'}"
        print_line(line)
    print_line("\n| | " + " | ".join(cell.axis_names) + " | mean | total |\n|" + "---|" * (n + 3))
    error = of_squares(size, before)
    print_line(_row("nothing added", error))
    print_line(_row("effects added", of_squares(size, after)))
    return 0


def _row(name: str, error: RelativeError) -> str:
    mean_axis = float(np.mean(error.axes))
    figures = (*error.axes, mean_axis, error.total)
    return f"| {name} | " + " | ".join(f"{figure:.2f}" for figure in figures) + " |"


if __name__ == "__main__":
    sys.exit(main())
