"""Gravity by the torques is estimated with the rest of the description as it is."""

from __future__ import annotations

import numpy as np
import pytest

from daq.report.described_geometry import checked_geometry, geometry_notes
from ident.discovery.geometry_check import GeometryCheck, Gravity
from ident.errors import Diagnosis
from tests.ident.recordings import three_axes_truth

AXES = ("J1", "J2", "J3")
DOWN = np.array([0.0, 0.0, -9.81])
CHECK = GeometryCheck(
    gravity=Gravity(DOWN, DOWN, np.radians(0.18), np.radians(0.04), np.zeros((2, 2))),
    mistakes=(),
    hidden_zeros=(),
)


def diagnosed(name: str, *axes: str, runs: tuple[str, ...] = ()) -> Diagnosis:
    return Diagnosis(name, runs, axes, "a number", "another", "correct it")


@pytest.mark.parametrize(
    ("diagnosis", "expected"),
    [
        (diagnosed("zero-off", "J2"), ["zero-off J2"]),
        (diagnosed("correction-unclear", "J2", "J3"), ["correction-unclear J2 J3"]),
        (diagnosed("gravity-tilted"), []),
        (diagnosed("axis-error", "J3"), []),
        (diagnosed("zero-off", "J2", runs=("held-out",)), []),
    ],
)
def test_another_mistake_of_the_description_is_named_beside_gravity(
    diagnosis: Diagnosis, expected: list[str]
) -> None:
    robot = three_axes_truth().model.robot
    (note,) = geometry_notes(CHECK, AXES, robot, (diagnosis,))
    assert "0.18 ± 0.04°" in note
    assert note.startswith("With the description as it is") == bool(expected)
    for name in expected:
        assert f"({name} not corrected)" in note
    found = checked_geometry(CHECK, AXES, robot, (diagnosis,))
    assert found is not None
    assert found.gravity is not None
    assert found.gravity.not_corrected == expected
