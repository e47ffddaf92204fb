"""Whether the friction of an axis brakes at every speed and position: it never drives the arm.

A joint fit is of the speeds that its runs have. Terms that depend on the speed alone can stand in
for each other there: drag by a root of the speed, with a dry friction below zero, is right from a
tenth of full speed on, and wrong below it. An axis of a real robot moved slowly in a region that
was left out: there such a fit was off by 18 % of the torque, and the fit without the term by 5 %.
Friction that depends on the position can be below zero where no run has been.
So dry and viscous friction are judged together with all effects of the speed and of the position on
the axis,

    f(v, q) = fs + fv |v| + sign(v) Σ c φ(v) + a cos q + b sin q ≥ 0,

for 0 < |v| ≤ the largest speed of the runs, in both directions, and all q within the joint's travel
about the middle of its runs. It may be below zero by no more than SIGMAS of its own σ. At rest,
f is what the friction of the axis begins with. Friction that grows with the load, or depends on
the distance, brakes too and is left out. An axis whose friction depends on the temperature is not
judged: fs and fv are then those of a temperature that the runs need not have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ident.arrays import FloatArray
from ident.discovery.evidence import Evidence
from ident.discovery.gates import SIGMAS, own_unknowns
from ident.effects.effect import PlacedEffect
from ident.effects.friction import PositionFriction, SpeedFriction
from ident.effects.signals import Abscissa
from ident.model.bodies import LOADED
from ident.model.regressor import cos_sin

SPEEDS = np.concatenate(([1e-6], np.geomspace(1e-3, 1.0, 25)))
"""Shares of the largest speed; the first one stands for the limit at rest."""

POSITIONS = 48
"""Positions at which friction that depends on the position is judged: 7.5° of a turn."""


def pushing(evidence: Evidence, axis: int) -> str:
    """Say where the friction of an axis would push; empty where it brakes everywhere.

    Args:
        evidence: a joint fit.
        axis: index of the axis.
    """
    of_axis = [placed for placed in evidence.effects if placed.axis == axis]
    of_speed: list[tuple[PlacedEffect, SpeedFriction]] = []
    of_position: list[PlacedEffect] = []
    for placed in of_axis:
        if placed.effect.abscissa is Abscissa.TEMPERATURE:
            return ""
        if isinstance(placed.effect, SpeedFriction):
            of_speed.append((placed, placed.effect))
        if isinstance(placed.effect, PositionFriction):
            of_position.append(placed)
    if not of_speed and not of_position:
        return ""
    positions_rad = np.zeros(1)
    if of_position:
        positions_rad = _positions(evidence, axis)
    speeds = [np.abs(data.velocity_rad_s[:, axis]) for data in evidence.fit_runs]
    fastest = max(float(np.max(speed)) for speed in speeds)
    found: list[_Friction] = []
    for declared in _declared_friction(evidence, axis):
        for direction in (1.0, -1.0):
            velocity = direction * fastest * SPEEDS
            found += _friction_at(
                evidence, declared, of_speed, of_position, velocity, positions_rad
            )
    worst = min(found, key=lambda one: one.at_most, default=None)
    if worst is None or worst.at_most >= 0.0:
        return ""
    where = _place(worst, fastest)
    if of_position:
        where += f", where its position is {worst.position_rad:.2g} rad"
    torque = f"{worst.torque:.3g} ± {worst.std:.2g} {worst.unit}"
    return f"the friction of this axis would push the arm {where} ({torque})"


@dataclass(frozen=True, slots=True)
class _Declared:
    """Dry and viscous friction of an axis, as places among the parameters.

    With a load, several parameters make the sum.
    """

    dry: tuple[int, ...]
    viscous: tuple[int, ...]
    unit: str  #: of the dry friction


@dataclass(frozen=True, slots=True)
class _Friction:
    """Friction of an axis at one speed and position; positive where it brakes."""

    speed: float  #: [rad/s or m/s]
    position_rad: float  #: 0 where no friction depends on it
    torque: float  #: [unit]
    std: float  #: [unit]
    unit: str

    @property
    def at_most(self) -> float:
        """The largest friction that its σ allows [unit]."""
        return self.torque + SIGMAS * self.std


def _place(worst: _Friction, fastest: float) -> str:
    """At which speed a friction is, in words."""
    if abs(worst.speed) < 2.0 * fastest * SPEEDS[0]:
        return "at rest"
    if worst.unit == "N":
        return f"at {worst.speed:.2g} m/s"
    return f"at {worst.speed:.2g} rad/s"


def _declared_friction(evidence: Evidence, axis: int) -> list[_Declared]:
    """The declared friction of an axis without load, and with it where that is another one.

    Empty where a part of it is regrouped into other parameters.
    """
    model = evidence.model
    places: dict[str, int] = {}
    for place, column in enumerate(evidence.estimate.unknowns):
        standard, *_ = column.name.split(" ", 1)
        places[standard] = place
    dry = model.columns[model.dry_friction_columns[axis]]
    viscous = model.columns[model.viscous_friction_columns[axis]].name
    if dry.name not in places or viscous not in places:
        return []
    bare = _Declared((places[dry.name],), (places[viscous],), dry.unit)
    more_dry = places.get(f"{dry.name}{LOADED}")
    more_viscous = places.get(f"{viscous}{LOADED}")
    if more_dry is None or more_viscous is None:
        return [bare]
    loaded = _Declared((*bare.dry, more_dry), (*bare.viscous, more_viscous), dry.unit)
    return [bare, loaded]


def _positions(evidence: Evidence, axis: int) -> FloatArray:
    """Positions of a joint at which its friction is judged, shape (POSITIONS,).

    They reach as far as its travel, about the middle of its runs; a turn holds all of a cosine.
    """
    robot = evidence.model.robot
    joint = robot.joints[robot.axis_joints[axis]]
    reach_rad = 2.0 * np.pi
    if joint.travel is not None:
        reach_rad = min(joint.travel, reach_rad)
    lowest = min(float(np.min(data.position_rad[:, axis])) for data in evidence.fit_runs)
    highest = max(float(np.max(data.position_rad[:, axis])) for data in evidence.fit_runs)
    reach_rad = max(reach_rad, highest - lowest)
    middle = 0.5 * (lowest + highest)
    return middle + reach_rad * np.linspace(-0.5, 0.5, POSITIONS)


def _friction_at(
    evidence: Evidence,
    declared: _Declared,
    of_speed: Sequence[tuple[PlacedEffect, SpeedFriction]],
    of_position: Sequence[PlacedEffect],
    speeds: FloatArray,
    positions_rad: FloatArray,
) -> list[_Friction]:
    """Friction at each of some velocities of one sign, shape (k,), and positions, shape (n,)."""
    estimate = evidence.estimate
    values = np.concatenate((estimate.gains, estimate.parameters))
    first = len(estimate.gains)
    dry = first + np.array(declared.dry)
    viscous = first + np.array(declared.viscous)
    velocity = np.repeat(speeds, len(positions_rad))
    position_rad = np.tile(positions_rad, len(speeds))
    # Row k of the weights w is ∂f(v_k, q_k)/∂(g, χ): f = w χ, and its variance is w C wᵀ.
    weights = np.zeros((len(velocity), len(values)))
    weights[:, dry] = 1.0
    weights[:, viscous] = np.abs(velocity)[:, None]
    for placed, effect in of_speed:
        against_motion = np.sign(velocity) * effect.at_speed(velocity)
        of_effect = first + own_unknowns(estimate, (placed,))
        weights[:, of_effect] = against_motion.T
    for placed in of_position:
        of_effect = first + own_unknowns(estimate, (placed,))
        weights[:, of_effect] = np.stack(cos_sin(position_rad), axis=-1)
    torque = weights @ values
    variance = np.einsum("kp,pq,kq->k", weights, estimate.covariance, weights, optimize=True)
    std = np.sqrt(variance)
    found: list[_Friction] = []
    for place in range(len(velocity)):
        found.append(
            _Friction(
                speed=float(velocity[place]),
                position_rad=float(position_rad[place]),
                torque=float(torque[place]),
                std=float(std[place]),
                unit=declared.unit,
            )
        )
    return found
