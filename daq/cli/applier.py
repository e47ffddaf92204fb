"""Who writes to a controller, and where that is written down: what `apply` and `rollback` share."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from daq.configuration.cell import Cell
from daq.digest import sha256
from daq.errors import AuditUnusable, DaqError, UsageError
from daq.history.judgement import NOTHING, Known, known_of
from daq.history.store import HistoryStore
from daq.login import login
from daq.write_back.gain_gates import GainChange
from daq.write_back.request import Request

_LOG = logging.getLogger("drivegain")

ByOption = Annotated[str | None, typer.Option("--by", help="Who does it, for the audit; you, by default.")]


@dataclass(frozen=True, slots=True)
class Applier:
    """Whoever runs the command.

    Attributes:
        name: as given, or the login.
        login: of the operating system.
    """

    name: str
    login: str

    @property
    def names(self) -> tuple[str, ...]:
        """All that may be theirs: no second person has one of them."""
        return tuple(dict.fromkeys((self.name, self.login)))

    def __str__(self) -> str:
        return self.name if self.name == self.login else f"{self.name} (login {self.login})"


def applier(by: str | None) -> Applier:
    """Whoever runs this, by the name given.

    Raises:
        UsageError: the name cannot be written down.
    """
    user = login()
    if by is not None and not by.isprintable():
        raise UsageError(
            f"--by {by!a}", found="characters that cannot be shown", expected="a name", remedy="type it again"
        )
    return Applier(by or user, user)


def audit_of(cell: Cell, others: Iterable[Path | None]) -> Path | None:
    """Where the writes of a cell are written down; None only for a cell that was read from a log.

    Args:
        cell: whose writes.
        others: files that take part, besides the cell's history and its controller's file.

    Raises:
        AuditUnusable: it is one of them.
    """
    if cell.history is None:
        return None
    own_file(cell.history.audit, (cell.history.store, cell.controller_path, *others))
    return cell.history.audit


def own_file(audit: Path, others: Iterable[Path | None]) -> None:
    """Refuse an audit that is another file which takes part, by whatever name, there already or not.

    Raises:
        AuditUnusable: it is.
    """
    for other in others:
        if other is not None and (os.path.realpath(audit) == os.path.realpath(other) or _is_same(audit, other)):
            raise AuditUnusable(
                str(audit),
                found=f"the same file as {other}",
                expected="a file of the audit's own",
                remedy="correct `history.audit` of the cell file, or --audit; nothing was written",
            )


def _is_same(audit: Path, other: Path) -> bool:
    try:
        return audit.samefile(other)
    except OSError:
        return False


def ask_history(cell: Cell, target: str, request: Request, changes: Sequence[GainChange]) -> Known:
    """What the cell's history knows that a change is judged by; one that cannot be read knows nothing."""
    if cell.history is None:
        return NOTHING
    try:
        with HistoryStore(cell.history.store) as store:
            return known_of(store, target, sha256(request.signed), changes)
    except DaqError as error:
        _LOG.warning("the history cannot be read: the numbers in the controller are taken as exact: %s", error)
        return NOTHING


def tell_history(cell: Cell, tell: Callable[[HistoryStore], object]) -> None:
    """Let the cell's history know of what is done already; where it cannot take it, that is told and no more."""
    if cell.history is None:
        return
    try:
        with HistoryStore(cell.history.store) as store:
            tell(store)
    except Exception as error:  # noqa: BLE001 - whatever it is, the controller has its gains: not to be called undone
        _LOG.warning("the history does not know of this: %s", error)
