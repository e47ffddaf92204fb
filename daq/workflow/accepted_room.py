"""The room and the speed of moves that an operator has looked at and accepted;
later moves stay inside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from daq.config.cell import Cell
from daq.workflow.experiment import CheckedScene, PlannedMove, paths_of, point_of
from daq.workflow.plan import Plan, TargetBox
from ident.arrays import FloatArray
from ident.model.robot import poses
from ident.planning.clearance import BASE, RESOLUTION_M, Box, Checker

STEPS = 50  #: Postures on each way whose extent is taken
SLACK_M = RESOLUTION_M + 0.001
"""How far moves may leave the extent of those that were accepted [m].

A part that only turns at one height is at its end in all postures. Without room for rounding and
for the resolution of the check, no way would be clear.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Extent:
    """Where the moving parts of an arm come [m], in the base frame."""

    lower_m: FloatArray  #: shape (3,)
    upper_m: FloatArray  #: shape (3,)
    radius_m: float  #: largest distance from the z axis


@dataclass(frozen=True, slots=True, eq=False)
class AcceptedRoom:
    """Room and speed of accepted moves."""

    box: TargetBox  #: joint positions between which they stay
    speed: float  #: share of the joints' limits of velocity that none of them exceeds
    acceleration: float  #: share of the joints' limits of acceleration that none of them exceeds
    #: Where their moving parts come; None where the cell file declares a workspace, or the shape of
    #: the arm is unknown.
    reach: Extent | None

    def scene(self, scene: CheckedScene) -> CheckedScene:
        """Return a scene in which no moving part leaves the reach of the accepted moves."""
        if self.reach is None:
            return scene
        capsules = scene.checker.scene.capsules
        lower_m = point_of(self.reach.lower_m - SLACK_M)
        upper_m = point_of(self.reach.upper_m + SLACK_M)
        reach = Box("the reach of the moves that were accepted", lower_m, upper_m)
        moving = [index for index, capsule in enumerate(capsules) if capsule.link != BASE]
        bounded = replace(scene.checker.scene, workspace=reach, confined=tuple(moving))
        return replace(scene, checker=Checker(scene.checker.robot, bounded))


def accepted_room(cell: Cell, scene: CheckedScene, plans: Sequence[Plan]) -> AcceptedRoom:
    """Return the room and the speed of plans; a way between two targets leaves their box nowhere.

    Args:
        cell: of the plans.
        scene: of the cell.
        plans: that an operator has looked at, one or more.
    """
    moves: list[PlannedMove] = []
    for plan in plans:
        moves += plan.moves
    targets = np.array([move.target_rad for move in moves])
    box = TargetBox(targets.min(axis=0), targets.max(axis=0))
    speed = max(move.velocity for move in moves)
    acceleration = max(move.acceleration for move in moves)
    checker = scene.checker
    is_declared = checker.scene.workspace is not None
    has_moving_shape = any(capsule.link != BASE for capsule in checker.scene.capsules)
    if is_declared or not has_moving_shape:
        return AcceptedRoom(box, speed, acceleration, None)
    postures = []
    for plan in plans:
        for path in paths_of(cell, plan.moves):
            time_s = np.linspace(0.0, path.duration_s, STEPS)
            position, _, _ = path.at(time_s)
            postures.append(position)
    reach = extent(checker, placed(checker, np.concatenate(postures)))
    return AcceptedRoom(box, speed, acceleration, reach)


def placed(checker: Checker, position: FloatArray) -> FloatArray:
    """Return both ends of every capsule in each posture [m], shape (k, capsules, 2, 3).

    Args:
        checker: of the arm.
        position: of the axes [rad or m], shape (k, m).
    """
    capsules = checker.scene.capsules
    at = poses(checker.robot, checker.joints(position))
    frame = [capsule.link + 1 for capsule in capsules]
    ends = np.array([(capsule.start_m, capsule.end_m) for capsule in capsules])
    ends = ends.reshape(-1, 1, 2, 3)
    origin = at.origin_m[frame].swapaxes(0, 1)
    # p_kce = R_ck end_ce + o_kc
    turned = np.einsum("ckij,cxej->kcei", at.rotation[frame], ends)
    return np.asarray(turned + origin[:, :, None])


def extent(checker: Checker, ends_m: FloatArray) -> Extent:
    """Return where the moving parts come; zeros where no moving part has a shape.

    Args:
        checker: of the arm.
        ends_m: ends of all capsules, shape (k, capsules, 2, 3).
    """
    capsules = checker.scene.capsules
    moving = np.array([capsule.link != BASE for capsule in capsules], dtype=np.bool_)
    if not moving.any():
        return Extent(np.zeros(3), np.zeros(3), 0.0)
    ends = ends_m[:, moving]
    radii_m = np.array([capsule.radius_m for capsule in capsules])
    radius_m = radii_m[moving, None]
    lowest = ends - radius_m[..., None]
    highest = ends + radius_m[..., None]
    lower = lowest.min(axis=(0, 1, 2))
    upper = highest.max(axis=(0, 1, 2))
    from_axis_m = np.hypot(ends[..., 0], ends[..., 1]) + radius_m
    return Extent(lower, upper, float(from_axis_m.max()))
