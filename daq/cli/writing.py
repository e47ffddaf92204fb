"""Shared by `apply` and `rollback`: the operator, the audit and the history, and the drives on their bus."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from daq.cli.terminal import interruptible
from daq.environment import login
from daq.errors import AuditUnusable, DaqError, ExitCode, UsageError

if TYPE_CHECKING:
    from daq.config.cell import Cell
    from daq.ledger.judgement import Known
    from daq.ledger.ledger import Ledger
    from daq.writeback.drive_target import DriveTarget
    from daq.writeback.request import GainChange, Request
    from drivers.canopen.parameters import Saving

_LOG = logging.getLogger("drivegain")

ByOption = Annotated[str | None, typer.Option("--by", help="Name of the operator for the audit; by default the login.")]


@dataclass(frozen=True, slots=True)
class Applier:
    """The operator."""

    name: str  #: as given, or the login
    login: str  #: of the operating system

    @property
    def names(self) -> tuple[str, ...]:
        """Every name that is the operator's: none of them is a second person."""
        return tuple(dict.fromkeys((self.name, self.login)))

    def __str__(self) -> str:
        return self.name if self.name == self.login else f"{self.name} (login {self.login})"


def applier(by: str | None) -> Applier:
    """Return the operator, by the name given.

    Raises:
        UsageError: the name has characters that cannot be printed.
    """
    user = login()
    if by is not None and not by.isprintable():
        raise UsageError(
            f"--by {by!a}", found="characters that cannot be shown", expected="a name", remedy="type it again"
        )
    return Applier(by or user, user)


def audit_of(cell: Cell, others: Iterable[Path | None]) -> Path | None:
    """Return the audit file of a cell; None only for a cell that was read from a log.

    Args:
        cell: the cell.
        others: files that take part, besides the cell's history and its controller's file.

    Raises:
        AuditUnusable: the audit is one of them.
    """
    if cell.history is None:
        return None
    require_separate_audit(cell.history.audit, (cell.history.store, cell.controller_path, *others))
    return cell.history.audit


def require_separate_audit(audit: Path, others: Iterable[Path | None]) -> None:
    """Refuse an audit that is another file of the command, by any name, whether it exists or not.

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
    """Return the figures of the cell's history that a change is judged by; none where it cannot be read."""
    from daq.files import sha256
    from daq.ledger.judgement import NOTHING, known_of
    from daq.ledger.store import HistoryStore

    if cell.history is None:
        return NOTHING
    try:
        with HistoryStore(cell.history.store) as store:
            return known_of(store, target, sha256(request.signed), changes)
    except DaqError as error:
        _LOG.warning("the history cannot be read: the numbers in the controller are taken as exact: %s", error)
        return NOTHING


def record_in_history(cell: Cell, actor: Applier, record: Callable[[Ledger], object]) -> None:
    """Enter a write into the cell's history; a history that cannot take it is only warned about."""
    from daq.ledger.ledger import Ledger

    if cell.history is None:
        return
    try:
        with Ledger(cell, cell.history, str(actor)) as ledger:
            record(ledger)
    except Exception as error:  # noqa: BLE001 - the controller has its gains: no error of the history may call that undone
        _LOG.warning("the history does not know of this: %s", error)


DrivesOption = Annotated[
    bool,
    typer.Option("--drives", help="The drives' objects that the cell names, not the controller's file."),
]
RamOnlyOption = Annotated[
    bool, typer.Option("--ram-only", help="Do not let the drives save: the gains are lost when they lose power.")
]
SaveUnknownOption = Annotated[
    bool, typer.Option("--save-unknown", help="Let drives save even if it is unknown what they save.")
]


def saving_of(ram_only: bool, save_unknown: bool) -> Saving:
    """Combine the two options.

    Raises:
        UsageError: both.
    """
    from drivers.canopen.parameters import Saving

    if ram_only and save_unknown:
        raise UsageError(
            "--ram-only --save-unknown",
            found="both",
            expected="one at most: the drives save, or they do not",
            remedy="leave one out",
        )
    return Saving.RAM if ram_only else Saving.ANY if save_unknown else Saving.KNOWN


@contextmanager
def drives_on_the_bus(declared: Cell, saving: Saving) -> Iterator[DriveTarget]:
    """Open the drives of a cell, its buses locked; Ctrl-C and SIGTERM restore the values written until then."""
    from daq.config.bus import cell_address, drive_axes
    from daq.workflow.safeguards import bus_lock
    from daq.writeback.drive_target import DriveTarget
    from drivers.canopen.network import CanopenNetwork

    address, axes = cell_address(declared), drive_axes(declared)
    try:
        with (
            bus_lock(declared),
            interruptible() as block_signals,
            CanopenNetwork(address, axes, block_signals=block_signals) as network,
        ):
            yield DriveTarget(declared, network, saving)
    except KeyboardInterrupt as interrupt:
        said = "; ".join(getattr(interrupt, "__notes__", ())) or "nothing was written to the drives"
        typer.echo(f"interrupted: {said}", err=True)
        raise typer.Exit(ExitCode.INTERRUPTED) from interrupt


def saving_text(saving: Saving) -> str:
    """Say whether the gains are saved."""
    from drivers.canopen.parameters import Saving

    if saving is Saving.RAM:
        return "The drives have NOT saved: the gains are lost when they lose power."
    return "The drives have saved."
