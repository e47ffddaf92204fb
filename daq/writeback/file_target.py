"""The controller file on the disk: one writer at a time, written down, a backup first, replaced whole; and back."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from pathlib import Path

from daq.config.controller import ControllerFormat
from daq.errors import CalibrationRefused, ControllerChanged
from daq.files import replace_file, sha256
from daq.ledger.audit import AuditAction, AuditRecorder
from daq.writeback.file_access import Backup, back_up, backups, exclusive_writer, put_back, resolve_links, short_digest
from daq.writeback.formats.document import decode, read_bytes


@dataclass(frozen=True, slots=True)
class Written:
    """What a replacement did.

    Attributes:
        file: the file that was replaced, symbolic links followed.
        backup: where its former content is.
        before, after: content.
        audit_sha256: of the audit's entry that tells of it, for whoever keeps it elsewhere; None without an audit.
    """

    file: Path
    backup: Path
    before: bytes
    after: bytes
    audit_sha256: str | None = None


@dataclass(frozen=True, slots=True)
class Restored:
    """What a way back did.

    Attributes:
        file: the controller file, symbolic links followed.
        source: the backup that it was restored from.
        backup: where its former content is, None where the file was gone.
        before, after: content; before is empty where the file was gone.
        audit_sha256: as of `Written`.
    """

    file: Path
    source: Path
    backup: Path | None
    before: bytes
    after: bytes
    audit_sha256: str | None = None


def write(
    file: Path,
    after: bytes,
    base_sha256: str,
    check: Callable[[bytes], None],
    now: datetime,
    *,
    audit: Path | None = None,
    who: str = "",
    details: Mapping[str, object] | None = None,
) -> Written:
    """Replace a controller file, if it is still the one that was looked at.

    Args:
        file: the controller file, or a symbolic link to it.
        after: its new content.
        base_sha256: digest of the content that the change was worked out for.
        check: called with what the disk gives back before anything is replaced.
        now: time for the backup's name and the audit.
        audit: where it is written down, before anything is replaced and after; None for nowhere.
        who: in whose name.
        details: what else the audit shall know.

    Raises:
        ControllerChanged: somebody has changed the file since, or saves it while it is written.
        CalibrationRefused: somebody is writing it.
        ControllerUnfit: from `check`, or it cannot be read.
        AuditUnusable: it could not be written down; the old content stands.
        OSError: from the file system; the old content stands, and neither backup nor temporary file is left.
    """
    target = resolve_links(file)
    recorder, known = AuditRecorder(audit, who, now), details or {}
    with contextlib.ExitStack() as lock:
        with recorder.record_refusal_of(target, known):
            lock.enter_context(exclusive_writer(target))
            before = read_bytes(target)
            found = sha256(before)
            if found != base_sha256:
                raise ControllerChanged(
                    str(file),
                    found=f"content {found[:12]}…",
                    expected=f"{base_sha256[:12]}…, for which the change was shown",
                    remedy="somebody has changed the file: look at a new dry run",
                )
        written, audit_digest = recorder.record_write(
            AuditAction.APPLY_BEGUN, AuditAction.APPLIED, target, before, after, known,
            partial(_replace, target, before, after, check, now),
        )  # fmt: skip
        return replace(written, audit_sha256=audit_digest)


def roll_back(
    file: Path,
    now: datetime,
    *,
    audit: Path | None = None,
    who: str = "",
    format: ControllerFormat | None = None,  # noqa: A002 - as the cell file calls it
) -> Restored:
    """Take the last write back: put the newest backup that differs from the file in its place.

    What it replaces becomes a backup too, so that a second way back undoes the first. A file that was deleted comes
    back as it was before the last write.

    Args:
        file: the controller file, or a symbolic link to it.
        now: time for the backup's name and the audit.
        audit, who: as in `write`.
        format: of the file; None where its name tells.

    Raises:
        CalibrationRefused: there is none.
        CalibrationRefused: somebody is writing the file.
        ControllerChanged: the file is not what was written when that backup was made: somebody has edited it since.
        ControllerUnfit: the file cannot be read; the backup was changed, or does not parse.
        AuditUnusable: it could not be written down; the file stands as it was.
        OSError: from the file system; the file stands as it was.
    """
    target = resolve_links(file)
    recorder = AuditRecorder(audit, who, now)
    with contextlib.ExitStack() as lock:
        with recorder.record_refusal_of(target, {"asked": "rollback"}):
            lock.enter_context(exclusive_writer(target))
            before = read_bytes(target) if target.exists() else None
            backup = _backup_to_restore(file, target, before)
            after = backup.content()
            if before is not None:
                _check_unedited(file, before, backup)
        details = {"restored": backup.path.name}
        check = partial(_check_parses, name=str(backup.path), format=format)
        restored, audit_digest = recorder.record_write(
            AuditAction.ROLLBACK_BEGUN, AuditAction.ROLLED_BACK, target, before, after, details,
            partial(_restore, target, before, after, backup, check, now),
        )  # fmt: skip
        return replace(restored, audit_sha256=audit_digest)


def _backup_to_restore(file: Path, target: Path, before: bytes | None) -> Backup:
    found = backups(target)
    for backup in reversed(found):
        # A writer that was killed before it replaced the file leaves a backup of what is still there.
        if before is None or backup.was != short_digest(before):
            return backup
    raise CalibrationRefused(
        str(file),
        found=f"{len(found)} backups with the same content" if found else "no backup beside it",
        expected=f"{target.name}.<time>.<digests>.bak with another content",
        remedy="nothing was changed",
    )


def _check_unedited(file: Path, before: bytes, backup: Backup) -> None:
    if short_digest(before) != backup.after_digest:
        one, other = shlex.quote(str(backup.path)), shlex.quote(str(file))
        raise ControllerChanged(
            str(file),
            found=f"content {short_digest(before)}…",
            expected=f"{backup.after_digest}…, as drivegain wrote it when it made {backup.path.name}",
            remedy="somebody has edited the file since, and going back would lose that; look at the difference with "
            f"`diff {one} {other}`; to go back all the same, `cp {one} {other}`",
        )


def _restore(
    target: Path, before: bytes | None, after: bytes, source: Backup, check: Callable[[bytes], None], now: datetime
) -> Restored:
    if before is not None:
        written = _replace(target, before, after, check, now)
        return Restored(target, source.path, written.backup, before, after)
    try:
        replace_file(target, after, check=_last_look(target, None, check), like=source.path)
    except BaseException:  # an interrupt too: what is restored is there whole, or not at all
        if _content(target) == after:  # and not what somebody else has put there
            target.unlink()
        raise
    return Restored(target, source.path, None, b"", after)


def _replace(target: Path, before: bytes, after: bytes, check: Callable[[bytes], None], now: datetime) -> Written:
    backup = back_up(target, before, after, now)
    try:
        replace_file(target, after, check=_last_look(target, before, check))
    except ControllerChanged:
        backup.unlink()
        raise
    except BaseException:
        # Before the rename the old file still stands; after it (the folder's fsync failed) the backup takes its place.
        # What somebody else has put there meanwhile stays, and so does the backup.
        found = _content(target)
        if found == before:
            backup.unlink()
        elif found == after:
            put_back(backup, target)
        raise
    return Written(target, backup, before, after)


def _last_look(target: Path, before: bytes | None, check: Callable[[bytes], None]) -> Callable[[bytes], None]:
    """What is asked right before the rename: the lock keeps every drivegain out, and no editor.

    Between the question and the rename are two calls of the system; whoever saves just then still loses it.
    """

    def look(written: bytes) -> None:
        check(written)
        found = _content(target)
        if found != before:
            raise ControllerChanged(
                str(target),
                found="no file any more" if found is None else f"content {sha256(found)[:12]}…",
                expected="no file, as before" if before is None else f"{sha256(before)[:12]}…, as before this write",
                remedy="somebody has saved the file meanwhile, and it stands as they did: look at a new dry run",
            )

    return look


def _content(target: Path) -> bytes | None:
    """Of the file as it is now, None where it is gone."""
    try:
        return target.read_bytes()
    except FileNotFoundError:
        return None


def _check_parses(content: bytes, name: str, format: ControllerFormat | None) -> None:  # noqa: A002
    decode(content, name, format).locate(())
