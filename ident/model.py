"""The declared model: rigid links, rotors, friction and offsets, each a column (paper eqs. 1 and 25)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident.drive_train import DriveTrain
from ident.link import LINK_PARAMETERS, LINK_UNITS
from ident.motion import Motion
from ident.regressor import rigid_regressor
from ident.robot import JointKind, Robot

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Column:
    """One standard parameter."""

    name: str
    unit: str


@dataclass(frozen=True, slots=True)
class Model:
    """A robot and its drive train, with the standard parameters χ_st in the paper's order.

    A joint has fourteen: ten of its link (LINK_PARAMETERS), then Ia, fv, fs, off. A motor that turns with several
    joints adds three (eq. 25): Iam, fvm, fsm. Its rotor inertia and viscous friction act on the joints through
    r rᵀ; the diagonal of that is already in Ia and fv, so Iam and fvm carry the off-diagonal part, as in the paper.
    """

    robot: Robot
    drive_train: DriveTrain

    @property
    def columns(self) -> tuple[Column, ...]:
        """Names and units of the standard parameters."""
        columns: list[Column] = []
        for number, joint in enumerate(self.robot.joints, start=1):
            force = "Nm" if joint.kind is JointKind.REVOLUTE else "N"
            rate = "rad/s" if joint.kind is JointKind.REVOLUTE else "m/s"
            inertia = "kg m²" if joint.kind is JointKind.REVOLUTE else "kg"
            columns += [Column(f"{name}{number}", unit) for name, unit in zip(LINK_PARAMETERS, LINK_UNITS, strict=True)]
            columns += [
                Column(f"Ia{number}", inertia),
                Column(f"fv{number}", f"{force}/({rate})"),
                Column(f"fs{number}", force),
                Column(f"off{number}", force),
            ]
        for motor in self.drive_train.coupled:
            columns += [
                Column(f"Iam{motor + 1}", "kg m²"),
                Column(f"fvm{motor + 1}", "Nm/(rad/s)"),
                Column(f"fsm{motor + 1}", "Nm"),
            ]
        return tuple(columns)

    @property
    def flange(self) -> slice:
        """The ten columns of the last link; a payload on it has the same."""
        first = 14 * (self.robot.joint_count - 1)
        return slice(first, first + 10)

    def regressor(self, motion: Motion) -> FloatArray:
        """Joint torque per unit of every standard parameter.

        Returns:
            shape (n, c, k) [Nm or N per unit], time last.
        """
        position, velocity, acceleration = motion.position_rad, motion.velocity_rad_s, motion.acceleration_rad_s2
        count, samples = position.shape
        sign = np.sign(velocity)
        out = np.zeros((count, len(self.columns), samples))
        rigid = rigid_regressor(self.robot, position, velocity, acceleration)
        for joint in range(count):
            first = 14 * joint
            out[:, first : first + 10] = rigid[:, 10 * joint : 10 * joint + 10]
            out[joint, first + 10] = acceleration[joint]
            out[joint, first + 11] = velocity[joint]
            out[joint, first + 12] = sign[joint]
            out[joint, first + 13] = 1.0
        direction = self.drive_train.direction
        motor_speed = direction @ velocity
        for index, motor in enumerate(self.drive_train.coupled):
            first = 14 * count + 3 * index
            r = direction[motor]
            cross = np.outer(r, r) - np.diag(r**2)
            out[:, first] = cross @ acceleration
            out[:, first + 1] = cross @ velocity
            out[:, first + 2] = r[:, None] * np.sign(motor_speed[motor])
        return out
