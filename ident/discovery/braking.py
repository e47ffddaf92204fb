"""Check that the friction of an axis brakes at every speed and position, and never drives the arm.

A fit knows the friction only at the speeds of its runs. There, two terms of the speed can
compensate each other: drag that grows with a root of the speed, with a negative dry friction, fits
from a tenth of full speed on, and is wrong below. On a real robot that was moved slowly through a
region that the fit had not seen, such a fit was off by 18 % of the torque, the fit without the term
by 5 %. Likewise, friction that depends on the position can be negative where no run has been.

So the declared dry and viscous friction is judged together with all effects of the speed and of the
position on its axis, including a user's own. With c their coefficients and φ(v, q) their columns,
it is

    f(v, q) = fs + fv |v| + sign(v) Σ c φ(v, q) ≥ 0,

for 0 < |v| ≤ the largest speed of the runs, in both directions, and for all q within the joint's
travel about the middle of its runs. The limit v → 0 is the friction at which the axis begins to
move. f is refused where it is below zero by more than SIGMAS of its own σ.

Friction that grows with the load, or depends on the distance, brakes by itself and is left out. An
axis whose friction depends on the temperature is not judged: its fs and fv are those at a
temperature that the runs may not have had.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.arrays import FloatArray, IntArray
from ident.discovery.evidence import Evidence
from ident.discovery.gates import SIGMAS, own_unknowns
from ident.effects.effect import (
    Effect,
    GearSide,
    PlacedEffect,
    Property,
    columns_at,
    is_shipped,
)
from ident.effects.signals import Abscissa, Signals
from ident.errors import EffectRefused
from ident.model.bodies import LOADED

#: Speeds at which friction is judged, as shares of the largest; the first is the limit at rest
SPEEDS = np.concatenate(([1e-6], np.geomspace(1e-3, 1.0, 25)))
#: Positions at which friction that depends on the position is judged: over one turn, 7.7° apart
POSITIONS = 48


def is_friction_of_motion(effect: Effect) -> bool:
    """Whether an effect is friction of a driven joint by its speed and position alone.

    What is even in the velocity and depends on the position is a spring, which may push.
    """
    match effect.declares:
        case Property.ODD_IN_VELOCITY:
            abscissas = {Abscissa.VELOCITY, Abscissa.POSITION}
        case Property.EVEN_IN_VELOCITY:
            abscissas = {Abscissa.VELOCITY}
        case _:
            return False
    return (
        effect.abscissa in abscissas
        and effect.side is GearSide.JOINT
        and effect.with_motor
        and not effect.needs_inertia
        and not effect.axis_setting
    )


def describe_driving_friction(evidence: Evidence, axis: int) -> str:
    """Say where the friction of an axis would drive the arm; empty where it brakes everywhere.

    Args:
        evidence: a joint fit.
        axis: index of the axis.
    """
    effects = _judged_effects(evidence, axis)
    if not effects:
        return ""
    # An effect of one's own may depend on the position besides the speed that it names.
    is_of_position = any(
        placed.effect.abscissa is Abscissa.POSITION or not is_shipped(placed.effect)
        for placed in effects
    )
    positions_rad = np.zeros(1)
    if is_of_position:
        positions_rad = _positions(evidence, axis)
    largest_speed = 0.0
    for data in evidence.fit_runs:
        speed = np.abs(data.velocity_rad_s[:, axis])
        largest_speed = max(largest_speed, float(speed.max()))
    judged: list[_Friction] = []
    for declared in _declared_friction(evidence, axis):
        for direction in (1.0, -1.0):
            velocities = direction * largest_speed * SPEEDS
            judged += _friction_at(evidence, declared, effects, velocities, positions_rad)
    worst = min(judged, key=lambda friction: friction.largest_possible, default=None)
    if worst is None or worst.largest_possible >= 0.0:
        return ""
    place = _velocity_text(worst, largest_speed)
    if is_of_position:
        place += f", where its position is {worst.position_rad:.2g} rad"
    torque = f"{worst.torque:.3g} ± {worst.std:.2g} {worst.unit}"
    return f"the friction of this axis would push the arm {place} ({torque})"


def _judged_effects(evidence: Evidence, axis: int) -> tuple[PlacedEffect, ...]:
    """Friction of an axis by speed and position alone;
    none where its friction depends on the temperature.
    """
    of_axis = [placed for placed in evidence.effects if placed.axis == axis]
    if any(placed.effect.abscissa is Abscissa.TEMPERATURE for placed in of_axis):
        return ()
    return tuple(placed for placed in of_axis if is_friction_of_motion(placed.effect))


@dataclass(frozen=True, slots=True)
class _Declared:
    """Indices of an axis' dry and viscous friction among the parameters of an estimate.

    With a payload mounted, dry friction is the sum of two parameters, and viscous friction too
    (`Model.friction_by_payload`).
    """

    dry: tuple[int, ...]
    viscous: tuple[int, ...]
    unit: str  #: of the dry friction


@dataclass(frozen=True, slots=True)
class _Friction:
    """Friction of an axis at one velocity and position, positive where it brakes."""

    velocity: float  #: signed [rad/s or m/s]
    position_rad: float  #: 0 where no friction depends on it
    torque: float  #: f [unit]
    std: float  #: [unit]
    unit: str

    @property
    def largest_possible(self) -> float:
        """The upper end of its confidence interval, f + SIGMAS σ [unit]."""
        return self.torque + SIGMAS * self.std


def _velocity_text(friction: _Friction, largest_speed: float) -> str:
    """Velocity of a friction for a sentence: ``at rest``, ``at -0.3 rad/s``."""
    speed_at_rest = largest_speed * SPEEDS[0]
    if abs(friction.velocity) < 2.0 * speed_at_rest:
        return "at rest"
    if friction.unit == "N":
        return f"at {friction.velocity:.2g} m/s"
    return f"at {friction.velocity:.2g} rad/s"


def _declared_friction(evidence: Evidence, axis: int) -> list[_Declared]:
    """The declared friction of an axis without payload, and with it where that is another one.

    Empty where a part of it is regrouped into other parameters.
    """
    model = evidence.model
    index_of: dict[str, int] = {}
    for index, unknown in enumerate(evidence.estimate.unknowns):
        # A base parameter is called after its leading standard parameter: "fs2 + 1*Iam3"
        leading_name, *_ = unknown.name.split(" ", 1)
        index_of[leading_name] = index
    dry = model.columns[model.dry_friction_columns[axis]]
    viscous = model.columns[model.viscous_friction_columns[axis]]
    if dry.name not in index_of or viscous.name not in index_of:
        return []
    dry_index = index_of[dry.name]
    viscous_index = index_of[viscous.name]
    bare = _Declared((dry_index,), (viscous_index,), dry.unit)
    dry_change = index_of.get(f"{dry.name}{LOADED}")
    viscous_change = index_of.get(f"{viscous.name}{LOADED}")
    if dry_change is None or viscous_change is None:
        return [bare]
    loaded_dry = (dry_index, dry_change)
    loaded_viscous = (viscous_index, viscous_change)
    loaded = _Declared(loaded_dry, loaded_viscous, dry.unit)
    return [bare, loaded]


def _positions(evidence: Evidence, axis: int) -> FloatArray:
    """Positions of a joint at which its friction is judged, shape (POSITIONS,).

    They cover its travel about the middle of its runs, or one turn where that is less (cos q and
    sin q repeat), and at least the positions of its runs.
    """
    robot = evidence.model.robot
    joint = robot.joints[robot.axis_joints[axis]]
    covered_rad = 2.0 * np.pi
    if joint.travel is not None:
        covered_rad = min(joint.travel, covered_rad)
    lowest = np.inf
    highest = -np.inf
    for data in evidence.fit_runs:
        position = data.position_rad[:, axis]
        lowest = min(lowest, float(position.min()))
        highest = max(highest, float(position.max()))
    covered_rad = max(covered_rad, highest - lowest)
    middle = 0.5 * (lowest + highest)
    return middle + covered_rad * np.linspace(-0.5, 0.5, POSITIONS)


def _motion(axes: int, velocity: FloatArray, position_rad: FloatArray) -> Signals:
    """Signals of joints that all pass through the same velocities and positions, without load.

    Args:
        axes: number of joints.
        velocity: of each sample [rad/s; m/s of a prismatic joint], shape (k,).
        position_rad: of each sample, shape (k,).
    """
    repeats = (axes, 1)
    positions_rad = np.tile(position_rad, repeats)
    nothing = np.zeros(positions_rad.shape)
    samples = np.arange(len(velocity), dtype=np.float64)
    return Signals(
        rate_hz=1.0,
        time_s=samples,
        session_s=samples,
        position_rad=positions_rad,
        velocity_rad_s=np.tile(velocity, repeats),
        acceleration_rad_s2=nothing,
        motor_position_rad=positions_rad,
        inertia_kg_m2=np.empty((axes, axes, 0)),
        load_torque_nm=nothing,
        geared_torque_nm=nothing,
        motor_torque_nm=nothing,
        current_a=nothing,
    )


def _columns_of(
    placed: PlacedEffect, axes: int, velocity: FloatArray, position_rad: FloatArray
) -> FloatArray | None:
    """Columns of an effect at velocities and positions, shape (p, k).

    None where they are no function of these: an effect of one's own needs the load, or what came
    before a sample.
    """
    onward = _motion(axes, velocity, position_rad)
    backward = _motion(axes, velocity[::-1], position_rad[::-1])
    try:
        columns = columns_at(placed.effect, onward, placed.axis)
        reversed_columns = columns_at(placed.effect, backward, placed.axis)
    except EffectRefused:
        return None
    if not np.allclose(columns, reversed_columns[:, ::-1]):
        return None
    return columns


def _friction_at(
    evidence: Evidence,
    declared: _Declared,
    effects: tuple[PlacedEffect, ...],
    velocities: FloatArray,
    positions_rad: FloatArray,
) -> list[_Friction]:
    """Friction of an axis at every pair of a velocity and a position.

    Args:
        evidence: a joint fit.
        declared: its dry and viscous friction.
        effects: its effects of the speed and of the position.
        velocities: all of one sign, shape (v,).
        positions_rad: shape (p,).

    Returns:
        v · p values of f; none where an effect is no function of velocity and position.
    """
    estimate = evidence.estimate
    unknowns = np.concatenate((estimate.gains, estimate.parameters))
    gain_count = len(estimate.gains)

    def indices(placed: PlacedEffect) -> IntArray:
        """Where the coefficients of an effect are among the unknowns."""
        return gain_count + own_unknowns(estimate, (placed,))

    velocity = np.repeat(velocities, len(positions_rad))
    position_rad = np.tile(positions_rad, len(velocities))
    # Row k of the weights w is ∂f(v_k, q_k)/∂(g, χ): f = w (g, χ), and its variance is w C wᵀ.
    weights = np.zeros((len(velocity), len(unknowns)))
    dry = gain_count + np.array(declared.dry)
    viscous = gain_count + np.array(declared.viscous)
    weights[:, dry] = 1.0
    weights[:, viscous] = np.abs(velocity)[:, None]
    for placed in effects:
        columns = _columns_of(placed, len(estimate.gains), velocity, position_rad)
        if columns is None:
            return []
        weights[:, indices(placed)] = (np.sign(velocity) * columns).T
    torque = weights @ unknowns
    variance = np.einsum("kp,pq,kq->k", weights, estimate.covariance, weights, optimize=True)
    std = np.sqrt(variance)
    found: list[_Friction] = []
    for row in range(len(velocity)):
        friction = _Friction(
            velocity=float(velocity[row]),
            position_rad=float(position_rad[row]),
            torque=float(torque[row]),
            std=float(std[row]),
            unit=declared.unit,
        )
        found.append(friction)
    return found
