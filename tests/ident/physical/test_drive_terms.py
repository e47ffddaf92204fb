"""Rotors and friction as terms of joints and motors:
the same torque, none negative, what does not fit named.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from ident.model.model import DriveTrain, Model
from ident.model.robot import Motion
from ident.model.urdf import robot_from_urdf
from ident.physical.drive_terms import DriveTerms, drive_terms
from ident.physical.physical import random_motion
from tests.ident.arms import SEVEN_AXES

FloatArray = NDArray[np.float64]
WRIST = np.diag([100.0, 100.0, 80.0, -80.0, 60.0, 50.0, 50.0])
WRIST[5, 6] = 50.0
WRIST[6, 5] = -25.0
WRIST[4, 3] = 12.0
MODEL = Model(robot_from_urdf(SEVEN_AXES.urdf), DriveTrain(WRIST))
STATES: Motion = random_motion(np.repeat([[0.0], [1.0], [2.0], [5.0]], 7, axis=1), 40, 3)


def _standard(values: dict[str, float], model: Model = MODEL) -> FloatArray:
    return np.array([values.get(column.name, 0.0) for column in model.columns])


def _torque(terms: DriveTerms, motion: Motion) -> FloatArray:
    """As a simulator has it, a whole matrix r rᵀ for each motor, shape (m, k)."""
    directions = MODEL.drive_train.direction
    acceleration = motion.acceleration_rad_s2.T
    velocity = motion.velocity_rad_s.T
    torque = (
        terms.inertia.of_axes[:, None] * acceleration + terms.damping.of_axes[:, None] * velocity
    )
    torque += terms.dry_friction.of_axes[:, None] * np.sign(velocity)
    for motor, r in enumerate(directions):
        along = terms.inertia.of_motors[motor] * (r @ acceleration) + terms.damping.of_motors[
            motor
        ] * (r @ velocity)
        along += terms.dry_friction.of_motors[motor] * np.sign(r @ velocity)
        torque += np.outer(r, along)
    return np.asarray(torque)


DRIVE = [
    column.name for column in MODEL.columns if column.name[0] in "Ifo" and column.name[1] in "avsf"
]


@pytest.mark.slow
@given(st.lists(st.floats(-2.0, 5.0), min_size=len(DRIVE), max_size=len(DRIVE)))
def test_terms_and_what_is_left_over_have_the_torque_of_the_parameters(values: list[float]) -> None:
    standard = _standard(dict(zip(DRIVE, values, strict=True)))
    terms = drive_terms(MODEL, standard)
    for part in (terms.inertia, terms.damping, terms.dry_friction):
        assert part.of_axes.min() >= 0.0
        assert part.of_motors.min() >= 0.0
    left = _standard({one.name: one.value for one in terms.left_over})
    columns = MODEL.regressor(STATES)
    expected = np.einsum("jck,c->jk", columns, standard)
    found = _torque(terms, STATES) + np.einsum("jck,c->jk", columns, left)
    assert found == pytest.approx(expected, abs=1e-9)


def test_possible_rotors_leave_nothing_over() -> None:
    """Rotors and dampers on each motor, friction on joints and motors."""
    assert MODEL.drive_train.coupled == (4, 5, 6)
    values = {}
    squares = MODEL.drive_train.direction**2
    for name, own, shared in (("Ia", 0.5, "Iam"), ("fv", 0.3, "fvm")):
        for axis in range(7):
            values[f"{name}{axis + 1}"] = own + float(squares[4:, axis].sum()) * 0.7
        for motor in (5, 6, 7):
            values[f"{shared}{motor}"] = 0.7
    terms = drive_terms(MODEL, _standard(values))
    assert terms.left_over == ()
    assert terms.inertia.of_axes == pytest.approx(np.full(7, 0.5))
    assert terms.damping.of_axes == pytest.approx(np.full(7, 0.3))
    assert terms.inertia.of_motors == pytest.approx([0.0] * 4 + [0.7] * 3)


@pytest.mark.parametrize(("both", "difference"), [(3.0, 0.2), (3.0, -0.2), (0.0, -0.2)])
def test_what_both_motors_of_a_differential_have_in_common_is_not_seen_and_leaves_nothing_over(
    both: float, difference: float
) -> None:
    """Their couplings are 1 and −0.5: Iam6 = x and Iam7 = 2 x make no torque,
    and a solver may choose any x.
    """
    values = {f"Ia{axis}": 1.0 for axis in range(1, 8)}
    values |= {"Iam6": both + difference, "Iam7": 2.0 * both}
    terms = drive_terms(MODEL, _standard(values))
    assert terms.left_over == ()
    seen = {f"Ia{axis}": 1.0 for axis in range(1, 8)} | {"Iam6": difference}
    expected = np.einsum("jck,c->jk", MODEL.regressor(STATES), _standard(seen))
    assert _torque(terms, STATES) == pytest.approx(expected, abs=1e-9)


def test_what_a_payload_adds_to_friction_is_no_part_of_the_robot() -> None:
    model = replace(MODEL, friction_by_payload=True)
    standard = _standard({"fs1": 2.0, "fs1_loaded": 0.4, "off2": 0.3}, model)
    left_over = drive_terms(model, standard).left_over
    assert [one.name for one in left_over] == ["off2"]
