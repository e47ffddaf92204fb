"""From where the robot stands to the first target of a plan:
straight, around what is in the way, or not at all.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.config.workspace import Clearance
from daq.workflow.experiment import PlannedMove, scene_of
from daq.workflow.plan import AROUND_SHARE, Plan, plan, way_to_first_target
from drivers.errors import MotionRefused
from ident.model.urdf import robot_from_urdf
from ident.planning.clearance import Box, Checker

pytestmark = pytest.mark.slow

LEFT = (1.2, 1.5, 0.0, 0.0, 0.0, 0.0)  #: The arm, stretched forward, beside a wall in front of it
#: On its other side: the straight way there swings through it
RIGHT = (-1.2, 1.5, 0.0, 0.0, 0.0, 0.0)
ABOVE = (0.0, -0.5, 0.0, 0.0, 0.0, 0.0)
MOVE = PlannedMove(RIGHT, 0.9, 0.8, 0.5)


@pytest.fixture(scope="module")
def walled(checkout: Path) -> Cell:
    """The demo cell with a wall in front of the arm."""
    lower_m = (0.3, -0.05, 0.0)
    upper_m = (0.6, 0.05, 1.0)
    wall = Box("wall", lower_m, upper_m)
    path = checkout / "configs/cells/demo.yaml"
    return replace(
        load_cell(path),
        clearance=Clearance(None, 0.02, (), (wall,)),
    )


def _plan_to(*targets: tuple[float, ...]) -> Plan:
    moves = tuple(replace(MOVE, target_rad=target) for target in targets)
    return Plan("demo", 1, 100.0, (), 1.0, moves, ())


def test_a_clear_straight_way_needs_no_further_move(walled: Cell) -> None:
    beside = (1.0, *LEFT[1:])
    straight = _plan_to(beside)
    start_rad = np.array(LEFT)
    assert way_to_first_target(walled, straight, start_rad) == (straight.moves, "")


def test_nothing_is_asked_where_the_cell_file_says_nothing_of_the_room(walled: Cell) -> None:
    bare = replace(walled, clearance=None)
    straight = _plan_to(RIGHT)
    start_rad = np.array(LEFT)
    assert way_to_first_target(bare, straight, start_rad) == (straight.moves, "")


def test_a_wall_that_no_position_of_the_plan_leads_around_is_refused(walled: Cell) -> None:
    """All targets of the plan are as high as the wall."""
    with pytest.raises(
        MotionRefused,
        match=r"found -?\d+ mm between .* and wall at .*, and no "
        r"other clear way",
    ):
        way_to_first_target(walled, _plan_to(RIGHT), np.array(LEFT))


def test_slow_moves_lead_around_a_wall_between_the_positions_of_the_plan(walled: Cell) -> None:
    plan_ = _plan_to(RIGHT, ABOVE)
    start_rad = np.array(LEFT)
    moves, remark = way_to_first_target(walled, plan_, start_rad)
    assert len(moves) > 1
    assert moves[-1].target_rad == RIGHT
    robot = robot_from_urdf(walled.urdf)
    scene = scene_of(walled, robot, 1.0).checker.scene
    # That a guessed arm touches itself refuses nothing
    changed_scene = replace(scene, pairs=())
    checker = Checker(robot, changed_scene)
    way = np.array([LEFT, *(move.target_rad for move in moves)])
    for start, end in pairwise(way):
        assert checker.obstruction(start, end) is None
    corners = np.array([LEFT, RIGHT, ABOVE])
    smallest_corner = corners.min(axis=0)
    assert np.all(way >= smallest_corner)
    largest_corner = corners.max(axis=0)
    assert np.all(way <= largest_corner)
    assert {(move.velocity, move.acceleration) for move in moves} == {(AROUND_SHARE, AROUND_SHARE)}
    assert "slow moves led around it, by " in remark


def test_the_next_plan_of_a_closed_chain_begins_where_the_last_one_ended(checkout: Path) -> None:
    """Between random positions the loops of the DualV do not stay closed on a straight way of its
    motors.
    """
    cell = load_cell(checkout / "configs/cells/dualv.yaml")
    plans = [
        plan(
            cell,
            seed=seed,
            duration_s=5.0,
            exchanges=0,
            largest_condition=np.inf,
            largest_std_percent=np.inf,
        )
        for seed in (1, 2, 3)
    ]
    remarks = [
        way_to_first_target(cell, after, _end_of(before))[1] for before, after in pairwise(plans)
    ]
    assert any("slow moves led around it" in remark for remark in remarks)


def _end_of(plan_: Plan) -> np.ndarray:
    last_move = plan_.moves[-1]
    return np.array(last_move.target_rad)
