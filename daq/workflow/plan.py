"""A plan: point-to-point moves that show every gain, chosen for the experiment that they are made
in (paper §2.3).

The search exchanges moves and judges them by the worst gain's predicted standard deviation
(ident/planning/excitation.py). The information of a plan is the sum over its moves. A changed
target touches two moves, so a proposal costs two small sums and one factorisation; the regressors
of a whole round of proposals are made at once.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from enum import Enum
from itertools import compress, pairwise
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from daq.config.cell import DEGREE, Cell, JointUnit, joint_unit, model_of, robot_of
from daq.config.same_cell import (
    calibrated_robot,
    expected_text,
    found_text,
    robot_differences,
)
from daq.config.yaml_file import DocumentKind, StrictModel, parse_yaml, read_model, read_yaml_bytes
from daq.errors import ConfigurationInconsistent, PlanTooShort, UsageError, counted
from daq.files import replace_file
from daq.workflow.choices import (
    EXCHANGES,
    LARGEST_CONDITION,
    LARGEST_CONDITION_OF_CHAIN,
    LARGEST_STD_PERCENT,
)
from daq.workflow.experiment import (
    PAYLOAD,
    CheckedScene,
    Experiment,
    PlannedMove,
    experiment_duration_s,
    experiment_of,
    limits_of,
    path_of,
    paths_of,
    scene_of,
    towards,
)
from drivers.errors import MotionRefused
from drivers.move import Trapezoid
from ident.arrays import FloatArray
from ident.calibration import CalibratedRobot
from ident.model.robot import Robot
from ident.planning.clear_way import clear_way
from ident.planning.clearance import CLOSURES, WORKSPACE_END, Checker, Obstruction
from ident.planning.effort import EFFORT_MARGIN
from ident.planning.excitation import Design
from ident.planning.gain_verdict import verdicts
from ident.planning.limits import followers_beyond
from ident.plausible import format_at_limit


@dataclass(frozen=True, slots=True)
class Plan:
    """A run's moves."""

    cell: str  #: name of the cell it was made for
    seed: int  #: it was made from
    condition: float  #: of the weighted observation matrix that these moves give
    #: Standard deviation of each gain [% of it] when the moves are made once without load and once
    #: with the cell's payload, as predicted from nominal parameters; empty in plans of earlier
    #: versions.
    predicted_std_percent: tuple[float, ...]
    #: From the first target to the end of the last dwell [s]; how long the way to the first target
    #: takes depends on the robot's position.
    duration_s: float
    moves: tuple[PlannedMove, ...]  #: in order
    units: tuple[JointUnit, ...]  #: in which people read the targets, one a joint
    #: what it was planned for, in words for its page; empty for a first plan, which is for all
    #: gains
    purpose: str = ""
    #: of the robot it was made for; None in plans of earlier versions
    robot: CalibratedRobot | None = None


DWELL_S = 0.1  #: Rest after each move
NEAR = 0.15  #: Standard deviation of a near target, as a share of the joint's range
ROUND = 8  #: Number of proposals whose regressors are made at once
THINNING = 2  #: Every second row is enough to compare proposals by
SHARPNESS = 8.0
"""The search lowers this norm of all gains' deviations, nearly the largest:
the second worst counts a little.
"""
MIN_PLANNED_MOVES = 5  #: Random moves that a run must have room for
WISHED_MOVES = 30  #: With so many, σ is judged by leaving moves out, and the search has a choice
#: Random postures or ways that are tried from one place before it counts as shut in
MAX_TRIES = 100
MAX_RETREATS = 30  #: Moves that a random plan may take back before no way counts as clear
MAX_STARTS = 10  #: Random plans that are begun before the run counts as too short
#: Shares of its speed at which a move is tried that asks too much torque
SLOWER = (1.0, 0.8, 0.6, 0.45, 0.3, 0.2)
PLACES = 3
"""Decimals to which targets in degrees (or mm), velocities and accelerations are rounded,
as in the plan file: what is judged is what the file says.
"""


class Kind(Enum):
    """Kind of a proposal."""

    ANEW = "another target"
    NEAR = "a target moved in some of the axes"
    SWING = "one axis to the other end of its range, the others as they were"
    SPEED = "another speed and acceleration"
    INSERT = "one more move"
    SHIFT = "a move taken out here and put in there"


KINDS = tuple(Kind)
#: Probability of each kind, in the order of KINDS
CHANCES = (0.2, 0.25, 0.2, 0.15, 0.1, 0.1)


@dataclass(frozen=True, slots=True, eq=False)
class Draft:
    """Moves with the ways between them and the information of each way."""

    moves: tuple[PlannedMove, ...]  #: the first only says where the run starts
    paths: tuple[Trapezoid, ...]  #: of moves[1:]
    informations: tuple[FloatArray, ...]  #: of moves[1:]


@dataclass(frozen=True, slots=True, eq=False)
class PlanGoal:
    """Purpose of a plan: σ of each gain relative to its target,
    together with all that was recorded before.
    """

    #: Information of what has been recorded (`ident.planning.target.recorded_information`) with the
    #: design of the experiment, shape (p, p).
    recorded: FloatArray
    #: σ that each gain shall reach [%], inf for one that does not matter, shape (n,)
    target_percent: FloatArray

    @classmethod
    def of_first(cls, design: Design) -> PlanGoal:
        """Return the goal of a first plan:
        nothing was recorded before, and all gains matter alike.
        """
        recorded = np.zeros((design.size, design.size))
        return cls(recorded, np.ones(len(design.expectation.gains)))

    def ratio(self, std_percent: FloatArray) -> FloatArray:
        """Return σ over target of each gain, shape (n,); zero for one that does not matter."""
        ratio = np.zeros(len(std_percent))
        matters = np.isfinite(self.target_percent)
        ratio[matters] = std_percent[matters] / self.target_percent[matters]
        return ratio


@dataclass(frozen=True, slots=True, eq=False)
class TargetBox:
    """Least and largest positions of targets [rad; m of a prismatic joint], shape (n,) each."""

    lower: FloatArray
    upper: FloatArray


class Search:
    """Random moves, and their exchange."""

    def __init__(
        self,
        experiment: Experiment,
        rng: np.random.Generator,
        duration_s: float,
        speed: float,
        acceleration: float,
        largest_condition: float,
        goal: PlanGoal,
        box: TargetBox,
        allowed: TargetBox,
    ) -> None:
        self._experiment = experiment
        self._cell = experiment.cell
        self._rng = rng
        self._duration_s = duration_s
        self._speed = speed
        self._acceleration = acceleration
        self._largest_condition = largest_condition
        self._goal = goal
        self._low = box.lower
        self._high = box.upper
        self._allowed = allowed
        self._obstructed = 0  #: ways that were refused because something is in the way
        self._too_heavy = 0  #: ways that were refused because the drives cannot carry them

    def random_moves(self) -> Draft:
        """Clear random moves that fill the duration.

        Raises:
            PlanTooShort: it has no room for five moves.
            UsageError: no clear way is found.
        """
        longest: list[PlannedMove] = []
        for _ in range(MAX_STARTS):
            moves, paths = self._random_sequence()
            if len(moves) >= MIN_PLANNED_MOVES:
                informations = self._experiment.informations(paths, THINNING)
                return Draft(tuple(moves), tuple(paths), tuple(informations))
            longest = max(longest, moves, key=len)
        found = f"room for {len(longest)} moves"
        if len(longest) == 1:  # which only says where the run starts
            found = "no room for a move"
        times_as_long = WISHED_MOVES / max(len(longest), 1)
        longer_s = _up_to_tens(self._duration_s * times_as_long)
        expected = f"at least {MIN_PLANNED_MOVES}, better {WISHED_MOVES}"
        remedy = f"allow a longer run (some --duration {longer_s:.0f})"
        raise _unfit(self._cell, self._duration_s, found, expected, remedy, PlanTooShort)

    def _random_sequence(self) -> tuple[list[PlannedMove], list[Trapezoid]]:
        """Return clear random moves, one after the other, until the duration is full,
        and the ways between them.

        Raises:
            UsageError: no clear way is found.
        """
        moves = [self._clear_start()]
        paths: list[Trapezoid] = []
        left_s = self._duration_s - DWELL_S
        retreats = 0
        while True:
            here = np.array(moves[-1].target_rad)
            move = self._clear_move(here)
            if move is None:
                # A corner that the random targets before it led into: take the last move back.
                retreats += 1
                if retreats > MAX_RETREATS:
                    raise self._blocked("way")
                if paths:
                    left_s += paths.pop().duration_s + moves.pop().dwell_s
                else:
                    moves = [self._clear_start()]
                continue
            path = path_of(self._cell, here, move)
            left_s -= path.duration_s + move.dwell_s
            if left_s < 0.0:
                return moves, paths
            moves.append(move)
            paths.append(path)

    def improve(
        self, draft: Draft, tries: int, progress: Callable[[int, FloatArray], None]
    ) -> Draft:
        """Exchange moves; an exchange stays when it lowers the deviations and the run gets no
        longer than allowed.

        Args:
            draft: the moves to begin with.
            tries: number of proposals.
            progress: receives the number of proposals so far, and σ of each gain [%], shape (n,).

        Returns:
            The best moves that were found.
        """
        best_cost, best_std_percent = self._judge(draft, np.inf)
        done = 0
        while done < tries:
            count = min(ROUND, tries - done)
            # One exchange a round: proposals that were made from the same moves do not go together.
            best_draft = draft
            proposals = [self._proposal(draft.moves) for _ in range(count)]
            for candidate in self._drafts(draft, proposals):
                cost, std_percent = self._judge(candidate, best_cost)
                if cost < best_cost:
                    best_draft = candidate
                    best_cost = cost
                    best_std_percent = std_percent
            draft = best_draft
            done += count
            progress(done, best_std_percent)
        return draft

    def _judge(self, draft: Draft, to_beat: float) -> tuple[float, FloatArray]:
        """Return the cost of a draft, which the search lowers, and σ of each gain [%], shape (n,).

        The cost is nearly the largest σ over target, raised where W is too badly conditioned.

        Args:
            draft: the moves.
            to_beat: cost from which on the condition does not matter, and is not computed.
        """
        information = self._goal.recorded + np.sum(draft.informations, axis=0)
        std_percent = self._experiment.design.std_percent(information)
        # Unseen gains are as bad as each other; the norm of inf would hide the rest.
        ratios = np.minimum(self._goal.ratio(std_percent), 1e6)
        worst = np.max(ratios)
        # (Σ rᵖ)^(1/p), scaled by the worst so that nothing overflows
        total = np.sum((ratios / worst) ** SHARPNESS)
        cost = float(worst * total ** (1.0 / SHARPNESS))
        if cost < to_beat:  # the condition can only raise it
            condition = self._experiment.design.condition(information)
            excess = max(1.0, condition / self._largest_condition)
            cost *= excess**2
        return cost, std_percent

    def _proposal(self, moves: tuple[PlannedMove, ...]) -> tuple[PlannedMove, ...]:
        """Return moves with one random change.

        The same seed gives the same plan: the random numbers are drawn in this order, and the move
        is drawn for every kind, although not all of them need it.
        """
        rng = self._rng
        kind = KINDS[int(rng.choice(len(KINDS), p=CHANCES))]
        index, other_index = (int(number) for number in rng.integers(len(moves), size=2))
        random_move = self._random_move()
        before = moves[:index]
        old = moves[index]
        after = moves[index + 1 :]
        match kind:
            case Kind.ANEW:
                return (*before, random_move, *after)
            case Kind.NEAR:
                near_target = self._near_target(np.array(old.target_rad))
                return (*before, replace(old, target_rad=near_target), *after)
            case Kind.SWING:
                previous = moves[max(index - 1, 0)]
                far_target = self._swung_target(old, previous)
                return (*before, replace(old, target_rad=far_target), *after)
            case Kind.SPEED:
                other_speed = replace(
                    old, velocity=random_move.velocity, acceleration=random_move.acceleration
                )
                return (*before, other_speed, *after)
            case Kind.INSERT:
                return (*before, random_move, old, *after)
            case Kind.SHIFT:
                others = (*before, *after)
                return (*others[:other_index], old, *others[other_index:])

    def _near_target(self, target: FloatArray) -> tuple[float, ...]:
        """Return a target that is moved by a random step in about half of the axes."""
        step = self._rng.normal(0.0, NEAR, len(target)) * (self._high - self._low)
        is_moved = self._rng.random(len(target)) < 0.5
        near = target + step * is_moved
        return self._rounded_target(np.clip(near, self._low, self._high))

    def _swung_target(self, move: PlannedMove, previous: PlannedMove) -> tuple[float, ...]:
        """Return the target of a move with one axis at the end of its range that is farther from
        where the previous move leaves it, or within a quarter of the range of that end.
        """
        target = np.array(move.target_rad)
        axis = int(self._rng.integers(len(target)))
        low = self._low[axis]
        high = self._high[axis]
        inwards = 0.25 * float(self._rng.random()) * (high - low)
        middle = 0.5 * (low + high)
        if previous.target_rad[axis] < middle:
            target[axis] = high - inwards
        else:
            target[axis] = low + inwards
        return self._rounded_target(target)

    def _drafts(self, draft: Draft, proposals: Sequence[tuple[PlannedMove, ...]]) -> list[Draft]:
        """Return the proposals that are short enough and whose new ways are clear and not too
        heavy, with their information.

        Args:
            draft: the moves that the proposals were made from; most ways are theirs.
            proposals: moves, in the order in which the drafts are returned.
        """
        known: dict[_Way, tuple[Trapezoid, FloatArray]] = {}
        pairs = pairwise(draft.moves)
        for pair, path, information in zip(pairs, draft.paths, draft.informations, strict=True):
            known[_way(pair)] = (path, information)
        clear: dict[_Way, Trapezoid] = {}  # new ways of all proposals
        candidates: list[tuple[tuple[PlannedMove, ...], list[_Way]]] = []
        for moves in proposals:
            ways = [_way(pair) for pair in pairwise(moves)]
            new: dict[_Way, Trapezoid] = {}  # those of this proposal
            moving_s = []
            for way in ways:
                if way in known:
                    path, _ = known[way]
                else:
                    start, move = way
                    path = path_of(self._cell, np.array(start), move)
                    new[way] = path
                moving_s.append(path.duration_s)
            dwell_s = sum(move.dwell_s for move in moves)
            # The time is quick to check, the clearance is not.
            if sum(moving_s) + dwell_s > self._duration_s:
                continue
            if not all(map(self._is_within, moves)):
                continue
            unchecked = [path for way, path in new.items() if way not in clear]
            if all(map(self._is_clear, unchecked)):
                candidates.append((moves, ways))
                clear |= new
        # Torques and regressors of all new ways at once: that is much faster than one by one.
        is_carried = self._is_carried(list(clear.values()))
        new_paths = {way: clear[way] for way in compress(clear, is_carried)}
        informations = self._experiment.informations(list(new_paths.values()), THINNING)
        for (way, path), information in zip(new_paths.items(), informations, strict=True):
            known[way] = (path, information)
        drafts = []
        for moves, ways in candidates:
            if all(way in known for way in ways):
                paths, informations_of_ways = zip(*[known[way] for way in ways], strict=True)
                drafts.append(Draft(moves, paths, informations_of_ways))
        return drafts

    def _is_clear(self, path: Trapezoid) -> bool:
        """Whether nothing is in the way, and the loops of a closed chain close on it."""
        checker = self._experiment.scene.checker
        return checker.obstruction(path.start, path.end) is None

    def _clear_start(self) -> PlannedMove:
        """Return a random move to a clear posture.

        Raises:
            UsageError: none is found.
        """
        for _ in range(MAX_TRIES):
            move = self._random_move()
            checker = self._experiment.scene.checker
            if checker.robot.is_constrained:
                target = np.array(move.target_rad)
                near = towards(checker, checker.home, target, self._low, self._high)
                move = replace(move, target_rad=self._rounded_target(near))
            if not self._is_within(move):
                continue
            posture = np.array([move.target_rad])
            margin_m = checker.margins(posture)[0]
            if margin_m > 0.0:
                return move
        raise self._blocked("posture")

    def _clear_move(self, start: FloatArray) -> PlannedMove | None:
        """Return a random move on a clear way that the drives can carry;
        None where none is found.
        """
        for _ in range(MAX_TRIES):
            move = self._random_move()
            checker = self._experiment.scene.checker
            target = np.array(move.target_rad)
            if checker.robot.is_constrained:
                # A way to a far target often leaves the workspace.
                target = towards(checker, start, target, self._low, self._high)
                move = replace(move, target_rad=self._rounded_target(target))
            if np.array_equal(target, start) or not self._is_within(move):
                continue
            if checker.obstruction(start, np.array(move.target_rad)) is not None:
                self._obstructed += 1
                continue
            carried = self._slow_enough(start, move)
            if carried is not None:
                return carried
            self._too_heavy += 1
        return None

    def _slow_enough(self, start: FloatArray, move: PlannedMove) -> PlannedMove | None:
        """Return the move as fast as the drives can carry it;
        None where they cannot even slowly.
        """
        for share in SLOWER:
            slower = _slower(move, share)
            path = path_of(self._cell, start, slower)
            if all(self._is_carried([path])):
                return slower
        return None

    def _is_carried(self, paths: Sequence[Trapezoid]) -> list[bool]:
        """Whether the drives can give the torque of each way,
        with a margin for what is not known of it.
        """
        shares = self._experiment.effort_shares(paths)
        is_carried = np.all(EFFORT_MARGIN * shares <= 1.0, axis=1)
        return list(map(bool, is_carried))

    def _random_move(self) -> PlannedMove:
        """Return a move to a random target, slow or fast: friction is distinguished from inertia by
        moves of different speed and acceleration.
        """
        target = self._rounded_target(self._rng.uniform(self._low, self._high))
        velocity = self._speed * float(self._rng.uniform(0.35, 1.0))
        acceleration = self._acceleration * float(self._rng.uniform(0.4, 1.0))
        return PlannedMove(
            target_rad=target,
            velocity=round(velocity, PLACES),
            acceleration=round(acceleration, PLACES),
            dwell_s=DWELL_S,
        )

    def _is_within(self, move: PlannedMove) -> bool:
        """Whether a target is allowed; the motors of a redundant drive were moved to fit each
        other.
        """
        target = np.array(move.target_rad)
        is_above_lower = target >= self._allowed.lower
        is_below_upper = target <= self._allowed.upper
        return bool(np.all(is_above_lower & is_below_upper))

    def _rounded_target(self, target: FloatArray) -> tuple[float, ...]:
        """Return a target as the plan file will say it: what is judged is what is made."""
        fitting = self._experiment.scene.checker.fitting(target)
        rounded = []
        for position, axis in zip(fitting.tolist(), self._cell.axes, strict=True):
            si = axis.unit.si
            rounded.append(round(position / si, PLACES) * si)
        return tuple(rounded)

    def _blocked(self, what: str) -> UsageError:
        """Return the error that names the two bodies which are in the way most often,
        or the axes that are too weak.
        """
        found = f"no clear {what} among hundreds of random ones"
        scene = self._experiment.scene
        checker = scene.checker
        blocking: list[Obstruction] = []
        for _ in range(MAX_TRIES):
            target = np.array(self._random_move().target_rad)
            obstruction = checker.obstruction(target, target)
            if obstruction is not None:
                blocking.append(obstruction)
        if self._too_heavy > self._obstructed:
            axes = " and ".join(self._too_weak()) or "some axis"
            found += f": also slowly, they ask too much torque of {axes}"
            expected = f"at most the `effort` of the URDF over {EFFORT_MARGIN:g}"
            remedy = (
                "correct `effort` in the URDF, declare a lighter payload, or narrow the "
                "joint limits"
            )
            return _unfit(self._cell, self._duration_s, found, expected, remedy)
        if not blocking:
            return _unfit(
                self._cell, self._duration_s, found, "room to move in", "widen the joint limits"
            )
        counts = Counter((obstruction.first, obstruction.second) for obstruction in blocking)
        pair, times = counts.most_common(1)[0]
        first, second = pair
        if first == CLOSURES:
            remedy = f"correct {_keys(blocking[0])} in the cell file"
            return _unfit(self._cell, self._duration_s, found, "poses that the loops allow", remedy)
        distances_m = []
        for obstruction in blocking:
            if (obstruction.first, obstruction.second) == pair:
                distances_m.append(obstruction.distance_m)
        farthest_mm = 1000.0 * max(distances_m)
        found += (
            f": in {times} of {MAX_TRIES} {first} and {second} are at most "
            f"{farthest_mm:.0f} mm apart"
        )
        minimum_mm = 1000.0 * checker.scene.minimum_m
        expected = f"at least {minimum_mm:.0f} mm"
        return _unfit(self._cell, self._duration_s, found, expected, _room_remedy(scene, pair))

    def _too_weak(self) -> list[str]:
        """Return the names of the axes whose drives cannot carry most of some slow random ways;
        if there is none, of those that cannot carry the most of them.
        """
        paths: list[Trapezoid] = []
        start = np.array(self._random_move().target_rad)
        for _ in range(MAX_TRIES):
            move = _slower(self._random_move(), SLOWER[-1])
            paths.append(path_of(self._cell, start, move))
            start = np.array(move.target_rad)
        is_heavy = EFFORT_MARGIN * self._experiment.effort_shares(paths) > 1.0
        share_heavy = np.mean(is_heavy, axis=0)
        # Just below the largest share, so that the axis with it is named.
        largest_share = float(np.max(share_heavy))
        limit = min(0.5, 0.99 * largest_share)
        return list(compress(self._cell.axis_names, share_heavy > limit))


def _room_remedy(scene: CheckedScene, pair: tuple[str, str]) -> str:
    """Say how two bodies get room, by what the cell file declares of them."""
    boxes = {box.name for box in scene.checker.scene.boxes}
    if pair[1] == WORKSPACE_END:
        return "correct `workspace` in the cell file, or the joint limits"
    if pair[1] in boxes:
        return f"correct `{pair[1]}` of `clearance.obstacles` in the cell file, or the joint limits"
    if scene.guessed:
        return "the shape of the arm is guessed: declare it in the cell file (`clearance.capsules`)"
    if scene.payload_link is not None and PAYLOAD in pair:
        return (
            "the shape of the payload is guessed: declare a capsule on link "
            f"{scene.payload_link} in the cell file (`clearance.capsules`)"
        )
    return (
        "correct these `clearance.capsules` or `clearance.minimum_m` in the cell file, or the "
        "joint limits"
    )


def _up_to_tens(seconds: float) -> float:
    """Round a duration up to tens of seconds, as a person would give it."""
    return 10.0 * math.ceil(seconds / 10.0)


def longer_run_s(used_s: float, requested_s: float, ratio: float) -> float | None:
    """Return the duration of a run in which σ is smaller by a ratio [s];
    None where it is longer than a plan may be.

    σ falls with the square root of the time.

    Args:
        used_s: duration of the moves that were found [s].
        requested_s: duration that they had room for [s]; the longer run is longer than that.
        ratio: σ that the moves give over σ that is wanted, above 1.
    """
    needed_s = _up_to_tens(used_s * ratio**2)
    if needed_s <= requested_s:
        needed_s = _up_to_tens(requested_s + 1.0)
    return needed_s if needed_s <= LONGEST_S else None


def _unfit(
    cell: Cell,
    duration_s: float,
    found: str,
    expected: str,
    remedy: str,
    kind: type[UsageError] = UsageError,
) -> UsageError:
    """Return the error for a plan that cannot be made."""
    subject = f"plan of {duration_s:g} s for cell {cell.name!r}"
    return kind(subject, found=found, expected=expected, remedy=remedy)


_Way = tuple[tuple[float, ...], PlannedMove]
"""Where a way starts, and the move that it makes."""


def _way(pair: tuple[PlannedMove, PlannedMove]) -> _Way:
    """Return the way from the target of one move to that of the next."""
    previous, move = pair
    return previous.target_rad, move


def plan(
    cell: Cell,
    *,
    seed: int,
    duration_s: float = 40.0,
    exchanges: int = EXCHANGES,
    speed: float = 1.0,
    acceleration: float | None = None,
    largest_condition: float | None = None,
    largest_std_percent: float = LARGEST_STD_PERCENT,
    experiment: Experiment | None = None,
    goal: PlanGoal | None = None,
    box: TargetBox | None = None,
    progress: Callable[[int, float], None] = lambda _done, _worst: None,
) -> Plan:
    """Choose moves that let the worst gain be known as well as the time allows.

    Random moves fill the duration; then they are exchanged, shifted, stretched and sped up one at a
    time, and what lowers the predicted standard deviation of the worst gain stays. All moves keep
    position, velocity and acceleration limits, the workspace and clear of the arm itself, on their
    whole way, and the torque limits of the URDF with a margin. The way to the first target is not
    known before the recording: see `way_to_first_target`.

    Args:
        cell: with robot, limits and a weighed payload.
        seed: the same seed gives the same plan.
        duration_s: of the run [s].
        exchanges: tries; every one of them is made. With 0 the random moves are the plan.
        speed: share of the limits of velocity that the fastest moves may use.
        acceleration: share of the limits of acceleration that the hardest moves may use; ``speed``
            when None.
        largest_condition: a plan worse than this is refused; that of the kind of robot when None.
        largest_std_percent: a plan that predicts more than this for a gain is refused.
        experiment: that the plan is for, None for the one with the cell's first payload. After a
            fit, its design may be that of `daq.workflow.verdicts.design_after`; ``mounted`` says
            what the moves are made with.
        goal: target σ of each gain, and what has been recorded before; None for a first plan. With
            a goal, the worst gain is that with the largest σ over target, and the plan's deviations
            are those of all recordings together.
        box: joint positions between which the targets stay, inside the limits; None for all that
            the limits allow.
        progress: receives the number of tries and the deviation predicted for the worst gain so far
            [%].

    Raises:
        PlanTooShort: a longer plan would show every gain, or have room for enough moves.
        UsageError: no plan shows every gain, or there is no clear way.
        ConfigurationInconsistent: the cell declares no payload, or a joint that follows an axis
            would go beyond its own limits.
    """
    experiment = experiment or experiment_of(cell)
    if largest_condition is None:
        if cell.chain is None:
            largest_condition = LARGEST_CONDITION
        else:
            largest_condition = LARGEST_CONDITION_OF_CHAIN
    goal = goal or PlanGoal.of_first(experiment.design)
    targets = _targets(cell, duration_s, box)
    allowed = _allowed_targets(cell, box)
    _require_followers(cell, allowed)
    if acceleration is None:
        acceleration = speed
    search = Search(
        experiment,
        np.random.default_rng(seed),
        duration_s,
        speed,
        acceleration,
        largest_condition,
        goal,
        targets,
        allowed,
    )

    def report_worst(done: int, std_percent: FloatArray) -> None:
        progress(done, float(np.max(std_percent)))

    draft = search.improve(search.random_moves(), exchanges, report_worst)
    # With all rows: the search compares by every second one.
    information_of_moves = np.sum(experiment.informations(draft.paths), axis=0)
    information = goal.recorded + information_of_moves
    predicted = experiment.design.std_percent(information)
    condition = experiment.design.condition(information)
    # `not … <=`: a number that is NaN is refused as well.
    if not condition <= largest_condition:
        raise _badly_conditioned(
            cell, experiment, duration_s, condition, largest_condition, exchanges
        )
    used_s = experiment_duration_s(cell, draft.moves)
    worst = int(np.argmax(goal.ratio(predicted)))
    if not predicted[worst] <= largest_std_percent:
        excitation, _ = experiment.excitation(draft.paths)
        judged = verdicts(experiment.design, [(excitation, experiment.mounted)])
        std_percent = format_at_limit(float(predicted[worst]), largest_std_percent, 1)
        longer_s = None
        if np.isfinite(predicted[worst]):
            excess = float(predicted[worst]) / largest_std_percent
            longer_s = longer_run_s(used_s, duration_s, excess)
        kind = UsageError
        remedy = "allow more exchanges, wider joint limits or higher speed"
        if longer_s is not None:
            kind = PlanTooShort
            remedy = f"allow a longer run (some --duration {longer_s:.0f}); or {remedy}"
        raise _unfit(
            cell,
            duration_s,
            found=f"{std_percent} % predicted for the gain of {cell.axes[worst].name}",
            expected=f"at most {largest_std_percent:g} %",
            remedy=". ".join((remedy, *judged.sentences(cell.axis_names))),
            kind=kind,
        )
    return Plan(
        cell=cell.name,
        seed=seed,
        condition=condition,
        predicted_std_percent=tuple(predicted.tolist()),
        duration_s=used_s,
        moves=draft.moves,
        units=tuple(axis.unit for axis in cell.axes),
        robot=calibrated_robot(cell),
    )


def _badly_conditioned(
    cell: Cell,
    experiment: Experiment,
    duration_s: float,
    condition: float,
    largest: float,
    exchanges: int,
) -> UsageError:
    """Return the error for a plan whose observation matrix is too badly conditioned."""
    condition_text = format_at_limit(condition, largest, 0)
    ratio = condition / largest
    kind = PlanTooShort if _is_mended_by_time(duration_s, ratio) else UsageError
    return _unfit(
        cell,
        duration_s,
        found=f"condition {condition_text} of the weighted observation matrix after {exchanges} "
        "exchanges",
        expected=f"at most {largest:.0f}",
        remedy=_condition_remedy(experiment, duration_s, ratio),
        kind=kind,
    )


#: Ratio of two conditions that more moves make; a larger one is of the robot
MADE_BY_MORE_MOVES = 10.0


def _is_mended_by_time(duration_s: float, ratio: float) -> bool:
    """Whether a run of twice the duration may lower a condition that is too large by a ratio."""
    if ratio > MADE_BY_MORE_MOVES:
        return False
    return _up_to_tens(2.0 * duration_s) <= LONGEST_S


def _condition_remedy(experiment: Experiment, duration_s: float, ratio: float) -> str:
    """Say what lowers a condition that is too large by a ratio:
    more moves, or right angles that are right.
    """
    other = "more exchanges, wider joint limits or higher speed; `--condition` accepts more"
    if _is_mended_by_time(duration_s, ratio):
        longer_s = _up_to_tens(2.0 * duration_s)
        return f"allow a longer run (some --duration {longer_s:.0f}), {other}"
    joints = nearly_right_joints(experiment.design.expectation.model.robot)
    if not joints:
        return f"allow {other}"
    exact = "1.5707963267948966 for a quarter turn, 3.141592653589793 for a half"
    listed = ", ".join(joints)
    return (
        f"the URDF turns {listed} by nearly a right angle, as rounded numbers do "
        f"(1.5708): parameters that an exact angle hides are nearly invisible then. Write {exact}. "
        "If these angles are measured ones, `--condition` accepts more"
    )


NEARLY_RIGHT = 2e-3
"""Largest difference between the entries of a joint's rotation and those of right angles that
rounding makes: 3.14 for a half turn is off by 1.6e-3.
"""
EXACTLY_RIGHT = 1e-9  #: Difference that a double leaves


def nearly_right_joints(robot: Robot) -> tuple[str, ...]:
    """Return the names of the joints that the URDF turns by nearly, but not exactly, right angles;
    axes are looked at, too.
    """
    found = []
    for joint in robot.joints:
        entries = np.concatenate((joint.rotation.ravel(), joint.axis))
        # Rotations by right angles have entries of 0, 1 and -1 alone.
        largest_difference = np.abs(entries - np.round(entries)).max()
        if EXACTLY_RIGHT < largest_difference < NEARLY_RIGHT:
            found.append(joint.name)
    return tuple(found)


def _targets(cell: Cell, duration_s: float, box: TargetBox | None) -> TargetBox:
    """Return between which positions targets are drawn: those of the joint limits, and inside a
    box.

    Raises:
        UsageError: the box is outside the limits.
    """
    lower, upper = limits_of(cell).targets()
    if box is None:
        return TargetBox(lower, upper)
    targets = TargetBox(np.maximum(lower, box.lower), np.minimum(upper, box.upper))
    outside = list(compress(cell.axis_names, targets.lower > targets.upper))
    if outside:
        listed = ", ".join(outside)
        found = f"a box of targets outside the joint limits of {listed}"
        raise _unfit(
            cell, duration_s, found, "a box inside the limits", "give a box that they allow"
        )
    return targets


def _allowed_targets(cell: Cell, box: TargetBox | None) -> TargetBox:
    """Return where targets may be: within the joint limits,
    and within a box but for the rounding of a plan file.
    """
    limits = limits_of(cell)
    if box is None:
        return TargetBox(limits.lower, limits.upper)
    units = np.array([axis.unit.si for axis in cell.axes])
    rounding = units * 10.0**-PLACES
    lower = np.maximum(limits.lower, box.lower - rounding)
    upper = np.minimum(limits.upper, box.upper + rounding)
    return TargetBox(lower, upper)


def _require_followers(cell: Cell, targets: TargetBox) -> None:
    """Refuse targets between which a joint that follows an axis goes beyond its own limits.

    Raises:
        ConfigurationInconsistent: for the first such joint.
    """
    for beyond in followers_beyond(robot_of(cell), targets.lower, targets.upper):
        axis = cell.axes[beyond.axis]
        joint = beyond.joint
        unit = joint_unit(joint.kind)
        allowed = _interval(axis.unit, beyond.axis_range)
        raise ConfigurationInconsistent(
            f"cell {cell.name}, limits of {axis.name}",
            found=f"joint {joint.name}, which follows it, from {_interval(unit, beyond.reached)}",
            expected=f"{_interval(unit, beyond.allowed)}, its limits in the URDF",
            remedy=f"give {axis.name} `limits` within {allowed}, or correct <limit> or <mimic> of "
            f"{joint.name} in the URDF",
        )


def _interval(unit: JointUnit, ends: tuple[float, float]) -> str:
    """Format two positions that are given in SI: `-20 deg to 35.5 deg`."""
    first, last = ends
    return f"{unit.spell(first)} to {unit.spell(last)}"


def slowed(cell: Cell, plan_: Plan, override: float) -> Plan:
    """Return the same ways at a share of their speed, as for a first run;
    the predictions are those of the plan as made.
    """
    moves = []
    for move in plan_.moves:
        velocity = move.velocity * override
        acceleration = move.acceleration * override**2
        moves.append(replace(move, velocity=velocity, acceleration=acceleration))
    duration_s = experiment_duration_s(cell, moves)
    return replace(plan_, duration_s=duration_s, moves=tuple(moves))


def _slower(move: PlannedMove, share: float) -> PlannedMove:
    """Return the same way at a share of its speed, as the plan file will say it,
    and no slower than one may say.
    """
    velocity = round(move.velocity * share, PLACES)
    acceleration = round(move.acceleration * share**2, PLACES)
    return replace(
        move,
        velocity=max(velocity, LEAST_VELOCITY),
        acceleration=max(acceleration, LEAST_ACCELERATION),
    )


# The file of a plan: moves that a person can read, change and approve before anything moves

LONGEST_S = 3600.0
LEAST_VELOCITY = 0.01  #: Share of the limits; slower than that a move would hardly end
#: A hundredth of the speed on the same ways is a ten-thousandth of the acceleration
LEAST_ACCELERATION = 0.0001
Velocity = Annotated[float, Field(ge=LEAST_VELOCITY, le=1)]
Acceleration = Annotated[float, Field(ge=LEAST_ACCELERATION, le=1)]


class _Move(StrictModel):
    """A move in a plan file."""

    target_deg: tuple[float, ...] | None = None
    target: tuple[float, ...] | None = None
    velocity: Velocity
    acceleration: Acceleration
    dwell_s: Annotated[float, Field(ge=0, le=60)] = 0.0

    @model_validator(mode="after")
    def _one_target(self) -> _Move:
        if (self.target_deg is None) == (self.target is None):
            raise ValueError("target_deg, or target where some axes are in mm")
        return self


class PlanFile(StrictModel):
    """The content of a plan file."""

    document_kind: ClassVar[DocumentKind | None] = DocumentKind.PLAN

    format: Literal["drivegain-plan"]
    cell: str
    seed: int
    condition: Annotated[float, Field(gt=0)]
    # Plans of earlier versions have none.
    predicted_std_percent: tuple[Annotated[float, Field(gt=0)], ...] = ()
    purpose: str = ""
    robot: CalibratedRobot | None = None
    moves: Annotated[tuple[_Move, ...], Field(min_length=1, max_length=10_000)]


def read_plan(path: Path) -> PlanFile:
    """Read what a plan file says, whatever cell it is for.

    Raises:
        ConfigurationError: the file is missing, or is no plan.
    """
    return read_model(parse_yaml(read_yaml_bytes(path), str(path)), PlanFile)


def save_plan(plan: Plan, path: Path) -> None:
    """Write a plan; a file of that name is replaced whole.

    Raises:
        OSError: from the file system.
    """
    target_key = _target_key(plan.units)
    predicted = ", ".join(f"{value:.3f}" for value in plan.predicted_std_percent)
    predicted_for = "moves made without load and with the payload"
    if plan.purpose:
        predicted_for = "all blocks of the session and these moves together"
    units = ", ".join(unit.name for unit in plan.units)
    lines = [
        "# Synchronised point-to-point moves; velocity and acceleration are shares of the "
        "joint limits.",
        f"# Targets: {units}.",
        "format: drivegain-plan",
        f"cell: {plan.cell}",
        f"seed: {plan.seed}",
        f"condition: {plan.condition:.1f}    # of the weighted observation matrix",
        f"predicted_std_percent: [{predicted}]    # of each gain, {predicted_for}",
    ]
    if plan.purpose:
        lines.append(f"purpose: {json.dumps(plan.purpose)}")  # a string of JSON is one of YAML
    if plan.robot is not None:
        lines += _robot_lines(plan.robot)
    lines.append("moves:")
    for move in plan.moves:
        positions = []
        for position, unit in zip(move.target_rad, plan.units, strict=True):
            positions.append(f"{position / unit.si:.3f}")
        target = ", ".join(positions)
        fields = [
            f"{target_key}: [{target}]",
            f"velocity: {move.velocity:.3f}",
            f"acceleration: {move.acceleration:.4f}",
            f"dwell_s: {move.dwell_s:.3f}",
        ]
        written = ", ".join(fields)
        lines.append(f"  - {{{written}}}")
    replace_file(path, ("\n".join(lines) + "\n").encode())


def _robot_lines(robot: CalibratedRobot) -> list[str]:
    """Return the lines of a plan file that say which robot it is for."""
    lines = [
        "robot:    # a plan is for one robot",
        f"  kinematics_sha256: {robot.kinematics_sha256}",
        f"  drives_sha256: {robot.drives_sha256}",
    ]
    # An object of JSON is one of YAML.
    if robot.joints:
        lines.append("  joints:")
        for joint in robot.joints:
            lines.append(f"    - {json.dumps(asdict(joint))}")
    if robot.drives:
        lines.append("  drives:")
        for drive in robot.drives:
            lines.append(f"    - {json.dumps(asdict(drive))}")
    if robot.motors:
        lines.append(f"  motors: {json.dumps(robot.motors)}")
    return lines


def load_plan(path: Path, cell: Cell) -> Plan:
    """Read a plan for a cell; one that was changed by hand keeps limits, duration and room, too.

    What its moves show, and the torque that they ask for, are not judged again.

    Raises:
        ConfigurationError: the file is missing, is not what its schema says, a target lies outside
            the joint limits or those of a joint that follows an axis, the plan takes longer than
            an hour, a way leaves the declared workspace or clearance, or the plan was made for
            another robot with the same cell name.
    """
    model = read_plan(path)
    if model.cell != cell.name:
        remedy = "make a plan for this cell: `drivegain plan CELL`"
        found = f"a plan for cell {model.cell!r}"
        raise _refused(str(path), found, f"one for {cell.name!r}", remedy)
    _require_robot(path, model.robot, cell)
    if len(model.predicted_std_percent) not in (0, len(cell.axes)):
        found = f"{len(model.predicted_std_percent)} numbers"
        remedy = "make the plan anew: `drivegain plan CELL`"
        expected = f"{len(cell.axes)}, one a gain"
        raise _refused(f"{path}: predicted_std_percent", found, expected, remedy)
    moves = tuple(
        _planned_move(path, cell, number, move) for number, move in enumerate(model.moves)
    )
    _check_followers(path, cell, moves)
    duration_s = experiment_duration_s(cell, moves)
    if duration_s > LONGEST_S:
        found = f"{duration_s:.0f} s of moves and dwells"
        remedy = "leave moves out, or raise velocity and acceleration"
        raise _refused(f"{path}: moves", found, f"at most {LONGEST_S:.0f} s", remedy)
    _check_room(path, cell, moves)
    return Plan(
        cell=model.cell,
        seed=model.seed,
        condition=model.condition,
        predicted_std_percent=model.predicted_std_percent,
        duration_s=duration_s,
        moves=moves,
        units=tuple(axis.unit for axis in cell.axes),
        purpose=model.purpose,
        robot=model.robot,
    )


def _require_robot(path: Path, robot: CalibratedRobot | None, cell: Cell) -> None:
    """Refuse a plan of another robot; one of an earlier version may not say whose it is."""
    if robot is None:
        return
    differences = robot_differences(robot, calibrated_robot(cell))
    if differences:
        raise _refused(
            f"{path}: robot",
            f"a plan for another robot with the same cell name {cell.name!r}: "
            f"{found_text(differences)}",
            f"{expected_text(differences)}, as in the cell file",
            "give the cell file that the plan was made with, or make a plan for this cell: "
            "`drivegain plan CELL`",
        )


def _target_key(units: tuple[JointUnit, ...]) -> str:
    """Return the key of a target in a plan file: `target_deg` if every joint is in degrees."""
    if all(unit == DEGREE for unit in units):
        return "target_deg"
    return "target"


def _refused(
    where: str, found: str, expected: str, remedy: str = "correct the move"
) -> ConfigurationInconsistent:
    """Return the error for a plan file that does not fit its cell."""
    return ConfigurationInconsistent(where, found=found, expected=expected, remedy=remedy)


def _planned_move(path: Path, cell: Cell, number: int, move: _Move) -> PlannedMove:
    """Convert a move of a plan file to SI.

    Args:
        path: the file, for messages.
        cell: with the units and the limits of the joints.
        number: of the move in the file, from 0.
        move: as the file has it.

    Raises:
        ConfigurationInconsistent: the target has another unit, other joints, or is outside the
            limits.
    """
    key = "target_deg" if move.target is None else "target"
    values = move.target_deg or move.target or ()
    where = f"{path}: moves[{number}].{key}"
    expected_key = _target_key(tuple(axis.unit for axis in cell.axes))
    if key != expected_key:
        units = ", ".join(f"{axis.name} {axis.unit.name}" for axis in cell.axes)
        raise _refused(where, key, f"{expected_key} ({units})")
    if len(values) != len(cell.axes):
        raise _refused(where, f"{len(values)} positions", f"{len(cell.axes)}, one a joint")
    target = tuple(value * axis.unit.si for value, axis in zip(values, cell.axes, strict=True))
    for axis, position in zip(cell.axes, target, strict=True):
        lower, upper = axis.limits.position
        if not lower <= position <= upper:
            spell = axis.unit.spell
            expected = f"{spell(lower)} to {spell(upper)}, the joint's limits"
            remedy = "correct the move, or the limits if they are wrong"
            raise _refused(f"{where}, {axis.name}", spell(position), expected, remedy)
    return PlannedMove(target, move.velocity, move.acceleration, move.dwell_s)


def _check_followers(path: Path, cell: Cell, moves: tuple[PlannedMove, ...]) -> None:
    """Refuse targets at which a joint that follows an axis is beyond its own limits."""
    robot = robot_of(cell)
    if not robot.couplings:
        return
    for number, move in enumerate(moves):
        target = np.array(move.target_rad)
        for beyond in followers_beyond(robot, target, target):
            axis = cell.axes[beyond.axis]
            joint = beyond.joint
            unit = joint_unit(joint.kind)
            position, _ = beyond.reached
            limits = _interval(unit, beyond.allowed)
            raise _refused(
                f"{path}: moves[{number}], {axis.name}",
                f"joint {joint.name}, which follows it, at {unit.spell(position)}",
                f"{limits}, its limits in the URDF",
                f"correct the move: {axis.name} within {_interval(axis.unit, beyond.axis_range)}",
            )


AROUND_SHARE = 0.25
"""Largest share of the limits at which a robot goes around what is in its way to the first target:
no one has seen these moves before.
"""


def way_to_first_target(
    cell: Cell, plan: Plan, start_rad: FloatArray
) -> tuple[tuple[PlannedMove, ...], str]:
    """Return the moves to the first target of a plan, and a remark where it is more than one.

    Where the straight way is clear, it is the first move of the plan. Else slow moves lead around
    what is in the way, between the joint positions of the plan and the one where the robot stands.

    Args:
        cell: with `workspace`, `clearance` or closures; without any, nothing is known of the room.
        plan: for this cell.
        start_rad: where the robot stands [rad; m of a prismatic joint], shape (n,).

    Raises:
        MotionRefused: no clear way was found; with the place and the bodies that come too close on
            the straight one.
    """
    first = plan.moves[0]
    if not _is_bounded(cell):
        return (first,), ""
    checker = _checker(cell)
    target = np.array(first.target_rad)
    blocked = checker.obstruction(start_rad, target)
    if blocked is None:
        return (first,), ""
    positions = [start_rad]
    for move in plan.moves:
        positions.append(np.array(move.target_rad))
    lower = np.min(positions, axis=0)
    upper = np.max(positions, axis=0)
    positions_between = clear_way(
        checker, start_rad, target, lower, upper, np.random.default_rng(0)
    )
    if positions_between is None:
        raise MotionRefused(
            f"the way from here to the first target of the plan: found {_describe(cell, blocked)}, "
            "and no other clear way between the positions of the plan; bring the robot near the "
            f"first target by hand, or correct {_keys(blocked)} in the cell file"
        )
    velocity = min(first.velocity, AROUND_SHARE)
    acceleration = min(first.acceleration, AROUND_SHARE)
    slow_to_first = replace(first, velocity=velocity, acceleration=acceleration)
    moves = []
    for position in positions_between:
        target_rad = tuple(position.tolist())
        moves.append(replace(slow_to_first, target_rad=target_rad, dwell_s=DWELL_S))
    moves.append(slow_to_first)
    further = counted(len(positions_between), "further position")
    remark = (
        f"the straight way from where the robot stood to the first target of the plan is not clear "
        f"({_describe(cell, blocked)}): slow moves led around it, by {further}"
    )
    return tuple(moves), remark


def check_return(cell: Cell, start_rad: FloatArray, end_rad: FloatArray) -> None:
    """Refuse a way back that leaves what the cell file declares.

    Raises:
        MotionRefused: with the place and the bodies that come too close.
    """
    if not _is_bounded(cell):
        return
    found = _checker(cell).obstruction(start_rad, end_rad)
    if found is not None:
        raise MotionRefused(
            f"the slow return within the limits: found {_describe(cell, found)}; bring the robot "
            f"within its limits by hand, or correct {_keys(found)} in the cell file"
        )


def _is_bounded(cell: Cell) -> bool:
    """Whether the cell file says where the robot must not go."""
    return cell.clearance is not None or cell.chain is not None


def _describe(cell: Cell, found: Obstruction) -> str:
    """Say what is in the way, and where the joints are then."""
    positions = []
    for axis, position in zip(cell.axes, found.position, strict=True):
        positions.append(axis.unit.spell(position))
    where = ", ".join(positions)
    if found.first == CLOSURES:
        return f"that the loops do not close, or are close to a singularity, at ({where})"
    distance_mm = 1000 * found.distance_m
    return f"{distance_mm:.0f} mm between {found.first} and {found.second} at ({where})"


def _keys(found: Obstruction) -> str:
    """Return the keys of the cell file that say what is in the way."""
    if found.first == CLOSURES:
        return "`closures`, `motors` and `limits`"
    return "`workspace` and `clearance`"


def _checker(cell: Cell) -> Checker:
    """Return the distances to what the cell file declares;
    that a guessed arm touches itself refuses nothing.
    """
    robot = model_of(cell).robot
    lightest = min((payload.mass_kg for payload in cell.payloads), default=1.0)
    scene = scene_of(cell, robot, lightest)
    if scene.guessed:
        return Checker(robot, replace(scene.checker.scene, pairs=()))
    return scene.checker


def _check_room(path: Path, cell: Cell, moves: tuple[PlannedMove, ...]) -> None:
    """Refuse ways that leave what the cell file declares."""
    if not _is_bounded(cell):
        return
    checker = _checker(cell)
    minimum_m = checker.scene.minimum_m
    for number, way in enumerate(paths_of(cell, moves), start=1):
        found = checker.obstruction(np.asarray(way.start), np.asarray(way.end))
        if found is not None:
            if found.first == CLOSURES:
                expected = "poses inside the workspace"
            else:
                expected = f"at least {1000 * minimum_m:.0f} mm"
            raise _refused(
                f"{path}: moves[{number}], on the way there",
                _describe(cell, found),
                expected,
                f"correct the move, or {_keys(found)} in the cell file",
            )
