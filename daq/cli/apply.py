"""`drivegain apply`: write the identified gains to the controller's file or to its drives; a dry run without --yes."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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
    drives_on_the_bus,
    query_history,
    record_in_history,
    saving_of,
    saving_text,
)
from daq.errors import CalibrationRefused, OutputFailed, UsageError

if TYPE_CHECKING:
    from daq.config.cell import Cell
    from daq.config.policy import ApplyPolicy
    from daq.ledger.ledger import Ledger
    from daq.writeback.request import Edit, Request
    from daq.writeback.target import E, Proposal, Target, Written
    from ident.calibration import Calibration


def apply_verb(
    calibration: Annotated[Path, typer.Argument(help="calibration.yaml of `drivegain fit`.")],
    cell: Annotated[Path, typer.Option(help="Cell file; it names the controller file and its keys.")],
    to: Annotated[Path | None, typer.Option(help="Controller file, instead of the one that the cell names.")] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Write; without it the change is only shown.")] = False,
    base: Annotated[
        str | None, typer.Option("--base", help="Write only the change whose dry run printed this BEFORE-AFTER.")
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
    """Write identified gains to the controller file: dry run and diff first, --yes to write, with a backup.

    The bounds of the gates are in the cell's `policy: {apply: ...}`; see docs/reference/gates.md.
    """
    from daq.config.cell_file import load_cell
    from daq.workflow.calibration_file import decode, read
    from daq.writeback.file_target import FileTarget
    from daq.writeback.request import Request

    declared, actor = load_cell(cell), applier(by)
    content = read(calibration)
    fitted = decode(content, str(calibration))
    request = Request(
        fitted,
        datetime.now(UTC),
        policy=tightened(declared.apply, max_change_percent, max_nameplate_percent, max_std_percent),
        configuration_changed=configuration_changed,
        entered_kg=entered_masses(payload_mass or (), fitted),
        base=base,
        appliers=actor.names,
        file=calibration,
        content=content,
    )
    audit = audit_of(declared, (cell, calibration, to))
    undo = f"drivegain rollback --cell {shlex.quote(str(cell))}"
    if drives:
        if to is not None:
            raise UsageError(
                "--drives", found="--to beside it", expected="one target", remedy="leave out one of the two"
            )
        opening = drives_on_the_bus(declared, saving_of(ram_only, save_unknown))
        apply_to(opening, declared, request, actor=actor, audit=audit, undo=f"{undo} --drives", yes=yes, json=json)
        return
    undo += "" if to is None else f" --to {shlex.quote(str(to))}"
    file = nullcontext(FileTarget.of(declared, to))
    apply_to(file, declared, request, actor=actor, audit=audit, undo=undo, yes=yes, json=json)


def apply_to(
    opening: AbstractContextManager[Target[E]],
    declared: Cell,
    request: Request,
    *,
    actor: Applier,
    audit: Path | None,
    undo: str,
    yes: bool,
    json: bool,
) -> None:
    """Show what a calibration changes in a target of a cell, and write it with `yes`.

    Args:
        opening: opens the target.
        declared: the cell.
        request: what is to be written.
        actor: the operator.
        audit: file of the audit, None for none.
        undo: command that undoes the write.
        yes: write.
        json: print a document instead of text.
    """
    from daq.report.proposal import describe, show
    from daq.writeback.target import apply, propose

    written: Written | None = None
    with opening as target:
        proposal = propose(target, request)
        edit = proposal.edit
        known = query_history(declared, edit.subject, request, edit.changes)
        if not json:
            show(proposal, Console(), known)
        try:
            if yes:
                written = apply(proposal, request.now, audit=audit, who=str(actor))
        except CalibrationRefused:
            if json:
                print_json(describe(proposal, None, known))
            raise
        except OSError as error:
            raise OutputFailed.of(edit.place, error) from error
    if yes and not proposal.refusals:
        record_in_history(declared, actor, lambda ledger: _enter(ledger, edit, written, request))
    if json:
        print_json(describe(proposal, written, known))
    else:
        _show_outcome(proposal, written, audit, undo, yes=yes)
    if proposal.refusals:
        raise proposal.error


def _enter(ledger: Ledger, edit: Edit, written: Written | None, request: Request) -> None:
    """Enter the write into the history; also one of an earlier command that was killed before it could."""
    from daq.files import sha256

    digest, entry = sha256(request.signed), None if written is None else written.audit_sha256
    ledger.add(request.calibration, digest=digest, at=request.now)
    ledger.record_applied(digest, at=request.now, target=edit.subject, sha256_after=sha256(edit.after), entry=entry)


def _show_outcome(proposal: Proposal[E], written: Written | None, audit: Path | None, undo: str, *, yes: bool) -> None:
    from daq.writeback.drive_target import DriveTarget
    from daq.writeback.gates.gate import Gate

    console = Console(soft_wrap=True, highlight=False, markup=False)
    edit, target = proposal.edit, proposal.target
    if proposal.refusals:
        # The review of a changed base is all that is missing, and this dry run is that review.
        if not yes and {refusal.gate for refusal in proposal.refusals} == {Gate.BASE}:
            console.print("Nothing was written. If this change of the present content is right, repeat with:")
            console.print(f"  --yes --base {edit.base}")
    elif written is not None and isinstance(target, DriveTarget):
        console.print(f"Written to the drives and read back; {written.backup} has the values before.", end=" ")
        console.print(saving_text(target.saving))
        console.print(f"To undo: {undo}")
    elif written is not None:
        backup = "none" if written.backup is None else written.backup.name
        console.print(f"Written to {edit.subject}, backup {backup}; the audit is {audit}.")
        console.print(f"To undo: {undo}")
    elif not edit.has_effect:
        console.print("Nothing to write: the controller file has these gains already.")
    else:
        if edit.before == edit.after:
            console.print("The drives have these gains already; --yes would only let them save.")
        console.print("Dry run, nothing was written. To write exactly this, repeat the command with:")
        console.print(f"  --yes --base {edit.base}")


def tightened(
    policy: ApplyPolicy, change_percent: float | None, nameplate_percent: float | None, std_percent: float | None
) -> ApplyPolicy:
    """Take bounds of the command line into the cell's policy; they may be tighter and not wider.

    Args:
        policy: of the cell.
        change_percent, nameplate_percent, std_percent: requested bounds [%]; None leaves the cell's.

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
        remedy=f"the person responsible for the cell may widen it in its file: `policy: {{apply: {{{name}: ...}}}}`",
    )


def entered_masses(entries: Sequence[str], calibration: Calibration) -> dict[str, float]:
    """Parse the values of --payload-mass: masses by payload [kg].

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
                expected=f"NAME=KG with one of {', '.join(mounted) or 'none: the calibration has no payload'}",
                remedy="correct the option",
            )
        found[name] = mass_kg
    return found


APPLY = Verb("apply", apply_verb, "drivegain apply calibration.yaml --cell cells/demo.yaml --yes")
