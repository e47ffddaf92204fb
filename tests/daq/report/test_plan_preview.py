"""The page of a plan: what it draws is the plan, and it is found again by the plan's content."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daq.config.cell import Cell, model_of
from daq.config.workspace import Clearance
from daq.report.plan_preview import STEP_S, find_preview, preview_data, preview_page
from daq.workflow.experiment import PlannedMove, experiment_duration_s, scene_of
from daq.workflow.plan import Plan
from ident.model.robot import poses
from ident.planning.clearance import BASE, Box, Checker

TARGETS = (
    (0.0, 0.0, 1.2, 0.0, 0.0, 0.0),
    (0.8, 0.4, 0.6, 0.0, 0.5, 0.0),
    (-0.8, -0.4, 1.2, 1.0, -0.5, 2.0),
)
MOVES = tuple(PlannedMove(target, 0.5, 0.5, 0.1) for target in TARGETS)
PLAN = Plan("demo", 1, 100.0, (), 1.0, MOVES, ())
WALL = Box("wall", (0.3, -0.05, 0.0), (0.6, 0.05, 1.0))


@pytest.fixture(scope="module")
def walled_cell(cell: Cell) -> Cell:
    """The demo cell with a wall in front of the arm."""
    clearance = Clearance(None, 0.02, (), (WALL,))
    return replace(cell, clearance=clearance)


@pytest.fixture(scope="module")
def checker(walled_cell: Cell) -> Checker:
    """Distances of its arm."""
    robot = model_of(walled_cell).robot
    return scene_of(walled_cell, robot, 4.59).checker


@pytest.fixture(scope="module")
def drawn(walled_cell: Cell, checker: Checker) -> dict[str, Any]:
    """The data of its page."""
    text = json.dumps(preview_data(walled_cell, MOVES, checker))
    found: dict[str, Any] = json.loads(text)
    return found


def test_the_rows_pass_through_every_target_at_its_time(
    walled_cell: Cell, drawn: dict[str, Any]
) -> None:
    robot = model_of(walled_cell).robot
    position_rad = np.array(TARGETS)
    origin_m = poses(robot, position_rad).origin_m
    at = origin_m.swapaxes(0, 1)
    chains = np.array(drawn["origins_m"])
    np.testing.assert_allclose(chains[0], at[0], atol=0.001)
    expected = at[-1]
    last_chain = chains[-1]
    np.testing.assert_allclose(last_chain, expected, atol=0.001)
    second = [row for row, number in enumerate(drawn["move"]) if number == 2]
    chain_difference = np.abs(chains[second] - at[1])
    largest_chain_difference = chain_difference.max(axis=(1, 2))
    assert largest_chain_difference.min() < 0.001
    assert drawn["time_s"][-1] == pytest.approx(
        experiment_duration_s(walled_cell, MOVES), abs=2 * STEP_S
    )
    # Half of its limits at most, and the slowest axis of each move at just that.
    speeds = np.array([axis["values"] for axis in drawn["speeds"]])
    assert 45.0 < speeds.max() <= 50.1


def test_a_capsule_is_where_the_arm_is_and_the_clearance_that_of_the_checker(
    checker: Checker, drawn: dict[str, Any]
) -> None:
    capsules = checker.scene.capsules
    position_rad = np.array([TARGETS[0]])
    at = poses(checker.robot, position_rad)
    for capsule, ends in zip(capsules, drawn["ends_m"][0], strict=True):
        rotation = at.rotation[capsule.link + 1, 0]
        origin = at.origin_m[capsule.link + 1, 0]
        expected = []
        for end in (capsule.start_m, capsule.end_m):
            expected.append(rotation @ np.array(end) + origin)
        np.testing.assert_allclose(ends, expected, atol=0.001)
    last_target = TARGETS[-1]
    position = np.array([TARGETS[0], last_target])
    margin_m = checker.margins(position)
    found = [drawn["clearance_mm"][row] for row in (0, -1)]
    np.testing.assert_allclose(found, 1000.0 * (margin_m + 0.02), atol=0.06)
    assert [box["name"] for box in drawn["boxes"]] == ["wall"]


def test_the_reach_is_that_of_every_moving_capsule_at_every_row(
    checker: Checker, drawn: dict[str, Any]
) -> None:
    grid = np.linspace(0.0, 1.0, 21)
    shares = grid[:, None]
    points = []
    radii = []
    for row in drawn["ends_m"]:
        for capsule, (start, end) in zip(checker.scene.capsules, np.array(row), strict=True):
            if capsule.link != BASE:
                points.append((1.0 - shares) * start + shares * end)
                radii.append(np.full(21, capsule.radius_m))
    along = np.concatenate(points)
    radius = np.concatenate(radii)
    along_difference = along - radius[:, None]
    expected = along_difference.min(axis=0)
    lower_m = drawn["reach"]["lower_m"]
    np.testing.assert_allclose(lower_m, expected, atol=0.002)
    largest_along = (along + radius[:, None]).max(axis=0)
    upper_m = drawn["reach"]["upper_m"]
    np.testing.assert_allclose(upper_m, largest_along, atol=0.002)
    across = (np.hypot(along[:, 0], along[:, 1]) + radius).max()
    radius_m = drawn["reach"]["radius_m"]
    assert radius_m == pytest.approx(across, abs=0.002)


def test_the_page_says_what_is_not_known(walled_cell: Cell, checker: Checker) -> None:
    page = preview_page(walled_cell, MOVES, checker, b"plan")
    assert "The shape of the arm is a guess from the URDF" in page
    assert "declares no workspace: tables" in page
    assert "drivegain record checks the way there" in page
    assert "below z = 0" not in page
    assert re.search(r"Smallest clearance: -\d+ mm, at [\d.]+ s; 20 mm must be kept", page)
    bare = replace(walled_cell, clearance=None)
    robot = model_of(bare).robot
    scene = scene_of(bare, robot, 4.59)
    page = preview_page(bare, MOVES, scene.checker, b"plan")
    assert "nothing checks the way there" in page


def test_the_page_needs_no_other_file_and_runs_only_its_own_script(
    walled_cell: Cell, checker: Checker
) -> None:
    hostile = replace(walled_cell, name="</script><script>alert(1)</script>")
    page = preview_page(hostile, MOVES, checker, b"plan")
    assert not re.search(r"https?:|src=|url\(", page)
    assert "<script>alert" not in page
    changed_cell = replace(walled_cell, name="a\u202eb")
    turned = preview_page(changed_cell, MOVES, checker, b"plan")
    assert "\u202e" not in turned
    assert turned.count("a\\u202eb") == 2
    (script,) = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"default-src 'none'; script-src 'sha256-{digest}'" in page


def test_a_preview_is_found_by_the_content_of_its_plan(
    walled_cell: Cell, checker: Checker, tmp_path: Path
) -> None:
    plan = tmp_path / "plan.yaml"
    plan.write_bytes(b"moves")
    (tmp_path / "another.html").write_text("<html>")
    assert find_preview(plan) is None
    text = preview_page(walled_cell, MOVES, checker, b"moves")
    (tmp_path / "look.html").write_text(text)
    assert find_preview(plan) == tmp_path / "look.html"
    plan.write_bytes(b"other moves")
    assert find_preview(plan) is None
