"""Whether the friction of an axis brakes at every speed:
friction takes work out of the arm, it never drives it.

A joint fit is of the speeds that its runs have. Terms that depend on the speed alone can stand in
for each other there: drag by a root of the speed, with a dry friction below zero, is right from a
tenth of full speed on, and wrong below it. An axis of a real robot moved slowly in a region that
was left out: there such a fit was off by 18 % of the torque, and the fit without the term by 5 %.
So dry and viscous friction are judged together with all effects of the speed on the axis,

    f(v) = fs + fv |v| + sign(v) Σ c φ(v) ≥ 0,     0 < |v| ≤ the largest speed of the runs, in both directions,

and may be below zero by no more than SIGMAS of its own σ. At rest, f is what the friction of the
axis begins with. Friction that grows with the load, or depends on position or distance, brakes too
and is left out. An axis whose friction depends on the temperature is not judged: fs and fv are then
those of a temperature that the runs need not have.
"""  # noqa: E501

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ident.arrays import FloatArray
from ident.discovery.evidence import Evidence
from ident.discovery.gates import SIGMAS, own_unknowns
from ident.effects.effect import PlacedEffect
from ident.effects.friction import SpeedFriction
from ident.effects.signals import Abscissa
from ident.model.bodies import LOADED

SPEEDS = np.concatenate(([1e-6], np.geomspace(1e-3, 1.0, 25)))
"""Shares of the largest speed; the first one stands for the limit at rest."""


def pushing(evidence: Evidence, axis: int) -> str:
    """Say at which speed the friction of an axis would push; empty where it brakes at all of them.

    Args:
        evidence: a joint fit.
        axis: index of the axis.
    """
    of_axis = [placed for placed in evidence.effects if placed.axis == axis]
    terms = [
        (placed, placed.effect) for placed in of_axis if isinstance(placed.effect, SpeedFriction)
    ]
    by_temperature = any(placed.effect.abscissa is Abscissa.TEMPERATURE for placed in of_axis)
    if not terms or by_temperature:
        return ""
    fastest = max(float(np.max(np.abs(data.velocity_rad_s[:, axis]))) for data in evidence.fit_runs)
    found: list[_Friction] = []
    for declared in _declared_friction(evidence, axis):
        for direction in (1.0, -1.0):
            found += _friction_at(evidence, declared, terms, direction * fastest * SPEEDS)
    worst = min(found, key=lambda one: one.at_most, default=None)
    if worst is None or worst.at_most >= 0.0:
        return ""
    rate = "m/s" if worst.unit == "N" else "rad/s"
    is_at_rest = abs(worst.speed) < 2.0 * fastest * SPEEDS[0]
    where = "at rest" if is_at_rest else f"at {worst.speed:.2g} {rate}"
    return (
        f"the friction of this axis would push the arm {where} ({worst.torque:.3g} ± "
        f"{worst.std:.2g} {worst.unit})"
    )


@dataclass(frozen=True, slots=True)
class _Declared:
    """Dry and viscous friction of an axis, as places among the parameters:
    without load, or the sums with it.
    """

    dry: tuple[int, ...]
    viscous: tuple[int, ...]
    unit: str  #: of the dry friction


@dataclass(frozen=True, slots=True)
class _Friction:
    """Friction of an axis at one speed; positive where it brakes."""

    speed: float  #: [rad/s or m/s]
    torque: float  #: [unit]
    std: float  #: [unit]
    unit: str

    @property
    def at_most(self) -> float:
        """The largest friction that its σ allows [unit]."""
        return self.torque + SIGMAS * self.std


def _declared_friction(evidence: Evidence, axis: int) -> list[_Declared]:
    """The declared friction of an axis without load, and with it where that is another one.

    Empty where a part of it is regrouped into other parameters.
    """
    model = evidence.model
    places = {
        column.name.split(" ", 1)[0]: place
        for place, column in enumerate(evidence.estimate.unknowns)
    }
    dry = model.columns[model.dry_friction_columns[axis]]
    viscous = model.columns[model.viscous_friction_columns[axis]].name
    if dry.name not in places or viscous not in places:
        return []
    bare = _Declared((places[dry.name],), (places[viscous],), dry.unit)
    more_dry = places.get(f"{dry.name}{LOADED}")
    more_viscous = places.get(f"{viscous}{LOADED}")
    if more_dry is None or more_viscous is None:
        return [bare]
    return [bare, _Declared((*bare.dry, more_dry), (*bare.viscous, more_viscous), dry.unit)]


def _friction_at(
    evidence: Evidence,
    declared: _Declared,
    terms: Sequence[tuple[PlacedEffect, SpeedFriction]],
    velocity: FloatArray,
) -> list[_Friction]:
    """Friction at velocities of one sign, shape (k,)."""
    estimate = evidence.estimate
    values = np.concatenate((estimate.gains, estimate.parameters))
    first = len(estimate.gains)
    weights = np.zeros((len(velocity), len(values)))
    weights[:, first + np.array(declared.dry)] = 1.0
    weights[:, first + np.array(declared.viscous)] = np.abs(velocity)[:, None]
    for placed, effect in terms:
        against_motion = np.sign(velocity) * effect.at_speed(velocity)
        weights[:, first + own_unknowns(estimate, (placed,))] = against_motion.T
    torque = weights @ values
    std = np.sqrt(np.einsum("kp,pq,kq->k", weights, estimate.covariance, weights))
    at_each = zip(velocity.tolist(), torque.tolist(), std.tolist(), strict=True)
    return [_Friction(speed, friction, sigma, declared.unit) for speed, friction, sigma in at_each]
