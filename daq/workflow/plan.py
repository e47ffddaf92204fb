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
from ident.calibration import CalibratedDrive, CalibratedJoint, CalibratedRobot
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


DWELL_S = 0.1
NEAR = 0.15  #: Standard deviation of a near target, as a share of the joint's range
ROUND = 8  #: Proposals whose regressors are made at once
THINNING = 2  #: Every second row is enough to compare proposals by
SHARPNESS = 8.0
"""The search lowers this norm of all gains' deviations, nearly the largest:
the second worst counts a little.
"""
MIN_PLANNED_MOVES = 5
WISHED_MOVES = 30  #: With so many, σ is judged by leaving moves out, and the search has a choice
#: Random postures or ways that are tried from one place before it counts as shut in
MAX_TRIES = 100
MAX_RETREATS = 30
MAX_STARTS = 10  #: Random plans that are begun before the run counts as too short
#: Shares of its speed at which a move is tried that asks too much torque
SLOWER = (1.0, 0.8, 0.6, 0.45, 0.3, 0.2)
#: Decimals of targets in degrees (or mm) and of shares: what is judged is what the plan file says
PLACES = 3


class Kind(Enum):
    """Kind of a proposal."""

    ANEW = "another target"
    NEAR = "a target moved in some of the axes"
    SWING = "one axis to the other end of its range, the others as they were"
    SPEED = "another speed and acceleration"
    INSERT = "one more move"
    SHIFT = "a move taken out here and put in there"


KINDS = tuple(Kind)
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
        most: list[PlannedMove] = []
        for _ in range(MAX_STARTS):
            moves, paths = self._filled()
            if len(moves) >= MIN_PLANNED_MOVES:
                informations = self._experiment.informations(paths, THINNING)
                return Draft(tuple(moves), tuple(paths), tuple(informations))
            most = max(most, moves, key=len)
        found = f"room for {len(most)} moves"
        if len(most) == 1:  # which only says where the run starts
            found = "no room for a move"
        shortage = WISHED_MOVES / max(len(most), 1)
        longer_s = _tens(self._duration_s * shortage)
        expected = f"at least {MIN_PLANNED_MOVES}, better {WISHED_MOVES}"
        remedy = f"allow a longer run (some --duration {longer_s:.0f})"
        raise _unfit(self._cell, self._duration_s, found, expected, remedy, PlanTooShort)

    def _filled(self) -> tuple[list[PlannedMove], list[Trapezoid]]:
        moves = [self._clear_start()]
        paths: list[Trapezoid] = []
        left = self._duration_s - DWELL_S
        retreats = 0
        while True:
            move = self._clear_move(np.array(moves[-1].target_rad))
            if move is not None:
                path = path_of(self._cell, np.array(moves[-1].target_rad), move)
                left -= path.duration_s + move.dwell_s
                if left < 0.0:
                    return moves, paths
                moves.append(move)
                paths.append(path)
                continue
            # A corner that the random targets before it led into.
            retreats += 1
            if retreats > MAX_RETREATS:
                raise self._blocked("way")
            if paths:
                left += paths.pop().duration_s + moves.pop().dwell_s
            else:
                moves = [self._clear_start()]

    def improve(
        self, draft: Draft, tries: int, progress: Callable[[int, FloatArray], None]
    ) -> Draft:
        """Exchange moves; an exchange stays when it lowers the deviations and the run gets no
        longer than allowed.
        """
        best, worst = self._judge(draft, np.inf)
        done = 0
        while done < tries:
            count = min(ROUND, tries - done)
            chosen = draft
            # One a round: proposals that were made from the same moves do not go together.
            proposals = [self._proposal(draft.moves) for _ in range(count)]
            for candidate in self._drafts(draft, proposals):
                value, found = self._judge(candidate, best)
                if value < best:
                    chosen = candidate
                    best = value
                    worst = found
            draft = chosen
            done += count
            progress(done, worst)
        return draft

    def _judge(self, draft: Draft, to_beat: float) -> tuple[float, FloatArray]:
        """Cost of the search, and the deviations [%]:
        nearly the worst, raised where W is too badly conditioned.
        """
        information = self._goal.recorded + np.sum(draft.informations, axis=0)
        found = self._experiment.design.std_percent(information)
        # Unseen gains are as bad as each other; the norm of inf would hide the rest.
        bounded = np.minimum(self._goal.ratio(found), 1e6)
        worst = np.max(bounded)
        # (Σ rᵖ)^(1/p), scaled by the worst so that nothing overflows
        total = np.sum((bounded / worst) ** SHARPNESS)
        value = float(worst * total ** (1.0 / SHARPNESS))
        if value < to_beat:  # the condition can only raise it
            condition = self._experiment.design.condition(information)
            excess = max(1.0, condition / self._largest_condition)
            value *= excess**2
        return value, found

    def _proposal(self, moves: tuple[PlannedMove, ...]) -> tuple[PlannedMove, ...]:
        rng = self._rng
        low = self._low
        high = self._high
        kind = KINDS[int(rng.choice(len(KINDS), p=CHANCES))]
        index, other = (int(number) for number in rng.integers(len(moves), size=2))
        before = moves[:index]
        old = moves[index]
        after = moves[index + 1 :]
        random = self._random_move()
        match kind:
            case Kind.ANEW:
                changed: tuple[PlannedMove, ...] = (*before, random, *after)
            case Kind.NEAR:
                step = rng.normal(0.0, NEAR, len(low)) * (high - low)
                is_moved = rng.random(len(low)) < 0.5
                target = np.array(old.target_rad) + step * is_moved
                near = self._written(np.clip(target, low, high))
                changed = (*before, replace(old, target_rad=near), *after)
            case Kind.SWING:
                axis = int(rng.integers(len(low)))
                inwards = 0.25 * float(rng.random()) * (high[axis] - low[axis])
                target = np.array(old.target_rad)
                previous = moves[max(index - 1, 0)].target_rad[axis]
                middle = 0.5 * (low[axis] + high[axis])
                if previous < middle:
                    target[axis] = high[axis] - inwards
                else:
                    target[axis] = low[axis] + inwards
                changed = (*before, replace(old, target_rad=self._written(target)), *after)
            case Kind.SPEED:
                speedy = replace(old, velocity=random.velocity, acceleration=random.acceleration)
                changed = (*before, speedy, *after)
            case Kind.INSERT:
                changed = (*before, random, old, *after)
            case Kind.SHIFT:
                rest = (*before, *after)
                changed = (*rest[:other], old, *rest[other:])
        return changed

    def _drafts(self, draft: Draft, proposals: Sequence[tuple[PlannedMove, ...]]) -> list[Draft]:
        """The proposals that are short enough and whose new ways are clear,
        with their information.
        """
        known: dict[_Way, tuple[Trapezoid, FloatArray]] = {}
        pairs = pairwise(draft.moves)
        for pair, path, information in zip(pairs, draft.paths, draft.informations, strict=True):
            known[_way(pair)] = (path, information)
        fresh: dict[_Way, Trapezoid] = {}
        kept = []
        for moves in proposals:
            ways = [_way(pair) for pair in pairwise(moves)]
            new: dict[_Way, Trapezoid] = {}
            lengths_s = []
            for way in ways:
                if way in known:
                    path, _ = known[way]
                else:
                    start, move = way
                    path = path_of(self._cell, np.array(start), move)
                    new[way] = path
                lengths_s.append(path.duration_s)
            dwell_s = sum(move.dwell_s for move in moves)
            # The time is quick to check, the clearance is not.
            if sum(lengths_s) + dwell_s > self._duration_s:
                continue
            if not all(map(self._is_within, moves)):
                continue
            unchecked = [path for way, path in new.items() if way not in fresh]
            if all(map(self._is_clear, unchecked)):
                kept.append((moves, ways))
                fresh |= new
        is_carried = self._is_carried(list(fresh.values()))
        for way, fits in zip(tuple(fresh), is_carried, strict=True):
            if not fits:
                del fresh[way]
        usable = known.keys() | fresh.keys()
        kept = [(moves, ways) for moves, ways in kept if usable.issuperset(ways)]
        informations = self._experiment.informations(list(fresh.values()), THINNING)
        for (way, path), information in zip(fresh.items(), informations, strict=True):
            known[way] = (path, information)
        drafts = []
        for moves, ways in kept:
            of_ways = [known[way] for way in ways]
            paths, of_paths = zip(*of_ways, strict=True)
            drafts.append(Draft(moves, paths, of_paths))
        return drafts

    def _is_clear(self, path: Trapezoid) -> bool:
        checker = self._experiment.scene.checker
        return checker.obstruction(path.start, path.end) is None

    def _clear_start(self) -> PlannedMove:
        for _ in range(MAX_TRIES):
            move = self._random_move()
            checker = self._experiment.scene.checker
            if checker.robot.is_constrained:
                target = np.array(move.target_rad)
                near = towards(checker, checker.home, target, self._low, self._high)
                move = replace(move, target_rad=self._written(near))
            if not self._is_within(move):
                continue
            [margin_m] = checker.margins(np.array([move.target_rad]))
            if margin_m > 0.0:
                return move
        raise self._blocked("posture")

    def _clear_move(self, start: FloatArray) -> PlannedMove | None:
        for _ in range(MAX_TRIES):
            move = self._random_move()
            checker = self._experiment.scene.checker
            target = np.array(move.target_rad)
            if checker.robot.is_constrained:  # a way to a far target often leaves the workspace
                target = towards(checker, start, target, self._low, self._high)
                move = replace(move, target_rad=self._written(target))
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
        """The move as fast as the drives can carry it; None where they cannot even slowly."""
        for share in SLOWER:
            slower = _slower(move, share)
            if self._is_carried([path_of(self._cell, start, slower)])[0]:
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
        # Slow and fast moves both: friction is distinguished from inertia by moves of different
        # speed and acceleration.
        target = self._written(self._rng.uniform(self._low, self._high))
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
        is_above = target >= self._allowed.lower
        is_below = target <= self._allowed.upper
        return bool(np.all(is_above & is_below))

    def _written(self, target: FloatArray) -> tuple[float, ...]:
        """As the plan file will say it: what is judged is what is made."""
        target = self._experiment.scene.checker.fitting(target)
        written = []
        for value, axis in zip(target.tolist(), self._cell.axes, strict=True):
            si = axis.unit.si
            written.append(round(value / si, PLACES) * si)
        return tuple(written)

    def _blocked(self, what: str) -> UsageError:
        """Error that names the two bodies which are in the way most often."""
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
        pairs = Counter((one.first, one.second) for one in blocking)
        (worst, times), *_ = pairs.most_common(1)
        if worst[0] == CLOSURES:
            remedy = f"correct {_keys(blocking[0])} in the cell file"
            return _unfit(self._cell, self._duration_s, found, "poses that the loops allow", remedy)
        of_worst = [one for one in blocking if (one.first, one.second) == worst]
        farthest_mm = 1000.0 * max(one.distance_m for one in of_worst)
        found += (
            f": in {times} of {MAX_TRIES} {worst[0]} and {worst[1]} are at most "
            f"{farthest_mm:.0f} mm apart"
        )
        minimum_mm = 1000.0 * checker.scene.minimum_m
        expected = f"at least {minimum_mm:.0f} mm"
        return _unfit(self._cell, self._duration_s, found, expected, _room_remedy(scene, worst))

    def _too_weak(self) -> list[str]:
        """Names of the axes whose drives cannot carry most of some slow random ways,
        or at least the most of them.
        """
        paths: list[Trapezoid] = []
        start = np.array(self._random_move().target_rad)
        for _ in range(MAX_TRIES):
            move = _slower(self._random_move(), SLOWER[-1])
            paths.append(path_of(self._cell, start, move))
            start = np.array(move.target_rad)
        is_heavy = EFFORT_MARGIN * self._experiment.effort_shares(paths) > 1.0
        share_heavy = np.mean(is_heavy, axis=0)
        limit = min(0.5, 0.99 * float(np.max(share_heavy)))
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
    return (
        "correct these `clearance.capsules` or `clearance.minimum_m` in the cell file, or the "
        "joint limits"
    )


def _tens(seconds: float) -> float:
    """Round a duration up to tens of seconds, as a person would give it."""
    return 10.0 * math.ceil(seconds / 10.0)


def longer_run_s(used_s: float, requested_s: float, ratio: float) -> float | None:
    """Duration of a run in which σ is smaller by a ratio [s];
    None where it is longer than a plan may be.

    σ falls with the square root of the time.

    Args:
        used_s: duration of the moves that were found [s].
        requested_s: duration that they had room for [s]; the longer run is longer than that.
        ratio: σ that the moves give over σ that is wanted, above 1.
    """
    needed_s = _tens(used_s * ratio**2)
    if needed_s <= requested_s:
        needed_s = _tens(requested_s + 1.0)
    return needed_s if needed_s <= LONGEST_S else None


def _unfit(
    cell: Cell,
    duration_s: float,
    found: str,
    expected: str,
    remedy: str,
    kind: type[UsageError] = UsageError,
) -> UsageError:
    subject = f"plan of {duration_s:g} s for cell {cell.name!r}"
    return kind(subject, found=found, expected=expected, remedy=remedy)


_Way = tuple[tuple[float, ...], PlannedMove]


def _way(pair: tuple[PlannedMove, PlannedMove]) -> _Way:
    return pair[0].target_rad, pair[1]


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
    room = _room(cell, duration_s, box)
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
        room,
        allowed,
    )

    def report_worst(done: int, std_percent: FloatArray) -> None:
        progress(done, float(np.max(std_percent)))

    draft = search.improve(search.random_moves(), exchanges, report_worst)
    of_moves = np.sum(experiment.informations(draft.paths), axis=0)
    information = goal.recorded + of_moves
    predicted = experiment.design.std_percent(information)
    found = experiment.design.condition(information)
    worst = int(np.argmax(goal.ratio(predicted)))
    if not found <= largest_condition:
        condition = format_at_limit(found, largest_condition, 0)
        words = (
            f"condition {condition} of the weighted observation matrix after {exchanges} exchanges"
        )
        ratio = found / largest_condition
        remedy = _condition_remedy(experiment, duration_s, ratio)
        kind = PlanTooShort if _is_mended_by_time(duration_s, ratio) else UsageError
        raise _unfit(cell, duration_s, words, f"at most {largest_condition:.0f}", remedy, kind)
    used_s = experiment_duration_s(cell, draft.moves)
    if not predicted[worst] <= largest_std_percent:
        percent = format_at_limit(float(predicted[worst]), largest_std_percent, 1)
        words = f"{percent} % predicted for the gain of {cell.axes[worst].name}"
        excitation, _ = experiment.excitation(draft.paths)
        judged = verdicts(experiment.design, [(excitation, experiment.mounted)])
        ways = ["allow more exchanges, wider joint limits or higher speed"]
        kind = UsageError
        if np.isfinite(predicted[worst]):
            excess = float(predicted[worst]) / largest_std_percent
            longer_s = longer_run_s(used_s, duration_s, excess)
            if longer_s is not None:
                ways.insert(0, f"allow a longer run (some --duration {longer_s:.0f})")
                kind = PlanTooShort
        sentences = ["; or ".join(ways), *judged.sentences(cell.axis_names)]
        remedy = ". ".join(sentences)
        raise _unfit(cell, duration_s, words, f"at most {largest_std_percent:g} %", remedy, kind)
    return Plan(
        cell=cell.name,
        seed=seed,
        condition=found,
        predicted_std_percent=tuple(predicted.tolist()),
        duration_s=used_s,
        moves=draft.moves,
        units=tuple(axis.unit for axis in cell.axes),
        robot=calibrated_robot(cell),
    )


#: Ratio of two conditions that more moves make; a larger one is of the robot
MADE_BY_MORE_MOVES = 10.0


def _is_mended_by_time(duration_s: float, ratio: float) -> bool:
    """Whether a run of twice the duration may lower a condition that is too large by a ratio."""
    if ratio > MADE_BY_MORE_MOVES:
        return False
    return _tens(2.0 * duration_s) <= LONGEST_S


def _condition_remedy(experiment: Experiment, duration_s: float, ratio: float) -> str:
    """Say what lowers a condition that is too large by a ratio:
    more moves, or right angles that are right.
    """
    other = "more exchanges, wider joint limits or higher speed; `--condition` accepts more"
    if _is_mended_by_time(duration_s, ratio):
        longer_s = _tens(2.0 * duration_s)
        return f"allow a longer run (some --duration {longer_s:.0f}), {other}"
    turned = nearly_right_joints(experiment.design.expectation.model.robot)
    if not turned:
        return f"allow {other}"
    exact = "1.5707963267948966 for a quarter turn, 3.141592653589793 for a half"
    listed = ", ".join(turned)
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
    """Names of the joints that the URDF turns by nearly, but not exactly, right angles;
    axes are looked at, too.
    """
    found = []
    for joint in robot.joints:
        entries = np.concatenate((joint.rotation.ravel(), joint.axis))
        # Rotations by right angles have entries of 0, 1 and -1 alone.
        off = np.abs(entries - np.round(entries))
        if EXACTLY_RIGHT < off.max() < NEARLY_RIGHT:
            found.append(joint.name)
    return tuple(found)


def _room(cell: Cell, duration_s: float, box: TargetBox | None) -> TargetBox:
    """Return the least and the largest targets: those of the joint limits, and inside a box."""
    lower, upper = limits_of(cell).targets()
    if box is None:
        return TargetBox(lower, upper)
    room = TargetBox(np.maximum(lower, box.lower), np.minimum(upper, box.upper))
    outside = list(compress(cell.axis_names, room.lower > room.upper))
    if outside:
        listed = ", ".join(outside)
        found = f"a box of targets outside the joint limits of {listed}"
        raise _unfit(
            cell, duration_s, found, "a box inside the limits", "give a box that they allow"
        )
    return room


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
            expected=f"{_interval(unit, joint.range or beyond.reached)}, its limits in the URDF",
            remedy=f"give {axis.name} `limits` within {allowed}, or correct <limit> or <mimic> of "
            f"{joint.name} in the URDF",
        )


def _interval(unit: JointUnit, ends: tuple[float, float]) -> str:
    """Format two positions that are given in SI: `-20 deg to 35.5 deg`."""
    first, last = ends
    return f"{unit.spell(first)} to {unit.spell(last)}"


def slowed(cell: Cell, plan_: Plan, override: float) -> Plan:
    """The same ways at a share of their speed, as for a first run;
    the predictions are those of the plan as made.
    """
    moves = tuple(
        replace(
            move, velocity=move.velocity * override, acceleration=move.acceleration * override**2
        )
        for move in plan_.moves
    )
    return replace(plan_, duration_s=experiment_duration_s(cell, moves), moves=moves)


def _slower(move: PlannedMove, share: float) -> PlannedMove:
    """The same way at a share of its speed, as the plan file will say it,
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
Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class _Move(StrictModel):
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


class _Joint(StrictModel):
    name: str
    kind: str
    parent: str


class _Drive(StrictModel):
    axis: str
    node_id: int | None
    vendor_id: int | None
    product_code: int | None


class _Robot(StrictModel):
    kinematics_sha256: Digest
    drives_sha256: Digest
    # Plans of earlier versions have the digests alone.
    joints: tuple[_Joint, ...] = ()
    drives: tuple[_Drive, ...] = ()
    motors: tuple[str, ...] = ()

    @property
    def robot(self) -> CalibratedRobot:
        """The robot."""
        joints = []
        for joint in self.joints:
            joints.append(CalibratedJoint(joint.name, joint.kind, joint.parent))
        drives = []
        for drive in self.drives:
            ids = (drive.node_id, drive.vendor_id, drive.product_code)
            drives.append(CalibratedDrive(drive.axis, *ids))
        return CalibratedRobot(
            self.kinematics_sha256, self.drives_sha256, tuple(joints), tuple(drives), self.motors
        )


class _Plan(StrictModel):
    document_kind: ClassVar[DocumentKind | None] = DocumentKind.PLAN

    format: Literal["drivegain-plan"]
    cell: str
    seed: int
    condition: Annotated[float, Field(gt=0)]
    # Plans of earlier versions have none.
    predicted_std_percent: tuple[Annotated[float, Field(gt=0)], ...] = ()
    purpose: str = ""
    robot: _Robot | None = None
    moves: Annotated[tuple[_Move, ...], Field(min_length=1, max_length=10_000)]


@dataclass(frozen=True, slots=True)
class PlanHead:
    """What a plan file says of itself, its moves unread."""

    cell: str  #: name of the cell it was made for
    seed: int  #: it was made from
    #: of each gain [% of it]; empty in plans of earlier versions
    predicted_std_percent: tuple[float, ...]


def plan_head(path: Path) -> PlanHead:
    """Read what a plan file says of itself, whatever cell it is for.

    Raises:
        ConfigurationError: the file is missing, or is no plan.
    """
    model = read_model(parse_yaml(read_yaml_bytes(path), str(path)), _Plan)
    return PlanHead(model.cell, model.seed, model.predicted_std_percent)


def save_plan(plan: Plan, path: Path) -> None:
    """Write a plan; a file of that name is replaced whole.

    Raises:
        OSError: from the file system.
    """
    key = _key(plan.units)
    predicted = ", ".join(f"{value:.3f}" for value in plan.predicted_std_percent)
    recorded = "moves made without load and with the payload"
    if plan.purpose:
        recorded = "all blocks of the session and these moves together"
    units = ", ".join(unit.name for unit in plan.units)
    lines = [
        "# Synchronised point-to-point moves; velocity and acceleration are shares of the "
        "joint limits.",
        f"# Targets: {units}.",
        "format: drivegain-plan",
        f"cell: {plan.cell}",
        f"seed: {plan.seed}",
        f"condition: {plan.condition:.1f}    # of the weighted observation matrix",
        f"predicted_std_percent: [{predicted}]    # of each gain, {recorded}",
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
            f"{key}: [{target}]",
            f"velocity: {move.velocity:.3f}",
            f"acceleration: {move.acceleration:.4f}",
            f"dwell_s: {move.dwell_s:.3f}",
        ]
        written = ", ".join(fields)
        lines.append(f"  - {{{written}}}")
    replace_file(path, ("\n".join(lines) + "\n").encode())


def _robot_lines(robot: CalibratedRobot) -> list[str]:
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
    model = read_model(parse_yaml(read_yaml_bytes(path), str(path)), _Plan)
    if model.cell != cell.name:
        remedy = "make a plan for this cell: `drivegain plan CELL`"
        found = f"a plan for cell {model.cell!r}"
        raise _refused(str(path), found, f"one for {cell.name!r}", remedy)
    robot = _robot_of(path, model.robot, cell)
    if len(model.predicted_std_percent) not in (0, len(cell.axes)):
        found = f"{len(model.predicted_std_percent)} numbers"
        remedy = "make the plan anew: `drivegain plan CELL`"
        expected = f"{len(cell.axes)}, one a gain"
        raise _refused(f"{path}: predicted_std_percent", found, expected, remedy)
    moves = tuple(_move(path, cell, number, move) for number, move in enumerate(model.moves))
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
        robot=robot,
    )


def _robot_of(path: Path, stated: _Robot | None, cell: Cell) -> CalibratedRobot | None:
    """Return the robot that a plan is for, None for a plan of an earlier version;
    refuse that of another robot.
    """
    if stated is None:
        return None
    found = stated.robot
    differences = robot_differences(found, calibrated_robot(cell))
    if differences:
        raise _refused(
            f"{path}: robot",
            f"a plan for another robot with the same cell name {cell.name!r}: "
            f"{found_text(differences)}",
            f"{expected_text(differences)}, as in the cell file",
            "give the cell file that the plan was made with, or make a plan for this cell: "
            "`drivegain plan CELL`",
        )
    return found


def _key(units: tuple[JointUnit, ...]) -> str:
    if all(unit == DEGREE for unit in units):
        return "target_deg"
    return "target"


def _refused(
    where: str, found: str, expected: str, remedy: str = "correct the move"
) -> ConfigurationInconsistent:
    return ConfigurationInconsistent(where, found=found, expected=expected, remedy=remedy)


def _move(path: Path, cell: Cell, number: int, move: _Move) -> PlannedMove:
    key = "target_deg" if move.target is None else "target"
    values = move.target_deg or move.target or ()
    where = f"{path}: moves[{number}].{key}"
    expected_key = _key(tuple(axis.unit for axis in cell.axes))
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
            limits = _interval(unit, joint.range or beyond.reached)
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
    positions = np.array([start_rad, *(move.target_rad for move in plan.moves)])
    lower = positions.min(axis=0)
    upper = positions.max(axis=0)
    turns = clear_way(checker, start_rad, target, lower, upper, np.random.default_rng(0))
    if turns is None:
        raise MotionRefused(
            f"the way from here to the first target of the plan: found {_spell(cell, blocked)}, "
            "and no other clear way between the positions of the plan; bring the robot near the "
            f"first target by hand, or correct {_keys(blocked)} in the cell file"
        )
    velocity = min(first.velocity, AROUND_SHARE)
    acceleration = min(first.acceleration, AROUND_SHARE)
    slow = replace(first, velocity=velocity, acceleration=acceleration)
    moves = []
    for turn in turns:
        moves.append(replace(slow, target_rad=tuple(turn.tolist()), dwell_s=DWELL_S))
    positions_between = counted(len(turns), "further position")
    remark = (
        f"the straight way from where the robot stood to the first target of the plan is not clear "
        f"({_spell(cell, blocked)}): slow moves led around it, by {positions_between}"
    )
    return (*moves, slow), remark


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
            f"the slow return within the limits: found {_spell(cell, found)}; bring the robot "
            f"within its limits by hand, or correct {_keys(found)} in the cell file"
        )


def _is_bounded(cell: Cell) -> bool:
    """Whether the cell file says where the robot must not go."""
    return cell.clearance is not None or cell.chain is not None


def _spell(cell: Cell, found: Obstruction) -> str:
    positions = []
    for axis, position in zip(cell.axes, found.position, strict=True):
        positions.append(axis.unit.spell(position))
    where = ", ".join(positions)
    if found.first == CLOSURES:
        return f"that the loops do not close, or are close to a singularity, at ({where})"
    distance_mm = 1000 * found.distance_m
    return f"{distance_mm:.0f} mm between {found.first} and {found.second} at ({where})"


def _keys(found: Obstruction) -> str:
    if found.first == CLOSURES:
        return "`closures`, `motors` and `limits`"
    return "`workspace` and `clearance`"


def _checker(cell: Cell) -> Checker:
    """Distances to what the cell file declares;
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
                _spell(cell, found),
                expected,
                f"correct the move, or {_keys(found)} in the cell file",
            )
