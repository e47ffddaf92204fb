"""A balancer on the second axis of a heavy arm:
declared it is fitted, left out it is found, and it bends no gain.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ident.arrays import FloatArray
from ident.calibration import calibration_of
from ident.discovery.declared import impossible_declared, with_declared
from ident.discovery.evidence import Evidence, gather
from ident.discovery.gates import Gates
from ident.discovery.loop import Step, find_effects
from ident.effects.dictionary import EFFECTS
from ident.effects.effect import PlacedEffect
from ident.effects.position import Counterbalance
from ident.errors import EffectImpossible
from ident.estimators.identify import identify
from ident.prediction import predict_torque
from tests.ident.balanced import (
    AXIS,
    CONDITIONING,
    FOOT_M,
    GAINS,
    LEVER_M,
    TOWARDS_RAD,
    heavy_model,
    heavy_runs,
)

pytestmark = pytest.mark.slow

GATES = Gates(draws=99)
LIKE_IT = tuple(
    family
    for family in EFFECTS
    if family[0].name in ("counterbalance", "gravity-compensator", "spring")
)
JOINTS = ("J1", "J2", "J3", "J4", "J5", "J6")
FREE_WITHOUT_PRELOAD_M = 0.53  #: Where the spring is shortest, it is 0.505 m long
FREE_BEYOND_ITS_REACH_M = 0.7  #: It pushes where it should pull
NEAR = PlacedEffect(Counterbalance(0.35, -1.2), AXIS)


def _gathered(balanced: bool) -> Evidence:
    return gather(
        identify(heavy_model(), heavy_runs(balanced), CONDITIONING, keep_rows=True, judge=False)
    )


@pytest.fixture(scope="module")
def balanced() -> Evidence:
    return _gathered(balanced=True)


@pytest.fixture(scope="module")
def declared(balanced: Evidence) -> tuple[Step, ...]:
    rng = np.random.default_rng(0)
    return with_declared(balanced, [NEAR], rng)


@pytest.fixture(scope="module")
def unbalanced() -> Evidence:
    return _gathered(balanced=False)


def _errors(evidence: Evidence) -> FloatArray:
    """Error of each gain over its σ."""
    gain_difference = evidence.estimate.gains - GAINS
    return np.asarray(gain_difference / evidence.estimate.gains_std)


def _assert_known(evidence: Evidence) -> None:
    """The gains are true, and so is the torque of the balancer but for what gravity holds of it."""
    assert np.max(np.abs(evidence.estimate.gains / GAINS - 1.0)) < 0.005
    assert np.max(np.abs(_errors(evidence))) < 3.5
    (placed,) = evidence.effects
    assert isinstance(placed.effect, Counterbalance)
    assert placed.axis == AXIS
    assert placed.effect.ratio == pytest.approx(LEVER_M / FOOT_M, abs=0.1)
    assert placed.effect.phase_rad == pytest.approx(TOWARDS_RAD, abs=0.1)


def test_declared_it_is_fitted_from_a_rough_geometry(
    balanced: Evidence, declared: tuple[Step, ...]
) -> None:
    after = declared[-1].after
    assert declared[-1].declared
    assert after.declared == 1
    _assert_known(after)
    before, error = (one.identification.training_error.axes[AXIS] for one in (balanced, after))
    assert error < 0.7 * before
    # What it is for: without it the gain of its axis is wrong, and σ larger.
    assert abs(balanced.estimate.gains[AXIS] / GAINS[AXIS] - 1.0) > 0.01
    assert after.estimate.gains_std[AXIS] < 0.2 * balanced.estimate.gains_std[AXIS]


def test_left_out_it_is_found_on_its_joint(balanced: Evidence) -> None:
    rng = np.random.default_rng(0)
    steps = find_effects(balanced, rng, GATES, LIKE_IT, geometry=())
    found = [
        (step.accepted.effect.name, step.accepted.axis)
        for step in steps
        if step.accepted is not None
    ]
    assert found == [("counterbalance", AXIS)]
    evidence = steps[-1].after
    _assert_known(evidence)


def test_a_search_keeps_what_is_declared_and_finds_nothing_beside_it(
    declared: tuple[Step, ...],
) -> None:
    start = declared[-1].after
    rng = np.random.default_rng(0)
    steps = find_effects(start, rng, GATES, LIKE_IT, geometry=())
    assert [step.accepted for step in steps] == [None]
    after = steps[-1].after
    assert after.effects == start.effects
    last_step = steps[-1]
    assert last_step.after.estimate.gains == pytest.approx(start.estimate.gains)


def test_no_balancer_is_found_where_there_is_none(unbalanced: Evidence) -> None:
    rng = np.random.default_rng(0)
    steps = find_effects(unbalanced, rng, GATES, LIKE_IT, geometry=())
    assert [step.accepted for step in steps] == [None]


def test_declared_where_there_is_none_it_bends_no_gain(unbalanced: Evidence) -> None:
    rng = np.random.default_rng(0)
    after = with_declared(unbalanced, [NEAR], rng)[-1].after
    gain_difference = after.estimate.gains - unbalanced.estimate.gains
    shift = gain_difference / after.estimate.gains_std
    largest_absolute_shift = np.max(np.abs(shift))
    assert largest_absolute_shift < 1.5
    assert np.max(np.abs(_errors(after))) < 3.5


def test_a_calibration_predicts_with_it(balanced: Evidence, declared: tuple[Step, ...]) -> None:
    made = calibration_of(balanced.identification, JOINTS, GAINS, steps=declared)
    assert [(effect.name, effect.axis) for effect in made.effects] == [("counterbalance", "J2")]
    data = balanced.datasets[0]
    torque = predict_torque(made, balanced.model, data)[:, AXIS]
    measured = GAINS[AXIS] * data.current_a[:, AXIS]
    torque_difference_norm = np.linalg.norm(torque - measured)
    measured_norm = np.linalg.norm(measured)
    assert torque_difference_norm < 0.12 * measured_norm
    rng = np.random.default_rng(0)
    counterbalance = Counterbalance(0.35, 1.7)
    with pytest.raises(EffectImpossible, match="physics allows"):
        with_declared(balanced, [PlacedEffect(counterbalance, AXIS)], rng)


def _leaning(free_m: float) -> Evidence:
    """A fit with gravity declared three degrees off, and a balancer whose spring has this length
    without force.
    """
    upright = heavy_model()
    lean_rad = np.radians(-3.0)
    declared = 9.81 * np.array([0.0, np.sin(lean_rad), -np.cos(lean_rad)])
    robot = replace(upright.robot, gravity_m_s2=declared)
    model = replace(upright, robot=robot)
    runs = heavy_runs(balanced=True, free_m=free_m)
    return gather(identify(model, runs, CONDITIONING, keep_rows=True, judge=False))


def test_a_balancer_that_only_a_leaning_base_makes_impossible_stays_and_the_search_corrects_gravity() -> (  # noqa: E501
    None
):
    steps = with_declared(_leaning(FREE_WITHOUT_PRELOAD_M), [NEAR], np.random.default_rng(0))
    before = steps[-1].after
    assert "preload" in impossible_declared(before, JOINTS)
    # Its own families apart: with this little preload another name of a spring explains as much.
    rng = np.random.default_rng(0)
    found = find_effects(before, rng, GATES, families=())
    after = found[-1].after
    assert [placed.effect.name for placed in after.effects] == [
        "counterbalance",
        "gravity-direction",
    ]
    assert impossible_declared(after, JOINTS) == ""
    assert np.max(np.abs(after.estimate.gains / GAINS - 1.0)) < 0.005


def test_a_balancer_that_no_geometry_makes_possible_is_refused_under_a_leaning_base_too() -> None:
    with pytest.raises(EffectImpossible, match="preload is -"):
        with_declared(_leaning(FREE_BEYOND_ITS_REACH_M), [NEAR], np.random.default_rng(0))
