"""Who writes to a controller, and where that is written down: what `apply` and `rollback` share."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from daq.cli.terminal import interruptible
from daq.config.bus import cell_address, drive_axes
from daq.config.cell import Cell
from daq.environment import login
from daq.errors import AuditUnusable, DaqError, ExitCode, UsageError
from daq.files import sha256
from daq.ledger.judgement import NOTHING, Known, known_of
from daq.ledger.store import HistoryStore
from daq.workflow.safeguards import bus_lock
from daq.writeback.drive_target import DrivesWritten
from daq.writeback.gates.target import GainChange
from daq.writeback.request import Request
from drivers.canopen.network import CanopenNetwork
from drivers.canopen.parameters import Saving

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
    require_separate_audit(cell.history.audit, (cell.history.store, cell.controller_path, *others))
    return cell.history.audit


def require_separate_audit(audit: Path, others: Iterable[Path | None]) -> None:
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


def query_history(cell: Cell, target: str, request: Request, changes: Sequence[GainChange]) -> Known:
    """What the cell's history knows that a change is judged by; one that cannot be read knows nothing."""
    if cell.history is None:
        return NOTHING
    try:
        with HistoryStore(cell.history.store) as store:
            return known_of(store, target, sha256(request.signed), changes)
    except DaqError as error:
        _LOG.warning("the history cannot be read: the numbers in the controller are taken as exact: %s", error)
        return NOTHING


def record_in_history(cell: Cell, record: Callable[[HistoryStore], object]) -> None:
    """Let the cell's history know of what is done already; where it cannot take it, that is told and no more."""
    if cell.history is None:
        return
    try:
        with HistoryStore(cell.history.store) as store:
            record(store)
    except Exception as error:  # noqa: BLE001 - whatever it is, the controller has its gains: not to be called undone
        _LOG.warning("the history does not know of this: %s", error)


# What `drivegain apply --drives` and `drivegain rollback --drives` have in common.


DrivesOption = Annotated[
    bool, typer.Option("--drives", help="The objects in the drives that the cell names, not the controller's file.")
]
RamOnlyOption = Annotated[
    bool, typer.Option("--ram-only", help="Do not let the drives save: the gains are gone with their power.")
]
SaveUnknownOption = Annotated[
    bool, typer.Option("--save-unknown", help="Let drives save of which nobody knows what that keeps.")
]


def saving_of(ram_only: bool, save_unknown: bool) -> Saving:
    """What the two options mean together.

    Raises:
        UsageError: both.
    """
    if ram_only and save_unknown:
        raise UsageError(
            "--ram-only --save-unknown",
            found="both",
            expected="one at most: the drives save, or they do not",
            remedy="leave one out",
        )
    return Saving.RAM if ram_only else Saving.ANY if save_unknown else Saving.KNOWN


@contextmanager
def on_the_bus(declared: Cell) -> Iterator[CanopenNetwork]:
    """The drives of a cell, its buses locked; Ctrl-C and SIGTERM put back what was written until then."""
    address, axes = cell_address(declared), drive_axes(declared)
    try:
        with (
            bus_lock(declared),
            interruptible() as block_signals,
            CanopenNetwork(address, axes, block_signals=block_signals) as network,
        ):
            yield network
    except KeyboardInterrupt as interrupt:
        said = "; ".join(getattr(interrupt, "__notes__", ())) or "nothing was written to the drives"
        typer.echo(f"interrupted: {said}", err=True)
        raise typer.Exit(ExitCode.INTERRUPTED) from interrupt


def outcome(written: DrivesWritten) -> dict[str, Any]:
    """What was done, for --json."""
    return {
        "record": str(written.record),
        "source": None if written.source is None else str(written.source),
        "saved": all(change.saved for change in written.changes),
    }


def saving_text(saving: Saving) -> str:
    """Whether it stays, for a person."""
    if saving is Saving.RAM:
        return "The drives have NOT saved: the gains are gone with their power."
    return "The drives have saved."
