"""Clearance: distances, and that nothing is jumped over."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ident.model.robot import poses
from ident.model.urdf import robot_from_urdf
from ident.planning.clearance import BASE, RESOLUTION_M, Box, Capsule, Checker, Scene
from tests.ident.arms import ARMS, GANTRY, SEVEN_AXES, TX40, Arm

FloatArray = NDArray[np.float64]


def _scene(last: int, minimum_m: float = 0.01) -> Scene:
    capsules = (
        Capsule("column", BASE, (0.0, 0.0, 0.0), (0.0, 0.0, 0.25), 0.07),
        Capsule("upper", 1, (0.0, 0.0, 0.0), (0.18, 0.0, 0.03), 0.06),
        Capsule("tool", last, (0.0, 0.0, 0.05), (0.0, 0.02, 0.2), 0.05),
        Capsule("ball", last, (0.05, 0.0, 0.1), (0.05, 0.0, 0.1), 0.04),
    )
    boxes = (Box("post", (0.3, -0.6, 0.0), (0.31, 0.6, 0.7)),)
    workspace = Box("workspace", (-1.5, -1.5, -0.2), (1.5, 1.5, 1.5))
    return Scene(capsules, ((0, 2), (1, 2), (0, 3)), boxes, workspace, (2, 3), minimum_m)


@pytest.mark.parametrize("arm", ARMS, ids=lambda arm: arm.name)
def test_poses_are_those_of_pinocchio(arm: Arm) -> None:
    robot = robot_from_urdf(arm.urdf)
    model = pin.buildModelFromXML(arm.urdf)
    data = model.createData()
    positions = np.random.default_rng(0).uniform(-2.0, 2.0, (model.nq, 5))
    found = poses(robot, positions.T)
    for sample in range(5):
        pin.forwardKinematics(model, data, positions[:, sample])
        for joint in range(model.nq):
            assert found.origin_m[joint + 1, sample] == pytest.approx(
                data.oMi[joint + 1].translation, abs=1e-12
            )
            assert found.rotation[joint + 1, sample] == pytest.approx(
                data.oMi[joint + 1].rotation, abs=1e-12
            )


def _segment_distance(a0: FloatArray, a1: FloatArray, b0: FloatArray, b1: FloatArray) -> float:
    """By brute force."""
    grid = np.linspace(0.0, 1.0, 201)
    first, second = (p + grid[:, None] * (q - p) for p, q in ((a0, a1), (b0, b1)))
    return float(np.linalg.norm(first[:, None] - second[None], axis=2).min())


def test_distances_are_those_of_the_segments() -> None:
    robot = robot_from_urdf(TX40.urdf)
    scene = _scene(5)
    bare = Scene(scene.capsules[:3], ((0, 2),), (), None, (), 0.01)
    checker = Checker(robot, bare)
    rng = np.random.default_rng(1)
    for _ in range(20):
        position = rng.uniform(-2.0, 2.0, (1, 6))
        at = poses(robot, position)
        ends = [
            at.origin_m[c.link + 1, 0] + at.rotation[c.link + 1, 0] @ np.array(point)
            for c in (bare.capsules[0], bare.capsules[2])
            for point in (c.start_m, c.end_m)
        ]
        expected = _segment_distance(*ends) - 0.07 - 0.05 - 0.01
        assert float(checker.margins(position)[0]) == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("arm", [TX40, SEVEN_AXES, GANTRY], ids=lambda arm: arm.name)
def test_a_way_that_is_called_clear_is_clear_everywhere(arm: Arm) -> None:
    robot = robot_from_urdf(arm.urdf)
    count = robot.joint_count
    checker = Checker(robot, _scene(count - 1))
    verdicts = []

    @settings(deadline=None, max_examples=60, derandomize=True)
    @given(seed=st.integers(0, 100_000), reach=st.sampled_from([0.05, 0.5, 1.0]))
    def check(seed: int, reach: float) -> None:
        rng = np.random.default_rng(seed)
        start = rng.uniform(-2.0, 2.0, count)
        end = start + reach * rng.uniform(-3.0, 3.0, count)
        found = checker.obstruction(start, end)
        verdicts.append(found is None)
        if found is None:
            along = start + (end - start) * np.linspace(0.0, 1.0, 800)[:, None]
            assert float(checker.margins(along).min()) >= 0.0
        else:
            there = np.array(found.position)[None]
            assert float(checker.margins(there)[0]) <= RESOLUTION_M
            assert found.first != found.second

    check()
    assert len(set(verdicts)) == 2


def test_a_thin_wall_between_two_free_postures_is_found() -> None:
    robot = robot_from_urdf(TX40.urdf)
    wall = Box("wall", (0.1, -0.002, 0.0), (1.5, 0.002, 1.0))
    scene = Scene(
        (Capsule("tool", 5, (0.0, 0.0, 0.02), (0.0, 0.0, 0.05), 0.01),), (), (wall,), None, (), 0.0
    )
    checker = Checker(robot, scene)
    start = np.array([-1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    end = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert (checker.margins(np.stack((start, end))) > 0.05).all()
    found = checker.obstruction(start, end)
    assert found is not None
    assert (found.first, found.second) == ("tool", "wall")
    away = start + np.array([-0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert checker.obstruction(start, away) is None


def test_what_leaves_the_workspace_is_named() -> None:
    robot = robot_from_urdf(TX40.urdf)
    tool = Capsule("tool", 5, (0.0, 0.0, 0.0), (0.0, 0.0, 0.1), 0.02)
    low = Box("workspace", (-2.0, -2.0, 0.3), (2.0, 2.0, 2.0))
    checker = Checker(robot, Scene((tool,), (), (), low, (0,), 0.0))
    up = np.zeros(6)
    down = np.array([0.0, 2.0, 0.5, 0.0, 0.0, 0.0])
    assert float(checker.margins(up[None])[0]) > 0.0
    found = checker.obstruction(up, down)
    assert found is not None
    assert (found.first, found.second) == ("tool", "the end of the workspace")


def test_nothing_declared_is_always_clear() -> None:
    robot = robot_from_urdf(TX40.urdf)
    checker = Checker(robot, Scene((), (), (), None, (), 0.0))
    assert checker.obstruction(np.zeros(6), np.ones(6)) is None
    assert np.isinf(checker.margins(np.zeros((3, 6)))).all()
