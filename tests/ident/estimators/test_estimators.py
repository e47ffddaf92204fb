"""Estimators: what they must give back, and what must not change them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.data.run import Run
from ident.equations.system import require_distinct
from ident.errors import DataUnfit, PayloadMissing, RankDeficient
from ident.estimators import maximum_likelihood
from ident.estimators.estimate import Estimate, Identification
from ident.estimators.identify import estimate_with, identify
from ident.estimators.least_squares import Scaling, tls, wls
from ident.estimators.maximum_likelihood import ml
from ident.estimators.method import Method
from ident.model.bodies import Payload
from ident.model.model import DriveTrain, Model
from tests.ident.recordings import CONDITIONING, GAINS, MOUNTED, PAYLOAD_TRUTH, Truth, record

FloatArray = NDArray[np.float64]


def _fit(truth: Truth, runs: tuple[Run, ...]) -> Estimate:
    return identify(truth.model, runs, CONDITIONING).estimate


@pytest.mark.slow
@pytest.mark.parametrize("method", Method)
def test_without_noise_every_method_finds_every_gain(
    truth: Truth, clean_runs: tuple[Run, ...], method: Method
) -> None:
    estimate = identify(truth.model, clean_runs, CONDITIONING, method=method).estimate
    assert estimate.gains == pytest.approx(GAINS, rel=2e-4)
    names = [column.name for column in estimate.unknowns]
    for name in ("mx", "my", "mz", "Izz"):
        found = estimate.parameters[names.index(f"{name}:a")]
        assert found == pytest.approx(PAYLOAD_TRUTH[name], rel=5e-3, abs=1e-3)


def test_fixed_gains_give_the_classical_identification(
    truth: Truth, clean_runs: tuple[Run, ...]
) -> None:
    system = identify(truth.model, clean_runs[:1], CONDITIONING, fixed_gains=GAINS).system
    expected = system.base.grouping @ truth.parameters
    for method in (Method.LS, Method.WLS, Method.ML):
        estimate = estimate_with(method, system, GAINS)
        assert estimate.parameters == pytest.approx(expected, rel=1e-3, abs=2e-3)
        assert np.all(estimate.gains_std == 0.0)


@pytest.mark.parametrize("method", [Method.WLS, Method.ML])
def test_with_fixed_gains_a_known_payload_need_not_be_distinguished(
    truth: Truth, method: Method
) -> None:
    """A loaded run alone gives the parameters of the robot where all of the payload is known."""
    known = Payload("disc", "a", PAYLOAD_TRUTH)
    rng = np.random.default_rng(11)
    loaded = record(truth, "loaded", rng, known)
    found = identify(truth.model, [loaded], CONDITIONING, method=method, fixed_gains=GAINS)
    expected = found.system.base.grouping @ truth.parameters
    assert found.estimate.parameters == pytest.approx(expected, rel=1e-3, abs=2e-3)
    with pytest.raises(RankDeficient, match="without load too"):
        identify(truth.model, [loaded], CONDITIONING, method=method)


def test_ml_and_the_papers_tls_beat_wls(noisy_found: Identification) -> None:
    methods = (Method.LS, Method.WLS, Method.TLS, Method.ML)
    errors = {
        m: float(np.mean(np.abs(estimate_with(m, noisy_found.system).gains / GAINS - 1.0)))
        for m in methods
    }
    assert errors[Method.ML] < 0.012
    assert errors[Method.TLS] < 0.012
    assert errors[Method.WLS] > 0.1


@pytest.mark.slow
def test_gains_scale_with_the_payload_mass(
    truth: Truth, noisy_runs: tuple[Run, ...], noisy_found: Identification
) -> None:
    known = {"m": 4.59 * 1.05}
    heavier = Payload("disc", "a", known)
    runs = tuple(replace(run, payload=heavier) if run.payload else run for run in noisy_runs)
    assert _fit(truth, runs).gains == pytest.approx(1.05 * noisy_found.estimate.gains, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1000.0, 2.0**-0.5, -1.0])
def test_a_change_of_current_unit_scales_exactly_that_gain(
    truth: Truth, noisy_runs: tuple[Run, ...], noisy_found: Identification, factor: float
) -> None:
    scale = np.ones(6)
    scale[3] = factor
    before = noisy_found.estimate
    runs = tuple(replace(run, current_a=run.current_a * scale) for run in noisy_runs)
    after = _fit(truth, runs)
    assert after.gains == pytest.approx(before.gains / scale, rel=1e-6)
    assert after.parameters == pytest.approx(before.parameters, rel=1e-5, abs=1e-8)
    assert after.gains_std == pytest.approx(before.gains_std / np.abs(scale), rel=1e-4)


@pytest.mark.slow
def test_the_order_of_runs_does_not_matter(
    truth: Truth, noisy_runs: tuple[Run, ...], noisy_found: Identification
) -> None:
    before = noisy_found.estimate
    after = _fit(truth, noisy_runs[::-1])
    assert after.gains == pytest.approx(before.gains, rel=1e-9)
    assert after.gains_std == pytest.approx(before.gains_std, rel=1e-6)


@pytest.mark.slow
def test_permuting_the_motors_permutes_the_gains(truth: Truth, noisy_runs: tuple[Run, ...]) -> None:
    order = np.array([0, 2, 1, 3, 5, 4])
    drive_train = DriveTrain(truth.model.drive_train.ratio[order])
    model = Model(truth.model.robot, drive_train)
    runs = tuple(replace(run, current_a=run.current_a[:, order]) for run in noisy_runs)
    standstill_rad_s = (0.0,) * 6
    conditioning = replace(CONDITIONING, standstill_rad_s=standstill_rad_s)
    before = identify(truth.model, noisy_runs, conditioning).estimate
    after = identify(model, runs, conditioning).estimate
    assert after.gains == pytest.approx(before.gains[order], rel=1e-9)
    assert after.parameters == pytest.approx(before.parameters, rel=1e-7, abs=1e-9)


def test_the_covariance_covers_the_error(noisy_found: Identification) -> None:
    estimate = noisy_found.estimate
    gain_difference = estimate.gains - GAINS
    scores = gain_difference / estimate.gains_std
    assert np.all(np.abs(scores) < 4.0)
    assert np.all(estimate.gains_std / np.abs(GAINS) < 0.02)


def test_ml_solves_the_instrumental_variable_equations(noisy_found: Identification) -> None:
    """Its instruments are the columns of W and the predicted currents (decision 0010)."""
    system = noisy_found.system
    estimate = noisy_found.estimate
    gamma = 1.0 / estimate.gains
    columns = np.zeros(len(estimate.parameters))
    size = np.zeros_like(columns)
    for factor, g, sigma in zip(system.motors.factors, gamma, estimate.axis_noise, strict=True):
        predicted = g * (factor[:, 1:-1] @ estimate.parameters + factor[:, -1])
        error = factor[:, 0] - predicted
        predicted_norm = np.linalg.norm(predicted)
        assert abs(predicted @ error) < 1e-6 * predicted_norm * np.linalg.norm(error)
        columns += g / sigma**2 * (factor[:, 1:-1].T @ error)
        error_norm = np.linalg.norm(error)
        size += abs(g) / sigma**2 * np.linalg.norm(factor[:, 1:-1], axis=0) * error_norm
    assert np.all(np.abs(columns) < 1e-6 * size)


@pytest.mark.parametrize("scaling", Scaling)
def test_tls_scalings_agree_without_noise(clean_found: Identification, scaling: Scaling) -> None:
    gains = tls(clean_found.system, scaling).gains
    assert gains == pytest.approx(GAINS, rel=2e-4)


def test_without_a_known_payload_there_is_no_scale(
    truth: Truth, clean_runs: tuple[Run, ...]
) -> None:
    with pytest.raises(PayloadMissing, match="payload of known mass"):
        _fit(truth, clean_runs[:1])
    system = identify(truth.model, clean_runs[:1], CONDITIONING, fixed_gains=GAINS).system
    for method in Method:
        with pytest.raises(PayloadMissing, match="payload of known mass"):
            estimate_with(method, system)


def test_loaded_runs_alone_are_rank_deficient(truth: Truth, clean_runs: tuple[Run, ...]) -> None:
    with pytest.raises(RankDeficient, match="without load too") as caught:
        _fit(truth, clean_runs[1:])
    assert any(name.endswith(":a") for name in caught.value.unknowns)


def test_gains_that_no_linear_estimate_has_are_named(
    clean_found: Identification, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without_the_third(*_: object) -> Estimate:
        gains = GAINS.copy()
        gains[2] = 0.0
        return replace(clean_found.estimate, gains=gains)

    monkeypatch.setattr(maximum_likelihood, "wls", without_the_third)
    monkeypatch.setattr(maximum_likelihood, "tls", without_the_third)
    with pytest.raises(RankDeficient, match="no linear estimate gives every gain") as caught:
        ml(clean_found.system)
    assert caught.value.unknowns == tuple(f"gain {motor}" for motor in range(1, 7))


def test_a_mounting_has_one_payload(truth: Truth) -> None:
    rng = np.random.default_rng(2)
    other = Payload("disc", "a", {"m": 5.0})
    runs = (
        record(truth, "one", rng, MOUNTED, seconds=3.0),
        replace(record(truth, "two", rng, seconds=3.0), payload=other),
    )
    with pytest.raises(DataUnfit, match="name of its own"):
        _fit(truth, runs)


def test_tls_has_nothing_to_do_with_fixed_gains(clean_found: Identification) -> None:
    with pytest.raises(DataUnfit, match="free gains"):
        estimate_with(Method.TLS, clean_found.system, GAINS)


def test_more_runs_of_one_mounting_share_its_unknowns(noisy_found: Identification) -> None:
    system = noisy_found.system
    assert len(system.unknowns) == 61 + 9
    expected = int(system.motors.rows.sum())
    assert noisy_found.estimate.rows == expected


def test_coupled_joints_that_never_move_together_are_named_and_only_ml_minds(
    clean_found: Identification,
) -> None:
    """Joint 6 rests while joint 5 moves: no row of the coupled motors is free of an undetermined
    dry friction.
    """
    system = clean_found.system
    factors = tuple(
        f if m < 4 else np.zeros((0, f.shape[1])) for m, f in enumerate(system.motors.factors)
    )
    rows = np.where(np.arange(6) < 4, system.motors.rows, 0)
    motors = replace(system.motors, factors=factors, rows=rows)
    apart = replace(
        system,
        motors=motors,
    )
    require_distinct(apart, gains=True)
    assert wls(apart).gains == pytest.approx(wls(system).gains)
    with pytest.raises(DataUnfit, match=r"(?i)\w+5 and \w+6.*never move at the same time"):
        ml(apart)


def test_an_axis_that_never_moves_is_named(truth: Truth, clean_runs: tuple[Run, ...]) -> None:
    still = []
    for run in clean_runs:
        position = run.position_rad.copy()
        position[:, 3] = 0.4
        still.append(replace(run, position_rad=position))
    with pytest.raises(DataUnfit, match="J4 never moves"):
        _fit(truth, tuple(still))
