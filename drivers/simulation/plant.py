"""Mechanics of a simulated cell: links, motors with gears, dry friction, brakes, effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pinocchio as pin

from drivers.simulation.closures import OPEN, SINGULAR, Mechanism, link_frame, settle
from drivers.simulation.dynamics import (
    TOLERANCE_RAD_S,
    Mechanics,
    advance,
    advance_closed,
    turn_rotors,
)
from drivers.simulation.effects import (
    AMBIENT_C,
    Coupling,
    Effect,
    Elasticity,
    Lag,
    Moment,
    PivotFriction,
    build_effect,
)
from drivers.simulation.noise import ColouredNoise, random_streams
from drivers.simulation.spec import (
    AxisSpec,
    BoolArray,
    CellSpec,
    ClosureLost,
    FloatArray,
    FrictionUnsolved,
    IntArray,
    PassiveFriction,
    SpecInvalid,
)

POSTURES = 8  #: Postures in which the inertia behind a flexible drive is computed
BRAKE_FACTOR = 2.0  #: Holding torque of a brake over the peak torque of its motor

#: Kind of the random streams of the torque disturbance; those of the current noise have none
DISTURBANCE = 1


def _brake_nm(axis: AxisSpec) -> float:
    """Torque of the brake of an axis."""
    return BRAKE_FACTOR * abs(axis.gain_nm_per_a) * axis.peak_current_a


def _only_joint(direction: FloatArray) -> int:
    """Return the joint that a direction moves alone; -1 where it moves several."""
    joints = np.flatnonzero(direction)
    if len(joints) == 1:
        return int(joints[0])
    return -1


def lay_out(
    spec: CellSpec, effects: Sequence[Effect | Lag], joints: int
) -> tuple[Mechanics, tuple[Elasticity, ...]]:
    """Assign coordinates and directions, and set them in the effects that add some.

    Args:
        spec: of the cell.
        effects: undeclared ones.
        joints: number of joints, those of the motors first.

    Returns:
        the mechanics, and the drives between a motor and its joints in the order of their
        coordinates.

    Raises:
        SpecInvalid: the drive train is wrong, or two flexible drives are given for one motor.
    """
    n = len(spec.axes)
    rows = motor_rows(spec.ratio)
    step_s = spec.sync_period_us * 1e-6 / spec.substeps
    flexible = tuple(effect for effect in effects if isinstance(effect, Elasticity))
    if len({drive.axis for drive in flexible}) < len(flexible):
        raise SpecInvalid(
            "two flexible drives on one motor; give elasticity and gap in one backlash effect"
        )
    total = joints + len(flexible)
    motor_direction = np.hstack([rows, np.zeros((n, total - n))])
    for coordinate, drive in enumerate(flexible, start=joints):
        drive.coordinate = coordinate
        drive.row = rows[drive.axis]
        motor_direction[drive.axis] = np.eye(total)[coordinate]
    directions = list(np.eye(joints, total))
    own_row = np.zeros(n, dtype=np.int64)
    for motor, row in enumerate(motor_direction):
        moved = np.flatnonzero(row)
        if len(moved) == 1 and moved[0] < joints:
            # A motor that turns with one joint alone shares that joint's direction; r_i is 1 there
            # by its making.
            own_row[motor] = moved[0]
        else:
            own_row[motor] = len(directions)
            directions.append(row)
    for effect in effects:
        if isinstance(effect, Coupling):
            effect.direction = len(directions)
            shared = np.zeros(total)
            shared[[effect.axis, effect.other]] = 1.0
            directions.append(shared)
        if isinstance(effect, PivotFriction):
            effect.direction = len(directions)
            effect.row = np.concatenate((effect.row, np.zeros(total - joints)))
            directions.append(effect.row)
    lone = [_only_joint(row) for row in directions]
    rotor_direction = motor_direction * reduction(spec.ratio)[:, None]
    motor_inertia = np.array([axis.motor_inertia_kg_m2 for axis in spec.axes])
    motor_viscous = np.array([axis.motor_viscous_nm_s_rad for axis in spec.axes])
    mechanics = Mechanics(
        motor_direction=motor_direction,
        rotor_direction=rotor_direction,
        motor_inertia=motor_inertia,
        motor_viscous=motor_viscous,
        directions=np.array(directions),
        own_row=own_row,
        lone=np.array(lone, dtype=np.int64),
        step_s=step_s,
    )
    return mechanics, flexible


def reduction(ratio: FloatArray) -> FloatArray:
    """Return the reduction N of each motor, shape (n,): that of its own joint, or else its largest.

    Raises:
        SpecInvalid: the matrix is not invertible.
    """
    if np.linalg.matrix_rank(ratio) < len(ratio):
        raise SpecInvalid(f"the drive train must be invertible, found {ratio.tolist()}")
    own = np.diag(ratio)
    largest = ratio[np.arange(len(own)), np.argmax(np.abs(ratio), axis=1)]
    return np.where(own != 0.0, own, largest)


def motor_rows(ratio: FloatArray) -> FloatArray:
    """Return r_i = R_i / N_i, shape (n, n): a motor's torque in joint units acts on the joints
    along r_i (eq. 24).
    """
    return np.asarray(ratio / reduction(ratio)[:, None], dtype=np.float64)


class Plant:
    """Robot of n joints, revolute or prismatic, driven by the currents of m motors.

    A serial robot has as many motors as joints. The joints of a closed chain are in the order of
    its `Mechanism`: those of the motors first, then the passive ones. The coordinates are the
    joints, then each motor behind a flexible drive. Motor torques are in joint units (τ_joint = Σ
    r_i g_i i_i). At power-on the robot is at rest with closed brakes.

    Attributes:
        mechanism: the closed chain, or None for a serial robot.
        position_rad, velocity_rad_s: of the coordinates, shape (N,).
        load_torque_nm: torque of the links on the joints in the last step, shape (n,).
        motor_rad: angle of each rotor [rad], shape (m,); zero at joint position zero.
        temperature_c: temperature of each motor [°C], shape (m,); AMBIENT_C without an effect that
            warms it.
        disturbance_nm: random torque on each motor in the last step, in joint units, shape (m,).
        time_s: since power-on.
    """

    def __init__(self, spec: CellSpec) -> None:
        """Build the equations of motion.

        Raises:
            SpecInvalid: URDF, drive train, axes, closures and start position do not fit together,
                or an undeclared effect or its parameters do not exist.
        """
        self.mount(spec)
        n = len(spec.axes)
        self.mechanism = Mechanism(self._model, spec) if spec.closures else None
        self._require_one_size(spec)
        start_rad = spec.start_rad
        mobility = n
        passive_joints: tuple[str, ...] = ()
        self._order: slice | IntArray = slice(None)  # of the joints in Pinocchio's model
        if self.mechanism is not None:
            start_rad = self.mechanism.start_rad
            mobility = self.mechanism.mobility
            passive_joints = self.mechanism.joints[n:]
            self._order = self.mechanism.order
        self._joints = n + len(passive_joints)
        effects = self._build_effects(spec, passive_joints)
        self._mechanics, flexible = lay_out(spec, effects, self._joints)
        self._constants = tuple(self._mechanics)
        m, total = self._mechanics.directions.shape
        with_friction: list[AxisSpec | PassiveFriction] = [*spec.axes]
        with_friction += [spec.passive.get(name, PassiveFriction()) for name in passive_joints]
        self.time_s = 0.0
        flexible_rad = [drive.row @ start_rad[:n] for drive in flexible]
        self.position_rad = np.concatenate([start_rad, flexible_rad])
        self.velocity_rad_s = np.zeros(total)
        self.load_torque_nm = np.zeros(self._joints)
        self.motor_rad = np.zeros(n)
        self.temperature_c = np.full(n, AMBIENT_C)
        self._acting = tuple(e for e in effects if not isinstance(e, Lag))
        self._rows = motor_rows(spec.ratio)
        self._gain = np.array([a.gain_nm_per_a for a in spec.axes])
        self._viscous = np.zeros(total)
        self._viscous[: self._joints] = [joint.viscous_nm_s_rad for joint in with_friction]
        # The paper's offset is on the motor's side of eq. 1, so it acts against the joint.
        self._torque = np.zeros(total)
        self._torque[:n] = [-a.offset_nm for a in spec.axes]
        self._free_bound = np.zeros(m)
        self._free_bound[: self._joints] = [joint.coulomb_nm for joint in with_friction]
        np.add.at(
            self._free_bound, self._mechanics.own_row, [a.motor_coulomb_nm for a in spec.axes]
        )
        self._brake_nm = np.array([_brake_nm(axis) for axis in spec.axes])
        self._bound = self._free_bound.copy()
        self._moment = Moment(
            time_s=0.0,
            step_s=self._mechanics.step_s,
            position_rad=self.position_rad,
            velocity_rad_s=self.velocity_rad_s,
            motor_rad=self.motor_rad,
            current_a=np.zeros(n),
            load_torque_nm=self.load_torque_nm,
            bound_nm=np.zeros(m),
            viscous_nm_s_rad=np.zeros(total),
            torque_nm=np.zeros(total),
            motor_torque_nm=np.zeros(n),
            temperature_c=self.temperature_c,
        )
        self._impulse = np.zeros(m)
        self._resting = np.zeros(total, dtype=np.bool_)
        self._basis = np.eye(self._joints, mobility)
        self._settle()
        turn_rotors(self._mechanics.rotor_direction, self.position_rad, self.motor_rad)
        self.disturbance_nm = np.zeros(n)
        self._disturbance = _disturbance(spec, self._mechanics.step_s)
        self._refuse_stiff(flexible, spec)
        self.set_brakes(np.ones(n, dtype=np.bool_))

    def _require_one_size(self, spec: CellSpec) -> None:
        """Refuse a URDF of another number of joints; a closed chain has passive ones as well.

        Raises:
            SpecInvalid: it is one.
        """
        n = len(spec.axes)
        joints = self._model.nv
        if self.mechanism is None and joints != n:
            raise SpecInvalid(f"{n} axes and a URDF of {joints} joints; expected equal numbers")

    def _build_effects(self, spec: CellSpec, passive_joints: tuple[str, ...]) -> list[Effect | Lag]:
        """Build the undeclared effects; pivots with friction learn how they turn with the joints.

        Raises:
            SpecInvalid: an effect or its parameters do not exist, or a closure is missing or no
                planar pivot.
        """
        effects = [build_effect(effect, len(spec.axes), passive_joints) for effect in spec.effects]
        for effect in effects:
            if not isinstance(effect, PivotFriction):
                continue
            if self.mechanism is None:
                raise SpecInvalid(f"closure {effect.closure!r}: the robot is not a closed chain")
            effect.row = self.mechanism.turning(self._model, effect.closure)
        return effects

    def _refuse_stiff(self, flexible: Sequence[Elasticity], spec: CellSpec) -> None:
        """Refuse a drive whose motor and links would swing faster than the steps can follow.

        The spring k and the damper c act with the speeds and the angle at the begin of a step h.
        Between two masses of reduced inertia μ, that is stable for 2ch + kh² < 4μ (z² - (2 - ch/μ -
        kh²/μ) z + 1 - ch/μ has its roots in the unit circle). The limit here is half of it, for the
        arm without payload.

        Raises:
            SpecInvalid: a drive is too stiff.
        """
        if not flexible:
            return
        step_s = self._mechanics.step_s
        bare = link_model(replace(spec, payload=None))
        postures = [self.position_rad[: self._joints]]
        if self.mechanism is None:
            postures = list(np.transpose(self.postures(spec.start_rad, POSTURES)))
        basis = self._basis
        masses = [
            basis.T @ self._mass(bare, bare.createData(), position) @ basis for position in postures
        ]
        for drive in flexible:
            row = drive.row @ basis[: len(spec.axes)]
            links = min(1.0 / float(row @ np.linalg.solve(mass, row)) for mass in masses)
            motor = spec.axes[drive.axis].motor_inertia_kg_m2
            stiff = (
                2.0 * drive.damping_nm_s_per_rad + drive.stiffness_nm_per_rad * step_s
            ) * step_s
            if stiff * (1.0 / motor + 1.0 / links) > 2.0:
                raise SpecInvalid(
                    f"the flexible drive of axis {drive.axis + 1} is too stiff for steps of "
                    f"{step_s * 1e6:g} us, a motor inertia of {motor:g} kg m² and {links:.3g} kg "
                    "m² behind it; lower stiffness or damping"
                )

    def set_brakes(self, closed: BoolArray) -> None:
        """Close or open the brake of each motor, shape (n,)."""
        self._bound[:] = self._free_bound
        np.add.at(self._bound, self._mechanics.own_row, np.where(closed, self._brake_nm, 0.0))

    def mount(self, spec: CellSpec) -> None:
        """Replace the payload by that of another description of the same cell;
        the state is kept.
        """
        self._model = link_model(spec)
        self._data = self._model.createData()

    def postures(self, start_rad: FloatArray, count: int) -> tuple[FloatArray, ...]:
        """Return `count` positions of each joint that cover its inertia.

        They are spread over one revolution from the start of a revolute joint, or over the travel
        of a prismatic one.
        """
        angles = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
        lower = self._model.lowerPositionLimit
        upper = self._model.upperPositionLimit
        # Pinocchio has a joint type for each sliding axis, as JointModelPX, or
        # JointModelPrismaticUnaligned.
        sliding = [
            str(joint.shortname()).startswith("JointModelP") for joint in self._model.joints[1:]
        ]
        postures = []
        for joint, start in enumerate(start_rad):
            posture = start + angles
            if sliding[joint]:
                posture = np.linspace(lower[joint], upper[joint], count)
            postures.append(posture)
        return tuple(postures)

    def motor_inertia_at(self, position_rad: FloatArray) -> FloatArray:
        """Return the inertia seen by each motor with the others at rest, in joint units [kg m²],
        shape (m,).

        Redundant drives cannot rest alone: with A = P G theirs is (A⁺ᵀ Gᵀ M G A⁺)ᵢᵢ / (A A⁺)ᵢᵢ, the
        share of motor i by least squares in the motion that turns it most. A closed chain has the
        position of its last step alone.
        """
        if self.mechanism is None:
            to_joint = np.linalg.inv(self._rows)
            links = self._mass(self._model, self._data, position_rad)
            return np.asarray(
                np.diag(to_joint.T @ links @ to_joint) + self._mechanics.motor_inertia
            )
        links = self._mass(self._model, self._data, self.position_rad[: self._joints])
        motors = self._rows @ self._basis[: len(self._gain)]
        to_speed = np.linalg.pinv(motors)
        shared = to_speed.T @ self._basis.T @ links @ self._basis @ to_speed
        return np.asarray(
            np.diag(shared) / np.diag(motors @ to_speed) + self._mechanics.motor_inertia
        )

    def step(self, current_a: FloatArray) -> None:
        """Advance by one substep with the motor currents, shape (m,).

        Raises:
            FrictionUnsolved: dry friction was not solved to its tolerance.
            ClosureLost: the closures of a closed chain were not met.
        """
        moment = self._moment
        moment.bound_nm[...] = self._bound
        np.multiply(self._gain, current_a, out=moment.motor_torque_nm)
        moment.viscous_nm_s_rad[...] = self._viscous
        moment.torque_nm[...] = self._torque
        if self._acting:
            moment.time_s = self.time_s
            moment.current_a[...] = current_a
            for act in self._acting:
                act(moment)
        if self._disturbance is not None:
            self.disturbance_nm = self._disturbance.advance()
            moment.motor_torque_nm += self.disturbance_nm
        residual = self._advance()
        if not residual <= TOLERANCE_RAD_S:
            raise FrictionUnsolved(
                f"dry friction at {self.time_s:.6f} s: residual {residual:.3g} rad/s, expected at "
                f"most {TOLERANCE_RAD_S:.3g}; check the inertias and friction of the cell for "
                "values that differ by many orders of magnitude"
            )
        if not self._resting.all():
            self._settle()
        turn_rotors(self._mechanics.rotor_direction, self.position_rad, self.motor_rad)
        self.time_s += self._mechanics.step_s

    def _advance(self) -> float:
        n = self._joints
        position = np.empty(n)
        velocity = np.empty(n)
        position[self._order] = self.position_rad[:n]
        velocity[self._order] = self.velocity_rad_s[:n]
        moment = self._moment
        mass = self._mass(self._model, self._data, self.position_rad[:n])
        bias_nm = pin.nonLinearEffects(self._model, self._data, position, velocity)
        step = (
            self._constants,
            mass,
            bias_nm[self._order],
            moment.viscous_nm_s_rad,
            moment.motor_torque_nm,
            moment.torque_nm,
            moment.bound_nm * self._mechanics.step_s,
            self._impulse,
            self.position_rad,
            self.velocity_rad_s,
            self.load_torque_nm,
        )
        if self.mechanism is None:
            return advance(*step)
        return advance_closed(*step, self._basis, self._resting)

    def _settle(self) -> None:
        """Return the joints of a closed chain to its closures;
        nothing is done for a serial robot.
        """
        if self.mechanism is None:
            return
        open_by, pivot = settle(
            self.mechanism.constants, self._resting, self.position_rad, self._basis
        )
        if not (open_by <= OPEN and pivot >= SINGULAR):
            raise ClosureLost(
                f"closures at {self.time_s:.6f} s: open by {open_by:.3g} m or rad, smallest pivot "
                f"{pivot:.3g} of the largest; expected at most {OPEN:g} and at least {SINGULAR:g}; "
                "the mechanism ran into a singular pose: keep the limits of motion away from it"
            )

    def _mass(self, model: pin.Model, data: pin.Data, position_rad: FloatArray) -> FloatArray:
        """Return the mass matrix of the links in the order of the plant's joints, shape (n, n)."""
        position = np.empty(self._joints)
        position[self._order] = position_rad
        return np.ascontiguousarray(pin.crba(model, data, position)[self._order][:, self._order])


def _disturbance(spec: CellSpec, step_s: float) -> ColouredNoise | None:
    """Return the random torque on each motor in joint units [Nm], None for a cell without any."""
    rated_nm = np.array([abs(axis.gain_nm_per_a) * axis.rated_current_a for axis in spec.axes])
    percent = np.array([axis.torque_disturbance_percent for axis in spec.axes])
    sigma_nm = 0.01 * percent * rated_nm
    if not sigma_nm.any():
        return None
    correlation_s = np.array([axis.disturbance_correlation_s for axis in spec.axes])
    return ColouredNoise(
        random_streams(spec.seed, len(spec.axes), DISTURBANCE), sigma_nm, correlation_s, step_s
    )


def link_model(spec: CellSpec) -> pin.Model:
    """Return the links of a cell, with its payload fixed to the last joint or to the link
    `platform`.

    Raises:
        SpecInvalid: the text is no URDF, a joint is neither revolute nor prismatic with limits, or
            there is no such link.
    """
    try:
        model = pin.buildModelFromXML(spec.urdf)
    except (ValueError, RuntimeError) as error:
        raise SpecInvalid(f"the URDF of the plant cannot be read: {error}") from error
    if model.nq != model.nv or model.nv != model.njoints - 1:
        raise SpecInvalid(
            f"the URDF has {model.njoints - 1} joints with {model.nq} coordinates and {model.nv} "
            "degrees of freedom; expected revolute or prismatic joints alone (a continuous joint "
            "is written as revolute with wide limits)"
        )
    model.gravity.linear = np.asarray(spec.gravity_m_s2, dtype=np.float64)
    payload = spec.payload
    if payload is not None:
        xx, xy, xz, yy, yz, zz = payload.inertia_kg_m2
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        body = pin.Inertia(payload.mass_kg, np.asarray(payload.centre_m, dtype=np.float64), inertia)
        if spec.platform is None:
            model.appendBodyToJoint(model.njoints - 1, body, pin.SE3.Identity())
        else:
            frame = link_frame(model, spec.platform)
            model.appendBodyToJoint(frame.parentJoint, body, frame.placement)
    return model
