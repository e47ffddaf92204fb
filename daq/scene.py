"""The shape of a cell's arm for the planner: as declared, or guessed from its joint chain and said so."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from daq.configuration.cell import Cell
from daq.configuration.clearance import DEFAULT_MINIMUM_M, Clearance
from ident.clearance import BASE, Capsule, Checker, Scene
from ident.nominal import side_of_cube
from ident.robot import JointKind, Robot

FloatArray = NDArray[np.float64]

LINK_RADIUS = 0.08
"""Of a guessed link, as a share of the length of the joint chain: 6 cm for an arm of the TX-40's size."""
POSTURES = 400
ALWAYS = 0.03
"""Two capsules that are apart in a smaller share of random postures belong together, as at a shared joint."""


@dataclass(frozen=True, slots=True, eq=False)
class CheckedScene:
    """A scene with what must be said of it.

    Attributes:
        checker: answers whether a way is clear.
        guessed: the arm's shape is a guess.
        together: names of pairs that are not looked at, because they touch in nearly every posture.
    """

    checker: Checker
    guessed: bool
    together: tuple[tuple[str, str], ...]

    @property
    def remarks(self) -> tuple[str, ...]:
        """What a person should know of it, in words."""
        scene = self.checker.scene
        shape = "a guess from the joint chain; declare `clearance` in the cell file" if self.guessed else "as declared"
        lines = [f"arm of {len(scene.capsules)} capsules, {shape}; {1000 * scene.minimum_m:.0f} mm kept"]
        if self.together:
            pairs = ", ".join(f"{first} and {second}" for first, second in self.together)
            lines.append(f"not told apart, as they touch in nearly every posture: {pairs}")
        if not scene.boxes and scene.workspace is None:
            lines.append("no obstacles and no workspace declared: tables, cables and people are not known")
        return tuple(lines)


def scene_of(cell: Cell, robot: Robot, mass_kg: float) -> CheckedScene:
    """The cell's own capsules, or guessed ones, and the pairs of them that must keep apart.

    Args:
        cell: with or without declared clearance.
        robot: of the cell.
        mass_kg: of the payload that will be mounted, for the guess of its size.
    """
    declared = cell.clearance or Clearance(None, DEFAULT_MINIMUM_M, (), ())
    capsules = declared.capsules or guessed_capsules(robot)
    last = robot.joint_count - 1
    if not any(capsule.link == last for capsule in capsules):
        capsules = (*capsules, guessed_payload(robot, mass_kg))
    candidates = tuple(
        (first, second)
        for second in range(len(capsules))
        for first in range(second)
        if not _neighbours(robot, capsules[first].link, capsules[second].link)
    )
    confined = tuple(index for index, capsule in enumerate(capsules) if capsule.link == last)
    everything = Scene(capsules, candidates, declared.obstacles, declared.workspace, confined, declared.minimum_m)
    lower, upper = np.array([axis.limits.position for axis in cell.axes]).T
    postures = np.random.default_rng(0).uniform(lower, upper, (POSTURES, len(lower))).T
    apart = Checker(robot, everything).apart(postures) > ALWAYS
    pairs = tuple(pair for pair, kept in zip(candidates, apart, strict=True) if kept)
    together = tuple(
        (capsules[a].name, capsules[b].name) for (a, b), kept in zip(candidates, apart, strict=True) if not kept
    )
    scene = Scene(capsules, pairs, declared.obstacles, declared.workspace, confined, declared.minimum_m)
    return CheckedScene(Checker(robot, scene), not declared.capsules, together)


def guessed_capsules(robot: Robot) -> tuple[Capsule, ...]:
    """One from each joint to the next revolute one; the far end is drawn in, so that a bent elbow is no collision.

    A way along a prismatic joint changes its length, and a guess would be no better than none: those links get none.
    """
    radius = LINK_RADIUS * max(sum(float(np.linalg.norm(joint.translation_m)) for joint in robot.joints), 0.1)
    capsules = []
    for joint in robot.joints:
        length = float(np.linalg.norm(joint.translation_m))
        before = robot.joints[joint.parent].kind if joint.parent != BASE else JointKind.REVOLUTE
        if length <= 2.0 * radius or JointKind.PRISMATIC in (joint.kind, before):
            continue
        end = joint.translation_m * (1.0 - radius / length)
        name = "base" if joint.parent == BASE else f"link {joint.parent + 1}"
        capsules.append(Capsule(name, joint.parent, (0.0, 0.0, 0.0), _point(end), radius))
    return tuple(capsules)


def guessed_payload(robot: Robot, mass_kg: float) -> Capsule:
    """Around a steel body of that mass on the last link, from a side in front of the joint to three of them."""
    side = side_of_cube(mass_kg)
    axis = robot.joints[-1].axis
    return Capsule("payload", robot.joint_count - 1, _point(side * axis), _point(2.0 * side * axis), side)


def _neighbours(robot: Robot, first: int, second: int) -> bool:
    parents = [robot.joints[link].parent if link != BASE else None for link in (first, second)]
    return first == second or parents[0] == second or parents[1] == first


def _point(vector: FloatArray) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])
