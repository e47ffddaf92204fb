"""The declared model: rigid links, rotors, friction and offsets, each a column (paper eqs. 1 and 25)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ident.arrays import BoolArray, FloatArray, IntArray, as_array, require_kind
from ident.errors import ModelError
from ident.model.bodies import LINK_PARAMETERS, LINK_UNITS
from ident.model.regressor import fill_rigid, rigid_torque
from ident.model.robot import JointKind, Motion, Robot

DRIVE_UNITS = {JointKind.REVOLUTE: ("Nm", "rad/s", "kg m²"), JointKind.PRISMATIC: ("N", "m/s", "kg")}
"""Units of torque or force along a joint, of its speed, and of a rotor's inertia seen there."""
JOINT_COLUMNS = 14  #: Standard parameters of a joint: ten of its link (LINK_PARAMETERS), then Ia, fv, fs, off


def link_columns(joints: int) -> IntArray:
    """Columns of the links' parameters among the standard ones, shape (joints, 10)."""
    return JOINT_COLUMNS * np.arange(joints)[:, None] + np.arange(len(LINK_PARAMETERS))


def dry_friction_columns(joints: int) -> IntArray:
    """Columns of fs among the standard ones, shape (joints,)."""
    return JOINT_COLUMNS * np.arange(joints) + 12


@dataclass(frozen=True, slots=True)
class DriveTrain:
    """Gears between motors and joints: q_motor = R q_joint and τ_joint = Rᵀ τ_motor (paper eq. 24)."""

    ratio: FloatArray  #: R, shape (n, n), invertible; row i belongs to motor i. Nested lists will do

    def __post_init__(self) -> None:
        ratio = as_array("the drive train", self.ratio)
        object.__setattr__(self, "ratio", ratio)
        if ratio.ndim != 2 or ratio.shape[0] != ratio.shape[1]:
            remedy = "; write np.diag(gear_ratios)" if ratio.ndim == 1 else ""
            raise ModelError(f"the drive train must be a square matrix, found shape {ratio.shape}{remedy}")
        condition = float(np.linalg.cond(ratio))
        if not np.isfinite(condition) or condition > 1e8:
            raise ModelError(f"the drive train is not invertible (condition {condition:.3g}): {ratio.tolist()}")

    @property
    def joints(self) -> tuple[int, ...]:
        """The joint that each motor belongs to: its own, or that of its largest ratio where it does not drive that."""
        return tuple(i if row[i] != 0.0 else int(np.argmax(np.abs(row))) for i, row in enumerate(self.ratio))

    @property
    def reduction(self) -> FloatArray:
        """N of each motor, shape (n,): its ratio to the joint that it belongs to."""
        return np.asarray(self.ratio[np.arange(len(self.ratio)), list(self.joints)], dtype=np.float64)

    @property
    def direction(self) -> FloatArray:
        """Rows r_i = R_i / N_i, shape (n, n): τ_joint = Σ_i r_iᵀ g_i v_i with the joint drive gains g_i."""
        return self.ratio / self.reduction[:, None]

    @property
    def to_motor(self) -> FloatArray:
        """T with g_i v_i = (T τ_joint)_i, the inverse of the transposed directions, shape (n, n)."""
        return np.asarray(np.linalg.inv(self.direction.T), dtype=np.float64)

    @property
    def coupled(self) -> tuple[int, ...]:
        """Motors that turn with more than one joint: their rotor inertia and friction need columns of their own."""
        return tuple(i for i, row in enumerate(self.ratio) if np.count_nonzero(row) > 1)


@dataclass(frozen=True, slots=True)
class Column:
    """One parameter, with the values that physics allows it: a spring may have either sign, a compliance not."""

    name: str
    unit: str
    least: float = -np.inf
    largest: float = np.inf

    def at(self, kind: JointKind) -> Column:
        """The same at a joint: Nm and rad of a revolute one are N and m of a prismatic one."""
        if kind is JointKind.REVOLUTE:
            return self
        return replace(self, unit=self.unit.replace("Nm", "N").replace("rad", "m"))


@dataclass(frozen=True, slots=True)
class Model:
    """A robot and its drive train, with the standard parameters χ_st in the paper's order.

    A joint has fourteen: ten of its link (LINK_PARAMETERS), then Ia, fv, fs, off. A motor that turns with several
    joints adds three (eq. 25): Iam, fvm, fsm. Its rotor inertia and viscous friction act on the joints through
    r rᵀ; the diagonal of that is already in Ia and fv, so Iam and fvm carry the off-diagonal part, as in the paper.
    """

    robot: Robot
    drive_train: DriveTrain

    def __post_init__(self) -> None:
        require_kind("robot", self.robot, Robot, "read it from a URDF: robot_from_urdf(urdf_text)")
        require_kind("drive_train", self.drive_train, DriveTrain, "write DriveTrain(np.diag(gear_ratios))")
        motors, joints = len(self.drive_train.ratio), self.robot.joint_count
        if motors != joints:
            raise ModelError(
                f"the drive train has shape {self.drive_train.ratio.shape}, expected {(joints, joints)}: the robot has "
                f"{joints} joints; give one motor for each"
            )

    @property
    def columns(self) -> tuple[Column, ...]:
        """Names and units of the standard parameters."""
        columns: list[Column] = []
        for number, joint in enumerate(self.robot.joints, start=1):
            force, rate, inertia = DRIVE_UNITS[joint.kind]
            link = zip(LINK_PARAMETERS, LINK_UNITS, strict=True)
            drive = ("Ia", inertia), ("fv", f"{force}/({rate})"), ("fs", force), ("off", force)
            columns += [Column(f"{name}{number}", unit) for name, unit in (*link, *drive)]
        for motor in self.drive_train.coupled:
            force, rate, inertia = DRIVE_UNITS[self.robot.joints[self.drive_train.joints[motor]].kind]
            coupling = ("Iam", inertia), ("fvm", f"{force}/({rate})"), ("fsm", force)
            columns += [Column(f"{name}{motor + 1}", unit) for name, unit in coupling]
        return tuple(columns)

    @property
    def flange(self) -> slice:
        """The ten columns of the last link; a payload on it has the same."""
        first = JOINT_COLUMNS * (self.robot.joint_count - 1)
        return slice(first, first + 10)

    @property
    def support(self) -> BoolArray:
        """Which standard parameters can load which joint, shape (n, c); all other entries of the regressor are zero."""
        count = self.robot.joint_count
        out = np.zeros((count, len(self.columns)), dtype=np.bool_)
        for link in range(count):
            first = JOINT_COLUMNS * link
            out[link, first + 10 : first + JOINT_COLUMNS] = True
            joint = link
            while joint >= 0:  # a link loads its own joint and those before it
                out[joint, first : first + 10] = True
                joint = self.robot.joints[joint].parent
        for index, motor in enumerate(self.drive_train.coupled):
            first = JOINT_COLUMNS * count + 3 * index
            out[:, first : first + 3] = (self.drive_train.direction[motor] != 0.0)[:, None]
        return out

    def regressor(self, motion: Motion) -> FloatArray:
        """Joint torque per unit of every standard parameter.

        Returns:
            shape (n, c, k) [Nm or N per unit], time last.

        Raises:
            ModelError: the motion is not one of n joints.
        """
        position, velocity, acceleration = self._joint_first(motion)
        count, samples = position.shape
        sign = np.sign(velocity)
        out = np.zeros((count, len(self.columns), samples))
        by_link = out[:, : JOINT_COLUMNS * count].reshape(count, count, JOINT_COLUMNS, samples)
        fill_rigid(self.robot, position, velocity, acceleration, by_link[:, :, :10])
        for joint in range(count):
            own = by_link[joint, joint]
            own[10], own[11], own[12], own[13] = acceleration[joint], velocity[joint], sign[joint], 1.0
        direction = self.drive_train.direction
        motor_speed = direction @ velocity
        for index, motor in enumerate(self.drive_train.coupled):
            first = JOINT_COLUMNS * count + 3 * index
            r = direction[motor]
            cross = np.outer(r, r) - np.diag(r**2)
            out[:, first] = cross @ acceleration
            out[:, first + 1] = cross @ velocity
            out[:, first + 2] = r[:, None] * np.sign(motor_speed[motor])
        return out

    def torques(self, motion: Motion, standard: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Joint torque of links and payload, the same with friction of the joints, and all [Nm or N], each (n, k).

        Args:
            motion: of n joints over k samples.
            standard: χ_st, shape (c,).
        """
        position, velocity, acceleration = self._joint_first(motion)
        own, motors = np.split(standard, [JOINT_COLUMNS * self.robot.joint_count])
        own, motors = own.reshape(-1, JOINT_COLUMNS), motors.reshape(-1, 3, 1)
        load = rigid_torque(self.robot, position, velocity, acceleration, own[:, :10])
        geared = load + own[:, 11, None] * velocity + own[:, 12, None] * np.sign(velocity)
        whole = geared + own[:, 10, None] * acceleration + own[:, 13, None]
        for motor, (inertia, viscous, dry) in zip(self.drive_train.coupled, motors, strict=True):
            r = self.drive_train.direction[motor]
            cross = np.outer(r, r) - np.diag(r**2)
            whole += cross @ (inertia * acceleration + viscous * velocity) + r[:, None] * dry * np.sign(r @ velocity)
        return load, geared, whole

    def _joint_first(self, motion: Motion) -> list[FloatArray]:
        states = motion.position_rad, motion.velocity_rad_s, motion.acceleration_rad_s2
        count, shapes = self.robot.joint_count, [np.shape(state) for state in states]
        if shapes != [(*shapes[0][:1], count)] * 3:
            raise ModelError(
                f"position, velocity and acceleration have the shapes {', '.join(map(str, shapes))}; expected "
                f"(n_samples, {count}) each: a row a sample, a column a joint"
            )
        return [np.ascontiguousarray(np.transpose(state)) for state in states]
