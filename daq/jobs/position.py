"""Where a guided session is: its stage, the next step of the operator, and how σ falls.

For terminal and console.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from daq.config.recalibration import PlannedRun
from daq.documents.session_state import Block, GuidedState, Outcome


class StageName(Enum):
    """Stages of a guided session."""

    RECORD = "record"
    IDENTIFY = "identify"
    WRITE = "write"
    ACCEPT = "accept"
    ENDED = "ended"


@dataclass(frozen=True, slots=True)
class Position:
    """Where a session is."""

    stage: StageName
    next_step: str  #: what happens next, and what the operator does for it


def sessions_folder(cell_file: Path) -> Path:
    """Return the folder of the guided sessions of a cell, where none was named."""
    return cell_file.with_suffix(SESSIONS_SUFFIX)


SESSIONS_SUFFIX = ".sessions"


def former_session_folders(cell_file: Path) -> tuple[Path, ...]:
    """Return the folders next to a cell file that have sessions of a cell file of another name.

    A cell file that was renamed leaves its sessions behind, under its earlier name. Where there is
    a cell file of that name, the sessions are its own.
    """
    found = []
    for folder in sorted(cell_file.parent.glob(f"*{SESSIONS_SUFFIX}")):
        owners = [folder.with_suffix(suffix) for suffix in (".yaml", ".yml")]
        is_owned = any(owner.exists() for owner in owners)
        if folder.is_dir() and folder != sessions_folder(cell_file) and not is_owned:
            found.append(folder)
    return tuple(found)


def on_flange(run: PlannedRun | Block) -> str:
    """Say what a run needs on the flange."""
    if run.payload is None:
        return "NOTHING on the flange"
    return f"{run.payload.upper()} ({run.mass_kg:g} kg) on the flange"


def goes_on_with(state: GuidedState) -> str:
    """Say what the same command does next in a session that an error has ended."""
    recorded = {run.name for run in state.runs}
    waiting = [block.name for block in state.blocks if block.name not in recorded]
    if waiting:
        return f"it records {waiting[0]} again, which does not count yet"
    if not state.complete:
        return "it goes on with the next block"
    if state.outcome is Outcome.APPLIED and state.acceptance is None:
        return "it goes on with the moves that accept the gains, and writes nothing again"
    if state.outcome is not None and state.outcome.good:
        return "it makes the certificate again, and moves and writes nothing"
    return "it records nothing again, and goes on with the identification"


def position_of(state: GuidedState) -> Position:
    """Find the stage that a session is in, by what its state has and lacks."""
    if state.outcome is not None and state.is_over:
        return Position(StageName.ENDED, f"The session has ended: {state.outcome.value}")
    recording = _recording_position(state)
    if recording is not None:
        return recording
    if state.outcome is Outcome.APPLIED and state.acceptance is None:
        return Position(
            StageName.ACCEPT,
            f"{on_flange(state.blocks[-1])}, then the robot makes moves that are new",
        )
    if state.outcome is not None and state.outcome.good:
        return Position(StageName.ACCEPT, "nothing: the certificate is being made")
    if state.decision is None:
        return Position(StageName.IDENTIFY, "nothing: the gains are being identified")
    return Position(StageName.WRITE, "look at the change, and type yes in the terminal to write it")


def _recording_position(state: GuidedState) -> Position | None:
    """Find the block that a session is at; None after the recording."""
    recorded = {run.name for run in state.runs}
    waiting = [block for block in state.blocks if block.name not in recorded]
    if waiting:
        return Position(
            StageName.RECORD, f"{on_flange(waiting[0])}, then the robot moves: {waiting[0].name}"
        )
    if not state.complete:
        return Position(StageName.RECORD, "nothing yet: the next block is being prepared")
    return None
