"""The schedule of a guided session: short blocks, bare and loaded in turn, until every gain is precise.

The first three blocks are bare, loaded, and loaded again but held out: with these, gains and their σ are known, and one
change of the payload is enough. Where they are not precise yet, blocks follow in pairs, loaded, bare, bare, loaded, so
that the means of the bare and of the loaded blocks lie at the same time. Friction that changes slowly as the arm gets
warm is then the same for both, and does not become gain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import count
from pathlib import Path

import numpy as np

from daq.config.cell_file import load_cell
from daq.config.policy import DEFAULT_TARGET_SIGMA_PERCENT
from daq.config.recalibration import PlannedRun
from daq.documents.session_state import Block, GainSoFar, GuidedState, Progress
from daq.errors import ConfigurationInconsistent, JobHeld, writing
from daq.jobs.block_check import compared_with, mistake_in
from daq.jobs.context import NextRun, SessionContext, before_motion
from daq.jobs.journal import Level
from daq.jobs.recording import log_of, move_without_log
from daq.jobs.session import Session
from daq.workflow.plan import Plan, load_plan, save_plan, slowed
from ident.errors import IdentificationError
from ident.estimators.estimate import Estimate

REHEARSAL_SPEED = 0.25  #: Share of the planned speed
MAX_REPETITIONS = 3  #: Of one block, before the session is held


class BlockRole(Enum):
    """What a block is for."""

    BARE = "bare"
    LOADED = "loaded"
    HELD_OUT = "held-out"


FIRST_BLOCKS = (BlockRole.BARE, BlockRole.LOADED, BlockRole.HELD_OUT)
NEXT_BLOCKS = (BlockRole.LOADED, BlockRole.BARE, BlockRole.BARE, BlockRole.LOADED)


def role_of(number: int) -> BlockRole:
    """Return the role of a block by its number from 0."""
    if number < len(FIRST_BLOCKS):
        return FIRST_BLOCKS[number]
    return NEXT_BLOCKS[(number - len(FIRST_BLOCKS)) % len(NEXT_BLOCKS)]


@dataclass(frozen=True, slots=True)
class GuidedSettings:
    """Limits and places of a guided session."""

    folder: Path  #: parent of the sessions
    payload: str  #: name of the body for the loaded blocks
    target_percent: float = DEFAULT_TARGET_SIGMA_PERCENT  #: σ of each gain at which the recording ends
    block_s: float = 20.0  #: duration of a block [s]
    time_limit_min: float = 30.0  #: motion after which the recording ends, precise or not [min]
    warm_up_min: float = 0.0
    retries: int = 1
    min_free_mb: float = 1000.0
    seed: int = 0
    keep_sessions: int = 20
    metrics: Path | None = None
    rehearse: bool = False  #: make the moves of the first blocks once at low speed


@dataclass(frozen=True, slots=True)
class UntilPrecise:
    """Blocks until the σ of every gain is at its target."""

    settings: GuidedSettings

    def prepare(self, context: SessionContext, session: Session) -> Session:
        """Forget blocks that were decided, but not recorded, and judge the others if that was not done."""
        state = guided(session)
        recorded = {run.name for run in state.runs}
        kept = tuple(block for block in state.blocks if block.name in recorded)
        has_lost = state.judged_blocks > len(kept)  # a log was damaged since
        session = session.update(
            blocks=kept,
            judged_blocks=0 if has_lost else state.judged_blocks,
            checked_blocks=min(state.checked_blocks, len(kept)),
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
        require_same_cell(context)
        number = _next_number(state)
        role = role_of(number)
        payload = None
        mass_kg = None
        if role is not BlockRole.BARE:
            payload = self.settings.payload
            mass_kg = state.mass_kg or context.operator.weigh(payload)
            session = session.update(mass_kg=mass_kg)
        block = Block(
            name=name_of(number),
            payload=payload,
            mass_kg=mass_kg,
            holdout=role is BlockRole.HELD_OUT,
            plan=plan_name(number),
        )
        plan = self.plan_block(context, number, session.folder / block.plan)
        # In the place of one that is recorded again.
        blocks = (*state.blocks[:number], block, *state.blocks[number:])
        session = session.update(blocks=blocks)
        return session, NextRun(_planned(session, block), plan)

    def after_run(self, context: SessionContext, session: Session) -> Session:
        """Look for mistakes in a block, then judge the gains.

        The session is complete when all gains are precise, or its time is up.

        Raises:
            JobHeld: a block has shown the same mistake too often.
        """
        return self._judged(context, self._checked(context, session))

    def _checked(self, context: SessionContext, session: Session) -> Session:
        """Look for mistakes in the block that was recorded last, and forget it if it is to be recorded again."""
        state = guided(session)
        recorded = len(state.blocks)
        if state.checked_blocks >= recorded:
            return session
        by_name = {block.name: block for block in state.blocks}
        in_order = [by_name[run.name] for run in state.runs]
        last = in_order[-1]
        earlier = [log_of(session, block.name) for block in compared_with(in_order)]
        facts = context.tools.look(context.cell, log_of(session, last.name), earlier)
        mistake = mistake_in(context.cell, in_order, facts)
        if mistake is None:
            if facts.added_kg is not None and last.payload is not None and compared_with(in_order)[-1].payload is None:
                context.journal.say(Level.INFO, "weighed", added_kg=facts.added_kg, std_kg=facts.added_std_kg)
            return session.update(checked_blocks=recorded)
        context.journal.say(Level.WARNING, "mistake in a block", block=last.name, text=mistake.text)
        if not context.operator.record_again(_planned(session, last), mistake.text):
            context.journal.say(Level.NOTICE, "kept as it is", block=last.name)
            return session.update(checked_blocks=recorded)
        repeated = (*state.repeated, *mistake.blocks)
        if repeated.count(last.name) > MAX_REPETITIONS:
            raise JobHeld(
                last.name,
                found=f"the same mistake in {MAX_REPETITIONS + 1} recordings: {mistake.text}",
                expected="a block without it",
                remedy="see to the flange and to the cell file; the same command goes on with this block",
            )
        blocks = tuple(block for block in state.blocks if block.name not in mistake.blocks)
        runs = tuple(run for run in state.runs if run.name not in mistake.blocks)
        return session.update(blocks=blocks, runs=runs, checked_blocks=len(blocks), repeated=repeated)

    def _judged(self, context: SessionContext, session: Session) -> Session:
        """Judge the gains by all blocks."""
        state = guided(session)
        recorded = len(state.blocks)
        if recorded < len(FIRST_BLOCKS) or state.judged_blocks == recorded:
            return session
        gains = self._gains(context, session)
        motion_s = recorded * self.settings.block_s
        progress = state.progress
        if gains:
            now = Progress(blocks=recorded, motion_s=motion_s, std_percent=tuple(gain.std_percent for gain in gains))
            progress = (*progress, now)
            context.journal.say(
                Level.INFO,
                "gains so far",
                gains=[gain.model_dump() for gain in gains],
                blocks=recorded,
                motion_s=motion_s,
                left_s=left_s(gains, motion_s),
            )
        precise = bool(gains) and all(gain.is_precise for gain in gains)
        is_time_up = motion_s >= 60.0 * self.settings.time_limit_min
        missing = "" if precise or not is_time_up else _missing(gains, self.settings.time_limit_min)
        return session.update(
            gains=gains,
            progress=progress,
            judged_blocks=recorded,
            complete=precise or is_time_up,
            missing=missing,
        )

    def plan_block(self, context: SessionContext, number: int, path: Path) -> Plan:
        """Make the moves of a block by its number from 0."""
        return plan_moves(context, name_of(number), path, self.settings.seed + number, self.settings.block_s)

    def _gains(self, context: SessionContext, session: Session) -> tuple[GainSoFar, ...]:
        """Return the gains of the blocks so far; none where they cannot be identified yet."""
        runs = self.runs(session)
        logs = [log_of(session, run.name) for run in runs if not run.holdout]
        unseen = [log_of(session, run.name) for run in runs if run.holdout]
        target_percent = self.settings.target_percent
        try:
            fitted = context.tools.fit(logs, holdout=unseen)
            gains = gains_so_far(context, fitted.estimate, target_percent)
            if all(gain.is_precise for gain in gains):
                return gains
            # What the model lacks is noise to it: a gain may be precise as soon as that is found.
            closed = context.tools.close_loop(fitted, self.settings.seed, lambda _: None)
            return gains_so_far(context, closed.estimate, target_percent)
        except IdentificationError as error:
            context.journal.say(Level.WARNING, "the blocks so far do not give the gains", text=str(error))
            return ()


@dataclass(frozen=True, slots=True)
class Rehearse:
    """Make the moves of the first blocks once, without load and slowly; no log of them stays.

    A person sees whether the arm stays clear of everything before it moves at full speed.
    """

    schedule: UntilPrecise
    speed: float = REHEARSAL_SPEED  #: share of the planned speed

    def run(self, context: SessionContext, session: Session) -> Session:
        """Go on after the last block that was rehearsed; do nothing where a block was recorded already.

        Raises:
            DaqError, DriverError: as from a recording.
        """
        if guided(session).rehearsed >= len(FIRST_BLOCKS) or session.state.runs:
            return session
        context = context.within("rehearse")
        before_motion(context)
        for number in range(guided(session).rehearsed, len(FIRST_BLOCKS)):
            path = session.folder / plan_name(number)
            plan = slowed(context.cell, self.schedule.plan_block(context, number, path), self.speed)
            planned = PlannedRun(name=f"rehearsal-{number + 1}", plan_file=path)
            context.operator.mount(planned)
            context.journal.say(Level.INFO, "rehearsing", speed=self.speed, seconds=plan.duration_s)
            move_without_log(context, session, NextRun(planned, plan), self.speed)
            session = session.update(rehearsed=number + 1)
        return session


def plan_name(number: int) -> str:
    """Return the file name of the moves of a block by its number from 0."""
    return f"plan-{number + 1}.yaml"


def name_of(number: int) -> str:
    """Return the name of a block by its number from 0."""
    return f"block-{number + 1}-{role_of(number).value}"


def _next_number(state: GuidedState) -> int:
    """Return the number of the first block that is not there."""
    names = {block.name for block in state.blocks}
    return next(number for number in count() if name_of(number) not in names)


def plan_moves(context: SessionContext, run: str, path: Path, seed: int, duration_s: float) -> Plan:
    """Make the moves of a run, their file, and a page that shows them.

    Raises:
        UsageError, ConfigurationInconsistent: there are no such moves.
        OutputFailed: the file system refuses.
    """
    context.journal.say(Level.INFO, "planning", seed=seed, duration_s=duration_s)
    with writing(path):
        save_plan(context.tools.plan(context.cell, seed=seed, duration_s=duration_s), path)
    plan = load_plan(path, context.cell)  # as a person can read it
    page = path.with_suffix(".html")
    with writing(page):
        context.tools.preview(context.cell, plan, path, page)
    context.journal.say(Level.NOTICE, "moves to look at", run=run, page=str(page))
    return plan


def require_same_cell(context: SessionContext) -> None:
    """Refuse a cell file that was changed since the session began; its next log would be of another cell.

    Raises:
        ConfigurationError: it was changed, or cannot be read any more.
    """
    found = load_cell(context.file).digest
    if found != context.cell.digest:
        raise ConfigurationInconsistent(
            str(context.file),
            found=f"another content (digest {found[:12]}) than at the start of this command",
            expected=f"the same cell in all blocks of a session (digest {context.cell.digest[:12]})",
            remedy="nothing moves; put the old content back and start the same command, which goes on, or start it "
            "with the new content, which begins a new session",
        )


def left_s(gains: Sequence[GainSoFar], motion_s: float) -> float:
    """Return the motion that is left until every gain is at its target, if σ falls as 1/√time [s]; 0 without gains."""
    ratios = [gain.std_percent / gain.target_percent for gain in gains]
    worst = max(ratios, default=0.0)
    return max(0.0, motion_s * (worst**2 - 1.0))


def gains_so_far(context: SessionContext, estimate: Estimate, target_percent: float) -> tuple[GainSoFar, ...]:
    """Return the gains of an estimate beside their target."""
    std_percent = 100.0 * np.abs(estimate.gains_std / estimate.gains)
    return tuple(
        GainSoFar(
            axis=axis.name,
            unit=axis.gain_unit,
            value=float(value),
            std_percent=float(std),
            target_percent=target_percent,
        )
        for axis, value, std in zip(context.cell.axes, estimate.gains, std_percent, strict=True)
    )


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
    listed = ", ".join(f"{gain.axis} {gain.std_percent:.2f} %" for gain in coarse)
    return f"σ after {minutes:g} min of motion: {listed}; the target is {coarse[0].target_percent:g} %"
