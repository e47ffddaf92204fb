"""Pivots that a closed chain is cut at:
joints without a motor that the tree of joints does not have.

A loop is cut at one of its joints, and closed again by equations (`ident.model.robot.Closure`).
Where the frames of a closure can turn about one axis only, the axis a of the first frame, the cut
joint is a pivot. With the angular velocities ω₁, ω₂ of the two links, its speed and its power are

    ψ̇ = a · (ω₂ − ω₁) = J_ψ q̇,    τ_ψ ψ̇ = (J_ψᵀ τ_ψ)ᵀ q̇,

so that a torque τ_ψ in the pivot acts as J_ψᵀ τ_ψ on the joints of the tree (virtual power, as for
a passive joint in Briot & Gautier, Multibody System Dynamics 2015). Either all revolute joints of
the loop are parallel to a, or the closure holds the other two angles. So ω₂ − ω₁ has the direction
of a, and a · (ω₂ − ω₁) is the sum over the revolute joints of the loop.

A ball joint turns about three axes at once and has no such angle: it is no pivot here, and friction
in it has no name.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ident.arrays import FloatArray
from ident.errors import ModelError
from ident.model.closed_chain import Assembly, assemble, null_space, towards_closed
from ident.model.closures import joint_axes, loops, spin
from ident.model.robot import Closure, JointKind, Motion, Pivot, Poses, Robot, joints_to_base, poses

#: Difference of two joints' speeds, relative to the largest, below which they turn alike; also the
#: speed of a pivot, relative to the largest of a joint, below which it does not turn
ALIKE_TOLERANCE = 1e-7
PARALLEL_SINE = 1e-6  #: Sine of the angle between two axes that count as parallel
DISTANCES_FROM_ASSEMBLY = (0.0, 0.06, -0.09)
"""Speeds are compared at poses that are this far from the assembly pose [rad or m]."""


def cut_pivots(robot: Robot) -> tuple[Pivot, ...]:
    """Find the pivots that loops are cut at, and in which friction differs from that of every joint
    of the tree.

    In a parallelogram, opposite joints turn alike at every pose; friction in one of them is
    friction in the other for the motors. Such a pivot is left out, so that an effect has one name.

    Args:
        robot: with closures.

    Returns:
        one a closure at most, in their order; none where the closures cannot be closed (`assemble`
        says why).
    """
    candidates = [_pivot_of(robot, index) for index in range(len(robot.closures))]
    turning = tuple(pivot for pivot in candidates if pivot is not None)
    if not turning:
        return ()
    try:
        assembly = assemble(robot)
    except ModelError:
        return ()
    speeds = _speeds_near(replace(robot, pivots=turning), assembly)
    count = robot.joint_count
    of_joints = speeds[:, :count]
    known = list(of_joints.T)
    # Where the joints of a loop turn against each other, a pivot at rest has a rounding error.
    least_speed = ALIKE_TOLERANCE * float(np.abs(of_joints).max())
    found: list[Pivot] = []
    for number, pivot in enumerate(turning):
        speed = speeds[:, count + number]
        turns = float(np.abs(speed).max()) > least_speed
        is_known = any(_turn_alike(speed, other) for other in known)
        if turns and not is_known:
            found.append(pivot)
            known.append(speed)
    return tuple(found)


def _turn_alike(own: FloatArray, other: FloatArray) -> bool:
    """Whether speeds are those of another joint in every motion, or their negatives.

    Args:
        own, other: speeds in each of the motions, shape (motions,).
    """
    largest = float(np.abs(own).max())
    difference = np.abs(own - other).max()
    difference_to_negative = np.abs(own + other).max()
    return bool(min(difference, difference_to_negative) <= ALIKE_TOLERANCE * largest)


def pivot_rates(robot: Robot, position_rad: FloatArray) -> FloatArray:
    """Speed of each pivot per unit of each joint's, J_ψ.

    Args:
        robot: with p pivots and n joints.
        position_rad: of the joints [rad or m], shape (k, n).

    Returns:
        shape (k, p, n) [1, or rad/m of a prismatic joint: zero].
    """
    rates = np.zeros((len(position_rad), len(robot.pivots), robot.joint_count))
    if not robot.pivots:
        return rates
    placed = poses(robot, position_rad)
    axes = joint_axes(robot, placed)
    for number, pivot in enumerate(robot.pivots):
        about = _axis(robot, placed, pivot)
        loop = _loop(robot, robot.closures[pivot.closure])
        for joint, sign in loop.items():
            along = np.einsum("ki,ki->k", about, axes[joint])  # a · a_j
            rates[:, number, joint] = sign * along
    return rates


def pivot_motion(robot: Robot, assembly: Assembly, joints: Motion) -> Motion:
    """Motion of the p pivots from that of all n joints, arrays of shape (k, p).

    An angle is zero where the two frames of the closure are parallel. It is the one within half a
    turn of the angle at the assembly pose. The axis a_j of each joint turns with the link before
    it, so that

        ψ̈ = J_ψ q̈ + a · Σ_j ± ω_parent(j) × (a_j q̇_j).

    a turns too, but with ω₂ − ω₁ in its direction, (ω₁ × a) · (ω₂ − ω₁) is zero.

    Args:
        robot: with p pivots.
        assembly: of the robot.
        joints: motion of all joints, arrays of shape (k, n).
    """
    samples = len(joints.position_rad)
    rates = pivot_rates(robot, joints.position_rad)
    velocity = np.einsum("kpn,kn->kp", rates, joints.velocity_rad_s)
    acceleration = np.einsum("kpn,kn->kp", rates, joints.acceleration_rad_s2)
    position = np.zeros((samples, len(robot.pivots)))
    if not robot.pivots:
        return Motion(position, velocity, acceleration)
    placed = poses(robot, joints.position_rad)
    assembled = poses(robot, assembly.position_rad[None])
    axes = joint_axes(robot, placed)
    angular_velocity = spin(robot, placed, axes, joints.velocity_rad_s).angular
    for number, pivot in enumerate(robot.pivots):
        assembly_angle = _angle(robot, assembled, pivot)
        away = _angle(robot, placed, pivot) - assembly_angle
        within_half_turn = np.arctan2(np.sin(away), np.cos(away))
        position[:, number] = assembly_angle + within_half_turn
        about = _axis(robot, placed, pivot)
        loop = _loop(robot, robot.closures[pivot.closure])
        for joint, sign in loop.items():
            parent = robot.joints[joint].parent
            of_parent = angular_velocity[parent + 1]
            of_joint = axes[joint] * joints.velocity_rad_s[:, joint, None]
            change = np.cross(of_parent, of_joint)
            along = np.einsum("ki,ki->k", about, change)  # a · (ω × a_j q̇_j)
            acceleration[:, number] += sign * along
    return Motion(position, velocity, acceleration)


def _pivot_of(robot: Robot, index: int) -> Pivot | None:
    """Return the pivot of a closure; None of one that turns about no axis or about several."""
    directions = robot.closures[index].directions
    translates: list[int] = []
    turns: list[int] = []
    for axis, name in enumerate("xyz"):
        if name not in directions:
            translates.append(axis)
        if f"r{name}" not in directions:
            turns.append(axis)
    if len(turns) == 1:
        return Pivot(index, turns[0])
    # A closure of a planar mechanism holds two translations and no angle: it turns about the third
    # axis. Any other that leaves two or three angles free turns about several axes.
    if len(turns) < 3 or len(translates) != 1:
        return None
    pivot = Pivot(index, translates[0])
    if _is_planar(robot, pivot):
        return pivot
    return None


def _is_planar(robot: Robot, pivot: Pivot) -> bool:
    """Whether every revolute joint of the loop is parallel to the pivot's axis at position zero,
    and so at every position.
    """
    placed = poses(robot, np.zeros((1, robot.joint_count)))
    about = _axis(robot, placed, pivot)
    axes = joint_axes(robot, placed)
    loop = _loop(robot, robot.closures[pivot.closure])
    for joint in loop:
        across = np.cross(about, axes[joint])
        if np.linalg.norm(across) > PARALLEL_SINE:
            return False
    return True


def _loop(robot: Robot, closure: Closure) -> dict[int, float]:
    """Revolute joints of a loop: 1 where one turns the second frame,
    −1 where it turns the first.
    """
    signs: dict[int, float] = {}
    for place, sign in ((closure.second, 1.0), (closure.first, -1.0)):
        for joint in joints_to_base(robot, place.joint):
            if robot.joints[joint].kind is JointKind.REVOLUTE:
                signs[joint] = signs.get(joint, 0.0) + sign
    return {joint: sign for joint, sign in signs.items() if sign != 0.0}


def _axis(robot: Robot, placed: Poses, pivot: Pivot) -> FloatArray:
    """Axis of a pivot in the base, shape (k, 3)."""
    first = robot.closures[pivot.closure].first
    axis = first.rotation[:, pivot.axis]
    return np.asarray(placed.rotation[first.joint + 1] @ axis)


def _angle(robot: Robot, placed: Poses, pivot: Pivot) -> FloatArray:
    """Angle of a pivot, between −π and π, shape (k,)."""
    closure = robot.closures[pivot.closure]
    first = closure.first
    second = closure.second
    frame = placed.rotation[first.joint + 1] @ first.rotation
    other = placed.rotation[second.joint + 1] @ second.rotation
    turned = np.swapaxes(frame, 1, 2) @ other
    # About z, the rotation has cos ψ at (x, x) and sin ψ at (y, x).
    following = (pivot.axis + 1) % 3
    last = (pivot.axis + 2) % 3
    sine = turned[:, last, following]
    cosine = turned[:, following, following]
    return np.asarray(np.arctan2(sine, cosine))


def _speeds_near(robot: Robot, assembly: Assembly) -> FloatArray:
    """Speeds of joints and pivots in free motions near the assembly pose, (motions, n + p).

    The free motions of a pose are the null space of the closures' Jacobian.
    """
    draw = np.random.default_rng(0)
    assembled = loops(robot, assembly.position_rad[None], assembly.size_m)
    free = null_space(assembled.jacobian[0])
    speeds: list[FloatArray] = []
    for distance in DISTANCES_FROM_ASSEMBLY:
        drawn = draw.standard_normal(free.shape[1])
        near = assembly.position_rad + distance * free @ drawn
        position, _ = towards_closed(robot, near, assembly.size_m, range(robot.joint_count))
        closing = loops(robot, position[None], assembly.size_m)
        of_joints = null_space(closing.jacobian[0])
        (rates,) = pivot_rates(robot, position[None])
        of_pivots = rates @ of_joints
        of_all = np.concatenate((of_joints, of_pivots))
        speeds.append(of_all.T)
    return np.concatenate(speeds)
