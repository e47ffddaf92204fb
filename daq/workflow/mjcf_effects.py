"""Effects of a calibration that a joint of MuJoCo has:
springs, and friction of joints without a motor.

| effect | at its joint |
|---|---|
| `spring`, τ = c q | `stiffness` c, `springref` 0 |
| `passive-spring`, τ = c q + a | `stiffness` c, `springref` −a/c |
| `passive-friction`, τ = a sign(q̇) + b q̇ | `frictionloss` a, `damping` b |

A spring that pushes away, c < 0, and effects in a pivot that a loop is cut at are left out. Beyond
the largest torque of the fit `predict_torque` limits an effect, and a simulator does not.
"""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass, replace

import numpy as np

from ident.arrays import FloatArray
from ident.calibration import AcceptedEffect, Calibration
from ident.effects.effect import Effect, is_shipped
from ident.effects.friction import PassiveFriction
from ident.effects.geometry_corrections import GravityDirection, ZeroOffset
from ident.effects.position import PassiveSpring, Spring
from ident.errors import EffectNotInstalled
from ident.model.robot import Robot
from ident.prediction import placed_effect


@dataclass(frozen=True, slots=True)
class LeftOutEffect:
    """An effect of a calibration that a model of a simulator lacks."""

    accepted: AcceptedEffect
    package_state: str = ""  #: as `not installed`; empty where its package is installed, or none is

    def __str__(self) -> str:
        """Name and axis; package, too, where it is not installed."""
        accepted = self.accepted
        name = f"{accepted.name} on {accepted.axis}"
        if self.package_state:
            return f"{name} (of {accepted.package}, {self.package_state})"
        return name


@dataclass(frozen=True, slots=True, eq=False)
class JointEffects:
    """Springs and friction of n joints by effects, and where each effect of a calibration is."""

    stiffness: FloatArray  #: [Nm/rad; N/m], shape (n,)
    spring_rest: FloatArray  #: position at which the spring rests [rad; m], shape (n,)
    damping: FloatArray  #: [Nm/(rad/s); N/(m/s)], shape (n,)
    dry_friction: FloatArray  #: [Nm; N], shape (n,)
    at_joints: tuple[str, ...]  #: effects that are in these numbers
    in_geometry: tuple[str, ...]  #: effects that correct joint frames or gravity
    left_out: tuple[LeftOutEffect, ...]  #: all others


def joint_effects(calibration: Calibration, robot: Robot) -> JointEffects:
    """Find what of the effects of a calibration joints can have.

    Args:
        calibration: with its effects.
        robot: whose joints these are.

    Raises:
        EffectRefused: the calibration holds an effect that does not exist.
    """
    numbers = np.zeros((4, robot.joint_count))
    at_joints: list[str] = []
    in_geometry: list[str] = []
    left_out: list[LeftOutEffect] = []
    for accepted in calibration.effects:
        name = f"{accepted.name} on {accepted.axis}"
        placed, coefficients = placed_effect(accepted, calibration)
        if isinstance(placed.effect, ZeroOffset | GravityDirection):
            in_geometry.append(name)
            continue
        joint = _joint_of(placed.axis, robot)
        if joint is None:
            own = None
        else:
            own = numbers_of(placed.effect, coefficients)
        if own is None or (own[0] > 0.0 and numbers[0, joint] > 0.0):
            left_out.append(LeftOutEffect(accepted))
        else:
            numbers[:, joint] += own
            at_joints.append(name)
    stiffness, spring_rest, damping, dry_friction = numbers
    return JointEffects(
        stiffness,
        spring_rest,
        damping,
        dry_friction,
        tuple(at_joints),
        tuple(in_geometry),
        tuple(left_out),
    )


def split_installed(calibration: Calibration) -> tuple[Calibration, tuple[LeftOutEffect, ...]]:
    """Return a calibration without the effects of packages that are not installed, and those.

    A model of a simulator holds no effect of another package, so none is needed to write it.

    Raises:
        EffectRefused: the calibration holds an effect that does not exist, and names no package
            that had it.
    """
    installed: list[AcceptedEffect] = []
    missing: list[LeftOutEffect] = []
    gone: set[str] = set()
    for accepted in calibration.effects:
        try:
            placed_effect(accepted, calibration)
        except EffectNotInstalled as error:
            missing.append(LeftOutEffect(accepted, error.state))
            gone |= {coefficient.name for coefficient in accepted.coefficients}
        else:
            installed.append(accepted)
    kept = replace(calibration, effects=tuple(installed))
    return _without_parameters(kept, gone), tuple(missing)


def _without_parameters(calibration: Calibration, names: Set[str]) -> Calibration:
    """Leave parameters out, and their rows of the covariance:
    those of the others stay as they are.
    """
    if not names:
        return calibration
    is_kept = [parameter.name not in names for parameter in calibration.parameters]
    parameters = tuple(
        parameter for parameter in calibration.parameters if parameter.name not in names
    )
    factor = calibration.covariance_factor
    if factor is not None:
        lower = np.zeros((len(factor), len(factor)))
        for number, row in enumerate(factor):
            lower[number, : len(row)] = row
        own = lower[[*np.ones(len(calibration.gains), dtype=np.bool_), *is_kept]]
        # L Lᵀ of some rows is Rᵀ R of their transpose: no number has to be inverted.
        _, upper = np.linalg.qr(own.T)
        factor = tuple(tuple(row[: number + 1].tolist()) for number, row in enumerate(upper.T))
    return replace(calibration, parameters=parameters, covariance_factor=factor)


def _joint_of(place: int, robot: Robot) -> int | None:
    """Joint of a place of effects (`Robot.places`); None of a pivot that a loop is cut at."""
    joints = robot.place_joints
    return joints[place] if place < len(joints) else None


def numbers_of(effect: Effect, coefficients: FloatArray) -> FloatArray | None:
    """Stiffness, rest, damping and dry friction of an effect; None of one that joints do not have.

    A class of one's own that derives from one of these has columns of its own.
    """
    if not is_shipped(effect):
        return None
    match effect:
        case Spring() if coefficients[0] > 0.0:
            return np.array([coefficients[0], 0.0, 0.0, 0.0])
        case PassiveSpring() if coefficients[0] > 0.0:
            stiffness, preload = coefficients
            return np.array([stiffness, -preload / stiffness, 0.0, 0.0])
        case PassiveFriction() if coefficients.min() >= 0.0:
            dry, viscous = coefficients
            return np.array([0.0, 0.0, viscous, dry])
        case _:
            return None
