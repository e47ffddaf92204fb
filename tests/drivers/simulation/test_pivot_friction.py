"""Friction of the pivot that a simulated closed chain is cut at."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from daq.simulation.simulation_file import load_simulation, shipped_simulation
from drivers.simulation.plant import Plant
from drivers.simulation.spec import CellSpec, SpecInvalid, UndeclaredEffect


def _spec(robot: str, closure: str, **parameters: float) -> CellSpec:
    effect = UndeclaredEffect("pivot-friction", -1, parameters, closure=closure)
    spec = load_simulation(shipped_simulation(robot))
    return replace(spec, effects=(effect,))


def _coasted(spec: CellSpec, seconds: float) -> Plant:
    """A plant without weight and without other losses, that was given a speed and no current."""
    axes = tuple(
        replace(
            axis,
            viscous_nm_s_rad=0.0,
            coulomb_nm=0.0,
            offset_nm=0.0,
            torque_disturbance_percent=0.0,
        )
        for axis in spec.axes
    )
    gravity_m_s2 = (0.0, 0.0, 0.0)
    changed_spec = replace(spec, axes=axes, passive={}, gravity_m_s2=gravity_m_s2)
    plant = Plant(changed_spec)
    closed = np.zeros(len(axes), dtype=np.bool_)
    plant.set_brakes(closed)
    plant.velocity_rad_s[:] = plant._basis @ np.array([0.5, -0.3])
    steps = round(seconds / plant._mechanics.step_s)
    for _ in range(steps):
        plant.step(np.zeros(len(axes)))
    return plant


def _energy_j(plant: Plant) -> float:
    mass = plant._mass(plant._model, plant._data, plant.position_rad)
    rotors = np.array([0.11, 0.11])
    speed = plant.velocity_rad_s
    return 0.5 * float(speed @ mass @ speed + rotors @ speed[:2] ** 2)


@pytest.mark.parametrize("kind", ["coulomb_nm", "viscous_nm_s_rad"])
def test_the_energy_that_is_lost_is_the_work_of_the_pivot(kind: str) -> None:
    seconds = 0.05
    spec = _spec("five-bar", "tip")
    before = _coasted(spec, 0.0)
    free = _coasted(_spec("five-bar", "tip"), seconds)
    rubbing = _coasted(_spec("five-bar", "tip", **{kind: 0.3}), seconds)
    # Angle between the two rods, by their joints: crank-2 + elbow-2 − crank-1 − elbow-1.
    sign = np.array([-1.0, 1.0, -1.0, 1.0])
    position_difference_rad = rubbing.position_rad - before.position_rad
    turned = abs(float(sign @ position_difference_rad))
    speed = 0.5 * abs(float(sign @ (rubbing.velocity_rad_s + before.velocity_rad_s)))
    work = 0.3 * turned * (speed if kind == "viscous_nm_s_rad" else 1.0)
    assert _energy_j(free) == pytest.approx(_energy_j(before), rel=1e-3)
    difference = _energy_j(free) - _energy_j(rubbing)
    assert difference == pytest.approx(work, rel=0.02)


def test_a_closure_that_is_no_planar_pivot_is_refused() -> None:
    spec = _spec("orthoglide", "leg-y", coulomb_nm=0.1)
    with pytest.raises(SpecInvalid, match="about more than one direction"):
        Plant(spec)
    with pytest.raises(SpecInvalid, match="no closure 'nose'; there are tip"):
        Plant(_spec("five-bar", "nose", coulomb_nm=0.1))
