"""The audit log of a cell: entries are appended and never removed.

One JSON line an entry, each with the digest of the one before: the chain reveals lines that were
edited, removed, moved or added. An entry is on the disk before `append` returns, written in one
piece under a lock. A killed writer leaves at most an unfinished line. That line stays; the next
entry begins on a line of its own and records its digest.

Next to the log is FILE.head with the digest of its last entry: a chain alone cannot show that its
end, or all of it, is missing. docs/decisions/0036 says what this defends against.
"""

from __future__ import annotations

import codecs
import contextlib
import errno
import fcntl
import json
import logging
import os
import stat
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from enum import Enum
from pathlib import Path

from daq.errors import AuditUnusable, WriteUnconfirmed, counted, reason_of
from daq.files import (
    follow_links,
    fsync_folder,
    is_marked,
    read_regular,
    require_takes_files,
    sha256,
    sha256_of,
)

_LOG = logging.getLogger("drivegain")
MAX_BYTES = 2**30  #: Largest audit log; it is read whole
_TRIES, _PAUSE_S = 100, 0.05  #: For the lock, which is held for one line
FIRST = "0" * 64  #: Previous digest of the first entry
GONE = "gone"  #: Takes the place of a missing file's digest
BACKUPS_WITHOUT_LOG = "backups_without_log"
"""Detail of the first write in a log: the number of backups of earlier writes,
which this log does not have.
"""
_BEGINNING = b'{"action":"'  #: Begin of every line: the keys are sorted
#: Before the digest of a line; in a text of it, the quotation marks would be escaped
_DIGEST = b',"sha256":"'
_DIGITS = 64  #: Of a digest, hexadecimal
CONVERT_BACK = (
    "keep a copy, convert the file back to UTF-8 without a BOM and with line ends LF "
    "(`dos2unix FILE`), check it with `drivegain history CELL --verify`, and end what converts it, "
    "such as an editor, or git (`*.jsonl -text` in .gitattributes)"
)
"""What to do about an audit log that another program has converted."""


class AuditAction(Enum):
    """Kinds of entries."""

    PROPOSED = "proposed"
    REFUSED = "refused"
    APPLY_BEGUN = "apply begun"
    APPLIED = "applied"
    ROLLBACK_BEGUN = "rollback begun"
    ROLLED_BACK = "rolled back"
    FAILED = "failed"
    #: A write was asked for, and the target had this content already
    NOTHING_TO_DO = "nothing to do"
    RECALIBRATION_BEGUN = "recalibration begun"
    RECALIBRATION_ENDED = "recalibration ended"
    ACCEPTED = "accepted"
    """A calibration was tried in the cell and accepted; details:
    cell, session, SHA-256 of the calibration's file.
    """
    NOT_ACCEPTED = "not accepted"
    """A calibration was tried in the cell, and new moves contradict it;
    details as of ACCEPTED, and how to undo it.
    """
    ACKNOWLEDGED = "acknowledged"
    CALIBRATION_ENTERED = "calibration entered"
    """The history has this calibration; details:
    SHA-256 of its file, cell, time, document, and its figures.
    """
    RENAMED = "renamed"
    """A cell has another name; details: `old_name`, `cell`, robot.

    It counts for the entries before it.
    """
    WRITE_FOUND = "write found"
    """A controller has these gains, though no entry ends the write that put them there;
    details as of its begin.
    """
    TORN_LINE = "torn line"
    """The line before was left by a writer that was killed or had no room; details:
    its length and SHA-256.
    """


@dataclass(frozen=True, slots=True)
class AuditEntry:
    """One entry."""

    number: int  #: from 1, without gaps
    at: str  #: ISO 8601 time with its zone
    who: str  #: the person or the job
    action: AuditAction  #: kind of entry
    subject: str  #: for a write, the controller file with symbolic links followed, or the drives
    details: dict[str, object]  #: plain JSON; see docs/reference/audit-and-history.md
    previous: str  #: `sha256` of the entry before, `FIRST` for the first
    sha256: str  #: of the canonical JSON of all of the above, hexadecimal


def entry(
    number: int,
    at: str,
    who: str,
    action: AuditAction,
    subject: str,
    details: Mapping[str, object],
    previous: str,
) -> AuditEntry:
    """Make an entry with its digest.

    Raises:
        TypeError, ValueError: the details are no JSON, or have a number that is not finite.
    """
    # As it will be read: with lists for tuples, so that what is returned is what is in the file.
    plain: dict[str, object] = json.loads(_canonical(dict(details)))
    unsigned = AuditEntry(number, at, who, action, subject, plain, previous, "")
    return replace(unsigned, sha256=sha256(_canonical(_content(unsigned))))


def entry_after(
    before: AuditEntry | None,
    at: str,
    who: str,
    action: AuditAction,
    subject: str,
    details: Mapping[str, object],
) -> AuditEntry:
    """Make the entry that follows another one, or the first one; raises as `entry`."""
    if before is None:
        return entry(1, at, who, action, subject, details, FIRST)
    return entry(before.number + 1, at, who, action, subject, details, before.sha256)


def encode(one: AuditEntry) -> bytes:
    """Return the line without its end."""
    return _canonical({**_content(one), "sha256": one.sha256})


_TYPES = {
    **dict.fromkeys(("at", "who", "action", "subject", "previous", "sha256"), str),
    **{"number": int, "details": dict},
}


def _decode(line: bytes) -> tuple[AuditEntry | None, bool]:
    """Return the entry of a line, None for one that `encode` could not write,
    and whether its digest is right.
    """
    try:
        tree = json.loads(line)
        if (
            not isinstance(tree, dict)
            or {name: type(value) for name, value in tree.items()} != _TYPES
        ):
            return None, False
        found = AuditEntry(**{**tree, "action": AuditAction(tree["action"])})
        # Encoding again costs four times as much as reading: it is only done to tell what a changed
        # line is.
        if found.sha256 == _digest_of_line(line):
            return found, True
        return (found if encode(found) == line else None), False
    except (ValueError, TypeError, RecursionError):
        return None, False


def _digest_of_line(line: bytes) -> str:
    """Return the SHA-256 of a line without the digest in it, as `entry` computes it."""
    before, _, after = line.rpartition(_DIGEST)
    return sha256(before + after[_DIGITS + 1 :])


def _is_fragment(line: bytes) -> bool:
    """Whether a line can be the begin of an unfinished entry, which is never JSON.

    Zeros after it, or alone, are left by a power cut. Any other text is from another file.
    """
    begun = line.rstrip(b"\0")
    if not begun.startswith(_BEGINNING) and not _BEGINNING.startswith(begun):
        return False
    with contextlib.suppress(RecursionError):
        try:
            json.loads(line)
        except ValueError:
            return True
    return False


def _content(one: AuditEntry) -> dict[str, object]:
    return {
        "number": one.number,
        "at": one.at,
        "who": one.who,
        "action": one.action.value,
        "subject": one.subject,
        "details": one.details,
        "previous": one.previous,
    }


def _canonical(tree: object) -> bytes:
    """Encode as JSON with one spelling for one content: sorted keys, no spaces, ASCII, no NaN."""
    return json.dumps(tree, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def append(
    path: Path,
    action: AuditAction,
    *,
    at: datetime,
    who: str,
    subject: str,
    details: Mapping[str, object],
) -> AuditEntry:
    """Append an entry durably; a new file is made in an existing folder.

    A note next to it that cannot be written is a warning: the entry is on the disk.

    Raises:
        AuditUnusable: no regular file, locked for long, or its last line is not what was written.
        OSError: from the file system; nothing was written.
        WriteUnconfirmed: the file system failed while it took the entry, or at its flush: the entry
            may be there, or an unfinished line.
    """
    with _locked(path) as descriptor:
        if os.fstat(descriptor).st_size > MAX_BYTES:
            raise _no_file(path, f"more than {MAX_BYTES} bytes")
        with os.fdopen(descriptor, "rb", closefd=False) as stream:
            content = stream.read()
        last, unfinished = _end_of(content, path)
        # The entries of one write have one time: the first of them warns for all.
        is_first = last is None or (last.at, last.who) != (at.isoformat(), who)
        line = b"" if not content or content.endswith(b"\n") else b"\n"
        if unfinished:
            torn = _torn_details(unfinished)
            last = entry_after(last, at.isoformat(), who, AuditAction.TORN_LINE, subject, torn)
            line += encode(last) + b"\n"
        new = entry_after(last, at.isoformat(), who, action, subject, details)
        line += encode(new) + b"\n"
        _write_all(descriptor, line, path)
        try:
            os.fsync(descriptor)
            if not content:
                fsync_folder(Path(os.path.realpath(path)).parent)
        except OSError as error:
            raise WriteUnconfirmed.of(path, error) from error
        try:
            _note_head(path, content, new.sha256)
        except OSError as error:
            # A close can fail after the complete note was written.
            is_noted = noted_heads(path)[-1:] == (new.sha256,)
            if is_first and not is_noted:
                _LOG.warning("%s", _says_not_noted(path, error))
        return new


def try_append(path: Path) -> None:
    """Try whether an entry could be appended to an audit log; nothing is written.

    Raises:
        AuditUnusable: as `append`, but for its last line.
        OSError: from the file system.
    """
    _require_target(path)
    target = follow_links(path)
    if not target.exists():
        require_takes_files(target.parent)
        return
    with _locked(path):
        pass


def _write_all(descriptor: int, data: bytes, path: Path) -> None:
    """Write all bytes, in several calls where the system takes a part:
    the next call says why it took no more.

    Raises:
        OSError: from the file system, which took nothing.
        WriteUnconfirmed: it took a part, which stays.
    """
    rest = memoryview(data)
    while rest:
        try:
            taken = _write_part(descriptor, rest)
        except OSError as error:
            if len(rest) == len(data):
                raise
            raise WriteUnconfirmed.of(path, error) from error
        rest = rest[taken:]


def _write_part(descriptor: int, data: memoryview) -> int:
    taken = os.write(descriptor, data)
    if taken == 0:
        raise OSError(errno.EIO, "the file system takes no more of an entry")
    return taken


def noted_heads(path: Path) -> tuple[str, ...]:
    """Return the digests of entries that were noted next to an audit log, and that it must have;
    none without a note.

    The last one is that of the last entry. Others are of entries that were missing when the next
    one was appended.
    """
    try:
        text = read_regular(head_file(path), MAX_BYTES).decode(errors="replace")
    except OSError:
        return ()
    lines = text.split("\n")
    return tuple(
        line for line in lines if len(line) == _DIGITS and set(line) <= set("0123456789abcdef")
    )


def head_file(path: Path) -> Path:
    """Return the note next to an audit log, FILE.head; symbolic links to the log are followed."""
    target = Path(os.path.realpath(path))
    return target.with_name(f"{target.name}.head")


def note_obstacle(path: Path) -> str:
    """Say why the next entry of an audit log could not be noted; empty where it could."""
    try:
        os.close(_open_note(path))
    except FileNotFoundError:
        # It will be made, where its folder takes a file.
        if not os.access(head_file(path).parent, os.W_OK):
            refused = OSError(errno.EACCES, "no file can be made in its folder")
            return _says_not_noted(path, refused)
    except OSError as error:
        return _says_not_noted(path, error)
    return ""


def _says_not_noted(path: Path, error: OSError) -> str:
    """Say what it means that the note next to an audit log cannot be written, and what to do."""
    note = head_file(path)
    reason = reason_of(error)
    remedy = "free space or rights"
    if note.is_symlink() or (note.exists() and not note.is_file()):
        remedy = "remove what has its name"
    elif is_marked(note) or is_marked(note.parent):
        reason = "marked as immutable or append-only"
        remedy = "take off the mark (`chattr -i -a`)"
    return (
        f"the digest of the last entry cannot be noted in {note} ({reason}): a missing end of the "
        f"audit log would not be noticed; {remedy}, and the next entry is noted again"
    )


def _open_note(path: Path, flags: int = 0) -> int:
    """Open the note next to an audit log for writing, never through a link.

    Raises:
        OSError: it cannot be written, or is no regular file.
    """
    note = head_file(path)
    flags |= os.O_WRONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    descriptor = os.open(note, flags, 0o666)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "something that is no regular file", str(note))
    return descriptor


def _note_head(path: Path, content: bytes, head: str) -> None:
    """Note the last entry; the caller has the lock, and `content` is what was before it.

    The note is older than the log after a kill, which is harmless: the chain has older entries too.

    Raises:
        OSError: the note cannot be written.
    """
    missing = [one for one in noted_heads(path) if not _has_entry(content, one)]
    noted = "".join(f"{one}\n" for one in (*missing, head)).encode()
    descriptor = _open_note(path, os.O_CREAT)
    try:
        # In place: there are never fewer lines than before, but where a missing entry came back,
        # or where the disk takes a part and no more.
        _replace_in_place(descriptor, noted)
    finally:
        os.close(descriptor)


def _has_entry(content: bytes, digest: str) -> bool:
    """Whether there is a complete entry of a digest; the beginning of one can have it, too."""
    mark = _mark_of(digest)
    for line in _lines_of(content):
        if mark not in line:
            continue
        one, _ = _decode(line)
        if one is not None and one.sha256 == digest:
            return True
    return False


def _mark_of(digest: str) -> bytes:
    """Return the part of a line that has its digest."""
    return _DIGEST + digest.encode() + b'"'


def _replace_in_place(descriptor: int, lines: bytes) -> None:
    """Replace the lines of a file; where the disk takes a part, the lines that it took remain.

    The beginning of a new digest before the end of an old one would be the digest of no entry, and
    a sound log would seem to lack its end.

    Raises:
        OSError: from the file system.
    """
    taken = 0
    try:
        while taken < len(lines):
            taken += os.pwrite(descriptor, lines[taken:], taken)
    finally:
        # Nothing was taken: the lines of before are whole.
        if taken:
            os.ftruncate(descriptor, lines.rfind(b"\n", 0, taken) + 1)


def read(path: Path) -> tuple[AuditEntry, ...]:
    """Return all entries, oldest first, unverified; none where there is no file.

    Raises:
        AuditUnusable: no regular file, or it cannot be read.
    """
    decoded = [_decode(line) for line in _lines_of(_content_of(path))]
    return tuple(one for one, _ in decoded if one is not None)


def verify(path: Path, heads: Collection[str] = ()) -> AuditVerdict:
    """Check that the audit log is what was written,
    and find writes that were begun and never ended.

    A chain alone cannot show that its last lines are missing: `heads` are the digests of entries
    noted elsewhere. A missing file is an empty one.

    Raises:
        AuditUnusable: no regular file, or it cannot be read.
    """
    return judge_chain(_content_of(path), digest_now, heads)


def _end_of(content: bytes, path: Path) -> tuple[AuditEntry | None, list[bytes]]:
    """Return the last entry and the unfinished lines after it.

    Raises:
        AuditUnusable: the last line is something else.
    """
    unfinished: list[bytes] = []
    for number, line in reversed(list(enumerate(_lines_of(content), start=1))):
        one, holds = _decode(line)
        if one is not None and holds:
            return one, unfinished[::-1]
        if one is not None or not _is_fragment(line):
            _, conversion = _undo_conversion(content)
            if conversion:
                raise AuditUnusable(
                    str(path),
                    found=f"{conversion}, by another program",
                    expected="an audit log as drivegain writes it",
                    remedy=f"{CONVERT_BACK}; nothing was written",
                )
            raise AuditUnusable(
                str(path),
                found=f"line {number}, which drivegain did not write",
                expected="an audit log whose entries were never changed",
                remedy="if this is another file, correct `history.audit` of the cell file or "
                "--audit; if it is the audit log, check it with `drivegain history --verify`, then "
                "move it away, keep it, and begin another; nothing was written",
            )
        unfinished.append(line)
    return None, unfinished[::-1]


def _undo_conversion(content: bytes) -> tuple[bytes, str]:
    """Return an audit log without what another program has converted, and what that was in words;
    the content as it is, and no words, where it was not converted.

    No entry has a carriage return or a BOM: its text is escaped.
    """
    text = content
    conversions = []
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        with contextlib.suppress(UnicodeError):
            text = content.decode("utf-16").encode()
            conversions.append("its encoding was converted (UTF-16)")
    elif content.startswith(codecs.BOM_UTF8):
        text = content.removeprefix(codecs.BOM_UTF8)
        conversions.append("its encoding was converted (UTF-8 with a BOM)")
    line_ends = text.count(b"\n")
    if line_ends > 0 and text.count(b"\r\n") == line_ends:
        text = text.replace(b"\r\n", b"\n")
        conversions.append("its line ends were converted (CRLF)")
    has_entries = bool(conversions) and any(_decode(line)[1] for line in _lines_of(text))
    if not has_entries:
        return content, ""
    return text, " and ".join(conversions)


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[int]:
    _require_target(path)
    # O_NONBLOCK: a FIFO of that name must not keep us waiting for its other end.
    flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK
    try:
        descriptor = os.open(follow_links(path), flags, 0o666)
    except IsADirectoryError as error:
        raise _no_file(path, "a folder") from error
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise _no_file(path, "something that is no regular file")
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
        # The entry was flushed; the descriptor is closed all the same (close(2))
        with contextlib.suppress(OSError):
            os.close(descriptor)


def _content_of(path: Path) -> bytes:
    try:
        return read_regular(path, MAX_BYTES)
    except FileNotFoundError:
        _require_target(path)
        return b""
    except PermissionError as error:
        raise AuditUnusable(
            str(path),
            found="no right to read it",
            expected="an audit log that this user may read and write",
            remedy="check its owner and rights; nothing was written",
        ) from error
    except OSError as error:
        raise _no_file(path, reason_of(error)) from error


def _require_target(path: Path) -> None:
    """Refuse a link that leads to no file:
    an audit log on a disk that is not mounted is not a new one.
    """
    if path.is_symlink() and not path.exists():
        raise AuditUnusable(
            str(path),
            found=f"a link to {path.readlink()}, where there is no file",
            expected="a link to the cell's audit log",
            remedy="mount the disk that it is on, or correct the link; for a new audit log there "
            "make an empty file; nothing was written",
        )


def _no_file(path: Path, found: str) -> AuditUnusable:
    return AuditUnusable(
        str(path),
        found=found,
        expected="the cell's audit, a regular file",
        remedy="correct `history.audit` of the cell file, or --audit where you gave it; nothing "
        "was written",
    )


def digest_now(subject: str) -> str | None:
    """Return the SHA-256 of a file as it is now, `GONE` without one, None where it cannot be read,
    and for drives: their subject is a name, and they are on a bus.
    """
    path = Path(subject)
    if not path.is_absolute():
        return None
    try:
        return sha256_of(path) if path.exists() else GONE
    except OSError:
        return None


_BEGUN = (AuditAction.APPLY_BEGUN, AuditAction.ROLLBACK_BEGUN)
_ENDS = (AuditAction.APPLIED, AuditAction.ROLLED_BACK, AuditAction.FAILED)


class Flaw(Enum):
    """Kinds of changes to a line."""

    EDITED = "edited"
    REMOVED = "removed"
    MOVED = "moved"
    ADDED = "added"
    CUT_OFF = "cut off"
    CONVERTED = "converted"  #: The whole file, by another program; entries are judged as before it
    UNFINISHED = "unfinished"  #: The entry was complete when it was noted; its end is lost


_MISSING_ENTRY = frozenset({Flaw.CUT_OFF, Flaw.UNFINISHED})  #: An entry that was noted is missing


@dataclass(frozen=True, slots=True)
class AuditFlaw:
    """One place where the audit log is not what was written."""

    line: int  #: in the file, from 1; of a removed line, the line that is in its place
    flaw: Flaw  #: its kind, as far as the chain shows it
    says: str  #: the same as a sentence


class Content(Enum):
    """Content of a controller file after a write that was begun and not ended."""

    BEFORE = "as before the write"
    AFTER = "the new content"
    OTHER = "neither: it was changed or removed since"
    UNKNOWN = "not known: the file cannot be read, or the entry has no digests"


@dataclass(frozen=True, slots=True)
class OpenWrite:
    """A write without an entry that ends it: its writer was killed."""

    begun: AuditEntry  #: the entry
    #: of the file afterwards: as the next write found it, or, where there was none, as it is now
    content: Content


@dataclass(frozen=True, slots=True)
class AuditVerdict:
    """Result of checking a chain."""

    entries: tuple[AuditEntry, ...]  #: all of them, in the order of the file
    intact: tuple[AuditEntry, ...]  #: those whose digest is that of their content
    flaws: tuple[AuditFlaw, ...]  #: by their lines; empty for an intact chain
    #: Lines, from 1, that a killed writer left unfinished. They are no flaw, but where an entry is
    #: missing, one of them may be what is left of it.
    torn: tuple[int, ...]
    open_writes: tuple[OpenWrite, ...]  #: begun and not ended

    @property
    def holds(self) -> bool:
        """Whether every entry is what was written and none is missing,
        as far as a chain can show it.
        """
        return not self.flaws

    @property
    def lacks_noted(self) -> bool:
        """Whether an entry that was noted elsewhere is missing."""
        return any(flaw.flaw in _MISSING_ENTRY for flaw in self.flaws)

    @property
    def is_only_converted(self) -> bool:
        """Whether the entries are what was written, in a file that was converted."""
        return [flaw.flaw for flaw in self.flaws] == [Flaw.CONVERTED]

    @property
    def is_torn_end(self) -> bool:
        """Whether unfinished lines and a noted entry that is missing are all that is wrong: a disk
        that lost the last bytes leaves that, and so does a person who cuts them off.
        """
        kinds = {flaw.flaw for flaw in self.flaws}
        has_remains = Flaw.UNFINISHED in kinds or self.may_be_torn
        return bool(kinds) and kinds <= _MISSING_ENTRY and has_remains

    @property
    def may_be_torn(self) -> bool:
        """Whether an unfinished line may be what is left of a noted entry that is missing."""
        is_cut_off = any(flaw.flaw is Flaw.CUT_OFF for flaw in self.flaws)
        return is_cut_off and bool(self.torn)

    @property
    def broken(self) -> int | None:
        """First line that is not what was written; None where there is none."""
        return self.flaws[0].line if self.flaws else None


def judge_chain(
    content: bytes, digest_now: Callable[[str], str | None], heads: Collection[str] = ()
) -> AuditVerdict:
    """Check a chain.

    Args:
        content: of the audit log.
        digest_now: SHA-256 of a controller file by its path, `GONE` where there is none, None where
            it cannot be read.
        heads: digests of entries that were noted elsewhere. One that is not in the chain shows that
            its end is missing.
    """
    text, conversion = _undo_conversion(content)
    chain = _Chain(text)
    for index, (one, holds) in enumerate(chain.decoded):
        if one is None:
            chain.unfinished.append(index)
        else:
            chain.take(index, one, holds=holds)
    chain.settle(None)
    entries = tuple(one for one, _ in chain.decoded if one is not None)
    chain.find_missing(set(heads) - {one.sha256 for one in entries})
    if conversion:
        chain.flaws.append(AuditFlaw(1, Flaw.CONVERTED, conversion))
    flaws = tuple(sorted(chain.flaws, key=lambda flaw: flaw.line))
    return AuditVerdict(
        entries=entries,
        intact=tuple(one for one, holds in chain.decoded if one is not None and holds),
        flaws=flaws,
        torn=tuple(chain.torn),
        open_writes=tuple(open_writes(entries, digest_now)),
    )


def _lines_of(content: bytes) -> list[bytes]:
    """Split into lines; the last one may lack its end."""
    lines = content.split(b"\n")
    return lines if lines[-1] else lines[:-1]


def _torn_details(fragments: Sequence[bytes]) -> dict[str, object]:
    """Return the details of the entry after unfinished lines."""
    joined = b"\n".join(fragments)
    return {"torn_bytes": len(joined), "torn_sha256": sha256(joined)}


class _Chain:
    """A walk from line to line, with the entry that must come next."""

    def __init__(self, content: bytes) -> None:
        self.lines = _lines_of(content)
        self.decoded = [_decode(line) for line in self.lines]
        """The entry of each line, None for a line that is none,
        and whether its digest is that of its content.
        """
        self.numbers = Counter(one.number for one, _ in self.decoded if one is not None)
        self.flaws: list[AuditFlaw] = []
        self.torn: list[int] = []
        self.unfinished: list[int] = []
        """Lines that are no entries, since the last one that is."""
        self.number = 1
        self.previous: str | None = FIRST
        """Digest that the next entry must follow; None after a broken line."""
        self.place = 1
        """Line of the entry before."""

    def take(self, index: int, one: AuditEntry, *, holds: bool) -> None:
        """The next line, which is an entry."""
        self.settle(one)
        place = index + 1
        if not holds:
            self._add_flaw(
                place, Flaw.EDITED, f"the digest of entry {one.number} is not that of its content"
            )
            self.number += 1
            self.previous = None
            self.place = place
            return
        if one.number < self.number:
            twice = self.numbers[one.number] > 1
            says = (
                f"entry {one.number} "
                f"{'is there more than once' if twice else 'is after a later one'}"
            )
            self._add_flaw(place, Flaw.ADDED if twice else Flaw.MOVED, says)
            return
        if one.number > self.number:
            missing = range(self.number, one.number)
            gone = [number for number in missing if number not in self.numbers]
            if gone:
                if len(gone) == 1:
                    which = f"entry {gone[0]} is"
                else:
                    which = f"entries {gone[0]} to {gone[-1]} are"
                self._add_flaw(place, Flaw.REMOVED, f"{which} missing before entry {one.number}")
            else:
                self._add_flaw(
                    place, Flaw.MOVED, f"entry {one.number} is before entry {missing[0]}"
                )
        elif self.previous is not None and one.previous != self.previous:
            says = (
                f"entry {one.number} follows another entry than the one before it, which was "
                "put in its place"
            )
            self._add_flaw(self.place, Flaw.EDITED, says)
        self.number = one.number + 1
        self.previous = one.sha256
        self.place = place

    def settle(self, follower: AuditEntry | None) -> None:
        """Judge lines that are no entries: left by a killed writer, or changed."""
        fragments = [self.lines[index] for index in self.unfinished]
        is_torn = follower is not None and follower.action is AuditAction.TORN_LINE
        if follower is not None and is_torn and follower.details != _torn_details(fragments):
            says = f"entry {follower.number} reports an unfinished line that is not there as it was"
            self._add_flaw(
                self.unfinished[0] + 1 if fragments else self.place + 1, Flaw.EDITED, says
            )
        elif is_torn or (follower is None and all(map(_is_fragment, fragments))):
            self.torn += [index + 1 for index in self.unfinished]
        else:
            for index in self.unfinished:
                self._add_flaw(index + 1, Flaw.EDITED, "no entry as drivegain writes them")
            if fragments:
                self.number += len(fragments)
                self.previous = None
        self.unfinished = []

    def find_missing(self, digests: Collection[str]) -> None:
        """Report entries that were noted elsewhere and are missing, at what is left of them."""
        missing = []
        for digest in sorted(digests):
            place = self._beginning_of(digest)
            if place is None:
                missing.append(digest[:12])
                continue
            self.torn.remove(place)
            says = f"the beginning of an entry noted elsewhere ({digest[:12]}), whose end is lost"
            self._add_flaw(place, Flaw.UNFINISHED, says)
        if missing:
            count = counted(len(missing), "entry")
            says = f"{count} noted elsewhere and missing here: {', '.join(missing)}"
            self._add_flaw(len(self.lines) + 1, Flaw.CUT_OFF, says)

    def _beginning_of(self, digest: str) -> int | None:
        """Return the unfinished line that has the digest of its entry; None where there is none."""
        mark = _mark_of(digest)
        for place in self.torn:
            if mark in self.lines[place - 1]:
                return place
        return None

    def _add_flaw(self, line: int, flaw: Flaw, says: str) -> None:
        self.flaws.append(AuditFlaw(line, flaw, says))


def open_writes(
    entries: Sequence[AuditEntry], digest_now: Callable[[str], str | None]
) -> Iterator[OpenWrite]:
    """Find writes that were begun and never ended. Args as of `judge_chain`."""
    ended = {begun_by(one) for one in entries if one.action in _ENDS}
    begins = [one for one in entries if one.action in _BEGUN]
    for place, one in enumerate(begins):
        if one.number in ended:
            continue
        # The next write read the file under its lock, before it changed anything: that is nearer
        # than the file now.
        witness = next(
            (later for later in begins[place + 1 :] if later.subject == one.subject), None
        )
        if witness is None:
            found = digest_now(one.subject)
        else:
            found = _digest_before(witness)
        before = _digest_before(one)
        after = one.details.get("sha256_after")
        if found is None or before is None or not isinstance(after, str):
            yield OpenWrite(one, Content.UNKNOWN)
        else:
            yield OpenWrite(
                one, {before: Content.BEFORE, after: Content.AFTER}.get(found, Content.OTHER)
            )


def unmade_write(verdict: AuditVerdict, subject: str) -> AuditEntry | None:
    """Return the last write to a file or to drives where it was begun and not made; else None.

    A write that has failed counts where the content from before it was in place then.

    Args:
        verdict: of `verify`, which has read the file.
        subject: as the audit log names it.
    """
    begun = [one for one in verdict.entries if one.action in _BEGUN and one.subject == subject]
    if not begun:
        return None
    last = begun[-1]
    unmade = [one.begun for one in verdict.open_writes if one.content is Content.BEFORE]
    if last in unmade:
        return last
    for one in verdict.entries:
        has_failed = one.action is AuditAction.FAILED and begun_by(one) == last.number
        if has_failed and one.details.get("sha256_found") == _digest_before(last):
            return last
    return None


def begun_by(entry: AuditEntry) -> int:
    """Return the number of the entry that began the write, 0 where there is none."""
    found = entry.details.get("begun")
    return found if isinstance(found, int) else 0


def made_writes(opened: Iterable[OpenWrite]) -> list[OpenWrite]:
    """Return the writes without an end whose content was found afterwards."""
    return [one for one in opened if one.content is Content.AFTER]


def witnessed_writes(entries: Sequence[AuditEntry]) -> list[OpenWrite]:
    """Return the writes without an end of which a later entry shows that they were made."""
    return made_writes(open_writes(entries, lambda _: None))


def _digest_before(begun: AuditEntry) -> str | None:
    """Return the digest of the file when the write began, `GONE` without a file,
    None for an entry without one.
    """
    recorded = begun.details.get("sha256_before", 0)
    if recorded is None:
        return GONE
    return recorded if isinstance(recorded, str) else None
