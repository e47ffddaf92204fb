"""Kill -9 at any system call of the write path:
the old file or the new one, whole, and the audit says which.

A kill changes no file, so one at a call leaves what the files are as that call begins. One writer
is therefore followed through all its calls, and another one is killed in each different state that
the files have been in.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import re
import shutil
import stat
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import cache, partial
from pathlib import Path

import pytest

from daq.documents.calibration_file import encode_calibration
from daq.formats.document import decode_document
from daq.ledger.audit import AuditAction, AuditVerdict, Content, verify
from daq.writeback.file_access import backups
from daq.writeback.file_target import FileTarget
from daq.writeback.request import Request
from daq.writeback.target import apply, propose, rollback
from ident.estimators.estimate import RelativeError
from tests.daq import killing
from tests.daq.calibrations import demo_calibration
from tests.daq.killing import killed_where

NOW = datetime(2025, 1, 2, 3, 4, 5, tzinfo=UTC)
OLD = b"# K. has weighed it.\ndrives:\n  J1: {gain: 32.96, kp: 120.0}   # Nm/A\n"
KEYS = {"J1": "drives.J1.gain"}
MIN_CALLS = 50
MIN_STATES = 8
LEFT = re.compile(
    r"x\.yaml|x\.yaml\..*\.bak|audit\.jsonl(\.head)?|\.x\.yaml\.lock|\.x\.yaml\..*\.tmp"
)
"""Files that may remain: the files themselves, the note of the audit's last entry, whole backups,
the lock file without a holder, unfinished copies.
"""


@cache
def _request(gain: float) -> Request:
    """A calibration of this gain, with the bytes of its file: these take long to make."""
    calibration = demo_calibration()
    changed_gain = replace(calibration.gains[0], value=gain, std=0.1)
    gains = (changed_gain,)
    relative_error_percent = RelativeError((3.1,), 3.1)
    holdout_error_percent = RelativeError((3.2,), 3.2)
    relative_error = RelativeError((4.2,), 4.2)
    calibration = replace(
        calibration,
        gains=gains,
        relative_error_percent=relative_error_percent,
        holdout_error_percent=holdout_error_percent,
        nameplate_holdout_error_percent=relative_error,
    )
    return Request(calibration, NOW, content=encode_calibration(calibration))


State = frozenset[tuple[str, int, bytes]]
"""Files by name, mode and content; the random part of a temporary name is left out."""


@dataclass(frozen=True)
class Place:
    """A controller's file with its audit, as a writer finds it."""

    folder: Path

    @property
    def file(self) -> Path:
        return self.folder / "x.yaml"

    @property
    def audit(self) -> Path:
        return self.folder / "audit.jsonl"

    def apply(self, gain: float, minutes: int = 0) -> None:
        """Write a gain."""
        target = FileTarget(self.file, KEYS)
        proposal = propose(target, _request(gain))
        assert proposal.refusals == ()
        now = NOW + timedelta(minutes=minutes)
        apply(proposal, now, audit=self.audit, who="Ada")

    def to_apply(self) -> Callable[[], object]:
        """The write itself, everything before it done: another gain goes in."""
        target = FileTarget(self.file, KEYS)
        proposal = propose(target, _request(33.9))
        return lambda: apply(proposal, NOW + timedelta(minutes=1), audit=self.audit, who="Ada")

    def to_roll_back(self) -> Callable[[], object]:
        """Return the rollback of an earlier write."""
        return lambda: rollback(
            FileTarget(self.file), NOW + timedelta(minutes=1), audit=self.audit, who="Bob"
        )

    def content(self) -> bytes | None:
        """Content of the file; None where it is gone."""
        return self.file.read_bytes() if self.file.exists() else None

    def state(self) -> State:
        """All that the next writer finds."""
        return frozenset(
            (re.sub(r"\.[^.]*\.tmp$", ".tmp", path.name), path.lstat().st_mode, path.read_bytes())
            for path in self.folder.iterdir()
        )

    def kinds_left(self) -> set[str]:
        """Endings of what lies about; nothing else does."""
        names = [path.name for path in self.folder.iterdir()]
        assert [name for name in names if not LEFT.fullmatch(name)] == []
        return {name.rpartition(".")[2] for name in names}


Prepare = Callable[[Path], Place]
Work = Callable[[Place], Callable[[], object]]


def _unflushed(_descriptor: int) -> None:
    """For what comes before the kill and after it:
    a kill is no power cut, and flushing takes most of the time.
    """


def _fresh(folder: Path) -> Place:
    """A place without a write so far, and without an audit."""
    folder.mkdir()
    place = Place(folder)
    place.file.write_bytes(OLD)
    place.file.chmod(0o640)
    return place


def _written_once(folder: Path) -> Place:
    place = _fresh(folder)
    place.apply(32.4)
    return place


def _deleted(folder: Path) -> Place:
    place = _written_once(folder)
    place.file.unlink()
    return place


def _reported_content(verdict: AuditVerdict) -> Content:
    """Which of the two the audit says the file is, after the one write that was killed."""
    # Before it, nothing or one finished write.
    if verdict.open_writes:
        assert len(verdict.open_writes) == 1
        return verdict.open_writes[0].content
    last = verdict.entries[-1].action if verdict.entries else None
    begun = [
        entry
        for entry in verdict.entries
        if entry.action in {AuditAction.APPLY_BEGUN, AuditAction.ROLLBACK_BEGUN}
    ]
    ended = {AuditAction.APPLIED, AuditAction.ROLLED_BACK}
    if last in ended and begun[-1].at == (NOW + timedelta(minutes=1)).isoformat():
        return Content.AFTER
    return Content.BEFORE


@pytest.fixture(scope="module")
def small() -> Iterator[Executor]:
    """A process that has imported this module alone:
    to fork one that has run other tests takes far longer.
    """
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        yield pool


@pytest.mark.parametrize(
    ("prepare", "work"),
    [
        pytest.param(_fresh, Place.to_apply, id="apply, first of all"),
        pytest.param(_written_once, Place.to_apply, id="apply, once more"),
        pytest.param(_written_once, Place.to_roll_back, id="rollback"),
        pytest.param(_deleted, Place.to_roll_back, id="rollback of a file that was deleted"),
    ],
)
def test_killed_at_every_system_call_the_file_is_old_or_new_and_the_audit_reports_which(
    tmp_path: Path,
    prepare: Prepare,
    work: Work,
    capsys: pytest.CaptureFixture[str],
    small: Executor,
) -> None:
    calls, outcomes, left, states = small.submit(_kill_everywhere, tmp_path, prepare, work).result()
    with capsys.disabled():
        reported = ", ".join(
            f"{count} × {content.name.lower()}" for content, count in outcomes.items()
        )
        remains = f"killed in each of them: {reported}; left behind: {', '.join(sorted(left))}"
        sys.stdout.write(f"\n  {states} states of the files at {calls} system calls, {remains}\n")
    assert calls >= MIN_CALLS
    assert states >= MIN_STATES
    expected = {Content.BEFORE, Content.AFTER}
    assert set(outcomes) == expected
    # Otherwise no writer was killed half-way.
    assert {"lock", "tmp"} <= left


def _kill_everywhere(
    folder: Path, prepare: Prepare, work: Work
) -> tuple[int, Counter[Content], set[str], int]:
    """Kill a writer in each state of the files that its system calls make,
    and check what each leaves.

    Returns:
        number of calls, outcomes, endings of what was left, and the number of different states.
    """
    model = prepare(folder / "model")
    before = model.content()
    work(model)()
    after = model.content()
    assert before != after
    outcomes: Counter[Content] = Counter()
    left: set[str] = set()
    place = prepare(folder / "place")
    kept = folder / "kept"
    shutil.copytree(place.folder, kept)
    seen: list[State] = []  # at each call of the writer that is followed
    gc.disable()  # of the child: when it collects is not part of the path
    try:
        killed_where(lambda _: seen.append(place.state()), work(place))
        states = dict.fromkeys((*seen, place.state()))
        for state in states:
            # Copied back, because preparing it takes longer; into the same folder, because the
            # audit names the file.
            shutil.rmtree(place.folder)
            shutil.copytree(kept, place.folder)
            here = partial(_is_reached, place, state)
            killed_where(here, work(place))
            assert place.state() == state
            outcomes[_check(place, before, after)] += 1
            left |= place.kinds_left()
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(os, "fsync", _unflushed)
                _check_next_write(place, before, after)
    finally:
        gc.enable()
    return len(seen), outcomes, left, len(states)


def _is_reached(place: Place, state: State, _call: int) -> bool:
    return place.state() == state


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ci", "ends"), [("", pytest.skip.Exception), ("true", pytest.fail.Exception)]
)
def test_where_ptrace_is_not_permitted_it_is_skipped_by_people_and_fails_in_ci(
    monkeypatch: pytest.MonkeyPatch, ci: str, ends: type[BaseException]
) -> None:
    monkeypatch.setenv("CI", ci)
    monkeypatch.setattr(killing, "_ptrace", lambda *_: -1)
    with pytest.raises(ends, match="ptrace is not permitted"):
        killing.killed_where(lambda _: True, lambda: None)


def _check(place: Place, before: bytes | None, after: bytes | None) -> Content:
    """Whole, with its mode, and known by the audit; gone only where it was."""
    content = place.content()
    assert content in {before, after}
    if content is not None:
        decode_document(content, "x.yaml").locate(tuple(KEYS.values()))
        st_mode = place.file.stat().st_mode
        assert stat.S_IMODE(st_mode) == 0o640
    verdict = verify(place.audit)
    assert verdict.holds
    reported = _reported_content(verdict)
    assert reported is (Content.BEFORE if content == before else Content.AFTER)
    for backup in backups(place.file):
        backup.content()  # each is what its name says
    return reported


def _check_next_write(place: Place, before: bytes | None, after: bytes | None) -> None:
    """The next writer is not hindered, and the audit still records what the killed one has done."""
    was = place.content()
    open_writes = verify(place.audit).open_writes
    reported = [one.content for one in open_writes]
    if was is None:
        now = NOW + timedelta(minutes=2)
        file_target = FileTarget(place.file)
        assert rollback(file_target, now, audit=place.audit).edit.after == after
        contents = [one.content for one in verify(place.audit).open_writes]
        assert contents == reported
        return
    place.apply(31.5, minutes=2)
    assert b"31.5" in place.file.read_bytes()
    verdict = verify(place.audit)
    assert verdict.holds
    assert [one.content for one in verdict.open_writes] == reported
    target = FileTarget(place.file)
    edit = rollback(target, NOW + timedelta(minutes=3), audit=place.audit).edit
    assert edit.after == was
    assert place.file.read_bytes() in {before, after}
