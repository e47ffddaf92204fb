"""Loop closures of a simulated plant: what keeps the tree of a URDF together as a closed chain.

A closure says that two frames of the tree coincide in some directions of the first. With R₁, p₁ and
R₂, p₂ of the two frames in the base and R = R₁ᵀ R₂,

    φ = (R₁ᵀ (p₂ − p₁),  ½ vee(R − Rᵀ)) in the chosen directions,     J_c = ∂φ/∂q,

so that a closure of two rotations leaves the third free below 180°. J_c has rank r, also where
closures are redundant (the parallelograms of an Orthoglide hold its platform twice). Elimination
with full pivots splits the joints into r dependent and d = n − r independent ones: J_c G = 0 with G
the identity in the independent rows, and Newton's method on the dependent joints alone returns
positions to φ = 0 (coordinate partitioning, Wehage and Haug 1982).

Joints are in the order of the plant: those of the motors first, in the order of the axes, then the
passive ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from drivers.simulation.dynamics import compiled
from drivers.simulation.spec import (
    DIRECTIONS,
    BoolArray,
    CellSpec,
    FloatArray,
    IntArray,
    SpecInvalid,
)

CLOSED = 1e-12  #: Largest |φ| [m or rad] at which Newton's method stops

OPEN = 1e-10  #: Largest |φ| [m or rad] that the plant accepts at the end of a step

#: Smallest pivot of the closures over the largest; below it the mechanism is in a singular pose
SINGULAR = 1e-7

MAX_NEWTON = 8  #: Newton steps after one step of the plant; two are usual

ASSEMBLY_NEWTON = 200  #: Newton steps from a rough assembly

ASSEMBLY_STEP = 0.2  #: Largest change of a joint in one of them [rad or m]

ASSEMBLY_LEAPS = 50  #: Poses on the way from the assembly to the start

#: Largest part of a pivot's turning about another axis than its own, or that changes with the pose
PLANAR = 1e-6

START_TOLERANCE = 1e-3  #: Largest correction of a start position of redundant drives [rad or m]


class Tree(NamedTuple):
    """Geometry of n joints and k closures.

    The base is joint 0, the joints of the plant follow in their order.
    """

    parent: IntArray  #: joint before each joint, shape (n + 1,)
    outwards: IntArray  #: the joints without the base, each after its parent, shape (n,)
    rotation: FloatArray  #: placement of each joint in the frame of its parent, shape (n + 1, 3, 3)
    offset: FloatArray  #: the same, its origin [m], shape (n + 1, 3)
    #: unit vector of each prismatic joint in its own frame, else zero, shape (n + 1, 3)
    slide: FloatArray
    #: unit vector of each revolute joint in its own frame, else zero, shape (n + 1, 3)
    turn: FloatArray
    frame_joint: IntArray  #: joint that moves each frame, shape (k, 2)
    frame_rotation: FloatArray  #: placement of each frame in that joint's, shape (k, 2, 3, 3)
    frame_offset: FloatArray  #: the same, its origin [m], shape (k, 2, 3)
    #: Closure of each of the c closed directions, and number of the direction: x, y, z, rx, ry, rz;
    #: shape (c, 2).
    closed: IntArray


class Placed(NamedTuple):
    """Joints in the base at one position, those of the tree."""

    rotation: FloatArray  #: shape (n + 1, 3, 3)
    origin: FloatArray  #: [m], shape (n + 1, 3)
    slide: FloatArray  #: as in the tree, shape (n + 1, 3)
    turn: FloatArray  #: as in the tree, shape (n + 1, 3)


@compiled
def evaluate(
    constants: tuple[Any, ...], position: FloatArray, error: FloatArray, jacobian: FloatArray
) -> None:
    """Compute φ, shape (c,), and J_c, shape (c, n), in place at the first n positions."""
    tree = Tree(*constants)
    joints = len(tree.parent)
    rotation = np.zeros((joints, 3, 3))
    origin = np.zeros((joints, 3))
    slide = np.zeros((joints, 3))
    turn = np.zeros((joints, 3))
    placed = Placed(rotation, origin, slide, turn)
    for a in range(3):
        placed.rotation[0, a, a] = 1.0
    for i in tree.outwards:
        _place_joint(tree, i, position[i - 1], placed)
    closures = len(tree.frame_joint)
    every_error = np.zeros((closures, 6))
    motion = np.zeros((closures, joints, 6))
    for k in range(closures):
        _close(tree, k, placed, every_error[k], motion[k])
    for row in range(len(error)):
        k = tree.closed[row, 0]
        direction = tree.closed[row, 1]
        error[row] = every_error[k, direction]
        for j in range(1, joints):
            jacobian[row, j - 1] = motion[k, j, direction]


@compiled
def _add(matrix: FloatArray, vector: FloatArray, total: FloatArray) -> None:
    """Add matrix · vector, of three dimensions, to a total."""
    for a in range(3):
        for b in range(3):
            total[a] += matrix[a, b] * vector[b]


@compiled
def _add_product(left: FloatArray, right: FloatArray, total: FloatArray) -> None:
    """Add left · right, of three dimensions, to a total."""
    for a in range(3):
        for b in range(3):
            for c in range(3):
                total[a, c] += left[a, b] * right[b, c]


@compiled
def _place_joint(tree: Tree, i: int, position: float, placed: Placed) -> None:
    """Place joint i in the base behind its parent."""
    parent = tree.parent[i]
    neutral = np.zeros((3, 3))
    _add_product(placed.rotation[parent], tree.rotation[i], neutral)
    _add(neutral, tree.slide[i], placed.slide[i])
    _add(neutral, tree.turn[i], placed.turn[i])
    for a in range(3):
        placed.origin[i, a] = placed.origin[parent, a]
    _add(placed.rotation[parent], tree.offset[i], placed.origin[i])
    for a in range(3):
        placed.origin[i, a] += position * placed.slide[i, a]
    _add_product(neutral, _turned(tree.turn[i], position), placed.rotation[i])


@compiled
def _turned(axis: FloatArray, angle: float) -> FloatArray:
    """Return the rotation about a unit vector (Rodrigues);
    the identity for a zero vector, a joint that slides.
    """
    x, y, z = axis
    if x == 0.0 and y == 0.0 and z == 0.0:
        angle = 0.0
    s = np.sin(angle)
    c = np.cos(angle)
    rotation = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            rotation[a, b] = axis[a] * axis[b] * (1 - c)
        rotation[a, a] += c
    rotation[0, 1] -= z * s
    rotation[0, 2] += y * s
    rotation[1, 0] += z * s
    rotation[1, 2] -= x * s
    rotation[2, 0] -= y * s
    rotation[2, 1] += x * s
    return rotation


@compiled
def _close(tree: Tree, k: int, placed: Placed, error: FloatArray, motion: FloatArray) -> None:
    """Compute φ of closure k in all six directions, shape (6,), and what each joint does to it,
    shape (n + 1, 6).

    With Ṙ = [ω] R the second part of φ changes by ½ (tr(R) I − R) ω, ω in the first frame: `spin`.
    """
    r = np.zeros((2, 3, 3))
    p = np.zeros((2, 3))
    for side in range(2):
        joint = tree.frame_joint[k, side]
        for a in range(3):
            p[side, a] = placed.origin[joint, a]
        _add(placed.rotation[joint], tree.frame_offset[k, side], p[side])
        _add_product(placed.rotation[joint], tree.frame_rotation[k, side], r[side])
    to_first = r[0].T.copy()
    between = np.zeros((3, 3))
    _add_product(to_first, r[1], between)
    trace = between[0, 0] + between[1, 1] + between[2, 2]
    apart = np.empty(3)
    spin = np.empty((3, 3))
    for a in range(3):
        b = (a + 1) % 3
        c = (a + 2) % 3
        apart[a] = p[1, a] - p[0, a]
        error[3 + a] = 0.5 * (between[c, b] - between[b, c])
        for b in range(3):
            spin[a, b] = 0.5 * ((trace if a == b else 0.0) - between[a, b])
    _add(to_first, apart, error[:3])
    for side in range(2):
        sign = -1.0
        if side == 1:
            sign = 1.0
        j = tree.frame_joint[k, side]
        while j > 0:
            velocity = np.empty(3)
            angular = np.zeros(3)
            _add(to_first, placed.turn[j], angular)
            for a in range(3):
                b = (a + 1) % 3
                c = (a + 2) % 3
                # Seen from the first frame, so that its own turning moves the second frame's origin
                # as well.
                lever_b = p[1, b] - placed.origin[j, b]
                lever_c = p[1, c] - placed.origin[j, c]
                across = placed.turn[j, b] * lever_c - placed.turn[j, c] * lever_b
                velocity[a] = sign * (placed.slide[j, a] + across)
                angular[a] *= sign
            _add(to_first, velocity, motion[j, :3])
            _add(spin, angular, motion[j, 3:])
            j = tree.parent[j]


@compiled
def eliminate(matrix: FloatArray, rank: int, held: BoolArray, pivots: IntArray) -> float:
    """Reduce [J_c | φ], shape (c, n + 1), in place by Gauss-Jordan steps with full pivots.

    Args:
        matrix: afterwards row i of the first `rank` has 1 in the column of pivot i, where all other
            rows have 0.
        rank: number of pivots, r.
        held: joints that become dependent only where no other can, shape (n,).
        pivots: column of each pivot, shape (r,), output.

    Returns:
        the smallest pivot over the largest.
    """
    n = matrix.shape[1] - 1
    used = np.zeros(n, dtype=np.bool_)
    barred = np.empty(n, dtype=np.bool_)
    largest = 0.0
    smallest = np.inf
    for i in range(rank):
        for j in range(n):
            barred[j] = used[j] or held[j]
        best, at_row, column = _find_pivot(matrix, i, barred)
        if not best > SINGULAR * largest:
            best, at_row, column = _find_pivot(matrix, i, used)
        if not best > 0.0:
            return 0.0
        largest = max(largest, best)
        smallest = min(smallest, best)
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
    if rank > 0:
        return smallest / largest
    return 1.0


@compiled
def _find_pivot(matrix: FloatArray, first: int, barred: BoolArray) -> tuple[float, int, int]:
    """Return the largest value from a row on outside the barred columns and the last one,
    its row and column.
    """
    best = 0.0
    at_row = first
    at_column = 0
    for k in range(first, matrix.shape[0]):
        for j in range(matrix.shape[1] - 1):
            if not barred[j] and abs(matrix[k, j]) > best:
                best = abs(matrix[k, j])
                at_row = k
                at_column = j
    return best, at_row, at_column


@compiled
def settle(
    constants: tuple[Any, ...], resting: BoolArray, position: FloatArray, basis: FloatArray
) -> tuple[float, float]:
    """Return positions to φ = 0, and compute G there.

    Args:
        constants: of the mechanism, its Tree as a plain tuple.
        resting: coordinates that are at rest and stay where they are, shape (N,).
        position: changed in place, shape (N,).
        basis: G, shape (n, d), output.

    Returns:
        the largest |φ| that is left, and the smallest pivot over the largest.
    """
    n, d = basis.shape
    rank = n - d
    rows = len(Tree(*constants).closed)
    matrix = np.empty((rows, n + 1))
    error = np.empty(rows)
    pivots = np.zeros(rank, dtype=np.int64)
    worst = np.inf
    ratio = 1.0
    for _ in range(MAX_NEWTON):
        evaluate(constants, position, error, matrix)
        worst = 0.0
        for k in range(rows):
            if not np.isfinite(error[k]):
                return np.inf, 0.0
            worst = max(worst, abs(error[k]))
            matrix[k, n] = error[k]
        ratio = eliminate(matrix, rank, resting[:n], pivots)
        if worst <= CLOSED or ratio < SINGULAR:
            break
        for i in range(rank):
            position[pivots[i]] -= matrix[i, n]
    _span(matrix, pivots, basis)
    return worst, ratio


@compiled
def _span(matrix: FloatArray, pivots: IntArray, basis: FloatArray) -> None:
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
        start_rad: closed position of all joints at power-on, shape (n,).
        mobility: d, degrees of freedom at power-on.
    """

    def __init__(self, model: pin.Model, spec: CellSpec) -> None:
        """Close the mechanism at its start.

        Raises:
            SpecInvalid: a joint or link does not exist, the closures cannot be closed, or the
                motors do not move all degrees of freedom.
        """
        names = list(model.names)[1:]
        _refuse_wrong_names(names, spec)
        self.joints = (*spec.motors, *(name for name in names if name not in spec.motors))
        ids = [model.getJointId(name) for name in self.joints]
        self.order = np.array([model.joints[i].idx_v for i in ids], dtype=np.int64)
        self._closures = spec.closures
        tree = _tree(model, ids, spec)
        self.constants: tuple[Any, ...] = tuple(tree)
        self._closed_directions = tree.closed
        motors = len(spec.motors)
        rough = np.array([spec.assembly_rad[name] for name in self.joints])
        assembled = self.closed(rough, (motors, 0))
        self.mobility = len(ids) - _rank(self.at(assembled)[1])
        self.start_rad = self._started(spec, assembled)
        jacobian = self.at(self.start_rad)[1]
        if self.mobility < 1 or motors < self.mobility:
            raise SpecInvalid(
                f"closures: {len(ids)} joints and {len(tree.closed)} closed directions of rank "
                f"{_rank(jacobian)} leave {self.mobility} degrees of freedom; expected at least 1 "
                f"and at most the {motors} motors; correct closures or motors"
            )
        _, _, rows = np.linalg.svd(jacobian)
        directions = rows[-self.mobility :].T[:motors]
        if _rank(directions) < self.mobility:
            raise SpecInvalid(
                f"motors: {', '.join(spec.motors)} move {_rank(directions)} of {self.mobility} "
                "degrees of freedom at the start; name the joints that have motors, or start away "
                "from the singular pose"
            )

    def at(self, position_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return φ, shape (c,), and J_c, shape (c, n)."""
        error = np.zeros(len(self._closed_directions))
        jacobian = np.zeros((len(error), len(self.joints)))
        evaluate(
            self.constants, np.ascontiguousarray(position_rad, dtype=np.float64), error, jacobian
        )
        return error, jacobian

    def turning(self, model: pin.Model, closure: str) -> FloatArray:
        """Return how the two links of a planar pivot turn against each other with each joint,
        shape (n,).

        They are entries 1, -1 and 0 at every pose where all joints of the loop turn about one
        direction; the links of any other closure turn against each other by a row that changes with
        the pose.

        Raises:
            SpecInvalid: there is no such closure, or it is no planar pivot.
        """
        found = [one for one in self._closures if one.name == closure]
        if not found:
            names = ", ".join(one.name for one in self._closures)
            raise SpecInvalid(f"no closure {closure!r}; there are {names}")
        ends = [
            model.getFrameId(link, pin.FrameType.BODY) for link in (found[0].first, found[0].second)
        ]
        # A second pose, to see whether the rows stay.
        poses = (self.start_rad, self.start_rad + np.linspace(0.2, 0.4, len(self.joints)))
        rows = [_relative_turning(model, ends, self.order, pose) for pose in poses]
        about = int(np.argmax(np.abs(rows[0]).sum(axis=1)))
        others = np.delete(rows[0], about, axis=0)
        if np.abs(others).max() > PLANAR or np.abs(rows[1] - rows[0]).max() > PLANAR:
            raise SpecInvalid(
                f"closure {closure}: its links turn against each other about more than one "
                "direction"
            )
        return np.asarray(np.round(rows[0][about]))

    def closed(self, position_rad: FloatArray, held: Sequence[int] = (0,)) -> FloatArray:
        """Return the position nearest to a rough one that the closures allow, by Newton's method.

        Args:
            position_rad: shape (n,).
            held: number of joints that stay, the first ones; the next number is tried where one
                cannot close it.

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
        worst, _ = self._closed_directions[np.argmax(np.abs(error))]
        name = self._closures[worst].name
        raise SpecInvalid(
            f"closures: {name} stays open by {float(np.abs(error).max()):.3g} m or rad; expected "
            "frames that can meet; correct the assembly, the start, the frames or the directions"
        )

    def _started(self, spec: CellSpec, assembled: FloatArray) -> FloatArray:
        """Return the closed position that continues the assembly to the start of the motors,
        shape (n,).
        """
        motors = len(spec.motors)
        # The rounded positions of redundant motors agree only nearly, so that these move as well.
        fixed: tuple[int, ...] = (motors,)
        if motors > self.mobility:
            fixed = (motors, 0)
        position = assembled.copy()
        begin = position[:motors].copy()
        for share in np.linspace(0.0, 1.0, ASSEMBLY_LEAPS + 1)[1:]:
            position[:motors] = begin + share * (spec.start_rad - begin)
            position = self.closed(position, fixed)
        apart = np.abs(position[:motors] - spec.start_rad)
        if apart.max() > START_TOLERANCE:
            worst = int(apart.argmax())
            raise SpecInvalid(
                f"start of {spec.motors[worst]}: {spec.start_rad[worst]:.6g} rad or m, where the "
                f"closures allow {position[worst]:.6g} with the others; expected start positions "
                f"that agree to {START_TOLERANCE:g}"
            )
        return position


def _relative_turning(
    model: pin.Model, ends: Sequence[int], order: IntArray, position_rad: FloatArray
) -> FloatArray:
    """Return the angular velocity of the second frame less that of the first, in the first,
    per joint, shape (3, n).
    """
    data = model.createData()
    configuration = np.empty(len(order))
    configuration[order] = position_rad
    pin.computeJointJacobians(model, data, configuration)
    pin.updateFramePlacements(model, data)
    angular = [pin.getFrameJacobian(model, data, end, pin.LOCAL_WORLD_ALIGNED)[3:] for end in ends]
    to_first = data.oMf[ends[0]].rotation.T
    return np.asarray((to_first @ (angular[1] - angular[0]))[:, order])


def _rank(matrix: FloatArray) -> int:
    """Return the rank of a matrix, singular values below 1e-6 of the largest being zero."""
    values = np.linalg.svd(matrix, compute_uv=False)
    return int((values > 1e-6 * values[0]).sum())


def _refuse_wrong_names(joints: Sequence[str], spec: CellSpec) -> None:
    """Refuse joints that the URDF lacks or that are missing, given its joints."""
    for key, given in (
        ("motors", spec.motors),
        ("assembly", spec.assembly_rad),
        ("passive", spec.passive),
    ):
        if unknown := sorted(set(given) - set(joints)):
            raise SpecInvalid(
                f"{key}: the URDF has no joint {', '.join(unknown)}; expected some of "
                f"{', '.join(joints)}"
            )
    different = len(set(spec.motors))
    if different != len(spec.motors) or different != len(spec.axes):
        raise SpecInvalid(
            f"motors: {different} joints for {len(spec.axes)} axes; name one for each axis"
        )
    missing = sorted(set(joints) - set(spec.assembly_rad))
    if missing:
        raise SpecInvalid(
            f"assembly: no position of {', '.join(missing)}; give a rough one of every joint"
        )
    driven = sorted(set(spec.passive) & set(spec.motors))
    if driven:
        raise SpecInvalid(
            f"passive: {', '.join(driven)} has a motor; its friction belongs to its axis"
        )


def _tree(model: pin.Model, ids: Sequence[int], spec: CellSpec) -> Tree:
    """Copy the geometry from a Pinocchio model, its joints `ids` in the order of the plant."""
    with_base = [0, *ids]
    place = {joint: index for index, joint in enumerate(with_base)}
    data = model.createData()
    neutral = pin.neutral(model)
    motion = np.zeros((len(with_base), 6))
    for index, joint in enumerate(ids, start=1):
        jacobian = pin.computeJointJacobian(model, data, neutral, joint).reshape(6, -1)
        motion[index] = jacobian[:, model.joints[joint].idx_v]
    sliding = np.linalg.norm(motion[:, :3], axis=1, keepdims=True) > 0.5
    placements = [model.jointPlacements[joint] for joint in with_base]
    frames: list[pin.Frame] = []
    closed: list[tuple[int, int]] = []
    for k, closure in enumerate(spec.closures):
        frames += [link_frame(model, closure.first), link_frame(model, closure.second)]
        closed += [
            (k, number)
            for number, direction in enumerate(DIRECTIONS)
            if direction in closure.directions
        ]
    parents = [place[model.parents[joint]] for joint in with_base]
    # Two frames a closure.
    frame_joint = np.array([place[frame.parentJoint] for frame in frames], dtype=np.int64)
    frame_rotation = np.array([frame.placement.rotation for frame in frames])
    frame_offset = np.array([frame.placement.translation for frame in frames])
    return Tree(
        parent=np.array(parents, dtype=np.int64),
        # Pinocchio numbers a joint after its parent.
        outwards=1 + np.argsort(ids).astype(np.int64),
        rotation=np.array([placement.rotation for placement in placements]),
        offset=np.array([placement.translation for placement in placements]),
        slide=np.where(sliding, motion[:, :3], 0.0),
        turn=np.where(sliding, 0.0, motion[:, 3:]),
        frame_joint=frame_joint.reshape(-1, 2),
        frame_rotation=frame_rotation.reshape(-1, 2, 3, 3),
        frame_offset=frame_offset.reshape(-1, 2, 3),
        closed=np.array(closed, dtype=np.int64),
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
