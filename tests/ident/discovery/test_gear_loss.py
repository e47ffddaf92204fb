"""Which side drives a gear, and what a gain takes up of a loss that the residual does not show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.data.dataset import Dataset
from ident.discovery.evidence import Evidence, with_effects
from ident.discovery.gates import Gates
from ident.discovery.gear_loss import GearLoss, driving_shares, gear_losses
from ident.discovery.loop import Step
from ident.discovery.search import rank_effects
from ident.effects.effect import Effect, PlacedEffect
from ident.effects.friction import LoadFriction, Stribeck
from ident.effects.transmission import Efficiency
from ident.equations.rows import decimate_rows
from ident.estimators.maximum_likelihood import ml
from tests.ident.recordings import PAYLOAD_TRUTH, Truth, acting_on, bent, search_problem_of

FloatArray = NDArray[np.float64]
AXIS = 1
ETA = 0.8
LOSS = (1.0 - ETA**2) / (1.0 + ETA**2)


def _load(truth: Truth, data: Dataset) -> FloatArray:
    """Torque of links and payload on the axis, by the test's own sum."""
    parameters = truth.parameters.copy()
    if data.payload is not None:
        parameters[truth.model.flange] += list(PAYLOAD_TRUTH.values())
    bodies = np.array(
        [column.name[:2] not in ("Ia", "fv", "fs", "of") for column in truth.model.columns]
    )
    return np.asarray(
        np.einsum("ck,c->k", truth.model.regressor(data.motion())[AXIS], parameters * bodies)
    )


@pytest.fixture(scope="module")
def lossy(small: Evidence, small_truth: Truth) -> Evidence:
    """The gear of one axis gives on a part of the power, in either direction."""

    def lost(data: Dataset) -> FloatArray:
        load = _load(small_truth, data)
        drives = load * data.velocity_rad_s[:, AXIS] > 0.0
        torque_nm = np.where(drives, load / ETA, load * ETA) - load
        return acting_on(AXIS, 3, torque_nm)

    return bent(small, small_truth, lost)


def _step(evidence: Evidence, *effects: Effect) -> Step:
    if effects:
        placed_effects = tuple(PlacedEffect(effect, AXIS) for effect in effects)
        after = with_effects(evidence, placed_effects)
    else:
        after = evidence
    families = ((Stribeck(0.1),), (Efficiency(1.0),))
    rng = np.random.default_rng(0)
    gates = Gates(draws=99)
    findings = rank_effects(search_problem_of(after), rng, gates, families)
    limits_nm = np.zeros(3)
    return Step(findings, (), limits_nm, None, after)


def _gain_error(evidence: Evidence, truth: Truth) -> float:
    return float(evidence.estimate.gains[AXIS] / truth.gains[AXIS] - 1.0)


def test_the_shares_are_those_of_the_true_load(small: Evidence, small_truth: Truth) -> None:
    rows = [
        decimate_rows(
            data,
            small.conditioning,
            np.stack((_load(small_truth, data), data.velocity_rad_s[:, AXIS])),
        )
        for data in small.datasets
    ]
    stacked_rows = np.concatenate(rows, axis=-1)
    load, velocity = stacked_rows[:, small.training.use[AXIS]]
    drives = load * velocity > 0.0
    mean_drive = float(np.mean(drives))
    expected = mean_drive, float(np.sum(load[drives] ** 2) / np.sum(load**2))
    assert driving_shares(small.training, small.estimate)[AXIS] == pytest.approx(expected, abs=0.01)


@pytest.mark.slow
def test_the_contrast_of_both_sides_shows_the_loss_and_its_law_the_gain(
    lossy: Evidence, small_truth: Truth
) -> None:
    step = _step(lossy, LoadFriction(0))
    found = gear_losses(step)[AXIS]
    assert found.gain_factor is not None
    assert found.loss == pytest.approx(LOSS, rel=0.05)
    assert found.efficiency == pytest.approx(ETA, rel=0.02)
    assert found.gain_factor == pytest.approx(1.0 / np.sqrt(1.0 - LOSS**2), rel=0.01)
    effects = (PlacedEffect(LoadFriction(0), AXIS),)
    fitted = with_effects(lossy, effects)
    # 2.5 % that no residual shows: the product of the law's two directions.
    assert _gain_error(fitted, small_truth) == pytest.approx(
        1.0 / found.gain_factor - 1.0, abs=0.006
    )


def test_a_search_without_the_loss_in_the_model_knows_it_too(lossy: Evidence) -> None:
    found = gear_losses(_step(lossy))[AXIS]
    assert found.loss is not None
    assert found.loss == pytest.approx(LOSS, abs=0.05)
    assert not found.gain_carries_it


def test_where_the_motor_drives_throughout_the_gain_carries_the_loss(
    lossy: Evidence, small_truth: Truth
) -> None:
    """Rows in which the load drives this joint are left out:
    the residual is silent, and the gain is wrong by 1/η.
    """
    observation = lossy.rows_without_effects
    standard = observation.base.independent
    column = 14 * AXIS + 12
    direction = observation.regressor[AXIS, standard.index(column)]
    load = np.concatenate(
        [
            decimate_rows(data, lossy.conditioning, _load(small_truth, data))
            for data in lossy.datasets
        ]
    )
    drives = observation.use[AXIS] & (load * direction > 0.0)
    use = observation.use.copy()
    motor_use = observation.motor_use.copy()
    use[AXIS] &= drives
    motor_use[AXIS] &= drives
    kept = replace(observation, use=use, motor_use=motor_use)
    estimate = ml(kept.system())
    driven = replace(lossy, rows_without_effects=kept, training=kept, estimate=estimate)
    found = gear_losses(_step(driven))[AXIS]
    assert found.lean > 0.98
    assert found.gain_carries_it
    assert _gain_error(driven, small_truth) == pytest.approx(ETA - 1.0, abs=0.02)


def test_what_was_not_tested_is_not_known_and_a_negative_loss_is_no_efficiency() -> None:
    unknown = GearLoss(0.6, 0.8, None, None)
    assert unknown.gain_carries_it
    assert unknown.efficiency is None
    gear_loss = GearLoss(0.6, 0.8, -0.1, 0.01)
    assert gear_loss.gain_factor is None
    hidden_shift = GearLoss(0.5, 0.5, 0.0, 0.3).hidden_shift
    assert hidden_shift == 0.0
