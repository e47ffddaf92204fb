"""What `drivegain apply --drives` and `drivegain rollback --drives` have in common."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import typer

from daq.bus_lock import bus_lock
from daq.cli.interrupt import interruptible
from daq.configuration.cell import Cell
from daq.configuration.cell_bus import cell_address, drive_axes
from daq.errors import ExitCode, UsageError
from daq.write_back.drive_write import DrivesWritten
from drivers.network import CanopenNetwork
from drivers.parameter_write import Saving

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
            interruptible() as undisturbed,
            CanopenNetwork(address, axes, undisturbed=undisturbed) as network,
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


def kept(saving: Saving) -> str:
    """Whether it stays, for a person."""
    if saving is Saving.RAM:
        return "The drives have NOT saved: the gains are gone with their power."
    return "The drives have saved."
