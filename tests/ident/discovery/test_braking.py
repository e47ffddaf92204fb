"""Friction brakes at every speed: a fit in which terms of the speed drive the arm together is not
written.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.data.dataset import Dataset
from ident.discovery.braking import describe_driving_friction, is_friction_of_motion
from ident.discovery.evidence import Evidence, with_effects
from ident.discovery.gates import Gates
from ident.discovery.joining import SetAside
from ident.discovery.loop import find_effects
from ident.effects.dictionary import EFFECTS
from ident.effects.effect import Effect, PlacedEffect, Property
from ident.effects.friction import (
    AsymmetricViscous,
    NonlinearViscous,
    PositionFriction,
    SpeedFriction,
    Stribeck,
)
from ident.effects.signals import Abscissa, Signals
from ident.model.model import Column
from tests.ident.recordings import (
    MOUNTED,
    Truth,
    acting_on,
    bent,
    gathered,
    record,
    three_axes_truth,
)

pytestmark = pytest.mark.slow

FloatArray = NDArray[np.float64]

AXIS = 1
NAMES = ("J1", "J2", "J3")
GATES = Gates(draws=199)


@pytest.fixture(scope="module")
def truth() -> Truth:
    return three_axes_truth()


@pytest.fixture(scope="module")
def clean(truth: Truth) -> Evidence:
    rng = np.random.default_rng(11)
    payloads = (None, MOUNTED, None, MOUNTED)
    runs = [
        record(
            truth,
            f"run{number}",
            rng,
            payload,
            noise_a=0.03,
            seconds=18.0,
            rate_hz=500.0,
            averaged=2,
        )
        for number, payload in enumerate(payloads)
    ]
    return gathered(truth, tuple(runs))


def _with_friction(clean: Evidence, truth: Truth, friction_nm: object) -> Evidence:
    """Recordings with a friction of its own on one axis, a function of the speed's size."""
    assert callable(friction_nm)

    def torque(data: Dataset) -> FloatArray:
        velocity = data.velocity_rad_s[:, AXIS]
        own = np.sign(velocity) * friction_nm(np.abs(velocity))
        return acting_on(AXIS, len(truth.gains), own)

    return bent(clean, truth, torque)


def test_terms_that_push_together_at_low_speed_are_named_with_speed_and_size(
    clean: Evidence, truth: Truth
) -> None:
    # Drag by a root of the speed where there is none, and 20 Nm less dry friction than the axis
    # has.
    worn = _with_friction(clean, truth, lambda speed: 25.0 * speed ** (1.0 / 3.0) - 20.0)
    effect = NonlinearViscous(1.0 / 3.0)
    placed = PlacedEffect(effect, AXIS)
    fitted = with_effects(worn, (placed,))
    said = describe_driving_friction(fitted, AXIS)
    assert said.startswith("the friction of this axis would push the arm at rest (-1")
    assert said.endswith(" Nm)")
    assert describe_driving_friction(fitted, 0) == ""
    assert describe_driving_friction(clean, AXIS) == ""


def test_the_search_writes_no_friction_that_drives_the_arm(clean: Evidence, truth: Truth) -> None:
    worn = _with_friction(clean, truth, lambda speed: 25.0 * speed ** (1.0 / 3.0) - 20.0)
    rng = np.random.default_rng(0)
    steps = find_effects(worn, rng, GATES)
    end = steps[-1].after
    assert all(describe_driving_friction(end, axis) == "" for axis in range(3))
    aside: list[SetAside] = []
    for step in steps:
        aside.extend(step.set_aside)
    assert any("would push the arm" in one.reason(NAMES) for one in aside)


@pytest.mark.parametrize(
    ("effect", "friction_nm"),
    [
        (NonlinearViscous(1.0 / 3.0), lambda speed: 6.0 * speed ** (1.0 / 3.0)),
        (NonlinearViscous(2.0), lambda speed: 3.0 * speed**2),
        (Stribeck(0.3), lambda speed: 5.0 * np.exp(-speed / 0.3)),
    ],
)
def test_friction_that_brakes_is_still_found(
    clean: Evidence, truth: Truth, effect: SpeedFriction, friction_nm: object
) -> None:
    worn = _with_friction(clean, truth, friction_nm)
    rng = np.random.default_rng(0)
    effects = find_effects(worn, rng, GATES)
    end = effects[-1].after
    expected = [(effect.name, AXIS)]
    assert [(placed.effect.name, placed.axis) for placed in end.effects] == expected
    assert describe_driving_friction(end, AXIS) == ""


def test_a_direction_in_which_the_arm_would_be_driven_is_seen(
    clean: Evidence, truth: Truth
) -> None:
    placed = PlacedEffect(AsymmetricViscous(), AXIS)
    fitted = with_effects(clean, (placed,))
    index = [column.name for column in fitted.estimate.unknowns].index(placed.columns[0].name)
    for value in (50.0, -50.0):
        parameters = fitted.estimate.parameters.copy()
        parameters[index] = value
        estimate = replace(fitted.estimate, parameters=parameters)
        lopsided = replace(fitted, estimate=estimate)
        found = re.search(
            r"would push the arm at (-?[0-9.]+) rad/s", describe_driving_friction(lopsided, AXIS)
        )
        assert found is not None
        assert (float(found[1]) < 0.0) == (value > 0.0)


@pytest.mark.parametrize("effect", [Stribeck(0.2), NonlinearViscous(0.5), AsymmetricViscous()])
def test_columns_are_the_torque_at_the_speed_of_the_joint(effect: SpeedFriction) -> None:
    velocity = np.linspace(-2.0, 2.0, 101)
    columns = effect.at_speed(velocity)
    expected = (len(effect.coefficients), len(velocity))
    assert columns.shape == expected
    is_even = isinstance(effect, AsymmetricViscous)
    np.testing.assert_allclose(
        columns, effect.at_speed(-velocity) * (1.0 if is_even else -1.0), atol=1e-12
    )


def test_friction_with_a_payload_is_judged_by_itself(truth: Truth) -> None:
    """Without load the axis brakes; with it, what the payload adds to the friction is more than
    there was.
    """
    model = replace(truth.model, friction_by_payload=True)
    by_payload = replace(truth, model=model)
    rng = np.random.default_rng(12)
    runs = [
        record(
            truth,
            f"run{number}",
            rng,
            payload,
            noise_a=0.03,
            seconds=18.0,
            rate_hz=500.0,
            averaged=2,
        )
        for number, payload in enumerate((None, MOUNTED))
    ]
    effects = (PlacedEffect(Stribeck(0.3), AXIS),)
    fitted = with_effects(gathered(by_payload, tuple(runs)), effects)
    assert describe_driving_friction(fitted, AXIS) == ""
    names = [column.name for column in fitted.estimate.unknowns]
    parameters = fitted.estimate.parameters.copy()
    parameters[names.index("fs2_loaded")] -= 30.0
    estimate = replace(fitted.estimate, parameters=parameters)
    lighter = replace(fitted, estimate=estimate)
    assert "would push the arm" in describe_driving_friction(lighter, AXIS)


def _with_swing(clean: Evidence, truth: Truth, swing_nm: float, offset_nm: float) -> Evidence:
    """Recordings whose dry friction on one axis has a cosine of the position, and an offset."""

    def torque(data: Dataset) -> FloatArray:
        position = data.position_rad[:, AXIS]
        size_nm = swing_nm * np.cos(position) + offset_nm
        own = np.sign(data.velocity_rad_s[:, AXIS]) * size_nm
        return acting_on(AXIS, len(truth.gains), own)

    return bent(clean, truth, torque)


@dataclass(frozen=True, slots=True)
class RunOut(Effect):
    """Friction of the position as a person writes it, who does not know the one of the dictionary.

    τ = sign(q̇) (a cos q + b sin q).
    """

    name = "run-out"
    declares = Property.ODD_IN_VELOCITY
    abscissa = Abscissa.POSITION
    coefficients = (Column("a", "Nm"), Column("b", "Nm"))

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (2, k)."""
        q = signals.position_rad[axis]
        size = np.stack((np.cos(q), np.sin(q)))
        return np.asarray(size * np.sign(signals.velocity_rad_s[axis]))


@dataclass(frozen=True, slots=True)
class SlowStart(Effect):
    """Friction that depends on what came before a sample, and needs a load.

    τ = sign(q̇) · τ_L/|τ_L| at odd samples.
    """

    name = "slow-start"
    declares = Property.ODD_IN_VELOCITY
    abscissa = Abscissa.VELOCITY
    coefficients = (Column("a", "Nm"),)

    needs_load: bool = False

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (1, k)."""
        own = np.sign(signals.velocity_rad_s[axis])
        own[::2] = 0.0
        if self.needs_load:
            with np.errstate(invalid="ignore"):
                own = own * signals.load_torque_nm[axis] / np.abs(signals.load_torque_nm[axis])
        return np.asarray(own)[None]


@pytest.mark.parametrize("needs_load", [False, True])
def test_an_effect_that_is_no_function_of_speed_and_position_is_not_judged(
    clean: Evidence, needs_load: bool
) -> None:
    effect = SlowStart(needs_load)
    fitted = with_effects(clean, (PlacedEffect(effect, AXIS),))
    assert describe_driving_friction(fitted, AXIS) == ""


@pytest.mark.parametrize("effect", [PositionFriction(), RunOut()])
def test_friction_that_pushes_at_a_position_is_named_with_that_position(
    clean: Evidence, truth: Truth, effect: Effect
) -> None:
    # 25 Nm of a cosine on a dry friction of less: half a turn from zero it would push.
    worn = _with_swing(clean, truth, 25.0, -10.0)
    fitted = with_effects(worn, (PlacedEffect(effect, AXIS),))
    said = describe_driving_friction(fitted, AXIS)
    assert said.startswith("the friction of this axis would push the arm at rest, where its")
    position_rad = float(re.findall(r"position is (-?[\d.]+) rad", said)[0])
    assert np.cos(position_rad) < 0.0
    assert describe_driving_friction(fitted, 0) == ""


def test_friction_that_brakes_at_every_position_may_depend_on_it(
    clean: Evidence, truth: Truth
) -> None:
    worn = _with_swing(clean, truth, 4.0, 4.0)
    for effect in (PositionFriction(), RunOut()):
        fitted = with_effects(worn, (PlacedEffect(effect, AXIS),))
        assert describe_driving_friction(fitted, AXIS) == ""


def test_effects_of_speed_and_position_alone_are_judged() -> None:
    judged = {family[0].name for family in EFFECTS if is_friction_of_motion(family[0])}
    expected = {"stribeck", "nonlinear-viscous", "asymmetric-viscous", "position-friction"}
    assert judged == expected
    assert is_friction_of_motion(RunOut())


def test_an_effect_of_ones_own_that_drives_the_arm_is_not_written(
    clean: Evidence, truth: Truth
) -> None:
    """Without the dictionary's own effect, it would explain the residual."""
    worn = _with_swing(clean, truth, 25.0, -10.0)
    own = tuple(family for family in EFFECTS if family[0].name != "position-friction")
    steps = find_effects(worn, np.random.default_rng(0), GATES, families=(*own, (RunOut(),)))
    end = steps[-1].after
    assert all(placed.effect.name != "run-out" for placed in end.effects)


def test_the_search_writes_no_friction_of_the_position_that_drives_the_arm(
    clean: Evidence, truth: Truth
) -> None:
    worn = _with_swing(clean, truth, 25.0, -10.0)
    steps = find_effects(worn, np.random.default_rng(0), GATES)
    end = steps[-1].after
    assert all(describe_driving_friction(end, axis) == "" for axis in range(3))
    assert all(placed.effect.name != "position-friction" for placed in end.effects)
