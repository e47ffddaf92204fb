"""Prediction from a calibration alone: the same torque as the estimate's,
and the currents that were recorded.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import chain

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from ident.calibration import EXTRAPOLATED, AcceptedEffect, Parameter, _largest_torque
from ident.data.dataset import Dataset, differentiate, planned
from ident.data.run import Run
from ident.discovery.evidence import Evidence, gather, with_effects
from ident.discovery.gates import own_unknowns
from ident.effects.dictionary import EFFECTS, UNNAMED
from ident.effects.effect import ALL_AXES, Effect, GearSide, PlacedEffect, check_settings
from ident.effects.electrical import Cogging, Lag, Saturation, TimeSkew
from ident.effects.friction import LoadFriction, NonlinearViscous, Stribeck, WarmUp
from ident.effects.position import Spring
from ident.effects.transmission import Elasticity
from ident.equations.rows import decimate_rows, row_masks
from ident.errors import DataUnfit, EffectRefused, ModelError
from ident.estimators.identify import identify
from ident.estimators.method import Method
from ident.model.bodies import Payload
from ident.model.model import Model
from ident.prediction import (
    measured_torque,
    placed_effect,
    predict_current,
    predict_torque,
    standard_parameters,
)
from tests.ident.recordings import (
    CONDITIONING,
    GAINS,
    MOUNTED,
    PAYLOAD_TRUTH,
    Truth,
    a_calibration,
    calibrated,
)


def _largest_difference(identification: Evidence) -> float:
    """Largest difference of the two predictions on the decimated rows,
    relative to the largest torque.
    """
    calibration = calibrated(identification)
    expected = identification.estimate.predicted_torque(identification.training)
    rows = [
        decimate_rows(data, CONDITIONING, predict_torque(calibration, identification.model, data).T)
        for data in identification.datasets
    ]
    stacked_rows = np.concatenate(rows, axis=1)
    stacked_row_difference = np.abs(stacked_rows - expected)
    largest_absolute_expected = np.max(np.abs(expected))
    return float(np.max(stacked_row_difference) / largest_absolute_expected)


@pytest.fixture(scope="module")
def identified(truth: Truth, noisy_runs: tuple[Run, ...]) -> Evidence:
    """One run without load and one with, by the classical identification."""
    found = identify(
        truth.model, noisy_runs[:2], CONDITIONING, method=Method.WLS, fixed_gains=GAINS
    )
    return gather(found, noisy_runs[:2])


@pytest.mark.slow
def test_the_estimates_own_torque_comes_back(identified: Evidence) -> None:
    assert _largest_difference(identified) < 1e-9


@pytest.mark.parametrize(
    "effects",
    [
        (PlacedEffect(Spring(), 2),),
        # Motor 6 turns with two joints; two orders on one motor must not be taken for each other.
        (PlacedEffect(Cogging(2), 5), PlacedEffect(Stribeck(0.12), 1), PlacedEffect(Cogging(6), 5)),
    ],
    ids=["spring", "cogging and stribeck"],
)
def test_so_does_that_of_effects(identified: Evidence, effects: tuple[PlacedEffect, ...]) -> None:
    after = with_effects(identified, effects)
    assert _largest_difference(after) < 1e-9
    without = replace(calibrated(after), effects=())
    effect = effects[0].effect
    with pytest.raises(ModelError, match=effect.name):
        standard_parameters(without, identified.model)


def test_an_effect_has_no_torque_far_beyond_what_the_fit_has_seen(identified: Evidence) -> None:
    """A power of the speed grows without end:
    at twice the speed, the fourth is sixteen times as large.
    """
    placed = PlacedEffect(NonlinearViscous(4.0), 1)
    after = with_effects(identified, (placed,))
    whole = calibrated(after)
    largest_nm = _largest_torque(after, placed)
    assert largest_nm is not None
    rows = (
        after.training.effects[:, 0]
        * after.estimate.parameters[own_unknowns(after.estimate, (placed,))]
    )
    largest_absolute_row = np.max(np.abs(rows), axis=1, where=after.training.use, initial=0.0)
    assert largest_nm == pytest.approx(largest_absolute_row, rel=1e-3)
    changed_effect = replace(whole.effects[0], largest_torque=largest_nm)
    effects = (changed_effect,)
    bounded = replace(whole, effects=effects)
    data = identified.datasets[0]
    velocity_rad_s = 2.0 * data.velocity_rad_s
    fast = replace(data, velocity_rad_s=velocity_rad_s)
    model = identified.model
    for motion, is_limited in ((data, False), (fast, True)):
        free = predict_torque(whole, model, motion)
        limited = predict_torque(bounded, model, motion)
        assert np.allclose(free, limited) != is_limited
    effect = whole.effects[0]
    calibration = replace(whole, effects=(_without_torque(effect),))
    without = predict_torque(calibration, model, fast)
    limited_difference = np.abs(limited - without)
    largest_limited_difference = np.max(limited_difference)
    assert largest_limited_difference == pytest.approx(EXTRAPOLATED * max(largest_nm), rel=1e-6)
    assert _largest_torque(after, PlacedEffect(Lag(), 1)) is None


def _without_torque(effect: AcceptedEffect) -> AcceptedEffect:
    """The same effect with coefficients of zero."""
    coefficients = tuple(replace(one, value=0.0) for one in effect.coefficients)
    return replace(effect, coefficients=coefficients)


@pytest.mark.slow
def test_what_fades_over_a_session_counts_from_its_first_run(
    truth: Truth, noisy_runs: tuple[Run, ...]
) -> None:
    runs = tuple(
        replace(run, started_s=1.7e9 + 60.0 * number) for number, run in enumerate(noisy_runs[:2])
    )
    found = identify(truth.model, runs, CONDITIONING, method=Method.WLS, fixed_gains=GAINS)
    effect = WarmUp(40.0, 1)
    effects = (PlacedEffect(effect, 1),)
    after = with_effects(gather(found, runs), effects)
    assert _largest_difference(after) < 1e-9


def test_a_motion_that_no_one_recorded_needs_the_same_current(identified: Evidence) -> None:
    effects = (PlacedEffect(Spring(), 2), PlacedEffect(LoadFriction(0), 1))
    after = with_effects(identified, effects)
    calibration = calibrated(after)
    data = after.datasets[1]
    asked = planned(data.motion(), data.rate_hz, data.payload)
    expected = predict_current(calibration, after.model, data)
    assert_allclose(
        predict_current(calibration, after.model, asked), expected, rtol=0.0, atol=1e-12
    )


def test_an_effect_of_the_load_is_predicted_with_the_final_load(identified: Evidence) -> None:
    """The fit built its columns with the estimate before the last,
    so the two agree only as the iteration does.
    """
    effects = (PlacedEffect(LoadFriction(0), 1),)
    after = with_effects(identified, effects)
    assert _largest_difference(after) < 1e-4


_seeds = st.integers(min_value=0, max_value=2**32 - 1)


@given(seed=_seeds)
@settings(max_examples=10, deadline=None)
def test_leading_columns_alone_move_as_all_standard_parameters_do(
    identified: Evidence, truth: Truth, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    like = identified.datasets[0]
    motion = _random_motion(like, rng)
    standard = rng.normal(size=len(truth.model.columns))
    base = identified.rows_without_effects.base
    named = tuple(
        Parameter(name, float(value), 0.0, "")
        for name, value in zip(base.names, base.grouping @ standard, strict=True)
    )
    columns = truth.model.regressor(motion.motion())
    expected = np.einsum("jck,c->kj", columns, standard)
    calibration = a_calibration(GAINS, named)
    found = predict_torque(calibration, truth.model, motion)
    largest_absolute_expected = np.max(np.abs(expected))
    assert found == pytest.approx(expected, abs=1e-6 * largest_absolute_expected)


def _random_motion(like: Dataset, rng: np.random.Generator) -> Dataset:
    position, velocity, acceleration = rng.normal(size=(3, 50, 6))
    time_s = np.arange(50.0)
    return replace(
        like,
        time_s=time_s,
        position_rad=position,
        velocity_rad_s=velocity,
        acceleration_rad_s2=acceleration,
        payload=None,
    )


def test_the_true_parameters_predict_the_recorded_current(
    identified: Evidence, truth: Truth, clean_runs: tuple[Run, ...]
) -> None:
    base = identified.rows_without_effects.base
    values = (
        *base.grouping @ truth.parameters,
        *(value for name, value in PAYLOAD_TRUTH.items() if name != "m"),
    )
    names = (*base.names, *(f"{name}:{MOUNTED.mounting}" for name in PAYLOAD_TRUTH if name != "m"))
    parameters = tuple(
        Parameter(name, float(value), 0.0, "") for name, value in zip(names, values, strict=True)
    )
    calibration = a_calibration(GAINS, parameters)
    for run in clean_runs:
        data = differentiate(run, truth.model.drive_train, CONDITIONING)
        # At standstill dry friction is undetermined
        _, use = row_masks(truth.model, data, CONDITIONING)
        recorded = decimate_rows(data, CONDITIONING, data.current_a.T)[use]
        predicted = decimate_rows(
            data, CONDITIONING, predict_current(calibration, truth.model, data).T
        )[use]
        predicted_difference_norm = np.linalg.norm(predicted - recorded)
        recorded_norm = np.linalg.norm(recorded)
        assert predicted_difference_norm < 2e-3 * recorded_norm
        current_a = predict_current(calibration, truth.model, data)
        torque = measured_torque(calibration, truth.model, current_a)
        expected = predict_torque(calibration, truth.model, data)
        assert_allclose(torque, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("payload", "words"),
    [
        (
            Payload("disc", "upside down", {"m": 4.59}),
            "'upside down', of which the calibration knows nothing.*'a'",
        ),
        (Payload("disc", "a", {"m": 4.59, "mx": -0.24}), "declares mx of mounting 'a'"),
    ],
)
def test_a_payload_that_the_calibration_does_not_know(
    identified: Evidence, payload: Payload, words: str
) -> None:
    data = replace(identified.datasets[1], payload=payload)
    with pytest.raises(DataUnfit, match=words):
        predict_torque(calibrated(identified), identified.model, data)


def test_a_payload_that_is_known_in_full_needs_nothing_of_the_calibration(
    identified: Evidence,
) -> None:
    calibration = calibrated(identified)
    data = identified.datasets[1]
    full = dict.fromkeys(PAYLOAD_TRUTH, 0.0) | {"m": 1e-9}  # a speck
    payload = Payload("x", "x", full)
    weightless = predict_torque(calibration, identified.model, replace(data, payload=payload))
    bare = predict_torque(calibration, identified.model, replace(data, payload=None))
    assert weightless == pytest.approx(bare, abs=1e-6)
    known = {**full, "m": 1.0}
    heavy = predict_torque(
        calibration, identified.model, replace(data, payload=Payload("x", "x", known))
    )
    heavy_difference = np.abs(heavy - bare)
    assert np.max(heavy_difference) > 5.0  # a kilogram at the flange of an arm of half a metre


STIFFNESS = Parameter("spring stiffness 3", 1.0, 0.0, "Nm/rad")


@pytest.mark.parametrize(
    ("effect", "words"),
    [
        (AcceptedEffect("magic", "J3", {}, (), 1.0, 1.0), "no effect 'magic'; there are .*spring"),
        (AcceptedEffect("spring", "J9", {}, (STIFFNESS,), 1.0, 1.0), "'J9'; there are J1, J2"),
        (
            AcceptedEffect("spring", "J3", {}, (STIFFNESS,), 1.0, 1.0, package="springs 1.0"),
            "found an effect of this name of drivegain, .*expected springs 1.0",
        ),
        (
            AcceptedEffect("spring", "J3", {"rest": 1.0}, (STIFFNESS,), 1.0, 1.0),
            "settings rest; it has none",
        ),
        (AcceptedEffect("stribeck", "J3", {}, (), 1.0, 1.0), "settings none; it has speed_rad_s"),
        (AcceptedEffect("cogging", "J3", {"order": 2.5}, (), 1.0, 1.0), "whole"),
        (
            AcceptedEffect("spring", "J3", {}, (), 1.0, 1.0),
            "coefficients none; it needs spring stiffness 3",
        ),
        (AcceptedEffect("spring", "J4", {}, (STIFFNESS,), 1.0, 1.0), "it needs spring stiffness 4"),
        (
            AcceptedEffect("time-skew", "J3", {}, (STIFFNESS,), 1.0, 1.0),
            "'J3'; it acts on all axes",
        ),
    ],
)
def test_an_effect_that_does_not_exist_is_refused(
    identified: Evidence, effect: AcceptedEffect, words: str
) -> None:
    with pytest.raises(EffectRefused, match=words):
        placed_effect(effect, calibrated(identified))


def test_an_effect_that_a_calibration_has_twice_is_refused(identified: Evidence) -> None:
    """Its torque would count twice; two orders of one effect are two effects."""
    spring = AcceptedEffect("spring", "J3", {}, (STIFFNESS,), 1.0, 1.0)
    calibration = replace(calibrated(identified), effects=(spring, spring))
    data = identified.datasets[0]
    words = "found the effect spring on J3 twice .*; expected each effect once on an axis; take one"
    with pytest.raises(EffectRefused, match=words):
        predict_torque(calibration, identified.model, data)
    orders: list[AcceptedEffect] = []
    for order in (6, 12):
        placed = PlacedEffect(Cogging(order), 2)
        coefficients = [Parameter(one.name, 0.1, 0.1, one.unit) for one in placed.columns]
        settings = placed.effect.settings
        orders.append(AcceptedEffect("cogging", "J3", settings, tuple(coefficients), 1.0, 1.0))
    two_orders = replace(calibration, effects=tuple(orders))
    torque_nm = predict_torque(two_orders, identified.model, data)
    assert torque_nm.shape == data.position_rad.shape


@pytest.mark.parametrize(
    ("name", "settings", "words"),
    [
        (
            "coupling",
            {"other_axis": 99, "sense": 1},
            "other_axis = 99; it is the number of another of the 6 axes",
        ),
        ("coupling", {"other_axis": 3, "sense": 1}, "other_axis = 3"),
        ("coupling", {"other_axis": 0, "sense": 1}, "other_axis = 0"),
        ("coupling", {"other_axis": 2.5, "sense": 1}, "other_axis = 2.5"),
        ("coupling", {"other_axis": 4, "sense": 0}, "sense = 0"),
        ("inertial-coupling", {"other_axis": -1}, "other_axis = -1"),
        ("stribeck", {"speed_rad_s": 0.0}, "speed_rad_s = 0; it lies between"),
        ("stribeck", {"speed_rad_s": np.nan}, "finite"),
        ("nonlinear-viscous", {"exponent": -2.0}, "exponent = -2"),
        ("nonlinear-viscous", {"exponent": np.inf}, "finite"),
        ("load-friction", {"speed_exponent": -1}, "speed_exponent = -1"),
        ("cogging", {"order": -3}, "order = -3"),
        ("cogging", {"order": 1e9}, "order = 1e"),
        ("warm-up", {"time_constant_s": -20.0, "whole_session": 0}, "time_constant_s = -20"),
        ("warm-up", {"time_constant_s": 20.0, "whole_session": 7}, "whole_session = 7"),
        (
            "smooth-velocity",
            {"lower": 1.0, "upper": 1.0, "signed": 0, "other_axis": 0},
            "must not be empty",
        ),
        (
            "smooth-velocity",
            {"lower": 0.0, "upper": 1.0, "signed": 0, "other_axis": 2},
            "no other axis",
        ),
        (
            "smooth-other-velocity",
            {"lower": 0.0, "upper": 1.0, "signed": 0, "other_axis": 0},
            "other_axis = 0",
        ),
    ],
)
def test_settings_that_no_effect_has_are_refused(
    identified: Evidence, name: str, settings: dict[str, float], words: str
) -> None:
    accepted = AcceptedEffect(name, "J3", settings, (), 1.0, 1.0)
    with pytest.raises(EffectRefused, match=words):
        placed_effect(accepted, calibrated(identified))


@pytest.mark.parametrize(
    ("effect", "coefficient"),
    [
        (Elasticity(), "elasticity compliance 3"),
        (Saturation(), "saturation coefficient 3"),
        (Lag(), "lag time 3"),
        (TimeSkew(), "time-skew time 1"),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_an_effect_of_an_earlier_version_is_that_of_first_order(
    identified: Evidence, effect: Effect, coefficient: str
) -> None:
    axis = ALL_AXES if effect.side is GearSide.ALL_MOTORS else "J3"
    coefficients = (Parameter(coefficient, 2e-4, 1e-5, ""),)
    earlier = AcceptedEffect(effect.name, axis, {}, coefficients, 1.0, 1.0)
    placed, values = placed_effect(earlier, calibrated(identified))
    assert (placed.effect, values.tolist()) == (effect, [2e-4])


def test_every_effect_of_the_dictionary_has_settings_that_an_effect_can_have() -> None:
    for effect in (*chain.from_iterable(EFFECTS), *UNNAMED):
        given_ = dict(effect.settings)
        if effect.abscissa.is_of_other_joint:
            given_["other_axis"] = given_["other_axis"] or 2
        check_settings(effect, given_, 0, 12)


def _with_longer_links(model: Model, times: float) -> Model:
    """The same robot with all offsets between its joints longer."""
    joints = [
        replace(joint, translation_m=times * joint.translation_m) for joint in model.robot.joints
    ]
    robot = replace(model.robot, joints=tuple(joints))
    return Model(robot, model.drive_train)


def test_a_calibration_of_another_robot_is_refused(identified: Evidence) -> None:
    calibration = calibrated(identified)
    data = identified.datasets[0]
    changed_calibration = replace(calibration, gains=calibration.gains[:5])
    with pytest.raises(ModelError, match="5 gains, the model 6 joints"):
        predict_torque(changed_calibration, identified.model, data)
    other = _with_longer_links(identified.model, 1.2)
    with pytest.raises(
        ModelError,
        match=r"which another geometry gathers; expected a calibration "
        r"of the model's",
    ):
        predict_current(calibration, other, data)
    measured_again = _with_longer_links(identified.model, 1.002)
    predict_current(calibration, measured_again, data)
    parameter = Parameter("Izz7 + 1.0*Ia7", 1.0, 0.0, "")
    parameters = (*calibration.parameters, parameter)
    seventh = replace(calibration, parameters=parameters)
    with pytest.raises(ModelError, match="'Izz7"):
        predict_torque(seventh, identified.model, data)
