"""Whether base parameters that were identified can be those of a robot.

Some changes of the standard parameters leave every torque as it is: W_st N = 0, whatever the motion
(paper §2.1). Base parameters β = G χ_st do not change with them, so G N = 0. That holds of any data
of the robot, also of data that determine fewer base parameters than the robot has; N depends on the
lengths, twists and kinds of joints, and another robot's is another.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from ident.arrays import FloatArray
from ident.model.bodies import LOADED
from ident.model.closed_chain import null_space
from ident.model.model import Model
from ident.model.robot import Motion

STATES = 60  #: States on which W_st is computed; each gives a row for every joint
RANGE = 1.5  #: Positions, speeds and accelerations are drawn from ± this [rad or m, s]
RANK_TOLERANCE = 1e-9  #: Singular values below this share of the largest are rounding error
WEIGHT_TOLERANCE = 1e-2
"""Share of a weight that may differ.

Filtered data determine it to four digits; a length that differs by a few millimetres is the
correction of a description, not another robot.
"""
ROUNDED = 2e-6  #: Weights are written with six decimals, and left out below
TERM = re.compile(r" ([+-]) ([0-9.e+-]+)\*(\S+)")
"""A standard parameter that a base parameter gathers, in its name: " + 0.4*m3"."""


def foreign_base_parameter(model: Model, names: Sequence[str]) -> str | None:
    """Return the base parameter that contradicts a robot most; None where they can be this robot's.

    Closed chains are not compared: their regressor needs a motion on which the loops close. Nor is
    what a payload adds to friction, which no geometry changes.

    Args:
        model: of the robot.
        names: of the base parameters, each a leading standard parameter of this model and what it
            gathers.
    """
    compared = [name for name in names if not _leading_name(name).endswith(LOADED)]
    # Standard parameters as they are, none gathered with others, are right for their robot.
    is_grouped = any(TERM.search(name) for name in compared)
    if model.robot.is_constrained or not is_grouped:
        return None
    columns: list[int] = []
    column_names: list[str] = []
    for number, column in enumerate(model.columns):
        if not column.name.endswith(LOADED):
            columns.append(number)
            column_names.append(column.name)
    states = _drawn_states(model.robot.axis_count)
    regressor = model.regressor(states)[:, columns]
    rows = regressor.transpose(0, 2, 1).reshape(-1, len(columns))
    size = np.linalg.norm(rows, axis=0)
    is_seen = size > RANK_TOLERANCE * float(size.max())
    scale = np.where(is_seen, size, 1.0)
    invisible = null_space(rows / scale, RANK_TOLERANCE)
    leading, weights = _weights(compared, column_names)
    by_torque = scale[leading, None] / scale  # weights for columns of unit size
    change = np.linalg.norm((weights * by_torque) @ invisible, axis=1)
    is_gathered = weights != 0.0
    largest_weight = np.maximum(1.0, np.abs(weights))
    allowed_weight = is_gathered * WEIGHT_TOLERANCE * largest_weight + is_seen * ROUNDED
    allowed = np.linalg.norm(allowed_weight * by_torque, axis=1)
    excess = change / allowed
    # It moves nothing here, as a link's moment does where gravity is along the axis
    excess[~is_seen[leading]] = 0.0
    worst = int(np.argmax(excess))
    if excess[worst] > 1.0:
        return compared[worst]
    return None


def _weights(names: Sequence[str], columns: Sequence[str]) -> tuple[list[int], FloatArray]:
    """Read names of base parameters: the index of each leading column, and G, shape (b, c)."""
    index = {name: number for number, name in enumerate(columns)}
    leading = [index[_leading_name(name)] for name in names]
    weights = np.zeros((len(names), len(columns)))
    for row, (first, name) in enumerate(zip(leading, names, strict=True)):
        weights[row, first] = 1.0
        for sign, number, other in TERM.findall(name):
            if other in index:
                weights[row, index[other]] = float(sign + number)
    return leading, weights


def _leading_name(name: str) -> str:
    """Standard parameter that a base parameter begins with."""
    leading, _, _ = name.partition(" ")
    return leading


def _drawn_states(axis_count: int) -> Motion:
    """States at random, always the same ones."""
    random = np.random.default_rng(0)
    position, velocity, acceleration = random.uniform(-RANGE, RANGE, (3, STATES, axis_count))
    return Motion(position, velocity, acceleration)
