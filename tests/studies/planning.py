"""How much better planned moves are than random ones: the table of docs/evidence/planning.md.

    python -m tests.studies.planning

Random plans keep the same limits, clearance and duration. "Truth" judges both with parameters that
the planner does not know: inertias, friction, gains and payload of tests/ident/recordings.py.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from daq.config.cell_file import load_cell
from daq.workflow.choices import EXCHANGES
from daq.workflow.experiment import RUNS, Experiment, experiment_of, paths_of
from daq.workflow.plan import Plan, plan
from ident.model.bodies import LINK_PARAMETERS
from ident.planning.excitation import Design, ExpectedPayload
from tests.ident.recordings import GAINS, PAYLOAD_TRUTH, tx40_truth

CELLS = Path(__file__).parents[2] / "configs" / "cells"
CASES = (("demo", 1), ("demo", 2), ("demo", 3), ("seven-axis", 1), ("gantry", 1))
RANDOM_SEEDS = range(100, 109)
DURATION_S = 40.0
ANYTHING = 1e9
"""No plan of the study is refused."""


def main() -> None:
    """Print the table."""
    out = sys.stdout
    out.write(
        "| cell, seed | random σ % (median) | planned σ % | lower by | with truth: random, "
        "planned | CPU s |\n"
    )
    out.write("|---|---|---|---|---|---|\n")
    for name, seed in CASES:
        path = CELLS / f"{name}.yaml"
        experiment = experiment_of(load_cell(path))
        truth = _truth(experiment) if name == "demo" else None
        random = [_plan(experiment, other, 0) for other in RANDOM_SEEDS]
        started = time.process_time()
        planned = _plan(experiment, seed, EXCHANGES)
        seconds = time.process_time() - started
        before = float(np.median([max(one.predicted_std_percent) for one in random]))
        after = max(planned.predicted_std_percent)
        judged = "–"
        if truth is not None:
            both = (np.median([_worst(truth, one) for one in random]), _worst(truth, planned))
            judged = f"{both[0]:.2f}, {both[1]:.2f}"
        lower = 100.0 * (1.0 - after / before)
        out.write(
            f"| {name}, {seed} | {before:.2f} | {after:.2f} | {lower:.0f} % | {judged} | "
            f"{seconds:.0f} |\n"
        )
        out.flush()


def _plan(experiment: Experiment, seed: int, exchanges: int) -> Plan:
    return plan(
        experiment.cell,
        seed=seed,
        duration_s=DURATION_S,
        exchanges=exchanges,
        largest_condition=ANYTHING if exchanges == 0 else 3500.0,
        largest_std_percent=ANYTHING,
        experiment=experiment,
    )


def _truth(experiment: Experiment) -> Experiment:
    parameters = np.array([PAYLOAD_TRUTH[name] for name in LINK_PARAMETERS])
    known = frozenset({"m"})
    payload = ExpectedPayload(known, parameters)
    expectation = replace(
        experiment.design.expectation,
        gains=GAINS,
        parameters=tx40_truth().parameters,
        payloads=(payload,),
    )
    design = Design(expectation, experiment.design.base)
    return replace(experiment, design=design)


def _worst(experiment: Experiment, made: Plan) -> float:
    paths = paths_of(experiment.cell, made.moves)
    excitation, _ = experiment.excitation(paths)
    return float(
        experiment.design.std_percent(experiment.design.information(excitation, RUNS)).max()
    )


if __name__ == "__main__":
    main()
