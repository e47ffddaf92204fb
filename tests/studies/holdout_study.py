"""Verdict of the hold-out on the gains beside an effect:
of right ones, and of one that is wrong among them.

`make holdout-study` prints the figures of docs/evidence/hold-out.md. Sessions obey the declared
model and a low-speed friction that it lacks; the loop finds it. Each session is fitted twice: for a
cell whose nameplate is 2 to 20 % off, and for one whose nameplate is true. Then one gain is made
wrong, and all the rest is refitted to it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import numpy as np

from daq.config.cell import Cell, model_of
from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.workflow.fit import Fit, calibration_of
from ident.data.run import Run
from ident.discovery.evidence import gather
from ident.discovery.loop import find_effects
from ident.estimators.identify import estimate_with, identify
from ident.estimators.method import Method
from tests.ident.recordings import GAINS, MOUNTED, record, tx40_truth

FIT = ("bare-1", "loaded-1", "bare-2", "loaded-2")
HELD_OUT = "held-out"
WRONG_AXIS = 3
FACTORS = (1.0, 0.7, 0.9, 1.1)


@dataclass(frozen=True, slots=True)
class Ratio:
    """Errors on the hold-out over those with the nameplate's gains, in total and of each axis."""

    seed: int
    nameplate: str
    factor: float
    total: float
    axes: tuple[float, ...]

    def __str__(self) -> str:
        axes = " ".join(f"{axis:6.3f}" for axis in self.axes)
        return (
            f"{self.seed:4d}  {self.nameplate:9s}  J4 × {self.factor:.1f}  "
            f"{self.total:6.3f}  {axes}"
        )


def session(seed: int) -> dict[str, Run]:
    """Four runs for the fit and one to be held out, by name."""
    truth = tx40_truth()
    rng = np.random.default_rng(seed)
    mounted = {name: None if name.startswith("bare") else MOUNTED for name in (*FIT, HELD_OUT)}
    return {
        name: _sticking(record(truth, name, rng, payload, noise_a=0.3, seconds=22.0, averaged=1))
        for name, payload in mounted.items()
    }


def _sticking(run: Run) -> Run:
    position_rad_gradient = np.gradient(run.position_rad[:, 1])
    speed = position_rad_gradient * run.rate_hz
    added = np.zeros_like(run.current_a)
    added[:, 1] = 5.0 * np.sign(speed) * np.exp(-((speed / 0.35) ** 2)) / GAINS[1]
    current_a = run.current_a + added
    return replace(run, current_a=current_a)


def fitted(cell: Cell, runs: dict[str, Run]) -> Fit:
    """With the effects that the loop accepts."""
    trained = [runs[name] for name in FIT]
    unseen = [runs[HELD_OUT]]
    found = identify(model_of(cell), trained, cell.conditioning, holdout=unseen)
    rng = np.random.default_rng(0)
    steps = find_effects(gather(found, trained, unseen), rng)
    return Fit(cell, (), (), (), found, steps, None)


def with_factor(right: Fit, factor: float) -> Fit:
    """As if one gain had been identified wrong by a factor."""
    after = right.steps[-1].after
    gains = after.estimate.gains.copy()
    gains[WRONG_AXIS] *= factor
    system = after.training.system()
    other = replace(estimate_with(Method.ML, system, gains), gains_fixed=False)
    last_step = right.steps[-1]
    changed_after = replace(after, estimate=other)
    step = replace(last_step, after=changed_after)
    steps = (*right.steps[:-1], step)
    return replace(right, steps=steps)


def ratios(seeds: range) -> Iterator[Ratio]:
    """Yield the ratios of every session, nameplate and factor."""
    path = shipped_configurations() / "cells" / "demo.yaml"
    off = load_cell(path)
    axes = (
        replace(axis, nameplate_gain=float(gain))
        for axis, gain in zip(off.axes, GAINS, strict=True)
    )
    true = replace(off, axes=tuple(axes))
    for seed in seeds:
        runs = session(seed)
        for name, cell in (("true", true), ("off", off)):
            right = fitted(cell, runs)
            for factor in FACTORS:
                of = calibration_of(with_factor(right, factor), datetime(2025, 1, 2, tzinfo=UTC))
                held = of.holdout_error_percent
                nameplate = of.nameplate_holdout_error_percent
                if held is None or nameplate is None:
                    raise LookupError("a session without a hold-out")
                compared = tuple(
                    one / other for one, other in zip(held.axes, nameplate.axes, strict=True)
                )
                total = held.total / nameplate.total
                yield Ratio(seed, name, factor, total, compared)


def main() -> None:
    """Print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", type=int, default=4)
    sys.stdout.write("seed  nameplate  gain      total  J1 to J6\n")
    sessions = parser.parse_args().sessions
    for ratio in ratios(range(3, 3 + sessions)):
        sys.stdout.write(f"{ratio}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
