"""Loop closures of a simulated plant: what keeps the tree of a URDF together as a closed chain.

A closure says that two frames of the tree coincide in some directions of the first. With R₁, p₁ and R₂, p₂ of the two
frames in the base and R = R₁ᵀ R₂,

    φ = (R₁ᵀ (p₂ − p₁),  ½ vee(R − Rᵀ)) in the chosen directions,     J_c = ∂φ/∂q,

so that a closure of two rotations leaves the third free below 180°. J_c has rank r, also where closures are
redundant (the parallelograms of an Orthoglide hold its platform twice). Elimination with full pivots splits the joints
into r dependent and d = n − r independent ones: J_c G = 0 with G the identity in the independent rows, and Newton's
method on the dependent joints alone returns positions to φ = 0 (coordinate partitioning, Wehage and Haug 1982).

Joints are in the order of the plant: those of the motors first, in the order of the axes, then the passive ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from drivers.simulation.dynamics import compiled
from drivers.simulation.spec import DIRECTIONS, CellSpec, FloatArray, SpecInvalid

CLOSED = 1e-12  #: Largest |φ| [m or rad] at which Newton's method stops

OPEN = 1e-10  #: Largest |φ| [m or rad] that the plant accepts at the end of a step

SINGULAR = 1e-7  #: Smallest pivot of the closures over the largest; below it the mechanism is in a singular pose

MAX_NEWTON = 8  #: Newton steps after one step of the plant; two are usual

ASSEMBLY_NEWTON = 200  #: Newton steps from a rough assembly

ASSEMBLY_STEP = 0.2  #: Largest change of a joint in one of them [rad or m]

ASSEMBLY_LEAPS = 50  #: Poses on the way from the assembly to the start

START_TOLERANCE = 1e-3  #: Largest correction of a start position of redundant drives [rad or m]


class Tree(NamedTuple):
    """Geometry of n joints and k closures."""

    parent: NDArray[np.int64]  #: joint before each joint, -1 for the base, shape (n,)
    outwards: NDArray[np.int64]  #: the joints, each after its parent, shape (n,)
    rotation: FloatArray  #: placement of each joint in the frame of its parent, shape (n, 3, 3)
    offset: FloatArray  #: the same, its origin [m], shape (n, 3)
    axis: FloatArray  #: unit vector of each joint in its own frame, shape (n, 3)
    sliding: NDArray[np.bool_]  #: whether each joint is prismatic, shape (n,)
    frame_joint: NDArray[np.int64]  #: joint that moves each frame, -1 for the base, shape (k, 2)
    frame_rotation: FloatArray  #: placement of each frame in that joint's, shape (k, 2, 3, 3)
    frame_offset: FloatArray  #: the same, its origin [m], shape (k, 2, 3)
    closed: NDArray[np.bool_]  #: whether each of x, y, z, rx, ry, rz of the first frame is closed, shape (k, 6)
    first_row: NDArray[np.int64]  #: of each closure among the c closed directions, and c, shape (k + 1,)


@compiled
def evaluate(constants: tuple[Any, ...], position: FloatArray, error: FloatArray, jacobian: FloatArray) -> None:
    """Compute φ, shape (c,), and J_c, shape (c, n), in place at the first n positions."""
    tree = Tree(*constants)
    n = len(tree.parent)
    rotation, origin, axis = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, 3))
    for i in tree.outwards:
        _place_joint(tree, i, position[i], rotation, origin, axis)
    r, p, spin = np.empty((2, 3, 3)), np.empty((2, 3)), np.empty((3, 3))
    jacobian[:] = 0.0
    arm = np.empty(3)
    for k in range(len(tree.closed)):
        row = tree.first_row[k]
        for side in range(2):
            _place_frame(tree, k, side, rotation, origin, r, p)
        _close(tree.closed[k], row, r, p, error, spin)
        for side in range(2):
            j = tree.frame_joint[k, side]
            while j >= 0:
                # Seen from the first frame, so that its own turning moves the second frame's origin as well.
                for a in range(3):
                    arm[a] = p[1, a] - origin[j, a]
                _add_joint(tree.closed[k], row, side, tree.sliding[j], axis[j], arm, r, spin, jacobian[:, j])
                j = tree.parent[j]


@compiled
def _close(
    closed: NDArray[np.bool_], row: int, r: FloatArray, p: FloatArray, error: FloatArray, spin: FloatArray
) -> None:
    """Fill φ of one closure from a row on.

    With Ṙ = [ω] R the second part of φ changes by ½ (tr(R) I − R) ω, ω in the first frame: `spin`, output.
    """
    turn = np.zeros((3, 3))
    for a in range(3):
        for b in range(3):
            for e in range(3):
                turn[a, b] += r[0, e, a] * r[1, e, b]
    trace = turn[0, 0] + turn[1, 1] + turn[2, 2]
    for a in range(3):
        for b in range(3):
            spin[a, b] = 0.5 * ((trace if a == b else 0.0) - turn[a, b])
        if closed[a]:
            error[row] = 0.0
            for b in range(3):
                error[row] += r[0, b, a] * (p[1, b] - p[0, b])
            row += 1
    for a in range(3):
        if closed[3 + a]:
            b, c = (a + 1) % 3, (a + 2) % 3
            error[row] = 0.5 * (turn[c, b] - turn[b, c])
            row += 1


@compiled
def _add_joint(
    closed: NDArray[np.bool_],
    row: int,
    side: int,
    sliding: bool,
    axis: FloatArray,
    arm: FloatArray,
    r: FloatArray,
    spin: FloatArray,
    column: FloatArray,
) -> None:
    """Add what a joint before one frame of a closure does, from a row on of its column of J_c.

    Args:
        closed: directions of the closure, shape (6,).
        row: first row of the closure.
        side: 0 for the first frame, 1 for the second.
        sliding: whether the joint is prismatic.
        axis: of the joint in the base, shape (3,).
        arm: from the joint to the second frame, shape (3,).
        r, spin: of the closure.
        column: changed in place, shape (c,).
    """
    sign = 1.0 if side == 1 else -1.0
    x, y, z = axis[0], axis[1], axis[2]
    u, v, w = arm[0], arm[1], arm[2]
    if sliding:
        u, v, w, x, y, z = x, y, z, 0.0, 0.0, 0.0
    else:
        u, v, w = y * w - z * v, z * u - x * w, x * v - y * u
    angular = np.empty(3)
    for a in range(3):
        angular[a] = r[0, 0, a] * x + r[0, 1, a] * y + r[0, 2, a] * z
        if closed[a]:
            column[row] += sign * (r[0, 0, a] * u + r[0, 1, a] * v + r[0, 2, a] * w)
            row += 1
    for a in range(3):
        if closed[3 + a]:
            column[row] += sign * (spin[a, 0] * angular[0] + spin[a, 1] * angular[1] + spin[a, 2] * angular[2])
            row += 1


@compiled
def _place_joint(
    tree: Tree, i: int, position: float, rotation: FloatArray, origin: FloatArray, axis: FloatArray
) -> None:
    """Place joint i in the base behind its parent: rotation, origin and axis, each indexed by the joint."""
    parent = tree.parent[i]
    x, y, z = tree.axis[i, 0], tree.axis[i, 1], tree.axis[i, 2]
    s, c = 0.0, 1.0
    if not tree.sliding[i]:
        s, c = np.sin(position), np.cos(position)
    own = np.empty((3, 3))
    own[0, 0], own[0, 1], own[0, 2] = c + x * x * (1 - c), x * y * (1 - c) - z * s, x * z * (1 - c) + y * s
    own[1, 0], own[1, 1], own[1, 2] = x * y * (1 - c) + z * s, c + y * y * (1 - c), y * z * (1 - c) - x * s
    own[2, 0], own[2, 1], own[2, 2] = x * z * (1 - c) - y * s, y * z * (1 - c) + x * s, c + z * z * (1 - c)
    placed = np.zeros((3, 3))
    for a in range(3):
        if parent < 0:
            origin[i, a] = tree.offset[i, a]
            for e in range(3):
                placed[a, e] = tree.rotation[i, a, e]
        else:
            origin[i, a] = origin[parent, a]
            for b in range(3):
                origin[i, a] += rotation[parent, a, b] * tree.offset[i, b]
                for e in range(3):
                    placed[a, e] += rotation[parent, a, b] * tree.rotation[i, b, e]
    for a in range(3):
        axis[i, a] = placed[a, 0] * x + placed[a, 1] * y + placed[a, 2] * z
        if tree.sliding[i]:
            origin[i, a] += position * axis[i, a]
        for e in range(3):
            rotation[i, a, e] = placed[a, 0] * own[0, e] + placed[a, 1] * own[1, e] + placed[a, 2] * own[2, e]


@compiled
def _place_frame(
    tree: Tree, k: int, side: int, rotation: FloatArray, origin: FloatArray, r: FloatArray, p: FloatArray
) -> None:
    """Place one frame of closure k in the base: r[side] and p[side]."""
    joint = tree.frame_joint[k, side]
    for a in range(3):
        p[side, a] = tree.frame_offset[k, side, a] if joint < 0 else origin[joint, a]
        for b in range(3):
            if joint < 0:
                r[side, a, b] = tree.frame_rotation[k, side, a, b]
                continue
            p[side, a] += rotation[joint, a, b] * tree.frame_offset[k, side, b]
            r[side, a, b] = 0.0
            for e in range(3):
                r[side, a, b] += rotation[joint, a, e] * tree.frame_rotation[k, side, e, b]


@compiled
def eliminate(matrix: FloatArray, rank: int, held: NDArray[np.bool_], pivots: NDArray[np.int64]) -> float:
    """Reduce [J_c | φ], shape (c, n + 1), in place by Gauss-Jordan steps with full pivots.

    Args:
        matrix: afterwards row i of the first `rank` has 1 in the column of pivot i, where all other rows have 0.
        rank: number of pivots, r.
        held: joints that become dependent only where no other can, shape (n,).
        pivots: column of each pivot, shape (r,), output.

    Returns:
        the smallest pivot over the largest.
    """
    n = matrix.shape[1] - 1
    used, barred = np.zeros(n, dtype=np.bool_), np.empty(n, dtype=np.bool_)
    largest, smallest = 0.0, np.inf
    for i in range(rank):
        for j in range(n):
            barred[j] = used[j] or held[j]
        best, at_row, column = _find_pivot(matrix, i, barred)
        if not best > SINGULAR * largest:
            best, at_row, column = _find_pivot(matrix, i, used)
        if not best > 0.0:
            return 0.0
        largest, smallest = max(largest, best), min(smallest, best)
        used[column] = True
        pivots[i] = column
        for j in range(n + 1):
            matrix[i, j], matrix[at_row, j] = matrix[at_row, j], matrix[i, j]
        pivot = matrix[i, column]
        for j in range(n + 1):
            matrix[i, j] /= pivot
        for k in range(len(matrix)):
            factor = matrix[k, column]
            if k != i and factor != 0.0:
                for j in range(n + 1):
                    matrix[k, j] -= factor * matrix[i, j]
    return smallest / largest if rank > 0 else 1.0


@compiled
def _find_pivot(matrix: FloatArray, first: int, barred: NDArray[np.bool_]) -> tuple[float, int, int]:
    """Return the largest value from a row on outside the barred columns and the last one, its row and column."""
    best, at_row, at_column = 0.0, first, 0
    for k in range(first, matrix.shape[0]):
        for j in range(matrix.shape[1] - 1):
            if not barred[j] and abs(matrix[k, j]) > best:
                best, at_row, at_column = abs(matrix[k, j]), k, j
    return best, at_row, at_column


@compiled
def settle(
    constants: tuple[Any, ...],
    rotor_direction: FloatArray,
    resting: NDArray[np.bool_],
    position: FloatArray,
    basis: FloatArray,
    motor_rad: FloatArray,
) -> tuple[float, float]:
    """Return positions to φ = 0, and compute G and the rotor angles there.

    Args:
        constants: of the mechanism, its Tree as a plain tuple.
        rotor_direction: how each rotor turns with the coordinates, shape (m, N).
        resting: coordinates that are at rest and stay where they are, shape (N,).
        position: changed in place, shape (N,).
        basis: G, shape (n, d), output.
        motor_rad: rotor angles, shape (m,), output.

    Returns:
        the largest |φ| that is left, and the smallest pivot over the largest.
    """
    n, d = basis.shape
    tree = Tree(*constants)
    rank, rows = n - d, tree.first_row[len(tree.closed)]
    matrix, error, jacobian = np.empty((rows, n + 1)), np.empty(rows), np.empty((rows, n))
    pivots = np.zeros(rank, dtype=np.int64)
    worst, ratio = np.inf, 1.0
    for _ in range(MAX_NEWTON):
        evaluate(constants, position, error, jacobian)
        worst = 0.0
        for k in range(rows):
            if not np.isfinite(error[k]):
                return np.inf, 0.0
            worst = max(worst, abs(error[k]))
            for j in range(n):
                matrix[k, j] = jacobian[k, j]
            matrix[k, n] = error[k]
        ratio = eliminate(matrix, rank, resting[:n], pivots)
        if worst <= CLOSED or ratio < SINGULAR:
            break
        for i in range(rank):
            position[pivots[i]] -= matrix[i, n]
    _span(matrix, pivots, basis)
    for i in range(len(motor_rad)):
        motor_rad[i] = 0.0
        for j in range(len(position)):
            motor_rad[i] += rotor_direction[i, j] * position[j]
    return worst, ratio


@compiled
def _span(matrix: FloatArray, pivots: NDArray[np.int64], basis: FloatArray) -> None:
    """Fill G from an eliminated matrix: the identity in the rows of the independent joints."""
    basis[:] = 0.0
    dependent = np.zeros(len(basis), dtype=np.bool_)
    for pivot in pivots:
        dependent[pivot] = True
    column = 0
    for j in range(len(basis)):
        if not dependent[j]:
            basis[j, column] = 1.0
            for i in range(len(pivots)):
                basis[pivots[i], column] = -matrix[i, j]
            column += 1


class Mechanism:
    """Closed chain of one cell.

    Attributes:
        joints: names of the n joints, in the order of the plant.
        order: place of each of them among the velocities of the Pinocchio model, shape (n,).
        constants: the Tree as a plain tuple.
        rows: number c of closed directions.
        start_rad: closed position of all joints at power-on, shape (n,).
        mobility: d, degrees of freedom at power-on.
    """

    def __init__(self, model: pin.Model, spec: CellSpec) -> None:
        """Close the mechanism at its start.

        Raises:
            SpecInvalid: a joint or link does not exist, the closures cannot be closed, or the motors do not move all
                degrees of freedom.
        """
        names = list(model.names)[1:]
        _refuse_wrong_names(names, spec)
        self.joints = (*spec.motors, *(name for name in names if name not in spec.motors))
        ids = [model.getJointId(name) for name in self.joints]
        self.order = np.array([model.joints[i].idx_v for i in ids], dtype=np.int64)
        self._closures = spec.closures
        tree = _tree(model, ids, spec)
        self.constants: tuple[Any, ...] = tuple(tree)
        self.rows = int(tree.closed.sum())
        motors = len(spec.motors)
        assembled = self.closed(np.array([spec.assembly_rad[name] for name in self.joints]), (motors, 0))
        self.mobility = len(ids) - _rank(self.at(assembled)[1])
        self.start_rad = self._started(spec, assembled)
        jacobian = self.at(self.start_rad)[1]
        if self.mobility < 1 or motors < self.mobility:
            raise SpecInvalid(
                f"closures: {len(ids)} joints and {self.rows} closed directions of rank {_rank(jacobian)} leave "
                f"{self.mobility} degrees of freedom; expected at least 1 and at most the {motors} motors; correct "
                "closures or motors"
            )
        directions = np.linalg.svd(jacobian)[2][-self.mobility :].T[:motors]
        if _rank(directions) < self.mobility:
            raise SpecInvalid(
                f"motors: {', '.join(spec.motors)} move {_rank(directions)} of {self.mobility} degrees of freedom at "
                "the start; name the joints that have motors, or start away from the singular pose"
            )

    def at(self, position_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return φ, shape (c,), and J_c, shape (c, n)."""
        error, jacobian = np.zeros(self.rows), np.zeros((self.rows, len(self.joints)))
        evaluate(self.constants, np.ascontiguousarray(position_rad, dtype=np.float64), error, jacobian)
        return error, jacobian

    def closed(self, position_rad: FloatArray, held: Sequence[int] = (0,)) -> FloatArray:
        """Return the position nearest to a rough one that the closures allow, by Newton's method.

        Args:
            position_rad: shape (n,).
            held: number of joints that stay, the first ones; the next number is tried where one cannot close it.

        Raises:
            SpecInvalid: it does not close.
        """
        error = np.zeros(0)
        for free in (slice(first, None) for first in held):
            position = position_rad.copy()
            for _ in range(ASSEMBLY_NEWTON):
                error, jacobian = self.at(position)
                if np.abs(error).max() <= CLOSED:
                    return position
                change = np.linalg.lstsq(jacobian[:, free], -error, rcond=1e-9)[0]
                change *= min(1.0, ASSEMBLY_STEP / max(float(np.abs(change).max()), 1e-300))
                position[free] += change
                if np.abs(change).max() <= 1e-15:
                    break
            if np.abs(self.at(position)[0]).max() <= OPEN:
                return position
        rows = np.repeat([c.name for c in self._closures], [len(c.directions) for c in self._closures])
        name = str(rows[int(np.argmax(np.abs(error)))])
        raise SpecInvalid(
            f"closures: {name} stays open by {float(np.abs(error).max()):.3g} m or rad; expected frames that can meet; "
            "correct the assembly, the start, the frames or the directions"
        )

    def _started(self, spec: CellSpec, assembled: FloatArray) -> FloatArray:
        """Return the closed position that continues the assembly to the start of the motors, shape (n,)."""
        motors = len(spec.motors)
        # The rounded positions of redundant motors agree only nearly, so that these move as well.
        held = (motors, 0) if motors > self.mobility else (motors,)
        position = assembled.copy()
        begin = position[:motors].copy()
        for share in np.linspace(0.0, 1.0, ASSEMBLY_LEAPS + 1)[1:]:
            position[:motors] = begin + share * (spec.start_rad - begin)
            position = self.closed(position, held)
        apart = np.abs(position[:motors] - spec.start_rad)
        if apart.max() > START_TOLERANCE:
            worst = int(apart.argmax())
            raise SpecInvalid(
                f"start of {spec.motors[worst]}: {spec.start_rad[worst]:.6g} rad or m, where the closures allow "
                f"{position[worst]:.6g} with the others; expected start positions that agree to {START_TOLERANCE:g}"
            )
        return position


def _rank(matrix: FloatArray) -> int:
    """Return the rank of a matrix, singular values below 1e-6 of the largest being zero."""
    values = np.linalg.svd(matrix, compute_uv=False)
    return int((values > 1e-6 * values[0]).sum())


def _refuse_wrong_names(joints: Sequence[str], spec: CellSpec) -> None:
    """Refuse joints that the URDF lacks or that are missing, given its joints."""
    for key, given in (("motors", spec.motors), ("assembly", spec.assembly_rad), ("passive", spec.passive)):
        if unknown := sorted(set(given) - set(joints)):
            raise SpecInvalid(
                f"{key}: the URDF has no joint {', '.join(unknown)}; expected some of {', '.join(joints)}"
            )
    if len(set(spec.motors)) != len(spec.motors) or len(spec.motors) != len(spec.axes):
        raise SpecInvalid(f"motors: {len(set(spec.motors))} joints for {len(spec.axes)} axes; name one for each axis")
    if missing := sorted(set(joints) - set(spec.assembly_rad)):
        raise SpecInvalid(f"assembly: no position of {', '.join(missing)}; give a rough one of every joint")
    if driven := sorted(set(spec.passive) & set(spec.motors)):
        raise SpecInvalid(f"passive: {', '.join(driven)} has a motor; its friction belongs to its axis")


def _tree(model: pin.Model, ids: Sequence[int], spec: CellSpec) -> Tree:
    """Copy the geometry from a Pinocchio model, its joints `ids` in the order of the plant."""
    place = {0: -1} | {joint: index for index, joint in enumerate(ids)}
    data, neutral = model.createData(), pin.neutral(model)
    jacobians = [pin.computeJointJacobian(model, data, neutral, i).reshape(6, -1) for i in ids]
    moves = np.array([jacobian[:, model.joints[i].idx_v] for jacobian, i in zip(jacobians, ids, strict=True)])
    sliding = np.linalg.norm(moves[:, :3], axis=1) > 0.5
    placements = [model.jointPlacements[i] for i in ids]
    frames = [[link_frame(model, name) for name in (c.first, c.second)] for c in spec.closures]
    closed = np.array([[d in c.directions for d in DIRECTIONS] for c in spec.closures])
    return Tree(
        parent=np.array([place[model.parents[i]] for i in ids], dtype=np.int64),
        # Pinocchio numbers a joint after its parent.
        outwards=np.argsort(ids).astype(np.int64),
        rotation=np.array([p.rotation for p in placements]),
        offset=np.array([p.translation for p in placements]),
        axis=np.ascontiguousarray(np.where(sliding[:, None], moves[:, :3], moves[:, 3:])),
        sliding=sliding,
        frame_joint=np.array([[place[f.parentJoint] for f in pair] for pair in frames], dtype=np.int64),
        frame_rotation=np.array([[f.placement.rotation for f in pair] for pair in frames]),
        frame_offset=np.array([[f.placement.translation for f in pair] for pair in frames]),
        closed=closed,
        first_row=np.concatenate(([0], np.cumsum(closed.sum(axis=1)))),
    )


def link_frame(model: pin.Model, link: str) -> pin.Frame:
    """Return the frame of a link of the URDF.

    Raises:
        SpecInvalid: there is no such link.
    """
    if not model.existFrame(link, pin.FrameType.BODY):
        links = ", ".join(frame.name for frame in model.frames if frame.type == pin.FrameType.BODY)
        raise SpecInvalid(f"the URDF has no link {link}; expected one of {links}")
    return model.frames[model.getFrameId(link, pin.FrameType.BODY)]
