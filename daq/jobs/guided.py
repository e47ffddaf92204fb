"""The schedule of a guided session: short blocks, bare and loaded, until every gain is precise.

The first blocks are bare, then one is loaded, and one loaded but held out: with these, gains and
their σ are known, and one change of the payload is enough. `block_order` says how many are bare,
and which kind comes next.

The moves are for all gains until these are known. Those of every later block are for the gain that
is farthest from its target by then. From the fourth block on, moves stay inside the room and the
speed of the first three, which the operator has looked at.

Where a block of the asked duration has no room for enough moves, it takes longer, and so do all
later ones.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.config.policy import DEFAULT_TARGET_SIGMA_PERCENT
from daq.config.recalibration import PlannedRun
from daq.documents.session_state import Block, GainSoFar, GuidedState, Outcome, Progress
from daq.errors import ConfigurationError, ConfigurationInconsistent, JobHeld, PlanTooShort, writing
from daq.jobs.block_check import compared_with, mistake_in
from daq.jobs.block_order import (
    FIRST_BLOCKS,
    BlockRole,
    BlocksSoFar,
    bare_blocks_first,
    first_blocks,
    fixed_role,
    next_role,
    quickest_way,
)
from daq.jobs.context import NextRun, SessionContext, before_motion
from daq.jobs.journal import Level
from daq.jobs.position import goes_on_with
from daq.jobs.recording import log_of, move_without_log
from daq.jobs.session import Session
from daq.workflow.accepted_room import AcceptedRoom, accepted_room
from daq.workflow.diagnoses import geometry_refusal
from daq.workflow.experiment import Experiment, experiment_of
from daq.workflow.outlook import Outlook, help_with, outlook_of
from daq.workflow.plan import Plan, load_plan, save_plan, slowed
from ident.errors import ChannelsExchanged, Diagnosis, GeometryTurned, IdentificationError
from ident.estimators.estimate import Estimate
from ident.planning.target import time_to_target

REHEARSAL_SPEED = 0.25  #: Share of the planned speed
MOST_DOUBLINGS = 3  #: Of the duration of blocks, where the asked one has no room for enough moves
MAX_REPETITIONS = 3  #: Of one block, before the session stops and waits
CORRECTED = "corrected.yaml"  #: Calibration of the blocks of a session by a corrected cell file


@dataclass(frozen=True, slots=True)
class GuidedSettings:
    """Limits and places of a guided session."""

    folder: Path  #: parent of the sessions
    payload: str  #: name of the body for the loaded blocks
    #: σ of each gain at which the recording ends
    target_percent: float = DEFAULT_TARGET_SIGMA_PERCENT
    #: duration of a block [s]; where it has no room for enough moves, blocks are longer
    block_s: float = 20.0
    time_limit_min: float = 30.0  #: motion after which the recording ends, precise or not [min]
    warm_up_min: float = 0.0
    retries: int = 1
    min_free_mb: float = 1000.0
    seed: int = 0
    keep_sessions: int = 20
    metrics: Path | None = None
    rehearse: bool = False  #: make the moves of the first blocks once at low speed


@dataclass(frozen=True, slots=True, eq=False)
class BlockEstimate:
    """What the blocks so far say of the gains."""

    gains: tuple[GainSoFar, ...]  #: empty where they cannot be identified yet
    outlook: Outlook | None = None  #: None where every gain is precise, or none is known

    @property
    def worst(self) -> GainSoFar:
        """The gain that is farthest from its target."""
        return max(self.gains, key=lambda gain: gain.std_percent / gain.target_percent)


@dataclass(frozen=True, slots=True)
class UntilPrecise:
    """Blocks until the σ of every gain is at its target."""

    settings: GuidedSettings

    def prepare(self, context: SessionContext, session: Session) -> Session:
        """Forget blocks that were decided, but not recorded,
        and judge the others if that was not done.

        Raises:
            ConfigurationInconsistent: its blocks carry another payload than is asked for.
        """
        state = guided(session)
        _require_same_payload(state, self.settings.payload)
        recorded = {run.name for run in state.runs}
        blocks = tuple(block for block in state.blocks if block.name in recorded)
        has_lost = state.judged_blocks > len(blocks)  # a log was damaged since
        judged_blocks = state.judged_blocks
        if has_lost:
            judged_blocks = 0
        session = session.update(
            blocks=blocks,
            judged_blocks=judged_blocks,
            checked_blocks=min(state.checked_blocks, len(blocks)),
            complete=False,
            repeated=(),
        )
        return self.after_run(context, session)

    def runs(self, session: Session) -> tuple[PlannedRun, ...]:
        """Return the blocks so far."""
        state = guided(session)
        return tuple(_planned(session, block) for block in state.blocks)

    def is_complete(self, session: Session) -> bool:
        """Whether the recording has ended, and its blocks are all there."""
        state = guided(session)
        recorded = {run.name for run in state.runs}
        return state.complete and all(block.name in recorded for block in state.blocks)

    def next_run(self, context: SessionContext, session: Session) -> tuple[Session, NextRun | None]:
        """Decide the next block; its moves are planned and written before it begins."""
        state = guided(session)
        if state.complete:
            return session, None
        require_same_cell(context, session)
        number = _next_number(state)
        role = self._role_of(context, state, state.gains, number)
        name = name_of(number, role)
        payload = None
        mass_kg = None
        if role is not BlockRole.BARE:
            payload = self.settings.payload
            mass_kg = state.mass_kg or context.operator.weigh(payload)
            session = session.update(mass_kg=mass_kg)
        path = session.folder / plan_name(number)
        if number < len(FIRST_BLOCKS):
            session, plan = self._rehearsed_plan(context, session, name, number, path)
            session = session.update(
                bare_first=self._bare_first(context, guided(session), plan, number)
            )
        else:
            session, plan = self._later_plan(context, session, number, path)
            say_moves(context, name, path)
        block = Block(
            name=name,
            payload=payload,
            mass_kg=mass_kg,
            holdout=role is BlockRole.HELD_OUT,
            plan=path.name,
            duration_s=self.block_s(guided(session)),
        )
        # In the place of one that is recorded again.
        blocks = (*state.blocks[:number], block, *state.blocks[number:])
        session = session.update(blocks=blocks)
        return session, NextRun(_planned(session, block), plan)

    def block_s(self, state: GuidedState) -> float:
        """Duration of the blocks that are to come [s]."""
        return max(self.settings.block_s, state.block_s)

    def _role_of(
        self, context: SessionContext, state: GuidedState, gains: Sequence[GainSoFar], number: int
    ) -> BlockRole:
        """Return the role of the next block.

        Args:
            context: of the session.
            state: with the blocks before it.
            gains: by these blocks; empty where they are not known yet.
            number: of the block, from 0.
        """
        if not context.cell.friction_by_payload:
            return fixed_role(number)
        first = first_blocks(state.bare_first)
        if number < len(first):
            return first[number]
        if not gains:
            return fixed_role(number)
        mounted = {block.name: block.payload is not None for block in state.blocks}
        recorded = [run.name for run in state.runs if run.name in mounted]
        so_far = blocks_so_far(state.blocks, is_mounted=mounted[recorded[-1]])
        block_s = self.block_s(state)
        until_limit_s = 60.0 * self.settings.time_limit_min - motion_s(
            state.blocks, self.settings.block_s
        )
        most = max(1, math.floor(until_limit_s / block_s))
        way = quickest_way(so_far, _variance_ratio(gains), block_s, most)
        return next_role(so_far, way)

    def _bare_first(
        self, context: SessionContext, state: GuidedState, plan: Plan, number: int
    ) -> int:
        """Return how many bare blocks come before the first one with the payload,
        by what the first plan predicts.
        """
        predicted_percent = plan.predicted_std_percent
        if number or not context.cell.friction_by_payload or not predicted_percent:
            return state.bare_first
        worst = max(predicted_percent) / self.settings.target_percent
        blocks_in_time = math.floor(60.0 * self.settings.time_limit_min / self.block_s(state))
        return bare_blocks_first(worst**2, blocks_in_time)

    def after_run(self, context: SessionContext, session: Session) -> Session:
        """Look for mistakes in a block, then judge the gains.

        The session is complete when all gains are precise, or its time is up.

        Raises:
            ChannelsExchanged, GeometryTurned: the blocks show another cell than described; they are
                kept, and the session is over.
            JobHeld: a block was recorded again too often because of a mistake.
        """
        try:
            return self._judged(context, self._checked(context, session))
        except (ChannelsExchanged, GeometryTurned):
            session.update(outcome=Outcome.UNFIT)  # the same blocks would be refused again
            raise

    def _checked(self, context: SessionContext, session: Session) -> Session:
        """Look for mistakes in the block that was recorded last,
        and forget it if it is to be recorded again.
        """
        state = guided(session)
        recorded = len(state.blocks)
        if state.checked_blocks >= recorded:
            return session
        by_name = {block.name: block for block in state.blocks}
        in_order = [by_name[run.name] for run in state.runs]
        last = in_order[-1]
        earlier = [log_of(session, block.name) for block in compared_with(in_order)]
        facts = context.tools.look(context.cell, log_of(session, last.name), earlier)
        mistake = mistake_in(context.cell, self.settings.payload, in_order, facts, state.repeated)
        if mistake is None:
            if (
                facts.added_kg is not None
                and last.payload is not None
                and compared_with(in_order)[-1].payload is None
            ):
                context.journal.say(
                    Level.INFO, "weighed", added_kg=facts.added_kg, std_kg=facts.added_std_kg
                )
            return session.update(checked_blocks=recorded)
        if mistake.is_of_body:
            logs = [log_of(session, block.name) for block in in_order]
            turned = context.tools.geometry(context.cell, logs)
            _refuse_geometry(() if turned is None else (turned,))
        context.journal.say(Level.WARNING, "mistake in a block", block=last.name, text=mistake.text)
        # A block that no fit can use is not kept: with it, the session could not go on.
        is_again = bool(facts.unreadable) or context.operator.record_again(
            _planned(session, last), mistake.blocks, mistake.text
        )
        if not is_again:
            context.journal.say(Level.NOTICE, "kept as it is", block=last.name)
            return session.update(checked_blocks=recorded)
        repeated = (*state.repeated, *mistake.blocks)
        if repeated.count(last.name) > MAX_REPETITIONS:
            raise JobHeld(
                last.name,
                found=f"a mistake in {MAX_REPETITIONS + 1} recordings; the last one: "
                f"{mistake.text}",
                expected="a block without it",
                remedy="see to the flange and to the cell file; the same command goes on with "
                "this block",
            )
        blocks = tuple(block for block in state.blocks if block.name not in mistake.blocks)
        runs = tuple(run for run in state.runs if run.name not in mistake.blocks)
        return session.update(
            blocks=blocks, runs=runs, checked_blocks=len(blocks), repeated=repeated
        )

    def _judged(self, context: SessionContext, session: Session) -> Session:
        """Judge the gains by all blocks, and plan the next one for the worst gain."""
        state = guided(session)
        recorded = len(state.blocks)
        if recorded < len(first_blocks(state.bare_first)) or state.judged_blocks == recorded:
            return session
        estimate = self._estimate(context, session)
        gains = estimate.gains
        moved_s = motion_s(state.blocks, self.settings.block_s)
        fitted_s = motion_s(_fitted(state.blocks), self.settings.block_s)
        left_s = motion_left_s(context.cell, gains, state.blocks, self.settings.block_s)
        progress = state.progress
        if gains:
            std_percent = tuple(gain.std_percent for gain in gains)
            now = Progress(
                blocks=recorded, motion_s=moved_s, fitted_s=fitted_s, std_percent=std_percent
            )
            progress = (*progress, now)
            context.journal.say(
                Level.INFO,
                "gains so far",
                gains=[gain.model_dump() for gain in gains],
                blocks=recorded,
                motion_s=moved_s,
                left_s=left_s,
            )
        has_held_out = any(block.holdout for block in state.blocks)
        is_precise = bool(gains) and all(gain.is_precise for gain in gains) and has_held_out
        is_time_up = moved_s >= 60.0 * self.settings.time_limit_min
        missing = ""
        would_help: tuple[str, ...] = ()
        if is_time_up and not is_precise:
            missing = _missing(gains, self.settings.time_limit_min)
            would_help = _would_help(estimate, moved_s + left_s)
            context.journal.say(Level.NOTICE, "time is up", missing=missing, would_help=would_help)
        elif not is_precise:
            session = self._plan_next(context, session, estimate)
        return session.update(
            gains=gains,
            progress=progress,
            judged_blocks=recorded,
            complete=is_precise or is_time_up,
            missing=missing,
            would_help=would_help,
        )

    def _plan_next(
        self, context: SessionContext, session: Session, estimate: BlockEstimate
    ) -> Session:
        """Plan the next block for the worst gain;
        nothing is planned where the gains are not known yet.
        """
        outlook = estimate.outlook
        number = _next_number(guided(session))
        if outlook is None or number < len(first_blocks(guided(session).bare_first)):
            return session
        experiment = experiment_of(context.cell, self.settings.payload)
        room = self._accepted_room(context, session, experiment)
        role = self._role_of(context, guided(session), estimate.gains, number)
        is_loaded = role is not BlockRole.BARE
        session, made = self._with_room(
            context,
            session,
            number,
            outlook.experiment(experiment, is_loaded=is_loaded, room=room),
            room,
            # More moves never make what is known worse.
            largest_condition=np.inf,
            largest_std_percent=np.inf,
            goal=outlook.goal(self.settings.target_percent),
        )
        worst = estimate.worst
        axis = context.cell.axis_names.index(worst.axis)
        predicted_percent = float(outlook.scale[axis]) * made.predicted_std_percent[axis]
        purpose = (
            f"the gain that is farthest from its target after {len(guided(session).blocks)} "
            f"blocks: {worst.axis}, ± {worst.std_percent:.2f} % (target {worst.target_percent:g} "
            f"%). With these moves ± {predicted_percent:.2f} % is predicted. They stay between the "
            "joint positions of the first blocks, and are no faster."
        )
        write_plan(context, session.folder / plan_name(number), replace(made, purpose=purpose))
        return session

    def _later_plan(
        self, context: SessionContext, session: Session, number: int, path: Path
    ) -> tuple[Session, Plan]:
        """Load the moves that were planned for the worst gain;
        where there are none, make some for all gains.
        """
        with suppress(ConfigurationError):  # what is missing or damaged is made again
            return session, load_plan(path, context.cell)
        return self._unaimed_plan(context, session, number, path)

    def _unaimed_plan(
        self, context: SessionContext, session: Session, number: int, path: Path
    ) -> tuple[Session, Plan]:
        """Make moves for all gains, inside the room of the first blocks."""
        experiment = experiment_of(context.cell, self.settings.payload)
        room = self._accepted_room(context, session, experiment)
        inside = replace(experiment, scene=room.scene(experiment.scene))
        session, made = self._with_room(context, session, number, inside, room)
        return session, write_plan(context, path, made)

    def _with_room(
        self,
        context: SessionContext,
        session: Session,
        number: int,
        experiment: Experiment,
        accepted: AcceptedRoom | None = None,
        **further: Any,
    ) -> tuple[Session, Plan]:
        """Make the moves of a block; where they have to be longer, those of later blocks are, too.

        Args:
            context: of the session.
            session: with the length of its blocks.
            number: of the block, from 0.
            experiment: that the moves are for.
            accepted: room and speed that they keep; None for the first blocks.
            **further: arguments of the planner.
        """
        if accepted is not None:
            further |= {
                "speed": accepted.speed,
                "acceleration": accepted.acceleration,
                "box": accepted.box,
            }
        block_s = self.block_s(guided(session))
        plan, taken_s = plan_with_room(
            context, experiment, self.settings.seed + number, block_s, **further
        )
        if taken_s > block_s:
            session = session.update(block_s=taken_s)
        return session, plan

    def _accepted_room(
        self, context: SessionContext, session: Session, experiment: Experiment
    ) -> AcceptedRoom:
        """Return room and speed of the first blocks, which the operator has looked at before they
        were recorded.

        Raises:
            ConfigurationInconsistent: none of their plans can be read any more.
        """
        plans = []
        for number in range(len(FIRST_BLOCKS)):
            # The room of the others is smaller, and was accepted, too
            with suppress(ConfigurationError):
                plans.append(load_plan(session.folder / plan_name(number), context.cell))
        if not plans:
            raise ConfigurationInconsistent(
                str(session.folder),
                found="no plan of the first blocks that can be read",
                expected="plan-1.yaml, plan-2.yaml or plan-3.yaml: later moves stay inside the "
                "room of these",
                remedy="nothing moves; put one of them back, or begin a new session in another "
                "folder (--sessions)",
            )
        return accepted_room(context.cell, experiment.scene, plans)

    def _rehearsed_plan(
        self, context: SessionContext, session: Session, name: str, number: int, path: Path
    ) -> tuple[Session, Plan]:
        """Load the moves of one of the first blocks if they were rehearsed; else make them.

        A later rehearsal may have found that blocks have to be longer: what the operator has seen
        stays as it is.
        """
        if number < guided(session).rehearsed:
            with suppress(ConfigurationError):  # what is missing or damaged is made again
                plan = load_plan(path, context.cell)
                say_moves(context, name, path)
                return session, plan
        return self.plan_block(context, session, name, number, path)

    def plan_block(
        self, context: SessionContext, session: Session, name: str, number: int, path: Path
    ) -> tuple[Session, Plan]:
        """Make the moves of one of the first blocks by its name, and its number from 0."""
        experiment = experiment_of(context.cell, self.settings.payload)
        session, made = self._with_room(context, session, number, experiment)
        plan = write_plan(context, path, made)
        say_moves(context, name, path)
        return session, plan

    def _estimate(self, context: SessionContext, session: Session) -> BlockEstimate:
        """Estimate the gains of the blocks so far; none where they cannot be identified yet.

        Raises:
            ChannelsExchanged, GeometryTurned: no further block helps.
        """
        runs = self.runs(session)
        logs = [log_of(session, run.name) for run in runs if not run.holdout]
        unseen = [log_of(session, run.name) for run in runs if run.holdout]
        target_percent = self.settings.target_percent
        try:
            fitted = context.tools.fit(logs, holdout=unseen)
            _refuse_geometry(fitted.diagnoses)
            gains = gains_so_far(context, fitted.estimate, target_percent)
            if all(gain.is_precise for gain in gains):
                return BlockEstimate(gains)
            # What the model lacks is noise to it: a gain may be precise as soon as that is found.
            closed = context.tools.close_loop(fitted, self.settings.seed, lambda _: None)
            gains = gains_so_far(context, closed.estimate, target_percent)
        except (ChannelsExchanged, GeometryTurned):
            raise
        except IdentificationError as error:
            context.journal.say(
                Level.WARNING, "the blocks so far do not give the gains", text=str(error)
            )
            return BlockEstimate(())
        std_percent = np.array([gain.std_percent for gain in gains])
        outlook = outlook_of(
            fitted, experiment_of(context.cell, self.settings.payload), std_percent
        )
        explained = []
        for gain, cause in zip(gains, outlook.causes, strict=True):
            explained.append(gain.model_copy(update={"cause": cause.value}))
        return BlockEstimate(tuple(explained), outlook)


@dataclass(frozen=True, slots=True)
class Rehearse:
    """Make the moves of the first blocks once, without load and slowly; no log of them stays.

    A person sees whether the arm stays clear of everything before it moves at full speed.
    """

    schedule: UntilPrecise

    def run(self, context: SessionContext, session: Session) -> Session:
        """Go on after the last block that was rehearsed;
        do nothing where a block was recorded already.

        Raises:
            DaqError, DriverError: as from a recording.
        """
        if guided(session).rehearsed >= len(FIRST_BLOCKS) or session.state.runs:
            return session
        context = context.within("rehearse")
        before_motion(context)
        for number in range(guided(session).rehearsed, len(FIRST_BLOCKS)):
            path = session.folder / plan_name(number)
            planned = PlannedRun(name=f"rehearsal-{number + 1}", plan_file=path)
            session, moves = self.schedule.plan_block(context, session, planned.name, number, path)
            plan = slowed(context.cell, moves, REHEARSAL_SPEED)
            context.operator.mount(planned)
            context.journal.say(
                Level.INFO, "rehearsing", speed=REHEARSAL_SPEED, seconds=plan.duration_s
            )
            move_without_log(context, session, NextRun(planned, plan), REHEARSAL_SPEED)
            session = session.update(rehearsed=number + 1)
        return session


def plan_name(number: int) -> str:
    """Return the file name of the moves of a block by its number from 0."""
    return f"plan-{number + 1}.yaml"


def name_of(number: int, role: BlockRole) -> str:
    """Return the name of a block by its number from 0."""
    return f"block-{number + 1}-{role.value}"


def _next_number(state: GuidedState) -> int:
    """Return the number of the first block that is not there."""
    taken = {int(block.name.split("-")[1]) - 1 for block in state.blocks}
    return next(number for number in count() if number not in taken)


def _require_same_payload(state: GuidedState, payload: str) -> None:
    """Refuse to go on with another body on the flange than in the blocks so far.

    Raises:
        ConfigurationInconsistent: names both.
    """
    mounted = {block.payload for block in state.blocks if block.payload is not None}
    others = sorted(mounted - {payload})
    if others:
        raise ConfigurationInconsistent(
            f"payload {payload!r}",
            found=f"a session whose blocks carry {others[0]!r}",
            expected="the same payload in all loaded blocks of a session",
            remedy=f"nothing moves; pass --payload {others[0]} to go on, or begin a new session in "
            "another folder (--sessions)",
        )


def _refuse_geometry(diagnoses: Sequence[Diagnosis]) -> None:
    """Refuse blocks in a geometry that is far from the described one.

    Raises:
        GeometryTurned: with the words of the diagnosis.
    """
    refused = geometry_refusal(diagnoses)
    if refused is not None:
        raise refused


def plan_with_room(
    context: SessionContext, experiment: Experiment, seed: int, duration_s: float, **further: Any
) -> tuple[Plan, float]:
    """Make a plan, of twice the duration where it has no room for enough moves, and so on;
    return both.

    Args:
        context: of the session.
        experiment: that the moves are for.
        seed: of the moves.
        duration_s: asked for.
        **further: arguments of the planner.

    Raises:
        PlanTooShort: even the longest one has no room.
        UsageError, ConfigurationInconsistent: there are no such moves.
    """
    make = partial(context.tools.plan, context.cell, seed=seed, experiment=experiment, **further)
    longest_s = duration_s * 2.0**MOST_DOUBLINGS
    taken_s = duration_s
    while True:
        context.journal.say(Level.INFO, "planning", seed=seed, duration_s=taken_s)
        try:
            return make(duration_s=taken_s), taken_s
        except PlanTooShort as error:
            if taken_s >= longest_s:
                raise
            short_s = taken_s
            taken_s = 2.0 * short_s
            context.journal.say(
                Level.NOTICE,
                "longer blocks",
                asked_s=short_s,
                found=error.found,
                expected=error.expected,
                duration_s=taken_s,
            )


def write_plan(context: SessionContext, path: Path, made: Plan) -> Plan:
    """Write the moves of a run, and a page that shows them; return them as a person can read them.

    Raises:
        OutputFailed: the file system refuses.
    """
    with writing(path):
        save_plan(made, path)
    plan = load_plan(path, context.cell)
    page = path.with_suffix(".html")
    with writing(page):
        context.tools.preview(context.cell, plan, path, page)
    return plan


def say_moves(context: SessionContext, run: str, path: Path) -> None:
    """Say where the page is that shows the moves of a run."""
    context.journal.say(
        Level.NOTICE, "moves to look at", run=run, page=str(path.with_suffix(".html"))
    )


def next_step_after(error: BaseException, cell_file: Path, session: Session) -> str:
    """Say what to do after an error in a guided session, and what the same command then does.

    Empty where the session is over, and the error itself says what to do.
    """
    if isinstance(error, ChannelsExchanged):
        return "correct the wiring or the cell file; the same command then begins a new session"
    if isinstance(error, GeometryTurned):
        command = fit_corrected_command(cell_file, session)
        refit = ""
        if command:
            refit = f"`{command}` then fits these blocks with it, and "
        return f"correct the cell file; {refit}the same command begins a new session"
    state = guided(session)
    if state.outcome in (Outcome.UNFIT, Outcome.REFUSED):
        return ""
    return go_on(state)


def go_on(state: GuidedState) -> str:
    """Say how to go on with a session that an error, or its operator, has interrupted."""
    start = "remove the cause, then start the same command"
    if state.outcome is Outcome.INTERRUPTED:
        start = "start the same command"
    return f"{start}: {goes_on_with(state)}"


def fit_corrected_command(cell_file: Path, session: Session) -> str:
    """Return the command that fits the recorded blocks with a corrected cell file.

    Empty as long as no block of the fit carries the payload.
    """
    state = guided(session)
    recorded = {run.name for run in state.runs}
    blocks = [block for block in state.blocks if block.name in recorded]
    used = [block for block in blocks if not block.holdout]
    if all(block.payload is None for block in used):
        return ""
    words: list[object] = ["drivegain", "residual"]
    words += [log_of(session, block.name) for block in used]
    for block in blocks:
        if block.holdout:
            words += ["--holdout", log_of(session, block.name)]
    words += ["--cell", cell_file, "--out", session.folder / CORRECTED]
    return shlex.join(map(str, words))


def require_same_cell(context: SessionContext, session: Session) -> None:
    """Refuse a cell file that was changed since the session began;
    its next log would be of another cell.

    Raises:
        ConfigurationError: it was changed, or cannot be read any more.
    """
    found = load_cell(context.file).digest
    if found != context.cell.digest:
        command = fit_corrected_command(context.file, session)
        refit = ""
        if command:
            refit = (
                f". The recorded blocks are not lost: `{command}` fits them with the new content"
            )
        expected = f"the same cell in all blocks of a session (digest {context.cell.digest[:12]})"
        raise ConfigurationInconsistent(
            str(context.file),
            found=f"another content (digest {found[:12]}) than at the start of this command",
            expected=expected,
            remedy="nothing moves; put the old content back and start the same command, which goes "
            f"on, or start it with the new content, which begins a new session{refit}",
        )


def motion_left_s(
    cell: Cell, gains: Sequence[GainSoFar], blocks: Sequence[Block], block_s: float
) -> float:
    """Return the motion that is left until every gain is at its target [s];
    0 where it is, or nothing is known.

    Args:
        cell: with its model of friction, which the order of the blocks depends on.
        gains: so far.
        blocks: that they are from.
        block_s: duration of a block that was asked for [s].
    """
    if not gains:
        return 0.0
    if not cell.friction_by_payload:
        fitted_s = motion_s(_fitted(blocks), block_s)
        std_percent = np.array([gain.std_percent for gain in gains])
        target_percent = np.array([gain.target_percent for gain in gains])
        return time_to_target(std_percent, target_percent, fitted_s).longest_s
    ratio = _variance_ratio(gains)
    if ratio <= 1.0:
        return 0.0
    if not math.isfinite(ratio):
        return math.inf
    so_far = blocks_so_far(blocks, is_mounted=blocks[-1].payload is not None)
    last_s = blocks[-1].duration_s or block_s
    return last_s * quickest_way(so_far, ratio, last_s).count


def motion_s(blocks: Sequence[Block], block_s: float) -> float:
    """Return the motion of blocks [s].

    Args:
        blocks: of the session.
        block_s: duration of those that do not say it [s].
    """
    return sum(block.duration_s or block_s for block in blocks)


def _fitted(blocks: Sequence[Block]) -> list[Block]:
    return [block for block in blocks if not block.holdout]


def blocks_so_far(blocks: Sequence[Block], *, is_mounted: bool) -> BlocksSoFar:
    """Count the blocks of the fit."""
    loads = [block.payload is not None for block in blocks if not block.holdout]
    return BlocksSoFar(loads.count(False), loads.count(True), is_mounted=is_mounted)


def _variance_ratio(gains: Sequence[GainSoFar]) -> float:
    """σ² of the worst gain over that of its target."""
    return max((gain.std_percent / gain.target_percent) ** 2 for gain in gains)


def gains_so_far(
    context: SessionContext, estimate: Estimate, target_percent: float
) -> tuple[GainSoFar, ...]:
    """Return the gains of an estimate with their target."""
    std_percent = 100.0 * np.abs(estimate.gains_std / estimate.gains)
    gains = []
    for axis, value, std in zip(context.cell.axes, estimate.gains, std_percent, strict=True):
        gain = GainSoFar(
            axis=axis.name,
            unit=axis.gain_unit,
            value=float(value),
            std_percent=float(std),
            target_percent=target_percent,
        )
        gains.append(gain)
    return tuple(gains)


def guided(session: Session) -> GuidedState:
    """Return the state of a guided session.

    Raises:
        ConfigurationInconsistent: it is that of a scheduled job.
    """
    if not isinstance(session.state, GuidedState):
        raise ConfigurationInconsistent(
            str(session.folder),
            found="the session of a scheduled job",
            expected="one of `drivegain calibrate`",
            remedy="name another folder for the sessions",
        )
    return session.state


def _planned(session: Session, block: Block) -> PlannedRun:
    return PlannedRun(
        name=block.name,
        payload=block.payload,
        mass_kg=block.mass_kg,
        plan_file=session.folder / block.plan,
        holdout=block.holdout,
    )


def _missing(gains: tuple[GainSoFar, ...], minutes: float) -> str:
    """Say what was not reached in the time."""
    if not gains:
        return f"the gains cannot be identified from {minutes:g} min of motion"
    coarse = [gain for gain in gains if not gain.is_precise]
    if not coarse:
        return f"a held-out block in {minutes:g} min of motion; every gain is at its target"
    listed = ", ".join(f"{gain.axis} {gain.std_percent:.2f} %" for gain in coarse)
    return (
        f"σ after {minutes:g} min of motion: {listed}; the target is {coarse[0].target_percent:g} %"
    )


def _would_help(estimate: BlockEstimate, needed_s: float) -> tuple[str, ...]:
    """Say what would help to reach the target:
    more time, and for each axis what its slowness comes from.

    Args:
        estimate: of the blocks so far.
        needed_s: motion of the whole session until every gain is at its target [s].
    """
    if not estimate.gains:
        return ("see above why the gains are not known; correct that, and record again",)
    found: list[str] = []
    if math.isfinite(needed_s):
        needed_min = math.ceil(needed_s / 60.0)
        found.append(
            f"more time: about {needed_min} min of motion in all at this rate "
            f"(--time-limit {needed_min})"
        )
    if estimate.outlook is None:
        return tuple(found)
    for gain, cause in zip(estimate.gains, estimate.outlook.causes, strict=True):
        if gain.is_precise:
            continue
        remedy = help_with(cause, gain.axis)
        text = f"{gain.axis}: {cause.value}"
        if remedy:
            text += f"; {remedy}"
        found.append(text)
    return tuple(found)
