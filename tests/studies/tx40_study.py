"""Closing the loop on the real TX-40, nested: effects are chosen without the runs that score them.

Run by `make tx40-study`; needs the recording in ../shared/data or $DRIVEGAIN_DATA. The run is cut into blocks of 0.5 s;
each quarter of them, every fourth block, is left out in turn. The rest is a run of its own: it is fitted, the loop is
closed on it with folds of its own blocks, and only then the left-out blocks are predicted. A row whose filter window
touches a block of the other side belongs to neither.
"""

from __future__ import annotations

import os
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.cli.app import main as drivegain
from daq.config.cell import model_of
from daq.environment import shipped_configurations
from daq.log.conversion import load_run
from ident.discovery.evidence import gather
from ident.discovery.loop import find_effects
from ident.equations.rows import Observation
from ident.estimators.estimate import Estimate, RelativeError, of_squares
from ident.estimators.identify import identify
from ident.estimators.method import Method

FloatArray = NDArray[np.float64]

BLOCK_S = 0.5
FOLDS = 4
SHARED = Path(__file__).parents[3] / "shared" / "data"


def squares(rows: Observation, estimate: Estimate) -> tuple[FloatArray, FloatArray]:
    """‖Y_j‖² and ‖ρ_j‖² of each joint [Nm²], shape (n,)."""
    residual, torque = estimate.residual_torque(rows), rows.torque(estimate.gains)
    return np.sum(torque**2, axis=1, where=rows.use), np.sum(residual**2, axis=1, where=rows.use)


def main() -> int:
    """Make the study and print its table."""
    data = Path(os.environ.get("DRIVEGAIN_DATA", SHARED)) / "tx40"
    if not data.is_dir():
        _print_line(
            f"found no {data}; expected the TX-40's recording there, or DRIVEGAIN_DATA to name the folder above it"
        )
        return 2
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "tx40.mcap"
        description = shipped_configurations() / "imports" / "tx40.yaml"
        drivegain(["import", str(description), "--data", str(data), "--out", str(log)])
        run, cell = load_run(log)
    block = np.floor(run.time_s / BLOCK_S).astype(np.int64)
    valid = np.ones_like(run.position_rad, dtype=np.bool_) if run.valid is None else run.valid
    model, n = model_of(cell), len(cell.axes)
    gains = np.array([axis.nameplate_gain for axis in cell.axes])
    size, before, after = np.zeros(n), np.zeros(n), np.zeros(n)
    for fold in range(FOLDS):
        left_out = (block % FOLDS == fold)[:, None]
        training = replace(run, name="the rest", move=block, valid=valid & ~left_out)
        unseen = replace(run, name="left out", move=block, valid=valid & left_out)
        found = identify(model, [training], cell.conditioning, method=Method.ML, fixed_gains=gains)
        start = gather(found, [training], [unseen])
        steps = find_effects(start, np.random.default_rng(0))
        end = steps[-1].after
        if start.holdout is None or end.holdout is None:
            raise ValueError("nothing was left out")
        size += squares(start.holdout, start.estimate)[0]
        before += squares(start.holdout, start.estimate)[1]
        after += squares(end.holdout, end.estimate)[1]
        names = ", ".join(f"{placed.effect.name} on {cell.axis_names[placed.axis]}" for placed in end.effects)
        _print_line(f"fold {fold + 1}: {names or 'nothing'}")
    _print_line("\n| | " + " | ".join(cell.axis_names) + " | mean | total |\n|" + "---|" * (n + 3))
    _print_line(_row("nothing added", of_squares(size, before)))
    _print_line(_row("effects added", of_squares(size, after)))
    return 0


def _row(name: str, error: RelativeError) -> str:
    figures = (*error.axes, float(np.mean(error.axes)), error.total)
    return f"| {name} | " + " | ".join(f"{figure:.2f}" for figure in figures) + " |"


def _print_line(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
