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

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from hashlib import blake2b
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ident.arrays import BoolArray, FloatArray, IntArray, as_array, require_flag, require_kind
from ident.errors import ModelError
from ident.model.bodies import LINK_PARAMETERS, LINK_UNITS, LOADED
from ident.model.closed_chain import Assembly, TreeMotion, assemble, follow
from ident.model.pivots import pivot_motion, pivot_rates
from ident.model.regressor import fill_rigid, mass_matrix, rigid_torque
from ident.model.robot import JointKind, Motion, Robot, at_rest, joints_to_base, require_described

DRIVE_UNITS = {
    JointKind.REVOLUTE: ("Nm", "rad/s", "kg m²"),
    JointKind.PRISMATIC: ("N", "m/s", "kg"),
}
"""Units of torque or force along a joint, of its speed, and of a rotor's inertia seen there."""
REMEMBERED_BYTES = 2**28
"""Largest size of the motions of closed chains that a model stores:
a fit needs those of the same few runs again.
"""
LARGEST_CONDITION = 1e8  #: Of a drive train that is invertible
#: Standard parameters of a joint: ten of its link (LINK_PARAMETERS), then Ia, fv, fs, off
JOINT_COLUMNS = 14
#: Ia, fv, fs, off among them
ROTOR_INERTIA, VISCOUS_FRICTION, DRY_FRICTION, OFFSET = range(10, JOINT_COLUMNS)
COUPLED_COLUMNS = 3  #: Parameters of a motor that turns with several joints: Iam, fvm, fsm


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
        is_square = ratio.ndim == 2 and ratio.shape[0] == ratio.shape[1] > 0
        if not is_square:
            remedy = ""
            if ratio.ndim == 1:
                remedy = "; write np.diag(gear_ratios)"
            raise ModelError(
                f"the drive train must be a square matrix, found shape {ratio.shape}{remedy}"
            )
        condition = float(np.linalg.cond(ratio))
        if not condition <= LARGEST_CONDITION:
            raise ModelError(
                f"the drive train is not invertible (condition {condition:.3g}): {ratio.tolist()}"
            )

    @property
    def joints(self) -> tuple[int, ...]:
        """The joint that each motor belongs to:
        its own, or that of its largest ratio where it does not drive that.
        """
        joints: list[int] = []
        for motor, row in enumerate(self.ratio):
            joint = motor
            if row[motor] == 0.0:
                joint = int(np.argmax(np.abs(row)))
            joints.append(joint)
        return tuple(joints)

    @property
    def reduction(self) -> FloatArray:
        """N of each motor, shape (n,): its ratio to the joint that it belongs to."""
        motors = np.arange(len(self.ratio))
        joints = list(self.joints)
        return np.asarray(self.ratio[motors, joints], dtype=np.float64)

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
        inverse = np.linalg.inv(self.direction.T)
        return np.asarray(inverse, dtype=np.float64)

    @property
    def coupled(self) -> tuple[int, ...]:
        """Motors that turn with more than one joint:
        their rotor inertia and friction need further columns.
        """
        joint_counts = np.count_nonzero(self.ratio, axis=1)
        motors = np.flatnonzero(joint_counts > 1)
        return tuple(motors.tolist())


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
        unit = self.unit.replace("Nm", "N")
        unit = unit.replace("rad", "m")
        return replace(self, unit=unit)


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
        require_flag("friction_by_payload", self.friction_by_payload)
        require_described(self.robot)
        ratio = self.drive_train.ratio
        axes = self.robot.axis_count
        if len(ratio) != axes:
            raise ModelError(
                f"the drive train has shape {ratio.shape}, expected {(axes, axes)}: the robot has "
                f"{axes} driven joints; give one motor for each"
            )
        object.__setattr__(self, "assembly", assemble(self.robot))
        off_diagonal = ratio - np.diag(np.diag(ratio))
        if self.is_redundant and off_diagonal.any():
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
            for name, unit in zip(LINK_PARAMETERS, LINK_UNITS, strict=True):
                columns.append(Column(f"{name}{number}", unit))
            columns.append(Column(f"Ia{number}", inertia))
            columns.append(Column(f"fv{number}", f"{force}/({rate})"))
            columns.append(Column(f"fs{number}", force))
            columns.append(Column(f"off{number}", force))
        joint_of_motor = self.drive_train.joints
        for motor in self.drive_train.coupled:
            joint = self.robot.axes[joint_of_motor[motor]]
            force, rate, inertia = DRIVE_UNITS[joint.kind]
            number = motor + 1
            columns.append(Column(f"Iam{number}", inertia))
            columns.append(Column(f"fvm{number}", f"{force}/({rate})"))
            columns.append(Column(f"fsm{number}", force))
        if self.friction_by_payload:
            for index in self.friction_columns.tolist():
                column = columns[index]
                columns.append(replace(column, name=f"{column.name}{LOADED}"))
        return tuple(columns)

    @property
    def link_columns(self) -> IntArray:
        """Columns of the links' parameters among the standard ones, shape (n, 10)."""
        joints = np.arange(self.robot.joint_count)
        first = JOINT_COLUMNS * joints
        return first[:, None] + np.arange(len(LINK_PARAMETERS))

    @property
    def _axis_columns(self) -> IntArray:
        """First column of the joint of each axis among the standard ones, shape (m,)."""
        return JOINT_COLUMNS * np.array(self.robot.axis_joints)

    @property
    def viscous_friction_columns(self) -> IntArray:
        """Column of fv of each axis among the standard ones, shape (m,)."""
        return self._axis_columns + VISCOUS_FRICTION

    @property
    def dry_friction_columns(self) -> IntArray:
        """Column of fs of each axis among the standard ones, shape (m,)."""
        return self._axis_columns + DRY_FRICTION

    @property
    def rotor_columns(self) -> IntArray:
        """Column of Ia of each axis among the standard ones, shape (m,)."""
        return self._axis_columns + ROTOR_INERTIA

    @property
    def coupled_columns(self) -> IntArray:
        """First column of each motor that turns with several joints, shape (coupled,):
        Iam, then fvm and fsm.
        """
        first = JOINT_COLUMNS * self.robot.joint_count
        count = len(self.drive_train.coupled)
        return first + COUPLED_COLUMNS * np.arange(count)

    def _each_coupled(self) -> Iterable[tuple[int, int]]:
        """Each motor that turns with several joints, and its first column."""
        return zip(self.drive_train.coupled, self.coupled_columns.tolist(), strict=True)

    @property
    def coupled_dry_friction_columns(self) -> IntArray:
        """Column of fsm of each motor that turns with several joints, shape (coupled,)."""
        return self.coupled_columns + 2

    @property
    def friction_columns(self) -> IntArray:
        """Columns of fv and fs of each axis, and of fvm and fsm of each motor that turns with
        several joints.
        """
        of_axes = self._axis_columns[:, None] + np.array([VISCOUS_FRICTION, DRY_FRICTION])
        of_coupled = self.coupled_columns[:, None] + np.array([1, 2])
        return np.concatenate((of_axes.ravel(), of_coupled.ravel()))

    @property
    def loaded_friction_columns(self) -> IntArray:
        """Columns of what a payload adds to the friction parameters,
        in the order of `friction_columns`; or empty.
        """
        coupled = len(self.drive_train.coupled)
        declared = JOINT_COLUMNS * self.robot.joint_count + COUPLED_COLUMNS * coupled
        count = 0
        if self.friction_by_payload:
            count = len(self.friction_columns)
        return declared + np.arange(count)

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
        out = np.zeros((self.robot.axis_count, len(self.columns)), dtype=np.bool_)
        for axis, first in enumerate(self._axis_columns.tolist()):
            drive = slice(first + ROTOR_INERTIA, first + JOINT_COLUMNS)
            if self.is_redundant:
                out[:, drive] = True
            out[axis, drive] = True
        for link in range(self.robot.joint_count):
            first = JOINT_COLUMNS * link
            own = slice(first, first + len(LINK_PARAMETERS))
            if self.robot.is_constrained:
                out[:, own] = True
                continue
            for joint in joints_to_base(self.robot, link):  # that the link loads
                out[joint, own] = True
        direction = self.drive_train.direction
        for motor, first in self._each_coupled():
            is_turned = direction[motor] != 0.0
            out[:, first : first + COUPLED_COLUMNS] = is_turned[:, None]
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
            position, velocity, acceleration = self._joint_first(motion)
            return self._tree_regressor(position, velocity, acceleration, loaded=loaded)
        columns, to_motors = self.balance(motion, loaded=loaded)
        if self.is_redundant:
            return spread(columns, to_motors)
        return columns

    def balance(self, motion: Motion, *, loaded: bool = False) -> tuple[FloatArray, FloatArray]:
        """Columns of the d equations of virtual power, Gᵀ W and Aᵀ, shapes (d, c, k) and (d, m, k).

        Arguments and errors are those of `regressor`.
        """
        followed = self.follow(motion)
        position, velocity, acceleration = self._first(followed.joints)
        columns = self._tree_regressor(position, velocity, acceleration, loaded=loaded)
        projected = np.zeros((self.assembly.mobility, *columns.shape[1:]))
        to_joints = np.ascontiguousarray(np.transpose(followed.to_joints, (1, 2, 0)))
        # Σ_n G_nd W_nc of each coordinate d: most links are moved by few joints
        for rates, own in zip(to_joints, columns, strict=True):
            nonzero = np.flatnonzero(own.any(axis=1))
            for equation, rate in zip(projected, rates, strict=True):
                if rate.any():
                    equation[nonzero] += rate * own[nonzero]
        to_motors = np.transpose(followed.to_motors, (2, 1, 0))
        return projected, np.ascontiguousarray(to_motors)

    def follow(self, motion: Motion) -> TreeMotion:
        """Motion of all joints from that of the axes; see `ident.model.closed_chain.follow`.

        In a closed chain its arrays are read-only, because the last few motions are stored.

        Raises:
            ModelError: the motion is not one of m axes, or the loops cannot be closed.
        """
        states = self._joint_first(motion)
        if not self.robot.is_constrained:
            return follow(self.robot, self.assembly, motion)
        content = b"".join(state.tobytes() for state in states)
        digest = blake2b(content).digest()
        stored = dict(self._followed)
        found = stored.pop(digest, None)
        if found is None:
            found = follow(self.robot, self.assembly, motion)
            for array in _arrays(found):
                array.flags.writeable = False
        # Replaced at once: of two threads, one may lose what the other has added, but neither finds
        # half of it.
        newest = _newest([(digest, found), *stored.items()])
        object.__setattr__(self, "_followed", newest)
        return found

    def _tree_regressor(
        self, position: FloatArray, velocity: FloatArray, acceleration: FloatArray, *, loaded: bool
    ) -> FloatArray:
        """Torque at each joint of the tree per unit of every parameter, shape (n, c, k)."""
        count, samples = position.shape
        sign = np.sign(velocity)
        out = np.zeros((count, len(self.columns), samples))
        of_joints = out[:, : JOINT_COLUMNS * count]
        by_link = of_joints.reshape(count, count, JOINT_COLUMNS, samples)
        fill_rigid(
            self.robot, position, velocity, acceleration, by_link[:, :, : len(LINK_PARAMETERS)]
        )
        axes = list(self.robot.axis_joints)
        for joint in axes:
            own = by_link[joint, joint]
            own[ROTOR_INERTIA] = acceleration[joint]
            own[VISCOUS_FRICTION] = velocity[joint]
            own[DRY_FRICTION] = sign[joint]
            own[OFFSET] = 1.0
        direction = self.drive_train.direction
        motor_speed = direction @ velocity[axes]
        for motor, first in self._each_coupled():
            r = direction[motor]
            cross = _off_diagonal(r)
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
        loaded = standard.copy()
        loaded[self.flange] += body
        if self.friction_by_payload:
            loaded[self.friction_columns] += standard[self.loaded_friction_columns]
        return loaded

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
        links = standard[self.link_columns]
        followed = None
        if self.robot.is_constrained:
            followed = self.follow(motion)
            joints = self._first(followed.joints)
            tree_load = rigid_torque(self.robot, joints[0], joints[1], joints[2], links)
            load = self.at_axes(followed, tree_load)
        else:
            load = rigid_torque(self.robot, position, velocity, acceleration, links)
        viscous = standard[self.viscous_friction_columns, None]
        dry = standard[self.dry_friction_columns, None]
        rotor = standard[self.rotor_columns, None]
        offset = standard[self._axis_columns + OFFSET, None]
        geared = dry * np.sign(velocity)
        geared += viscous * velocity
        geared += load
        total = rotor * acceleration
        total += geared
        total += offset
        direction = self.drive_train.direction
        for motor, first in self._each_coupled():
            inertia, viscous, dry = standard[first : first + COUPLED_COLUMNS]
            r = direction[motor]
            smooth = _off_diagonal(r) @ (inertia * acceleration + viscous * velocity)
            total += smooth + r[:, None] * dry * np.sign(r @ velocity)
        if followed is not None and self.is_redundant:
            load = without_preload(followed, load)
            geared = without_preload(followed, geared)
            total = without_preload(followed, total)
        return load, geared, total

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
            position = np.ascontiguousarray(position_rad.T)
            return mass_matrix(self.robot, position, links)
        followed = self.follow(at_rest(position_rad))
        position = np.ascontiguousarray(followed.joints.position_rad.T)
        tree = mass_matrix(self.robot, position, links)
        # M G A⁺ of the joints of the tree: torque per unit of acceleration of each axis
        per_coordinate = np.einsum("ijk,kjd->idk", tree, followed.to_joints)
        coordinates_per_axis = np.linalg.pinv(followed.to_motors)
        per_axis = np.einsum("idk,kda->iak", per_coordinate, coordinates_per_axis)
        return self.at_axes(followed, per_axis)

    def leverage(self, followed: TreeMotion) -> FloatArray:
        """Torque at each axis per unit of torque on each place without a motor (`Robot.places`),
        shape (u, m, k).
        """
        samples = len(followed.to_joints)
        undriven = list(self.robot.place_joints[self.robot.axis_count :])
        unit = np.eye(self.robot.joint_count)[:, undriven]
        of_joints = np.repeat(unit[:, :, None], samples, axis=2)
        rates = pivot_rates(self.robot, followed.joints.position_rad)
        of_pivots = np.transpose(rates, (2, 1, 0))
        torque = np.concatenate((of_joints, of_pivots), axis=1)
        of_axes = self.at_axes(followed, torque)
        return np.ascontiguousarray(np.swapaxes(of_axes, 0, 1))

    def at_places(self, followed: TreeMotion) -> Motion:
        """Motion of all places (`Robot.places`) from that of the joints, arrays of shape (k,
        places).
        """
        joints = list(self.robot.place_joints)
        tree = followed.joints
        pivots = pivot_motion(self.robot, self.assembly, tree)

        def with_pivots(of_joints: FloatArray, of_pivots: FloatArray) -> FloatArray:
            return np.concatenate((of_joints[:, joints], of_pivots), axis=1)

        return Motion(
            position_rad=with_pivots(tree.position_rad, pivots.position_rad),
            velocity_rad_s=with_pivots(tree.velocity_rad_s, pivots.velocity_rad_s),
            acceleration_rad_s2=with_pivots(tree.acceleration_rad_s2, pivots.acceleration_rad_s2),
        )

    def at_axes(self, followed: TreeMotion, torque: FloatArray) -> FloatArray:
        """Torques of all joints as torques of the axes, B Gᵀ τ [Nm or N], shapes (n, …, k) and (m,
        …, k).
        """
        # Gᵀ τ: Σ_n G_knd τ_nk of each coordinate d and sample k
        projected = np.einsum("knd,n...k->d...k", followed.to_joints, torque)
        if not self.is_redundant:
            return np.asarray(projected)
        to_motors = np.transpose(followed.to_motors, (2, 1, 0))
        return spread(projected, to_motors)

    def _joint_first(self, motion: Motion) -> list[FloatArray]:
        """Positions, velocities and accelerations of the axes, shape (m, k) each,
        once their shapes are checked.
        """
        require_kind("motion", motion, Motion, "write Motion(position_rad, velocity_rad_s, ...)")
        count = self.robot.axis_count
        shapes = [np.shape(state) for state in _states(motion)]
        expected = (*shapes[0][:1], count)
        if shapes != [expected] * 3:
            found = ", ".join(map(str, shapes))
            raise ModelError(
                f"position, velocity and acceleration have the shapes {found}; expected "
                f"(n_samples, {count}) each: a row a sample, a column a joint"
            )
        return self._first(motion)

    @staticmethod
    def _first(motion: Motion) -> list[FloatArray]:
        """Positions, velocities and accelerations, joint first."""
        return [np.ascontiguousarray(np.transpose(state)) for state in _states(motion)]


def _states(motion: Motion) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Positions, velocities and accelerations."""
    return motion.position_rad, motion.velocity_rad_s, motion.acceleration_rad_s2


def _arrays(followed: TreeMotion) -> tuple[FloatArray, ...]:
    """All arrays of a motion."""
    states = _states(followed.joints)
    return *states, followed.to_joints, followed.to_motors, followed.condition


def _newest(motions: Sequence[tuple[bytes, TreeMotion]]) -> tuple[tuple[bytes, TreeMotion], ...]:
    """The first motions, as many as REMEMBERED_BYTES allow."""
    newest: list[tuple[bytes, TreeMotion]] = []
    size = 0
    for digest, followed in motions:
        size += sum(array.nbytes for array in _arrays(followed))
        if size > REMEMBERED_BYTES:
            break
        newest.append((digest, followed))
    return tuple(newest)


def _off_diagonal(direction: FloatArray) -> FloatArray:
    """r rᵀ without its diagonal, shape (m, m):
    how a motor's rotor couples the joints that it turns with.
    """
    return np.outer(direction, direction) - np.diag(direction**2)


def spread(columns: FloatArray, to_motors: FloatArray) -> FloatArray:
    """The least torques of the axes that satisfy the d equations with the given columns, B y.

    Args:
        columns: y, shape (d, …, k).
        to_motors: Aᵀ, shape (d, m, k).

    Returns:
        shape (m, …, k).
    """
    a = np.transpose(to_motors, (2, 1, 0))
    gram = np.swapaxes(a, 1, 2) @ a
    b = a @ np.linalg.inv(gram)  # B = A (AᵀA)⁻¹
    # Σ_d B_kmd y_dk of each axis m and sample k
    torque = np.einsum("kmd,d...k->m...k", b, columns, optimize=True)
    return np.asarray(torque)


def preload_directions(to_motors: FloatArray) -> FloatArray:
    """N, torques of the axes that move nothing: an orthonormal basis of the null space of Aᵀ.

    Args:
        to_motors: Aᵀ, shape (d, m, k).

    Returns:
        shape (k, m, m − d).
    """
    a = np.transpose(to_motors, (2, 1, 0))
    directions, _ = np.linalg.qr(a, mode="complete")
    mobility = len(to_motors)
    return np.asarray(directions[:, :, mobility:])


def without_preload(followed: TreeMotion, torque: FloatArray) -> FloatArray:
    """Take internal preload out of torques of the axes [Nm or N], B Aᵀ τ, shape (m, k)."""
    to_motors = np.transpose(followed.to_motors, (2, 1, 0))
    equations = np.einsum("dmk,mk->dk", to_motors, torque)  # Aᵀ τ
    return spread(equations, to_motors)
