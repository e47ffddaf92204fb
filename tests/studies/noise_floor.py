"""How the relative error of a fit of a clean cell grows with its current noise;
what the study's noise factors rest on.

`python -m tests.studies.noise_floor --seeds 1 2 --factors 1 3` prints a line a cell and factor.
"""

from __future__ import annotations

import argparse
import sys

from daq.config.cell import model_of
from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.workflow.plan import plan
from ident.estimators.identify import identify
from ident.estimators.method import Method
from tests.studies.direct_cell import run_of, simulate_run
from tests.studies.study_cells import declared_payload, spec_of, study_cell

RUNS = ((None, 0), ("disc", 0), (None, 1), ("disc", 1))
"""Payload and plan of each run, as in the study's fits."""


def main(arguments: list[str] | None = None) -> int:
    """Print relative errors and gain errors of each cell and factor."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.noise_floor", description=__doc__
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--factors", type=float, nargs="+", default=[1.0, 3.0])
    parser.add_argument("--duration", type=float, default=20.0, help="of each run [s]")
    options = parser.parse_args(arguments)
    path = shipped_configurations() / "cells" / "demo.yaml"
    cell = load_cell(path)
    sys.stdout.write("| seed | factor | relative error % | gain errors % |\n|---|---|---|---|\n")
    for seed in options.seeds:
        plans = [
            plan(cell, seed=10 * seed + index, duration_s=options.duration) for index in range(2)
        ]
        for factor in options.factors:
            truth = study_cell(seed, factor)
            runs = []
            for number, (payload, moves) in enumerate(RUNS):
                if payload is None:
                    declared = None
                else:
                    declared = declared_payload(payload)
                spec = spec_of(truth, payload, number)
                raw = simulate_run(cell, spec, plans[moves], f"run-{number}", declared)
                runs.append(run_of(raw, cell))
            found = identify(model_of(cell), tuple(runs), cell.conditioning, method=Method.ML)
            true = [axis.gain_nm_per_a for axis in truth.bare.axes]
            errors = [
                100.0 * (gain / value - 1.0)
                for gain, value in zip(found.estimate.gains, true, strict=True)
            ]
            reported = ", ".join(f"{error:+.2f}" for error in errors)
            sys.stdout.write(
                f"| {seed} | {factor:g} | {found.training_error.total:.2f} | {reported} |\n"
            )
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
