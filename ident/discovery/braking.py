"""Whether the friction of an axis brakes at every speed: friction takes work out of the arm, it never drives it.

A joint fit is of the speeds that its runs have. Terms that depend on the speed alone can stand in for each other there:
drag by a root of the speed, with a dry friction below zero, is right from a tenth of full speed on, and wrong below it.
On a region of the workspace where the arm moves slowly, such a fit was off by 18 % of the torque where the one without
it was off by 5 %. So dry and viscous friction are judged together with all effects of the speed on the axis,

    f(v) = fs + fv |v| + sign(v) Σ c φ(v) ≥ 0,     0 < |v| ≤ the largest speed of the runs, in both directions,

and may be below zero by no more than SIGMAS of its own σ. At rest, f is what the friction of the axis begins with.
"""

from __future__ import annotations

import numpy as np

from ident.discovery.evidence import Evidence
from ident.discovery.gates import SIGMAS, own_unknowns
from ident.effects.friction import SpeedFriction

SPEEDS = np.concatenate(([1e-6], np.geomspace(1e-3, 1.0, 25)))
"""Shares of the largest speed; the first one stands for the limit at rest."""


def pushing(evidence: Evidence, axis: int) -> str:
    """Say at which speed the friction of an axis would push; empty where it brakes at all of them.

    Args:
        evidence: a joint fit.
        axis: index of the axis.
    """
    estimate = evidence.estimate
    placed = [one for one in evidence.effects if one.axis == axis and isinstance(one.effect, SpeedFriction)]
    declared = _declared_places(evidence, axis)
    if not placed or declared is None:
        return ""
    fastest = max(float(np.max(np.abs(data.velocity_rad_s[:, axis]))) for data in evidence.fit_runs)
    values = np.concatenate((estimate.gains, estimate.parameters))
    count = len(estimate.gains)
    worst = ""
    lowest = 0.0
    for sign in (1.0, -1.0):
        speed = fastest * SPEEDS
        weights = np.zeros((len(speed), len(values)))
        weights[:, count + declared[0]] = 1.0
        weights[:, count + declared[1]] = speed
        for one in placed:
            assert isinstance(one.effect, SpeedFriction)
            columns = sign * one.effect.at_speed(sign * speed)
            weights[:, count + own_unknowns(estimate, (one,))] = columns.T
        friction = weights @ values
        std = np.sqrt(np.einsum("kp,pq,kq->k", weights, estimate.covariance, weights))
        excess = friction + SIGMAS * std
        place = int(np.argmin(excess))
        if excess[place] < lowest:
            lowest = float(excess[place])
            worst = _text(evidence, declared[0], sign * float(speed[place]), float(friction[place]), float(std[place]))
    return worst


def _declared_places(evidence: Evidence, axis: int) -> tuple[int, int] | None:
    """Places of fs and fv of an axis among the parameters; None where one of them is regrouped into others."""
    leading = [column.name.split(" ", 1)[0] for column in evidence.estimate.unknowns]
    columns = evidence.model.columns
    dry = columns[evidence.model.dry_friction_columns[axis]].name
    viscous = columns[evidence.model.viscous_friction_columns[axis]].name
    if dry not in leading or viscous not in leading:
        return None
    return leading.index(dry), leading.index(viscous)


def _text(evidence: Evidence, dry: int, speed: float, friction: float, std: float) -> str:
    unit = evidence.estimate.unknowns[dry].unit
    rate = "m/s" if unit == "N" else "rad/s"
    at = "at rest" if abs(speed) < 1e-5 else f"at {speed:.2g} {rate}"
    return f"the friction of this axis would push the arm {at} ({friction:.3g} ± {std:.2g} {unit})"
