"""Motion of a closed chain: how the passive joints follow the motors.

Every loop is cut, so that a tree with n joints remains, and closed again by φ(q) = 0
(`ident.model.robot.Closure`). With J = ∂φ/∂q, d = n − rank J coordinates x move independently, and

    q̇ = G ẋ,    J G = 0,    q̇_a = A ẋ,    q̈ = G ẍ + h,    J h = −J̇ q̇  (h zero in the rows of x).

x are d of the joints themselves, so that G is the identity in their rows and solves J_d G_d = −J_x
in the others. With as many motors as degrees of freedom (m = d), x are the motors' joints, and A =
I. A joint that follows another in a fixed ratio is a row of φ, too: G then has that ratio. A robot
without closures and followers has G = A = I. (Briot & Gautier, Multibody System Dynamics 2015, eqs.
of the tree and its closure; Khalil & Dombre, Modeling, Identification and Control of Robots, ch.
7.)

Rows of φ that are lengths are divided by the size of the robot: a condition number then compares
like with like. J_d is factorised once, J_d = Q R, and solves for G_d and h_d:

    G_d = −R⁻¹ Qᵀ J_x,    h_d = −R⁻¹ Qᵀ J̇ q̇.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ident.arrays import BoolArray, FloatArray, IntArray
from ident.errors import ModelError
from ident.model.closures import loops, origin, with_followers
from ident.model.robot import Closure, JointKind, Motion, Robot, poses

LARGEST_CONDITION = 500.0
"""Largest condition number (Frobenius) of J_d, the derivatives to the joints that follow, and of A
for a redundant drive: nearer to a singularity, small errors of position are large forces.
Mechanisms stay below 30 in their workspace.
"""
CLOSED = 1e-12  #: |φ| at which Newton's iteration ends, in units of the robot's size or radians
#: The same on the way to other positions: Newton's next step would leave about its square, 1e-8
NEARLY_CLOSED = 1e-4
SETTLED_RAD = 1e-9  #: Longest last step of a Newton iteration [rad or m]
NEARLY_SETTLED_RAD = 1e-3  #: The same on the way to other positions [rad or m]
SMALLEST_RANK = 1e-7  #: Singular value of J, relative to the largest, that counts as zero
LARGEST_GAP = 0.3  #: |φ| at the declared assembly pose, in units of the robot's size or radians
LARGEST_MISFIT = 0.02
"""Largest difference between a measured position of a redundant drive's motor and the pose that
fits all of them best [rad, or m divided by the robot's size]: a bent arm stays below it, a wrong
zero or sign does not.
"""
LONGEST_STRIDE = 64
"""At least every 64th sample is reached from the assembly pose, in steps;
the others start from their neighbours.
"""
#: Largest motion between two such samples [rad, or m divided by the robot's size]
STRIDE_RAD = 0.25
#: Longest step on the way from the assembly pose [rad, or m divided by the robot's size]
STEP_RAD = 0.15
LONGEST_STEP_RAD = 1.5  #: Longer steps of Newton lead to another pose, or nowhere [rad or m]
MAX_ITERATIONS = 30
SMALLEST_SIZE_M = 1e-3  #: Of a robot


@dataclass(frozen=True, slots=True, eq=False)
class Assembly:
    """Joints of a robot that its closures leave free, and those that follow,
    found at its assembly pose.
    """

    position_rad: FloatArray  #: of all joints, closed exactly, shape (n,)
    independent: tuple[int, ...]  #: joints that are x, d of them
    dependent: tuple[int, ...]  #: the other joints, which follow
    size_m: float  #: largest distance from the base of a joint or of a frame that closes a loop
    condition: float  #: of J_d there, by the Frobenius norm

    @property
    def mobility(self) -> int:
        """Degrees of freedom d."""
        return len(self.independent)


@dataclass(frozen=True, slots=True, eq=False)
class TreeMotion:
    """Motion of all n joints over k samples, and how it follows from that of x."""

    joints: Motion  #: arrays of shape (k, n)
    to_joints: FloatArray  #: G, shape (k, n, d)
    to_motors: FloatArray  #: A, shape (k, m, d)
    condition: FloatArray  #: of J_d by the Frobenius norm, shape (k,)


def assemble(robot: Robot, mobility: int | None = None) -> Assembly:
    """Close the loops at the assembly pose, and count what remains free.

    Args:
        robot: with closures or couplings; a robot without any has n independent joints.
        mobility: d as its maker declares it; not checked when None.

    Raises:
        ModelError: a closure names no direction or cannot close there, the mobility is another one,
            the motors do not move every degree of freedom, or the pose is singular.
    """
    count = robot.joint_count
    joints = tuple(range(count))
    start = np.zeros(count)
    if robot.assembly_rad is not None:
        start = np.asarray(robot.assembly_rad, dtype=np.float64)
    if not robot.is_constrained:
        size_m = _size(robot, start)
        return Assembly(start, joints, (), size_m, condition=1.0)
    _check(robot, start)
    start = with_followers(robot, start)
    size_m = _size(robot, start)
    position = _closed_near(robot, start, size_m)
    jacobian = loops(robot, position[None], size_m).jacobian[0]
    free_motions = null_space(jacobian)
    found = free_motions.shape[1]
    if mobility is not None and found != mobility:
        raise ModelError(
            f"the closures leave {found} degrees of freedom at the assembly pose; expected "
            f"{mobility} as declared: is a closure missing, or does one hold a direction that must "
            "be free (`directions`)?"
        )
    motors = robot.axis_joints
    _require_driven(robot, position, free_motions, size_m)
    independent = motors
    if len(motors) != found:  # a redundant drive: any d joints that move independently are x
        independent = _independent(free_motions)
    dependent = tuple(joint for joint in joints if joint not in independent)
    condition = 1.0
    if dependent:
        _, triangle = np.linalg.qr(jacobian[None, :, dependent])
        condition = float(_condition(triangle)[0])
    if condition > LARGEST_CONDITION:
        raise ModelError(
            f"the assembly pose is close to a singularity: condition {condition:.3g} of the "
            f"closures; expected below {LARGEST_CONDITION:g}: give a pose inside the workspace"
        )
    return Assembly(position, independent, dependent, size_m, condition)


def _require_driven(robot: Robot, position: FloatArray, free: FloatArray, size_m: float) -> None:
    """Refuse motors that do not move every free motion of the joints, shape (n, d),
    at the assembly pose.

    Raises:
        ModelError: they do not.
    """
    motors = list(robot.axis_joints)
    mobility = free.shape[1]
    has_enough = len(motors) >= mobility
    if has_enough and np.linalg.matrix_rank(free[motors], tol=1e-6) == mobility:
        return
    names = ", ".join(robot.joints[joint].name for joint in motors)
    if has_enough and _generic_rank(robot, position, free, size_m) == mobility:
        raise ModelError(
            f"the robot is singular at the assembly pose: there the motors {names} do not move all "
            f"of its {mobility} degrees of freedom, near it they do; give an assembly pose "
            "inside the workspace"
        )
    raise ModelError(
        f"the motors {names} do not move all {mobility} degrees of freedom that the closures "
        "leave; name a joint that each motor drives, one for each degree of freedom at least "
        "(`motors`)"
    )


def follow(robot: Robot, assembly: Assembly, axes: Motion) -> TreeMotion:
    """Let all joints follow the motors' joints.

    Of the several poses that belong to a position of the motors, it is the one that is reached from
    the assembly pose by moving them there in a straight line: a function of the position alone,
    whatever was asked before. Samples between two such poses start from an interpolation, which
    leads to the same pose.

    Args:
        robot: with n joints and m motors.
        assembly: of the robot.
        axes: motion of the motors' joints, arrays of shape (k, m). A redundantly driven robot (m >
            d) gets the pose that fits them best.

    Raises:
        ModelError: the loops cannot be closed at a position, the positions of a redundant drive's
            motors do not fit each other, or it is close to a singularity, where small errors of
            position are large forces.
    """
    motors = list(robot.axis_joints)
    dependent = list(assembly.dependent)
    axes_rad = np.asarray(axes.position_rad, dtype=np.float64)
    samples = len(axes_rad)
    count = robot.joint_count
    if not robot.is_constrained:
        identity = np.broadcast_to(np.eye(count), (samples, count, count))
        return TreeMotion(axes, identity, identity, np.ones(samples))
    position = positions(robot, assembly, axes_rad)
    jacobian = loops(robot, position, assembly.size_m).jacobian
    to_joints, q, r = joints_by_free_ones(assembly, jacobian)
    # ẋ by q̇_a = A ẋ, and q̇ = G ẋ.
    to_motors = to_joints[:, motors]
    velocity_x = _least_squares(to_motors, np.asarray(axes.velocity_rad_s))
    velocity = np.einsum("knd,kd->kn", to_joints, velocity_x)
    # h_d = −R⁻¹ Qᵀ J̇ q̇.
    loop_bias = loops(robot, position, assembly.size_m, velocity).bias  # J̇ q̇
    bias = np.zeros((samples, count))  # h
    bias[:, dependent] = -solve_qr(q, r, loop_bias)
    # ẍ by q̈_a = A ẍ + h_a, and q̈ = G ẍ + h.
    axes_without_bias = np.asarray(axes.acceleration_rad_s2) - bias[:, motors]
    acceleration_x = _least_squares(to_motors, axes_without_bias)
    without_bias = np.einsum("knd,kd->kn", to_joints, acceleration_x)
    acceleration = without_bias + bias
    condition = _condition(r)
    condition_of_motors = _condition_of_motors(robot, assembly, to_motors)
    _require_regular(robot, axes_rad, condition, "closures")
    _require_regular(robot, axes_rad, condition_of_motors, "motors")
    joints = Motion(position, velocity, acceleration)
    return TreeMotion(joints, to_joints, to_motors, condition)


def joints_by_free_ones(
    assembly: Assembly, jacobian: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return G of q̇ = G ẋ in each sample, shape (k, n, d), with Q and R of J_d.

    It is the identity in the rows of x, and G_d = −R⁻¹ Qᵀ J_x in the others.

    Args:
        assembly: of the robot.
        jacobian: of its closures, shape (k, c, n).
    """
    x = list(assembly.independent)
    dependent = list(assembly.dependent)
    samples, _, joints = jacobian.shape
    q, r = np.linalg.qr(jacobian[:, :, dependent])
    projected_x = np.swapaxes(q, 1, 2) @ jacobian[:, :, x]
    to_joints = np.zeros((samples, joints, len(x)))
    to_joints[:, x] = np.eye(len(x))
    to_joints[:, dependent] = -np.linalg.solve(r, projected_x)
    return to_joints, q, r


def _require_regular(robot: Robot, axes_rad: FloatArray, condition: FloatArray, of: str) -> None:
    """Refuse positions at which a condition, shape (k,), is too large.

    Raises:
        ModelError: one is above LARGEST_CONDITION.
    """
    worst = int(np.argmax(condition))
    largest = condition[worst]
    if largest > LARGEST_CONDITION:
        place = _at(robot, axes_rad[worst])
        raise ModelError(
            f"the motion comes close to a singularity at {place}: condition {largest:.3g} of the "
            f"{of}; expected below {LARGEST_CONDITION:g}: record moves away from it"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Reach:
    """Poses that belong to positions of the motors' joints, where there are any."""

    #: of all joints; where the loops do not close, of some pose near by, shape (k, n)
    position_rad: FloatArray
    gap: FloatArray  #: |φ| that is left, in units of the robot's size or radians, shape (k,)
    #: Largest difference between a motor's position and that of its joint [rad or m], shape (k,):
    #: not zero where motors of a redundant drive do not fit each other.
    misfit: FloatArray
    condition: FloatArray  #: of J_d by the Frobenius norm, shape (k,)

    @property
    def closed(self) -> BoolArray:
        """Where the loops close, shape (k,)."""
        return self.gap < CLOSED


def positions(robot: Robot, assembly: Assembly, axes_rad: FloatArray) -> FloatArray:
    """Positions of all joints [rad or m] from those of the motors' joints; see `follow`.

    Args:
        robot: with n joints and m motors.
        assembly: of the robot.
        axes_rad: positions of the motors' joints, shape (k, m).

    Returns:
        shape (k, n).

    Raises:
        ModelError: the loops cannot be closed at a position, or motors of a redundant drive do not
            fit each other.
    """
    found = reach(robot, assembly, axes_rad)
    units = _units(robot, assembly)
    motors = list(robot.axis_joints)
    difference = np.abs(found.position_rad[:, motors] - axes_rad)
    misfit = difference / units  # zero where m = d
    worst, axis = divmod(int(np.argmax(misfit)), misfit.shape[1])  # sample and axis
    if misfit[worst, axis] > LARGEST_MISFIT:
        name = robot.axes[axis].name
        unit = units[axis]
        found_misfit = misfit[worst, axis] * unit
        largest_misfit = LARGEST_MISFIT * unit
        place = _at(robot, axes_rad[worst])
        raise ModelError(
            f"the motors do not fit each other at {place}: {name} is "
            f"{found_misfit:.2g} away from where the others hold it; expected at most "
            f"{largest_misfit:.2g} (rad or m): are signs, zeros and ratios of the axes right?"
        )
    if not found.closed.all():
        worst = int(np.argmax(found.gap))
        gap = found.gap[worst]
        place = _at(robot, axes_rad[worst])
        raise ModelError(
            f"the loops cannot be closed at {place}: {gap:.2g} "
            "of the robot's size is left open; expected positions inside the workspace: are signs, "
            "zeros and units of the axes right?"
        )
    return found.position_rad


def _units(robot: Robot, assembly: Assembly) -> FloatArray:
    """What a misfit of each motor's joint is compared with, shape (m,).

    A radian where it is revolute, the robot's size where it is prismatic.
    """
    return _unit_of_each(robot, robot.axis_joints, assembly.size_m)


def _unit_of_each(robot: Robot, joints: Sequence[int], size_m: float) -> FloatArray:
    """The same of some joints, by their indices."""
    units: list[float] = []
    for joint in joints:
        if robot.joints[joint].kind is JointKind.REVOLUTE:
            units.append(1.0)
        else:
            units.append(size_m)
    return np.array(units)


def _condition(triangle: FloatArray) -> FloatArray:
    """Condition number ‖R‖ ‖R⁻¹‖ of a triangle in each sample, by the Frobenius norm, shape (k,).

    It is at least that by singular values, and needs none.
    """
    inverse = _solve_each(triangle, np.eye(triangle.shape[-1]))
    norm = np.linalg.norm(triangle, axis=(1, 2))
    inverse_norm = np.linalg.norm(inverse, axis=(1, 2))
    return np.asarray(norm * inverse_norm)


def _condition_of_motors(robot: Robot, assembly: Assembly, to_motors: FloatArray) -> FloatArray:
    """Condition of A in each sample, shape (k,):
    where it is large, motors hardly move some of the coordinates x.
    """
    if robot.axis_count == assembly.mobility:
        return np.ones(len(to_motors))
    units_of_x = _unit_of_each(robot, assembly.independent, assembly.size_m)
    units_of_motors = _units(robot, assembly)
    scaled = to_motors * units_of_x / units_of_motors[:, None]
    _, triangle = np.linalg.qr(scaled)
    return _condition(triangle)


def _at(robot: Robot, axes_rad: FloatArray) -> str:
    """Positions of the axes, for a message."""
    named: list[str] = []
    for joint, value in zip(robot.axes, axes_rad, strict=True):
        named.append(f"{joint.name} {value:.4g}")
    places = ", ".join(named)
    return f"{places} (rad or m)"


def reach(robot: Robot, assembly: Assembly, axes_rad: FloatArray) -> Reach:
    """Close the loops at positions of the motors' joints [rad or m], (k, m), as far as they do.

    First some coarse samples go from the assembly pose to their positions in small steps. Then
    finer and finer ones start between those that are closed already.
    """
    samples = len(axes_rad)
    if not robot.is_constrained:
        no_gap = np.zeros(samples)
        no_misfit = np.zeros(samples)
        return Reach(axes_rad, no_gap, no_misfit, condition=np.ones(samples))
    motors = list(robot.axis_joints)
    start = assembly.position_rad[motors]
    units = _units(robot, assembly)
    steps_of_samples = np.abs(np.diff(axes_rad, axis=0)) / units
    largest_step = float(np.max(steps_of_samples, initial=0.0))
    allowed_stride = int(STRIDE_RAD / max(largest_step, 1e-9))
    stride = min(LONGEST_STRIDE, max(1, allowed_stride))
    coarse = _every(stride, samples)
    goal = axes_rad[coarse]
    distances = np.abs(goal - start) / units
    farthest = np.max(distances, initial=0.0)
    steps = int(np.ceil(farthest / STEP_RAD))
    found = np.tile(assembly.position_rad, (len(coarse), 1))
    gap = np.zeros(len(coarse))
    condition = np.full(len(coarse), assembly.condition)
    for step in range(1, steps + 1):
        # On the way, motors of a redundant drive need not fit each other.
        waypoint = start + (goal - start) * (step / steps)
        is_on_the_way = step < steps
        found, gap, condition = _newton(robot, assembly, found, waypoint, on_the_way=is_on_the_way)
    while len(coarse) < samples:
        stride = max(1, stride // 8)
        finer = _every(stride, samples)
        if len(coarse) > 1:
            near = _between(coarse, found, finer)
        else:
            near = np.repeat(found, len(finer), axis=0)
        coarse = finer
        found, gap, condition = _newton(robot, assembly, near, axes_rad[finer])
    misfit = np.max(np.abs(found[:, motors] - axes_rad), axis=1)
    return Reach(found, gap, misfit, condition)


def _every(stride: int, samples: int) -> IntArray:
    """Indices of every so many of the samples, and of the last one."""
    indices = np.arange(0, samples, stride)
    return np.unique(np.append(indices, samples - 1))


def reach_near(
    robot: Robot, assembly: Assembly, near_rad: FloatArray, axes_rad: FloatArray
) -> FloatArray:
    """Close the loops from poses near by, as those with slightly other lengths or zeros.

    Args:
        robot: whose loops are closed.
        assembly: of this robot, or of the other one: which joints follow is the same.
        near_rad: positions of all joints, shape (k, n).
        axes_rad: of the motors' joints, shape (k, m).

    Returns:
        positions of all joints, shape (k, n).
    """
    position, _, _ = _newton(robot, assembly, near_rad, axes_rad)
    return position


def _newton(
    robot: Robot,
    assembly: Assembly,
    position: FloatArray,
    axes_rad: FloatArray,
    *,
    on_the_way: bool = False,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Close the loops at given positions of the motors' joints, from near by (Newton's method).

    A step is −J_d⁻¹ φ of the joints that follow. With a redundant drive, x moves as well, so that
    the motors' joints come as close to their positions as least squares allow (Gauss-Newton).

    Args:
        robot: with n joints and m motors.
        assembly: of the robot.
        position: of all joints, near the poses, shape (k, n).
        axes_rad: positions of the motors' joints, shape (k, m).
        on_the_way: to other positions, where it is enough to stay near the pose.

    Returns:
        positions, shape (k, n), gaps |φ| before the last step, and conditions of J_d, shape (k,).
    """
    largest_gap = CLOSED
    longest_step_rad = SETTLED_RAD
    if on_the_way:
        largest_gap = NEARLY_CLOSED
        longest_step_rad = NEARLY_SETTLED_RAD
    motors = list(robot.axis_joints)
    x = list(assembly.independent)
    dependent = list(assembly.dependent)
    position = position.copy()
    samples, count = position.shape
    is_redundant = len(motors) > len(x)
    if not is_redundant:
        position[:, motors] = axes_rad
    position = with_followers(robot, position)
    for _ in range(MAX_ITERATIONS):
        closing = loops(robot, position, assembly.size_m)
        gap = np.max(np.abs(closing.residual), axis=1)
        # −J_d⁻¹ [φ | J_x] = −R⁻¹ Qᵀ [φ | J_x]: the step that closes the loops, and G_d.
        q, r = np.linalg.qr(closing.jacobian[:, :, dependent])
        residual = closing.residual[:, :, None]
        jacobian_x = closing.jacobian[:, :, x]
        right = np.concatenate((residual, jacobian_x), axis=2)
        projected = np.swapaxes(q, 1, 2) @ right
        solution = -_solve_each(r, projected)
        change = np.zeros_like(position)
        change[:, dependent] = solution[:, :, 0]
        if is_redundant:
            to_joints = np.zeros((samples, count, len(x)))
            to_joints[:, x] = np.eye(len(x))
            to_joints[:, dependent] = solution[:, :, 1:]
            misfit = axes_rad - position[:, motors] - change[:, motors]
            change_x = _least_squares(to_joints[:, motors], misfit)
            change += np.einsum("knd,kd->kn", to_joints, change_x)  # G Δx
        step = np.max(np.abs(change), axis=1)
        # Where there is no pose, Newton's steps become longer and longer, or NaN: not "step >= …".
        is_lost = ~(step < LONGEST_STEP_RAD)
        change[is_lost] = 0.0
        position += change
        has_no_gap = gap < largest_gap
        has_settled = step < longest_step_rad
        is_closed = has_no_gap & has_settled
        if np.all(is_lost | is_closed):
            break
    return position, gap, _condition(r)


def _between(coarse: IntArray, found: FloatArray, finer: IntArray) -> FloatArray:
    """Positions between known samples by cubic Hermite splines, shape (len(finer), n).

    Between q_0 and q_1 with slopes q̇_0 and q̇_1 of central differences, at a distance l and with s
    from 0 to 1:

        q = (1 − s) q_0 + s q_1 + s (1 − s) ((1 − s) a + s b),
        a = l q̇_0 + (q_0 − q_1),    b = −l q̇_1 − (q_0 − q_1).

    Args:
        coarse: indices of the known samples.
        found: their positions, shape (len(coarse), n).
        finer: indices of the wanted samples.
    """
    slope = np.gradient(found, coarse, axis=0)
    left = np.searchsorted(coarse, finer, side="right") - 1
    left = np.clip(left, 0, len(coarse) - 2)
    right = left + 1
    length = (coarse[right] - coarse[left])[:, None]
    s = (finer - coarse[left])[:, None] / length
    first = found[left]
    second = found[right]
    difference = first - second
    a = slope[left] * length + difference
    b = -slope[right] * length - difference
    straight = (1 - s) * first + s * second
    bend = (1 - s) * a + s * b
    return np.asarray(straight + s * (1 - s) * bend)


def _solve_each(triangle: FloatArray, right: FloatArray) -> FloatArray:
    """Solution of R x = b in each sample; huge where R is singular."""
    diagonal = np.einsum("kii->ki", triangle)
    is_zero = np.abs(diagonal) <= np.finfo(np.float64).tiny
    if is_zero.any():
        triangle = triangle.copy()
        writable_diagonal = np.einsum("kii->ki", triangle)  # a view of the copy
        writable_diagonal[is_zero] = 1e-300
    shape = (len(triangle), *right.shape[-2:])
    solution = np.linalg.solve(triangle, np.broadcast_to(right, shape))
    return np.asarray(solution)


def _closed_near(robot: Robot, start: FloatArray, size_m: float) -> FloatArray:
    """Close the loops near a declared pose: with the motors where they are if that is possible.

    Raises:
        ModelError: they cannot be closed near it.
    """
    joints = list(range(robot.joint_count))
    passive = list(robot.passive_joints)
    residual = loops(robot, start[None], size_m).residual[0]
    if float(np.max(np.abs(residual))) < LARGEST_GAP:
        for moved in (passive, joints):
            position, gap = towards_closed(robot, start, size_m, moved)
            farthest = float(np.max(np.abs(position - start)))
            if gap < CLOSED and farthest < np.pi:  # less than half a turn
                return position
    closure, gaps = _worst_closure(robot, np.abs(residual))
    # A gap is a share of the robot's size where its direction is a length, else an angle.
    values = ", ".join(map(_gap, closure.directions, gaps * size_m, gaps))
    raise ModelError(
        f"closure {closure.name!r} cannot close at the assembly pose: {values} apart where it is "
        "declared; expected a pose of all joints at which the frames of every closure nearly "
        "coincide (assembly_deg, assembly_mm)"
    )


def towards_closed(
    robot: Robot, start: FloatArray, size_m: float, moved: Sequence[int]
) -> tuple[FloatArray, float]:
    """Close the loops by moving some joints, as far as Newton's iteration does: the position, (n,),
    and the gap that was left before the last step.
    """
    position = start.copy()
    for _ in range(MAX_ITERATIONS):
        closing = loops(robot, position[None], size_m)
        residual = closing.residual[0]
        gap = float(np.max(np.abs(residual)))
        if gap < CLOSED or not np.isfinite(gap):
            break
        jacobian = closing.jacobian[0][:, moved]
        # The shortest step that closes them, or nearly so
        step, *_ = np.linalg.lstsq(jacobian, residual, rcond=1e-8)
        position[moved] -= step
    return position, gap


def _worst_closure(robot: Robot, gaps: FloatArray) -> tuple[Closure, FloatArray]:
    """The closure with the largest gap, and its gaps in its directions."""
    ends = np.cumsum([len(closure.directions) for closure in robot.closures])
    parts = np.split(gaps, ends[:-1])
    largest = [float(part.max()) for part in parts]
    worst = int(np.argmax(largest))
    return robot.closures[worst], parts[worst]


def _gap(direction: str, length_m: float, angle_rad: float) -> str:
    """A gap in one direction, for a message."""
    if "r" in direction:
        return f"{direction} {np.degrees(angle_rad):.3g}°"
    return f"{direction} {1e3 * length_m:.3g} mm"


def _independent(free: FloatArray) -> tuple[int, ...]:
    """Joints that move most independently of each other, by pivoted QR of the free motions,
    shape (n, d).

    Each is the joint that moves most in the motions that are left when those of the joints before
    it are projected out (Gram-Schmidt).
    """
    remaining = free.copy()
    chosen: list[int] = []
    for _ in range(free.shape[1]):
        norms = np.linalg.norm(remaining, axis=1)
        joint = int(np.argmax(norms))
        direction = remaining[joint] / np.linalg.norm(remaining[joint])
        remaining -= np.outer(remaining @ direction, direction)
        chosen.append(joint)
    return tuple(sorted(chosen))


def null_space(matrix: FloatArray, smallest: float = SMALLEST_RANK) -> FloatArray:
    """Orthonormal directions that a matrix makes zero, shape (n, d).

    Of the closures' Jacobian, these are the motions of the joints that they leave free.

    Args:
        matrix: shape (r, n).
        smallest: singular value, relative to the largest, that is none.
    """
    _, values, directions = np.linalg.svd(matrix)
    rank = int(np.sum(values > smallest * values.max(initial=0.0)))
    return np.asarray(directions[rank:].T)


def _generic_rank(robot: Robot, position: FloatArray, free: FloatArray, size_m: float) -> int:
    """Degrees of freedom that the motors move a little away from the assembly pose.

    The rank is the largest of four poses at random: at a single one it may be singular again.
    """
    motors = list(robot.axis_joints)
    joints = range(robot.joint_count)
    rng = np.random.default_rng(0)
    best = 0
    for _ in range(4):
        near = position + 0.02 * free @ rng.standard_normal(free.shape[1])
        closed, _ = towards_closed(robot, near, size_m, joints)
        jacobian = loops(robot, closed[None], size_m).jacobian[0]
        driven = null_space(jacobian)[motors]
        rank = int(np.linalg.matrix_rank(driven, tol=1e-6))
        best = max(best, rank)
    return best


def _check(robot: Robot, start: FloatArray) -> None:
    """Refuse a closed chain that is described with contradictions.

    Raises:
        ModelError: of the assembly pose, the motors or a closure.
    """
    if start.shape != (robot.joint_count,):
        raise ModelError(
            f"the assembly pose has shape {start.shape}; expected a position of each joint"
        )
    if not robot.motors:
        raise ModelError(
            "a robot with closures or couplings needs the list of its motors' joints (`motors`); "
            "found none"
        )
    driven = sorted(set(robot.motors))
    if len(driven) < len(robot.motors):
        twice = [robot.joints[joint].name for joint in driven if robot.motors.count(joint) > 1]
        raise ModelError(
            f"two motors drive {', '.join(twice)}; expected a joint of its own for each (`motors`)"
        )
    for coupling in robot.couplings:
        if coupling.follower in robot.motors:
            name = robot.joints[coupling.follower].name
            leader = robot.joints[coupling.leader].name
            raise ModelError(
                f"joint {name!r} follows {leader!r} and has a motor; expected one or the other "
                "(`motors`)"
            )
    for joint, position in zip(robot.joints, start, strict=True):
        # Poses are reached from the assembly pose in small steps, so a turn too many costs time in
        # each of them.
        if joint.kind is JointKind.REVOLUTE and not abs(position) <= 2.0 * np.pi:
            raise ModelError(
                f"the assembly pose has {joint.name} at {np.degrees(position):.6g}°; expected "
                "-360° to 360° (assembly_deg): whole turns change no pose"
            )
    for closure in robot.closures:
        if not closure.directions:
            raise ModelError(
                f"closure {closure.name!r} holds no direction; expected some of x, y, z, rx, ry, rz"
            )


def _size(robot: Robot, position: FloatArray) -> float:
    """Largest distance of a joint, or of a frame that closes a loop, from the base."""
    placed = poses(robot, position[None])
    points = list(placed.origin_m[1:, 0])
    for closure in robot.closures:
        points.append(origin(placed, closure.first)[0])
        points.append(origin(placed, closure.second)[0])
    distances_m = np.linalg.norm(points, axis=1)
    return float(max(distances_m.max(), SMALLEST_SIZE_M))


def _least_squares(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solution of A x = b in each sample, shapes (k, m, d) and (k, m); exact for a square A."""
    return solve_qr(*np.linalg.qr(matrix), right)


def solve_qr(q: FloatArray, r: FloatArray, right: FloatArray) -> FloatArray:
    """Return R⁻¹ Qᵀ b in each sample, shape (k, d), with Q of (k, m, d) and b of (k, m)."""
    projected = np.einsum("kmd,km->kd", q, right)
    solution = np.linalg.solve(r, projected[..., None])
    return np.asarray(solution[..., 0])
