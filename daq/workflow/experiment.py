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
from daq.errors import ConfigurationInconsistent, counted
from drivers.move import Trapezoid, synchronised
from ident.arrays import BoolArray, FloatArray
from ident.model.robot import JointKind, Motion, Poses, Robot, poses
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


LINK_RADIUS_SHARE = 0.08
"""Radius of a guessed link, as a share of the length of the joint chain:
6 cm for an arm of the TX-40's size.
"""
POSTURES = 400  #: Random postures in which capsules are compared
PAYLOAD = "payload"  #: Name of the guessed capsule of the payload
LEAST_APART_SHARE = 0.03
"""Two capsules that are apart in no larger share of random postures are not checked against each
other: they touch in nearly every posture, as at a shared joint.
"""


@dataclass(frozen=True, slots=True, eq=False)
class CheckedScene:
    """A scene, and what an operator must know of it."""

    checker: Checker  #: answers whether a way is clear
    #: Number of declared capsules, which are the first of the scene; the others are guessed.
    declared: int
    #: Link on which a capsule of the payload would have to be declared; None where one is.
    payload_link: str | None
    #: Names of pairs that are not checked, because they touch in nearly every posture.
    together: tuple[tuple[str, str], ...]

    @property
    def guessed(self) -> bool:
        """Whether the arm's shape is a guess."""
        return self.declared == 0

    @property
    def remarks(self) -> tuple[str, ...]:
        """Remarks for the operator."""
        scene = self.checker.scene
        count = len(scene.capsules)
        if not self.guessed:
            capsules = counted(self.declared, "capsule")
            shape = f"shape of the arm: {capsules}, as declared"
        elif self.checker.robot.is_constrained:
            shape = (
                "shape of the links: unknown, of a closed chain it is not guessed; declare "
                "`clearance` in the cell file"
            )
        else:
            shape = (
                f"shape of the arm: {count} capsules, guessed from the joint chain; declare "
                "`clearance` in the cell file"
            )
        lines = [shape]
        if not self.guessed and self.payload_link is not None:
            lines.append(
                "shape of the payload: guessed from its mass; declare a capsule on link "
                f"{self.payload_link} in `clearance.capsules` of the cell file"
            )
        lines.append(f"clearance: {1000 * scene.minimum_m:.0f} mm")
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
    """Return the scene of a cell: its declared capsules, or guessed ones, one for the payload,
    and the pairs of capsules that must keep apart.

    Args:
        cell: with limits and clearance.
        robot: of the cell.
        mass_kg: of the payload, which gives the size of its capsule where none is declared.
    """
    declared = cell.clearance or Clearance(None, DEFAULT_MINIMUM_M, (), ())
    declared_count = len(declared.capsules)
    capsules = declared.capsules or guessed_capsules(robot)
    carrier = robot.carrier
    payload_link = None
    if not any(capsule.link == carrier for capsule in capsules):
        payload_link = _link_name(cell, robot, carrier)
        # Around a steel cube of that mass, along the joint's axis. The round ends have one side as
        # their radius: with them it reaches from the mounting to three sides away.
        side_m = side_of_cube(mass_kg)
        axis = robot.joints[carrier].axis
        start_m = point_of(robot.mounting_m + side_m * axis)
        end_m = point_of(robot.mounting_m + 2.0 * side_m * axis)
        payload = Capsule(PAYLOAD, carrier, start_m, end_m, radius_m=side_m)
        capsules = (*capsules, payload)
    candidates = _pairs_of_separate_links(robot, capsules)
    # What the workspace confines: everything on the link with the payload
    confined = tuple(index for index, capsule in enumerate(capsules) if capsule.link == carrier)
    scene_of_all_pairs = Scene(
        capsules=capsules,
        pairs=candidates,
        boxes=declared.obstacles,
        workspace=declared.workspace,
        confined=confined,
        minimum_m=declared.minimum_m,
    )
    limits = limits_of(cell)
    rng = np.random.default_rng(0)
    postures = rng.uniform(limits.lower, limits.upper, (POSTURES, len(cell.axes)))
    # Two guessed capsules that never keep the least distance are not checked, as two that always
    # touch: each grows by half of that distance, so that they touch here.
    grown = []
    for number, capsule in enumerate(capsules):
        radius_m = capsule.radius_m
        is_guessed = number >= declared_count
        if is_guessed:
            radius_m += 0.5 * declared.minimum_m
        grown.append(replace(capsule, radius_m=radius_m))
    grown_scene = replace(scene_of_all_pairs, capsules=tuple(grown))
    apart_shares = Checker(robot, grown_scene).apart(postures)
    are_apart = apart_shares > LEAST_APART_SHARE
    pairs = []
    together = []
    for (first, second), is_apart in zip(candidates, are_apart, strict=True):
        if is_apart:
            pairs.append((first, second))
        else:
            together.append((capsules[first].name, capsules[second].name))
    scene = replace(scene_of_all_pairs, pairs=tuple(pairs))
    return CheckedScene(
        checker=Checker(robot, scene),
        declared=declared_count,
        payload_link=payload_link,
        together=tuple(together),
    )


def _link_name(cell: Cell, robot: Robot, joint: int) -> str:
    """Return the name that a cell file has for the link behind a joint: that of the axis which
    drives it, or of the joint where none does.
    """
    axis_by_joint = dict(zip(robot.axis_joints, cell.axis_names, strict=True))
    return axis_by_joint.get(joint, robot.joints[joint].name)


def _pairs_of_separate_links(
    robot: Robot, capsules: Sequence[Capsule]
) -> tuple[tuple[int, int], ...]:
    """Return the pairs of capsules on different links without a common joint, by their indices."""
    links = [capsule.link for capsule in capsules]
    parents: list[int | None] = []
    for link in links:
        parent = None
        if link != BASE:
            parent = robot.joints[link].parent
        parents.append(parent)
    pairs = []
    for second in range(len(capsules)):
        for first in range(second):
            is_same = links[first] == links[second]
            is_joined = links[first] == parents[second] or parents[first] == links[second]
            if not is_same and not is_joined:
                pairs.append((first, second))
    return tuple(pairs)


def guessed_capsules(robot: Robot) -> tuple[Capsule, ...]:
    """Guess a capsule from each joint to the next one;
    the far end is drawn in, so that a bent elbow is no collision.

    Links at a prismatic joint get none: their length changes, and a guess would be no better than
    none. Neither do those of a closed chain, whose legs lie in front of and behind each other.
    """
    if robot.is_constrained:
        return ()
    lengths_m = [float(np.linalg.norm(joint.translation_m)) for joint in robot.joints]
    radius_m = LINK_RADIUS_SHARE * max(sum(lengths_m), 0.1)
    capsules = []
    for joint, length_m in zip(robot.joints, lengths_m, strict=True):
        if joint.parent == BASE:
            name = "base"
            parent_kind = JointKind.REVOLUTE
        else:
            name = f"link {joint.parent + 1}"
            parent_kind = robot.joints[joint.parent].kind
        is_prismatic = JointKind.PRISMATIC in (joint.kind, parent_kind)
        is_short = length_m <= 2.0 * radius_m
        if is_prismatic or is_short:
            continue
        end_m = joint.translation_m * (1.0 - radius_m / length_m)
        capsules.append(Capsule(name, joint.parent, (0.0, 0.0, 0.0), point_of(end_m), radius_m))
    return tuple(capsules)


def point_of(vector: FloatArray) -> tuple[float, float, float]:
    """Return a vector of shape (3,) as a tuple."""
    return float(vector[0]), float(vector[1]), float(vector[2])


#: What is mounted at each repetition of the moves: nothing, then the payload, by its number
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
    #: what is mounted at each repetition of the moves: number of the payload, None without load
    mounted: tuple[int | None, ...] = RUNS

    def excitation(
        self, paths: Sequence[Trapezoid], thinning: int = 1
    ) -> tuple[Excitation, tuple[slice, ...]]:
        """Return the rows of several moves, one after the other, and a slice of them for each move.

        Args:
            paths: of the moves.
            thinning: only every so many-th row is made.
        """
        period_s = self.row_s * thinning
        motions = []
        uses = []
        slices = []
        row_count = 0
        for path in paths:
            time_s = np.arange(0.5 * period_s, path.duration_s, period_s)
            motions.append(path.at(time_s))
            uses.append(self._use(path, time_s))
            slices.append(slice(row_count, row_count + len(time_s)))
            row_count += len(time_s)
        motion = _joined(motions)
        use = np.concatenate(uses, axis=1)
        return Excitation(motion, use), tuple(slices)

    def informations(self, paths: Sequence[Trapezoid], thinning: int = 1) -> list[FloatArray]:
        """Return the information of each move, summed over what is mounted in turn.

        One regressor serves all moves. Where rows are thinned out, each counts for those left out.
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
        """Return the largest expected torque of each axis on each path over its effort limit,
        with whatever is mounted in turn, shape (paths, n).
        """
        if not paths or not np.isfinite(self.effort).any():
            return np.zeros((len(paths), len(self.effort)))
        motion = _joined([path.at(_torque_times(path)) for path in paths])
        shares = effort_shares(self.design.expectation, self.effort, motion, self.mounted)
        # Every path has as many torque times: axes, paths, times
        by_path = shares.reshape(len(self.effort), len(paths), -1)
        return np.asarray(by_path.max(axis=2).T)

    def _use(self, path: Trapezoid, time_s: FloatArray) -> BoolArray:
        """Return which rows of each motor count, shape (motors, k);
        the same rule as in ident/equations/rows.py, for moves from rest to rest.
        """
        model = self.design.expectation.model
        train = model.drive_train
        # On a trapezoid a joint is slowest at the ends of a row's window.
        early = path.at(time_s - self.edge_s)[1].T
        late = path.at(time_s + self.edge_s)[1].T
        declared_rad_s = self.cell.conditioning.standstill_rad_s or (0.0,) * len(early)
        standstill = np.array(declared_rad_s)[:, None]
        slowest = np.minimum(np.abs(early), np.abs(late))
        joint_moves = slowest > standstill
        motor_early = np.abs(train.direction @ early)
        motor_late = np.abs(train.direction @ late)
        motor_moves = np.minimum(motor_early, motor_late) > standstill
        # Motor i's equation mixes the joints in row i of T, and those that turn the motor; each of
        # them must move.
        is_mixed = np.abs(train.to_motor) > 0
        is_turned = np.abs(train.direction) > 0
        uses = []
        for motor, moves in enumerate(motor_moves):
            joints = is_mixed[motor] | is_turned[motor]
            all_move = joint_moves[joints].all(axis=0)
            uses.append(all_move & moves)
        use = np.stack(uses)
        if model.is_redundant:
            use &= use.all(axis=0)
        return use


def experiment_of(cell: Cell, payload: str | None = None) -> Experiment:
    """Return the experiment of a cell, with the expected arm: inertias of the URDF,
    guesses for the rest, which the remarks state, and nameplate gains.

    Args:
        cell: of the arm.
        payload: name of the payload, None for the first.

    Raises:
        ConfigurationInconsistent: the cell declares no payload, or none of that name.
    """
    found = [declared for declared in cell.payloads if payload in (None, declared.name)]
    if not found:
        known = ", ".join(declared.name for declared in cell.payloads)
        lacking = "none"
        if payload is not None:
            lacking = f"no payload {payload!r}"
        raise ConfigurationInconsistent(
            f"payloads of cell {cell.name!r}",
            found=lacking,
            expected=known or "a weighed payload",
            remedy="the gains need a known mass: give a declared name, or weigh a body and "
            "declare it under `payloads`",
        )
    weighed = found[0]
    model = model_of(cell)
    expected_payload = nominal_payload(model.robot, weighed.drawn)
    limits = limits_of(cell)
    fast_motion = _fast_motion(limits, Checker(model.robot, EMPTY_SCENE))
    gains = np.array([axis.nameplate_gain for axis in cell.axes])
    expectation, from_urdf = nominal_expectation(
        model, cell.urdf, gains, expected_payload, limits, fast_motion
    )
    scene = scene_of(cell, model.robot, weighed.mass_kg)
    design = Design(expectation, visible_base(model, fast_motion))
    row_s, edge_s = rows_between_rests(cell.conditioning)
    declared_effort = declared_efforts(model, cell.urdf)
    effort = believable_efforts(expectation, declared_effort, fast_motion.position_rad, RUNS)
    source = "guessed"
    if from_urdf:
        source = "from the URDF"
    noise_percent = 100 * NOISE_SHARE
    remarks = (
        f"payload: {weighed.name}, {weighed.mass_kg:g} kg",
        f"masses of the links: {source}",
        f"noise: {noise_percent:g} % of each motor's current at its torque limit, correlation "
        f"{LAG_ONE:g} from row to row",
        *scene.remarks,
        *_effort_remarks(cell, declared_effort, effort, from_urdf=from_urdf),
    )
    return Experiment(
        cell=cell,
        design=design,
        scene=scene,
        payload=weighed,
        row_s=row_s,
        edge_s=edge_s,
        effort=effort,
        remarks=remarks,
    )


def _effort_remarks(
    cell: Cell, declared: FloatArray, believed: FloatArray, *, from_urdf: bool
) -> tuple[str, ...]:
    """Say which axes have no effort limit that planned moves could stay below.

    Args:
        cell: of the arm.
        declared: effort limits of the URDF, inf where it has none, shape (n,).
        believed: the same, and inf where gravity alone exceeds them, shape (n,).
        from_urdf: whether the masses of the links are from the URDF, not guessed.
    """
    lines: list[str] = []
    unknown: list[str] = []
    refuted: list[str] = []
    limits = zip(cell.axis_names, declared, believed, strict=True)
    for name, declared_limit, believed_limit in limits:
        if np.isinf(declared_limit):
            unknown.append(name)
        elif np.isinf(believed_limit):
            refuted.append(name)
    if unknown:
        lines.append(
            f"torque limits: the URDF has no `effort` of {', '.join(unknown)}; their torque is not "
            "limited"
        )
    if refuted:
        if from_urdf:
            masses = "the masses of the URDF"
        else:
            masses = "guessed masses of the links"
        lines.append(
            f"torque limits: with {masses}, gravity alone asks more than the `effort` of "
            f"{', '.join(refuted)} in the URDF; their torque is not limited. Correct `effort` or "
            "the masses; the planner knows no balancer"
        )
    return tuple(lines)


PIECE_SHARES = np.array([0.01, 0.25, 0.5, 0.75, 0.99])
"""Shares of each piece of a trapezoid at which the torque is computed:
near its ends, where it jumps, and between.
"""


def _torque_times(path: Trapezoid) -> FloatArray:
    """Return times at which the torque of a move may be largest [s], also at rest before and after
    it; as many for every move.
    """
    corners = (0.0, path.ramp_s, path.duration_s - path.ramp_s, path.duration_s)
    pieces = [begin + PIECE_SHARES * (end - begin) for begin, end in pairwise(corners)]
    at_rest = np.array([-1.0, path.duration_s + 1.0])
    return np.concatenate([*pieces, at_rest])


#: Scene without bodies: its checker checks nothing but the closures of a robot
EMPTY_SCENE = Scene((), (), (), None, (), 0.0)


def _fast_motion(limits: JointLimits, checker: Checker) -> Motion:
    """Return random moves as fast as the limits allow.

    They are the same every time: which parameters are identifiable must not depend on a plan's
    seed.
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
    position_rad, velocity_rad_s, acceleration_rad_s2 = zip(*parts, strict=True)
    return Motion(
        np.concatenate(position_rad),
        np.concatenate(velocity_rad_s),
        np.concatenate(acceleration_rad_s2),
    )


def _allowed(
    checker: Checker, rng: np.random.Generator, lower: FloatArray, upper: FloatArray, count: int
) -> FloatArray:
    """Return positions of a closed chain that can be reached one after the other,
    shape (count, m).
    """
    found = []
    here = checker.home
    for _ in range(count):
        target = rng.uniform(lower, upper)
        here = towards(checker, here, target, lower, upper)
        found.append(here)
    return np.array(found)


def towards(
    checker: Checker, start: FloatArray, target: FloatArray, lower: FloatArray, upper: FloatArray
) -> FloatArray:
    """Return the farthest position that a closed chain can go to on the way to a target;
    the start where there is none.

    Args:
        checker: of the robot.
        start, target: positions of the axes [rad or m], shape (m,).
        lower, upper: limits of the axes, shape (m,).
    """
    found = farthest_towards(checker, start, target, lower, upper)
    if found is None:
        return start
    return found


@dataclass(frozen=True, slots=True)
class PlannedMove:
    """One synchronised point-to-point move."""

    #: joint positions at its end [rad; m of a prismatic joint], shape (n,)
    target_rad: tuple[float, ...]
    velocity: float  #: share of the joints' velocity limits, above 0 up to 1
    acceleration: float  #: share of the joints' acceleration limits, above 0 up to 1
    dwell_s: float  #: rest after it [s]


def path_of(cell: Cell, start_rad: FloatArray, move: PlannedMove) -> Trapezoid:
    """Return the joint trapezoid of a move from the robot's position."""
    limits = limits_of(cell)
    velocity = limits.velocity * move.velocity
    acceleration = limits.acceleration * move.acceleration
    return synchronised(start_rad, np.array(move.target_rad), velocity, acceleration)


def paths_of(cell: Cell, moves: Sequence[PlannedMove]) -> tuple[Trapezoid, ...]:
    """Return the paths of all moves but the first, whose start is unknown."""
    paths = []
    for before, move in pairwise(moves):
        start_rad = np.array(before.target_rad)
        paths.append(path_of(cell, start_rad, move))
    return tuple(paths)


def experiment_duration_s(cell: Cell, moves: Sequence[PlannedMove]) -> float:
    """Return the time from the first target to the end of the last dwell [s]."""
    motion_s = sum(path.duration_s for path in paths_of(cell, moves))
    dwell_s = sum(move.dwell_s for move in moves)
    return float(motion_s + dwell_s)


#: Least duration of the extra moves of each kind, so that the kinds can be compared
EXTRA_MOVES_S = 5.0
EXTRA_POSTURES = 300  #: Random postures in which extra moves are tried
#: The same for a closed chain, for which each posture takes a way of its own
EXTRA_POSTURES_OF_CHAIN = 20
SWINGS = 3  #: Most postures in which the extra moves of one kind are made
SLOW_SHARE = 0.2  #: Share of the speed limit at which gravity excites more than inertia
STROKES = (1.0, 0.7, 0.4)  #: Shares of the range that are tried until the way is clear


def extra_moves(experiment: Experiment) -> tuple[ExtraMoves, ...]:
    """Return extra moves of each kind, for EXTRA_MOVES_S or a little more, within limits and clear
    of everything; the same every time.

    For every axis: fast with the arm stretched, fast with it folded (as the payload's link is seen
    from that axis), and slow with it stretched; of every two neighbouring axes together; and of all
    axes together.
    """
    cell = experiment.cell
    checker = experiment.scene.checker
    limits = limits_of(cell)
    low, high = limits.targets()
    rng = np.random.default_rng(0)
    if checker.robot.is_constrained:
        sampled = _allowed(checker, rng, low, high, EXTRA_POSTURES_OF_CHAIN)
    else:
        sampled = rng.uniform(low, high, (EXTRA_POSTURES, len(low)))
    clear = sampled[checker.margins(sampled) > 0.0]
    found: list[ExtraMoves] = []
    ends_of = _swing
    if checker.robot.is_constrained:
        ends_of = _swing_of_chain

    def swing(words: str, postures: FloatArray, moved: list[int], speed: float = 1.0) -> None:
        """Add moves there and back in the first few postures in which the way is clear."""
        paths: list[Trapezoid] = []
        for posture in postures:
            ends = ends_of(checker, posture, moved, low, high)
            if ends is not None:
                start, end = ends
                there = synchronised(start, end, limits.velocity * speed, limits.acceleration)
                back = replace(there, start=there.end, end=there.start)
                paths += [there, back]
            if len(paths) >= 2 * SWINGS:
                break
        chosen: list[Trapezoid] = []
        duration_s = 0.0
        for path in cycle(paths):
            chosen.append(path)
            duration_s += path.duration_s
            if duration_s >= EXTRA_MOVES_S:
                break
        if chosen:
            excitation, _ = experiment.excitation(chosen)
            found.append(ExtraMoves(words, duration_s, excitation))

    names = cell.axis_names
    robot = experiment.design.expectation.model.robot
    frames = poses(robot, checker.joints(clear))
    for axis, (name, joint) in enumerate(zip(names, robot.axis_joints, strict=True)):
        lever_m = _lever_of_carrier(robot, frames, joint)
        stretched = clear[np.argsort(-lever_m, kind="stable")]
        folded = clear[np.argsort(lever_m, kind="stable")]
        swing(f"fast moves of {name} with the arm stretched", stretched, [axis])
        swing(f"fast moves of {name} with the arm folded", folded, [axis])
        swing(f"slow moves of {name} with the arm stretched", stretched, [axis], SLOW_SHARE)
        following = axis + 1
        if following < len(names):
            words = f"fast moves of {name} and {names[following]} together"
            swing(words, clear, [axis, following])
    swing("fast moves of all axes", clear, list(range(len(names))))
    return tuple(found)


def _lever_of_carrier(robot: Robot, frames: Poses, joint: int) -> FloatArray:
    """Return the distance of the link with the payload from the axis of a joint [m], shape (k,);
    of a prismatic joint, from the origin of its frame.
    """
    to_carrier_m = frames.origin_m[robot.carrier + 1] - frames.origin_m[joint + 1]
    if robot.joints[joint].kind is JointKind.PRISMATIC:
        return np.asarray(np.linalg.norm(to_carrier_m, axis=1))
    direction = frames.rotation[joint + 1] @ robot.joints[joint].axis
    return np.asarray(np.linalg.norm(np.cross(direction, to_carrier_m), axis=1))


def _swing(
    checker: Checker, posture: FloatArray, moved: list[int], low: FloatArray, high: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Return both ends of the longest clear swing of some axes about the middle of their range;
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
    """Return the same for a closed chain, whose closures bound the swing;
    None where they leave none.
    """
    low_target = posture.copy()
    low_target[moved] = low[moved]
    start = towards(checker, posture, low_target, low, high)
    high_target = posture.copy()
    high_target[moved] = high[moved]
    end = towards(checker, start, high_target, low, high)
    if np.allclose(start, end):
        return None
    return start, end
