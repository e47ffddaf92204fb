"""Who writes to a controller, and where that is written down: what `apply` and `rollback` share."""

from __future__ import annotations

import getpass
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from daq.configuration.cell import Cell
from daq.errors import DaqError
from daq.history.store import HistoryStore

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
    """Whoever runs this, by the name given."""
    login = getpass.getuser()
    return Applier(by or login, login)


def audit_of(cell: Cell) -> Path | None:
    """Where the writes of a cell are written down; None only for a cell that was read from a log."""
    return None if cell.history is None else cell.history.audit


def tell_history(cell: Cell, tell: Callable[[HistoryStore], object]) -> None:
    """Let the cell's history know of what is done already; where it cannot take it, that is told and no more."""
    if cell.history is None:
        return
    try:
        with HistoryStore(cell.history.store) as store:
            tell(store)
    except DaqError as error:
        _LOG.warning("the history does not know of this: %s", error)
