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
    start_m = (0.0, 0.0, 0.0)
    capsule = Capsule("column", BASE, start_m, (0.0, 0.0, 0.25), 0.07)
    end_m = (0.18, 0.0, 0.03)
    capsules = (
        capsule,
        Capsule("upper", 1, (0.0, 0.0, 0.0), end_m, 0.06),
        Capsule("tool", last, (0.0, 0.0, 0.05), (0.0, 0.02, 0.2), 0.05),
        Capsule("ball", last, (0.05, 0.0, 0.1), (0.05, 0.0, 0.1), 0.04),
    )
    lower_m = (0.3, -0.6, 0.0)
    box = Box("post", lower_m, (0.31, 0.6, 0.7))
    boxes = (box,)
    upper_m = (1.5, 1.5, 1.5)
    workspace = Box("workspace", (-1.5, -1.5, -0.2), upper_m)
    pairs = ((0, 2), (1, 2), (0, 3))
    return Scene(capsules, pairs, boxes, workspace, (2, 3), minimum_m)


@pytest.mark.parametrize("arm", ARMS, ids=lambda arm: arm.name)
def test_poses_are_those_of_pinocchio(arm: Arm) -> None:
    robot = robot_from_urdf(arm.urdf)
    model = pin.buildModelFromXML(arm.urdf)
    data = model.createData()
    rng = np.random.default_rng(0)
    positions = rng.uniform(-2.0, 2.0, (model.nq, 5))
    found = poses(robot, positions.T)
    for sample in range(5):
        pin.forwardKinematics(model, data, positions[:, sample])
        for joint in range(model.nq):
            translation = data.oMi[joint + 1].translation
            assert found.origin_m[joint + 1, sample] == pytest.approx(translation, abs=1e-12)
            assert found.rotation[joint + 1, sample] == pytest.approx(
                data.oMi[joint + 1].rotation, abs=1e-12
            )


def _segment_distance(a0: FloatArray, a1: FloatArray, b0: FloatArray, b1: FloatArray) -> float:
    """By brute force."""
    grid = np.linspace(0.0, 1.0, 201)
    first, second = (p + grid[:, None] * (q - p) for p, q in ((a0, a1), (b0, b1)))
    difference = first[:, None] - second[None]
    difference_norm = np.linalg.norm(difference, axis=2)
    return float(difference_norm.min())


def test_distances_are_those_of_the_segments() -> None:
    robot = robot_from_urdf(TX40.urdf)
    scene = _scene(5)
    pairs = ((0, 2),)
    bare = Scene(scene.capsules[:3], pairs, (), None, (), 0.01)
    checker = Checker(robot, bare)
    rng = np.random.default_rng(1)
    for _ in range(20):
        position = rng.uniform(-2.0, 2.0, (1, 6))
        at = poses(robot, position)
        ends = []
        for c in (bare.capsules[0], bare.capsules[2]):
            for point in (c.start_m, c.end_m):
                ends.append(
                    at.origin_m[c.link + 1, 0] + at.rotation[c.link + 1, 0] @ np.array(point)
                )
        expected = _segment_distance(*ends) - 0.07 - 0.05 - 0.01
        assert float(checker.margins(position)[0]) == pytest.approx(expected, abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("arm", [TX40, SEVEN_AXES, GANTRY], ids=lambda arm: arm.name)
def test_a_way_that_is_called_clear_is_clear_everywhere(arm: Arm) -> None:
    robot = robot_from_urdf(arm.urdf)
    count = robot.joint_count
    scene = _scene(count - 1)
    checker = Checker(robot, scene)
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
            grid = np.linspace(0.0, 1.0, 800)
            along = start + (end - start) * grid[:, None]
            smallest = checker.margins(along).min()
            assert float(smallest) >= 0.0
        else:
            there = np.array(found.position)[None]
            assert float(checker.margins(there)[0]) <= RESOLUTION_M
            assert found.first != found.second

    check()
    assert len(set(verdicts)) == 2


def test_a_thin_wall_between_two_free_postures_is_found() -> None:
    robot = robot_from_urdf(TX40.urdf)
    lower_m = (0.1, -0.002, 0.0)
    upper_m = (1.5, 0.002, 1.0)
    wall = Box("wall", lower_m, upper_m)
    start_m = (0.0, 0.0, 0.02)
    end_m = (0.0, 0.0, 0.05)
    capsules = (Capsule("tool", 5, start_m, end_m, 0.01),)
    scene = Scene(capsules, (), (wall,), None, (), 0.0)
    checker = Checker(robot, scene)
    start = np.array([-1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    end = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    position = np.stack((start, end))
    assert (checker.margins(position) > 0.05).all()
    found = checker.obstruction(start, end)
    assert found is not None
    assert (found.first, found.second) == ("tool", "wall")
    away = start + np.array([-0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert checker.obstruction(start, away) is None


def test_what_leaves_the_workspace_is_named() -> None:
    robot = robot_from_urdf(TX40.urdf)
    start_m = (0.0, 0.0, 0.0)
    end_m = (0.0, 0.0, 0.1)
    tool = Capsule("tool", 5, start_m, end_m, 0.02)
    lower_m = (-2.0, -2.0, 0.3)
    upper_m = (2.0, 2.0, 2.0)
    low = Box("workspace", lower_m, upper_m)
    scene = Scene((tool,), (), (), low, (0,), 0.0)
    checker = Checker(robot, scene)
    up = np.zeros(6)
    down = np.array([0.0, 2.0, 0.5, 0.0, 0.0, 0.0])
    assert float(checker.margins(up[None])[0]) > 0.0
    found = checker.obstruction(up, down)
    assert found is not None
    assert (found.first, found.second) == ("tool", "the end of the workspace")


def test_nothing_declared_is_always_clear() -> None:
    robot = robot_from_urdf(TX40.urdf)
    scene = Scene((), (), (), None, (), 0.0)
    checker = Checker(robot, scene)
    assert checker.obstruction(np.zeros(6), np.ones(6)) is None
    position = np.zeros((3, 6))
    assert np.isinf(checker.margins(position)).all()
