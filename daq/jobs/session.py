"""A recalibration session on disk: a folder with logs, calibration and report,
and a state file with its progress.

The state is replaced whole after every step, with the digests of the files that the step made. A
file that the state does not list, or lists with another digest, is a remnant of a killed job.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Collection, Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from daq.documents.session_state import GuidedState, JobState, SessionState
from daq.errors import ConfigurationInconsistent, reason_of, writing
from daq.files import read_regular, replace_file

CLOCK_SLACK = timedelta(minutes=1)  #: A time service sets a clock back by less
STATE = "state.json"
CALIBRATION = "calibration.yaml"
REPORT = "report"
LARGEST_STATE_BYTES = 4 << 20  # a job writes a few kilobytes
_ANY_STATE: TypeAdapter[JobState | GuidedState] = TypeAdapter(JobState | GuidedState)
_STAMP = "%Y%m%dT%H%M%SZ"
_NAME = re.compile(r"[0-9]{8}T[0-9]{6}Z(?:-[0-9]{2})?")
_REMOVED = re.compile(rf"\.{_NAME.pattern}\.removed")  #: A session that is being removed
#: First part of the name of a state that is being written (`daq.files.replace_file`)
_UNWRITTEN = f".{STATE}."


@dataclass(frozen=True, slots=True)
class Session:
    """A session folder and its state."""

    folder: Path
    state: SessionState

    @property
    def began(self) -> datetime:
        """Start of its first job."""
        return datetime.fromisoformat(self.state.began)

    @property
    def finished(self) -> bool:
        """Whether no job resumes it."""
        return self.state.is_over

    def update(self, **changed: object) -> Session:
        """Change some values of the state, and write it as `save`."""
        return save(replace(self, state=self.state.with_(**changed)))


def sessions(folder: Path, cell: str | None = None) -> tuple[Session, ...]:
    """Read the sessions in a folder, oldest first; folders without a readable state are skipped.

    Args:
        folder: of the sessions; several cells may share one.
        cell: name of the cell; None for all cells.

    Raises:
        ConfigurationInconsistent: it is no folder, or cannot be read.
    """
    try:
        entries = tuple(folder.iterdir())
    except FileNotFoundError:
        return ()
    except OSError as error:
        raise ConfigurationInconsistent(
            str(folder),
            found=reason_of(error),
            expected="the folder of a cell's sessions",
            remedy="correct `recalibration.folder` of the cell file, or move that file away",
        ) from error
    found: list[Session] = []
    for entry in entries:
        if not _NAME.fullmatch(entry.name):
            continue
        state = _read(entry / STATE)
        if state is None:
            continue
        if cell is None or state.cell == cell:
            found.append(Session(entry, state))
    return tuple(sorted(found, key=lambda session: (session.began, session.folder.name)))


def rename_sessions(folders: Iterable[Path], old: str, new: str, until: datetime) -> int:
    """Give the sessions of a cell its new name; return their number.

    Each state is replaced whole, so a process that is killed in between leaves the rest to the next
    call.

    Args:
        folders: of sessions; one that does not exist has none.
        old: name of the cell before.
        new: its name now.
        until: when it was renamed; a session that began later is of another cell with the old name.

    Raises:
        ConfigurationInconsistent: a folder is none, or cannot be read.
        OutputFailed: the file system refuses.
    """
    count = 0
    for folder in folders:
        for session in sessions_to_rename(folder, old, until):
            session.update(cell=new)
            count += 1
    return count


def sessions_to_rename(folder: Path, old: str, until: datetime) -> tuple[Session, ...]:
    """Return the sessions of a cell that `rename_sessions` gives another name.

    Args and errors as there.
    """
    return tuple(session for session in sessions(folder, old) if session.began <= until)


def begun_until(found: tuple[Session, ...], now: datetime) -> tuple[Session, ...]:
    """Return the sessions that began by now.

    One that begins later was made under a wrong date. By its date it would be the newest one for as
    long, so no age, no order and no removal counts it.
    """
    return tuple(session for session in found if session.began - now <= CLOCK_SLACK)


def session_of(calibration: Path, digest: str) -> str | None:
    """Return the name of the session that made a calibration;
    None for a file in no session's folder.

    Args:
        calibration: its file.
        digest: SHA-256 of the file, as the session noted it.
    """
    state = _read(calibration.resolve().parent / STATE)
    if state is None or state.fitted is None or state.fitted.calibration_sha256 != digest:
        return None
    return state.session


@dataclass(frozen=True, slots=True)
class Basis:
    """Cell, configuration and approved plans of a session:
    a session is resumed only with the same ones.
    """

    cell: str
    configuration_sha256: str
    plans_sha256: str


def begin(
    folder: Path, basis: Basis, now: datetime, kind: type[SessionState] = JobState
) -> Session:
    """Begin a session: make its folder and write its state.

    Args:
        folder: of the sessions.
        basis: of the session.
        now: wall clock.
        kind: of its state.

    Raises:
        OutputFailed: the file system refuses.
    """
    stamp = now.astimezone(UTC).strftime(_STAMP)
    names = (stamp, *(f"{stamp}-{number:02d}" for number in range(2, 100)))
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        name = next(name for name in names if not (folder / name).exists())
        (folder / name).mkdir()
    at = now.isoformat(timespec="seconds")
    state = kind(session=name, began=at, attempt_began=at, **asdict(basis))
    return save(Session(folder / name, state))


def save(session: Session) -> Session:
    """Write the state of a session, whole.

    Raises:
        OutputFailed: the file system refuses.
    """
    path = session.folder / STATE
    with writing(path):
        replace_file(path, (session.state.model_dump_json(indent=2) + "\n").encode())
    return session


def resumable_session(
    found: tuple[Session, ...], basis: Basis, now: datetime, within_h: float
) -> Session | None:
    """Newest session, if it is unfinished, has the same basis and is recent enough."""
    if not found or found[-1].finished:
        return None
    last = found[-1]
    young = timedelta(0) <= now - last.began <= timedelta(hours=within_h)
    its = Basis(last.state.cell, last.state.configuration_sha256, last.state.plans_sha256)
    if young and its == basis:
        return last
    return None


def resume(session: Session, now: datetime) -> Session:
    """Begin another attempt of an unfinished session: how the one before ended is forgotten.

    Raises:
        OutputFailed: the file system refuses.
    """
    return session.update(
        attempt=session.state.attempt + 1,
        attempt_began=now.isoformat(timespec="seconds"),
        outcome=None,
        exit_code=None,
        problem="",
        ended=None,
    )


def last_good(found: tuple[Session, ...]) -> Session | None:
    """Newest session with a valid calibration."""
    for session in reversed(found):
        if session.finished and session.state.outcome is not None and session.state.outcome.good:
            return session
    return None


def remove_old(
    found: tuple[Session, ...], keep: int, in_force: Collection[str]
) -> tuple[Path, ...]:
    """Remove old sessions, except the last good one and those whose calibration is in force.

    Args:
        found: oldest first, those that count (`begun_until`).
        keep: number of the newest sessions to keep.
        in_force: digests of the calibrations in force: their logs and signatures are the evidence
            for current gains.

    Returns:
        folders that were removed; one that the file system does not release is skipped.
    """
    good = last_good(found)
    removed = []
    for session in found[:-keep]:
        fitted = session.state.fitted
        if session is not good and (fitted is None or fitted.calibration_sha256 not in in_force):
            with suppress(OSError):
                # Renamed first: killed halfway, it would be a folder without a state, which no job
                # removes.
                doomed = session.folder.with_name(f".{session.folder.name}.removed")
                session.folder.rename(doomed)
                shutil.rmtree(doomed)
                removed.append(session.folder)
    for session in found[-1:]:
        with suppress(OSError):
            _remove_remnants(session.folder)
    return tuple(removed)


def _remove_remnants(newest: Path) -> None:
    """Remove what killed jobs left next to this folder:
    sessions half removed, and those that never got a state.

    A later folder without a state may be that of another cell's job, which begins just now. One
    with any other file in it is left to a person.
    """
    for entry in tuple(newest.parent.iterdir()):
        if _REMOVED.fullmatch(entry.name):
            shutil.rmtree(entry, ignore_errors=True)
        elif _NAME.fullmatch(entry.name) and entry.name < newest.name and entry.is_dir():
            content = tuple(entry.iterdir())
            if all(file.name.startswith(_UNWRITTEN) for file in content):
                for file in content:
                    file.unlink()
                entry.rmdir()


def _read(path: Path) -> SessionState | None:
    with suppress(OSError, ValidationError, ValueError):
        state = _ANY_STATE.validate_json(read_regular(path, LARGEST_STATE_BYTES))
        # Ages are counted from these times, so each must be one, with a known zone.
        if all(time.utcoffset() is not None for time in _times(state)):
            return state
    return None


def _times(state: SessionState) -> list[datetime]:
    times = (state.began, state.attempt_began, state.ended)
    return [datetime.fromisoformat(time) for time in times if time is not None]
