"""`drivegain apply`: the identified gains into the controller's file, shown first and written only on --yes."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from dataclasses import asdict, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from daq.cli.verb import JsonOption, Verb, print_json
from daq.cli.writing import (
    Applier,
    ByOption,
    DrivesOption,
    RamOnlyOption,
    SaveUnknownOption,
    applier,
    audit_of,
    on_the_bus,
    outcome,
    query_history,
    record_in_history,
    saving_of,
    saving_text,
)
from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.config.policy import ApplyPolicy
from daq.errors import CalibrationRefused, OutputFailed, UsageError
from daq.files import sha256
from daq.ledger.audit import find_write_entry
from daq.ledger.entry import Event, WriteAction
from daq.ledger.judgement import Known
from daq.ledger.store import HistoryStore
from daq.ledger.verify import enter_applied
from daq.report.proposal import describe, show, show_changes
from daq.workflow.calibration_file import decode, read
from daq.writeback.drive_proposal import DriveProposal, drives_of, propose_to_drives
from daq.writeback.drive_proposal import refused as drives_refused
from daq.writeback.drive_record import record_folder
from daq.writeback.drive_target import DrivesWritten, apply_to_drives
from daq.writeback.file_access import resolve_links
from daq.writeback.file_proposal import Proposal, apply, propose_for, refused
from daq.writeback.file_target import Written
from daq.writeback.gates.table import Gate
from daq.writeback.request import Request
from drivers.canopen.parameters import Saving
from ident.calibration import Calibration

# Gains into the drives themselves: what `drivegain apply --drives` does.


def apply_drives(
    declared: Cell,
    cell_file: Path,
    request: Request,
    *,
    actor: Applier,
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
            _show(proposal, query_history(declared, drives_of(declared.name), request, proposal.changes), Console())
        if yes and proposal.refusals and json:
            print_json(_described(proposal, None))
        if yes:
            try:
                written = apply_to_drives(proposal, network, request.now, saving=saving, audit=audit, who=str(actor))
            except OSError as error:
                raise OutputFailed.of(record_folder(declared), error) from error
    if written is not None:
        _enter_drives(declared, request, actor, written)
    if json:
        print_json(_described(proposal, written))
    if proposal.refusals:
        raise drives_refused(proposal)
    if not json:
        _say_drives_outcome(proposal, written, saving, cell_file)


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


def _enter_drives(declared: Cell, request: Request, actor: Applier, written: DrivesWritten) -> None:
    digest = sha256(request.signed)

    def enter(store: HistoryStore) -> None:
        store.add(request.calibration, digest=digest, at=request.now)
        told, after = written.audit_sha256, written.sha256_after
        enter_applied(
            declared, store, Event(digest, WriteAction.APPLIED, request.now, str(actor), written.target, told, after)
        )

    record_in_history(declared, enter)


def _say_drives_outcome(
    proposal: DriveProposal, written: DrivesWritten | None, saving: Saving, cell_file: Path
) -> None:
    console = Console(soft_wrap=True, highlight=False, markup=False)
    if written is not None:
        console.print(
            f"Written to the drives and read back; {written.record} has the values before. {saving_text(saving)}"
        )
        console.print(f"To undo: drivegain rollback --cell {shlex.quote(str(cell_file))} --drives")
        return
    if proposal.unchanged:
        console.print("The drives have these gains already; --yes would only let them save.")
    console.print("Dry run, nothing was written. To write exactly this, repeat the command with:")
    console.print(f"  --yes --base {proposal.looked_at}")


def apply_verb(
    calibration: Annotated[Path, typer.Argument(help="calibration.yaml of `drivegain fit`.")],
    cell: Annotated[Path, typer.Option(help="Cell file; it says which controller file and which keys.")],
    to: Annotated[Path | None, typer.Option(help="Controller file, instead of the one that the cell names.")] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Write; without it the change is only shown.")] = False,
    base: Annotated[
        str | None, typer.Option("--base", help="Write only the change of the dry run that tells this BEFORE-AFTER.")
    ] = None,
    by: ByOption = None,
    payload_mass: Annotated[
        list[str] | None,
        typer.Option(help="NAME=KG: mass of a payload from the scale, where `record --mass` was not given."),
    ] = None,
    max_change_percent: Annotated[
        float | None, typer.Option(help="Largest change from the gain in the file; at most the cell's.", min=0.0)
    ] = None,
    max_nameplate_percent: Annotated[
        float | None, typer.Option(help="Largest distance from the nameplate; at most the cell's.", min=0.0)
    ] = None,
    max_std_percent: Annotated[
        float | None, typer.Option(help="Largest standard deviation of a gain; at most the cell's.", min=0.0)
    ] = None,
    configuration_changed: Annotated[
        bool,
        typer.Option("--configuration-changed", help="Accept a cell configuration that changed since the recording."),
    ] = False,
    drives: DrivesOption = False,
    ram_only: RamOnlyOption = False,
    save_unknown: SaveUnknownOption = False,
    json: JsonOption = False,
) -> None:
    """Write identified gains into the controller file: dry run and diff first, --yes to write, with a backup.

    The gates are those of the cell's `policy: {apply: ...}`; see docs/reference/gates.md.
    """
    declared, actor = load_cell(cell), applier(by)
    content = read(calibration)
    fitted = decode(content, str(calibration))
    request = Request(
        fitted,
        datetime.now(UTC),
        policy=tightened(declared.apply, max_change_percent, max_nameplate_percent, max_std_percent),
        configuration_changed=configuration_changed,
        entered_kg=entered_masses(payload_mass or (), fitted),
        looked_at=base,
        appliers=actor.names,
        file=calibration,
        content=content,
    )
    book = audit_of(declared, (cell, calibration, to))
    if drives:
        if to is not None:
            raise UsageError(
                "--drives", found="--to beside it", expected="one target", remedy="leave out one of the two"
            )
        saving = saving_of(ram_only, save_unknown)
        apply_drives(declared, cell, request, actor=actor, saving=saving, audit=book, yes=yes, json=json)
        return
    proposal = propose_for(declared, request, to)
    known = query_history(declared, str(resolve_links(proposal.file)), request, proposal.changes)
    if not json:
        show(proposal, Console(), known)
    try:
        written = _write(proposal, request.now, book, actor) if yes else None
    except CalibrationRefused:
        if json:
            print_json({**describe(proposal, None, known), "base": proposal.looked_at})
        raise
    if yes and not proposal.refusals:
        record_in_history(declared, partial(_enter, declared, proposal, written, request, actor, book))
    if json:
        print_json({**describe(proposal, written, known), "base": proposal.looked_at})
    if proposal.refusals:
        if not yes and not json:
            _show_next_command(proposal)
        raise refused(proposal)
    if not json:
        _say_outcome(proposal, written, yes, cell, to, book)


def tightened(
    policy: ApplyPolicy, change_percent: float | None, nameplate_percent: float | None, std_percent: float | None
) -> ApplyPolicy:
    """The cell's policy with bounds of the command line, which may be tighter and not wider.

    Args:
        policy: of the cell.
        change_percent, nameplate_percent, std_percent: bounds asked for [%]; None leaves the cell's.

    Raises:
        UsageError: one is wider.
    """
    return replace(
        policy,
        max_change_percent=_tighter("max_change_percent", change_percent, policy.max_change_percent),
        max_nameplate_percent=_tighter("max_nameplate_percent", nameplate_percent, policy.max_nameplate_percent),
        max_std_percent=_tighter("max_std_percent", std_percent, policy.max_std_percent),
    )


def _tighter(name: str, asked: float | None, allowed: float) -> float:
    if asked is None or asked <= allowed:
        return allowed if asked is None else asked
    raise UsageError(
        f"--{name.replace('_', '-')} {asked:g}",
        found="a bound that is wider than the cell's",
        expected=f"at most {allowed:g}",
        remedy=f"whoever answers for the cell may widen it in its file: `policy: {{apply: {{{name}: ...}}}}`",
    )


def entered_masses(entries: Sequence[str], calibration: Calibration) -> dict[str, float]:
    """Masses that were entered a second time, by payload [kg].

    Raises:
        UsageError: not NAME=KG, or no log of the calibration had that payload.
    """
    mounted = tuple(dict.fromkeys(one.payload for one in calibration.sources if one.payload is not None))
    found = {}
    for text in entries:
        name, _, number = text.rpartition("=")
        try:
            mass_kg = float(number)
        except ValueError:
            mass_kg = math.nan
        if not 0.0 < mass_kg < math.inf or name not in mounted:
            raise UsageError(
                f"--payload-mass {text}",
                found="no mass in kg" if name in mounted else f"no payload {name!r}",
                expected=f"NAME=KG with one of {', '.join(mounted) or 'none: the calibration tells of no payload'}",
                remedy="correct the option",
            )
        found[name] = mass_kg
    return found


def _write(proposal: Proposal, now: datetime, audit: Path | None, actor: Applier) -> Written | None:
    try:
        return apply(proposal, now, audit=audit, who=str(actor))
    except OSError as error:
        raise OutputFailed.of(proposal.file, error) from error


def _enter(
    cell: Cell,
    proposal: Proposal,
    written: Written | None,
    request: Request,
    actor: Applier,
    audit: Path | None,
    store: HistoryStore,
) -> None:
    """The controller has these gains; also where an earlier command wrote them and was killed before it told so."""
    digest, target = sha256(request.signed), str(resolve_links(proposal.file))
    store.add(request.calibration, digest=digest, at=request.now)
    if written is None and store.in_force(target) == digest:
        return
    after = sha256(proposal.after_content)
    audit_digest = None if written is None else written.audit_sha256
    if written is None and audit is not None:
        audit_digest = find_write_entry(audit, target, after)
    enter_applied(cell, store, Event(digest, WriteAction.APPLIED, request.now, str(actor), target, audit_digest, after))


def _show_next_command(proposal: Proposal) -> None:
    """Where nothing but a look at the changed file is wanted: this was the look."""
    if {refusal.gate for refusal in proposal.refusals} == {Gate.BASE}:
        console = Console(soft_wrap=True, highlight=False, markup=False)
        console.print("Nothing was written. If this change of the file as it is now is right, repeat the command with:")
        console.print(f"  --yes --base {proposal.looked_at}")


def _say_outcome(
    proposal: Proposal, written: Written | None, yes: bool, cell: Path, to: Path | None, audit: Path | None
) -> None:
    console = Console(soft_wrap=True, highlight=False, markup=False)
    if proposal.before_content == proposal.after_content:
        console.print("Nothing to write: the controller file has these gains already.")
    elif written is not None:
        console.print(f"Written to {written.file}, backup {written.backup.name}; the audit is {audit}.")
        other = "" if to is None else f" --to {shlex.quote(str(to))}"
        console.print(f"To undo: drivegain rollback --cell {shlex.quote(str(cell))}{other}")
    elif not yes:
        console.print("Dry run, nothing was written. To write exactly this, repeat the command with:")
        console.print(f"  --yes --base {proposal.looked_at}")


APPLY = Verb("apply", apply_verb, "drivegain apply calibration.yaml --cell cells/demo.yaml --yes")
