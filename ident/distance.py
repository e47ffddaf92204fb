"""Distances of segments from segments and from boxes, in closed form, for many samples at once.

A capsule is a segment with a radius, so the distance of two capsules, or of a capsule and a box, is one of these less
the radii.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


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
