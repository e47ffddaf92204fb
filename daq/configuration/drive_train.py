"""The drive train as a cell file writes it, and which joint the gain of each motor speaks of."""

from __future__ import annotations

from math import pi

import numpy as np
from numpy.typing import NDArray

from daq.configuration.cell_schema import CellModel

FloatArray = NDArray[np.float64]


def ratio_of(model: CellModel) -> FloatArray:
    """R of q_motor = R q_joint (paper eq. 24), rad a rad, or rad a metre of a prismatic joint, shape (n, n).

    Where a prismatic axis has a `lead_mm`, its column is written in turns: one turn of screw or pinion moves the joint
    by the lead, so R = ratio · 2π / lead.

    Raises:
        ValueError: the rows are not n of n numbers.
    """
    lead_mm = [axis.lead_mm for axis in model.axes]
    per_turn = np.array([1.0 if lead is None else 2.0 * pi / (1e-3 * lead) for lead in lead_mm])
    return np.asarray(np.array(model.drive_train.ratio, dtype=np.float64) * per_turn, dtype=np.float64)


def gain_joints(ratio: FloatArray) -> tuple[int, ...]:
    """Index of the joint whose torque or force the gain of each motor speaks of: that of its reduction N.

    Args:
        ratio: R, shape (n, n).
    """
    # The rule of ident.drive_train.DriveTrain.reduction.
    return tuple(motor if row[motor] != 0.0 else int(np.argmax(np.abs(row))) for motor, row in enumerate(ratio))
