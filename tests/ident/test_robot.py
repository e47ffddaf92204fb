"""What a URDF must be for its joints to be a robot's."""

from __future__ import annotations

import pytest

from ident.errors import ModelError
from ident.robot import robot_from_urdf
from tests.ident.arms import SEVEN_AXES


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (('<axis xyz="0 0 1"/>', '<axis xyz="0 0 0"/>'), "direction of length one"),
        (('xyz="0 0.01 0.2"', 'xyz="0 10 200"'), "in mm"),
        (('xyz="0 0.01 0.2"', 'xyz="0 1e200 0.2"'), "expected at most"),
    ],
)
def test_no_geometry_that_cannot_be(wrong: tuple[str, str], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        robot_from_urdf(SEVEN_AXES.urdf.replace(*wrong, 1))


def test_the_arms_of_the_tests_can_be() -> None:
    assert robot_from_urdf(SEVEN_AXES.urdf).joint_count == 7
