"""A write to a controller, written down: that it begins, before anything is replaced, and how it ended."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TypeVar

from daq.digest import sha256
from daq.errors import AuditUnusable, CalibrationRefused
from daq.write_back.audit import AuditAction, AuditEntry, append, digest_now
from daq.write_back.gates import Refusal

_LOG = logging.getLogger("drivegain")
_NOT_WRITTEN = (OSError, AuditUnusable)
_Done = TypeVar("_Done")


@dataclass(frozen=True, slots=True)
class Chronicle:
    """Where writes are written down, and in whose name.

    Attributes:
        audit: file; None for a library that keeps none.
        who: the person or the job.
        at: when.
    """

    audit: Path | None
    who: str
    at: datetime

    def of_write(
        self,
        begun: AuditAction,
        ended: AuditAction,
        target: Path,
        before: bytes | None,
        after: bytes,
        details: Mapping[str, object],
        write: Callable[[], _Done],
    ) -> tuple[_Done, str | None]:
        """Replace a file, told before and after.

        Args:
            begun, ended: what is written down before it, and after it when all went well.
            target: the file, symbolic links followed.
            before, after: content; before is None where the file is gone.
            details: what else is to be known of it.
            write: replaces it.

        Returns:
            what `write` returns, and SHA-256 of the audit's last entry about it, None without an audit: whoever keeps
            it elsewhere notices an audit whose end was cut off.

        Raises:
            AuditUnusable, OSError: the beginning could not be written down; the file stands as it was.
            Exception: whatever `write` raises.
        """
        if self.audit is None:
            return write(), None
        digests = {"sha256_before": None if before is None else sha256(before), "sha256_after": sha256(after)}
        entry = self._append(self.audit, begun, target, {**digests, **details})
        try:
            done = write()
        except BaseException as error:  # an interrupt ends a write too
            # An interrupt may come when all is done: the digest says what stands there, whatever the error says.
            found = {"begun": entry.number, "error": _said(error), "sha256_found": digest_now(str(target))}
            self._end(self.audit, AuditAction.FAILED, target, found)
            raise
        told = self._end(self.audit, ended, target, {"begun": entry.number})
        return done, (told or entry).sha256

    def refusal(self, target: Path, refusals: Sequence[Refusal], details: Mapping[str, object]) -> None:
        """Somebody asked for a write, and gates were closed."""
        told = [{"gate": one.gate.value, "subject": one.subject, "found": one.found} for one in refusals]
        self._refused(target, {"refusals": told, **details})

    def nothing_to_do(self, target: Path, content: bytes, details: Mapping[str, object]) -> None:
        """Somebody asked for a write of what stands there already."""
        if self.audit is not None:
            self._end(self.audit, AuditAction.NOTHING_TO_DO, target, {"sha256_found": sha256(content), **details})

    @contextlib.contextmanager
    def of_question(self, target: Path, details: Mapping[str, object]) -> Iterator[None]:
        """Around what is asked of a file before it is written; a no is written down."""
        try:
            yield
        except CalibrationRefused as error:
            told = {"gate": "file", "subject": error.subject, "found": error.found}
            self._refused(target, {"refusals": [told], **details})
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
            # What was done stands, and the beginning with the digests tells of it: no reason to call it undone.
            _LOG.warning("the audit could not be told that it is %s: %s", action.value, error)
            return None


def _said(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"[:500]
