"""Motion of a closed chain: how the passive joints follow the motors.

Every loop is cut, so that a tree with n joints remains, and closed again by φ(q) = 0 (`ident.model.robot.Closure`).
With J = ∂φ/∂q, d = n − rank J coordinates x move independently, and

    q̇ = G ẋ,    J G = 0,    q̇_a = A ẋ,    q̈ = G q̈_x + h    with    J q̈ = −J̇ q̇.

x are d of the joints themselves, so that G is the identity in their rows and solves J_d G_d = −J_x in the others. With
as many motors as degrees of freedom (m = d), x are the motors' joints, and A = I. A robot without closures has G = A =
I. (Briot & Gautier, Multibody System Dynamics 2015, eqs. of the tree and its closure; Khalil & Dombre, Modeling,
Identification and Control of Robots, ch. 7.)

Rows of φ that are lengths are divided by the size of the robot: a condition number then compares like with like.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.arrays import BoolArray, FloatArray, IntArray
from ident.errors import ModelError
from ident.model.robot import Closure, JointKind, Motion, Place, Poses, Robot, poses

LARGEST_CONDITION = 500.0
"""Largest condition of J_d, the derivatives to the joints that follow; mechanisms stay below 30 in their workspace."""
CLOSED = 1e-12  #: |φ| at which Newton's iteration ends, in units of the robot's size or radians
SMALLEST_RANK = 1e-7  #: Singular value of J, relative to the largest, that counts as zero
LARGEST_GAP = 0.3  #: |φ| at the declared assembly pose, in units of the robot's size or radians
LONGEST_STRIDE = 64
"""At most every so manyth sample is reached from the assembly pose; the others start from their neighbours."""
STRIDE_RAD = 0.25  #: Largest motion between two such samples [rad, or m divided by the robot's size]
STEP_RAD = 0.15  #: Longest step on that way [rad, or m divided by the robot's size]
LONGEST_STEP_RAD = 1.5  #: Longer steps of Newton lead to another pose, or nowhere
MAX_ITERATIONS = 30

_AFTER = {"x": "y", "y": "z", "z": "x"}
_INDEX = {"x": 0, "y": 1, "z": 2}


@dataclass(frozen=True, slots=True, eq=False)
class Assembly:
    """Joints of a robot that its closures leave free, and those that follow, found at its assembly pose."""

    position_rad: FloatArray  #: of all joints, closed exactly, shape (n,)
    independent: tuple[int, ...]  #: joints that are x, d of them
    dependent: tuple[int, ...]  #: the other joints, which follow
    size_m: float  #: largest distance of two frames that close a loop from the base, at least of two joints
    condition: float  #: of J_d there

    @property
    def mobility(self) -> int:
        """d."""
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
        robot: with closures; a robot without any has n independent joints.
        mobility: d as its maker declares it; not checked when None.

    Raises:
        ModelError: a closure names no direction or cannot close there, the mobility is another one, the motors do not
            move every degree of freedom, or the pose is singular.
    """
    count = robot.joint_count
    everything = tuple(range(count))
    start = np.zeros(count) if robot.assembly_rad is None else np.asarray(robot.assembly_rad, dtype=np.float64)
    if not robot.closures:
        return Assembly(start, everything, (), _size(robot, start), 1.0)
    _check(robot, start)
    size_m = _size(robot, start)
    position = _closed_near(robot, start, size_m)
    jacobian = _loops(robot, position[None], size_m).jacobian[0]
    free = _null_space(jacobian)
    found = free.shape[1]
    if mobility is not None and found != mobility:
        raise ModelError(
            f"the closures leave {found} degrees of freedom at the assembly pose; expected {mobility} as declared: "
            "is a closure missing, or does one hold a direction that must be free (`directions`)?"
        )
    motors = list(robot.axis_joints)
    driven = free[motors]
    names = ", ".join(robot.joints[joint].name for joint in motors)
    if len(motors) < found or np.linalg.matrix_rank(driven, tol=1e-6) < found:
        if len(motors) >= found and _generic_rank(robot, position, free, size_m) == found:
            raise ModelError(
                f"the robot is singular at the assembly pose: there the motors {names} do not move all of its {found} "
                "degrees of freedom, beside it they do; give an assembly pose inside the workspace"
            )
        raise ModelError(
            f"the motors {names} do not move all {found} degrees of freedom that the closures leave; name a joint that "
            "each motor drives, one for each degree of freedom at least (`motors`)"
        )
    independent = tuple(motors) if len(motors) == found else _independent(free)
    dependent = tuple(joint for joint in everything if joint not in independent)
    condition = float(np.linalg.cond(jacobian[:, dependent])) if dependent else 1.0
    if condition > LARGEST_CONDITION:
        raise ModelError(
            f"the assembly pose is close to a singularity: condition {condition:.3g} of the closures; expected below "
            f"{LARGEST_CONDITION:g}: give a pose inside the workspace"
        )
    return Assembly(position, independent, dependent, size_m, condition)


def follow(robot: Robot, assembly: Assembly, axes: Motion) -> TreeMotion:
    """Let all joints follow the motors' joints.

    Of the several poses that belong to a position of the motors, it is the one that is reached from the assembly pose
    by moving them there in a straight line: a function of the position alone, whatever was asked before.

    Args:
        robot: with n joints and m motors.
        assembly: of the robot.
        axes: motion of the motors' joints, arrays of shape (k, m). Of a redundantly driven robot (m > d) the pose that
            fits them best.

    Raises:
        ModelError: the loops cannot be closed at a position, or it is close to a singularity, where small errors of
            position are large forces.
    """
    motors, x, rest = list(robot.axis_joints), list(assembly.independent), list(assembly.dependent)
    measured = np.asarray(axes.position_rad, dtype=np.float64)
    samples, count, d = len(measured), robot.joint_count, len(x)
    if not robot.closures:
        one = np.broadcast_to(np.eye(count), (samples, count, count))
        return TreeMotion(axes, one, one, np.ones(samples))
    position = positions(robot, assembly, measured)
    loops = _loops(robot, position, assembly.size_m)
    q, r = np.linalg.qr(loops.jacobian[:, :, rest])
    to_joints = np.zeros((samples, count, d))
    to_joints[:, x] = np.eye(d)
    to_joints[:, rest] = -np.linalg.solve(r, np.swapaxes(q, 1, 2) @ loops.jacobian[:, :, x])
    to_motors = to_joints[:, motors]
    speed_x = _least_squares(to_motors, np.asarray(axes.velocity_rad_s))
    velocity = np.einsum("knd,kd->kn", to_joints, speed_x)
    bias = np.zeros((samples, count))
    turning = _loops(robot, position, assembly.size_m, velocity).bias
    bias[:, rest] = -np.linalg.solve(r, np.einsum("kcr,kc->kr", q, turning)[..., None])[..., 0]
    acceleration_x = _least_squares(to_motors, np.asarray(axes.acceleration_rad_s2) - bias[:, motors])
    acceleration = np.einsum("knd,kd->kn", to_joints, acceleration_x) + bias
    condition = np.linalg.norm(r, axis=(1, 2)) * np.linalg.norm(_solve_each(r, np.eye(len(rest))), axis=(1, 2))
    worst = int(np.argmax(condition))
    if condition[worst] > LARGEST_CONDITION:
        raise ModelError(
            f"the motion comes close to a singularity at {_at(robot, measured[worst])}: condition "
            f"{condition[worst]:.3g} of the closures; expected below {LARGEST_CONDITION:g}: record moves away from it"
        )
    return TreeMotion(Motion(position, velocity, acceleration), to_joints, to_motors, condition)


@dataclass(frozen=True, slots=True, eq=False)
class Reach:
    """Poses that belong to positions of the motors' joints, where there are any."""

    position_rad: FloatArray  #: of all joints; where the loops do not close, of some pose near by, shape (k, n)
    gap: FloatArray  #: |φ| that is left, in units of the robot's size or radians, shape (k,)
    #: Largest difference between a motor's position and that of its joint [rad or m], shape (k,): not zero where motors
    #: of a redundant drive do not fit each other.
    misfit: FloatArray
    condition: FloatArray  #: of J_d by the Frobenius norm, shape (k,)

    @property
    def closed(self) -> BoolArray:
        """Where the loops close, shape (k,)."""
        return self.gap < CLOSED


def positions(robot: Robot, assembly: Assembly, axes_rad: FloatArray) -> FloatArray:
    """Positions of all joints, shape (k, n), of those of the motors' joints, shape (k, m); see `follow`.

    Raises:
        ModelError: the loops cannot be closed at a position.
    """
    found = reach(robot, assembly, axes_rad)
    if not found.closed.all():
        worst = int(np.argmax(found.gap))
        raise ModelError(
            f"the loops cannot be closed at {_at(robot, axes_rad[worst])}: {found.gap[worst]:.2g} of the robot's size "
            "is left open; expected positions inside the workspace: are signs, zeros and units of the axes right?"
        )
    return found.position_rad


def _at(robot: Robot, axes_rad: FloatArray) -> str:
    named = zip(robot.axes, axes_rad, strict=True)
    return ", ".join(f"{joint.name} {value:.4g}" for joint, value in named) + " (rad or m)"


def reach(robot: Robot, assembly: Assembly, axes_rad: FloatArray) -> Reach:
    """Close the loops at positions of the motors' joints, shape (k, m), as far as they close; see `follow`."""
    samples, motors = len(axes_rad), list(robot.axis_joints)
    if not robot.closures:
        return Reach(axes_rad, np.zeros(samples), np.zeros(samples), np.ones(samples))
    start = assembly.position_rad[motors]
    units = np.array([1.0 if joint.kind is JointKind.REVOLUTE else assembly.size_m for joint in robot.axes])
    largest = float(np.max(np.abs(np.diff(axes_rad, axis=0)) / units, initial=0.0))
    stride = min(LONGEST_STRIDE, max(1, int(STRIDE_RAD / max(largest, 1e-9))))
    coarse = np.unique(np.append(np.arange(0, samples, stride), samples - 1))
    steps = int(np.ceil(np.max(np.abs(axes_rad[coarse] - start) / units, initial=0.0) / STEP_RAD))
    found = np.tile(assembly.position_rad, (len(coarse), 1))
    gap, condition = np.zeros(len(coarse)), np.full(len(coarse), assembly.condition)
    for step in range(1, steps + 1):
        # On the way, motors of a redundant drive need not fit each other.
        way = start + (axes_rad[coarse] - start) * (step / steps)
        found, gap, condition = _newton(robot, assembly, found, way, 1e-9 if step == steps else 1e-3)
    while len(coarse) < samples:
        stride = max(1, stride // 8)
        finer = np.unique(np.append(np.arange(0, samples, stride), samples - 1))
        near = _between(coarse, found, finer) if len(coarse) > 1 else np.repeat(found, len(finer), axis=0)
        coarse = finer
        found, gap, condition = _newton(robot, assembly, near, axes_rad[finer])
    return Reach(found, gap, np.max(np.abs(found[:, motors] - axes_rad), axis=1), condition)


def _newton(
    robot: Robot, assembly: Assembly, position: FloatArray, axes_rad: FloatArray, tolerance_rad: float = 1e-9
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Close the loops at given positions of the motors' joints, from near by: positions, gaps and conditions."""
    motors, x, rest = list(robot.axis_joints), list(assembly.independent), list(assembly.dependent)
    position = position.copy()
    redundant = len(motors) > len(x)
    if not redundant:
        position[:, motors] = axes_rad
    for _ in range(MAX_ITERATIONS):
        loops = _loops(robot, position, assembly.size_m)
        gap = np.max(np.abs(loops.residual), axis=1)
        q, r = np.linalg.qr(loops.jacobian[:, :, rest])
        wanted = np.concatenate((loops.residual[:, :, None], loops.jacobian[:, :, x]), axis=2)
        answer = -_solve_each(r, np.swapaxes(q, 1, 2) @ wanted)
        change = np.zeros_like(position)
        change[:, rest] = answer[:, :, 0]
        if redundant:
            to_joints = np.zeros((len(position), position.shape[1], len(x)))
            to_joints[:, x], to_joints[:, rest] = np.eye(len(x)), answer[:, :, 1:]
            left = axes_rad - position[:, motors] - change[:, motors]
            change += np.einsum("knd,kd->kn", to_joints, _least_squares(to_joints[:, motors], left))
        step = np.max(np.abs(change), axis=1)
        lost = ~(step < LONGEST_STEP_RAD)  # where there is no pose, Newton's steps become longer and longer
        change[lost] = 0.0
        position += change
        if np.all(lost | ((gap < CLOSED) & (step < tolerance_rad))):
            break
    condition = np.linalg.norm(r, axis=(1, 2)) * np.linalg.norm(_solve_each(r, np.eye(len(rest))), axis=(1, 2))
    return position, gap, condition


def _between(coarse: IntArray, found: FloatArray, finer: IntArray) -> FloatArray:
    """Positions between known samples, shape (len(finer), n): cubic polynomials with the slopes of differences."""
    slope = np.gradient(found, coarse, axis=0)
    before = np.clip(np.searchsorted(coarse, finer, side="right") - 1, 0, len(coarse) - 2)
    length = (coarse[before + 1] - coarse[before])[:, None]
    s = (finer - coarse[before])[:, None] / length
    first, second = found[before], found[before + 1]
    bend = first - second
    a, b = slope[before] * length + bend, -slope[before + 1] * length - bend
    return np.asarray((1 - s) * first + s * second + s * (1 - s) * ((1 - s) * a + s * b))


def _solve_each(triangle: FloatArray, right: FloatArray) -> FloatArray:
    """Solution of R x = b in each sample; huge where R is singular."""
    diagonal = np.einsum("kii->ki", triangle)
    tiny = np.finfo(np.float64).tiny
    if not np.all(np.abs(diagonal) > tiny):
        triangle = triangle.copy()
        np.einsum("kii->ki", triangle)[np.abs(diagonal) <= tiny] = 1e-300
    return np.asarray(np.linalg.solve(triangle, np.broadcast_to(right, (len(triangle), *right.shape[-2:]))))


def _closed_near(robot: Robot, start: FloatArray, size_m: float) -> FloatArray:
    """Close the loops near a declared pose: with the motors where they are if that is possible."""
    motors = list(robot.axis_joints)
    rest = [joint for joint in range(robot.joint_count) if joint not in motors]
    declared = float(np.max(np.abs(_loops(robot, start[None], size_m).residual)))
    for moved in (rest, list(range(robot.joint_count))) if declared < LARGEST_GAP else ():
        position = start.copy()
        for _ in range(MAX_ITERATIONS):
            loops = _loops(robot, position[None], size_m)
            gap = float(np.max(np.abs(loops.residual)))
            if gap < CLOSED or not np.isfinite(gap):
                break
            position[moved] -= np.linalg.lstsq(loops.jacobian[0][:, moved], loops.residual[0], rcond=1e-8)[0]
        if gap < CLOSED and float(np.max(np.abs(position - start))) < np.pi:
            return position
    loops = _loops(robot, start[None], size_m)
    ends = np.cumsum([len(closure.directions) for closure in robot.closures])
    parts = np.split(np.abs(loops.residual[0]), ends[:-1])
    worst = max(zip(robot.closures, parts, strict=True), key=lambda pair: float(pair[1].max()))
    name, values = worst[0].name, ", ".join(map(_gap, worst[0].directions, worst[1] * size_m, worst[1]))
    raise ModelError(
        f"closure {name!r} cannot close at the assembly pose: {values} apart where it is declared; expected a pose of "
        "all joints at which the frames of every closure nearly coincide (assembly_deg, assembly_mm)"
    )


def _gap(direction: str, length_m: float, angle_rad: float) -> str:
    return f"{direction} {np.degrees(angle_rad):.3g}°" if "r" in direction else f"{direction} {1e3 * length_m:.3g} mm"


def _independent(free: FloatArray) -> tuple[int, ...]:
    """Joints that move most independently of each other, by pivoted QR of the free motions, shape (n, d)."""
    left, chosen = free.copy(), list[int]()
    for _ in range(free.shape[1]):
        joint = int(np.argmax(np.linalg.norm(left, axis=1)))
        way = left[joint] / np.linalg.norm(left[joint])
        left -= np.outer(left @ way, way)
        chosen.append(joint)
    return tuple(sorted(chosen))


def _null_space(jacobian: FloatArray) -> FloatArray:
    """Motions of the joints that the closures leave free, shape (n, d)."""
    _, values, ways = np.linalg.svd(jacobian)
    rank = int(np.sum(values > SMALLEST_RANK * values.max(initial=0.0)))
    return np.asarray(ways[rank:].T)


def _generic_rank(robot: Robot, position: FloatArray, free: FloatArray, size_m: float) -> int:
    """Degrees of freedom that the motors move a little beside the assembly pose."""
    draw = np.random.default_rng(0)
    best = 0
    for _ in range(4):
        beside = position + 0.02 * free @ draw.standard_normal(free.shape[1])
        for _ in range(MAX_ITERATIONS):
            loops = _loops(robot, beside[None], size_m)
            beside -= np.linalg.lstsq(loops.jacobian[0], loops.residual[0], rcond=1e-8)[0]
        moved = _null_space(_loops(robot, beside[None], size_m).jacobian[0])
        best = max(best, int(np.linalg.matrix_rank(moved[list(robot.axis_joints)], tol=1e-6)))
    return best


def _check(robot: Robot, start: FloatArray) -> None:
    if start.shape != (robot.joint_count,):
        raise ModelError(f"the assembly pose has shape {start.shape}; expected a position of each joint")
    if not robot.motors:
        raise ModelError("a robot with closures needs the list of its motors' joints (`motors`); found none")
    if len(set(robot.motors)) < len(robot.motors):
        raise ModelError("two motors drive the same joint; expected a joint of its own for each (`motors`)")
    for closure in robot.closures:
        if not closure.directions:
            raise ModelError(f"closure {closure.name!r} holds no direction; expected some of x, y, z, rx, ry, rz")


def _size(robot: Robot, position: FloatArray) -> float:
    """Largest distance of a joint, or of a frame that closes a loop, from the base."""
    placed = poses(robot, position[None])
    points = [*placed.origin_m[1:, 0]]
    for closure in robot.closures:
        points += [_origin(placed, place)[0] for place in (closure.first, closure.second)]
    return float(max(np.linalg.norm(points, axis=1).max(), 1e-3))


def _least_squares(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solution of A x = b, shapes (k, m, d) and (k, m); for square A exact."""
    q, r = np.linalg.qr(matrix)
    return np.asarray(np.linalg.solve(r, np.einsum("kmd,km->kd", q, right)[..., None])[..., 0])


@dataclass(frozen=True, slots=True, eq=False)
class _Loops:
    """φ, J and J̇ q̇ of all closures over k samples."""

    residual: FloatArray  #: shape (k, c)
    jacobian: FloatArray  #: shape (k, c, n)
    bias: FloatArray  #: shape (k, c); empty without a velocity


def closure_equations(
    robot: Robot, position: FloatArray, velocity: FloatArray | None = None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """φ, J and J̇ q̇ of all closures, in units of 1 m, shapes (k, c), (k, c, n) and (k, c).

    Args:
        robot: with closures.
        position, velocity: of all joints, shape (k, n); J̇ q̇ is empty without velocities.
    """
    loops = _loops(robot, position, 1.0, velocity)
    return loops.residual, loops.jacobian, loops.bias


def _loops(robot: Robot, position: FloatArray, size_m: float, velocity: FloatArray | None = None) -> _Loops:
    placed, samples = poses(robot, position), len(position)
    axes = [placed.rotation[i + 1] @ joint.axis for i, joint in enumerate(robot.joints)]
    moved = None if velocity is None else _spin(robot, placed, axes, position, velocity)
    width = sum(len(closure.directions) for closure in robot.closures)
    residual = np.empty((samples, width))
    jacobian = np.empty((samples, width, robot.joint_count))
    bias = np.empty((samples, width if moved is not None else 0))
    first = 0
    for closure in robot.closures:
        part = slice(first, first + len(closure.directions))
        residual[:, part], jacobian[:, part], turning = _closure(robot, closure, placed, axes, moved)
        if moved is not None:
            bias[:, part] = turning
        lengths = [first + row for row, one in enumerate(closure.directions) if "r" not in one]
        for array in (residual, jacobian, bias) if moved is not None else (residual, jacobian):
            array[:, lengths] /= size_m
        first = part.stop
    return _Loops(residual, jacobian, bias)


@dataclass(frozen=True, slots=True, eq=False)
class _Spin:
    """Motion of every link with all joint accelerations zero; arrays of shape (n + 1, k, 3), in the base frame."""

    angular: FloatArray  #: ω
    linear: FloatArray  #: velocity of the frame's origin
    angular_bias: FloatArray  #: its angular acceleration
    linear_bias: FloatArray  #: its origin's acceleration


def _spin(robot: Robot, placed: Poses, axes: list[FloatArray], position: FloatArray, velocity: FloatArray) -> _Spin:
    shape = (robot.joint_count + 1, len(position), 3)
    w, v, dw, dv = (np.zeros(shape) for _ in range(4))
    for index, joint in enumerate(robot.joints):
        p, i = joint.parent + 1, index + 1
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


_AHEAD, _BEHIND = np.array([1, 2, 0]), np.array([2, 0, 1])


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products of vectors, shape (…, 3); without the checks of numpy's, which take longer than the products."""
    return np.asarray(a[..., _AHEAD] * b[..., _BEHIND] - a[..., _BEHIND] * b[..., _AHEAD])


def _cross_columns(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products of columns, shape (k, 3, n), with a vector of each sample, shape (k, 3)."""
    b = b[:, :, None]
    return np.asarray(a[:, _AHEAD] * b[:, _BEHIND] - a[:, _BEHIND] * b[:, _AHEAD])


def _origin(placed: Poses, place: Place) -> FloatArray:
    at = place.joint + 1
    return np.asarray(placed.origin_m[at] + placed.rotation[at] @ place.translation_m)


def _columns(robot: Robot, placed: Poses, axes: list[FloatArray], place: Place) -> tuple[FloatArray, FloatArray]:
    """Velocity of a frame's origin, and its angular velocity, per unit of each joint's: shapes (k, 3, n)."""
    point = _origin(placed, place)
    linear, angular = (np.zeros((len(point), 3, robot.joint_count)) for _ in range(2))
    joint = place.joint
    while joint >= 0:
        if robot.joints[joint].kind is JointKind.REVOLUTE:
            angular[:, :, joint] = axes[joint]
            linear[:, :, joint] = _cross(axes[joint], point - placed.origin_m[joint + 1])
        else:
            linear[:, :, joint] = axes[joint]
        joint = robot.joints[joint].parent
    return linear, angular


def _closure(
    robot: Robot, closure: Closure, placed: Poses, axes: list[FloatArray], moved: _Spin | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """φ, J and J̇ q̇ of one closure, in m and rad.

    Lengths are Rᵀ(p₂ − p₁) in the first frame. Angles are entries of E = R₁ᵀR₂ that are zero where the frames are
    parallel and that change by the angle: the second frame's axis b along the first one's c, for a turn about a, with
    (a, b, c) cyclic. Where the frames may turn about one axis, it is that axis of the second frame that must be
    parallel to the first one's: this holds at every angle.
    """
    first, second = closure.first, closure.second
    frame = placed.rotation[first.joint + 1] @ first.rotation
    other = placed.rotation[second.joint + 1] @ second.rotation
    apart = _origin(placed, second) - _origin(placed, first)
    turned = np.swapaxes(frame, 1, 2)
    (v1, w1), (v2, w2) = (_columns(robot, placed, axes, place) for place in (first, second))
    residual, jacobian, bias = [], [], []
    gap = np.einsum("kij,kj->ki", turned, apart)
    lengths = turned @ (v2 - v1 - _cross_columns(w1, apart))
    turning = turned @ (w2 - w1)
    parallel = np.swapaxes(frame, 1, 2) @ other
    if moved is not None:
        motion = [_place_motion(moved, placed, place) for place in (first, second)]
        (u1, o1, du1, do1), (u2, o2, du2, do2) = motion
        rate = u2 - u1
        drift = du2 - du1 - _cross(do1, apart) - 2.0 * _cross(o1, rate) + _cross(o1, _cross(o1, apart))
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
        column, unit = parallel[:, :, axis], np.eye(3)[along]
        residual.append(column[:, along])
        lever = _cross(column, unit)
        jacobian.append(np.einsum("ki,kin->kn", lever, turning))
        if moved is not None:
            swung = _cross(_cross(spin, column), unit)
            bias.append(np.einsum("ki,ki->k", spin_bias, lever) + np.einsum("ki,ki->k", spin, swung))
    return np.stack(residual, 1), np.stack(jacobian, 1), np.stack(bias, 1) if bias else np.empty((len(apart), 0))


def _parallel_axes(directions: tuple[str, ...], about: str) -> tuple[int, int]:
    """Entry of E = R₁ᵀR₂ that must be zero so that the frames do not turn about an axis."""
    following = _AFTER[about]
    last = _AFTER[following]
    if sum(direction in directions for direction in ("rx", "ry", "rz")) == 2:
        free = next(axis for axis in "xyz" if f"r{axis}" not in directions)
        return _INDEX[following if last == free else last], _INDEX[free]
    return _INDEX[last], _INDEX[following]


def _place_motion(moved: _Spin, placed: Poses, place: Place) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Velocity of a frame's origin, its angular velocity, and both accelerations without joint accelerations."""
    at = place.joint + 1
    arm = placed.rotation[at] @ place.translation_m
    w, dw = moved.angular[at], moved.angular_bias[at]
    linear = moved.linear[at] + _cross(w, arm)
    return linear, w, moved.linear_bias[at] + _cross(dw, arm) + _cross(w, _cross(w, arm)), dw
