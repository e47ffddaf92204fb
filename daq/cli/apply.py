"""`drivegain apply`: the identified gains into the controller's file, shown first and written only on --yes."""

from __future__ import annotations

import shlex
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.syntax import Syntax
from rich.table import Table

from daq.calibration_file import load
from daq.cli.verb import JsonOption, Verb, print_json
from daq.configuration.apply_policy import ApplyPolicy
from daq.configuration.cell_file import load_cell
from daq.errors import ConfigurationInconsistent, ControllerChanged, OutputFailed
from daq.report.gain_table import with_deviation
from daq.write_back.apply import Proposal, apply, propose, refused
from daq.write_back.controller_write import Written
from daq.write_back.gates import GainChange

_DEFAULT = ApplyPolicy()


def apply_verb(
    calibration: Annotated[Path, typer.Argument(help="calibration.yaml of `drivegain fit`.")],
    cell: Annotated[Path, typer.Option(help="Cell file; it says which controller file and which keys.")],
    to: Annotated[Path | None, typer.Option(help="Controller file, instead of the one that the cell names.")] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Write; without it the change is only shown.")] = False,
    base: Annotated[
        str | None, typer.Option("--base", help="Write only if the controller file still has this SHA-256 (dry run).")
    ] = None,
    max_change_percent: Annotated[
        float, typer.Option(help="Largest change from the gain in the file.", min=0.0)
    ] = _DEFAULT.max_change_percent,
    max_nameplate_percent: Annotated[
        float, typer.Option(help="Largest distance from the nameplate.", min=0.0)
    ] = _DEFAULT.max_nameplate_percent,
    max_std_percent: Annotated[
        float, typer.Option(help="Largest standard deviation of a gain.", min=0.0)
    ] = _DEFAULT.max_std_percent,
    configuration_changed: Annotated[
        bool,
        typer.Option("--configuration-changed", help="Accept a cell configuration that changed since the recording."),
    ] = False,
    json: JsonOption = False,
) -> None:
    """Write identified gains into the controller file: dry run and diff first, --yes to write, with a backup."""
    declared = load_cell(cell)
    if declared.controller is None:
        raise ConfigurationInconsistent(
            f"{cell}: controller",
            found="none",
            expected="the controller's file and the key of each gain",
            remedy="add `controller: {file: ..., gains: [...]}` to the cell",
        )
    file = to or declared.controller_path
    if file is None:
        raise ConfigurationInconsistent(
            str(cell), found="no controller file", expected="one", remedy="give it with --to FILE"
        )
    proposal = propose(
        load(calibration),
        file,
        dict(zip(declared.axis_names, declared.controller.gains, strict=True)),
        cell=declared.name,
        configuration_sha256=None if configuration_changed else declared.digest,
        policy=ApplyPolicy(max_change_percent, max_nameplate_percent, max_std_percent),
    )
    if base is not None and base != proposal.base_sha256:
        raise ControllerChanged(
            str(file),
            found=f"content {proposal.base_sha256[:12]}…",
            expected=f"{base[:12]}…, as --base says",
            remedy="somebody has changed the file: look at a new dry run",
        )
    if not json:
        show(proposal, Console())
    written = _write(proposal) if yes and not proposal.refusals else None
    if json:
        print_json(describe(proposal, written))
    if proposal.refusals:
        raise refused(proposal)
    if not json:
        _say_outcome(proposal, written, yes)


def show(proposal: Proposal, console: Console) -> None:
    """The change as a table and as a diff."""
    console.print(change_table(proposal.changes))
    console.print()
    if proposal.diff:
        console.print(Syntax(proposal.diff, "diff", background_color="default", word_wrap=True))


def change_table(changes: tuple[GainChange, ...]) -> Table:
    """Old and new gain of each axis with what there is to judge the change by."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    table.add_column("axis", no_wrap=True)
    for heading in ("in the file", "identified ± σ", "σ %", "change %", "nameplate"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    for change in changes:
        table.add_row(
            change.axis,
            f"{change.old:.5g}",
            with_deviation(change.new, change.std),
            f"{change.std_percent:.2f}",
            f"{change.change_percent:+.1f}",
            f"{change.nameplate:.5g}",
            change.unit,
        )
    return table


def describe(proposal: Proposal, written: Written | None) -> dict[str, Any]:
    """The proposal and its outcome for --json."""
    return {
        "file": str(proposal.file),
        "base_sha256": proposal.base_sha256,
        "applied": written is not None,
        "backup": None if written is None else str(written.backup),
        "changes": [
            {
                "axis": change.axis,
                "key": change.key,
                "line": change.line,
                "old": change.old,
                "new": change.new,
                "change_percent": change.change_percent,
                "std_percent": change.std_percent,
                "nameplate": change.nameplate,
                "unit": change.unit,
            }
            for change in proposal.changes
        ],
        "refusals": [
            {
                "gate": refusal.gate.value,
                "subject": refusal.subject,
                "found": refusal.found,
                "expected": refusal.expected,
                "remedy": refusal.remedy,
            }
            for refusal in proposal.refusals
        ],
        "diff": proposal.diff,
    }


def _write(proposal: Proposal) -> Written | None:
    try:
        return apply(proposal, datetime.now(UTC))
    except OSError as error:
        raise OutputFailed.of(proposal.file, error) from error


def _say_outcome(proposal: Proposal, written: Written | None, yes: bool) -> None:
    console = Console(soft_wrap=True, highlight=False, markup=False)
    if proposal.before == proposal.after:
        console.print("Nothing to write: the controller file has these gains already.")
    elif written is not None:
        console.print(f"Written to {written.file}, backup {written.backup.name}.")
        console.print(f"To undo: drivegain rollback --to {shlex.quote(str(proposal.file))}")
    elif not yes:
        console.print("Dry run, nothing was written. To write exactly this, repeat the command with:")
        console.print(f"  --yes --base {proposal.base_sha256}")


APPLY = Verb("apply", apply_verb, "drivegain apply calibration.yaml --cell cells/demo.yaml --yes")
