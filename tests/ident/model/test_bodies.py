"""A payload is a body: values that no body has are refused, those of any body are not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ident.errors import ModelError
from ident.model.bodies import LINK_PARAMETERS, Body, Payload

COORDINATE = st.floats(-0.5, 0.5)
POINTS = st.lists(st.tuples(st.floats(0.01, 5.0), COORDINATE, COORDINATE, COORDINATE), min_size=1, max_size=8)


def _of_points(points: list[tuple[float, float, float, float]]) -> dict[str, float]:
    """Parameters of point masses about the origin."""
    total = np.zeros(10)
    for mass, x, y, z in points:
        total += Body(mass, np.array([x, y, z]), np.zeros((3, 3))).parameters
    return dict(zip(LINK_PARAMETERS, total.tolist(), strict=True))


@settings(max_examples=100, deadline=None)
@given(points=POINTS, kept=st.sets(st.sampled_from(LINK_PARAMETERS)))
def test_what_is_known_of_any_body_is_taken(points: list[tuple[float, float, float, float]], kept: set[str]) -> None:
    """Also of points on a line, whose inertia is the least that there is, and of a part of the parameters."""
    whole = _of_points(points)
    assert Payload("disc", "flange", whole).known == whole
    Payload("disc", "flange", {name: whole[name] for name in kept})


@settings(max_examples=50, deadline=None)
@given(points=POINTS.filter(lambda points: max(abs(point[1]) for point in points) > 0.05), share=st.floats(0.0, 0.9))
def test_an_inertia_too_small_for_its_first_moments_is_refused(
    points: list[tuple[float, float, float, float]], share: float
) -> None:
    """A single point has the least inertia of its mass and place; less is of none."""
    mass = sum(point[0] for point in points)
    centre = np.array([[point[0] * value / mass for value in point[1:]] for point in points]).sum(axis=0)
    if np.linalg.norm(centre) < 0.02:
        return
    least = _of_points([(mass, *centre.tolist())])
    too_small = {name: value * (share if name.startswith("I") else 1.0) for name, value in least.items()}
    with pytest.raises(ModelError, match="inertia that is too small for its mass"):
        Payload("disc", "flange", too_small)


INERTIA = {"Ixx": 0.02, "Ixy": 0.0, "Ixz": 0.0, "Iyy": 0.03, "Iyz": 0.0, "Izz": 0.04}


@pytest.mark.parametrize(
    ("known", "words"),
    [
        ({"m": 0.0}, "a mass of 0 kg"),
        ({"m": -4.59}, "a mass of -4.59 kg"),
        ({"m": float("nan")}, "m = nan"),
        ({"m": 4.59, "mx": float("inf")}, "mx = inf"),
        ({**INERTIA, "Izz": 0.06}, "above the sum of the other two"),
        ({**INERTIA, "Ixx": -0.02}, "moments of inertia of which one is below zero"),
        ({**INERTIA, "Ixy": 0.05}, "moments of inertia"),
    ],
)
def test_values_of_no_body_are_refused(known: dict[str, float], words: str) -> None:
    with pytest.raises(ModelError, match=words):
        Payload("disc", "flange", known)
