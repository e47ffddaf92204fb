"""The experiment that a plan is for: the same moves once without load and once with the weighed
payload.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import cycle, pairwise

import numpy as np

from daq.config.cell import Cell, WeighedPayload, model_of
from daq.config.workspace import DEFAULT_MINIMUM_M, Clearance
from daq.errors import ConfigurationInconsistent
from drivers.move import Trapezoid, synchronised
from ident.arrays import BoolArray, FloatArray
from ident.model.robot import JointKind, Motion, Robot, poses
from ident.planning.clear_way import farthest_towards
from ident.planning.clearance import BASE, Capsule, Checker, Scene
from ident.planning.effort import believable_efforts, effort_shares
from ident.planning.excitation import (
    LAG_ONE,
    NOISE_SHARE,
    Design,
    Excitation,
    declared_efforts,
    nominal_expectation,
    nominal_payload,
    rows_between_rests,
    side_of_cube,
    visible_base,
)
from ident.planning.gain_verdict import ExtraMoves
from ident.planning.limits import JointLimits


def limits_of(cell: Cell) -> JointLimits:
    """Return the limits that a cell declares."""
    limits = [axis.limits for axis in cell.axes]
    lower = [one.position[0] for one in limits]
    upper = [one.position[1] for one in limits]
    velocity = [one.velocity for one in limits]
    acceleration = [one.acceleration for one in limits]
    return JointLimits(
        lower=lower,
        upper=upper,
        velocity=velocity,
        acceleration=acceleration,
    )


LINK_RADIUS = 0.08
"""Radius of a guessed link, as a share of the length of the joint chain:
6 cm for an arm of the TX-40's size.
"""
POSTURES = 400
PAYLOAD = "payload"  #: Name of the capsule of a body that no capsule declares
ALWAYS = 0.03
"""Two capsules that are apart in a smaller share of random postures belong together,
as at a shared joint.
"""


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
        if self.guessed:
            known = "guessed from the joint chain; declare `clearance` in the cell file"
        else:
            known = "as declared"
        shape = f"shape of the arm: {len(scene.capsules)} capsules, {known}"
        if self.guessed and self.checker.robot.is_constrained:
            shape = (
                "shape of the links: unknown, of a closed chain it is not guessed; declare "
                "`clearance` in the cell file"
            )
        lines = [shape, f"clearance: {1000 * scene.minimum_m:.0f} mm"]
        if self.together:
            pairs = [f"{first} and {second}" for first, second in self.together]
            listed = ", ".join(pairs)
            lines.append(
                f"not checked against each other, as they touch in nearly every posture: {listed}"
            )
        if not scene.boxes and scene.workspace is None:
            lines.append(
                "obstacles and workspace: none declared; tables, cables and people are not known"
            )
        return tuple(lines)


def scene_of(cell: Cell, robot: Robot, mass_kg: float) -> CheckedScene:
    """The cell's own capsules, or guessed ones, and the pairs of them that must keep apart."""
    declared = cell.clearance or Clearance(None, DEFAULT_MINIMUM_M, (), ())
    capsules = declared.capsules or guessed_capsules(robot)
    last = robot.carrier
    if not any(capsule.link == last for capsule in capsules):
        # Around a steel body of that mass, from where it is mounted to three of its sides away.
        side = side_of_cube(mass_kg)
        axis = robot.joints[last].axis
        at = robot.mounting_m
        begin = point_of(at + side * axis)
        end = point_of(at + 2.0 * side * axis)
        capsules = (
            *capsules,
            Capsule(PAYLOAD, last, begin, end, side),
        )
    links = [capsule.link for capsule in capsules]
    parents = [robot.joints[link].parent if link != BASE else None for link in links]
    candidates = []
    for second in range(len(capsules)):
        for first in range(second):
            is_same = links[first] == links[second]
            is_joined = links[first] == parents[second] or parents[first] == links[second]
            if not is_same and not is_joined:
                candidates.append((first, second))
    confined = tuple(index for index, capsule in enumerate(capsules) if capsule.link == last)
    everything = Scene(
        capsules,
        tuple(candidates),
        declared.obstacles,
        declared.workspace,
        confined,
        declared.minimum_m,
    )
    limits = limits_of(cell)
    rng = np.random.default_rng(0)
    postures = rng.uniform(limits.lower, limits.upper, (POSTURES, len(cell.axes)))
    # Of a guessed shape, a pair that never keeps the distance belongs together as one that always
    # touches does.
    is_guessed = [not declared.capsules or capsule.name == PAYLOAD for capsule in capsules]
    grown = []
    for capsule, guessed in zip(capsules, is_guessed, strict=True):
        margin_m = 0.5 * declared.minimum_m if guessed else 0.0
        grown.append(replace(capsule, radius_m=capsule.radius_m + margin_m))
    grown_scene = replace(everything, capsules=tuple(grown))
    apart = Checker(robot, grown_scene).apart(postures) > ALWAYS
    pairs = []
    together = []
    for (first, second), is_apart in zip(candidates, apart, strict=True):
        if is_apart:
            pairs.append((first, second))
        else:
            together.append((capsules[first].name, capsules[second].name))
    scene = replace(everything, pairs=tuple(pairs))
    return CheckedScene(Checker(robot, scene), not declared.capsules, tuple(together))


def guessed_capsules(robot: Robot) -> tuple[Capsule, ...]:
    """One from each joint to the next revolute one;
    the far end is drawn in, so that a bent elbow is no collision.

    A way along a prismatic joint changes its length, and a guess would be no better than none:
    those links get none. Neither do those of a closed chain, whose legs lie in front of and behind
    each other.
    """
    if robot.is_constrained:
        return ()
    lengths_m = [float(np.linalg.norm(joint.translation_m)) for joint in robot.joints]
    radius = LINK_RADIUS * max(sum(lengths_m), 0.1)
    capsules = []
    for joint in robot.joints:
        length = float(np.linalg.norm(joint.translation_m))
        if joint.parent != BASE:
            before = robot.joints[joint.parent].kind
        else:
            before = JointKind.REVOLUTE
        if length <= 2.0 * radius or JointKind.PRISMATIC in (joint.kind, before):
            continue
        end = joint.translation_m * (1.0 - radius / length)
        if joint.parent == BASE:
            name = "base"
        else:
            name = f"link {joint.parent + 1}"
        capsules.append(Capsule(name, joint.parent, (0.0, 0.0, 0.0), point_of(end), radius))
    return tuple(capsules)


def point_of(vector: FloatArray) -> tuple[float, float, float]:
    """Return a vector as a place."""
    return float(vector[0]), float(vector[1]), float(vector[2])


#: What is mounted while the moves are made: nothing, then the payload
RUNS: tuple[int | None, ...] = (None, 0)


@dataclass(frozen=True, slots=True, eq=False)
class Experiment:
    """Everything needed to judge moves before they are made."""

    cell: Cell  #: of the arm
    design: Design  #: unknowns and information
    scene: CheckedScene  #: what must keep apart
    payload: WeighedPayload  #: that will be mounted
    row_s: float  #: time between two rows of the observation [s]
    edge_s: float  #: how long after a standstill rows begin to count [s]
    #: Torque limit of each axis [Nm; N of a prismatic joint], inf where it is not known, shape
    #: (n,).
    effort: FloatArray
    remarks: tuple[str, ...]  #: what was assumed, in words
    #: what is mounted at each repetition of the moves: payload or None
    mounted: tuple[int | None, ...] = RUNS

    def excitation(
        self, paths: Sequence[Trapezoid], thinning: int = 1
    ) -> tuple[Excitation, tuple[slice, ...]]:
        """Rows of several moves, one after the other, and which of them belong to which move."""
        period = self.row_s * thinning
        times = [np.arange(0.5 * period, path.duration_s, period) for path in paths]
        parts = [path.at(time) for path, time in zip(paths, times, strict=True)]
        motion = _joined(parts)
        uses = [self._use(path, time) for path, time in zip(paths, times, strict=True)]
        use = np.concatenate(uses, axis=1)
        ends = np.cumsum([len(time) for time in times])
        slices = []
        for end, time in zip(ends.tolist(), times, strict=True):
            slices.append(slice(end - len(time), end))
        return Excitation(motion, use), tuple(slices)

    def informations(self, paths: Sequence[Trapezoid], thinning: int = 1) -> list[FloatArray]:
        """Information of each move with everything that is mounted in turn,
        all from one regressor.
        """
        if not paths:
            return []
        excitation, slices = self.excitation(paths, thinning)
        whitened = self.design.whitened(excitation)
        informations = []
        for part in slices:
            information = self.design.information_of(whitened[:, :, part], self.mounted)
            informations.append(thinning * information)
        return informations

    def effort_shares(self, paths: Sequence[Trapezoid]) -> FloatArray:
        """Largest expected torque of each axis on each way, over its limit; shape (ways, n).

        It is that with the heavier of the payloads that are mounted in turn.
        """
        if not paths or not np.isfinite(self.effort).any():
            return np.zeros((len(paths), len(self.effort)))
        times = [_torque_times(path) for path in paths]
        motions = [path.at(time) for path, time in zip(paths, times, strict=True)]
        motion = _joined(motions)
        shares = effort_shares(self.design.expectation, self.effort, motion, self.mounted)
        of_ways = shares.reshape(len(self.effort), len(paths), -1)
        return np.asarray(of_ways.max(axis=2).T)

    def _use(self, path: Trapezoid, time_s: FloatArray) -> BoolArray:
        """Rows of each motor that count; the same rule as ident/equations/rows.py,
        for moves from rest to rest.
        """
        train = self.design.expectation.model.drive_train
        # On a trapezoid a joint is slowest at the ends of a row's window.
        early = path.at(time_s - self.edge_s)[1].T
        late = path.at(time_s + self.edge_s)[1].T
        declared_rad_s = self.cell.conditioning.standstill_rad_s or (0.0,) * len(early)
        standstill = np.array(declared_rad_s)[:, None]
        slowest = np.minimum(np.abs(early), np.abs(late))
        moving = slowest > standstill
        motor_early = np.abs(train.direction @ early)
        motor_late = np.abs(train.direction @ late)
        turned = np.minimum(motor_early, motor_late) > standstill
        is_moved = np.abs(train.to_motor) > 0
        is_loaded = np.abs(train.direction) > 0
        needed = is_moved | is_loaded
        uses = []
        for motor, has_turned in enumerate(turned):
            all_moving = moving[needed[motor]].all(axis=0)
            uses.append(all_moving & has_turned)
        use = np.stack(uses)
        if self.design.expectation.model.is_redundant:
            use &= use.all(axis=0)
        return use


def experiment_of(cell: Cell, payload: str | None = None) -> Experiment:
    """Expectation of a cell's arm: inertias of the URDF, stated guesses for the rest,
    nameplate gains.

    Args:
        payload: name of it, None for the first.

    Raises:
        ConfigurationInconsistent: the cell declares no payload, or none of that name.
    """
    found = [declared for declared in cell.payloads if payload in (None, declared.name)]
    if not found:
        known = ", ".join(declared.name for declared in cell.payloads)
        raise ConfigurationInconsistent(
            f"payloads of cell {cell.name!r}",
            found="none" if payload is None else f"no payload {payload!r}",
            expected=known or "a weighed payload",
            remedy="the gains need a known mass: give a declared name, or weigh a body and "
            "declare it under `payloads`",
        )
    mounted = found[0]
    model = model_of(cell)
    expected = nominal_payload(model.robot, mounted.drawn)
    limits = limits_of(cell)
    fast_motion = _fast_motion(limits, Checker(model.robot, NOTHING))
    gains = np.array([axis.nameplate_gain for axis in cell.axes])
    expectation, from_urdf = nominal_expectation(
        model, cell.urdf, gains, expected, limits, fast_motion
    )
    scene = scene_of(cell, model.robot, mounted.mass_kg)
    source = "from the URDF" if from_urdf else "guessed"
    noise_percent = 100 * NOISE_SHARE
    remarks = (
        f"payload: {mounted.name}, {mounted.mass_kg:g} kg",
        f"masses of the links: {source}",
        f"noise: {noise_percent:g} % of each motor's current at its torque limit, correlation "
        f"{LAG_ONE:g} from row to row",
        *scene.remarks,
    )
    design = Design(expectation, visible_base(model, fast_motion))
    period, edge = rows_between_rests(cell.conditioning)
    declared = declared_efforts(model, cell.urdf)
    effort = believable_efforts(expectation, declared, fast_motion.position_rad, RUNS)
    remarks = (*remarks, *_effort_remarks(cell, declared, effort, from_urdf=from_urdf))
    return Experiment(cell, design, scene, mounted, period, edge, effort, remarks)


def _effort_remarks(
    cell: Cell, declared: FloatArray, believed: FloatArray, *, from_urdf: bool
) -> tuple[str, ...]:
    """Say which axes have no effort limit that moves could be kept below;
    masses of the links may be guessed.
    """
    lines: list[str] = []
    unknown: list[str] = []
    refuted: list[str] = []
    for name, of_urdf, limit in zip(cell.axis_names, declared, believed, strict=True):
        if np.isinf(of_urdf):
            unknown.append(name)
        elif np.isinf(limit):
            refuted.append(name)
    if unknown:
        lines.append(
            f"torque limits: the URDF has no `effort` of {', '.join(unknown)}; not kept there"
        )
    if refuted:
        if from_urdf:
            masses = "the masses of the URDF"
        else:
            masses = "guessed masses of the links"
        lines.append(
            f"torque limits: with {masses}, gravity alone asks more than the `effort` of "
            f"{', '.join(refuted)} in the URDF; not kept there. Correct `effort` or the masses; "
            "the planner knows no balancer"
        )
    return tuple(lines)


PIECE_SHARES = np.array([0.01, 0.25, 0.5, 0.75, 0.99])
"""Where the torque is looked at in each piece of a trapezoid:
near its ends, where it jumps, and between.
"""


def _torque_times(path: Trapezoid) -> FloatArray:
    """Times at which the torque of a move may be largest [s], also at rest before and after it;
    as many for each.
    """
    corners = (0.0, path.ramp_s, path.duration_s - path.ramp_s, path.duration_s)
    pieces = [begin + PIECE_SHARES * (end - begin) for begin, end in pairwise(corners)]
    at_rest = np.array([-1.0, path.duration_s + 1.0])
    return np.concatenate([*pieces, at_rest])


NOTHING = Scene((), (), (), None, (), 0.0)  #: Without bodies, a checker knows what closures allow


def _fast_motion(limits: JointLimits, checker: Checker) -> Motion:
    """Random moves as fast as the limits allow:
    which parameters there are does not depend on a plan's seed.
    """
    rng = np.random.default_rng(0)
    targets = rng.uniform(limits.lower, limits.upper, (40, len(limits.lower)))
    if checker.robot.is_constrained:
        targets = _allowed(checker, rng, limits.lower, limits.upper, len(targets))
    parts = []
    for start, end in pairwise(targets):
        path = synchronised(start, end, limits.velocity, limits.acceleration)
        shares = np.linspace(0.02, 0.98, 24)
        parts.append(path.at(shares * path.duration_s))
    return _joined(parts)


def _joined(parts: Sequence[tuple[FloatArray, ...]]) -> Motion:
    """Join motions of positions, velocities and accelerations, one after the other."""
    return Motion(*map(np.concatenate, zip(*parts, strict=True)))


def _allowed(
    checker: Checker, rng: np.random.Generator, lower: FloatArray, upper: FloatArray, count: int
) -> FloatArray:
    """Positions of a closed chain that can be reached one after the other, shape (count, m)."""
    found = [checker.home]
    while len(found) <= count:
        posture = rng.uniform(lower, upper)
        found.append(towards(checker, found[-1], posture, lower, upper))
    return np.array(found[1:])


def towards(
    checker: Checker, start: FloatArray, target: FloatArray, lower: FloatArray, upper: FloatArray
) -> FloatArray:
    """The farthest position that a closed chain can go to on the way to a target;
    the start where there is none.

    Args:
        checker: of the robot.
        start, target: positions of the axes [rad or m], shape (m,).
        lower, upper: limits of the axes, shape (m,).
    """
    found = farthest_towards(checker, start, target, lower, upper)
    return start if found is None else found


@dataclass(frozen=True, slots=True)
class PlannedMove:
    """One synchronised point-to-point move."""

    #: joint positions at its end [rad; m of a prismatic joint], shape (n,)
    target_rad: tuple[float, ...]
    velocity: float  #: share of the joints' velocity limits, above 0 up to 1
    acceleration: float  #: share of the joints' acceleration limits, above 0 up to 1
    dwell_s: float  #: rest after it [s]


def path_of(cell: Cell, start_rad: FloatArray, move: PlannedMove) -> Trapezoid:
    """The joint trapezoid of a move from the robot's position."""
    limits = limits_of(cell)
    velocity = limits.velocity * move.velocity
    acceleration = limits.acceleration * move.acceleration
    return synchronised(start_rad, np.array(move.target_rad), velocity, acceleration)


def paths_of(cell: Cell, moves: Sequence[PlannedMove]) -> tuple[Trapezoid, ...]:
    """Paths of all moves but the first, whose start is unknown."""
    starts = (np.array(move.target_rad) for move in moves)
    return tuple(path_of(cell, start, move) for start, move in zip(starts, moves[1:], strict=False))


def experiment_duration_s(cell: Cell, moves: Sequence[PlannedMove]) -> float:
    """From the first target to the end of the last dwell [s]."""
    motion_s = sum(path.duration_s for path in paths_of(cell, moves))
    dwell_s = sum(move.dwell_s for move in moves)
    return float(motion_s + dwell_s)


SECONDS = 5.0  #: Duration of the extra moves of each kind, so that the kinds can be compared
EXTRA_POSTURES = 300
SLOW = 0.2  #: Share of the speed limit at which gravity excites more than inertia
STROKES = (1.0, 0.7, 0.4)  #: Shares of the range that are tried until the way is clear


def extra_moves(experiment: Experiment) -> tuple[ExtraMoves, ...]:
    """Some five seconds of each kind, within limits and clear of everything; the same every time.

    For every axis: fast with the arm stretched, fast with it folded (as the payload's link is seen
    from that axis), slow with it stretched, and fast together with a neighbour; and of all axes
    together.
    """
    cell = experiment.cell
    checker = experiment.scene.checker
    limits = limits_of(cell)
    low, high = limits.targets()
    rng = np.random.default_rng(0)
    sampled = rng.uniform(low, high, (EXTRA_POSTURES, len(low)))
    if checker.robot.is_constrained:
        rng = np.random.default_rng(0)
        sampled = _allowed(checker, rng, low, high, EXTRA_POSTURES // 15)
    clear = sampled[checker.margins(sampled) > 0.0]
    found: list[ExtraMoves] = []
    ends_of = _swing_of_chain if checker.robot.is_constrained else _swing

    def swing(words: str, postures: FloatArray, moved: list[int], speed: float = 1.0) -> None:
        """There and back in the first few postures in which that is clear."""
        paths: list[Trapezoid] = []
        for posture in postures:
            ends = ends_of(checker, posture, moved, low, high)
            if ends is not None:
                there = synchronised(*ends, limits.velocity * speed, limits.acceleration)
                paths += [there, Trapezoid(there.end, there.start, there.duration_s, there.ramp_s)]
            if len(paths) >= 6:
                break
        chosen: list[Trapezoid] = []
        seconds = 0.0
        for path in cycle(paths):
            chosen.append(path)
            seconds += path.duration_s
            if seconds >= SECONDS:
                break
        if chosen:
            found.append(ExtraMoves(words, seconds, experiment.excitation(chosen)[0]))

    names = cell.axis_names
    robot = experiment.design.expectation.model.robot
    at = poses(robot, checker.joints(clear))
    for axis, (name, joint) in enumerate(zip(names, robot.axis_joints, strict=True)):
        # Distance of the link with the payload from the axis; of a prismatic one, from the axis'
        # own frame [m].
        carrier_m = at.origin_m[robot.carrier + 1]
        way = carrier_m - at.origin_m[joint + 1]
        if robot.joints[joint].kind is not JointKind.PRISMATIC:
            axis_of_joint = at.rotation[joint + 1] @ robot.joints[joint].axis
            way = np.cross(axis_of_joint, way)
        lever = np.linalg.norm(way, axis=1)
        stretched = clear[np.argsort(-lever, kind="stable")]
        folded = clear[np.argsort(lever, kind="stable")]
        swing(f"fast moves of {name} with the arm stretched", stretched, [axis])
        swing(f"fast moves of {name} with the arm folded", folded, [axis])
        swing(f"slow moves of {name} with the arm stretched", stretched, [axis], SLOW)
        other = axis + 1 if axis + 1 < len(names) else axis - 1
        if other >= 0:
            swing(f"fast moves of {name} and {names[other]} together", clear, [axis, other])
    swing("fast moves of all axes", clear, list(range(len(names))))
    return tuple(found)


def _swing(
    checker: Checker, posture: FloatArray, moved: list[int], low: FloatArray, high: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Both ends of the longest clear swing of some axes about the middle of their range;
    None where there is none.
    """
    for stroke in STROKES:
        inwards = 0.5 * (1.0 - stroke) * (high - low)
        start = posture.copy()
        end = posture.copy()
        start[moved] = (low + inwards)[moved]
        end[moved] = (high - inwards)[moved]
        if checker.obstruction(start, end) is None:
            return start, end
    return None


def _swing_of_chain(
    checker: Checker, posture: FloatArray, moved: list[int], low: FloatArray, high: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """The same where the other axes follow, as far as the closures allow;
    None where that is nowhere.
    """
    ends: list[FloatArray] = []
    for limit in (low, high):
        target = posture.copy()
        target[moved] = limit[moved]
        ends.append(towards(checker, ends[-1] if ends else posture, target, low, high))
    if np.allclose(ends[0], ends[1]):
        return None
    return (ends[0], ends[1])
