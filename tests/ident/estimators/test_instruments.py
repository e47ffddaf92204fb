"""Instruments from the demanded motion: what they promise, and the bias that they take away."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ident.discovery.evidence import by_instruments, gather, with_effects
from ident.effects.effect import PlacedEffect
from ident.effects.friction import LoadFriction
from ident.errors import DataUnfit
from ident.estimators.estimate import Identification
from ident.estimators.identify import identify
from ident.estimators.method import Method
from tests.ident.loops import record_in_loop
from tests.ident.recordings import CONDITIONING, MOUNTED, Truth, record

THREE = replace(CONDITIONING, standstill_rad_s=(0.03,) * 3)
SEEDS = 3
BENT = ("fs1", "fs2", "fs3")
"""A disturbance that opposes the motion slows the arm down,
so that friction looks smaller than it is.
"""


@pytest.fixture(scope="module")
def disturbed(small_truth: Truth) -> tuple[Identification, ...]:
    """One cell: identified by ``ml`` and by ``iv``."""
    rng = np.random.default_rng(11)
    runs = [
        record_in_loop(small_truth, name, rng, payload, disturbance_nm=3.0, seconds=20.0)
        for name, payload in (("bare", None), ("loaded", MOUNTED))
    ]
    return tuple(identify(small_truth.model, runs, THREE, method=method) for method in ("ml", "iv"))


@pytest.mark.slow
def test_iv_solves_the_equations_of_its_instruments(disturbed: tuple[Identification, ...]) -> None:
    """Σ_i (T L̂_i)ᵀ e_i γ_i/σ_i² = 0 and v̂_iᵀ e_i = 0 with the residual of the recorded motion."""
    found = disturbed[1]
    estimate = found.estimate
    system = found.system
    projected = system.on_instruments()
    columns = np.zeros(len(estimate.parameters))
    size = np.zeros(len(estimate.parameters))
    sums = []
    sizes = []
    for motor, gain in enumerate(estimate.gains):
        recorded = np.concatenate([cluster[motor] for cluster in system.clusters])
        instrument = np.concatenate([cluster[motor] for cluster in projected.clusters])
        error = recorded[:, 0] - (recorded[:, 1:-1] @ estimate.parameters + recorded[:, -1]) / gain
        predicted = (instrument[:, 1:-1] @ estimate.parameters + instrument[:, -1]) / gain
        predicted_norm = np.linalg.norm(predicted)
        error_norm = np.linalg.norm(error)
        assert abs(predicted @ error) < 1e-5 * predicted_norm * error_norm
        residual = recorded[:, 0] - predicted
        weight = len(error) / (gain * float(residual @ residual))
        sums.append(weight * (instrument[:, 1:-1].T @ error))
        instrument_norm = np.linalg.norm(instrument[:, 1:-1], axis=0)
        sizes.append(abs(weight) * instrument_norm * np.linalg.norm(error))
    columns = np.sum(sums, axis=0)
    size = np.sum(sizes, axis=0)
    # σ counts the free unknowns of all motors alike, hence the hundredth.
    assert np.all(np.abs(columns) < 1e-2 * size)


@pytest.mark.slow
def test_the_loop_bends_ml_and_not_iv(small_truth: Truth) -> None:
    """Mean z of friction over some cells: four σ off by ``ml``, none by ``iv``."""
    z: dict[str, list[list[float]]] = {"ml": [], "iv": []}
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        runs = [
            record_in_loop(small_truth, name, rng, payload, disturbance_nm=3.0, seconds=20.0)
            for name, payload in (("bare", None), ("loaded", MOUNTED))
        ]
        for method, scores in z.items():
            estimate = identify(small_truth.model, runs, THREE, method=method).estimate
            names = [column.name for column in estimate.unknowns]
            at = [names.index(name) for name in BENT]
            true = []
            for name in BENT:
                true.append(
                    small_truth.parameters[
                        [column.name for column in small_truth.model.columns].index(name)
                    ]
                )
            parameter_difference = estimate.parameters[at] - true
            scores.append((parameter_difference / estimate.parameters_std[at]).tolist())
    mean = {method: np.mean(scores, axis=0) for method, scores in z.items()}
    noise = 1.0 / np.sqrt(SEEDS)
    assert np.all(mean["ml"] < -3.0 * noise)
    assert np.all(np.abs(mean["iv"]) < 3.0 * noise)


@pytest.mark.slow
def test_instruments_of_rows_are_those_of_the_reduction(small_truth: Truth) -> None:
    """The search builds its rows whole, the fit as triangles:
    both give the same estimate, with and without effects.
    """
    rng = np.random.default_rng(5)
    runs = [
        record_in_loop(small_truth, name, rng, payload, disturbance_nm=2.0, seconds=8.0)
        for name, payload in (("bare", None), ("loaded", MOUNTED))
    ]
    found = identify(small_truth.model, runs, THREE, method="iv")
    evidence = gather(identify(small_truth.model, runs, THREE), runs)
    again = by_instruments(evidence)
    assert again is not None
    assert again.gains == pytest.approx(found.estimate.gains, rel=1e-6)
    assert again.gains_std == pytest.approx(found.estimate.gains_std, rel=1e-3)
    effects = (PlacedEffect(LoadFriction(0), 1),)
    joined = by_instruments(with_effects(evidence, effects))
    assert joined is not None
    assert joined.method is Method.IV
    expected = len(found.estimate.parameters) + 1
    assert len(joined.parameters) == expected


def test_continuous_motion_has_no_instruments(small_truth: Truth) -> None:
    rng = np.random.default_rng(1)
    runs = [
        record(small_truth, "bare", rng, seconds=6.0),
        record(small_truth, "loaded", rng, MOUNTED, seconds=6.0),
    ]
    time = runs[0].time_s[:, None]
    motion = np.sin(2.0 * time + np.arange(3)) + 0.5 * np.cos(3.3 * time) + 0.3 * np.sin(5.1 * time)
    waving = [replace(run, position_rad=motion) for run in runs]
    with pytest.raises(DataUnfit, match="demanded motion is not known"):
        identify(small_truth.model, waving, THREE, method="iv")
