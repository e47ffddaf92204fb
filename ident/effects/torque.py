"""An effect's columns where its torque acts: at its joint, or at its motor and so at all joints that it turns."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ident.conditioning import Conditioning
from ident.dataset import Dataset
from ident.drive_train import DriveTrain
from ident.effects.compensator import Compensator
from ident.effects.effect import Effect, Side
from ident.effects.position_friction import PositionFriction
from ident.model import Model
from ident.robot import JointKind, Robot
from ident.rows import decimate_rows
from ident.signals import Signals

FloatArray = NDArray[np.float64]


def at_joints(effect: Effect, axis: int, columns: FloatArray, drive_train: DriveTrain) -> FloatArray:
    """An effect's columns at its axis, shape (p, k) or (joints, p, k), as torque of all joints, shape (n, p, k)."""
    if effect.side is Side.MOTOR:
        return np.asarray(drive_train.direction[axis][:, None, None] * columns[None])
    if effect.side is Side.ALL_JOINTS:
        return columns
    if effect.side is Side.ALL_MOTORS:
        return np.asarray(np.einsum("ij,ipk->jpk", drive_train.direction, columns))
    joints = [axis, int(effect.settings["other_axis"]) - 1] if effect.side is Side.TWO_JOINTS else [axis]
    torque = np.zeros((len(drive_train.ratio), *columns.shape[-2:]))
    torque[joints] = columns
    return torque


def is_placeable(effect: Effect, axis: int, robot: Robot) -> bool:
    """Whether an effect can act on an axis; a pair of joints is named by the lower one, and only angles have a sine."""
    axes = robot.joint_count
    if isinstance(effect, PositionFriction | Compensator) and robot.joints[axis].kind is JointKind.PRISMATIC:
        return False
    if effect.side is Side.ALL_MOTORS:
        return axis == 0
    return effect.side is not Side.TWO_JOINTS or axis + 1 < int(effect.settings["other_axis"]) <= axes


def acts_on(effect: Effect, axis: int, drive_train: DriveTrain) -> frozenset[int]:
    """The joints that an effect at an axis gives a torque of its own to."""
    everywhere = frozenset(range(len(drive_train.ratio)))
    if effect.side in (Side.ALL_JOINTS, Side.JOINT):
        return frozenset({axis})  # elasticity and backlash are felt everywhere, and are one joint's
    if effect.side is Side.TWO_JOINTS:
        return frozenset({axis, int(effect.settings["other_axis"]) - 1})
    if effect.side is Side.MOTOR:
        return frozenset(np.flatnonzero(drive_train.direction[axis]).tolist())
    return everywhere


def effect_torque(
    effect: Effect,
    axis: int,
    runs: Sequence[Signals],
    datasets: Sequence[Dataset],
    conditioning: Conditioning,
    model: Model,
) -> FloatArray:
    """An effect's columns as joint torques on the observation's rows [Nm per unit], shape (n, p, r)."""
    parts = [
        decimate_rows(data, conditioning, effect.columns(run, axis)) for run, data in zip(runs, datasets, strict=True)
    ]
    return at_joints(effect, axis, np.concatenate(parts, axis=-1), model.drive_train)
