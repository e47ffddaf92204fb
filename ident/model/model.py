"""The declared model: rigid links, rotors, friction and offsets, each a column (paper eqs.
1 and 25).

The torques τ of the m axes need d equations of virtual power, Aᵀ τ = Gᵀ W χ, with W of the tree of
all joints and G, A of `ident.model.closed_chain`. A serial robot has G = A = I. With as many motors
as degrees of freedom A is the identity too, and each axis has an equation of its own. With more
motors than that, the part of τ in the null space of Aᵀ, the internal preload, moves nothing and is
in no equation: the columns are then those of the least τ without it,

    τ = B Gᵀ W χ,    B = A (AᵀA)⁻¹,    Aᵀ B = I.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from hashlib import blake2b
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ident.arrays import BoolArray, FloatArray, IntArray, as_array, require_kind
from ident.errors import ModelError
from ident.model.bodies import LINK_PARAMETERS, LINK_UNITS, LOADED
from ident.model.closed_chain import Assembly, TreeMotion, assemble, follow
from ident.model.pivots import pivot_motion, pivot_rates
from ident.model.regressor import fill_rigid, mass_matrix, rigid_torque
from ident.model.robot import JointKind, Motion, Robot

DRIVE_UNITS = {
    JointKind.REVOLUTE: ("Nm", "rad/s", "kg m²"),
    JointKind.PRISMATIC: ("N", "m/s", "kg"),
}
"""Units of torque or force along a joint, of its speed, and of a rotor's inertia seen there."""
REMEMBERED_BYTES = 2**28
"""Largest size of the motions of closed chains that a model keeps:
a fit asks for those of the same few runs again.
"""
#: Standard parameters of a joint: ten of its link (LINK_PARAMETERS), then Ia, fv, fs, off
JOINT_COLUMNS = 14


@dataclass(frozen=True, slots=True)
class DriveTrain:
    """Gears between motors and joints: q_motor = R q_joint and τ_joint = Rᵀ τ_motor (paper eq.
    24).
    """

    #: R, shape (n, n), invertible; row i belongs to motor i. Nested lists will do
    ratio: FloatArray

    if TYPE_CHECKING:  # whatever becomes an array

        def __init__(self, ratio: ArrayLike) -> None: ...

    def __post_init__(self) -> None:
        ratio = as_array("the drive train", self.ratio)
        object.__setattr__(self, "ratio", ratio)
        if ratio.ndim != 2 or ratio.shape[0] != ratio.shape[1]:
            if ratio.ndim == 1:
                remedy = "; write np.diag(gear_ratios)"
            else:
                remedy = ""
            raise ModelError(
                f"the drive train must be a square matrix, found shape {ratio.shape}{remedy}"
            )
        condition = float(np.linalg.cond(ratio))
        if not np.isfinite(condition) or condition > 1e8:
            raise ModelError(
                f"the drive train is not invertible (condition {condition:.3g}): {ratio.tolist()}"
            )

    @property
    def joints(self) -> tuple[int, ...]:
        """The joint that each motor belongs to:
        its own, or that of its largest ratio where it does not drive that.
        """
        return tuple(
            i if row[i] != 0.0 else int(np.argmax(np.abs(row))) for i, row in enumerate(self.ratio)
        )

    @property
    def reduction(self) -> FloatArray:
        """N of each motor, shape (n,): its ratio to the joint that it belongs to."""
        return np.asarray(
            self.ratio[np.arange(len(self.ratio)), list(self.joints)], dtype=np.float64
        )

    @property
    def direction(self) -> FloatArray:
        """Rows r_i = R_i / N_i, shape (n, n):
        τ_joint = Σ_i r_iᵀ g_i v_i with the joint drive gains g_i.
        """
        return self.ratio / self.reduction[:, None]

    @property
    def to_motor(self) -> FloatArray:
        """T with g_i v_i = (T τ_joint)_i, the inverse of the transposed directions, shape (n,
        n).
        """
        return np.asarray(np.linalg.inv(self.direction.T), dtype=np.float64)

    @property
    def coupled(self) -> tuple[int, ...]:
        """Motors that turn with more than one joint:
        their rotor inertia and friction need columns of their own.
        """
        return tuple(i for i, row in enumerate(self.ratio) if np.count_nonzero(row) > 1)


@dataclass(frozen=True, slots=True)
class Column:
    """One parameter, with the values that physics allows it:
    a spring may have either sign, a compliance not.
    """

    name: str  #: of the parameter
    unit: str  #: of its value
    least: float = -np.inf  #: smallest value that physics allows
    largest: float = np.inf  #: largest value that physics allows
    #: Value that its column was linearised about: a fit finds the difference from it
    #: (`ident.effects.geometry_corrections`).
    about: float = 0.0

    def at(self, kind: JointKind) -> Column:
        """The same at a joint: Nm and rad of a revolute one are N and m of a prismatic one."""
        if kind is JointKind.REVOLUTE:
            return self
        return replace(self, unit=self.unit.replace("Nm", "N").replace("rad", "m"))


@dataclass(frozen=True, slots=True)
class Model:
    """A robot and its drive train, with the standard parameters χ_st in the paper's order.

    A joint has fourteen: ten of its link (LINK_PARAMETERS), then Ia, fv, fs, off; of a joint
    without a motor the last four are zero columns. A motor that turns with several joints adds
    three (eq. 25): Iam, fvm, fsm. Its rotor inertia and viscous friction act on the joints through
    r rᵀ; the diagonal of that is already in Ia and fv, so Iam and fvm carry the off-diagonal part,
    as in the paper.

    Friction is not the same in all runs: it falls while the arm warms up, and changes with the
    torque on the gears. Where the runs without load come first, the change looks like other gains.
    With `friction_by_payload`, each friction parameter has one more at the end, NAME_loaded: what
    is added to it while a payload is mounted. The paper has none.
    """

    robot: Robot
    drive_train: DriveTrain  #: between motors and the joints of the axes
    #: whether friction with a payload is another one than without
    friction_by_payload: bool = False
    #: which joints are free, and how the loops close
    assembly: Assembly = field(init=False, compare=False, repr=False)
    #: Followed motions by the digest of what was asked, the last one first.
    _followed: tuple[tuple[bytes, TreeMotion], ...] = field(
        default=(), init=False, compare=False, repr=False
    )

    def __post_init__(self) -> None:
        require_kind("robot", self.robot, Robot, "read it from a URDF: robot_from_urdf(urdf_text)")
        require_kind(
            "drive_train", self.drive_train, DriveTrain, "write DriveTrain(np.diag(gear_ratios))"
        )
        motors = len(self.drive_train.ratio)
        axes = self.robot.axis_count
        if motors != axes:
            raise ModelError(
                f"the drive train has shape {self.drive_train.ratio.shape}, expected "
                f"{(axes, axes)}: the robot has {axes} driven joints; give one motor for each"
            )
        object.__setattr__(self, "assembly", assemble(self.robot))
        ratio = self.drive_train.ratio
        if self.is_redundant and np.count_nonzero(ratio - np.diag(np.diag(ratio))):
            raise ModelError(
                "the robot has more motors than degrees of freedom, and motors that turn with the "
                "joint of another; expected a diagonal drive train there"
            )

    @property
    def is_redundant(self) -> bool:
        """Whether there are more motors than degrees of freedom,
        so that they can work against each other.
        """
        return self.robot.axis_count > self.assembly.mobility

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
            force, rate, inertia = DRIVE_UNITS[self.robot.axes[self.drive_train.joints[motor]].kind]
            coupling = ("Iam", inertia), ("fvm", f"{force}/({rate})"), ("fsm", force)
            columns += [Column(f"{name}{motor + 1}", unit) for name, unit in coupling]
        if self.friction_by_payload:
            friction = [columns[place] for place in self.friction_columns]
            columns += [replace(column, name=f"{column.name}{LOADED}") for column in friction]
        return tuple(columns)

    @property
    def link_columns(self) -> IntArray:
        """Columns of the links' parameters among the standard ones, shape (n, 10)."""
        return JOINT_COLUMNS * np.arange(self.robot.joint_count)[:, None] + np.arange(
            len(LINK_PARAMETERS)
        )

    @property
    def viscous_friction_columns(self) -> IntArray:
        """Column of fv of each axis among the standard ones, shape (m,)."""
        return JOINT_COLUMNS * np.array(self.robot.axis_joints) + 11

    @property
    def dry_friction_columns(self) -> IntArray:
        """Column of fs of each axis among the standard ones, shape (m,)."""
        return JOINT_COLUMNS * np.array(self.robot.axis_joints) + 12

    @property
    def rotor_columns(self) -> IntArray:
        """Column of Ia of each axis among the standard ones, shape (m,)."""
        return JOINT_COLUMNS * np.array(self.robot.axis_joints) + len(LINK_PARAMETERS)

    @property
    def friction_columns(self) -> IntArray:
        """Columns of fv and fs of each axis, and of fvm and fsm of each motor that turns with
        several joints.
        """
        of_axes = JOINT_COLUMNS * np.array(self.robot.axis_joints)[:, None] + np.array([11, 12])
        first = JOINT_COLUMNS * self.robot.joint_count
        of_coupled = (
            first + 3 * np.arange(len(self.drive_train.coupled))[:, None] + np.array([1, 2])
        )
        return np.concatenate((of_axes.ravel(), of_coupled.ravel()))

    @property
    def loaded_friction_columns(self) -> IntArray:
        """Columns of what a payload adds to the friction parameters,
        in the order of `friction_columns`; or empty.
        """
        declared = JOINT_COLUMNS * self.robot.joint_count + 3 * len(self.drive_train.coupled)
        return declared + np.arange(len(self.friction_columns) if self.friction_by_payload else 0)

    @property
    def flange(self) -> slice:
        """The ten columns of the link that carries the payload; a payload on it has the same."""
        first = JOINT_COLUMNS * self.robot.carrier
        return slice(first, first + 10)

    @property
    def support(self) -> BoolArray:
        """Mask of the standard parameters that load each axis, shape (m, c);
        all else in the regressor is zero.
        """
        count = self.robot.joint_count
        axes = self.robot.axis_count
        out = np.zeros((axes, len(self.columns)), dtype=np.bool_)
        for axis, joint in enumerate(self.robot.axis_joints):
            first = JOINT_COLUMNS * joint
            out[:, first + 10 : first + JOINT_COLUMNS] |= self.is_redundant
            out[axis, first + 10 : first + JOINT_COLUMNS] = True
        for link in range(count):
            first = JOINT_COLUMNS * link
            joint = link
            # A link loads its own joint and those before it
            while joint >= 0 and not self.robot.is_constrained:
                out[joint, first : first + 10] = True
                joint = self.robot.joints[joint].parent
            if self.robot.is_constrained:
                out[:, first : first + 10] = True
        for index, motor in enumerate(self.drive_train.coupled):
            first = JOINT_COLUMNS * count + 3 * index
            out[:, first : first + 3] = (self.drive_train.direction[motor] != 0.0)[:, None]
        if self.friction_by_payload:
            out[:, self.loaded_friction_columns] = out[:, self.friction_columns]
        return out

    def regressor(self, motion: Motion, *, loaded: bool = False) -> FloatArray:
        """Torque at each axis per unit of every standard parameter, B Gᵀ W.

        Args:
            motion: of the m axes over k samples.
            loaded: whether a payload is mounted. Its inertia has the columns of the link that
                carries it.

        Returns:
            shape (m, c, k) [Nm or N per unit], time last.

        Raises:
            ModelError: the motion is not one of m axes, or the loops cannot be closed.
        """
        if not self.robot.is_constrained:
            return self._tree_regressor(*self._joint_first(motion), loaded=loaded)
        columns, to_motors = self.balance(motion, loaded=loaded)
        if self.is_redundant:
            return spread(columns, to_motors)
        return columns

    def balance(self, motion: Motion, *, loaded: bool = False) -> tuple[FloatArray, FloatArray]:
        """Columns of the d equations of virtual power, Gᵀ W and Aᵀ, shapes (d, c, k) and (d, m, k).

        Arguments and errors are those of `regressor`.
        """
        followed = self.follow(motion)
        columns = self._tree_regressor(*self._first(followed.joints), loaded=loaded)
        projected = np.zeros((self.assembly.mobility, *columns.shape[1:]))
        per_joint = np.ascontiguousarray(np.transpose(followed.to_joints, (1, 2, 0)))
        for joint, part in enumerate(columns):  # most links are moved by few joints
            held = np.flatnonzero(part.any(axis=1))
            for way, rate in zip(projected, per_joint[joint], strict=True):
                if rate.any():
                    way[held] += rate * part[held]
        return projected, np.ascontiguousarray(np.transpose(followed.to_motors, (2, 1, 0)))

    def follow(self, motion: Motion) -> TreeMotion:
        """Motion of all joints from that of the axes; see `ident.model.closed_chain.follow`.

        In a closed chain its arrays are read-only, because the last few motions are kept.

        Raises:
            ModelError: the motion is not one of m axes, or the loops cannot be closed.
        """
        states = self._joint_first(motion)
        if not self.robot.is_constrained:
            return follow(self.robot, self.assembly, motion)
        digest = blake2b(b"".join(state.tobytes() for state in states)).digest()
        # Replaced as a whole: of two threads, one may lose what the other has added, but neither
        # finds half of it.
        others = tuple(one for one in self._followed if one[0] != digest)
        found = next((followed for key, followed in self._followed if key == digest), None)
        if found is None:
            found = follow(self.robot, self.assembly, motion)
            for array in _arrays(found):
                array.flags.writeable = False
        kept = list[tuple[bytes, TreeMotion]]()
        size = 0
        for key, followed in ((digest, found), *others):
            size += sum(array.nbytes for array in _arrays(followed))
            if size > REMEMBERED_BYTES:
                break
            kept.append((key, followed))
        object.__setattr__(self, "_followed", tuple(kept))
        return found

    def _tree_regressor(
        self, position: FloatArray, velocity: FloatArray, acceleration: FloatArray, *, loaded: bool
    ) -> FloatArray:
        count, samples = position.shape
        sign = np.sign(velocity)
        out = np.zeros((count, len(self.columns), samples))
        by_link = out[:, : JOINT_COLUMNS * count].reshape(count, count, JOINT_COLUMNS, samples)
        fill_rigid(self.robot, position, velocity, acceleration, by_link[:, :, :10])
        axes = list(self.robot.axis_joints)
        for joint in axes:
            own = by_link[joint, joint]
            own[10], own[11], own[12], own[13] = (
                acceleration[joint],
                velocity[joint],
                sign[joint],
                1.0,
            )
        direction = self.drive_train.direction
        motor_speed = direction @ velocity[axes]
        for index, motor in enumerate(self.drive_train.coupled):
            first = JOINT_COLUMNS * count + 3 * index
            r = direction[motor]
            cross = np.outer(r, r) - np.diag(r**2)
            out[axes, first] = cross @ acceleration[axes]
            out[axes, first + 1] = cross @ velocity[axes]
            out[axes, first + 2] = r[:, None] * np.sign(motor_speed[motor])
        if loaded and self.friction_by_payload:
            out[:, self.loaded_friction_columns] = out[:, self.friction_columns]
        return out

    def with_payload(self, standard: FloatArray, body: FloatArray | None) -> FloatArray:
        """Standard parameters of the robot with what is mounted, shape (c,).

        Args:
            standard: χ_st without payload, shape (c,).
            body: the ten parameters of what is mounted, shape (10,); None without load.
        """
        if body is None:
            return standard
        whole = standard.copy()
        whole[self.flange] += body
        if self.friction_by_payload:
            whole[self.friction_columns] += standard[self.loaded_friction_columns]
        return whole

    def torques(
        self, motion: Motion, standard: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Torque of links and payload at each axis, the same with friction of the axes,
        and all [Nm or N], each (m, k).

        Those of a redundant drive are without preload.

        Args:
            motion: of m axes over k samples.
            standard: χ_st with what is mounted (`with_payload`), shape (c,).

        Raises:
            ModelError: the motion is not one of m axes, or the loops cannot be closed.
        """
        position, velocity, acceleration = self._joint_first(motion)
        of_joints = JOINT_COLUMNS * self.robot.joint_count
        links = standard[:of_joints].reshape(-1, JOINT_COLUMNS)
        motors = standard[of_joints : of_joints + 3 * len(self.drive_train.coupled)].reshape(
            -1, 3, 1
        )
        own = links[list(self.robot.axis_joints)]
        if self.robot.is_constrained:
            followed = self.follow(motion)
        else:
            followed = None
        if followed is None:
            load = rigid_torque(self.robot, position, velocity, acceleration, links[:, :10])
        else:
            joints = self._first(followed.joints)
            load = self.at_axes(
                followed, rigid_torque(self.robot, joints[0], joints[1], joints[2], links[:, :10])
            )
        geared = load + own[:, 11, None] * velocity + own[:, 12, None] * np.sign(velocity)
        whole = geared + own[:, 10, None] * acceleration + own[:, 13, None]
        for motor, (inertia, viscous, dry) in zip(self.drive_train.coupled, motors, strict=True):
            r = self.drive_train.direction[motor]
            cross = np.outer(r, r) - np.diag(r**2)
            whole += cross @ (inertia * acceleration + viscous * velocity) + r[
                :, None
            ] * dry * np.sign(r @ velocity)
        if followed is not None and self.is_redundant:
            return (
                without_preload(followed, load),
                without_preload(followed, geared),
                without_preload(followed, whole),
            )
        return load, geared, whole

    def inertia(self, position_rad: FloatArray, standard: FloatArray) -> FloatArray:
        """Mass matrix of links and payload: torque at axis i per unit of acceleration of axis j,
        shape (m, m, k).

        Args:
            position_rad: of the axes [rad or m], shape (k, m).
            standard: χ_st, shape (c,).

        Raises:
            ModelError: the loops cannot be closed.
        """
        links = standard[self.link_columns]
        if not self.robot.is_constrained:
            return mass_matrix(self.robot, np.ascontiguousarray(position_rad.T), links)
        still = np.zeros_like(position_rad)
        followed = self.follow(Motion(position_rad, still, still))
        tree = mass_matrix(self.robot, np.ascontiguousarray(followed.joints.position_rad.T), links)
        per_x = np.einsum("ijk,kjd->idk", tree, followed.to_joints)
        per_axis = np.linalg.pinv(followed.to_motors)
        return self.at_axes(followed, np.einsum("idk,kda->iak", per_x, per_axis))

    def leverage(self, followed: TreeMotion) -> FloatArray:
        """Torque at each axis per unit of torque on each place without a motor (`Robot.places`),
        shape (u, m, k).
        """
        unit = np.eye(self.robot.joint_count)[
            :, list(self.robot.place_joints[self.robot.axis_count :])
        ]
        torque = np.repeat(unit[:, :, None], len(followed.to_joints), axis=2)
        per_joint = pivot_rates(self.robot, followed.joints.position_rad)
        torque = np.concatenate((torque, np.transpose(per_joint, (2, 1, 0))), axis=1)
        return np.ascontiguousarray(np.swapaxes(self.at_axes(followed, torque), 0, 1))

    def at_places(self, followed: TreeMotion) -> Motion:
        """Motion of all places (`Robot.places`) from that of the joints, arrays of shape (k,
        places).
        """
        joints = list(self.robot.place_joints)
        tree = followed.joints
        pivots = pivot_motion(self.robot, self.assembly, tree)
        return Motion(
            np.concatenate((tree.position_rad[:, joints], pivots.position_rad), axis=1),
            np.concatenate((tree.velocity_rad_s[:, joints], pivots.velocity_rad_s), axis=1),
            np.concatenate(
                (tree.acceleration_rad_s2[:, joints], pivots.acceleration_rad_s2), axis=1
            ),
        )

    def at_axes(self, followed: TreeMotion, torque: FloatArray) -> FloatArray:
        """Torques of all joints as torques of the axes, B Gᵀ τ [Nm or N], shapes (n, …, k) and (m,
        …, k).
        """
        projected = np.einsum("knd,n...k->d...k", followed.to_joints, torque)
        if not self.is_redundant:
            return np.asarray(projected)
        return spread(projected, np.transpose(followed.to_motors, (2, 1, 0)))

    def _joint_first(self, motion: Motion) -> list[FloatArray]:
        states = motion.position_rad, motion.velocity_rad_s, motion.acceleration_rad_s2
        count = self.robot.axis_count
        shapes = [np.shape(state) for state in states]
        if shapes != [(*shapes[0][:1], count)] * 3:
            raise ModelError(
                "position, velocity and acceleration have the shapes "
                f"{', '.join(map(str, shapes))}; expected (n_samples, {count}) each: a row a "
                "sample, a column a joint"
            )
        return self._first(motion)

    @staticmethod
    def _first(motion: Motion) -> list[FloatArray]:
        states = motion.position_rad, motion.velocity_rad_s, motion.acceleration_rad_s2
        return [np.ascontiguousarray(np.transpose(state)) for state in states]


def _arrays(followed: TreeMotion) -> tuple[FloatArray, ...]:
    """All arrays of a motion."""
    states = (
        followed.joints.position_rad,
        followed.joints.velocity_rad_s,
        followed.joints.acceleration_rad_s2,
    )
    return *states, followed.to_joints, followed.to_motors, followed.condition


def spread(columns: FloatArray, to_motors: FloatArray) -> FloatArray:
    """The least torques of the axes that do what columns of the d equations ask, B y.

    Args:
        columns: y, shape (d, …, k).
        to_motors: Aᵀ, shape (d, m, k).

    Returns:
        shape (m, …, k).
    """
    a = np.transpose(to_motors, (2, 1, 0))
    back = a @ np.linalg.inv(np.swapaxes(a, 1, 2) @ a)
    return np.asarray(np.einsum("kmd,d...k->m...k", back, columns, optimize=True))


def preload_directions(to_motors: FloatArray) -> FloatArray:
    """N, torques of the axes that move nothing: an orthonormal basis of the null space of Aᵀ.

    Args:
        to_motors: Aᵀ, shape (d, m, k).

    Returns:
        shape (k, m, m − d).
    """
    whole, _ = np.linalg.qr(np.transpose(to_motors, (2, 1, 0)), mode="complete")
    return np.asarray(whole[:, :, len(to_motors) :])


def without_preload(followed: TreeMotion, torque: FloatArray) -> FloatArray:
    """Take internal preload out of torques of the axes [Nm or N], B Aᵀ τ, shape (m, k)."""
    to_motors = np.transpose(followed.to_motors, (2, 1, 0))
    return np.asarray(spread(np.einsum("dmk,mk->dk", to_motors, torque), to_motors))
