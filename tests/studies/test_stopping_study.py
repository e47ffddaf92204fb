"""Where a recording ends by each rule, and the figures over cells."""

from __future__ import annotations

import numpy as np
import pytest

from tests.studies.stopping_cells import ML, QUICK, CellUnit, Look
from tests.studies.stopping_study import (
    TARGETS_PERCENT,
    by_cell,
    figures,
    ml_after_each_block,
    ml_twice,
    quick_after_each_move,
    stops_of,
    table,
)
from tests.studies.study_rows import from_csv, to_csv


def _look(
    seed: int, estimator: str, block: int, std: float, *, error: float = 0.0, into_s: float = 8.0
) -> Look:
    """One gain at its σ, the other at half of it."""
    recorded_s = 8.0 * (block - 1) + into_s
    std_percent = (std, 0.5 * std)
    error_percent = (error, -error)
    return Look(
        seed=seed,
        estimator=estimator,
        block=block,
        is_end=into_s == 8.0,
        recorded_s=recorded_s,
        error_percent=error_percent,
        std_percent=std_percent,
    )


def _cell(seed: int, stds: tuple[float, ...], error: float = 1.0) -> list[Look]:
    looks = []
    for block, std in enumerate(stds, start=1):
        looks.append(_look(seed, QUICK, block, std - 0.1, error=error, into_s=4.4))
        looks.append(_look(seed, QUICK, block, std, error=error))
        looks.append(_look(seed, ML, block, std, error=error))
    return looks


def test_the_rules_stop_at_the_first_look_that_they_are_for() -> None:
    stds = (2.0, 1.0, 1.05, 0.9, 0.8)
    looks = _cell(1, stds)
    quick = quick_after_each_move(looks, 0.95)
    assert quick is not None
    assert (quick.block, quick.recorded_s) == (2, 12.4)
    once = ml_after_each_block(looks, 1.0)
    assert once is not None
    assert (once.block, once.estimator) == (2, ML)
    twice = ml_twice(looks, 1.0)
    assert twice is not None
    assert twice.block == 5
    assert ml_twice(looks, 0.85) is None
    assert ml_after_each_block(looks, 0.5) is None


def test_recordings_of_a_fixed_length_end_with_the_median_cell() -> None:
    stds = (0.9, 0.8, 0.7)
    cells = [_cell(1, stds), _cell(2, (2.0, 0.9, 0.8)), _cell(3, (2.0, 2.0, 0.9))]
    found = stops_of(cells, 1.0)
    blocks = [look.block for look in found["ml, each block"]]
    assert blocks == [1, 2, 3]
    assert [look.block for look in found["ml, length fixed before"]] == [2, 2, 2]
    recorded_s = [look.recorded_s for look in found["quick, each move"]]
    assert recorded_s == [4.4, 12.4, 20.4]
    assert [look.recorded_s for look in found["quick, length fixed before"]] == [12.4, 12.4, 12.4]
    seeds = [look.seed for look in found["ml, two blocks in a row"]]
    assert seeds == [1, 2]
    assert not any(stops_of(cells, 0.1).values())


def test_the_figures_are_over_all_gains_and_cells() -> None:
    stops = [_look(1, ML, 2, 1.0, error=1.0), _look(2, ML, 4, 1.0, error=3.0)]
    found = figures(stops)
    assert found.cells == 2
    assert found.recorded_s[1] == 24.0
    assert found.error_percent == 0.0
    # z is 1 and −2 in the first cell, 3 and −6 in the second.
    assert found.z_rms == pytest.approx(np.sqrt(50.0 / 4.0))
    assert found.z_rms_se == pytest.approx(
        np.std([2.5, 22.5], ddof=1) / np.sqrt(2) / (2.0 * found.z_rms)
    )
    assert found.coverage_percent == 25.0


def test_the_looks_come_back_from_their_table_by_cell() -> None:
    looks = (*_cell(1, (2.0, 1.0)), *_cell(2, (1.0,)))
    text = to_csv(Look, looks)
    back = from_csv(Look, text)
    assert back == looks
    cell_counts = [len(cell) for cell in by_cell(back)]
    assert cell_counts == [6, 3]
    assert CellUnit("three", 7).name == "three-007"
    looks_of_arm = {"three": by_cell(back)}
    lines = table(looks_of_arm).splitlines()
    assert [
        line for line in lines if f"| {TARGETS_PERCENT[-1]:g} | ml, each block | 2 of 2 |" in line
    ]
