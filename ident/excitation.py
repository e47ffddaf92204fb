"""How well a motion that has not been made yet would show the parameters (paper §2.3 and Table 5)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ident.base_parameters import base_parameters
from ident.model import Model
from ident.motion import Motion

FloatArray = NDArray[np.float64]


def weighted_columns(model: Model, motion: Motion, noise_nm: FloatArray) -> FloatArray:
    """Standard columns over a piece of motion, rows of a joint divided by its noise, shape (n k, c).

    Args:
        model: the declared model.
        motion: k samples.
        noise_nm: standard deviation expected at each joint [Nm], shape (n,).
    """
    columns = model.regressor(motion) / noise_nm[:, None, None]
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
