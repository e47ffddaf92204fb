"""The `workspace` and `clearance` sections of a cell file,
and the arm that is guessed without them.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from daq.config.cell import model_of
from daq.config.cell_file import load_cell
from daq.errors import ConfigurationInconsistent, SchemaMismatch
from daq.workflow.experiment import LINK_RADIUS_SHARE, guessed_capsules, scene_of
from ident.planning.clearance import BASE

CONFIGS = Path(__file__).parents[3] / "configs"
DECLARED = """
workspace: {lower_m: [-0.8, -0.8, 0.0], upper_m: [0.8, 0.8, 1.2]}
clearance:
  minimum_m: 0.03
  capsules:
    - {name: column, link: base, from_m: [0, 0, 0], to_m: [0, 0, 0.2], radius_m: 0.08}
    - {name: forearm, link: J3, from_m: [0, 0, 0.04], to_m: [0, -0.15, 0.04], radius_m: 0.06}
    - {name: disc, link: J6, from_m: [0, 0, 0.08], to_m: [0, 0, 0.12], radius_m: 0.1}
  obstacles:
    - {name: table, lower_m: [-1.0, -1.0, -0.1], upper_m: [1.0, 1.0, -0.02]}
"""


@pytest.fixture
def cell_file(tmp_path: Path) -> Path:
    """A copy of the demonstration's cell that may be written to."""
    shutil.copytree(CONFIGS, tmp_path / "configs")
    cells_folder = tmp_path / "configs" / "cells"
    return cells_folder / "demo.yaml"


def test_what_is_declared_is_what_is_checked(cell_file: Path) -> None:
    cell_file.write_text(cell_file.read_text() + DECLARED)
    cell = load_cell(cell_file)
    robot = model_of(cell).robot
    found = scene_of(cell, robot, 4.59)
    scene = found.checker.scene
    expected = [("column", BASE), ("forearm", 2), ("disc", 5)]
    assert [(capsule.name, capsule.link) for capsule in scene.capsules] == expected
    assert not found.guessed
    assert (scene.minimum_m, scene.confined, scene.boxes[0].name) == (0.03, (2,), "table")
    assert {(0, 1), (0, 2)} <= set(scene.pairs)
    assert scene.workspace is not None
    assert found.remarks[0] == "shape of the arm: 3 capsules, as declared"
    assert not any("payload" in line for line in found.remarks)


def test_a_payload_without_a_declared_capsule_is_said_to_be_guessed(cell_file: Path) -> None:
    lines = [line for line in DECLARED.splitlines() if "name: disc" not in line]
    cell_file.write_text(cell_file.read_text() + "\n".join(lines))
    cell = load_cell(cell_file)
    robot = model_of(cell).robot
    found = scene_of(cell, robot, 4.59)
    names = [capsule.name for capsule in found.checker.scene.capsules]
    assert names == ["column", "forearm", "payload"]
    assert not found.guessed
    assert found.remarks[:2] == (
        "shape of the arm: 2 capsules, as declared",
        "shape of the payload: guessed from its mass; declare a capsule on link J6 in "
        "`clearance.capsules` of the cell file",
    )


@pytest.mark.parametrize("name", ["hub", "payload"])
def test_the_name_of_a_declared_capsule_does_not_change_what_is_checked(
    cell_file: Path, name: str
) -> None:
    """The hub turns about the shoulder, 10 mm above the column in every posture."""
    capsules = f"""
clearance:
  minimum_m: 0.03
  capsules:
    - {{name: column, link: base, from_m: [0, 0, 0], to_m: [0, 0, 0.21], radius_m: 0.05}}
    - {{name: {name}, link: J2, from_m: [0, 0, -0.01], to_m: [0, 0, 0.01], radius_m: 0.05}}
    - {{name: disc, link: J6, from_m: [0, 0, 0.08], to_m: [0, 0, 0.12], radius_m: 0.1}}
"""
    cell_file.write_text(cell_file.read_text() + capsules)
    cell = load_cell(cell_file)
    robot = model_of(cell).robot
    found = scene_of(cell, robot, 4.59)
    assert found.together == ()
    assert (0, 1) in found.checker.scene.pairs


@pytest.mark.parametrize(
    ("old", "new", "error", "message"),
    [
        ("link: J3", "link: J9", ConfigurationInconsistent, "J9"),
        (
            "lower_m: [-0.8, -0.8, 0.0]",
            "lower_m: [0.8, -0.8, 0.0]",
            ConfigurationInconsistent,
            "workspace",
        ),
        (
            "upper_m: [1.0, 1.0, -0.02]",
            "upper_m: [1.0, 1.0, -0.2]",
            ConfigurationInconsistent,
            "obstacles",
        ),
        ("radius_m: 0.06", "radius_m: 0", SchemaMismatch, "radius_m"),
        ("radius_m: 0.06", "radius_m: 60", SchemaMismatch, "radius_m"),
        ("minimum_m: 0.03", "minimum_m: -0.03", SchemaMismatch, "minimum_m"),
        ("from_m: [0, 0, 0.04]", "from_m: [0, 0]", SchemaMismatch, "from_m"),
    ],
)
def test_a_room_that_cannot_be_is_refused(
    cell_file: Path, old: str, new: str, error: type[Exception], message: str
) -> None:
    assert old in DECLARED
    changed_declared = DECLARED.replace(old, new, 1)
    cell_file.write_text(cell_file.read_text() + changed_declared)
    with pytest.raises(error, match=message):
        load_cell(cell_file)


@pytest.mark.parametrize("name", ["demo", "seven-axis", "gantry"])
def test_a_guessed_arm_has_a_payload_and_room_to_move(name: str) -> None:
    path = CONFIGS / "cells" / f"{name}.yaml"
    cell = load_cell(path)
    robot = model_of(cell).robot
    found = scene_of(cell, robot, 4.59)
    assert found.guessed
    last_capsule = found.checker.scene.capsules[-1]
    assert last_capsule.name == "payload"
    assert any("guess" in line for line in found.remarks)
    assert any("obstacles and workspace: none declared" in line for line in found.remarks)
    positions = [axis.limits.position for axis in cell.axes]
    lower, upper = np.array(positions).T
    rng = np.random.default_rng(3)
    postures = rng.uniform(lower, upper, (300, len(lower)))
    assert float((found.checker.margins(postures) > 0.0).mean()) > 0.3


def test_links_that_change_their_length_are_not_guessed() -> None:
    path = CONFIGS / "cells" / "gantry.yaml"
    cell = load_cell(path)
    robot = model_of(cell).robot
    for capsule in guessed_capsules(robot):
        assert capsule.link != BASE
        assert capsule.link > 2


@pytest.mark.parametrize("gap_m", [0.005, 0.015])
def test_links_of_a_guessed_arm_that_never_keep_the_distance_belong_together(
    cell_file: Path, gap_m: float
) -> None:
    """A column, and an upper arm that turns about the end of a short link above it."""
    cell = load_cell(cell_file)
    robot = model_of(cell).robot
    column, shoulder, *others = robot.joints
    column_m = 0.4
    # The guess takes a radius from the whole length of the arm, which the short link is part of.
    reach_m = sum(float(np.linalg.norm(joint.translation_m)) for joint in others) + column_m
    short_m = 0.0
    for _ in range(30):
        radius_m = LINK_RADIUS_SHARE * (reach_m + short_m)
        short_m = radius_m + gap_m
    above = replace(column, translation_m=np.array([0.0, 0.0, column_m]))
    beside = replace(shoulder, translation_m=np.array([0.0, 0.0, short_m]))
    arm = replace(robot, joints=(above, beside, *others))
    found = scene_of(cell, arm, 4.59)
    assert (found.checker.scene.minimum_m, found.guessed) == (0.01, True)
    is_together = ("base", "link 2") in found.together
    assert is_together == (gap_m < 0.01)
    remarks = "\n".join(found.remarks)
    assert ("nearly every posture: base and link 2" in remarks) == is_together
