"""What the description of a robot has wrong:
zeros of joints, the mounting, and positions that come late.

Such a mistake changes the torques of the whole arm. Its column is the derivative of all joint
torques with respect to it, at the parameters of an estimate; friction of one axis, which may look
like it there, explains nothing on the others. One column is right for small mistakes alone. So a
search corrects the description by what it has found (`corrected_robot`, `corrected_dataset`),
builds everything anew around it, and fits what is left: the value of a coefficient is the whole
correction, what was applied and what is left, and its σ is that of the fit.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ident.arrays import BoolArray, FloatArray
from ident.data.dataset import Dataset
from ident.effects.effect import Effect, GearSide, PlacedEffect, Property, Reported
from ident.effects.signals import Abscissa, Arm, Signals
from ident.model.geometry import GeometryChange, GeometryKind, GeometryParameter, with_geometry
from ident.model.model import Column, Model
from ident.model.robot import Motion, Robot, turned_about

#: Of a difference quotient, rad or m: torques change by 1e-5 of themselves, far above rounding
POSITION_STEP = 1e-5
TIME_STEP_S = 1e-5  #: The same of a delay
#: Largest zero offset, rad or m: 46°; a larger one is looked for by `turned_geometry`
LARGEST_ZERO = 0.8
LARGEST_TILT_RAD = 0.35  #: Largest turn of gravity that two columns can find
LONGEST_DELAY_S = 0.02  #: Longest delay of one encoder


@dataclass(frozen=True, slots=True)
class GeometryEffect(Effect):
    """An effect that corrects the description of the robot, or of its recordings.

    The applied part does not take part in comparisons: an effect is the same one after each
    correction.
    """

    side = GearSide.ALL_JOINTS
    needs_inertia = False

    @property
    @abstractmethod
    def applied(self) -> tuple[float, ...]:
        """Value of each coefficient that the description has been corrected by already,
        shape (p,).
        """

    @abstractmethod
    def with_applied(self, values: Sequence[float]) -> GeometryEffect:
        """The same effect, with the description corrected by these values of the coefficients."""

    def correct_robot(self, robot: Robot, axis: int) -> Robot:
        """The robot with the applied part of the correction."""
        del axis
        return robot

    def correct_dataset(self, data: Dataset, axis: int) -> Dataset:
        """A run with the applied part of the correction."""
        del axis
        return data


@dataclass(frozen=True, slots=True)
class ZeroOffset(GeometryEffect):
    """τ = c ∂τ/∂q_j, on all joints;  c > 0: joint j stands further than its position says, by c.

    Source: calibration of joint offsets; Hollerbach, Khalil & Gautier, "Model identification",
    Springer Handbook of Robotics (2016), by torques in the place of poses. Signature: gravity and
    inertia of the arm behind the joint act in directions that are turned, on all joints.
    """

    name = "zero-offset"
    reported = Reported.ANGLES
    needs_tree = True
    declares = Property.TURNS_THE_ARM
    abscissa = Abscissa.LOAD

    #: correction of the joint's zero in the description
    applied_rad: float = field(default=0.0, compare=False)

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """The offset."""
        return (
            Column(
                "offset", "rad", least=-LARGEST_ZERO, largest=LARGEST_ZERO, about=self.applied_rad
            ),
        )

    @property
    def applied(self) -> tuple[float, ...]:
        """The offset in the description."""
        return (self.applied_rad,)

    def with_applied(self, values: Sequence[float]) -> ZeroOffset:
        """The same with another zero in the description."""
        (offset,) = values
        return ZeroOffset(applied_rad=float(offset))

    def correct_robot(self, robot: Robot, axis: int) -> Robot:
        """Turn or shift the frame of the joint, so that its recorded position is right."""
        zero = GeometryParameter(GeometryKind.ZERO, robot.axes[axis].name)
        return with_geometry(robot, (GeometryChange(zero, self.applied_rad),))

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (n, 1, k)."""
        arm = require_arm(signals)
        position = arm.motion.position_rad.copy()
        position[:, axis] += POSITION_STEP
        # Not the load of the signals: filtered, it is not quite that of a filtered motion.
        change = arm.load_change(replace(arm.motion, position_rad=position))
        return change[:, None] / POSITION_STEP


@dataclass(frozen=True, slots=True)
class GravityDirection(GeometryEffect):
    """τ = a ∂τ/∂α + b ∂τ/∂β on all joints: gravity turned about two axes across the declared one.

    Source: torque is linear in the vector of gravity. Its length is known; two angles are its
    direction, so a mounting that is tilted shows in two columns. Signature: torque at rest on many
    joints at once, also about a vertical axis.
    """

    name = "gravity-direction"
    reported = Reported.ANGLES
    declares = Property.TURNS_THE_ARM
    abscissa = Abscissa.LOAD
    has_axis = False

    #: applied turn about the first axis (`across`)
    applied_1_rad: float = field(default=0.0, compare=False)
    applied_2_rad: float = field(default=0.0, compare=False)  #: applied turn about the second axis

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """The components of the turn."""
        coefficients: list[Column] = []
        for number, applied in enumerate(self.applied, start=1):
            name = f"turn {number}"
            coefficients.append(
                Column(
                    name, "rad", least=-LARGEST_TILT_RAD, largest=LARGEST_TILT_RAD, about=applied
                )
            )
        return tuple(coefficients)

    @property
    def applied(self) -> tuple[float, ...]:
        """The turn in the description."""
        return self.applied_1_rad, self.applied_2_rad

    def with_applied(self, values: Sequence[float]) -> GravityDirection:
        """The same with another direction in the description."""
        first, second = values
        return GravityDirection(applied_1_rad=float(first), applied_2_rad=float(second))

    def correct_robot(self, robot: Robot, axis: int) -> Robot:
        """Turn gravity."""
        del axis
        declared = robot.gravity_m_s2
        return replace(
            robot,
            gravity_m_s2=turned_gravity(declared, self.applied),
            declared_gravity_m_s2=declared,
        )

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (n, 2, k); the axis does not matter."""
        del axis
        arm = require_arm(signals)
        robot = arm.model.robot
        found = robot.gravity_m_s2
        if robot.declared_gravity_m_s2 is None:
            declared = found
        else:
            declared = robot.declared_gravity_m_s2
        columns: list[FloatArray] = []
        for number in range(2):
            turn = list(self.applied)
            turn[number] += POSITION_STEP
            change = (turned_gravity(declared, turn) - found) / POSITION_STEP
            columns.append(arm.weight(change))
        return np.stack(columns, axis=1)


@dataclass(frozen=True, slots=True)
class LatePosition(GeometryEffect):
    """τ = c (∂τ/∂q_j q̇_j + ∂τ/∂q̇_j q̈_j + ∂τ/∂q̈_j d³q_j/dt³), on all joints;  c > 0:
    the position of j is late by c.

    Source: Taylor expansion of the torque of the whole arm with one joint later than the others.
    Signature: in motion alone, on all joints; a late current shows on its own alone.
    """

    name = "late-position"
    reported = Reported.DELAY
    needs_tree = True
    declares = Property.TURNS_THE_ARM
    abscissa = Abscissa.TORQUE_RATE

    #: by which the recorded position was advanced
    applied_s: float = field(default=0.0, compare=False)

    @property
    def coefficients(self) -> tuple[Column, ...]:
        """The delay."""
        return (
            Column(
                "time", "s", least=-LONGEST_DELAY_S, largest=LONGEST_DELAY_S, about=self.applied_s
            ),
        )

    @property
    def applied(self) -> tuple[float, ...]:
        """The delay that the recording was corrected by."""
        return (self.applied_s,)

    def with_applied(self, values: Sequence[float]) -> LatePosition:
        """The same with the recording corrected by another delay."""
        (delay_s,) = values
        return LatePosition(applied_s=float(delay_s))

    def correct_dataset(self, data: Dataset, axis: int) -> Dataset:
        """Advance one joint's position and its derivatives, between filtered samples."""
        steps = self.applied_s * data.rate_hz

        def advanced(values: FloatArray) -> FloatArray:
            moved = values.copy()
            moved[:, axis] = shifted(values[:, axis], steps)
            return moved

        def advanced_mask(mask: BoolArray) -> BoolArray:
            later = np.arange(len(mask)) + round(steps)
            source = np.clip(later, 0, len(mask) - 1)
            moved = mask.copy()
            moved[:, axis] = mask[source, axis]
            return moved

        return replace(
            data,
            position_rad=advanced(data.position_rad),
            velocity_rad_s=advanced(data.velocity_rad_s),
            acceleration_rad_s2=advanced(data.acceleration_rad_s2),
            moving=advanced_mask(data.moving),
            motor_moving=advanced_mask(data.motor_moving),
        )

    def columns(self, signals: Signals, axis: int) -> FloatArray:
        """Columns, shape (n, 1, k)."""
        arm = require_arm(signals)
        motion = arm.motion
        jerk = np.gradient(motion.acceleration_rad_s2[:, axis]) * signals.rate_hz
        position = motion.position_rad.copy()
        velocity = motion.velocity_rad_s.copy()
        acceleration = motion.acceleration_rad_s2.copy()
        position[:, axis] += TIME_STEP_S * motion.velocity_rad_s[:, axis]
        velocity[:, axis] += TIME_STEP_S * motion.acceleration_rad_s2[:, axis]
        acceleration[:, axis] += TIME_STEP_S * jerk
        # Dry friction jumps where the joint turns back; there the joint rests, and rows at rest do
        # not count.
        change = arm.smooth_torque_change(Motion(position, velocity, acceleration))
        return change[:, None] / TIME_STEP_S


def is_correction(placed: PlacedEffect) -> bool:
    """Whether an effect corrects the description of the robot or of its recordings."""
    return isinstance(placed.effect, GeometryEffect)


def corrected_model(model: Model, effects: Iterable[PlacedEffect]) -> Model:
    """The declared model with the applied part of all corrections among these effects."""
    robot = model.robot
    for placed in effects:
        if isinstance(placed.effect, GeometryEffect):
            robot = placed.effect.correct_robot(robot, placed.axis)
    if robot is model.robot:
        return model
    return replace(model, robot=robot)


def corrected_dataset(data: Dataset, effects: Iterable[PlacedEffect]) -> Dataset:
    """A run with the applied part of all corrections; one that was planned has nothing wrong."""
    if data.is_planned:
        return data
    for placed in effects:
        if isinstance(placed.effect, GeometryEffect):
            data = placed.effect.correct_dataset(data, placed.axis)
    return data


def require_arm(signals: Signals) -> Arm:
    """The arm behind signals.

    Raises:
        ValueError: they were made without one.
    """
    if signals.arm is None:
        raise ValueError(
            "signals without an arm; expected those that fitted_signals or declared_signals returns"
        )
    return signals.arm


def across(gravity_m_s2: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors across gravity and each other, shape (3,) each.

    Of gravity along −z they are x and y of the base, of gravity along +z, as of an arm that hangs,
    x and −y.
    """
    along = gravity_m_s2 / np.linalg.norm(gravity_m_s2)
    least_along = int(np.argmin(np.abs(along)))
    other = np.eye(3)[least_along]
    first = other - along * float(along @ other)
    first /= np.linalg.norm(first)
    return first, np.cross(first, along)


def turned_gravity(declared_m_s2: FloatArray, turn_rad: Sequence[float]) -> FloatArray:
    """Gravity turned by a turn's two components about the axes of `across` [m/s²], shape (3,)."""
    first, second = across(declared_m_s2)
    turn_vector_rad = turn_rad[0] * first + turn_rad[1] * second
    return rotation_by(turn_vector_rad) @ declared_m_s2


def turned_gravity_std(
    declared_m_s2: FloatArray, turned_m_s2: FloatArray, deviations_rad: Sequence[float]
) -> FloatArray:
    """σ of each component of gravity, from those of its turn's two components [m/s²], (3,).

    To first order a small further turn t about an axis moves gravity by t × g; the two σ may
    differ, because the moves may show one of the turns alone.
    """
    changes: list[FloatArray] = []
    for axis, std_rad in zip(across(declared_m_s2), deviations_rad, strict=True):
        changes.append(std_rad * np.cross(axis, turned_m_s2))
    return np.asarray(np.linalg.norm(changes, axis=0))


def turn_between(declared_m_s2: FloatArray, found_m_s2: FloatArray) -> FloatArray:
    """Components of the turn between two directions of gravity (`turned_gravity`), shape (2,)."""
    axis = np.cross(declared_m_s2, found_m_s2)
    sine = float(np.linalg.norm(axis))
    if sine == 0.0:
        return np.zeros(2)
    angle = float(np.arctan2(sine, float(declared_m_s2 @ found_m_s2)))
    first, second = across(declared_m_s2)
    return angle / sine * np.array([axis @ first, axis @ second])


def rotation_by(vector_rad: FloatArray) -> FloatArray:
    """Rotation about a vector by its length, shape (3, 3)."""
    angle = float(np.linalg.norm(vector_rad))
    if angle == 0.0:
        return np.eye(3)
    return turned_about(vector_rad / angle, angle)


def shifted(values: FloatArray, steps: float) -> FloatArray:
    """Values so many samples later, by Lagrange's cubic between four neighbours, shape (k,).

    The ends stay constant.
    """
    whole = int(np.floor(steps))
    part = steps - whole
    weights = (
        -part * (part - 1.0) * (part - 2.0) / 6.0,
        (part + 1.0) * (part - 1.0) * (part - 2.0) / 2.0,
        -(part + 1.0) * part * (part - 2.0) / 2.0,
        (part + 1.0) * part * (part - 1.0) / 6.0,
    )
    last = len(values) - 1
    later = np.arange(len(values)) + whole
    out = np.zeros_like(values)
    for offset, weight in enumerate(weights, start=-1):
        neighbours = np.clip(later + offset, 0, last)
        out += weight * values[neighbours]
    return out
