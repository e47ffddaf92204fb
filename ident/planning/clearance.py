"""Clearance of an arm from itself, from obstacles and from the walls of its workspace,
along a whole move.

Links are capsules: a capsule is a segment with a radius, so the distance of two capsules, or of a
capsule and a box, is that of their segments less the radii. These distances have closed forms
(`segment_to_segment`, `segment_to_box`).

A synchronised point-to-point move is a straight line in joint space, q(s) = q₀ + s Δq, so no point
of a capsule on link b moves relative to link a by more than Σ_k |Δq_k| ℓ_k over the whole of it,
with k the joints between the two and ℓ_k the longest lever from joint k to the capsule. A stretch
of half-width h about s is clear when the distance at s is at least h times that; else it is halved.
So nothing is jumped over, whatever the speed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.arrays import BoolArray, FloatArray
from ident.model.closed_chain import assemble, reach
from ident.model.robot import JointKind, Robot, poses

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
    minimum_m: float  #: distance that must be kept


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
        capsules = scene.capsules
        boxes = scene.boxes
        moving = [index for index, capsule in enumerate(capsules) if capsule.link != BASE]
        # Bodies are the capsules in their order, then the boxes; the ends of a box are opposite
        # corners.
        behind = range(len(capsules), len(capsules) + len(boxes))
        self._pairs = [*scene.pairs, *((index, box) for index in moving for box in behind)]
        if scene.workspace is not None:
            self._confined = scene.confined
        else:
            self._confined = ()
        self._names = [body.name for bodies in (capsules, boxes) for body in bodies]
        self._frame = np.array(
            [capsule.link + 1 for capsule in capsules] + [0] * len(boxes), dtype=np.int64
        )
        ends = [(c.start_m, c.end_m) for c in capsules] + [
            (box.lower_m, box.upper_m) for box in boxes
        ]
        self._ends = np.array(ends).reshape(-1, 2, 3).swapaxes(1, 2)
        self._radius = np.array([capsule.radius_m for capsule in capsules] + [0.0] * len(boxes))
        self._sphere = self._radius + 0.5 * np.linalg.norm(
            self._ends[:, :, 1] - self._ends[:, :, 0], axis=1
        )
        self._everywhere = np.full(len(self._pairs) + len(self._confined), np.inf)
        self._first, self._second = np.array(self._pairs, dtype=np.int64).reshape(-1, 2).T

    def margins(self, position: FloatArray) -> FloatArray:
        """Compute the smallest distance beyond the minimum in each posture [m],
        negative where it is not kept.

        Args:
            position: of the axes [rad or m], shape (k, m).

        Returns:
            shape (k,); inf where there is nothing to keep away from, −inf where the loops of a
            closed chain do not close, or nearly have a singularity.
        """
        if not self.robot.is_constrained:
            return np.asarray(self._margins(position, self._everywhere).min(axis=0, initial=np.inf))
        found = self._reached(position)
        return np.where(
            found.usable,
            self._margins(found.joints, self._everywhere).min(axis=0, initial=np.inf),
            -np.inf,
        )

    def fitting(self, position: FloatArray) -> FloatArray:
        """Positions of the axes that fit each other, near given ones, shape (…, m):
        the same where they are free.
        """
        if not self.robot.is_constrained:
            return position
        found = reach(self.robot, self._assembly, np.atleast_2d(position)).position_rad
        return found[:, list(self.robot.axis_joints)].reshape(position.shape)

    def joints(self, position: FloatArray) -> FloatArray:
        """Positions of all joints, shape (k, n), for those of the axes, shape (k, m)."""
        return reach(self.robot, self._assembly, position).position_rad

    @property
    def home(self) -> FloatArray:
        """Positions of the axes in the assembly pose, shape (m,)."""
        return self._assembly.position_rad[list(self.robot.axis_joints)]

    def _reached(self, position: FloatArray) -> _Reached:
        found = reach(self.robot, self._assembly, position)
        usable = (
            found.closed
            & (found.condition < LARGEST_PLANNED_CONDITION)
            & (found.misfit < LARGEST_PLANNED_MISFIT)
        )
        return _Reached(found.position_rad, usable)

    def apart(self, position: FloatArray) -> FloatArray:
        """Share of postures, shape (k, n), in which each of the scene's pairs does not touch,
        shape (pairs,).
        """
        if self.robot.is_constrained:
            found = self._reached(position)
            position = found.joints[found.usable]
        margins = self._margins(position, self._everywhere)[: len(self.scene.pairs)]
        return np.asarray((margins + self.scene.minimum_m > 0.0).mean(axis=1))

    def obstruction(self, start: FloatArray, end: FloatArray) -> Obstruction | None:
        """Find an obstruction on a straight line in joint space, None when all of it is clear.

        Args:
            start, end: positions of the axes [rad or m], shape (m,).
        """
        if self.robot.is_constrained:
            return self._ways(start[None], end[None])[0]
        # A bound on the path of any point of one body relative to the other, for each row of
        # `_margins` [m].
        rows = [*self._pairs, *((index, len(self.scene.capsules)) for index in self._confined)]
        travel = np.array(
            [self._relative_travel(first, second, start, end) for first, second in rows]
        )
        middles = np.array([0.5])
        half = 0.5
        while len(middles):
            position = start + (end - start) * middles[:, None]
            needed = half * travel
            margins = self._margins(position, needed)
            unsure = margins < needed[:, None]
            blocked = (margins < 0.0) | (unsure & (needed < RESOLUTION_M)[:, None])
            if blocked.any():
                row, sample = np.argwhere(blocked)[0]
                margin_m = float(margins[row, sample])
                where = tuple(position[sample].tolist())
                if row < len(self._pairs):
                    first, second = (self._names[index] for index in self._pairs[row])
                    return Obstruction(first, second, margin_m + self.scene.minimum_m, where)
                confined = self.scene.capsules[self._confined[row - len(self._pairs)]]
                return Obstruction(confined.name, WORKSPACE_END, margin_m, where)
            half /= 2.0
            open_ = middles[unsure.any(axis=0)]
            middles = np.concatenate((open_ - half, open_ + half))
        return None

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
        inside = np.all((ends >= lower) & (ends <= upper), axis=1)
        if not self.robot.is_constrained:
            return next((end for end in ends[inside] if self.obstruction(start, end) is None), None)
        found = self._ways(np.broadcast_to(start, ends.shape), ends)
        clear = (
            end
            for end, within, obstruction in zip(ends, inside, found, strict=True)
            if within and not obstruction
        )
        return next(clear, None)

    def _ways(self, starts: FloatArray, ends: FloatArray) -> list[Obstruction | None]:
        """Look at poses of straight ways so close to each other that nothing happens between
        them.
        """
        share = np.linspace(0.0, 1.0, round(1.0 / STEP_SHARE) + 1)[:, None]
        position = starts[:, None] + (ends - starts)[:, None] * share
        shape = position.shape[:2]
        found = self._reached(position.reshape(-1, position.shape[2]))
        usable = found.usable.reshape(shape)
        margins = self._margins(found.joints, self._everywhere)
        # A body moves at most as far between two poses as the fastest of its ends: from the nearer
        # one at most half of that, and two bodies that both move come closer by all of it. (The way
        # of an end between poses is taken as straight; it is bent by less than a hundredth of its
        # length.)
        both = np.array(
            [max(pair) < len(self.scene.capsules) for pair in self._pairs]
            + [False] * len(self._confined)
        )
        placed = self._placed(found.joints).reshape(-1, *shape, 3, 2)
        travel = np.linalg.norm(np.diff(placed, axis=2), axis=3).max(axis=(0, 2, 3), initial=0.0)
        answers: list[Obstruction | None] = []
        for way, moved in enumerate(travel.tolist()):
            own = margins.reshape(-1, *shape)[:, way] - moved * np.where(both, 1.0, 0.5)[:, None]
            if not usable[way].all():
                at = tuple(position[way, int(np.argmin(usable[way]))].tolist())
                answers.append(Obstruction(CLOSURES, "a pose that they allow", 0.0, at))
            elif not own.size or own.min() >= 0.0:
                answers.append(None)
            else:
                row, sample = np.unravel_index(int(np.argmin(own)), own.shape)
                first, second = self._names_of(int(row))
                distance_m = float(own[row, sample]) + (
                    self.scene.minimum_m if row < len(self._pairs) else 0.0
                )
                answers.append(
                    Obstruction(first, second, distance_m, tuple(position[way, sample].tolist()))
                )
        return answers

    def _names_of(self, row: int) -> tuple[str, str]:
        if row < len(self._pairs):
            first, second = self._pairs[row]
            return self._names[first], self._names[second]
        return self.scene.capsules[self._confined[row - len(self._pairs)]].name, WORKSPACE_END

    def _placed(self, joints: FloatArray) -> FloatArray:
        """Both ends of every body in each posture, shape (bodies, k, 3, 2)."""
        at = poses(self.robot, joints)
        return np.asarray(
            at.rotation[self._frame] @ self._ends[:, None] + at.origin_m[self._frame][..., None]
        )

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
        middle = 0.5 * (start + end)
        between = _length(middle[first] - middle[second])
        out[:pairs] = (
            between - (self._sphere[first] + self._sphere[second] + self.scene.minimum_m)[:, None]
        )
        row, sample = np.nonzero(out[:pairs] < needed[:pairs, None])
        to_box = second[row] >= len(self.scene.capsules)
        for distance, chosen in ((segment_to_segment, ~to_box), (segment_to_box, to_box)):
            if chosen.any():
                number = row[chosen]
                k = sample[chosen]
                one = first[number]
                other = second[number]
                kept = self._radius[one] + self._radius[other] + self.scene.minimum_m
                out[number, k] = (
                    distance(start[one, k], end[one, k], start[other, k], end[other, k]) - kept
                )
        if self.scene.workspace is not None:
            lower = np.array(self.scene.workspace.lower_m)
            upper = np.array(self.scene.workspace.upper_m)
            for last, index in enumerate(self._confined, start=pairs):
                inside = [
                    np.minimum(ends[index] - lower, upper - ends[index]).min(axis=1)
                    for ends in (start, end)
                ]
                out[last] = np.minimum(*inside) - self._radius[index]
        return out

    def _relative_travel(
        self, first: int, second: int, start: FloatArray, end: FloatArray
    ) -> float:
        capsules = self.scene.capsules
        links = [
            capsules[index].link if index < len(capsules) else BASE for index in (first, second)
        ]
        chains = [self._chain(link) for link in links]
        total = 0.0
        for index, chain, other in ((first, chains[0], chains[1]), (second, chains[1], chains[0])):
            if index >= len(capsules):
                continue
            lever = max(
                float(np.linalg.norm(point))
                for point in (capsules[index].start_m, capsules[index].end_m)
            )
            for joint in chain:  # from the capsule towards the base
                if joint in other:
                    break
                declared = self.robot.joints[joint]
                distance = abs(float(end[joint] - start[joint]))
                prismatic = declared.kind is JointKind.PRISMATIC
                total += distance * (1.0 if prismatic else lever)
                lever += float(np.linalg.norm(declared.translation_m))
                if prismatic:
                    lever += max(abs(float(start[joint])), abs(float(end[joint])))
                else:
                    lever += 0.0
        return total

    def _chain(self, link: int) -> list[int]:
        """Joints from a link to the base."""
        chain = []
        while link != BASE:
            chain.append(link)
            link = self.robot.joints[link].parent
        return chain


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
    e = _dot(other, other)
    c = _dot(along, between)
    f = _dot(other, between)
    t = _share(b * _share(b * f - c * e, a * e - b * b) + f, e)
    s = _share(b * t - c, a)
    return _length(between + s[:, None] * along - t[:, None] * other)


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
    along = end - start
    crossings = [_share(plane - start, along) for plane in (lower, upper)]
    limits = np.broadcast_to([0.0, 1.0], (len(start), 2))
    bends = np.sort(np.concatenate((*crossings, limits), axis=1), axis=1)
    at_bends = start[:, None] + along[:, None] * bends[:, :, None]
    slope = _dot(along[:, None], at_bends - np.clip(at_bends, lower[:, None], upper[:, None]))
    # The first bend behind the zero
    after = np.clip((slope < 0.0).sum(axis=1), 1, bends.shape[1] - 1)
    sample = np.arange(len(start))
    low = slope[sample, after - 1]
    high = slope[sample, after]
    first = bends[sample, after - 1]
    last = bends[sample, after]
    nearest = start + along * (first + (last - first) * _share(-low, high - low))[:, None]
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
    crosses = np.cross(edges, (end - start)[:, None])
    length = np.linalg.norm(crosses, axis=2)
    normals = np.concatenate(
        (edges, crosses / np.where(length > 0.0, length, 1.0)[:, :, None]), axis=1
    )
    middle = 0.5 * (lower + upper)
    half = 0.5 * (upper - lower)
    ends = np.einsum("knd,ekd->ekn", normals, np.stack((start - middle, end - middle)))
    depths = np.einsum("knd,kd->kn", np.abs(normals), half) + np.minimum(
        ends.max(axis=0), -ends.min(axis=0)
    )
    depths[:, 3:][length == 0.0] = np.inf
    return np.asarray(depths.min(axis=1))


def _share(numerator: FloatArray, denominator: FloatArray) -> FloatArray:
    """Quotient clipped to 0 … 1; 0 where the denominator is zero."""
    quotient = np.zeros_like(numerator)
    with np.errstate(over="ignore"):
        np.divide(numerator, denominator, out=quotient, where=denominator != 0.0)
    return np.minimum(np.maximum(quotient, 0.0), 1.0)


def _dot(first: FloatArray, second: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("...d,...d->...", first, second))


def _length(vectors: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(_dot(vectors, vectors)))
