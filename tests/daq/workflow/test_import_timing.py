"""Uneven stamps cost no accuracy: gains from resampled runs are as good as from uniform ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from daq.config.import_description import TimeColumn, TimeUnit
from daq.log.resampling import clock_of
from daq.log.table import Table, stamps_of_numbers
from ident.data.conditioning import Conditioning
from ident.data.run import Run
from ident.estimators.identify import identify
from tests.ident.recordings import MOUNTED, FloatArray, record, three_axes_truth

SEEDS = 8
NOISE_A = 0.03
FILTERS = Conditioning(
    position_cutoff_hz=15.0, decimation_cutoff_hz=8.0, standstill_rad_s=(0.03,) * 3
)
"""For 91 samples a second."""
TIME = TimeColumn(file="run.csv", column="t", unit=TimeUnit.MILLISECOND)


def _samples(run: Run, steps_ms: FloatArray, rng: np.random.Generator) -> Table:
    """Samples of a 1 kHz recording after these steps, positions before currents,
    with noise on the currents.
    """
    cumulative = np.cumsum(steps_ms).astype(np.int64)
    index = np.concatenate(([1], 1 + cumulative))
    # The simulated current of the first and the last sample is zero
    index = index[index < len(run.time_s) - 1]
    noise = NOISE_A * rng.standard_normal((len(index), 3))
    values = np.hstack((run.position_rad[index], run.current_a[index] + noise))
    stamps = stamps_of_numbers(index.astype(np.float64), TIME.unit)
    return Table(Path("run.csv"), (), values, "", stamps)


def _even(run: Run, table: Table) -> Run:
    """The samples at their mean rate."""
    assert table.stamps is not None
    time_s = np.linspace(0.0, table.stamps.time_s[-1], len(table.values))
    return replace(
        run, time_s=time_s, position_rad=table.values[:, :3], current_a=table.values[:, 3:]
    )


def _resampled(run: Run, table: Table) -> Run:
    """The samples as the import takes them."""
    clock = clock_of(table, TIME, table.values)
    position_rad = clock.positions(table.values[:, :3])
    current_a = clock.currents(table.values[:, 3:])
    return replace(run, time_s=clock.tick_s, position_rad=position_rad, current_a=current_a)


@pytest.mark.slow
def test_jittered_stamps_cost_at_most_a_fifth_of_the_accuracy() -> None:
    """Random steps of 10 and 12 ms against 11 ms:
    the same motions, and noise of the same size, over several seeds.

    The mean rate in place of the stamps more than doubles the errors.
    """
    truth = three_axes_truth()
    rng = np.random.default_rng(0)
    motions = [
        record(truth, f"r{i}", rng, load, seconds=15.0, averaged=1)
        for i, load in enumerate((None, None, MOUNTED, MOUNTED))
    ]
    size = {}
    for name, steps_ms, made in (
        ("uniform", (11.0, 11.0), _even),
        ("resampled", (10.0, 12.0), _resampled),
        ("mean rate", (10.0, 12.0), _even),
    ):
        errors = []
        for seed in range(SEEDS if name != "mean rate" else 3):
            noise = np.random.default_rng(seed)
            runs = [
                made(run, _samples(run, noise.choice(steps_ms, 2000), noise)) for run in motions
            ]
            estimate = identify(truth.model, runs, FILTERS).estimate
            errors.append(estimate.gains / truth.gains - 1.0)
        size[name] = float(np.sqrt(np.mean(np.square(errors))))
    assert size["uniform"] < 0.01
    assert size["resampled"] <= 1.2 * size["uniform"]
    assert size["mean rate"] > 2.0 * size["resampled"]
