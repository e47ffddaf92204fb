"""Plan moves from limits alone: point to point, for the gains that are known worst (paper §2.3).

Random moves fill the duration. Then they are exchanged one at a time, and what lowers the predicted
standard deviation of the worst gain stays. The information of a plan is the sum over its moves
(`ident.planning.excitation`), so that an exchange costs the columns of the two moves that it
touches.

Nothing here knows what is in the room: the ways between the targets are the caller's to check.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike

from ident.arrays import (
    FloatArray,
    as_array,
    as_gains,
    require_count,
    require_kind,
    require_number,
    takes,
)
from ident.data.conditioning import Conditioning, require_cutoffs, require_settings
from ident.errors import ModelError, PlanUnfit
from ident.model.bodies import Payload
from ident.model.model import Model
from ident.model.robot import JointKind, Motion, Robot
from ident.planning.effort import EFFORT_MARGIN, believable_efforts, effort_shares
from ident.planning.excitation import (
    Design,
    Excitation,
    declared_efforts,
    nominal_expectation,
    nominal_payload,
    rows_between_rests,
    visible_base,
)
from ident.planning.limits import JointLimits, followers_beyond

DWELL_S = 0.1  #: Rest at each target [s]: moves are told apart by it
#: Least speed of a random move, as a share of the fastest that its limits allow
SLOWEST_SHARE = 0.3
#: Least way of a random move, as a share of the way to a target drawn from all positions: shorter
#: ways leave time for more moves
SHORTEST_SHARE = 0.3
#: p of the p-norm of all predicted σ, which a plan lowers: nearly the largest σ
COST_NORM = 8.0
NEAR_SHARE = 0.15  #: Standard deviation of the step to a near target, as a share of the range
FEWEST_MOVES = 10  #: σ of a fit is found by leaving out moves
MAX_TRIES = 100  #: Random moves from one place before its limits count as too narrow
#: Index of the payload in each run of the same moves: once without load, once with the payload
RUNS: tuple[int | None, ...] = (None, 0)
MOST_SAMPLES = 1e7  #: Of a motion: more would take gigabytes
LONGEST_RUN_S = 3600.0  #: Of a plan: a longer one would hold gigabytes, and an arm is warm by then
#: Largest speed of a move with least jerk, at its middle, relative to the mean speed d/T
PEAK_SPEED = 15.0 / 8.0
#: Its largest acceleration, at s = 1/2 − √3/6, relative to d/T²
PEAK_ACCELERATION = 10.0 / 3.0**0.5


@dataclass(frozen=True, slots=True)
class PlannedMoves:
    """Moves from rest to rest in which all joints start and end together,
    each with the least jerk.
    """

    target_rad: FloatArray  #: start, then the target of each move, shape (moves + 1, n)
    move_s: FloatArray  #: duration of each move, shape (moves,)
    dwell_s: float  #: rest at each target
    #: Standard deviation of each gain [% of it] when the moves are made once without load and once
    #: with the payload, as predicted from a nominal robot, shape (n,). A careful bound, and no
    #: forecast: a fit of simulated moves has a third to a twelfth of it. It compares plans of one
    #: robot.
    predicted_std_percent: FloatArray

    @property
    def duration_s(self) -> float:
        """Time from the start to the end of the last dwell [s]."""
        return float(self.move_s.sum() + self.dwell_s * len(self.move_s))

    def motion(self, rate_hz: float) -> tuple[FloatArray, Motion]:
        """Set-points at a rate: time of each sample, shape (k,), and the motion, shape (k, n) each.

        Args:
            rate_hz: sampling rate.

        Raises:
            ModelError: the rate, a duration or the dwell is no finite number above zero, or the
                samples are more than MOST_SAMPLES.
        """
        rate_hz = require_number(
            "rate_hz", rate_hz, above=0.0, remedy="give the rate of the controller, such as 500"
        )
        dwell_s = require_number(
            "dwell_s", self.dwell_s, above=0.0, remedy="give a rest such as 0.1 s"
        )
        target_rad = as_array("target_rad", self.target_rad)
        move_s = as_array("move_s", self.move_s)
        if target_rad.ndim != 2 or move_s.shape != (len(target_rad) - 1,):
            found = f"target_rad of shape {target_rad.shape} and move_s of shape {move_s.shape}"
            raise ModelError(
                f"found {found}; expected (moves + 1, n_axes) and (moves,); give each "
                "move its duration"
            )
        if not np.all(move_s > 0.0):
            raise ModelError(
                f"move_s has {move_s.min():g} s; expected durations above 0 s; take "
                "those of plan_moves"
            )
        all_s = float(move_s.sum() + dwell_s * len(move_s))
        samples = rate_hz * all_s
        if samples > MOST_SAMPLES:
            expected = f"at most {MOST_SAMPLES:.0e}; give a lower `rate_hz`, or fewer moves"
            raise ModelError(f"found {samples:.3g} samples at {rate_hz:g} Hz; expected {expected}")
        time_s = np.arange(0.0, self.duration_s, 1.0 / rate_hz)
        ends_s = np.cumsum(self.move_s + self.dwell_s)
        begin_s = np.concatenate(([0.0], ends_s[:-1]))
        move = np.searchsorted(begin_s, time_s, side="right") - 1
        way_rad = np.diff(self.target_rad, axis=0)
        move_of_sample_s = self.move_s[move]
        since_begin_s = time_s - begin_s[move]
        progress = np.minimum(since_begin_s / move_of_sample_s, 1.0)  # one while the arm dwells
        motion = _least_jerk(self.target_rad[move], way_rad[move], move_of_sample_s, progress)
        return time_s, motion


def _least_jerk(
    start_rad: FloatArray, way_rad: FloatArray, move_s: FloatArray, progress: FloatArray
) -> Motion:
    """Motion of least jerk from rest to rest: q = q₀ + d (10 s³ − 15 s⁴ + 6 s⁵) with s = t/T.

    Flash & Hogan, Journal of Neuroscience 5 (1985).

    Args:
        start_rad: q₀ of the move of each sample, shape (k, n).
        way_rad: d of it, shape (k, n).
        move_s: T of it [s], shape (k,).
        progress: s, 0 to 1, shape (k,).
    """
    s = progress[:, None]
    duration_s = move_s[:, None]
    position = 10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5
    speed = 30.0 * s**2 - 60.0 * s**3 + 30.0 * s**4
    acceleration = 60.0 * s - 180.0 * s**2 + 120.0 * s**3
    return Motion(
        position_rad=start_rad + way_rad * position,
        velocity_rad_s=way_rad * speed / duration_s,
        acceleration_rad_s2=way_rad * acceleration / duration_s**2,
    )


class _Exchange(Enum):
    """What a try changes; numbered as the random draw is."""

    ANYWHERE = 0  #: a target, to one drawn from all positions
    NEAR = 1  #: a target, by a small step
    SPEED = 2  #: the speed of a move


@dataclass(frozen=True, slots=True)
class _Draft:
    """Moves while they are exchanged, with the information of each."""

    target_rad: tuple[FloatArray, ...]  #: start, then the target of each move, shapes (n,)
    speed_share: tuple[float, ...]  #: speed of each move, as a share of the fastest possible
    move_s: tuple[float, ...]  #: duration of each move [s]
    information: tuple[FloatArray, ...]  #: Fisher information of each move, shape (p, p)

    @property
    def duration_s(self) -> float:
        """Time with all dwells [s]."""
        return sum(self.move_s) + DWELL_S * len(self.move_s)


@dataclass(frozen=True, slots=True)
class _Search:
    """What moves are judged by."""

    design: Design
    limits: JointLimits
    effort: FloatArray  #: limit of each axis [Nm or N], inf where it is not known, shape (n,)
    row_s: float  #: time between two rows of the fit [s]
    edge_s: float  #: time next to a rest in which rows are not used [s]

    def fastest_s(self, start_rad: FloatArray, end_rad: FloatArray) -> float:
        """Shortest duration of a move within the limits of velocity and acceleration [s]."""
        way_rad = np.abs(end_rad - start_rad)
        by_velocity = PEAK_SPEED * way_rad / self.limits.velocity
        by_acceleration = np.sqrt(PEAK_ACCELERATION * way_rad / self.limits.acceleration)
        return float(max(by_velocity.max(), by_acceleration.max()))

    def information(
        self, start_rad: FloatArray, end_rad: FloatArray, move_s: float
    ) -> FloatArray | None:
        """Fisher information of a move made without load and with the payload, shape (p, p);
        None where it has no row, or needs more torque than a drive has.
        """
        time_s = np.arange(0.5 * self.row_s, move_s, self.row_s)
        rows = len(time_s)
        if rows == 0:
            return None
        way_rad = end_rad - start_rad
        motion = _least_jerk(
            start_rad=np.tile(start_rad, (rows, 1)),
            way_rad=np.tile(way_rad, (rows, 1)),
            move_s=np.full(rows, move_s),
            progress=time_s / move_s,
        )
        expected = self.design.expectation
        if np.isfinite(self.effort).any():
            shares = effort_shares(expected, self.effort, motion, RUNS)
            if shares.max() * EFFORT_MARGIN > 1.0:
                return None
        # Rows whose filter window has a rest in it do not count (`ident.equations.rows`).
        is_after_rest = time_s > self.edge_s
        is_before_rest = time_s < move_s - self.edge_s
        is_moving = is_after_rest & is_before_rest
        # A motor's row is used where all joints move that it turns, or whose torque it supplies.
        joint_moves = np.abs(way_rad) > 0.0
        train = expected.model.drive_train
        is_coupled = (train.to_motor != 0.0) | (train.direction != 0.0)
        motor_moves = np.array([joint_moves[joints].all() for joints in is_coupled])
        use = motor_moves[:, None] & is_moving
        return self.design.information(Excitation(motion, use), RUNS)

    def random_target(
        self, rng: np.random.Generator, start_rad: FloatArray | None = None
    ) -> FloatArray:
        """A target within the limits, with a margin, shape (n,).

        It is drawn from all positions; with a start, it lies on the way there.
        """
        lower, upper = self.limits.targets()
        end_rad = rng.uniform(lower, upper)
        if start_rad is None:
            return end_rad
        share = rng.uniform(SHORTEST_SHARE, 1.0)
        return np.asarray(start_rad + share * (end_rad - start_rad))

    def near_target(self, rng: np.random.Generator, target_rad: FloatArray) -> FloatArray:
        """A target near another one, within the limits."""
        lower, upper = self.limits.targets()
        step_rad = NEAR_SHARE * (upper - lower) * rng.standard_normal(len(lower))
        return np.clip(target_rad + step_rad, lower, upper)

    def cost(self, information: FloatArray) -> float:
        """Nearly the largest predicted σ of a gain [%]; inf where a gain does not show."""
        std_percent = self.design.std_percent(information)
        if not np.isfinite(std_percent).all():
            return np.inf
        return float(np.linalg.norm(std_percent, COST_NORM))


@takes()
def plan_moves(
    model: Model,
    limits: JointLimits,
    payload: Payload,
    nameplate: ArrayLike,
    *,
    urdf: str | None = None,
    duration_s: float = 40.0,
    seed: int = 0,
    exchanges: int = 1000,
    conditioning: Conditioning | None = None,
) -> PlannedMoves:
    """Choose moves that let the worst gain be known as well as the time allows,
    from limits and without a cell file.

    The moves are made twice: without load, and with the payload. Positions, velocities and
    accelerations keep the limits all the way, targets with a margin; torques keep the efforts of
    the URDF, where it has any. Obstacles and the arm itself are not known: look at the moves before
    a robot makes them.

    Args:
        model: the declared model of a serial robot; joints may follow axes (`<mimic>`).
        limits: of the axes. Joints that follow them must keep the limits of the URDF, too.
        payload: that will be mounted, with its known mass.
        nameplate: gains by the data sheet, shape (n,); their sizes decide how clearly a torque
            shows.
        urdf: text of the URDF with inertias and efforts; without it, links are rods of 5 kg.
        duration_s: of one run [s], dwells included.
        seed: the same seed gives the same moves.
        exchanges: tries; with 0 the random moves are the plan.
        conditioning: the filters of the fit; the usual ones when None.

    Returns:
        the moves, with the predicted standard deviation of each gain. It is a careful bound: it
        counts on a residual of 0.6 % of each motor's largest current that stays the same from row
        to row (correlation 0.67). Where the residual is the noise of currents alone, the fit has a
        third to a twelfth of this σ.

    Raises:
        ModelError: an argument is of another type or shape, a limit is none, a joint that follows
            an axis would go beyond its own limits, or the robot is a closed chain.
        PlanUnfit: the duration has no room for enough moves, or some gain does not show in them.
    """
    require_kind("model", model, Model, "write Model(robot, drive_train)")
    require_kind(
        "limits", limits, JointLimits, "write JointLimits(lower, upper, velocity, acceleration)"
    )
    require_kind("payload", payload, Payload, "write Payload(name, mounting, known)")
    if urdf is not None:
        require_kind("urdf", urdf, str, "give the text of the file: Path(...).read_text()")
    if conditioning is not None:
        require_kind("conditioning", conditioning, Conditioning, "write Conditioning()")
        require_settings(conditioning)
        require_cutoffs(conditioning)
    if model.robot.closures:
        names = ", ".join(closure.name for closure in model.robot.closures)
        raise ModelError(
            f"the model is of a closed chain (closures {names}): which positions its loops reach "
            "is not known here; expected a serial robot, whose joints may follow axes; choose its "
            "moves by hand"
        )
    count = model.robot.axis_count
    gains = as_gains("nameplate", nameplate, count)
    limits.require_size(count)
    _require_followers(model.robot, limits)
    duration_s = require_number(
        "duration_s", duration_s, above=0.0, remedy="give the time of one run, such as 40"
    )
    if duration_s > LONGEST_RUN_S:
        expected = f"at most {LONGEST_RUN_S:g} s for one run; plan several runs, with a seed each"
        raise ModelError(f"duration_s is {duration_s:g} s; expected {expected}")
    seed = require_count("seed", seed)
    exchanges = require_count("exchanges", exchanges)
    if conditioning is None:
        conditioning = Conditioning()
    search = _search_of(model, limits, payload, gains, urdf, conditioning)
    rng = np.random.default_rng(seed)
    random_moves = _random_moves(search, rng, duration_s)
    draft = _improved(search, random_moves, rng, duration_s, exchanges)
    predicted = search.design.std_percent(np.sum(draft.information, axis=0))
    unseen = np.flatnonzero(~np.isfinite(predicted))
    if len(unseen):
        names = ", ".join(model.robot.axes[axis].name for axis in unseen)
        raise PlanUnfit(
            found=f"gains that {len(draft.move_s)} moves do not show: {names}",
            expected="moves that show every gain",
            remedy="allow a longer `duration_s` or wider `limits`, or give a payload with a mass",
        )
    return PlannedMoves(
        target_rad=np.array(draft.target_rad),
        move_s=np.array(draft.move_s),
        dwell_s=DWELL_S,
        predicted_std_percent=predicted,
    )


def _require_followers(robot: Robot, limits: JointLimits) -> None:
    """Refuse limits of axes at which a joint that follows one goes beyond its own.

    Raises:
        ModelError: for the first such joint.
    """
    for beyond in followers_beyond(robot, limits.lower, limits.upper):
        axis = robot.axes[beyond.axis]
        joint = beyond.joint
        unit = "rad"
        if joint.kind is JointKind.PRISMATIC:
            unit = "m"
        least, largest = beyond.allowed
        first, last = beyond.axis_range
        raise ModelError(
            f"limits: joint {joint.name}, which follows {axis.name}, goes from "
            f"{beyond.reached[0]:.6g} to {beyond.reached[1]:.6g} {unit}; expected {least:.6g} to "
            f"{largest:.6g} {unit}, its limits in the URDF; give {axis.name} limits within "
            f"{first:.6g} to {last:.6g}"
        )


def _search_of(
    model: Model,
    limits: JointLimits,
    payload: Payload,
    gains: FloatArray,
    urdf: str | None,
    conditioning: Conditioning,
) -> _Search:
    """What moves of a nominal robot are judged by."""
    fast_motion = _fast_motion(limits)
    expected = nominal_payload(model.robot, payload)
    expectation, _ = nominal_expectation(model, urdf, gains, expected, limits, fast_motion)
    declared = declared_efforts(model, urdf)
    effort = believable_efforts(expectation, declared, fast_motion.position_rad, RUNS)
    row_s, edge_s = rows_between_rests(conditioning)
    design = Design(expectation, visible_base(model, fast_motion))
    return _Search(design, limits, effort, row_s, edge_s)


def _fast_motion(limits: JointLimits) -> Motion:
    """Random states as fast as the limits allow:
    which parameters there are does not depend on a plan's seed.
    """
    rng = np.random.default_rng(0)
    shape = (960, len(limits.lower))
    position = rng.uniform(limits.lower, limits.upper, shape)
    velocity = limits.velocity * rng.uniform(-1.0, 1.0, shape)
    acceleration = limits.acceleration * rng.uniform(-1.0, 1.0, shape)
    return Motion(position, velocity, acceleration)


def _move(
    search: _Search, start_rad: FloatArray, end_rad: FloatArray, speed_share: float
) -> tuple[float, FloatArray] | None:
    """Duration and information of a move; None where it cannot be made."""
    move_s = search.fastest_s(start_rad, end_rad) / speed_share
    information = search.information(start_rad, end_rad, move_s)
    if information is None:
        return None
    return move_s, information


def _random_moves(search: _Search, rng: np.random.Generator, duration_s: float) -> _Draft:
    """Fill the duration with random moves."""
    targets = [search.random_target(rng)]
    shares: list[float] = []
    moves_s: list[float] = []
    information: list[FloatArray] = []
    tries = 0  # since the last move that could be made
    while tries < MAX_TRIES:
        tries += 1
        start = targets[-1]
        target = search.random_target(rng, start)
        share = float(rng.uniform(SLOWEST_SHARE, 1.0))
        # Slow limits make moves of hours: one that has no room ends the filling before its rows are
        # built.
        if search.fastest_s(start, target) / share > duration_s:
            break
        move = _move(search, start, target, share)
        if move is None:
            continue
        move_s, own_information = move
        dwells_s = DWELL_S * (len(moves_s) + 1)
        if sum(moves_s) + move_s + dwells_s > duration_s:
            break
        targets.append(target)
        shares.append(share)
        moves_s.append(move_s)
        information.append(own_information)
        tries = 0
    if len(moves_s) < FEWEST_MOVES:
        raise PlanUnfit(
            found=f"room for {len(moves_s)} moves in {duration_s:g} s",
            expected=f"at least {FEWEST_MOVES}, and better 30",
            remedy="give a longer `duration_s`, higher `limits`, or the right efforts in the URDF",
        )
    return _Draft(tuple(targets), tuple(shares), tuple(moves_s), tuple(information))


def _improved(
    search: _Search, draft: _Draft, rng: np.random.Generator, duration_s: float, exchanges: int
) -> _Draft:
    """Exchange targets and speeds one at a time, and keep what lowers the deviations."""
    best = draft
    least_cost = search.cost(np.sum(best.information, axis=0))
    for _ in range(exchanges):
        proposal = _exchanged(search, best, rng, duration_s)
        if proposal is None or proposal.duration_s > duration_s:
            continue
        cost = search.cost(np.sum(proposal.information, axis=0))
        if cost < least_cost:
            best = proposal
            least_cost = cost
    return best


def _exchanged(
    search: _Search, draft: _Draft, rng: np.random.Generator, duration_s: float
) -> _Draft | None:
    """The same moves with another target, a near one or another speed;
    None where a move cannot be made.
    """
    changed = int(rng.integers(len(draft.target_rad)))
    kind = _Exchange(int(rng.integers(len(_Exchange))))
    targets = list(draft.target_rad)
    shares = list(draft.speed_share)
    moves_s = list(draft.move_s)
    information = list(draft.information)
    # The moves to this target and from it; the start has none to it, the last target none from it.
    touched = [move for move in (changed - 1, changed) if 0 <= move < len(moves_s)]
    if kind is _Exchange.ANYWHERE:
        start = None
        if changed:
            start = targets[changed - 1]
        targets[changed] = search.random_target(rng, start)
    elif kind is _Exchange.NEAR:
        targets[changed] = search.near_target(rng, targets[changed])
    else:
        shares[touched[0]] = float(rng.uniform(SLOWEST_SHARE, 1.0))
    for move in touched:
        start_rad = targets[move]
        end_rad = targets[move + 1]
        share = shares[move]
        if search.fastest_s(start_rad, end_rad) / share > duration_s:
            return None
        found = _move(search, start_rad, end_rad, share)
        if found is None:
            return None
        moves_s[move], information[move] = found
    return _Draft(tuple(targets), tuple(shares), tuple(moves_s), tuple(information))
