"""The schedule of a guided session: short blocks, bare and loaded in turn, until every gain is precise.

The first three blocks are bare, loaded, and loaded again but held out: with these, gains and their σ are known, and one
change of the payload is enough. Where they are not precise yet, blocks follow in pairs, loaded, bare, bare, loaded, so
that the means of the bare and of the loaded blocks lie at the same time. Friction that changes slowly as the arm gets
warm is then the same for both, and does not become gain.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np

from daq.config.recalibration import PlannedRun
from daq.documents.session_state import Block, GainSoFar, GuidedState
from daq.errors import ConfigurationInconsistent, writing
from daq.jobs.context import NextRun, SessionContext
from daq.jobs.journal import Level
from daq.jobs.recording import log_of
from daq.jobs.session import Session
from daq.workflow.plan import Plan, load_plan, save_plan
from ident.errors import IdentificationError
from ident.estimators.estimate import Estimate

TARGET_PERCENT = 0.5  #: σ of each gain at which a session ends, where the cell file names none
ACCEPTANCE_SEED = 900  #: Added to the seed of the session: moves that no block has made


class Role(Enum):
    """What a block is for."""

    BARE = "bare"
    LOADED = "loaded"
    HELD_OUT = "held-out"


FIRST_BLOCKS = (Role.BARE, Role.LOADED, Role.HELD_OUT)
NEXT_BLOCKS = (Role.LOADED, Role.BARE, Role.BARE, Role.LOADED)


def role_of(number: int) -> Role:
    """Return the role of a block by its number from 0."""
    if number < len(FIRST_BLOCKS):
        return FIRST_BLOCKS[number]
    return NEXT_BLOCKS[(number - len(FIRST_BLOCKS)) % len(NEXT_BLOCKS)]


@dataclass(frozen=True, slots=True)
class GuidedSettings:
    """Limits and places of a guided session."""

    folder: Path  #: parent of the sessions
    payload: str  #: name of the body for the loaded blocks
    target_percent: float = TARGET_PERCENT  #: σ of each gain at which the recording ends
    block_s: float = 20.0  #: duration of a block [s]
    time_limit_min: float = 30.0  #: motion after which the recording ends, precise or not [min]
    warm_up_min: float = 0.0
    retries: int = 1
    min_free_mb: float = 1000.0
    seed: int = 0
    keep_sessions: int = 20
    metrics: Path | None = None


@dataclass(frozen=True, slots=True)
class UntilPrecise:
    """Blocks until the σ of every gain is at its target."""

    settings: GuidedSettings

    def prepare(self, context: SessionContext, session: Session) -> Session:
        """Forget blocks that were decided, but not recorded, and judge the gains if that was not done."""
        state = guided(session)
        recorded = {run.name for run in state.runs}
        kept = tuple(block for block in state.blocks if block.name in recorded)
        return self.after_run(context, session.update(blocks=kept, complete=False))

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
        number = len(state.blocks)
        role = role_of(number)
        payload = None
        mass_kg = None
        if role is not Role.BARE:
            payload = self.settings.payload
            mass_kg = _mass_so_far(state) or context.operator.weigh(payload)
        block = Block(
            name=f"block-{number + 1}-{role.value}",
            payload=payload,
            mass_kg=mass_kg,
            holdout=role is Role.HELD_OUT,
            plan=f"plan-{number + 1}.yaml",
        )
        plan = self._plan(context, number, session.folder / block.plan)
        session = session.update(blocks=(*state.blocks, block))
        return session, NextRun(_planned(session, block), plan)

    def after_run(self, context: SessionContext, session: Session) -> Session:
        """Judge the gains after a block; the session is complete when all are precise, or its time is up."""
        state = guided(session)
        count = len(state.blocks)
        if count < len(FIRST_BLOCKS) or state.judged_blocks == count:
            return session
        gains = self._gains(context, session)
        for gain in gains:
            words = "precise" if gain.is_precise else "not yet"
            context.journal.say(
                Level.INFO,
                "gain so far",
                axis=gain.axis,
                value=gain.value,
                std_percent=round(gain.std_percent, 2),
                target_percent=gain.target_percent,
                verdict=words,
            )
        precise = bool(gains) and all(gain.is_precise for gain in gains)
        is_time_up = count * self.settings.block_s >= 60.0 * self.settings.time_limit_min
        missing = "" if precise or not is_time_up else _missing(gains, self.settings.time_limit_min)
        return session.update(gains=gains, judged_blocks=count, complete=precise or is_time_up, missing=missing)

    def _plan(self, context: SessionContext, number: int, path: Path) -> Plan:
        """Make the moves of a block."""
        seed = self.settings.seed + number
        context.journal.say(Level.INFO, "planning", seed=seed, duration_s=self.settings.block_s)
        with writing(path):
            save_plan(context.tools.plan(context.cell, seed=seed, duration_s=self.settings.block_s), path)
        return load_plan(path, context.cell)  # as a person can read it

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


def _mass_so_far(state: GuidedState) -> float | None:
    """Return the mass that was read from the scale in this session [kg]; None before the first loaded block."""
    return next((block.mass_kg for block in state.blocks if block.mass_kg is not None), None)


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
