"""Processor time of one look at a fit that grows:
six axes at 1 kHz, a look after each move of five seconds.

python -m tests.bench.growing        prints the table of docs/evidence/speed.md; exit code 1 above a tenth of a move
"""  # noqa: E501

from __future__ import annotations

import sys
import time
from dataclasses import replace
from statistics import median

import numpy as np

from ident.data.run import Run
from ident.equations.reduction import reduce_runs, regrouped
from ident.estimators.growing import GrowingFit
from ident.estimators.maximum_likelihood import ml
from tests.ident.pieces import first_samples
from tests.ident.recordings import CONDITIONING, MOUNTED, record, tx40_truth

RATE_HZ = 1000.0
MOVE_S = 5.0
MOVES = 6  #: Of each run
RUNS = 6
NOISE_A = 0.3
LARGEST_SHARE = 0.1


def _runs() -> list[Run]:
    """Runs in the order bare, loaded, loaded, bare, …"""
    rng = np.random.default_rng(1)
    runs = []
    for number in range(RUNS):
        payload = MOUNTED if number % 4 in (1, 2) else None
        run = record(
            tx40_truth(),
            f"run {number}",
            rng,
            payload,
            seconds=MOVES * MOVE_S,
            noise_a=NOISE_A,
            rate_hz=RATE_HZ,
            averaged=1,
        )
        move = (run.time_s // MOVE_S).astype(np.int64)
        runs.append(replace(run, move=move))
    return runs


def _ms(seconds: list[float]) -> str:
    return f"{1000.0 * median(seconds):.0f} (largest {1000.0 * max(seconds):.0f})"


def main() -> int:
    """Measure and print."""
    runs = _runs()
    model = tx40_truth().model
    fit = GrowingFit(model, CONDITIONING, (MOUNTED,))
    folding = []
    estimating = []
    for run in runs:
        for number in range(1, MOVES + 1):
            samples = round(number * MOVE_S * RATE_HZ)
            part = first_samples(run, samples)
            if run.move is not None:
                part = replace(part, move=run.move[:samples])
            begun_s = time.process_time()
            if number == MOVES:
                fit = fit.with_run(run)
            else:
                fit = fit.with_run_so_far(part)
            folded_s = time.process_time()
            found = fit.gains()
            ended_s = time.process_time()
            folding.append(folded_s - begun_s)
            if found.gains is not None:
                estimating.append(ended_s - folded_s)
    begun_s = time.process_time()
    ml(fit.system())
    likelihood_s = time.process_time() - begun_s
    begun_s = time.process_time()
    ml(regrouped(reduce_runs(model, runs, CONDITIONING)))
    whole_s = time.process_time() - begun_s
    lines = [
        "| | processor time ms, median |",
        "|---|---|",
        f"| fold in a move of {MOVE_S:g} s | {_ms(folding)} |",
        f"| quick gains ± σ | {_ms(estimating)} |",
        f"| `ml` from the same triangles, {fit.move_count} clusters | "
        f"{1000.0 * likelihood_s:.0f} |",
        f"| all {RUNS} runs of {MOVES * MOVE_S:g} s reduced again, `ml` | {1000.0 * whole_s:.0f} |",
    ]
    sys.stdout.write("\n".join(lines) + "\n")
    slowest = max(folding) + max(estimating)
    return int(slowest > LARGEST_SHARE * MOVE_S)


if __name__ == "__main__":
    sys.exit(main())
