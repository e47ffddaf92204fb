"""Gains into the drives themselves: what `drivegain apply --drives` and `drivegain rollback --drives` do."""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from daq.bus_lock import bus_lock
from daq.cli.applier import Applier, tell_history
from daq.cli.interrupt import interruptible
from daq.cli.verb import print_json
from daq.configuration.apply_policy import ApplyPolicy
from daq.configuration.cell import Cell
from daq.configuration.cell_bus import cell_address, drive_axes
from daq.errors import ExitCode, OutputFailed, UsageError
from daq.history.store import HistoryStore
from daq.report.proposal import change_table
from daq.write_back.drive_proposal import DriveProposal, propose_to_drives, refused
from daq.write_back.drive_record import record_folder
from daq.write_back.drive_write import DrivesWritten, apply_to_drives, roll_back_drives
from drivers.network import CanopenNetwork
from drivers.parameter_write import Saving
from ident.calibration import Calibration

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


def apply_drives(
    declared: Cell,
    cell_file: Path,
    calibration: Calibration,
    *,
    now: datetime,
    doer: Applier,
    policy: ApplyPolicy,
    configuration_changed: bool,
    entered_kg: Mapping[str, float],
    looked_at: str | None,
    appliers: Collection[str],
    calibration_file: Path,
    calibration_content: bytes,
    saving: Saving,
    audit: Path | None,
    yes: bool,
    json: bool,
) -> None:
    """Show what a calibration changes in the drives of a cell, and write it with `yes`; nothing moves.

    Args:
        declared, cell_file: the cell, and where it is.
        calibration, calibration_file, calibration_content: to be written.
        now, doer, policy, configuration_changed, entered_kg, looked_at, appliers, audit: as for a controller's file.
        saving: whether the drives keep it.
        yes: write.
        json: tell it to a program.
    """
    written: DrivesWritten | None = None
    with _on_the_bus(declared) as network:
        proposal = propose_to_drives(
            declared,
            calibration,
            network,
            now=now,
            policy=policy,
            configuration_changed=configuration_changed,
            entered_kg=entered_kg,
            looked_at=looked_at,
            appliers=appliers,
            calibration_file=calibration_file,
            calibration_content=calibration_content,
        )
        if not json:
            _show(proposal, Console())
        if yes and proposal.refusals and json:
            print_json(_described(proposal, None))
        if yes:
            try:
                written = apply_to_drives(proposal, network, now, saving=saving, audit=audit, who=str(doer))
            except OSError as error:
                raise OutputFailed.of(record_folder(declared), error) from error
    if written is not None:
        _enter(declared, calibration, calibration_content, now, doer, written.target)
    if json:
        print_json(_described(proposal, written))
    if proposal.refusals:
        raise refused(proposal)
    if not json:
        _say_outcome(proposal, written, saving, cell_file)


def rollback_drives(
    declared: Cell, *, now: datetime, doer: Applier, saving: Saving, audit: Path | None, json: bool
) -> None:
    """Put back what stood in the drives before the last write; a second time undoes it.

    Args:
        declared: the cell.
        now, doer, audit: as for a controller's file.
        saving: whether the drives keep it.
        json: tell it to a program.
    """
    with _on_the_bus(declared) as network:
        try:
            done = roll_back_drives(declared, network, now, saving=saving, audit=audit, who=str(doer))
        except OSError as error:
            raise OutputFailed.of(record_folder(declared), error) from error
    tell_history(declared, lambda store: store.rolled_back(at=now, who=str(doer), target=done.target))
    if json:
        print_json({"drives": done.target, **_outcome(done)})
        return
    console = Console(soft_wrap=True, highlight=False, markup=False)
    for change in done.changes:
        old, new = change.parameter.value(change.old), change.parameter.value(change.new)
        console.print(f"{change.axis}, {change.parameter}: {old:.9g} -> {new:.9g}")
    console.print(f"Restored what {done.source} says; what stood there is now in {done.record.name}. {_kept(saving)}")


@contextmanager
def _on_the_bus(declared: Cell) -> Iterator[CanopenNetwork]:
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


def _show(proposal: DriveProposal, console: Console) -> None:
    table = change_table(proposal.changes)
    table.columns[1].header = "in the drive"
    console.print(table)
    console.print()
    for change, value in zip(proposal.changes, proposal.base, strict=True):
        console.print(f"{change.key}: {value.value:.9g} -> {change.spelling}", markup=False, highlight=False)


def _described(proposal: DriveProposal, written: DrivesWritten | None) -> dict[str, Any]:
    return {
        "cell": proposal.cell,
        "base_sha256": proposal.base_sha256,
        "applied": written is not None,
        **({} if written is None else _outcome(written)),
        "changes": [
            {
                "axis": change.axis,
                "object": change.key,
                "old": change.old,
                "new": change.new,
                "std": change.std,
                "nameplate": change.nameplate,
                "unit": change.unit,
            }
            for change in proposal.changes
        ],
        "refusals": [
            {
                "gate": one.gate.value,
                "subject": one.subject,
                "found": one.found,
                "expected": one.expected,
                "remedy": one.remedy,
            }
            for one in proposal.refusals
        ],
    }


def _outcome(written: DrivesWritten) -> dict[str, Any]:
    return {
        "record": str(written.record),
        "source": None if written.source is None else str(written.source),
        "saved": all(change.saved for change in written.changes),
    }


def _enter(declared: Cell, calibration: Calibration, content: bytes, now: datetime, doer: Applier, target: str) -> None:
    digest = hashlib.sha256(content).hexdigest()

    def enter(store: HistoryStore) -> None:
        store.add(calibration, digest=digest, at=now)
        store.applied(digest, at=now, who=str(doer), target=target)

    tell_history(declared, enter)


def _say_outcome(proposal: DriveProposal, written: DrivesWritten | None, saving: Saving, cell_file: Path) -> None:
    console = Console(soft_wrap=True, highlight=False, markup=False)
    if written is not None:
        console.print(f"Written to the drives and read back; {written.record} says what stood there. {_kept(saving)}")
        console.print(f"To undo: drivegain rollback --cell {shlex.quote(str(cell_file))} --drives")
        return
    if proposal.unchanged:
        console.print("The drives have these gains already; --yes would only let them save.")
    console.print("Dry run, nothing was written. To write exactly this, repeat the command with:")
    console.print(f"  --yes --base {proposal.base_sha256}")


def _kept(saving: Saving) -> str:
    if saving is Saving.RAM:
        return "The drives have NOT saved: the gains are gone with their power."
    return "The drives have saved."
