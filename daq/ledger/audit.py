"""The audit log of a cell: entries are appended and never removed.

One JSON line an entry, each with the digest of the one before. An entry is on the disk before `append` returns, written
in one piece under a lock. A killed writer leaves at most an unfinished line. That line stays; the next entry begins on
a line of its own and records its digest.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import stat
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TypeVar

from daq.errors import AuditUnusable, CalibrationRefused
from daq.files import fsync_folder, sha256, sha256_of
from daq.ledger.audit_chain import (
    FIRST,
    GONE,
    AuditAction,
    AuditEntry,
    AuditFlaw,
    AuditVerdict,
    Content,
    Flaw,
    OpenWrite,
    decode,
    encode,
    entry,
    is_fragment,
    judge,
    lines_of,
    torn_details,
)
from daq.writeback.gates.gate import Refusal

__all__ = [
    "AuditAction",
    "AuditEntry",
    "AuditFlaw",
    "AuditVerdict",
    "Content",
    "Flaw",
    "OpenWrite",
    "append",
    "digest_now",
    "find_write_entry",
    "read",
    "verify",
]

_TRIES, _PAUSE_S = 100, 0.05  #: For the lock, which is held for one line
_LOG = logging.getLogger("drivegain")
_NOT_WRITTEN = (OSError, AuditUnusable)
_Done = TypeVar("_Done")


def append(
    path: Path, action: AuditAction, *, at: datetime, who: str, subject: str, details: Mapping[str, object]
) -> AuditEntry:
    """Append an entry durably; a new file is made in an existing folder.

    Args:
        path: of the audit log.
        action: what happened.
        at: time with its zone.
        who: the person or the job.
        subject: the file, drives or cell that it happened to.
        details: plain JSON with finite numbers.

    Raises:
        AuditUnusable: no regular file, locked for long, or its last line is not what was written.
        OSError: from the file system; at most an unfinished line was left.
    """
    with _locked(path) as descriptor:
        content = _read_all(descriptor)
        new: list[AuditEntry] = []

        def add(kind: AuditAction, says: Mapping[str, object]) -> None:
            before = new[-1] if new else last
            number, previous = (1, FIRST) if before is None else (before.number + 1, before.sha256)
            new.append(entry(number, at.isoformat(), who, kind, subject, says, previous))

        last, unfinished = _end_of(content, path)
        if unfinished:
            add(AuditAction.TORN_LINE, torn_details(unfinished))
        add(action, details)
        begin = b"" if not content or content.endswith(b"\n") else b"\n"
        line = begin + b"".join(encode(one) + b"\n" for one in new)
        if os.write(descriptor, line) != len(line):
            raise OSError(28, "No space left on device", str(path))
        os.fsync(descriptor)
        if not content:
            fsync_folder(path.resolve().parent)
        return new[-1]


def read(path: Path) -> tuple[AuditEntry, ...]:
    """Return all entries, oldest first, unverified; none where there is no file.

    Raises:
        AuditUnusable: no regular file, or it cannot be read.
    """
    return tuple(one for one in map(decode, lines_of(_content(path))) if one is not None)


def verify(path: Path, heads: Collection[str] = ()) -> AuditVerdict:
    """Check that the audit log is what was written, and find writes that were begun and never ended.

    Args:
        path: of the audit log; a missing file is an empty one.
        heads: `sha256` of entries noted elsewhere. A chain alone cannot show that its last lines are missing.

    Raises:
        AuditUnusable: no regular file, or it cannot be read.
    """
    return judge(_content(path), digest_now, heads)


def find_write_entry(path: Path, subject: str, sha256_after: str) -> str | None:
    """Return the SHA-256 of the newest entry about a write of that content to that subject, None without one.

    Raises:
        AuditUnusable: no regular file, or it cannot be read.
    """
    digests = [
        one.sha256 for one in read(path) if (one.subject, one.details.get("sha256_after")) == (subject, sha256_after)
    ]
    return digests[-1] if digests else None


@dataclass(frozen=True, slots=True)
class AuditRecorder:
    """Record writes to controllers: that one begins, before anything is replaced, and how it ended."""

    audit: Path | None  #: file of the audit log; None records nothing
    who: str  #: the person or the job
    at: datetime  #: time with its zone

    def record_write(
        self,
        begun: AuditAction,
        ended: AuditAction,
        target: Path,
        before: bytes | None,
        after: bytes,
        details: Mapping[str, object],
        write: Callable[[], _Done],
    ) -> tuple[_Done, str | None]:
        """Call `write` between two entries.

        Args:
            begun, ended: actions of the entry before, and of the one after success.
            target: the file, with symbolic links followed, or the drives.
            before, after: content; before is None where the file is gone.
            details: of the first entry, besides the digests.
            write: replaces the content.

        Returns:
            the result of `write`, and the SHA-256 of the last entry, None without an audit log. Kept elsewhere, it
            reveals an audit log whose end was cut off.

        Raises:
            AuditUnusable, OSError: the first entry could not be written; the target is unchanged.
            Exception: from `write`.
        """
        if self.audit is None:
            return write(), None
        digests = {"sha256_before": None if before is None else sha256(before), "sha256_after": sha256(after)}
        entry = self._append(self.audit, begun, target, {**digests, **details})
        try:
            done = write()
        except BaseException as error:  # an interrupt ends a write too
            # An interrupt may come when all is done: the digest shows the content, whatever the error says.
            found = {"begun": entry.number, "error": _said(error), "sha256_found": digest_now(str(target))}
            self._end(self.audit, AuditAction.FAILED, target, found)
            raise
        end_entry = self._end(self.audit, ended, target, {"begun": entry.number})
        return done, (end_entry or entry).sha256

    def record_refusal(self, target: Path, refusals: Sequence[Refusal], details: Mapping[str, object]) -> None:
        """Record a write that gates refused."""
        listed = [{"gate": one.gate.value, "subject": one.subject, "found": one.found} for one in refusals]
        self._refused(target, {"refusals": listed, **details})

    def record_no_change(self, target: Path, content: bytes, details: Mapping[str, object]) -> None:
        """Record that the target had this content already."""
        if self.audit is not None:
            self._end(self.audit, AuditAction.NOTHING_TO_DO, target, {"sha256_found": sha256(content), **details})

    @contextlib.contextmanager
    def record_refusal_of(self, target: Path, details: Mapping[str, object]) -> Iterator[None]:
        """Record a refusal that is raised within the context."""
        try:
            yield
        except CalibrationRefused as error:
            documented = {"gate": "file", "subject": error.subject, "found": error.found}
            self._refused(target, {"refusals": [documented], **details})
            raise

    def _refused(self, target: Path, details: Mapping[str, object]) -> None:
        if self.audit is not None:
            self._end(self.audit, AuditAction.REFUSED, target, details)

    def _append(self, audit: Path, action: AuditAction, target: Path, details: Mapping[str, object]) -> AuditEntry:
        return append(audit, action, at=self.at, who=self.who, subject=str(target), details=details)

    def _end(self, audit: Path, action: AuditAction, target: Path, details: Mapping[str, object]) -> AuditEntry | None:
        try:
            return self._append(audit, action, target, details)
        except _NOT_WRITTEN as error:
            # The write is done, and the first entry has its digests: no reason to call it undone.
            _LOG.warning("the audit log does not have that it is %s: %s", action.value, error)
            return None


def _end_of(content: bytes, path: Path) -> tuple[AuditEntry | None, list[bytes]]:
    """Return the last entry and the unfinished lines after it.

    Raises:
        AuditUnusable: the last line is something else.
    """
    unfinished: list[bytes] = []
    for number, line in reversed(list(enumerate(lines_of(content), start=1))):
        one = decode(line)
        if one is not None and one.holds:
            return one, unfinished[::-1]
        if one is not None or not is_fragment(line):
            raise AuditUnusable(
                str(path),
                found=f"line {number}, which drivegain did not write",
                expected="an audit log whose entries were never changed",
                remedy="if this is another file, correct `history.audit` of the cell file or --audit; if it is the "
                "audit log, check it with `drivegain history --verify`, then move it away, keep it, and begin another; "
                "nothing was written",
            )
        unfinished.append(line)
    return None, unfinished[::-1]


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[int]:
    # O_NONBLOCK: a FIFO of that name must not keep us waiting for its other end.
    flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK
    try:
        descriptor = os.open(path, flags, 0o666)
    except IsADirectoryError as error:
        raise _no_file(path, "a folder") from error
    try:
        _check_regular(descriptor, path)
        for _ in range(_TRIES):
            with contextlib.suppress(BlockingIOError):
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            time.sleep(_PAUSE_S)
        else:
            raise AuditUnusable(
                str(path),
                found="another program that keeps it locked",
                expected="a lock for as long as a line takes",
                remedy="see who has it open (`fuser`); nothing was written",
            )
        yield descriptor
    finally:
        os.close(descriptor)


def _content(path: Path) -> bytes:
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except FileNotFoundError:
        return b""
    except OSError as error:
        raise _no_file(path, (error.strerror or type(error).__name__).lower()) from error
    try:
        _check_regular(descriptor, path)
        return _read_all(descriptor)
    finally:
        os.close(descriptor)


def _check_regular(descriptor: int, path: Path) -> None:
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        raise _no_file(path, "something that is no regular file")


def _no_file(path: Path, found: str) -> AuditUnusable:
    return AuditUnusable(
        str(path),
        found=found,
        expected="the cell's audit, a regular file",
        remedy="correct `history.audit` of the cell file, or give --audit FILE; nothing was written",
    )


def _read_all(descriptor: int) -> bytes:
    os.lseek(descriptor, 0, os.SEEK_SET)
    pieces = []
    while piece := os.read(descriptor, 1 << 20):
        pieces.append(piece)
    return b"".join(pieces)


def digest_now(subject: str) -> str | None:
    """Return the SHA-256 of a file as it is now, `GONE` without one, None where it cannot be read."""
    path = Path(subject)
    try:
        return sha256_of(path) if path.exists() else GONE
    except OSError:
        return None


def _said(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"[:500]
