"""A cell as ident takes it: its declared model."""

from __future__ import annotations

from daq.configuration.cell import Cell
from ident.drive_train import DriveTrain
from ident.model import Model
from ident.robot import robot_from_urdf


def model_of(cell: Cell) -> Model:
    """Geometry of the URDF, gravity and drive train.

    Raises:
        ModelError: the URDF or the drive train describes no robot.
    """
    return Model(robot_from_urdf(cell.urdf, cell.gravity_m_s2), DriveTrain(cell.ratio))
