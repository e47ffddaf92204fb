"""Rotors and friction as inertias, dampers and dry friction of single joints and of motors.

The standard parameters of a motor that turns with several joints are split so that a fit sees them
(paper eq. 25): with r the motor's direction, Iam and fvm multiply the off-diagonal part of r rᵀ,
and the diagonal is in Ia and fv of the joints. Simulators have it the other way round: a rotor t
acts on the joints as t r rᵀ, with its diagonal, and a joint has an inertia too. With t of each
coupled motor m and a of each joint,

    diag(Ia) + Σ_m Iam_m (r_m r_mᵀ − diag(r_m²)) = diag(a) + Σ_m t_m r_m r_mᵀ,
    t_m = Iam_m,    a = Ia − Σ_m Iam_m r_m²,

and the same with fv and fvm. No simulator has a negative a or t. Where identified values would need
one, the motors of that joint are reduced in one proportion until a ≥ 0. The diagonal is still
right, and the rest of Iam_m is named as left out. Another division may leave out less. Dry friction
is not split: fs is that of the joints, fsm that of the motors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from ident.arrays import FloatArray
from ident.model.bodies import LOADED
from ident.model.model import COUPLED_COLUMNS, Model

ROUNDING = 1e-12  #: Share of a parameter up to which what is left of it is rounding error

#: Iam, fvm and fsm among the COUPLED_COLUMNS of a motor
INERTIA, VISCOUS, DRY = range(COUPLED_COLUMNS)


@dataclass(frozen=True, slots=True)
class LeftOver:
    """A part of a standard parameter that single joints and motors cannot have.

    The torque that it causes, its column of the regressor times the value, is missing.
    """

    name: str  #: of the standard parameter
    value: float  #: the part that is missing, in the unit
    unit: str  #: of the standard parameter


@dataclass(frozen=True, slots=True, eq=False)
class Terms:
    """One quantity (inertia, damping or dry friction) of single joints and of motors; none of its
    values is negative.
    """

    of_axes: FloatArray  #: of the joint of each axis alone, shape (m,)
    #: of each motor along its direction, zero for one that turns with one joint, shape (m,)
    of_motors: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class DriveTerms:
    """Rotors and friction of a robot, as simulators have them."""

    inertia: Terms  #: [kg m²; kg of a prismatic joint]
    damping: Terms  #: [Nm/(rad/s); N/(m/s)]
    dry_friction: Terms  #: [Nm; N]
    #: offsets, negative friction, and couplings that no rotor has
    left_over: tuple[LeftOver, ...]


def drive_terms(model: Model, standard: FloatArray) -> DriveTerms:
    """Split the standard parameters of the drives into terms of joints and of motors.

    Args:
        model: the declared model.
        standard: χ_st without payload, shape (c,).
    """
    coupled = list(model.drive_train.coupled)
    # Columns of Iam, fvm and fsm of each coupled motor
    of_coupled = model.coupled_columns[:, None] + np.arange(COUPLED_COLUMNS)
    of_motors = np.zeros((model.robot.axis_count, COUPLED_COLUMNS))
    of_motors[coupled] = standard[of_coupled]
    rotors = standard[model.rotor_columns]
    viscous = standard[model.viscous_friction_columns]
    dry = standard[model.dry_friction_columns]
    directions = model.drive_train.direction
    squares = directions**2
    # Values that simulators can have stay as they were identified.
    for column, of_joints in ((INERTIA, rotors), (VISCOUS, viscous)):
        values = of_motors[:, column]
        is_negative = values < 0.0
        exceeds_joints = values @ squares > of_joints
        if np.any(is_negative) or np.any(exceeds_joints):
            of_motors[coupled, column] = _not_negative(values[coupled], directions[coupled])
    inertia = _split(rotors, of_motors[:, INERTIA], squares)
    damping = _split(viscous, of_motors[:, VISCOUS], squares)
    dry_friction = Terms(
        of_axes=np.maximum(dry, 0.0),
        of_motors=np.maximum(of_motors[:, DRY], 0.0),
    )
    # Other parameters of the coupled motors give the same torque as the identified ones
    # (`_not_negative`), so what is missing is judged by them.
    same_torque = standard.copy()
    same_torque[of_coupled] = of_motors[coupled]
    missing = same_torque - _standard_of(model, inertia, damping, dry_friction)
    missing[model.link_columns] = 0.0
    left_over: list[LeftOver] = []
    for parameter, value, identified in zip(model.columns, missing, standard, strict=True):
        is_missing = abs(value) > ROUNDING * abs(identified)
        # What a payload adds to friction is no part of the robot without one.
        is_of_payload = parameter.name.endswith(LOADED)
        if is_missing and not is_of_payload:
            left_over.append(LeftOver(parameter.name, float(value), parameter.unit))
    return DriveTerms(inertia, damping, dry_friction, tuple(left_over))


def _not_negative(of_motors: FloatArray, directions: FloatArray) -> FloatArray:
    """Return Iam or fvm that are not negative and couple the joints as the identified ones do,
    shape (c,); the identified ones where there are no such values.

    Both motors of a differential couple its joints with opposite signs: the torque shows their
    difference only, and what both have in common would be taken from the joints. Of these two, one
    becomes zero.

    Args:
        of_motors: Iam or fvm of the c motors that turn with several joints, shape (c,).
        directions: r of each of them, shape (c, m).
    """
    first, second = np.triu_indices(directions.shape[1], 1)
    products = directions[:, first] * directions[:, second]
    # Off-diagonal element of r rᵀ for each pair of joints (row) and motor (column)
    couplings = products.T
    wanted = couplings @ of_motors
    not_negative, residual = nnls(couplings, wanted)
    if residual <= ROUNDING * np.linalg.norm(wanted):
        return np.asarray(not_negative)
    return of_motors


def _split(of_joints: FloatArray, of_motors: FloatArray, squares: FloatArray) -> Terms:
    """Split a diagonal and the off-diagonal parts of motors into terms that are not negative.

    Args:
        of_joints: the diagonal, Ia or fv, shape (m,).
        of_motors: Iam or fvm, zero for a motor that turns with one joint, shape (m,).
        squares: r², shape (m motors, m axes).
    """
    diagonal = np.maximum(of_joints, 0.0)
    wanted = np.maximum(of_motors, 0.0)
    diagonal_of_motors = wanted @ squares
    # Where the motors would exceed the diagonal of a joint, each of them gets the same share only.
    # A motor of several joints gets the least of its shares.
    allowed_share = np.ones(len(diagonal))
    exceeds = diagonal_of_motors > diagonal
    allowed_share[exceeds] = diagonal[exceeds] / diagonal_of_motors[exceeds]
    share_of_motor = [float(allowed_share[row > 0.0].min()) for row in squares]
    motors_alone = wanted * np.array(share_of_motor)
    axes_alone = np.maximum(diagonal - motors_alone @ squares, 0.0)
    return Terms(of_axes=axes_alone, of_motors=motors_alone)


def _standard_of(model: Model, inertia: Terms, damping: Terms, dry_friction: Terms) -> FloatArray:
    """Return the standard parameters that these terms amount to, shape (c,)."""
    squares = model.drive_train.direction**2
    standard = np.zeros(len(model.columns))
    standard[model.rotor_columns] = inertia.of_axes + inertia.of_motors @ squares
    standard[model.viscous_friction_columns] = damping.of_axes + damping.of_motors @ squares
    standard[model.dry_friction_columns] = dry_friction.of_axes
    of_coupled = zip(model.coupled_columns.tolist(), model.drive_train.coupled, strict=True)
    for first, motor in of_coupled:
        standard[first + INERTIA] = inertia.of_motors[motor]
        standard[first + VISCOUS] = damping.of_motors[motor]
        standard[first + DRY] = dry_friction.of_motors[motor]
    return standard
