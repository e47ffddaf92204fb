"""Corrections that recordings do not tell apart, and which axes must move further for it.

A zero that is off turns gravity for the arm behind its joint. Where the joints before it hardly
move, a base that leans makes the same torques. Then neither is known, although each alone has a
small σ.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident.arrays import FloatArray
from ident.data.dataset import Dataset
from ident.discovery.candidates import SearchProblem
from ident.discovery.search import Finding
from ident.effects.effect import PlacedEffect
from ident.effects.geometry_corrections import GravityDirection, LatePosition, ZeroOffset
from ident.model.robot import JointKind, Robot, joints_to_base

OWN_SHARE = 0.5  #: Of what a correction explains alone, that it must explain beside another effect
WIDE_RAD = float(np.deg2rad(120.0))  #: Range of a joint that turns the arm behind it enough


def explains_beside(
    problem: SearchProblem, torque_nm: FloatArray, left_out_fall: float, rival_nm: FloatArray
) -> bool:
    """Whether a mistake explains most of what it does beside another effect, too.

    Args:
        problem: around the fit.
        torque_nm: columns of the mistake at the joints, shape (m, p, r).
        left_out_fall: of ‖e‖² on left-out moves, by the mistake alone.
        rival_nm: columns of the other effect.
    """
    both_nm = np.concatenate((rival_nm, torque_nm), axis=1)
    alone, both = problem.trials([rival_nm, both_nm])
    if alone is None or both is None:
        return False
    fall = float(alone.left_out.sum() - both.left_out.sum())
    return fall >= OWN_SHARE * left_out_fall


def alike_corrections(
    problem: SearchProblem, correction: Finding, findings: Sequence[Finding]
) -> tuple[Finding, ...]:
    """Corrections that folds do not distinguish from one that was found.

    Beside them, it explains little more.

    Args:
        problem: with rows that serve as signals.
        correction: that was found.
        findings: of all corrections of the description.
    """
    torque_nm = problem.torque_at_rows(correction.effect, correction.axis)
    alike: list[Finding] = []
    for other in findings:
        if other.placed not in correction.ambiguity or other.impossible:
            continue
        of_other_nm = problem.torque_at_rows(other.effect, other.axis)
        if not explains_beside(problem, torque_nm, correction.left_out_fall, of_other_nm):
            alike.append(other)
    return tuple(alike)


def axes_to_move(
    alike: Sequence[PlacedEffect], robot: Robot, datasets: Sequence[Dataset]
) -> tuple[int, ...]:
    """Axes that must turn further for recordings to tell corrections apart.

    Empty where no motion of one axis does. A zero differs from a turn of gravity by the joints
    before it, and from another zero by their own joints.

    Args:
        alike: corrections that the recordings do not tell apart.
        robot: a serial robot, or a tree.
        datasets: the recordings.
    """
    zeros = {placed.axis for placed in alike if isinstance(placed.effect, ZeroOffset)}
    if not zeros or any(isinstance(placed.effect, LatePosition) for placed in alike):
        return ()
    wanted = zeros
    if any(isinstance(placed.effect, GravityDirection) for placed in alike):
        wanted = set()
        for axis in zeros:
            wanted.update(axes_before(axis, robot))
    turning = [axis for axis in sorted(wanted) if robot.axes[axis].kind is JointKind.REVOLUTE]
    ranges_rad = _ranges(datasets)
    narrow = [axis for axis in turning if ranges_rad[axis] < WIDE_RAD]
    return tuple(narrow or turning)


def axes_before(axis: int, robot: Robot) -> tuple[int, ...]:
    """Axes whose joints are before that of an axis on its chain, the last one first."""
    before: list[int] = []
    own = robot.joints[robot.axis_joints[axis]]
    for joint in joints_to_base(robot, own.parent):
        if joint in robot.axis_joints:
            before.append(robot.axis_joints.index(joint))
    return tuple(before)


def _ranges(datasets: Sequence[Dataset]) -> FloatArray:
    """Range of each axis in all recordings together [rad or m], shape (m,)."""
    highest = [data.position_rad.max(axis=0) for data in datasets]
    lowest = [data.position_rad.min(axis=0) for data in datasets]
    return np.asarray(np.max(highest, axis=0) - np.min(lowest, axis=0))
