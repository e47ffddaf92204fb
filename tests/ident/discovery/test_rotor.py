"""Load friction beside a heavy rotor: the load that it multiplies is that of the links alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.calibration import Calibration
from ident.data.dataset import Dataset
from ident.discovery.declared import with_declared
from ident.discovery.evidence import Evidence, gather, with_effects
from ident.discovery.gates import Gates
from ident.discovery.loop import find_effects
from ident.discovery.rotor_search import (
    axes_with_rotor_in_load,
    largest_rotor_inertia,
    with_refined_rotor,
)
from ident.effects.dictionary import EFFECTS
from ident.effects.effect import Effect, PlacedEffect
from ident.effects.friction import LoadFriction
from ident.effects.transmission import Efficiency
from ident.errors import EffectRefused
from ident.estimators.identify import identify
from ident.prediction import placed_effect, predict_torque
from tests.ident.closed_recordings import recorded
from tests.ident.mechanisms import FIVE_BAR, PLANAR, THREE_LEGS, Mechanism
from tests.ident.recordings import (
    MOUNTED,
    PAYLOAD_TRUTH,
    Truth,
    acting_on,
    bent,
    calibrated,
    gathered,
    record,
    search_problem_of,
    three_axes_truth,
)

pytestmark = pytest.mark.slow

FloatArray = NDArray[np.float64]

AXIS = 1  #: Its rotor moves as its link does
COEFFICIENT = 0.1
ROTORS_KG_M2 = (1.5, 1.2, 0.1)
GATES = Gates(draws=199)
NAMES = ("J1", "J2", "J3")


def _truth(rotors_kg_m2: tuple[float, ...]) -> Truth:
    truth = three_axes_truth()
    parameters = truth.parameters.copy()
    parameters[truth.model.rotor_columns] = rotors_kg_m2
    return replace(truth, parameters=parameters)


def _clean(truth: Truth) -> Evidence:
    rng = np.random.default_rng(5)
    runs = []
    for number in range(4):
        payload = MOUNTED if number % 2 else None
        runs.append(
            record(
                truth,
                f"run{number}",
                rng,
                payload,
                noise_a=0.02,
                seconds=16.0,
                rate_hz=500.0,
                averaged=2,
            )
        )
    return gathered(truth, tuple(runs))


def _with_load_friction(truth: Truth) -> Evidence:
    """Recordings with friction that grows with the torque for links and payload,
    by the regressor's link columns.
    """

    def torque(data: Dataset) -> FloatArray:
        parameters = truth.parameters.copy()
        if data.payload is not None:
            parameters[truth.model.flange] += list(PAYLOAD_TRUTH.values())
        links = np.isin(np.arange(len(parameters)), truth.model.link_columns)
        load_nm = np.einsum("jck,c->jk", truth.model.regressor(data.motion()), parameters * links)[
            AXIS
        ]
        velocity_sign = np.sign(data.velocity_rad_s[:, AXIS])
        friction_nm = COEFFICIENT * np.abs(load_nm) * velocity_sign
        return acting_on(AXIS, len(truth.gains), friction_nm)

    return bent(_clean(truth), truth, torque)


@pytest.fixture(scope="module")
def heavy_truth() -> Truth:
    return _truth(ROTORS_KG_M2)


@pytest.fixture(scope="module")
def heavy(heavy_truth: Truth) -> Evidence:
    return _with_load_friction(heavy_truth)


@pytest.fixture(scope="module")
def found(heavy: Evidence) -> Evidence:
    rng = np.random.default_rng(0)
    effects = find_effects(heavy, rng, GATES)
    return effects[-1].after


def _loss(evidence: Evidence) -> tuple[FloatArray, FloatArray]:
    """Coefficients of the only effect and their σ."""
    first = len(evidence.rows_without_effects.columns)
    return evidence.estimate.parameters[first:], evidence.estimate.parameters_std[first:]


def _own(evidence: Evidence) -> LoadFriction:
    (placed,) = evidence.effects
    assert isinstance(placed.effect, LoadFriction)
    assert placed.axis == AXIS
    return placed.effect


def _assert_true(evidence: Evidence, truth: Truth, rotor_kg_m2: float) -> None:
    """Coefficient, rotor and gains are true within 3 σ, and σ is small."""
    effect = _own(evidence)
    values, deviations = (part[:2] for part in _loss(evidence))
    difference = abs(values[0] - COEFFICIENT)
    assert difference < 3.0 * deviations[0]
    assert deviations[0] < 0.02 * COEFFICIENT
    gain_difference = evidence.estimate.gains - truth.gains
    errors = gain_difference / evidence.estimate.gains_std
    assert np.max(np.abs(errors)) < 3.5
    if not rotor_kg_m2 and not effect.with_rotor:
        return  # moves that were left out are predicted no better without a rotor that is not there
    assert effect.with_rotor == 1
    inertia_std = deviations[1] / values[0]
    inertia_kg_m2 = effect.rotor_inertia_kg_m2 + values[1] / values[0]
    inertia_difference_kg_m2 = abs(inertia_kg_m2 - rotor_kg_m2)
    assert inertia_difference_kg_m2 < 3.0 * inertia_std
    assert inertia_std < 0.2


def test_load_friction_beside_a_heavy_rotor_is_true(
    found: Evidence, heavy: Evidence, heavy_truth: Truth
) -> None:
    _assert_true(found, heavy_truth, ROTORS_KG_M2[AXIS])
    assert abs(_loss(found)[0][1]) < _loss(found)[1][1]
    # What it is for: with the rotor in the load the coefficient is wrong.
    effects = (PlacedEffect(LoadFriction(0), AXIS),)
    plain = with_effects(heavy, effects)
    values, deviations = _loss(plain)
    difference = abs(values[0] - COEFFICIENT)
    assert difference > 5.0 * deviations[0]


def test_without_a_rotor_the_coefficient_is_true_as_well() -> None:
    truth = _truth((0.0, 0.0, 0.0))
    effects = find_effects(_with_load_friction(truth), np.random.default_rng(0), GATES)
    after = effects[-1].after
    _assert_true(after, truth, 0.0)


def test_deviations_hold_what_is_open_about_the_rotor(found: Evidence) -> None:
    effect = _own(found)
    changed_effect = replace(effect, with_rotor=0)
    effects = (PlacedEffect(changed_effect, AXIS),)
    known = with_effects(found, effects)
    assert _loss(found)[1][0] > _loss(known)[1][0]


def _predicted(calibration: Calibration, truth: Truth, data: Dataset) -> FloatArray:
    return predict_torque(calibration, truth.model, data)[:, AXIS]


def test_a_calibration_predicts_the_same_load_friction(found: Evidence, heavy_truth: Truth) -> None:
    calibration = calibrated(found)
    (accepted,) = calibration.effects
    effect = placed_effect(accepted, calibration)[0].effect
    assert effect == _own(found)
    data = found.datasets[1]
    names = {coefficient.name for coefficient in accepted.coefficients}
    declared = tuple(
        parameter for parameter in calibration.parameters if parameter.name not in names
    )
    bare = replace(calibration, effects=(), parameters=declared)
    friction_nm = _predicted(calibration, heavy_truth, data) - _predicted(bare, heavy_truth, data)
    parameters = heavy_truth.parameters.copy()
    parameters[heavy_truth.model.flange] += list(PAYLOAD_TRUTH.values())
    load_nm = heavy_truth.model.torques(data.motion(), parameters)[0][AXIS]
    velocity_sign = np.sign(data.velocity_rad_s[:, AXIS])
    expected_nm = COEFFICIENT * np.abs(load_nm) * velocity_sign
    friction_difference_norm_nm = np.linalg.norm(friction_nm - expected_nm)
    expected_norm_nm = np.linalg.norm(expected_nm)
    assert friction_difference_norm_nm < 0.03 * expected_norm_nm


def test_a_calibration_of_an_earlier_version_has_no_rotor(heavy: Evidence) -> None:
    effects = (PlacedEffect(LoadFriction(0), AXIS),)
    calibration = calibrated(with_effects(heavy, effects))
    (accepted,) = calibration.effects
    earlier = replace(accepted, settings={"speed_exponent": 0.0})
    effect = placed_effect(earlier, calibration)[0].effect
    assert effect == LoadFriction(0)
    assert [one.name for one in accepted.coefficients] == [
        "load-friction coefficient 2 (speed_exponent 0)"
    ]


@pytest.mark.parametrize(
    ("mechanism", "expected"),
    [(FIVE_BAR, (0, 1)), (PLANAR, (0, 1, 2, 3)), (THREE_LEGS, ())],
    ids=lambda one: getattr(one, "name", None),
)
def test_cranks_carry_their_rotors_and_slides_do_not(
    mechanism: Mechanism, expected: tuple[int, ...]
) -> None:
    made = recorded(mechanism, 7, seconds=12.0, noise_a=0.01)
    rows = identify(made.model, made.runs, made.conditioning, keep_rows=True).gathered
    assert rows is not None
    assert axes_with_rotor_in_load(rows[1]) == expected


def test_only_the_first_two_axes_of_an_arm_carry_their_rotors(heavy: Evidence) -> None:
    assert axes_with_rotor_in_load(heavy.training) == (0, 1)
    problem = search_problem_of(heavy)
    for axis in (0, 1):
        assert largest_rotor_inertia(problem, axis) > 0.9 * ROTORS_KG_M2[axis]


def test_the_bound_of_a_rotor_holds_for_a_redundant_drive() -> None:
    """With nothing but one rotor in the mass matrix of torques without preload,
    the bound is that rotor.
    """
    made = recorded(PLANAR, 7, seconds=12.0, noise_a=0.01)
    evidence = gather(identify(made.model, made.runs, made.conditioning, keep_rows=True))
    problem = search_problem_of(evidence)
    (run, _) = problem.runs
    (data, _) = problem.datasets
    followed = made.model.follow(data.motion())
    back = np.linalg.pinv(followed.to_motors)
    projector = np.einsum("kmd,kdj->kmj", followed.to_motors, back)[:20]
    rotors_kg_m2 = np.array([0.3, 0.2, 0.4, 0.5])
    inertia_kg_m2 = np.einsum("kij,j,kjl->ilk", projector, rotors_kg_m2, projector)
    runs = (replace(run, inertia_kg_m2=inertia_kg_m2),)
    alone = replace(problem, runs=runs)
    smallest_inertia_kg_m2 = np.min(inertia_kg_m2[0, 0])
    assert smallest_inertia_kg_m2 < rotors_kg_m2[0]
    assert largest_rotor_inertia(alone, 0) >= rotors_kg_m2[0] - 1e-9


def _declared(heavy: Evidence, effect: Effect, axis: int) -> Evidence:
    declared = [PlacedEffect(effect, axis)]
    rng = np.random.default_rng(0)
    return with_declared(heavy, declared, rng)[-1].after


def test_a_declared_loss_leaves_the_rotor_out(heavy: Evidence, heavy_truth: Truth) -> None:
    evidence = _declared(heavy, LoadFriction(0), AXIS)
    _assert_true(evidence, heavy_truth, ROTORS_KG_M2[AXIS])


def test_a_declared_inertia_is_kept(heavy: Evidence) -> None:
    given = LoadFriction(0, ROTORS_KG_M2[AXIS])
    after = _declared(heavy, given, AXIS)
    assert _own(after) == given
    values, deviations = _loss(after)
    difference = abs(values[0] - COEFFICIENT)
    assert difference < 3.0 * deviations[0]


def test_a_declared_inertia_that_is_a_parameter_of_its_own_is_refused(heavy: Evidence) -> None:
    effect = Efficiency(1.0, 0.1)
    declared = [PlacedEffect(effect, 2)]
    rng = np.random.default_rng(0)
    with pytest.raises(EffectRefused, match="J3 is given a rotor"):
        with_declared(heavy, declared, rng, axes=NAMES)


@pytest.mark.parametrize("name", [LoadFriction.name, Efficiency.name])
def test_no_rotor_has_a_negative_inertia(name: str, heavy: Evidence) -> None:
    """J + d/c is not negative: beside J = 0 its rest is not either,
    and a rotor that is certainly negative is none.
    """
    dictionary = {family[0].name: family[0] for family in EFFECTS}
    settings = {"with_rotor": 1, "rotor_inertia_kg_m2": 0.0}
    without = dictionary[name].with_settings(settings)
    beside = without.with_settings({"rotor_inertia_kg_m2": 0.2})
    assert without.coefficients[1].least == 0.0
    assert beside.coefficients[1].least == -np.inf
    problem = search_problem_of(heavy)
    deviations = np.array([0.01, 0.01])
    coefficients = np.array([0.1, -0.05])
    certain = with_refined_rotor(problem, without, 0, coefficients, deviations)
    assert certain.settings["with_rotor"] == 0
    may_be_zero = with_refined_rotor(problem, without, 0, np.array([0.1, -0.015]), deviations)
    assert may_be_zero == without
