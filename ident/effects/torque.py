"""An effect's columns where its torque acts: at its joint, or at its motor and so at all joints that it turns."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ident.conditioning import Conditioning
from ident.dataset import Dataset
from ident.drive_train import DriveTrain
from ident.effects.effect import Effect, Side
from ident.model import Model
from ident.rows import decimate_rows
from ident.signals import Signals

FloatArray = NDArray[np.float64]


def at_joints(effect: Effect, axis: int, columns: FloatArray, drive_train: DriveTrain) -> FloatArray:
    """An effect's columns at its axis, shape (p, k), as torque of all joints, shape (n, p, k)."""
    acts_on = drive_train.direction[axis] if effect.side is Side.MOTOR else np.eye(len(drive_train.ratio))[axis]
    return np.asarray(acts_on[:, None, None] * columns[None])


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
    return at_joints(effect, axis, np.concatenate(parts, axis=1), model.drive_train)
