"""A session on the disk: a folder with logs, calibration and report, and a state file that says how far it has come.

The state is replaced whole after every step, with the digests of what the step made. What is in the folder and not in
the state, or not as the state has it, was left by a job that was killed.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from enum import Enum
from pathlib import Path
from typing import Literal

from pydantic import ValidationError

from daq.config.yaml_file import StrictModel
from daq.errors import OutputFailed
from daq.files import read_regular, replace_file

STATE, CALIBRATION, REPORT = "state.json", "calibration.yaml", "report"
LARGEST_STATE_BYTES = 4 << 20
"""A job writes a few kilobytes."""
_STAMP = "%Y%m%dT%H%M%SZ"
_NAME = re.compile(r"[0-9]{8}T[0-9]{6}Z(?:-[0-9]{2})?")


class Outcome(Enum):
    """How a job ended."""

    NOT_DUE = "not due"
    """The last good calibration is young enough; no session was begun."""
    APPLIED = "applied"
    UNCHANGED = "unchanged"
    """No gain differs from the controller's by more than chance."""
    PROPOSED = "proposed"
    """A person must apply it."""
    REFUSED = "refused"
    """A gate of the write-back is closed."""
    UNFIT = "unfit"
    """The recordings cannot be used."""
    STOPPED = "stopped"
    """Something stood in the way; the next job goes on with the session."""
    INTERRUPTED = "interrupted"
    """As STOPPED, by a signal."""

    @property
    def good(self) -> bool:
        """Whether the calibration stands."""
        return self in (Outcome.APPLIED, Outcome.UNCHANGED, Outcome.PROPOSED)

    @property
    def concluded(self) -> bool:
        """Whether the session is over: the same logs would end in the same way."""
        return self not in (Outcome.STOPPED, Outcome.INTERRUPTED)


class RecordedRun(StrictModel):
    """A finished log of the session: its digest, how many recordings it took, and what was lost in all of them."""

    name: str
    sha256: str
    attempts: int
    samples: int
    lost_cycles: int
    missing: tuple[int, ...]


class Fitted(StrictModel):
    """The calibration file's digest, and the residual in words."""

    calibration_sha256: str
    sentences: tuple[str, ...]


class JudgedGain(StrictModel):
    """A gain against the one in the controller: both, their σ, and whether they differ by more than chance.

    The drift is their difference in σ of the difference, None where both σ are 0; the σ of a number that nobody knows
    anything of is 0. The change is None where the number in the controller is 0.
    """

    axis: str
    unit: str
    old: float
    old_std: float
    new: float
    new_std: float
    change_percent: float | None
    drift_sigma: float | None
    differs: bool


class Decision(StrictModel):
    """What was decided, and from which gains."""

    gains: tuple[JudgedGain, ...]
    remark: str


class Target(StrictModel):
    """What is about to be written, noted before it is: after a kill the file's digest says whether it was.

    `looked_at` is what `apply --base` takes from whoever has looked at the change; `unsigned` where the policy wants
    signatures that the calibration has not got yet.
    """

    file: str
    base_sha256: str
    after_sha256: str
    looked_at: str = ""
    unsigned: bool = False


class WatchedGain(StrictModel):
    """What the chart of a gain over all calibrations says (`daq.ledger.watch`); no words where it raises no alarm."""

    axis: str
    alarm: str


class SessionState(StrictModel):
    """`state.json`; what a step has not made yet is None, or not in the list.

    `plans_sha256` is of the approved plans that runs name, `audit_sha256` of the audit's entry about the session's end.
    """

    format: Literal["drivegain-recalibration"] = "drivegain-recalibration"
    version: Literal[1] = 1
    session: str
    cell: str
    configuration_sha256: str
    plans_sha256: str = ""
    began: str
    attempt: int = 1
    attempt_began: str
    runs: tuple[RecordedRun, ...] = ()
    fitted: Fitted | None = None
    watched: tuple[WatchedGain, ...] = ()
    decision: Decision | None = None
    target: Target | None = None
    outcome: Outcome | None = None
    exit_code: int | None = None
    problem: str = ""
    ended: str | None = None
    audit_sha256: str | None = None

    def with_(self, **changed: object) -> SessionState:
        """A copy with other values."""
        return self.model_copy(update=changed)


@dataclass(frozen=True, slots=True)
class Session:
    """A folder and its state."""

    folder: Path
    state: SessionState

    @property
    def began(self) -> datetime:
        """When its first job began it."""
        return datetime.fromisoformat(self.state.began)

    @property
    def finished(self) -> bool:
        """Whether no job takes it up any more; one that was killed before it told its end has not come to it."""
        outcome = self.state.outcome
        return outcome is not None and outcome.concluded and self.state.ended is not None

    @property
    def last_written(self) -> datetime:
        """The latest time in its state."""
        return max(_times(self.state))


def sessions(folder: Path, cell: str | None = None) -> tuple[Session, ...]:
    """Sessions in a folder, oldest first; what has no readable state is none.

    Args:
        folder: where they are.
        cell: name of the cell whose they are, since several may keep theirs in one folder; None for all of them.
    """
    found: list[Session] = []
    with suppress(FileNotFoundError):
        folders = [entry for entry in folder.iterdir() if _NAME.fullmatch(entry.name)]
        read = ((entry, _read(entry / STATE)) for entry in folders)
        found = [Session(entry, state) for entry, state in read if state is not None and cell in (None, state.cell)]
    return tuple(sorted(found, key=lambda session: (session.began, session.folder.name)))


@dataclass(frozen=True, slots=True)
class Basis:
    """What all recordings of a session have in common.

    Attributes:
        cell: name.
        configuration_sha256: of its configuration.
        plans_sha256: of the approved plans that its runs name.
    """

    cell: str
    configuration_sha256: str
    plans_sha256: str


def begin(folder: Path, basis: Basis, now: datetime) -> Session:
    """Make the folder of a new session and write its state.

    Raises:
        OutputFailed: the file system refuses.
    """
    stamp = now.astimezone(UTC).strftime(_STAMP)
    names = (stamp, *(f"{stamp}-{number:02d}" for number in range(2, 100)))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        name = next(name for name in names if not (folder / name).exists())
        (folder / name).mkdir()
    except OSError as error:
        raise OutputFailed.of(folder, error) from error
    at = now.isoformat(timespec="seconds")
    state = SessionState(
        session=name,
        cell=basis.cell,
        configuration_sha256=basis.configuration_sha256,
        plans_sha256=basis.plans_sha256,
        began=at,
        attempt_began=at,
    )
    return save(Session(folder / name, state))


def save(session: Session) -> Session:
    """Write its state, whole.

    Raises:
        OutputFailed: the file system refuses.
    """
    path = session.folder / STATE
    try:
        replace_file(path, (session.state.model_dump_json(indent=2) + "\n").encode())
    except OSError as error:
        raise OutputFailed.of(path, error) from error
    return session


def resumable_session(found: tuple[Session, ...], basis: Basis, now: datetime, within_h: float) -> Session | None:
    """The newest session, if it waits for its end: of this configuration, with these plans, and young enough."""
    if not found or found[-1].finished:
        return None
    last = found[-1]
    young = timedelta(0) <= now - last.began <= timedelta(hours=within_h)
    its = Basis(last.state.cell, last.state.configuration_sha256, last.state.plans_sha256)
    return last if young and its == basis else None


def last_good(found: tuple[Session, ...]) -> Session | None:
    """The newest session whose calibration stands."""
    good = [
        session
        for session in found
        if session.finished and session.state.outcome is not None and session.state.outcome.good
    ]
    return good[-1] if good else None


def remove_old(found: tuple[Session, ...], keep: int, in_force: Collection[str]) -> tuple[Path, ...]:
    """Remove the oldest sessions beyond so many; the last good one stays, and so does what a controller rests on.

    Args:
        found: oldest first.
        keep: so many of the newest stay.
        in_force: digests of the calibrations whose gains a controller has: their logs and signatures are its evidence.

    Returns:
        what was removed; what the file system does not let go stays.
    """
    good = last_good(found)
    removed = []
    for session in found[:-keep]:
        fitted = session.state.fitted
        if session is not good and (fitted is None or fitted.calibration_sha256 not in in_force):
            with suppress(OSError):
                shutil.rmtree(session.folder)
                removed.append(session.folder)
    return tuple(removed)


def _read(path: Path) -> SessionState | None:
    with suppress(OSError, ValidationError, ValueError):
        state = SessionState.model_validate_json(read_regular(path, LARGEST_STATE_BYTES))
        # Ages are counted from them, so each must be a time, and of a known zone.
        if all(time.utcoffset() is not None for time in _times(state)):
            return state
    return None


def _times(state: SessionState) -> list[datetime]:
    times = (state.began, state.attempt_began, state.ended)
    return [datetime.fromisoformat(time) for time in times if time is not None]
