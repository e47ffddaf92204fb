"""Base parameters of a robot are taken for its own, also from poor data;
those of another robot are not.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ident.model.base import base_parameters
from ident.model.model import DriveTrain, Model
from ident.model.robot import Motion
from ident.model.same_robot import foreign_base_parameter
from ident.model.urdf import robot_from_urdf
from tests.ident.arms import ARMS, GRAVITIES, TX40, Arm
from tests.ident.recordings import RATIO

SAMPLES = 200


def _model(
    arm: Arm, urdf: str | None = None, gravity: tuple[float, float, float] = GRAVITIES[0]
) -> Model:
    robot = robot_from_urdf(urdf or arm.urdf, gravity)
    ratio = RATIO if arm is TX40 else np.eye(robot.joint_count)
    return Model(robot, DriveTrain(ratio))


def _names(model: Model, moving: list[int], seed: int = 1) -> tuple[str, ...]:
    """Names of the base parameters that a motion of some joints determines; the others stand."""
    count = model.robot.axis_count
    rng = np.random.default_rng(seed)
    drawn = rng.uniform(-1.0, 1.0, (3, SAMPLES, count))
    stand = [joint for joint in range(count) if joint not in moving]
    drawn[:, :, stand] = 0.0
    velocity_rad_s = 2.0 * drawn[1]
    acceleration_rad_s2 = 6.0 * drawn[2]
    motion = Motion(drawn[0], velocity_rad_s, acceleration_rad_s2)
    regressor = model.regressor(motion)
    rows = regressor.transpose(0, 2, 1).reshape(-1, regressor.shape[1])
    triangle = np.asarray(np.linalg.qr(rows, mode="r"))
    names = tuple(column.name for column in model.columns)
    return base_parameters(triangle, names).names


@pytest.mark.parametrize("arm", ARMS, ids=[arm.name for arm in ARMS])
def test_the_base_parameters_of_a_robot_are_its_own(arm: Arm) -> None:
    model = _model(arm)
    every = list(range(model.robot.axis_count))
    names = _names(model, every)
    assert foreign_base_parameter(model, names) is None


@settings(max_examples=20, deadline=None)
@given(arm=st.sampled_from(ARMS), data=st.data())
def test_those_of_a_motion_of_some_joints_are_its_own_too(arm: Arm, data: st.DataObject) -> None:
    model = _model(arm)
    joints = st.integers(0, model.robot.axis_count - 1)
    moving = data.draw(st.lists(joints, min_size=1, unique=True))
    names = _names(model, moving)
    assert foreign_base_parameter(model, names) is None


@pytest.mark.parametrize(
    ("of", "given_as"),
    [
        ("0.225 0 0.035", "0.250 0 0.035"),  # a length
        ("0.225 0 0.035", "0.225 0 0.055"),  # an offset beside it
    ],
)
def test_those_of_a_longer_robot_are_not(of: str, given_as: str) -> None:
    model = _model(TX40)
    urdf = TX40.urdf.replace(of, given_as)
    longer = _model(TX40, urdf)
    moving = list(range(6))
    names = _names(model, moving)
    foreign = foreign_base_parameter(longer, names)
    assert foreign in names
    assert foreign_base_parameter(model, _names(longer, list(range(6)))) is not None


def test_a_corrected_length_is_no_other_robot() -> None:
    model = _model(TX40)
    urdf = TX40.urdf.replace("0.225 0 0.035", "0.22502 0 0.035")
    corrected = _model(TX40, urdf)
    moving = list(range(6))
    names = _names(model, moving)
    assert foreign_base_parameter(corrected, names) is None


def test_a_parameter_that_moves_nothing_here_is_of_no_other_robot() -> None:
    """A base that leans shows first moments of the first link, which an upright one does not."""
    gravity = (0.5, 0.3, -9.79)
    leaning = _model(TX40, gravity=gravity)
    upright = _model(TX40)
    moving = list(range(6))
    names = _names(leaning, moving)
    assert len(names) > len(_names(upright, list(range(6))))
    assert foreign_base_parameter(leaning, names) is None
    assert foreign_base_parameter(upright, names) is None


def test_no_parameters_contradict_nothing() -> None:
    assert foreign_base_parameter(_model(TX40), ()) is None
