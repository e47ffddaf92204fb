"""Whether an arm keeps clear of itself, of obstacles and of the walls of its workspace, along a whole move.

Links are capsules. A synchronised point-to-point move is a straight line in joint space, q(s) = q₀ + s Δq, so no point
of a capsule on link b moves relative to link a by more than Σ_k |Δq_k| ℓ_k over the whole of it, with k the joints
between the two and ℓ_k the longest lever from joint k to the capsule. A stretch of half-width h about s is clear when
the distance at s is at least h times that; else it is halved. So nothing is jumped over, whatever the speed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident.model.kinematics import Poses, poses
from ident.model.robot import JointKind, Robot

# Distances of segments from segments and from boxes, in closed form, for many samples at once.
#
# A capsule is a segment with a radius, so the distance of two capsules, or of a capsule and a box, is one of these
# less
# the radii.


def segment_to_segment(
    start: FloatArray, end: FloatArray, other_start: FloatArray, other_end: FloatArray
) -> FloatArray:
    """Distance of two segments in each sample [m].

    The nearest points are an end of one segment and a point of the other, or lie inside both, where the straight lines
    through them are nearest to each other. The minimum of all five candidates is exact for parallel segments and
    segments without length, too.

    Args:
        start, end, other_start, other_end: ends of the segments [m], shape (k, 3).

    Returns:
        shape (k,).
    """
    along, other, between = end - start, other_end - other_start, start - other_start
    a, b, e = _dot(along, along), _dot(along, other), _dot(other, other)
    c, f = _dot(along, between), _dot(other, between)
    inside = start + along * _share(b * f - c * e, a * e - b * b)[:, None]
    candidates = (
        _point_to_segment(inside, other_start, other_end),
        _point_to_segment(start, other_start, other_end),
        _point_to_segment(end, other_start, other_end),
        _point_to_segment(other_start, start, end),
        _point_to_segment(other_end, start, end),
    )
    return np.asarray(np.min(candidates, axis=0))


def segment_to_box(start: FloatArray, end: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Distance of a segment from an axis-aligned box in each sample [m], negative where they overlap.

    Half the derivative of the squared distance along the segment, d · excess(t), is piecewise linear and never falls.
    It bends where the segment crosses the plane of a face; between two bends its zero follows from a straight line.

    Args:
        start, end: ends of the segment [m], shape (k, 3).
        lower, upper: opposite corners of the box [m], shape (k, 3).

    Returns:
        shape (k,); where the two overlap, minus the shortest way that separates them.
    """
    along = end - start
    crossings = [_share(plane - start, along) for plane in (lower, upper)]
    limits = np.broadcast_to([0.0, 1.0], (len(start), 2))
    bends = np.sort(np.concatenate((*crossings, limits), axis=1), axis=1)
    at_bends = start[:, None] + along[:, None] * bends[:, :, None]
    slope = _dot(along[:, None], at_bends - np.clip(at_bends, lower[:, None], upper[:, None]))
    after = np.clip((slope < 0.0).sum(axis=1), 1, bends.shape[1] - 1)  # the first bend behind the zero
    sample = np.arange(len(start))
    low, high = slope[sample, after - 1], slope[sample, after]
    first, last = bends[sample, after - 1], bends[sample, after]
    nearest = start + along * (first + (last - first) * _share(-low, high - low))[:, None]
    distance = np.linalg.norm(nearest - np.clip(nearest, lower, upper), axis=1)
    depth = _depth(start, end, lower, upper)
    return np.where(depth > 0.0, -depth, distance)


def _depth(start: FloatArray, end: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Shortest way that takes a segment out of a box that it enters, shape (k,); not positive where they are apart.

    It is along a normal of a face of their Minkowski difference: an edge of the box, or the cross product of one with
    the segment.
    """
    edges = np.broadcast_to(np.eye(3), (len(start), 3, 3))
    crosses = np.cross(edges, (end - start)[:, None])
    length = np.linalg.norm(crosses, axis=2)
    normals = np.concatenate((edges, crosses / np.where(length > 0.0, length, 1.0)[:, :, None]), axis=1)
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    ends = np.einsum("knd,ekd->ekn", normals, np.stack((start - middle, end - middle)))
    ways = np.einsum("knd,kd->kn", np.abs(normals), half) + np.minimum(ends.max(axis=0), -ends.min(axis=0))
    ways[:, 3:][length == 0.0] = np.inf
    return np.asarray(ways.min(axis=1))


def _point_to_segment(point: FloatArray, start: FloatArray, end: FloatArray) -> FloatArray:
    along = end - start
    share = _share(_dot(point - start, along), _dot(along, along))
    return np.asarray(np.linalg.norm(point - start - along * share[:, None], axis=1))


def _share(numerator: FloatArray, denominator: FloatArray) -> FloatArray:
    """The quotient within 0 to 1; 0 where the denominator is zero."""
    usable = denominator != 0.0
    with np.errstate(over="ignore"):
        return np.clip(np.divide(numerator, denominator, out=np.zeros_like(numerator), where=usable), 0.0, 1.0)


def _dot(first: FloatArray, second: FloatArray) -> FloatArray:
    return np.asarray((first * second).sum(axis=-1))


FloatArray = NDArray[np.float64]

BASE = -1
"""Index of the link that does not move."""
RESOLUTION_M = 0.004
"""A stretch in which nothing moves farther than this, and which is still not known to be clear, counts as blocked."""


@dataclass(frozen=True, slots=True)
class Capsule:
    """All points within a radius of a segment.

    Attributes:
        name: for messages.
        link: index of the joint that it moves with, BASE for the base.
        start_m, end_m: of the segment, in that joint's frame (3 numbers each).
        radius_m: above zero.
    """

    name: str
    link: int
    start_m: tuple[float, float, float]
    end_m: tuple[float, float, float]
    radius_m: float


@dataclass(frozen=True, slots=True)
class Box:
    """Axis-aligned in the base frame.

    Attributes:
        name: for messages.
        lower_m, upper_m: opposite corners.
    """

    name: str
    lower_m: tuple[float, float, float]
    upper_m: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Scene:
    """What must keep apart.

    Attributes:
        capsules: of the arm and of what it carries.
        pairs: indices of capsules that must keep apart.
        boxes: obstacles; capsules of the base may touch them.
        workspace: in which the confined capsules must stay, None for no bounds.
        confined: indices of capsules.
        minimum_m: distance that must be kept.
    """

    capsules: tuple[Capsule, ...]
    pairs: tuple[tuple[int, int], ...]
    boxes: tuple[Box, ...]
    workspace: Box | None
    confined: tuple[int, ...]
    minimum_m: float


@dataclass(frozen=True, slots=True)
class Obstruction:
    """Why a way is not clear.

    Attributes:
        first, second: what comes too near to what.
        distance_m: found there; negative when they overlap.
        position: of the joints there [rad or m].
    """

    first: str
    second: str
    distance_m: float
    position: tuple[float, ...]


class Checker:
    """A scene made ready for many questions: each asks for the distance of two things."""

    def __init__(self, robot: Robot, scene: Scene) -> None:
        self.robot = robot
        self.scene = scene
        moving = [index for index, capsule in enumerate(scene.capsules) if capsule.link != BASE]
        boxes = range(len(scene.capsules), len(scene.capsules) + len(scene.boxes))
        # Capsules are numbered as in the scene, boxes behind them.
        self._questions = [*scene.pairs, *((index, box) for index in moving for box in boxes)]
        self._confined = scene.confined if scene.workspace is not None else ()
        self._first, self._second = np.array(self._questions, dtype=np.int64).reshape(-1, 2).T
        self._radius = np.array([capsule.radius_m for capsule in scene.capsules] + [0.0] * len(scene.boxes))
        self._lower = np.array([box.lower_m for box in scene.boxes]).reshape(-1, 3)
        self._upper = np.array([box.upper_m for box in scene.boxes]).reshape(-1, 3)

    def margins(self, position: FloatArray) -> FloatArray:
        """Distance beyond the minimum of the nearest two things; negative where it is not kept [m].

        Args:
            position: of the joints [rad or m], shape (n, k).

        Returns:
            shape (k,); inf where there is nothing to be near to.
        """
        far = np.full(len(self._questions) + len(self._confined), np.inf)
        return np.asarray(self._margins(position, far).min(axis=0, initial=np.inf))

    def apart(self, position: FloatArray) -> FloatArray:
        """Share of the samples in which each of the scene's pairs does not touch, shape (pairs,)."""
        far = np.full(len(self._questions) + len(self._confined), np.inf)
        margins = self._margins(position, far)[: len(self.scene.pairs)]
        return np.asarray((margins + self.scene.minimum_m > 0.0).mean(axis=1))

    def obstruction(self, start: FloatArray, end: FloatArray) -> Obstruction | None:
        """One that lies on a straight line in joint space, None when all of it is clear.

        Args:
            start, end: positions of the joints [rad or m], shape (n,).
        """
        travel = self._travel(start, end)
        middles, half = np.array([0.5]), 0.5
        while len(middles):
            position = start[:, None] + (end - start)[:, None] * middles
            needed = half * travel
            margins = self._margins(position, needed)
            unsure = margins < needed[:, None]
            blocked = (margins < 0.0) | (unsure & (needed < RESOLUTION_M)[:, None])
            if blocked.any():
                question, sample = np.argwhere(blocked)[0]
                return self._obstruction_at(int(question), float(margins[question, sample]), position[:, sample])
            half /= 2.0
            open_ = middles[unsure.any(axis=0)]
            middles = np.concatenate((open_ - half, open_ + half))
        return None

    def _margins(self, position: FloatArray, needed: FloatArray) -> FloatArray:
        """Of each question, shape (questions, k); where spheres around both are farther apart than needed, theirs."""
        at = poses(self.robot, position.T)
        samples, capsules, boxes = position.shape[1], self.scene.capsules, len(self.scene.boxes)
        start = np.empty((len(capsules) + boxes, samples, 3))
        end = np.empty_like(start)
        for index, capsule in enumerate(capsules):
            start[index], end[index] = _at(at, capsule.link, capsule.start_m), _at(at, capsule.link, capsule.end_m)
        start[len(capsules) :], end[len(capsules) :] = self._lower[:, None], self._upper[:, None]
        middle, sphere = 0.5 * (start + end), 0.5 * np.linalg.norm(end - start, axis=2) + self._radius[:, None]
        out = np.empty((len(needed), samples))
        asked, first, second = len(self._questions), self._first, self._second
        out[:asked] = np.linalg.norm(middle[first] - middle[second], axis=2) - sphere[first] - sphere[second]
        out[:asked] -= self.scene.minimum_m
        near = out[:asked] < needed[:asked, None]
        for boxed, distance in ((False, segment_to_segment), (True, segment_to_box)):
            row, sample = np.nonzero(near & ((second >= len(capsules)) == boxed)[:, None])
            if row.size:
                a, b = (first[row], sample), (second[row], sample)
                radii = self._radius[first[row]] + self._radius[second[row]]
                out[row, sample] = distance(start[a], end[a], start[b], end[b]) - radii - self.scene.minimum_m
        if self.scene.workspace is not None:
            lower, upper = np.array(self.scene.workspace.lower_m), np.array(self.scene.workspace.upper_m)
            for number, index in enumerate(self._confined, start=asked):
                inside = [np.minimum(ends[index] - lower, upper - ends[index]).min(axis=1) for ends in (start, end)]
                out[number] = np.minimum(*inside) - capsules[index].radius_m
        return out

    def _travel(self, start: FloatArray, end: FloatArray) -> FloatArray:
        """Bound on the way of any point of one thing as the other sees it, for each question [m]."""
        pairs = [*self._questions, *((index, len(self.scene.capsules)) for index in self._confined)]
        return np.array([self._relative_travel(first, second, start, end) for first, second in pairs])

    def _relative_travel(self, first: int, second: int, start: FloatArray, end: FloatArray) -> float:
        capsules = self.scene.capsules
        links = [capsules[index].link if index < len(capsules) else BASE for index in (first, second)]
        chains = [self._chain(link) for link in links]
        total = 0.0
        for index, chain, other in ((first, chains[0], chains[1]), (second, chains[1], chains[0])):
            if index >= len(capsules):
                continue
            lever = max(float(np.linalg.norm(point)) for point in (capsules[index].start_m, capsules[index].end_m))
            for joint in chain:  # from the capsule towards the base
                if joint in other:
                    break
                declared = self.robot.joints[joint]
                way = abs(float(end[joint] - start[joint]))
                prismatic = declared.kind is JointKind.PRISMATIC
                total += way * (1.0 if prismatic else lever)
                lever += float(np.linalg.norm(declared.translation_m))
                lever += max(abs(float(start[joint])), abs(float(end[joint]))) if prismatic else 0.0
        return total

    def _chain(self, link: int) -> list[int]:
        chain = []
        while link != BASE:
            chain.append(link)
            link = self.robot.joints[link].parent
        return chain

    def _obstruction_at(self, question: int, margin_m: float, position: FloatArray) -> Obstruction:
        where = tuple(float(value) for value in position)
        if question < len(self._questions):
            names = [thing.name for things in (self.scene.capsules, self.scene.boxes) for thing in things]
            first, second = (names[index] for index in self._questions[question])
            return Obstruction(first, second, margin_m + self.scene.minimum_m, where)
        confined = self.scene.capsules[self._confined[question - len(self._questions)]]
        return Obstruction(confined.name, "the end of the workspace", margin_m, where)


def _at(at: Poses, link: int, point_m: tuple[float, float, float]) -> FloatArray:
    return np.asarray(at.origin_m[link + 1] + at.rotation[link + 1] @ np.array(point_m))
