"""Equations of loop closures: how far the two frames of each are apart,
and the derivatives of that.

A closure says that two frames of the tree coincide in some directions of the first
(`ident.model.robot.Closure`). A joint that follows another one adds a row, φ = q − multiplier ·
q_leader − offset (`ident.model.robot.JointCoupling`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.arrays import FloatArray
from ident.model.robot import Closure, JointKind, Place, Poses, Robot, joints_to_base, poses

_AFTER = {"x": "y", "y": "z", "z": "x"}
_INDEX = {"x": 0, "y": 1, "z": 2}


@dataclass(frozen=True, slots=True, eq=False)
class Loops:
    """φ, J and J̇ q̇ of all closures, then of all couplings, over k samples."""

    residual: FloatArray  #: shape (k, c)
    jacobian: FloatArray  #: shape (k, c, n)
    bias: FloatArray  #: shape (k, c); empty without a velocity


def loops(
    robot: Robot, position: FloatArray, size_m: float = 1.0, velocity: FloatArray | None = None
) -> Loops:
    """φ, J and J̇ q̇ with lengths divided by the size of the robot.

    Args:
        robot: with closures or couplings.
        position, velocity: of all joints [rad or m, and per s], shape (k, n); without velocities J̇
            q̇ is empty.
        size_m: that divides lengths.
    """
    samples = len(position)
    placed = poses(robot, position)
    axes = joint_axes(robot, placed)
    width = len(robot.couplings)
    for closure in robot.closures:
        width += len(closure.directions)
    residual = np.empty((samples, width))
    jacobian = np.empty((samples, width, robot.joint_count))
    if velocity is None:
        moved = None
        bias = np.empty((samples, 0))
    else:
        moved = spin(robot, placed, axes, velocity)
        bias = np.empty((samples, width))
    first = 0
    for closure in robot.closures:
        end = first + len(closure.directions)
        own = _closure(robot, closure, placed, axes, moved)
        residual[:, first:end] = own.residual
        jacobian[:, first:end] = own.jacobian
        directions = enumerate(closure.directions, start=first)
        lengths = [row for row, name in directions if name in _INDEX]
        residual[:, lengths] /= size_m
        jacobian[:, lengths] /= size_m
        if moved is not None:
            bias[:, first:end] = own.bias
            bias[:, lengths] /= size_m
        first = end
    for row, coupling in enumerate(robot.couplings, start=first):
        follower = coupling.follower
        leader = coupling.leader
        unit = size_m
        if robot.joints[follower].kind is JointKind.REVOLUTE:
            unit = 1.0
        followed = coupling.multiplier * position[:, leader] + coupling.offset
        gap = position[:, follower] - followed
        residual[:, row] = gap / unit
        jacobian[:, row] = 0.0
        jacobian[:, row, follower] = 1.0 / unit
        jacobian[:, row, leader] = -coupling.multiplier / unit
        if moved is not None:
            bias[:, row] = 0.0
    return Loops(residual, jacobian, bias)


def with_followers(robot: Robot, position: FloatArray) -> FloatArray:
    """Positions of all joints [rad or m], (…, n), each follower where its leader puts it."""
    out = position.copy()
    for coupling in robot.couplings:
        leader_position = position[..., coupling.leader]
        followed = coupling.multiplier * leader_position + coupling.offset
        out[..., coupling.follower] = followed
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Spin:
    """Motion of every link without joint accelerations, in the base frame, (n + 1, k, 3) each."""

    angular: FloatArray  #: ω
    linear: FloatArray  #: velocity of the frame's origin
    angular_bias: FloatArray  #: its angular acceleration
    linear_bias: FloatArray  #: its origin's acceleration


def joint_axes(robot: Robot, placed: Poses) -> FloatArray:
    """Axes of all joints in the base, shape (n, k, 3)."""
    axes = np.array([joint.axis for joint in robot.joints])
    columns = axes[:, None, :, None]
    return np.asarray((placed.rotation[1:] @ columns)[..., 0])


def spin(robot: Robot, placed: Poses, axes: FloatArray, velocity: FloatArray) -> Spin:
    """Motion of every link, from the base outwards; axes are `joint_axes`."""
    shape = (robot.joint_count + 1, len(velocity), 3)
    w = np.zeros(shape)
    v = np.zeros(shape)
    dw = np.zeros(shape)
    dv = np.zeros(shape)
    for index, joint in enumerate(robot.joints):
        p = joint.parent + 1
        i = index + 1
        along = axes[index] * velocity[:, index, None]
        arm = placed.origin_m[i] - placed.origin_m[p]
        w[i] = w[p]
        dw[i] = dw[p]
        of_arm = _cross(w[p], arm)
        centripetal = _cross(w[p], of_arm)
        v[i] = v[p] + of_arm
        dv[i] = dv[p] + _cross(dw[p], arm) + centripetal
        if joint.kind is JointKind.REVOLUTE:
            w[i] = w[p] + along
            dw[i] = dw[p] + _cross(w[p], along)
        else:
            v[i] += along
            dv[i] += 2.0 * _cross(w[p], along)
    return Spin(w, v, dw, dv)


_NEXT = np.array([1, 2, 0])  #: Component after each one
_LAST = np.array([2, 0, 1])  #: Component before each one


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products of vectors, shape (…, 3).

    numpy's own has checks that take longer than the products.
    """
    positive = a[..., _NEXT] * b[..., _LAST]
    negative = a[..., _LAST] * b[..., _NEXT]
    return np.asarray(positive - negative)


def origin(placed: Poses, place: Place) -> FloatArray:
    """Origin of a frame in the base [m], shape (k, 3)."""
    at = place.joint + 1
    offset_m = placed.rotation[at] @ place.translation_m
    return np.asarray(placed.origin_m[at] + offset_m)


def _columns(
    robot: Robot, placed: Poses, axes: FloatArray, place: Place
) -> tuple[FloatArray, FloatArray]:
    """Velocity of a frame's origin, and its angular velocity, per unit of each joint's:
    shapes (n, k, 3).
    """
    linear = np.zeros_like(axes)
    angular = np.zeros_like(axes)
    revolute: list[int] = []
    for joint in joints_to_base(robot, place.joint):
        if robot.joints[joint].kind is JointKind.REVOLUTE:
            revolute.append(joint)
        else:
            linear[joint] = axes[joint]
    arms = origin(placed, place) - placed.origin_m[1:][revolute]
    angular[revolute] = axes[revolute]
    linear[revolute] = _cross(axes[revolute], arms)
    return linear, angular


def _closure(
    robot: Robot, closure: Closure, placed: Poses, axes: FloatArray, moved: Spin | None
) -> Loops:
    """φ, J and J̇ q̇ of one closure, in m and rad.

    Lengths are Rᵀ(p₂ − p₁) in the first frame. Angles are entries of E = R₁ᵀR₂ that are zero where
    the frames are parallel and that change by the angle: the second frame's axis b along the first
    one's c, for a turn about a, with (a, b, c) cyclic. Where the frames may turn about one axis, it
    is that axis of the second frame that must be parallel to the first one's: this holds at every
    angle.
    """
    first = closure.first
    second = closure.second
    frame = placed.rotation[first.joint + 1] @ first.rotation
    to_frame = np.swapaxes(frame, 1, 2)  # R₁ᵀ
    gap = origin(placed, second) - origin(placed, first)
    v1, w1 = _columns(robot, placed, axes, first)
    v2, w2 = _columns(robot, placed, axes, second)
    gap_in_frame = _in_frame(to_frame, gap)
    gap_rates = v2 - v1 - _cross(w1, gap)
    gap_jacobian = to_frame @ gap_rates.transpose(1, 2, 0)
    parallel = np.empty(0)
    turn_jacobian = np.empty(0)
    if any(direction not in _INDEX for direction in closure.directions):
        other = placed.rotation[second.joint + 1] @ second.rotation
        parallel = to_frame @ other  # E
        turn_jacobian = to_frame @ (w2 - w1).transpose(1, 2, 0)
    if moved is not None:
        gap_bias = _in_frame(to_frame, _gap_acceleration(moved, placed, closure, gap))
        turn_rate, turn_bias = _relative_turn(moved, closure, to_frame)
    residual: list[FloatArray] = []
    jacobian: list[FloatArray] = []
    bias: list[FloatArray] = []
    for direction in closure.directions:
        if direction in _INDEX:
            index = _INDEX[direction]
            residual.append(gap_in_frame[:, index])
            jacobian.append(gap_jacobian[:, index])
            if moved is not None:
                bias.append(gap_bias[:, index])
            continue
        along, axis = _parallel_axes(closure.directions, direction[1])
        column = parallel[:, :, axis]
        unit = np.eye(3)[along]
        lever = _cross(column, unit)
        residual.append(column[:, along])
        jacobian.append(np.einsum("ki,kin->kn", lever, turn_jacobian))
        if moved is not None:
            lever_rate = _cross(_cross(turn_rate, column), unit)
            bias.append(_dot(turn_bias, lever) + _dot(turn_rate, lever_rate))
    if moved is None:
        all_bias = np.empty((len(gap), 0))
    else:
        all_bias = np.stack(bias, 1)
    return Loops(np.stack(residual, 1), np.stack(jacobian, 1), all_bias)


def _in_frame(to_frame: FloatArray, vector: FloatArray) -> FloatArray:
    """Vectors in another frame, R v, shapes (k, 3, 3) and (k, 3)."""
    return np.asarray(np.einsum("kij,kj->ki", to_frame, vector))


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Products a · b, shape (k,)."""
    return np.asarray(np.einsum("ki,ki->k", a, b))


def _gap_acceleration(moved: Spin, placed: Poses, closure: Closure, gap: FloatArray) -> FloatArray:
    """Acceleration of p₂ − p₁ in the first frame, without joint accelerations, shape (k, 3)."""
    v1, dv1 = _place_motion(moved, placed, closure.first)
    v2, dv2 = _place_motion(moved, placed, closure.second)
    at = closure.first.joint + 1
    w1 = moved.angular[at]
    dw1 = moved.angular_bias[at]
    coriolis = 2.0 * _cross(w1, v2 - v1)
    centripetal = _cross(w1, _cross(w1, gap))
    euler = _cross(dw1, gap)
    return dv2 - dv1 - euler - coriolis + centripetal


def _relative_turn(
    moved: Spin, closure: Closure, to_frame: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Angular velocity of the second frame in the first, and its rate without accelerations."""
    first = closure.first.joint + 1
    second = closure.second.joint + 1
    w1 = moved.angular[first]
    dw1 = moved.angular_bias[first]
    relative = moved.angular[second] - w1
    coriolis = _cross(w1, relative)
    rate = moved.angular_bias[second] - dw1 - coriolis
    return _in_frame(to_frame, relative), _in_frame(to_frame, rate)


def _parallel_axes(directions: tuple[str, ...], about: str) -> tuple[int, int]:
    """Entry of E = R₁ᵀR₂ that must be zero so that the frames do not turn about an axis."""
    following = _AFTER[about]
    last = _AFTER[following]
    free = [axis for axis in "xyz" if f"r{axis}" not in directions]
    if len(free) == 1:
        (free_axis,) = free
        along = last
        if last == free_axis:
            along = following
        return _INDEX[along], _INDEX[free_axis]
    return _INDEX[last], _INDEX[following]


def _place_motion(moved: Spin, placed: Poses, place: Place) -> tuple[FloatArray, FloatArray]:
    """Velocity of a frame's origin, and its acceleration with all joint accelerations zero."""
    at = place.joint + 1
    arm = placed.rotation[at] @ place.translation_m
    w = moved.angular[at]
    dw = moved.angular_bias[at]
    of_arm = _cross(w, arm)
    centripetal = _cross(w, of_arm)
    velocity = moved.linear[at] + of_arm
    acceleration = moved.linear_bias[at] + _cross(dw, arm) + centripetal
    return velocity, acceleration
