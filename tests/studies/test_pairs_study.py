"""Pairs of recordings: each is in one pair, and z has the root mean square that its errors were
drawn with.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.studies.pairs_study import (
    RecordingScore,
    disjoint_pairs,
    found_effects,
    pair_z,
    rms_interval,
    tables,
    truth_z,
)

STD = np.array([0.5, 2.0])
PLAIN_STD = np.array([1.0, 1.0])


def _scores(count: int, too_small: float, common: float = 0.0) -> list[RecordingScore]:
    """Errors are `too_small` times σ, and all share one error of `common` σ."""
    rng = np.random.default_rng(5)
    scores = []
    for number in range(count):
        error = STD * (too_small * rng.standard_normal(2) + common)
        plain = PLAIN_STD * rng.standard_normal(2)
        error_percent = tuple(error.tolist())
        std_percent = tuple(STD.tolist())
        plain_error_percent = tuple(plain.tolist())
        plain_std_percent = tuple(PLAIN_STD.tolist())
        score = RecordingScore(
            world="measurement",
            number=number,
            error_percent=error_percent,
            std_percent=std_percent,
            plain_error_percent=plain_error_percent,
            plain_std_percent=plain_std_percent,
            effects=("stribeck on J4",) if number % 3 else (),
        )
        scores.append(score)
    return scores


def test_each_recording_is_in_one_pair() -> None:
    pairs = disjoint_pairs(_scores(7, 1.0))
    expected = [(0, 1), (2, 3), (4, 5)]
    assert [(first.number, second.number) for first, second in pairs] == expected


@pytest.mark.parametrize("too_small", [1.0, 1.5])
def test_z_shows_how_much_sigma_is_too_small(too_small: float) -> None:
    scores = _scores(4000, too_small, common=3.0)
    rms, error = rms_interval(pair_z(disjoint_pairs(scores)))
    # What all have in common does not show
    assert rms == pytest.approx(np.full(2, too_small), rel=0.05)
    assert error == pytest.approx(rms / np.sqrt(2 * 2000), rel=0.1)  # as of a normal distribution
    plain, _ = rms_interval(pair_z(disjoint_pairs(scores), plain=True))
    assert plain == pytest.approx(np.ones(2), rel=0.05)
    to_truth, _ = rms_interval(truth_z(scores))
    assert to_truth == pytest.approx(np.full(2, np.hypot(too_small, 3.0)), rel=0.05)


def test_the_table_has_the_figures_of_its_scores() -> None:
    scores = _scores(400, 1.0, common=1.0)
    lines = tables(scores, ("J1", "J2")).splitlines()
    assert lines[0] == "| world | 200 pairs | J1 | J2 |"
    rows = {line.split(" | ")[1]: line.strip("| ").split(" | ")[2:] for line in lines[2:]}
    rms, error = rms_interval(pair_z(disjoint_pairs(scores)))
    expected = [f"{value:.2f} ± {one:.2f}" for value, one in zip(rms, error, strict=True)]
    assert rows["z of pairs after the search, rms"] == expected
    assert rows["σ, rms, %"] == ["0.50", "2.00"]
    bias = [float(cell) for cell in rows["mean error, %"]]
    assert bias == pytest.approx(STD, abs=0.25)
    assert found_effects(scores) == "266 × stribeck on J4; 134 × nothing"
