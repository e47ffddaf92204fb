"""Clearance of an arm from itself, from obstacles and from the walls of its workspace,
all along a move.

Links are capsules: a capsule is a segment with a radius, so the distance of two capsules, or of a
capsule and a box, is that of their segments less the radii. These distances have closed forms
(`segment_to_segment`, `segment_to_box`).

A synchronised point-to-point move is a straight line in joint space, q(s) = q₀ + s Δq, so no point
of a capsule on link b moves relative to link a by more than Σ_k |Δq_k| ℓ_k from its start to its
end, with k the joints between the two and ℓ_k the longest lever from joint k to the capsule. A
stretch of half-width h about s is clear when the distance at s is at least h times that; else it is
halved. So nothing is jumped over, whatever the speed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.arrays import BoolArray, FloatArray
from ident.model.closed_chain import assemble, reach
from ident.model.robot import JointKind, Robot, joints_to_base, poses

_Point = tuple[float, float, float]
BASE = -1  #: Index of the link that does not move
RESOLUTION_M = 0.004
"""A stretch in which nothing moves farther than this, and which is still not known to be clear,
counts as blocked.
"""


@dataclass(frozen=True, slots=True)
class Capsule:
    """All points within a radius of a segment."""

    name: str  #: for messages
    link: int  #: index of the joint that it moves with, BASE for the base
    start_m: tuple[float, float, float]  #: first end of the segment in that joint's frame
    end_m: tuple[float, float, float]  #: second end
    radius_m: float  #: above zero


@dataclass(frozen=True, slots=True)
class Box:
    """Axis-aligned box in the base frame."""

    name: str  #: for messages
    lower_m: tuple[float, float, float]  #: lower corner
    upper_m: tuple[float, float, float]  #: upper corner


@dataclass(frozen=True, slots=True)
class Scene:
    """Bodies that must keep apart."""

    capsules: tuple[Capsule, ...]  #: of the arm and its payload
    pairs: tuple[tuple[int, int], ...]  #: indices of capsules that must keep apart
    boxes: tuple[Box, ...]  #: obstacles; capsules of the base may touch them
    workspace: Box | None  #: box that the confined capsules must not leave, None for no bounds
    confined: tuple[int, ...]  #: indices of capsules
    minimum_m: float  #: smallest distance that is allowed


@dataclass(frozen=True, slots=True)
class Obstruction:
    """Reason why a path is not clear."""

    first: str  #: name of one body
    second: str  #: name of the other
    distance_m: float  #: found there; negative when they overlap
    position: tuple[float, ...]  #: of the axes there [rad or m]


#: What is in the way where the loops of a closed chain do not close, or are nearly singular
CLOSURES = "the closures"
#: What is in the way of a body that must not leave the workspace
WORKSPACE_END = "the end of the workspace"
LARGEST_PLANNED_CONDITION = 60.0
"""Largest condition of the closures in a planned pose (Frobenius):
nearer to a singularity, forces in loops grow.
"""
LARGEST_PLANNED_MISFIT = 0.01
"""Motors of a redundant drive may differ by this on the way between two poses that fit [rad or m]:
they work against each other there, which is what separates their gains, and no more than their
position loops can bear.
"""
STEP_SHARE = 0.05  #: Of the way between two poses of a closed chain that are examined


@dataclass(frozen=True, slots=True, eq=False)
class _Reached:
    """Poses of a closed chain, and which of them may be used."""

    joints: FloatArray  #: shape (k, n)
    usable: BoolArray  #: shape (k,)


class Checker:
    """Distances of the pairs of bodies in a scene, for many postures of the arm;
    whether a closed chain gets there.
    """

    def __init__(self, robot: Robot, scene: Scene) -> None:
        self.robot = robot
        self.scene = scene
        self._assembly = assemble(robot)
        # Bodies are the capsules in their order, then the boxes; the ends of a box are opposite
        # corners.
        names: list[str] = []
        frames: list[int] = []
        ends: list[tuple[_Point, _Point]] = []
        radii: list[float] = []
        for capsule in scene.capsules:
            names.append(capsule.name)
            frames.append(capsule.link + 1)
            ends.append((capsule.start_m, capsule.end_m))
            radii.append(capsule.radius_m)
        for box in scene.boxes:
            names.append(box.name)
            frames.append(0)
            ends.append((box.lower_m, box.upper_m))
            radii.append(0.0)
        self._names = names
        self._frame = np.array(frames, dtype=np.int64)
        self._ends = np.array(ends).reshape(-1, 2, 3).swapaxes(1, 2)
        self._radius = np.array(radii)
        half_lengths = 0.5 * np.linalg.norm(self._ends[:, :, 1] - self._ends[:, :, 0], axis=1)
        self._sphere = self._radius + half_lengths
        self._pairs = [*scene.pairs, *_pairs_with_boxes(scene)]
        self._confined: tuple[int, ...] = ()
        if scene.workspace is not None:
            self._confined = scene.confined
        self._everywhere = np.full(len(self._pairs) + len(self._confined), np.inf)
        self._first, self._second = np.array(self._pairs, dtype=np.int64).reshape(-1, 2).T

    def margins(self, position: FloatArray) -> FloatArray:
        """Compute the smallest distance beyond the minimum in each posture [m],
        negative where bodies are closer.

        Args:
            position: of the axes [rad or m], shape (k, m).

        Returns:
            shape (k,); inf where there is nothing to keep away from, −inf where the loops of a
            closed chain do not close, or nearly have a singularity.
        """
        if not self.robot.is_constrained:
            margins = self._margins(position, self._everywhere)
            return np.asarray(margins.min(axis=0, initial=np.inf))
        found = self._reached(position)
        margins = self._margins(found.joints, self._everywhere)
        return np.where(found.usable, margins.min(axis=0, initial=np.inf), -np.inf)

    def fitting(self, position: FloatArray) -> FloatArray:
        """Positions of the axes that fit each other, near given ones, shape (…, m):
        the same where they are free.
        """
        if not self.robot.is_constrained:
            return position
        found = reach(self.robot, self._assembly, np.atleast_2d(position))
        of_axes = found.position_rad[:, list(self.robot.axis_joints)]
        return of_axes.reshape(position.shape)

    def joints(self, position: FloatArray) -> FloatArray:
        """Positions of all joints, shape (k, n), for those of the axes, shape (k, m)."""
        return reach(self.robot, self._assembly, position).position_rad

    @property
    def home(self) -> FloatArray:
        """Positions of the axes in the assembly pose, shape (m,)."""
        return self._assembly.position_rad[list(self.robot.axis_joints)]

    def _reached(self, position: FloatArray) -> _Reached:
        """Poses of a closed chain at positions of the axes, shape (k, m)."""
        found = reach(self.robot, self._assembly, position)
        is_regular = found.condition < LARGEST_PLANNED_CONDITION
        fits = found.misfit < LARGEST_PLANNED_MISFIT
        return _Reached(found.position_rad, found.closed & is_regular & fits)

    def apart(self, position: FloatArray) -> FloatArray:
        """Share of postures, shape (k, n), in which each of the scene's pairs does not touch,
        shape (pairs,).
        """
        if self.robot.is_constrained:
            found = self._reached(position)
            position = found.joints[found.usable]
        margins = self._margins(position, self._everywhere)[: len(self.scene.pairs)]
        distances = margins + self.scene.minimum_m
        return np.asarray((distances > 0.0).mean(axis=1))

    def obstruction(self, start: FloatArray, end: FloatArray) -> Obstruction | None:
        """Find an obstruction on a straight line in joint space, None when all of it is clear.

        Args:
            start, end: positions of the axes [rad or m], shape (m,).
        """
        if self.robot.is_constrained:
            (found,) = self._ways(start[None], end[None])
            return found
        travel_m = self._travel_of_rows(start, end)
        middles = np.array([0.5])
        half = 0.5
        while len(middles):
            position = start + (end - start) * middles[:, None]
            needed = half * travel_m
            margins = self._margins(position, needed)
            is_unsure = margins < needed[:, None]
            is_fine = (needed < RESOLUTION_M)[:, None]
            is_blocked = (margins < 0.0) | (is_unsure & is_fine)
            if is_blocked.any():
                row, sample = np.argwhere(is_blocked)[0]
                return self._obstruction_at(int(row), float(margins[row, sample]), position[sample])
            half /= 2.0
            unsure_middles = middles[is_unsure.any(axis=0)]
            middles = np.concatenate((unsure_middles - half, unsure_middles + half))
        return None

    def _travel_of_rows(self, start: FloatArray, end: FloatArray) -> FloatArray:
        """Bound on the path of any point of one body relative to the other,
        of each row of `_margins` [m].
        """
        travel_m = [
            self._relative_travel(first, second, start, end) for first, second in self._pairs
        ]
        outside = len(self.scene.capsules)  # a body that does not move
        for index in self._confined:
            travel_m.append(self._relative_travel(index, outside, start, end))
        return np.array(travel_m)

    def _obstruction_at(self, row: int, margin_m: float, position: FloatArray) -> Obstruction:
        """Obstruction by the bodies of a row of `_margins`."""
        where = tuple(position.tolist())
        if row < len(self._pairs):
            first, second = self._pairs[row]
            distance_m = margin_m + self.scene.minimum_m
            return Obstruction(self._names[first], self._names[second], distance_m, where)
        confined = self._confined[row - len(self._pairs)]
        return Obstruction(self._names[confined], WORKSPACE_END, margin_m, where)

    def farthest(
        self, start: FloatArray, ends: FloatArray, lower: FloatArray, upper: FloatArray
    ) -> FloatArray | None:
        """Choose the first of some ends that the robot can go to; None where it can go to none.

        Args:
            start, lower, upper: positions of the axes [rad or m], shape (m,).
            ends: shape (e, m). Motors of a redundant drive are moved to positions that fit each
                other, which may be outside the limits.
        """
        ends = self.fitting(ends)
        is_inside = np.all((ends >= lower) & (ends <= upper), axis=1)
        if not self.robot.is_constrained:
            for end in ends[is_inside]:
                if self.obstruction(start, end) is None:
                    return np.asarray(end)
            return None
        obstructions = self._ways(np.broadcast_to(start, ends.shape), ends)
        for end, inside, obstruction in zip(ends, is_inside, obstructions, strict=True):
            if inside and obstruction is None:
                return np.asarray(end)
        return None

    def _ways(self, starts: FloatArray, ends: FloatArray) -> list[Obstruction | None]:
        """Look at poses of straight ways so close to each other that nothing happens between
        them.
        """
        shares = np.linspace(0.0, 1.0, round(1.0 / STEP_SHARE) + 1)
        position = starts[:, None] + (ends - starts)[:, None] * shares[:, None]
        ways, samples, axes = position.shape
        found = self._reached(position.reshape(-1, axes))
        usable = found.usable.reshape(ways, samples)
        margins = self._margins(found.joints, self._everywhere).reshape(-1, ways, samples)
        placed = self._placed(found.joints).reshape(-1, ways, samples, 3, 2)
        # A body moves at most as far between two poses as the fastest of its ends: from the nearer
        # one at most half of that, and two bodies that both move come closer by all of it. (The way
        # of an end between poses is taken as straight; it is bent by less than a hundredth of its
        # length.)
        steps = np.linalg.norm(np.diff(placed, axis=2), axis=3)
        travel = steps.max(axis=(0, 2, 3), initial=0.0)
        share_of_travel = self._shares_of_travel()
        obstructions: list[Obstruction | None] = []
        for way, moved in enumerate(travel.tolist()):
            own = margins[:, way] - moved * share_of_travel[:, None]
            if not usable[way].all():
                first_unusable = int(np.argmin(usable[way]))
                where = tuple(position[way, first_unusable].tolist())
                obstructions.append(Obstruction(CLOSURES, "a pose that they allow", 0.0, where))
            elif not own.size or own.min() >= 0.0:
                obstructions.append(None)
            else:
                row, sample = np.unravel_index(int(np.argmin(own)), own.shape)
                margin_m = float(own[row, sample])
                obstructions.append(self._obstruction_at(int(row), margin_m, position[way, sample]))
        return obstructions

    def _shares_of_travel(self) -> FloatArray:
        """Share of the travel of an end by which the bodies of each row of `_margins` may come
        closer.
        """
        shares: list[float] = []
        for pair in self._pairs:
            both_move = max(pair) < len(self.scene.capsules)
            if both_move:
                shares.append(1.0)
            else:
                shares.append(0.5)
        shares += [0.5] * len(self._confined)
        return np.array(shares)

    def _placed(self, joints: FloatArray) -> FloatArray:
        """Both ends of every body in each posture, shape (bodies, k, 3, 2)."""
        placed = poses(self.robot, joints)
        rotation = placed.rotation[self._frame]
        origin_m = placed.origin_m[self._frame]
        return np.asarray(rotation @ self._ends[:, None] + origin_m[..., None])

    def _margins(self, position: FloatArray, needed: FloatArray) -> FloatArray:
        """Margin of each pair, then of each confined capsule, shape (pairs + confined, k).

        Where spheres around both bodies are farther apart than needed, it is the margin of the
        spheres.
        """
        placed = self._placed(position)
        start = placed[..., 0]
        end = placed[..., 1]
        out = np.empty((len(needed), len(position)))
        pairs = len(self._pairs)
        first = self._first
        second = self._second
        minimum_m = self.scene.minimum_m
        middle = 0.5 * (start + end)
        between = _length(middle[first] - middle[second])
        of_spheres = self._sphere[first] + self._sphere[second] + minimum_m
        out[:pairs] = between - of_spheres[:, None]
        row, sample = np.nonzero(out[:pairs] < needed[:pairs, None])
        to_box = second[row] >= len(self.scene.capsules)
        for distance, chosen in ((segment_to_segment, ~to_box), (segment_to_box, to_box)):
            if chosen.any():
                pair = row[chosen]
                k = sample[chosen]
                one = first[pair]
                other = second[pair]
                distance_m = distance(start[one, k], end[one, k], start[other, k], end[other, k])
                smallest_m = self._radius[one] + self._radius[other] + minimum_m
                out[pair, k] = distance_m - smallest_m
        if self.scene.workspace is not None:
            for last, index in enumerate(self._confined, start=pairs):
                start_margin = _margin_inside(start[index], self.scene.workspace)
                end_margin = _margin_inside(end[index], self.scene.workspace)
                out[last] = np.minimum(start_margin, end_margin) - self._radius[index]
        return out

    def _relative_travel(
        self, first: int, second: int, start: FloatArray, end: FloatArray
    ) -> float:
        """Bound on the path of any point of one body relative to another one [m]."""
        first_chain = self._chain(first)
        second_chain = self._chain(second)
        first_m = self._travel_beyond(first, first_chain, second_chain, start, end)
        second_m = self._travel_beyond(second, second_chain, first_chain, start, end)
        return first_m + second_m

    def _travel_beyond(
        self,
        body: int,
        chain: list[int],
        other: list[int],
        start: FloatArray,
        end: FloatArray,
    ) -> float:
        """Path along which the joints of a chain that are not in another one can move a body [m];
        zero of a box.
        """
        if body >= len(self.scene.capsules):
            return 0.0
        travel_m = 0.0
        capsule = self.scene.capsules[body]
        start_lever = float(np.linalg.norm(capsule.start_m))
        end_lever = float(np.linalg.norm(capsule.end_m))
        lever = max(start_lever, end_lever)
        for number in chain:  # from the capsule towards the base
            if number in other:
                break
            joint = self.robot.joints[number]
            distance = abs(float(end[number] - start[number]))
            length_m = float(np.linalg.norm(joint.translation_m))
            if joint.kind is JointKind.PRISMATIC:
                farthest = max(abs(float(start[number])), abs(float(end[number])))
                travel_m += distance
                lever += length_m
                lever += farthest
            else:
                travel_m += distance * lever
                lever += length_m
        return travel_m

    def _chain(self, body: int) -> list[int]:
        """Joints from a body to the base; none of a box."""
        if body >= len(self.scene.capsules):
            return []
        return list(joints_to_base(self.robot, self.scene.capsules[body].link))


def _pairs_with_boxes(scene: Scene) -> list[tuple[int, int]]:
    """Pairs of each capsule that moves with each box,
    whose indices follow those of the capsules.
    """
    pairs: list[tuple[int, int]] = []
    first_box = len(scene.capsules)
    for index, capsule in enumerate(scene.capsules):
        if capsule.link != BASE:
            pairs += [(index, first_box + box) for box in range(len(scene.boxes))]
    return pairs


def _margin_inside(point_m: FloatArray, box: Box) -> FloatArray:
    """Distance of points inside a box from its nearest face [m], shape (k, 3) → (k,);
    negative outside.
    """
    from_lower = point_m - np.array(box.lower_m)
    from_upper = np.array(box.upper_m) - point_m
    return np.asarray(np.minimum(from_lower, from_upper).min(axis=1))


def segment_to_segment(
    start: FloatArray, end: FloatArray, other_start: FloatArray, other_end: FloatArray
) -> FloatArray:
    """Compute the distance of two segments in each sample [m], shape (k,).

    The squared distance of points s and t along the segments is a convex quadratic. Its minimum
    over s, clipped to the segment, gives the best t, and t, clipped, the best s (Ericson, Real-Time
    Collision Detection, 5.1.9). For parallel segments the first s may be any.

    Args:
        start, end, other_start, other_end: ends of the segments [m], shape (k, 3).
    """
    along = end - start
    other = other_end - other_start
    between = start - other_start
    a = _dot(along, along)
    b = _dot(along, other)
    c = _dot(along, between)
    e = _dot(other, other)
    f = _dot(other, between)
    first_s = _share(b * f - c * e, a * e - b * b)
    t = _share(b * first_s + f, e)
    s = _share(b * t - c, a)
    nearest = between + s[:, None] * along - t[:, None] * other
    return _length(nearest)


def segment_to_box(
    start: FloatArray, end: FloatArray, lower: FloatArray, upper: FloatArray
) -> FloatArray:
    """Compute the distance of a segment from an axis-aligned box in each sample [m], shape (k,).

    Where the two overlap it is minus the shortest displacement that separates them. Half the
    derivative of the squared distance along the segment, d · excess(t), is piecewise linear and
    never falls. It bends where the segment crosses the plane of a face; between two bends its zero
    follows from a straight line.

    Args:
        start, end: ends of the segment [m], shape (k, 3).
        lower, upper: opposite corners of the box [m], shape (k, 3).
    """
    samples = len(start)
    along = end - start
    crosses_lower = _share(lower - start, along)
    crosses_upper = _share(upper - start, along)
    limits = np.broadcast_to([0.0, 1.0], (samples, 2))
    bends = np.concatenate((crosses_lower, crosses_upper, limits), axis=1)
    bends = np.sort(bends, axis=1)
    at_bends = start[:, None] + along[:, None] * bends[:, :, None]
    excess = at_bends - np.clip(at_bends, lower[:, None], upper[:, None])
    slope = _dot(along[:, None], excess)
    falling = (slope < 0.0).sum(axis=1)
    after = np.clip(falling, 1, bends.shape[1] - 1)  # the first bend after the zero
    before = after - 1
    sample = np.arange(samples)
    low = slope[sample, before]
    high = slope[sample, after]
    first = bends[sample, before]
    last = bends[sample, after]
    zero = first + (last - first) * _share(-low, high - low)
    nearest = start + along * zero[:, None]
    distance = _length(nearest - np.clip(nearest, lower, upper))
    depth = _depth(start, end, lower, upper)
    return np.where(depth > 0.0, -depth, distance)


def _depth(start: FloatArray, end: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Shortest displacement of a segment out of a box that it enters, shape (k,);
    not positive where they are apart.

    It is along a normal of a face of their Minkowski difference: an edge of the box, or the cross
    product of one with the segment.
    """
    edges = np.broadcast_to(np.eye(3), (len(start), 3, 3))
    along = end - start
    crosses = np.cross(edges, along[:, None])
    length = np.linalg.norm(crosses, axis=2)
    divisor = np.where(length > 0.0, length, 1.0)
    normals = np.concatenate((edges, crosses / divisor[:, :, None]), axis=1)
    middle = 0.5 * (lower + upper)
    half = 0.5 * (upper - lower)
    from_middle = np.stack((start - middle, end - middle))
    # Along each normal n: of both ends e of the segment, and half the extent of the box
    ends = np.einsum("knd,ekd->ekn", normals, from_middle)
    half_extent = np.einsum("knd,kd->kn", np.abs(normals), half)
    nearer_side = np.minimum(ends.max(axis=0), -ends.min(axis=0))
    depths = half_extent + nearer_side
    depths[:, 3:][length == 0.0] = np.inf
    return np.asarray(depths.min(axis=1))


def _share(numerator: FloatArray, denominator: FloatArray) -> FloatArray:
    """Quotient clipped to 0 … 1; 0 where the denominator is zero."""
    quotient = np.zeros_like(numerator)
    with np.errstate(over="ignore"):
        np.divide(numerator, denominator, out=quotient, where=denominator != 0.0)
    return np.minimum(np.maximum(quotient, 0.0), 1.0)


def _dot(first: FloatArray, second: FloatArray) -> FloatArray:
    """Products a · b over the last axis."""
    return np.asarray(np.einsum("...d,...d->...", first, second))


def _length(vectors: FloatArray) -> FloatArray:
    """Lengths over the last axis."""
    squares = _dot(vectors, vectors)
    return np.asarray(np.sqrt(squares))
