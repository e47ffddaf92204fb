"""Every effect claims a property of its columns; here is the one test that tries to refute them all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ident.effects import EFFECTS
from ident.effects.effect import Effect, Property
from ident.signals import Signals

MEMBERS = [
    pytest.param(effect, id=f"{effect.name}-{index}") for family in EFFECTS for index, effect in enumerate(family)
]


def _signals(seed: int) -> Signals:
    rng = np.random.default_rng(seed)
    arrays = rng.normal(size=(6, 3, 400))
    torque = np.cumsum(arrays[5], axis=1)
    return Signals(
        rate_hz=1000.0,
        time_s=np.arange(400) / 1000.0,
        position_rad=arrays[0],
        velocity_rad_s=arrays[1],
        acceleration_rad_s2=arrays[2],
        motor_position_rad=30.0 * arrays[0],
        load_torque_nm=arrays[3],
        motor_torque_nm=torque,
        current_a=torque / 20.0,
    )


def _transformed(signals: Signals, claim: Property) -> tuple[Signals, float]:
    """The change of motion that the claim speaks of, and the factor that its columns must then show."""
    if claim in (Property.ODD_IN_VELOCITY, Property.EVEN_IN_VELOCITY):
        factor = -1.0 if claim is Property.ODD_IN_VELOCITY else 1.0
        return replace(signals, velocity_rad_s=-signals.velocity_rad_s), factor
    if claim is Property.INDEPENDENT_OF_VELOCITY:
        return replace(signals, velocity_rad_s=3.0 + signals.velocity_rad_s**2), 1.0
    if claim is Property.PERIODIC_IN_MOTOR_ANGLE:
        return replace(signals, motor_position_rad=signals.motor_position_rad + 2.0 * np.pi), 1.0
    if claim is Property.ODD_IN_CURRENT:
        return replace(signals, motor_torque_nm=-signals.motor_torque_nm, current_a=-signals.current_a), -1.0
    return replace(signals, motor_torque_nm=signals.motor_torque_nm + 7.0), 1.0


@pytest.mark.parametrize("effect", MEMBERS)
def test_claims_hold(effect: Effect) -> None:
    for seed in range(3):
        signals = _signals(seed)
        changed, factor = _transformed(signals, effect.holds)
        for axis in range(3):
            expected = factor * effect.columns(signals, axis)
            assert effect.columns(changed, axis) == pytest.approx(expected, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("effect", MEMBERS)
def test_columns_are_as_many_as_coefficients_and_belong_to_the_axis(effect: Effect) -> None:
    signals = _signals(5)
    columns = effect.columns(signals, 1)
    assert columns.shape == (len(effect.coefficients), 400)
    assert np.all(np.isfinite(columns))
    assert float(np.ptp(columns)) > 0
    assert not np.allclose(columns, effect.columns(signals, 2))


def test_families_hold_one_name_and_names_are_unique() -> None:
    names = [{effect.name for effect in family} for family in EFFECTS]
    assert all(len(name) == 1 for name in names)
    assert len(set.union(*names)) == len(names)
