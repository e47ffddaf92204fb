"""Recover the grouping of a calibration's base parameters from their names and the robot."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from scipy import linalg

from ident.arrays import FloatArray
from ident.errors import ModelError
from ident.model.base import BaseParameters
from ident.model.kinematics import Motion
from ident.model.model import Model

_SAME = 1e-4  #: Tolerance of a weight: names carry six decimals, and filtered data determine a few digits less
_TERM = re.compile(r" ([+-]) ([0-9.e+-]+)\*(\S+)")


def random_motion(limits: FloatArray, samples: int, seed: int) -> Motion:
    """Draw independent states within limits, to test statements about every motion.

    Args:
        limits: middle of the range, half the range, speed and acceleration of each joint, in four rows [rad or m, and
            their derivatives], shape (4, n).
        samples: k.
        seed: the same seed gives the same states.
    """
    draw = np.random.default_rng(seed).uniform(-1.0, 1.0, (3, limits.shape[1], samples)).transpose(0, 2, 1)
    middle, *sizes = limits
    position, velocity, acceleration = (size * part for size, part in zip(sizes, draw, strict=True))
    return Motion(middle + position, velocity, acceleration)


def regroup(model: Model, names: Sequence[str], columns: FloatArray) -> BaseParameters:
    """Compute the weights of standard parameters in each base parameter to full precision.

    A calibration keeps the weights of the grouping as text of six decimals; its leading names are exact. Every column
    is a combination of the leading ones (paper §2.1), so the weights follow from any motion that is rich enough.

    Args:
        model: the declared model of the robot.
        names: of base parameters, in any order: a leading name and what is regrouped with it.
        columns: the model's regressor of such a motion, rows of all joints, shape (m, c).

    Raises:
        ModelError: the names are not those of this robot: unknown, or with other weights (another geometry, other
            gravity), or too few (not everything was identifiable in the fit) or too many.
    """
    index = {column.name: number for number, column in enumerate(model.columns)}
    leading = [name.split(" ", 1)[0] for name in names]
    foreign = [name for name in leading if name not in index]
    if foreign:
        raise ModelError(
            f"the calibration has parameters that this robot does not have: {', '.join(foreign)}; use the cell of the "
            "fit, with its drive train"
        )
    order = np.argsort([index[name] for name in leading])
    independent = tuple(index[leading[i]] for i in order)
    ordered = tuple(names[i] for i in order)
    norms = np.linalg.norm(columns, axis=0)
    scale = np.where(norms > 1e-9 * float(norms.max()), norms, 1.0)
    unit = columns / scale
    chosen = unit[:, list(independent)]
    weights, _, rank, _ = linalg.lstsq(chosen, unit, cond=1e-9)
    if rank < len(independent):
        raise ModelError(
            f"the calibration has {len(independent)} base parameters, this robot only {rank}: another geometry, "
            "gravity or drive train"
        )
    left = np.linalg.norm(unit - chosen @ weights, axis=0)
    unseen = [column.name for column, rest in zip(model.columns, left, strict=True) if rest > 1e-6]
    if unseen:
        raise ModelError(
            f"the calibration lacks {', '.join(unseen)}, which this robot's torque depends on: its data did not "
            "determine them, or it is of another robot"
        )
    grouping = weights * scale / scale[list(independent), None]
    grouping[:, list(independent)] = np.eye(len(independent))
    for row, name in zip(grouping, ordered, strict=True):
        _check_weights(name, row, index)
    return BaseParameters(independent, grouping, ordered)


def _check_weights(name: str, row: FloatArray, index: dict[str, int]) -> None:
    for sign, size, other in _TERM.findall(name):
        declared = float(sign + size)
        found = float(row[index[other]]) if other in index else float("nan")
        if not abs(found - declared) <= _SAME * max(1.0, abs(declared)):
            raise ModelError(
                f"the base parameter {name!r} of the calibration gathers {declared:g}*{other}; this robot's geometry "
                f"gives {found:.6g}: it is not the robot, the gravity or the drive train of the fit"
            )
