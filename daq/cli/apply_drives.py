"""Gains into the drives themselves: what `drivegain apply --drives` does."""

from __future__ import annotations

import shlex
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console

from daq.cli.applier import Applier, ask_history, tell_history
from daq.cli.drives import kept, on_the_bus, outcome
from daq.cli.verb import print_json
from daq.configuration.cell import Cell
from daq.digest import sha256
from daq.errors import OutputFailed
from daq.history.audited import enter_applied
from daq.history.entry import Deed, Event
from daq.history.judgement import Known
from daq.history.store import HistoryStore
from daq.report.proposal import show_changes
from daq.write_back.drive_proposal import DriveProposal, drives_of, propose_to_drives, refused
from daq.write_back.drive_record import record_folder
from daq.write_back.drive_write import DrivesWritten, apply_to_drives
from daq.write_back.request import Request
from drivers.parameter_write import Saving


def apply_drives(
    declared: Cell,
    cell_file: Path,
    request: Request,
    *,
    doer: Applier,
    saving: Saving,
    audit: Path | None,
    yes: bool,
    json: bool,
) -> None:
    """Show what a calibration changes in the drives of a cell, and write it with `yes`; nothing moves.

    Args:
        declared, cell_file: the cell, and where it is.
        request: what is to be written.
        doer: who writes it.
        saving: whether the drives keep it.
        audit: where it is written down, None for nowhere.
        yes: write.
        json: tell it to a program.
    """
    written: DrivesWritten | None = None
    with on_the_bus(declared) as network:
        proposal = propose_to_drives(declared, request, network)
        if not json:
            _show(proposal, ask_history(declared, drives_of(declared.name), request, proposal.changes), Console())
        if yes and proposal.refusals and json:
            print_json(_described(proposal, None))
        if yes:
            try:
                written = apply_to_drives(proposal, network, request.now, saving=saving, audit=audit, who=str(doer))
            except OSError as error:
                raise OutputFailed.of(record_folder(declared), error) from error
    if written is not None:
        _enter(declared, request, doer, written)
    if json:
        print_json(_described(proposal, written))
    if proposal.refusals:
        raise refused(proposal)
    if not json:
        _say_outcome(proposal, written, saving, cell_file)


def _show(proposal: DriveProposal, known: Known, console: Console) -> None:
    show_changes(proposal.changes, console, known, "in the drive")
    for change, value in zip(proposal.changes, proposal.base, strict=True):
        console.print(f"{change.key}: {value.value:.9g} -> {change.spelling}", markup=False, highlight=False)


def _described(proposal: DriveProposal, written: DrivesWritten | None) -> dict[str, Any]:
    return {
        "cell": proposal.cell,
        "base_sha256": proposal.base_sha256,
        "base": proposal.looked_at,
        "applied": written is not None,
        **({} if written is None else outcome(written)),
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
        "refusals": [asdict(refusal) | {"gate": refusal.gate.value} for refusal in proposal.refusals],
    }


def _enter(declared: Cell, request: Request, doer: Applier, written: DrivesWritten) -> None:
    digest = sha256(request.signed)

    def enter(store: HistoryStore) -> None:
        store.add(request.calibration, digest=digest, at=request.now)
        told, after = written.audit_sha256, written.sha256_after
        enter_applied(declared, store, Event(digest, Deed.APPLIED, request.now, str(doer), written.target, told, after))

    tell_history(declared, enter)


def _say_outcome(proposal: DriveProposal, written: DrivesWritten | None, saving: Saving, cell_file: Path) -> None:
    console = Console(soft_wrap=True, highlight=False, markup=False)
    if written is not None:
        console.print(f"Written to the drives and read back; {written.record} says what stood there. {kept(saving)}")
        console.print(f"To undo: drivegain rollback --cell {shlex.quote(str(cell_file))} --drives")
        return
    if proposal.unchanged:
        console.print("The drives have these gains already; --yes would only let them save.")
    console.print("Dry run, nothing was written. To write exactly this, repeat the command with:")
    console.print(f"  --yes --base {proposal.looked_at}")
