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
from ident.model.robot import Closure, JointKind, Place, Poses, Robot, poses

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
    placed = poses(robot, position)
    samples = len(position)
    axes = (
        placed.rotation[1:] @ np.array([joint.axis for joint in robot.joints])[:, None, :, None]
    )[..., 0]
    if velocity is None:
        moved = None
    else:
        moved = _spin(robot, placed, axes, position, velocity)
    width = sum(len(closure.directions) for closure in robot.closures) + len(robot.couplings)
    residual = np.empty((samples, width))
    jacobian = np.empty((samples, width, robot.joint_count))
    bias = np.empty((samples, width if moved is not None else 0))
    first = 0
    for closure in robot.closures:
        part = slice(first, first + len(closure.directions))
        residual[:, part], jacobian[:, part], turning = _closure(
            robot, closure, placed, axes, moved
        )
        if moved is not None:
            bias[:, part] = turning
        lengths = [first + row for row, one in enumerate(closure.directions) if "r" not in one]
        for array in (residual, jacobian, bias) if moved is not None else (residual, jacobian):
            array[:, lengths] /= size_m
        first = part.stop
    for row, coupling in enumerate(robot.couplings, start=first):
        if robot.joints[coupling.follower].kind is JointKind.REVOLUTE:
            unit = 1.0
        else:
            unit = size_m
        followed = coupling.multiplier * position[:, coupling.leader] + coupling.offset
        residual[:, row] = (position[:, coupling.follower] - followed) / unit
        jacobian[:, row] = 0.0
        jacobian[:, row, coupling.follower] = 1.0 / unit
        jacobian[:, row, coupling.leader] = -coupling.multiplier / unit
        if moved is not None:
            bias[:, row] = 0.0
    return Loops(residual, jacobian, bias)


def with_followers(robot: Robot, position: FloatArray) -> FloatArray:
    """Positions of all joints [rad or m], shape (…, n),
    with each follower where its leader puts it.
    """
    out = position.copy()
    for coupling in robot.couplings:
        out[..., coupling.follower] = (
            coupling.multiplier * position[..., coupling.leader] + coupling.offset
        )
    return out


@dataclass(frozen=True, slots=True, eq=False)
class _Spin:
    """Motion of every link with all joint accelerations zero;
    arrays of shape (n + 1, k, 3), in the base frame.
    """

    angular: FloatArray  #: ω
    linear: FloatArray  #: velocity of the frame's origin
    angular_bias: FloatArray  #: its angular acceleration
    linear_bias: FloatArray  #: its origin's acceleration


def _spin(
    robot: Robot, placed: Poses, axes: FloatArray, position: FloatArray, velocity: FloatArray
) -> _Spin:
    shape = (robot.joint_count + 1, len(position), 3)
    w, v, dw, dv = (np.zeros(shape) for _ in range(4))
    for index, joint in enumerate(robot.joints):
        p = joint.parent + 1
        i = index + 1
        along = axes[index] * velocity[:, index, None]
        arm = placed.origin_m[i] - placed.origin_m[p]
        w[i], dw[i] = w[p], dw[p]
        v[i] = v[p] + _cross(w[p], arm)
        dv[i] = dv[p] + _cross(dw[p], arm) + _cross(w[p], _cross(w[p], arm))
        if joint.kind is JointKind.REVOLUTE:
            w[i] = w[p] + along
            dw[i] = dw[p] + _cross(w[p], along)
        else:
            v[i] += along
            dv[i] += 2.0 * _cross(w[p], along)
    return _Spin(w, v, dw, dv)


_AHEAD = np.array([1, 2, 0])
_BEHIND = np.array([2, 0, 1])


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products of vectors, shape (…, 3);
    without the checks of numpy's, which take longer than the products.
    """
    return np.asarray(a[..., _AHEAD] * b[..., _BEHIND] - a[..., _BEHIND] * b[..., _AHEAD])


def origin(placed: Poses, place: Place) -> FloatArray:
    """Origin of a frame in the base [m], shape (k, 3)."""
    at = place.joint + 1
    return np.asarray(placed.origin_m[at] + placed.rotation[at] @ place.translation_m)


def _columns(
    robot: Robot, placed: Poses, axes: FloatArray, place: Place
) -> tuple[FloatArray, FloatArray]:
    """Velocity of a frame's origin, and its angular velocity, per unit of each joint's:
    shapes (n, k, 3).
    """
    linear = np.zeros_like(axes)
    angular = np.zeros_like(axes)
    moved = list[int]()
    joint = place.joint
    while joint >= 0:
        if robot.joints[joint].kind is JointKind.REVOLUTE:
            moved.append(joint)
        else:
            linear[joint] = axes[joint]
        joint = robot.joints[joint].parent
    angular[moved] = axes[moved]
    linear[moved] = _cross(axes[moved], origin(placed, place) - placed.origin_m[1:][moved])
    return linear, angular


def _closure(
    robot: Robot, closure: Closure, placed: Poses, axes: FloatArray, moved: _Spin | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
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
    other = placed.rotation[second.joint + 1] @ second.rotation
    apart = origin(placed, second) - origin(placed, first)
    turned = np.swapaxes(frame, 1, 2)
    (v1, w1), (v2, w2) = (_columns(robot, placed, axes, place) for place in (first, second))
    residual = []
    jacobian = []
    bias = []
    gap = np.einsum("kij,kj->ki", turned, apart)
    lengths = turned @ (v2 - v1 - _cross(w1, apart)).transpose(1, 2, 0)
    turns = any("r" in direction for direction in closure.directions)
    if turns:
        turning = turned @ (w2 - w1).transpose(1, 2, 0)
    else:
        turning = np.empty(0)
    parallel = turned @ other if turns else np.empty(0)
    if moved is not None:
        motion = [_place_motion(moved, placed, place) for place in (first, second)]
        (u1, o1, du1, do1), (u2, o2, du2, do2) = motion
        rate = u2 - u1
        drift = (
            du2 - du1 - _cross(do1, apart) - 2.0 * _cross(o1, rate) + _cross(o1, _cross(o1, apart))
        )
        drift = np.einsum("kij,kj->ki", turned, drift)
        spin = np.einsum("kij,kj->ki", turned, o2 - o1)
        spin_bias = np.einsum("kij,kj->ki", turned, do2 - do1 - _cross(o1, o2 - o1))
    for direction in closure.directions:
        if direction in _INDEX:
            i = _INDEX[direction]
            residual.append(gap[:, i])
            jacobian.append(lengths[:, i])
            if moved is not None:
                bias.append(drift[:, i])
            continue
        along, axis = _parallel_axes(closure.directions, direction[1])
        column = parallel[:, :, axis]
        unit = np.eye(3)[along]
        residual.append(column[:, along])
        lever = _cross(column, unit)
        jacobian.append(np.einsum("ki,kin->kn", lever, turning))
        if moved is not None:
            swung = _cross(_cross(spin, column), unit)
            bias.append(
                np.einsum("ki,ki->k", spin_bias, lever) + np.einsum("ki,ki->k", spin, swung)
            )
    return (
        np.stack(residual, 1),
        np.stack(jacobian, 1),
        np.stack(bias, 1) if bias else np.empty((len(apart), 0)),
    )


def _parallel_axes(directions: tuple[str, ...], about: str) -> tuple[int, int]:
    """Entry of E = R₁ᵀR₂ that must be zero so that the frames do not turn about an axis."""
    following = _AFTER[about]
    last = _AFTER[following]
    if sum(direction in directions for direction in ("rx", "ry", "rz")) == 2:
        free = next(axis for axis in "xyz" if f"r{axis}" not in directions)
        return _INDEX[following if last == free else last], _INDEX[free]
    return _INDEX[last], _INDEX[following]


def _place_motion(
    moved: _Spin, placed: Poses, place: Place
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Velocity of a frame's origin, its angular velocity,
    and both accelerations without joint accelerations.
    """
    at = place.joint + 1
    arm = placed.rotation[at] @ place.translation_m
    w = moved.angular[at]
    dw = moved.angular_bias[at]
    linear = moved.linear[at] + _cross(w, arm)
    return linear, w, moved.linear_bias[at] + _cross(dw, arm) + _cross(w, _cross(w, arm)), dw
