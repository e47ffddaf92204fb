"""Where an effect's torque acts: on its joint, or on its motor and so on all joints that the motor turns."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident.arrays import FloatArray
from ident.data.conditioning import Conditioning
from ident.data.dataset import Dataset
from ident.effects.effect import Effect, Side
from ident.effects.signals import Signals
from ident.equations.rows import decimate_rows
from ident.model.model import DriveTrain, Model
from ident.model.robot import JointKind, Robot


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


def at_joints(effect: Effect, axis: int, columns: FloatArray, drive_train: DriveTrain) -> FloatArray:
    """Convert an effect's columns, shape (p, k) or (joints, p, k), to torques of all joints, shape (n, p, k)."""
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
    """Whether an effect can act on an axis; an effect of two joints is placed on the one with the lower number."""
    if effect.needs_revolute and robot.joints[axis].kind is JointKind.PRISMATIC:
        return False
    if effect.side is Side.ALL_MOTORS:
        return axis == 0
    return effect.side is not Side.TWO_JOINTS or axis + 1 < int(effect.settings["other_axis"]) <= robot.joint_count


def joints_of(effect: Effect, axis: int, drive_train: DriveTrain) -> frozenset[int]:
    """Joints whose own torque an effect changes; elasticity and backlash act through the links, and belong to one."""
    if effect.side in (Side.ALL_JOINTS, Side.JOINT):
        return frozenset({axis})
    if effect.side is Side.TWO_JOINTS:
        return frozenset({axis, int(effect.settings["other_axis"]) - 1})
    if effect.side is Side.MOTOR:
        return frozenset(np.flatnonzero(drive_train.direction[axis]).tolist())
    return frozenset(range(len(drive_train.ratio)))
