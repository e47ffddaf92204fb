"""Rotors and friction as inertias, dampers and dry friction of single joints and of motors.

The standard parameters of a motor that turns with several joints are split so that a fit sees them
(paper eq. 25): with r the motor's direction, Iam and fvm are the off-diagonal part of r rᵀ, and the
diagonal is in Ia and fv of the joints. Simulators have it the other way round: a rotor t acts on
the joints as t r rᵀ, a whole matrix, and a joint has an inertia of its own. With t of each coupled
motor m and a of each joint,

    diag(Ia) + Σ_m Iam_m (r_m r_mᵀ − diag(r_m²)) = diag(a) + Σ_m t_m r_m r_mᵀ,    t_m = Iam_m,  a = Ia − Σ_m Iam_m r_m²,

and the same with fv and fvm. No simulator has a negative a or t. Where identified values would need
one, t_m is as large as a ≥ 0 allows, the diagonal is still right, and the rest of Iam_m is named as
left out.
"""  # noqa: E501

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from ident.arrays import FloatArray
from ident.model.bodies import LOADED
from ident.model.model import JOINT_COLUMNS, Model

ROUNDING = 1e-12  #: Share of a parameter below which what is left of it is rounding error


@dataclass(frozen=True, slots=True)
class LeftOver:
    """A part of a standard parameter that single joints and motors cannot have:
    its column times this is missing.
    """

    name: str  #: of the standard parameter
    value: float  #: what is missing of it [unit]
    unit: str


@dataclass(frozen=True, slots=True, eq=False)
class Terms:
    """Inertia, damping or dry friction, none of them negative."""

    of_axes: FloatArray  #: of the joint of each axis alone, shape (m,)
    #: of each motor along its direction, zero for one that turns with one joint, shape (m,)
    of_motors: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class DriveTerms:
    """What rotors and friction of a robot amount to."""

    inertia: Terms  #: [kg m²; kg of a prismatic joint]
    damping: Terms  #: [Nm/(rad/s); N/(m/s)]
    dry_friction: Terms  #: [Nm; N]
    left_over: tuple[LeftOver, ...]  #: offsets, friction that drives, couplings that no rotor has


def drive_terms(model: Model, standard: FloatArray) -> DriveTerms:
    """Split the standard parameters of the drives.

    Args:
        model: the declared model.
        standard: χ_st without payload, shape (c,).
    """
    coupled = list(model.drive_train.coupled)
    first = JOINT_COLUMNS * model.robot.joint_count
    motors = np.zeros((model.robot.axis_count, 3))
    motors[coupled] = standard[first : first + 3 * len(coupled)].reshape(-1, 3)
    directions = model.drive_train.direction
    squares = directions**2
    for place, of_joints in enumerate((model.rotor_columns, model.viscous_friction_columns)):
        own = motors[:, place]
        if np.any(own < 0.0) or np.any(own @ squares > standard[of_joints]):
            motors[coupled, place] = _least_of_motors(own[coupled], directions[coupled])
    dry = standard[model.dry_friction_columns]
    inertia = _split(standard[model.rotor_columns], motors[:, 0], squares)
    damping = _split(standard[model.viscous_friction_columns], motors[:, 1], squares)
    dry_friction = Terms(np.maximum(dry, 0.0), np.maximum(motors[:, 2], 0.0))
    held = standard.copy()
    held[model.link_columns] = 0.0
    held[first : first + 3 * len(coupled)] = motors[coupled].ravel()
    missing = held - _standard_of(model, inertia, damping, dry_friction)
    missing[model.link_columns] = 0.0
    left_over = []
    for column, value, whole in zip(model.columns, missing, standard, strict=True):
        # What a payload adds to friction is no part of the robot without one.
        if abs(value) > ROUNDING * abs(whole) and not column.name.endswith(LOADED):
            left_over.append(LeftOver(column.name, float(value), column.unit))
    return DriveTerms(inertia, damping, dry_friction, tuple(left_over))


def _least_of_motors(of_motors: FloatArray, directions: FloatArray) -> FloatArray:
    """The least Iam or fvm that couple the joints alike,
    none of them negative where that is possible, shape (c,).

    Both motors of a differential couple its joints with opposite signs: the torque shows their
    difference, and what both have in common would only need room at the joints.

    Args:
        of_motors: Iam or fvm of the motors that turn with several joints, shape (c,).
        directions: r of each of them, shape (c, m).
    """
    first, second = np.triu_indices(directions.shape[1], 1)
    couplings = (directions[:, first] * directions[:, second]).T
    wanted = couplings @ of_motors
    least, left = nnls(couplings, wanted)
    return np.asarray(least if left <= ROUNDING * np.linalg.norm(wanted) else of_motors)


def _split(of_joints: FloatArray, of_motors: FloatArray, squares: FloatArray) -> Terms:
    """Split a diagonal and the off-diagonal parts of motors into terms that are not negative.

    Args:
        of_joints: the diagonal, Ia or fv, shape (m,).
        of_motors: Iam or fvm, zero for a motor that turns with one joint, shape (m,).
        squares: r², shape (m motors, m axes).
    """
    room = np.maximum(of_joints, 0.0)
    wanted = np.maximum(of_motors, 0.0)
    used = wanted @ squares
    allowed = np.ones(len(room))
    is_short = used > room
    allowed[is_short] = room[is_short] / used[is_short]
    shares = [float(allowed[row > 0.0].min()) for row in squares]
    along = wanted * np.array(shares)
    alone = np.maximum(room - along @ squares, 0.0)
    return Terms(alone, along)


def _standard_of(model: Model, inertia: Terms, damping: Terms, dry_friction: Terms) -> FloatArray:
    """Standard parameters of such terms, shape (c,)."""
    squares = model.drive_train.direction**2
    standard = np.zeros(len(model.columns))
    standard[model.rotor_columns] = inertia.of_axes + inertia.of_motors @ squares
    standard[model.viscous_friction_columns] = damping.of_axes + damping.of_motors @ squares
    standard[model.dry_friction_columns] = dry_friction.of_axes
    first = JOINT_COLUMNS * model.robot.joint_count
    for number, motor in enumerate(model.drive_train.coupled):
        own = first + 3 * number
        along = (inertia.of_motors[motor], damping.of_motors[motor], dry_friction.of_motors[motor])
        standard[own : own + 3] = along
    return standard
