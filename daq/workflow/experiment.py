"""The experiment that a plan is for: the same moves once without load and once with the weighed payload."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from daq.config.cell import Cell, WeighedPayload, model_of
from daq.config.clearance import DEFAULT_MINIMUM_M, Clearance
from daq.errors import ConfigurationInconsistent
from drivers.motion.move import Trapezoid, synchronised
from ident.data.conditioning import decimator
from ident.model.robot import JointKind, Motion, Robot
from ident.planning.clearance import BASE, Capsule, Checker, Scene
from ident.planning.excitation import (
    Design,
    Excitation,
    Expectation,
    effective_noise,
    nominal_links,
    nominal_parameters,
    nominal_payload,
    nominal_torque_limits,
    side_of_cube,
    visible,
)

LINK_RADIUS = 0.08
"""Radius of a guessed link, as a share of the length of the joint chain: 6 cm for an arm of the TX-40's size."""
POSTURES = 400
ALWAYS = 0.03
"""Two capsules that are apart in a smaller share of random postures belong together, as at a shared joint."""


@dataclass(frozen=True, slots=True, eq=False)
class CheckedScene:
    """A scene with what must be said of it."""

    checker: Checker  #: answers whether a way is clear
    guessed: bool  #: the arm's shape is a guess
    #: Names of pairs that are not checked, because they touch in nearly every posture.
    together: tuple[tuple[str, str], ...]

    @property
    def remarks(self) -> tuple[str, ...]:
        """Remarks for the operator."""
        scene = self.checker.scene
        shape = "a guess from the joint chain; declare `clearance` in the cell file" if self.guessed else "as declared"
        lines = [f"arm of {len(scene.capsules)} capsules, {shape}; {1000 * scene.minimum_m:.0f} mm kept"]
        if self.together:
            pairs = ", ".join(f"{first} and {second}" for first, second in self.together)
            lines.append(f"left unchecked, as they touch in nearly every posture: {pairs}")
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
    postures = np.random.default_rng(0).uniform(lower, upper, (POSTURES, len(lower)))
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


FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

NOISE_SHARE = 0.006
"""Standard deviation of a row's residual, as a share of the motor's current at its torque limit: some 4 % of the rms
current of a lively plan, which is what a good fit leaves (docs/evidence/estimators.md)."""
LAG_ONE = 0.67  #: Correlation of the residual from row to row, as measured on real recordings
RUNS: tuple[int | None, ...] = (None, 0)  #: What is mounted while the moves are made: nothing, then the payload


@dataclass(frozen=True, slots=True, eq=False)
class Experiment:
    """Everything needed to judge moves before they are made."""

    cell: Cell  #: of the arm
    design: Design  #: unknowns and information
    scene: CheckedScene  #: what must keep apart
    payload: WeighedPayload  #: that will be mounted
    row_s: float  #: time between two rows of the observation [s]
    edge_s: float  #: how long after a standstill rows begin to count [s]
    remarks: tuple[str, ...]  #: what was assumed, in words

    def excitation(self, paths: Sequence[Trapezoid], thinning: int = 1) -> tuple[Excitation, tuple[slice, ...]]:
        """Rows of several moves, one after the other, and which of them belong to which move.

        Args:
            paths: the moves.
            thinning: takes every so manieth row only.
        """
        period = self.row_s * thinning
        times = [np.arange(0.5 * period, path.duration_s, period) for path in paths]
        parts = [path.at(time) for path, time in zip(paths, times, strict=True)]
        motion = Motion(*(np.concatenate([part[kind] for part in parts]) for kind in range(3)))
        use = np.concatenate([self._use(path, time) for path, time in zip(paths, times, strict=True)], axis=1)
        ends = np.cumsum([len(time) for time in times])
        slices = tuple(slice(end - len(time), end) for end, time in zip(ends.tolist(), times, strict=True))
        return Excitation(motion, use), slices

    def informations(self, paths: Sequence[Trapezoid], thinning: int = 1) -> list[FloatArray]:
        """Excitation of each move, without load and with the payload, all from one regressor."""
        if not paths:
            return []
        excitation, slices = self.excitation(paths, thinning)
        whitened = self.design.whitened(excitation)
        return [thinning * self.design.information_of(whitened[:, :, part], RUNS) for part in slices]

    def _use(self, path: Trapezoid, time_s: FloatArray) -> BoolArray:
        """Rows of each motor that count; the same rule as ident/equations/rows.py, for moves from rest to rest."""
        train = self.design.expectation.model.drive_train
        # On a trapezoid a joint is slowest at the ends of a row's window.
        early, late = (np.abs(path.at(time_s + shift)[1].T) for shift in (-self.edge_s, self.edge_s))
        standstill = np.array(self.cell.conditioning.standstill_rad_s or (0.0,) * len(early))[:, None]
        moving = (np.minimum(early, late) > standstill) if standstill.any() else np.minimum(early, late) > 0.0
        slowest = np.minimum(*(np.abs(train.direction @ path.at(time_s + s)[1].T) for s in (-self.edge_s, self.edge_s)))
        turned = slowest > standstill
        needed = (np.abs(train.to_motor) > 0) | (np.abs(train.direction) > 0)
        return np.stack([moving[needed[motor]].all(axis=0) & turned[motor] for motor in range(len(moving))])


def experiment_of(cell: Cell, payload: str | None = None) -> Experiment:
    """Expectation of a cell's arm: inertias of the URDF, stated guesses for the rest, nameplate gains.

    Args:
        cell: with a payload.
        payload: name of it, None for the first.

    Raises:
        ConfigurationInconsistent: the cell declares no payload, or none of that name.
    """
    mounted = _payload(cell, payload)
    model = model_of(cell)
    expected = nominal_payload(model.robot, mounted.drawn)
    velocity = np.array([axis.limits.velocity for axis in cell.axes])
    acceleration = np.array([axis.limits.acceleration for axis in cell.axes])
    fast_motion = _fast_motion(cell, velocity, acceleration)
    links, from_urdf = nominal_links(model.robot, cell.urdf)
    loaded = links.copy()
    loaded[-1] += expected.parameters
    torque = nominal_torque_limits(model, cell.urdf, loaded, fast_motion)
    gains = np.array([axis.nameplate_gain for axis in cell.axes])
    noise = NOISE_SHARE * (np.abs(model.drive_train.to_motor) * torque).max(axis=1) / np.abs(gains)
    expectation = Expectation(
        model=model,
        gains=gains,
        parameters=nominal_parameters(model, links, torque, velocity, acceleration),
        payloads=(expected,),
        noise_a=effective_noise(noise, LAG_ONE),
    )
    scene = scene_of(cell, model.robot, mounted.mass_kg)
    remarks = (
        f"payload {mounted.name}, {mounted.mass_kg:g} kg" + ("" if from_urdf else "; link masses guessed"),
        f"noise {100 * NOISE_SHARE:g} % of the current at each motor's torque limit, correlation {LAG_ONE:g} from row "
        "to row",
        *scene.remarks,
    )
    period, edge = _rows(cell)
    return Experiment(cell, Design(expectation, visible(model, fast_motion)), scene, mounted, period, edge, remarks)


def _payload(cell: Cell, name: str | None) -> WeighedPayload:
    found = [payload for payload in cell.payloads if name in (None, payload.name)]
    if not found:
        names = ", ".join(payload.name for payload in cell.payloads) or "none"
        raise ConfigurationInconsistent(
            f"payloads of cell {cell.name!r}",
            found=names,
            expected="a weighed payload" if name is None else repr(name),
            remedy="gains show only beside a known mass: weigh a body and declare it under `payloads`",
        )
    return found[0]


def _fast_motion(cell: Cell, velocity: FloatArray, acceleration: FloatArray) -> Motion:
    """Random moves as fast as the limits allow: which parameters there are does not depend on a plan's seed."""
    rng = np.random.default_rng(0)
    lower, upper = np.array([axis.limits.position for axis in cell.axes]).T
    targets = rng.uniform(lower, upper, (40, len(lower)))
    parts = []
    for start, end in pairwise(targets):
        path = synchronised(start, end, velocity, acceleration)
        parts.append(path.at(np.linspace(0.02, 0.98, 24) * path.duration_s))
    return Motion(*(np.concatenate([part[kind] for part in parts]) for kind in range(3)))


def _rows(cell: Cell) -> tuple[float, float]:
    """Time between rows, and how far from a standstill a row's filter window must be for it to count [s]."""
    conditioning = cell.conditioning
    rate_hz = 1000.0
    filter_ = decimator(rate_hz, conditioning.decimation_cutoff_hz)
    weight = np.cumsum(np.abs(filter_.taps)) / np.abs(filter_.taps).sum()
    inside = int(np.searchsorted(weight, conditioning.standstill_share))
    return filter_.factor / rate_hz, max(filter_.half - inside, 0) / rate_hz


@dataclass(frozen=True, slots=True)
class PlannedMove:
    """One synchronised point-to-point move."""

    target_rad: tuple[float, ...]  #: joint positions at its end [rad; m of a prismatic joint], shape (n,)
    velocity: float  #: share of the joints' limits, above 0 up to 1
    acceleration: float  #: share of the joints' limits, above 0 up to 1
    dwell_s: float  #: rest after it [s]


def path_of(cell: Cell, start_rad: FloatArray, move: PlannedMove) -> Trapezoid:
    """The joint trapezoid of a move from the robot's position."""
    velocity = np.array([axis.limits.velocity for axis in cell.axes]) * move.velocity
    acceleration = np.array([axis.limits.acceleration for axis in cell.axes]) * move.acceleration
    return synchronised(start_rad, np.array(move.target_rad), velocity, acceleration)


def paths_of(cell: Cell, moves: Sequence[PlannedMove]) -> tuple[Trapezoid, ...]:
    """Paths of all moves but the first, whose start is unknown."""
    starts = (np.array(move.target_rad) for move in moves)
    return tuple(path_of(cell, start, move) for start, move in zip(starts, moves[1:], strict=False))


def duration_of(cell: Cell, moves: Sequence[PlannedMove]) -> float:
    """From the first target to the end of the last dwell [s]."""
    return float(sum(path.duration_s for path in paths_of(cell, moves)) + sum(move.dwell_s for move in moves))
