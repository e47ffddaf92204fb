"""Mistakes of geometry and time that are planted into runs or into the description,
and whether a search names them.

A zero offset is added to the recorded positions of one joint; a late encoder reads them, and a late
current those of a motor, where they were a while before; a tilt turns the gravity that the
identification is given. It is given nothing else of the mistake.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from scipy import linalg

from daq.config.cell import Cell
from ident.arrays import FloatArray
from ident.data.run import Run
from ident.discovery.candidates import prepare_search
from ident.discovery.evidence import Evidence
from ident.discovery.gates import own_unknowns, values_of
from ident.effects.effect import PlacedEffect
from ident.equations.observation import observe
from ident.model.robot import JointKind

GRAVITY_M_S2 = 9.81
SI_OF_UNIT = {
    "rad": 1.0,
    "mrad": 1e-3,
    "deg": np.pi / 180.0,
    "m": 1.0,
    "mm": 1e-3,
    "s": 1.0,
    "ms": 1e-3,
    "m/s²": 1.0 / GRAVITY_M_S2,
    "m/s^2": 1.0 / GRAVITY_M_S2,
    "": 1.0,
}
"""Units that a coefficient may have; a component of gravity counts as the angle that it turns
gravity by.
"""
UNSEEN = 1e-6  #: Share of a column, squared, below which the declared directions contain it
SHIFT = 1e-5  #: Step of the derivative to a joint's position [rad or m]


class Mistake(Enum):
    """What is planted."""

    CLEAN = "clean"
    ZERO = "zero-offset"
    GRAVITY = "gravity-direction"
    ENCODER = "late-position"
    CURRENT = "late-current"


EFFECT_OF = {
    Mistake.ZERO: "zero-offset",
    Mistake.GRAVITY: "gravity-direction",
    Mistake.ENCODER: "late-position",
    Mistake.CURRENT: "lag",
}
"""Effect by which a mistake is named; on its axis, but for gravity, which has none."""


@dataclass(frozen=True, slots=True)
class Planted:
    """One mistake.

    Attributes:
        mistake: its kind.
        axis: index of its joint or motor; −1 where it has none.
        size: rad, m of a prismatic joint, or s; 0 of a clean cell.
    """

    mistake: Mistake
    axis: int = -1
    size: float = 0.0


@dataclass(frozen=True, slots=True)
class NamedMistake:
    """Whether a search named what was planted, and with which value.

    Attributes:
        named: whether it did, on the right axis.
        value, std: of the coefficient in SI, its length where there are several; NaN where it was
            not named.
        z: distance of the value found from that which corrects what was planted, in σ; of a turn,
            by its size.
        others: all other effects that joined, but those that the cell declares.
    """

    named: bool
    value: float
    std: float
    z: float
    others: tuple[PlacedEffect, ...]


def plant(
    runs: Sequence[Run], cell: Cell, planted: Planted, seed: int
) -> tuple[tuple[Run, ...], Cell]:
    """Plant a mistake into runs or into the description of the cell.

    Args:
        runs: as recorded.
        cell: as declared.
        planted: the mistake.
        seed: of the direction of a tilt.
    """
    if planted.mistake is Mistake.CLEAN:
        return tuple(runs), cell
    if planted.mistake is Mistake.GRAVITY:
        gravity_m_s2 = tilted(cell.gravity_m_s2, planted.size, float(seed))
        return tuple(runs), replace(cell, gravity_m_s2=gravity_m_s2)
    return tuple(_wrong(run, planted) for run in runs), cell


def _wrong(run: Run, planted: Planted) -> Run:
    """A run with a mistake in its arrays."""
    axis = planted.axis
    position = run.position_rad.copy()
    current = run.current_a.copy()
    if planted.mistake is Mistake.ZERO:
        position[:, axis] += planted.size
    elif planted.mistake is Mistake.ENCODER:
        position[:, axis] = late(run.time_s, position[:, axis], planted.size)
    else:
        current[:, axis] = late(run.time_s, current[:, axis], planted.size)
    return replace(run, position_rad=position, current_a=current)


def late(time_s: FloatArray, values: FloatArray, delay_s: float) -> FloatArray:
    """Values as they were a while before, shape (k,) each;
    before the first sample they were as in it.
    """
    return np.interp(time_s - delay_s, time_s, values)


def tilted(
    gravity_m_s2: Sequence[float], angle_rad: float, heading_rad: float
) -> tuple[float, float, float]:
    """Gravity turned about a direction across it [m/s²].

    Args:
        gravity_m_s2: in the base frame, shape (3,).
        angle_rad: by which it is turned.
        heading_rad: which of the directions across it.
    """
    gravity = np.asarray(gravity_m_s2, dtype=np.float64)
    size = float(np.linalg.norm(gravity))
    along = gravity / size
    across = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    across /= np.linalg.norm(across)
    along_cross = np.cross(along, across)
    towards = np.cos(heading_rad) * across + np.sin(heading_rad) * along_cross
    x, y, z = (size * (np.cos(angle_rad) * along + np.sin(angle_rad) * towards)).tolist()
    return x, y, z


def value_of(evidence: Evidence, placed: PlacedEffect) -> tuple[float, float]:
    """Coefficient of an effect and its σ in SI; of several coefficients the length of their vector.

    Raises:
        ValueError: its unit is none of SI_OF_UNIT.
    """
    estimate = evidence.estimate
    own = own_unknowns(estimate, (placed,))
    units = [estimate.unknowns[place].unit for place in own]
    difference = set(units) - SI_OF_UNIT.keys()
    unknown = sorted(difference)
    if unknown:
        raise ValueError(
            f"{placed.effect.name} has the unit {unknown[0]!r}; expected one of "
            f"{', '.join(SI_OF_UNIT)}"
        )
    si_of_units = [SI_OF_UNIT[unit] for unit in units]
    scale = np.array(si_of_units)
    values = values_of(estimate, own) * scale
    place = len(estimate.gains) + own
    scale_outer = np.outer(scale, scale)
    covariance = estimate.covariance[np.ix_(place, place)] * scale_outer
    if len(values) == 1:
        covariance_root = np.sqrt(covariance[0, 0])
        return float(values[0]), float(covariance_root)
    length = float(np.linalg.norm(values))
    direction = values / length
    return length, float(np.sqrt(direction @ covariance @ direction))


def judge_mistake(evidence: Evidence, planted: Planted) -> NamedMistake:
    """Judge what a search has added to the model of runs with a mistake."""
    found = evidence.effects[evidence.declared :]
    name = EFFECT_OF.get(planted.mistake)
    anywhere = planted.mistake is Mistake.GRAVITY
    own = [
        placed
        for placed in found
        if placed.effect.name == name and (anywhere or placed.axis == planted.axis)
    ]
    others = tuple(placed for placed in found if placed not in own)
    if not own:
        return NamedMistake(False, float("nan"), float("nan"), float("nan"), others)
    value, std = value_of(evidence, own[0])
    difference = value - correcting_value(planted)
    return NamedMistake(True, value, std, difference / std, others)


def correcting_value(planted: Planted) -> float:
    """Coefficient that corrects a mistake: what has to be added to a position,
    or by how much a signal is late.
    """
    if planted.mistake is Mistake.ZERO:
        return -planted.size
    return planted.size


def predicted_offset_std(evidence: Evidence) -> FloatArray:
    """σ with which a zero offset of each joint would be found beside the declared model [rad or m],
    shape (n,).

    The column of an offset is ∂τ/∂q_j of the whole arm, on all axes. What the declared directions
    leave of it, φ⊥, finds the offset with the variance Σ_c (φ⊥_cᵀ e_c)²/(φ⊥ᵀφ⊥)², of clusters c of
    rows and with e the residual beside the column. Infinite where they leave none.
    """
    model = evidence.model
    estimate = evidence.estimate
    rows = evidence.training
    prepared = prepare_search(model, evidence.fit_runs, rows, estimate)
    folds = prepared.folds
    problem = folds.linearisation
    torque = estimate.predicted_torque(rows)
    deviations: list[float] = []
    for joint in range(model.robot.axis_count):
        step = np.zeros(model.robot.axis_count)
        step[joint] = SHIFT
        moved = [replace(data, position_rad=data.position_rad + step) for data in evidence.fit_runs]
        there = observe(model, moved, evidence.conditioning, rows)
        shifted = replace(rows, regressor=there.regressor, flange=there.flange)
        difference = estimate.predicted_torque(shifted) - torque
        column = difference / SHIFT
        whitened = problem.whitened(column[:, None, :], model.drive_train.to_motor)[:, 0]
        absorbed = linalg.cho_solve(folds.full_factor, problem.jacobian.on_columns(whitened))
        left = whitened - problem.jacobian @ absorbed
        size = float(left @ left)
        if size <= UNSEEN * float(whitened @ whitened):
            deviations.append(float("inf"))
            continue
        offset = float(left @ problem.residual) / size
        scores = np.bincount(problem.cluster, left * (problem.residual - left * offset))
        score_norm = float(np.linalg.norm(scores))
        deviations.append(score_norm / size)
    return np.array(deviations)


def is_prismatic(evidence: Evidence) -> tuple[bool, ...]:
    """Whether each axis is prismatic."""
    axes = evidence.model.robot.axes
    return tuple(joint.kind is JointKind.PRISMATIC for joint in axes)
