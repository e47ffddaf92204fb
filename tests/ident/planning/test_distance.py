"""Distances of segments and boxes, against those of coal, which finds them by iteration."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from pinocchio import coal

from ident.planning.clearance import segment_to_box, segment_to_segment

FloatArray = NDArray[np.float64]

COUNT = 4000
RADIUS_M = 0.05
ITERATED_M = 5e-6
"""How far coal's iterated distances are off; those of two capsules it has in closed form."""


def _segments(seed: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Pairs of segments in general position, without length, parallel,
    and with ends on a coarse grid.
    """
    rng = np.random.default_rng(seed)
    start, end, other_start, other_end = rng.uniform(-1.0, 1.0, (4, COUNT, 3))
    end[:400] = start[:400]
    other_end[200:600] = other_start[200:600]
    other_end[600:1000] = (
        other_start[600:1000] + rng.uniform(-1.0, 1.0, (400, 1)) * (end - start)[600:1000]
    )
    for ends in (start, end, other_start, other_end):
        ends[1000:2000] = 0.3 * rng.integers(-1, 2, (1000, 3))
    return start, end, other_start, other_end


def _capsule(start: FloatArray, end: FloatArray) -> tuple[coal.CollisionGeometry, coal.Transform3s]:
    difference_norm = np.linalg.norm(end - start)
    length = float(difference_norm)
    if length == 0.0:
        return coal.Sphere(RADIUS_M), coal.Transform3s(np.eye(3), start)
    z = (end - start) / length
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    rotation = np.column_stack((x, np.cross(z, x), z))
    capsule = coal.Capsule(RADIUS_M, length)
    transform3s = coal.Transform3s(rotation, (start + end) / 2)
    return capsule, transform3s


def _distance(
    first: tuple[coal.CollisionGeometry, coal.Transform3s],
    second: tuple[coal.CollisionGeometry, coal.Transform3s],
) -> float:
    return float(coal.distance(*first, *second, coal.DistanceRequest(), coal.DistanceResult()))


@pytest.mark.slow
def test_distances_of_capsules_are_those_of_coal() -> None:
    ends = _segments(0)
    expected = [_distance(_capsule(a, b), _capsule(c, d)) for a, b, c, d in zip(*ends, strict=True)]
    found = segment_to_segment(*ends)
    absolute_expected = np.abs(found - 2.0 * RADIUS_M - expected)
    assert absolute_expected.max() < 1e-9
    assert (found == 0.0).any()  # segments of the grid that cross


@pytest.mark.slow
def test_distances_to_boxes_and_depths_inside_are_those_of_coal() -> None:
    start, end, corner, size = _segments(1)
    lower = 0.5 * corner
    upper = 0.5 * corner + np.maximum(np.abs(size), 0.001)
    expected = [
        _distance(
            _capsule(a, b), (coal.Box(*(high - low)), coal.Transform3s(np.eye(3), (low + high) / 2))
        )
        for a, b, low, high in zip(start, end, lower, upper, strict=True)
    ]
    found = segment_to_box(start, end, lower, upper)
    absolute_radius_m = np.abs(found - RADIUS_M - expected)
    assert absolute_radius_m.max() < ITERATED_M
    assert 0.05 < (found < 0.0).mean() < 0.95


@pytest.mark.parametrize("reach", [1e-9, 1e-6, 1e-3, 1.0])
def test_nearly_parallel_segments_lose_no_precision(reach: float) -> None:
    """Two of length one, 0.1 m apart, crossed by less and less."""
    start = np.array([[-0.5, 0.0, 0.0]])
    end = np.array([[0.5, 0.0, 0.0]])
    other = np.array([[-0.5, -reach, 0.1]]), np.array([[0.5, reach, 0.1]])
    assert segment_to_segment(start, end, *other)[0] == pytest.approx(0.1, abs=1e-12)
    assert segment_to_segment(*other, end, start)[0] == pytest.approx(0.1, abs=1e-12)
