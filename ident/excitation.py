"""How well a motion that has not been made yet would show the parameters (paper §2.3 and Table 5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident.base_parameters import base_parameters
from ident.dataset import Dataset
from ident.model import Model

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Motion:
    """A piece of planned motion of the joints, joint-first, each of shape (n, k)."""

    position_rad: FloatArray
    velocity_rad_s: FloatArray
    acceleration_rad_s2: FloatArray


def weighted_columns(model: Model, motion: Motion, noise_nm: FloatArray) -> FloatArray:
    """Standard columns over a piece of motion, rows of a joint divided by its noise, shape (n k, c).

    Args:
        model: the declared model.
        motion: k samples.
        noise_nm: standard deviation expected at each joint [Nm], shape (n,).
    """
    count, samples = motion.position_rad.shape
    always = np.ones((count, samples), dtype=np.bool_)
    data = Dataset(
        name="plan",
        rate_hz=1.0,
        time_s=np.arange(samples, dtype=np.float64),
        position_rad=motion.position_rad,
        velocity_rad_s=motion.velocity_rad_s,
        acceleration_rad_s2=motion.acceleration_rad_s2,
        current_a=np.zeros((count, samples)),
        moving=always,
        motor_moving=always,
        valid=always,
        move=np.zeros(samples, dtype=np.int64),
        payload=None,
    )
    columns = model.regressor(data, slice(0, samples)) / noise_nm[:, None, None]
    # A joint at rest says nothing that can be used: its dry friction is undetermined (see the standstill mask).
    columns *= (motion.velocity_rad_s != 0.0)[:, None, :]
    return np.asarray(columns.transpose(0, 2, 1).reshape(-1, columns.shape[1]))


def independent_columns(model: Model, pieces: Sequence[FloatArray]) -> tuple[int, ...]:
    """Base parameters that these pieces of weighted columns show, as indices of standard columns."""
    triangle = np.asarray(np.linalg.qr(np.concatenate(pieces), mode="r"))
    return base_parameters(triangle, tuple(column.name for column in model.columns)).independent


def condition(information: FloatArray) -> float:
    """Condition number of the weighted observation matrix W from WᵀW; inf when a column is not seen.

    The information of a plan is the sum over its moves.
    """
    values = np.linalg.eigvalsh(information)
    return float(np.sqrt(values[-1] / values[0])) if values[0] > 0.0 else float("inf")
