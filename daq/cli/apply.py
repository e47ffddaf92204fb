"""`drivegain apply` and `rollback`: write the identified gains to the controller's file or to its
drives, and undo it.

Both are dry runs without --yes, but for the rollback of a file, whose backup can be reviewed.
"""

from __future__ import annotations

import logging
import math
import os
import shlex
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from daq.cli.output import has_reader, wait_until_shown
from daq.cli.terminal import (
    WRITTEN,
    at_most_one,
    delay_signals,
    interruptible,
    output_console,
    say_last,
    write_output,
)
from daq.cli.verb import (
    CalibrationArgument,
    JsonOption,
    print_json,
    read_cell,
    require_printable,
    taking,
)
from daq.environment import login
from daq.errors import (
    AuditUnusable,
    CalibrationRefused,
    ConfigurationInconsistent,
    ExitCode,
    OutputFailed,
    UsageError,
)
from daq.report.text import terminal_text
from drivers.errors import all_notes

if TYPE_CHECKING:
    from daq.config.cell import Cell
    from daq.config.policy import ApplyPolicy
    from daq.writeback.drive_target import DriveTarget
    from daq.writeback.request import Request
    from daq.writeback.target import E, Proposal, Target, Written
    from drivers.canopen.parameters import Saving
    from ident.calibration import Calibration

_LOG = logging.getLogger("drivegain")

ByOption = Annotated[
    str | None,
    typer.Option("--by", help="Name of the operator for the audit; by default the login."),
]
DrivesOption = Annotated[
    bool, typer.Option("--drives", help="The objects in the drives, not the controller's file.")
]
RamOnlyOption = Annotated[
    bool, typer.Option("--ram-only", help="Do not save: a power cycle loses the gains.")
]
SaveUnknownOption = Annotated[
    bool, typer.Option("--save-unknown", help="Save even if it is unknown what a drive saves.")
]


@dataclass(frozen=True, slots=True)
class ApplyOptions:
    """A write of gains to a controller, as the command line asks for it."""

    cell: Annotated[
        Path, typer.Argument(help="Cell file; it names the controller file and its keys.")
    ]
    calibration: CalibrationArgument
    to: Annotated[
        Path | None, typer.Option(help="Controller file, instead of the one that the cell names.")
    ] = None
    yes: Annotated[
        bool, typer.Option("--yes", help="Write; without it the change is only shown.")
    ] = False
    base: Annotated[
        str | None,
        typer.Option("--base", help="Write only the change with this BEFORE-AFTER of its dry run."),
    ] = None
    by: ByOption = None
    payload_mass: Annotated[
        list[str] | None,
        typer.Option(help="NAME=KG from the scale, for a payload recorded without --mass."),
    ] = None
    max_change_percent: Annotated[
        float | None, typer.Option(help="Tighter bound on the change [%].", min=0.0)
    ] = None
    max_nameplate_percent: Annotated[
        float | None,
        typer.Option(help="Tighter bound on the change from the nameplate [%].", min=0.0),
    ] = None
    max_std_percent: Annotated[
        float | None, typer.Option(help="Tighter bound on σ [%].", min=0.0)
    ] = None
    configuration_changed: Annotated[
        bool,
        typer.Option(
            "--configuration-changed", help="Accept a cell file that changed since the recording."
        ),
    ] = False
    drives: DrivesOption = False
    ram_only: RamOnlyOption = False
    save_unknown: SaveUnknownOption = False
    json: JsonOption = False


@taking(ApplyOptions)
def apply_verb(options: ApplyOptions) -> None:
    """Write identified gains to the controller file:
    dry run and diff first, --yes to write, with a backup.

    The bounds of the gates are in the cell's `policy: {apply: ...}`; see docs/reference/gates.md.
    """
    from daq.documents.calibration_file import decode_calibration, read_calibration_bytes
    from daq.writeback.file_target import FileTarget
    from daq.writeback.request import Request

    saving = saving_of(options.ram_only, options.save_unknown, drives=options.drives)
    declared = read_cell(options.cell)
    actor = applier(options.by)
    content = read_calibration_bytes(options.calibration)
    fitted = decode_calibration(content, str(options.calibration))
    request = Request(
        fitted,
        datetime.now(UTC),
        policy=tightened(
            declared.apply,
            options.max_change_percent,
            options.max_nameplate_percent,
            options.max_std_percent,
        ),
        accepts_changed_configuration=options.configuration_changed,
        entered_kg=entered_masses(options.payload_mass or (), fitted),
        base=options.base,
        appliers=actor.names,
        file=options.calibration,
        content=content,
    )
    audit = audit_of(declared, (options.cell, options.calibration, options.to))
    opening: AbstractContextManager[Target[Any]]
    interrupts: AbstractContextManager[Any]
    whole: AbstractContextManager[None]
    if options.drives:
        at_most_one(drives=True, to=options.to)
        opening = drives_on_the_bus(declared, saving)
        interrupts = nullcontext()  # `drives_on_the_bus` handles them
        whole = nullcontext()
    else:
        opening = nullcontext(FileTarget.of(declared, options.to))
        interrupts = interruptible()
        whole = delay_signals()
    with interrupts:
        apply_to(
            opening,
            declared,
            request,
            actor=actor,
            audit=audit,
            undo=rollback_command(options),
            yes=options.yes,
            json=options.json,
            whole=whole,
        )


def rollback_command(options: ApplyOptions) -> str:
    """Command that undoes the write: of a file at once, of drives with the same way of saving."""
    words = ["drivegain", "rollback", str(options.cell)]
    if options.drives:
        words.append("--drives")
        if options.ram_only:
            words.append("--ram-only")
        if options.save_unknown:
            words.append("--save-unknown")
        words.append("--yes")
    elif options.to is not None:
        words += ["--to", str(options.to)]
    return shlex.join(words)


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
    whole: AbstractContextManager[None] | None = None,
) -> None:
    """Show what a calibration changes in a target, and write it with `yes`;
    `undo` is the command that undoes it.

    The write, with its entries in audit log and history, is done within `whole`.
    """
    from daq.report.proposal import proposal_report, show_proposal
    from daq.writeback.judgement import read_history_figures
    from daq.writeback.target import apply, propose

    written: Written | None = None
    with opening as target:
        proposal = propose(target, request)
        edit = proposal.edit
        known = read_history_figures(declared, edit.subject, request, edit.changes)
        if not json:
            show_proposal(proposal, output_console(), known)
        try:
            if yes:
                _require_shown(json=json)
                with (
                    whole or nullcontext(),
                    write_output(edit.place) if edit.has_effect else nullcontext(),
                ):
                    written = apply(proposal, request.now, audit=audit, who=str(actor))
        except CalibrationRefused:
            if json:
                print_json(proposal_report(proposal, None, known))
            raise
    if json:
        print_json(proposal_report(proposal, written, known))
    else:
        _show_outcome(proposal, written, audit, undo, yes=yes)
    if proposal.refusals:
        raise proposal.error


def _require_shown(*, json: bool) -> None:
    """Refuse to write what cannot be shown.

    What a write changes is printed before it, and with --json after it, to a reader that may have
    gone.

    Raises:
        OSError: what was printed cannot be written.
        OutputFailed: the reader of standard output has gone.
    """
    if not json:
        wait_until_shown(sys.stdout)
    elif not has_reader(sys.stdout):
        raise OutputFailed(
            "standard output",
            found="a pipe or terminal whose other end is closed",
            expected="a reader of the report that follows the write",
            remedy="nothing was written; repeat the command with a reader, or send its output to "
            "a file",
        )


def _show_outcome(
    proposal: Proposal[E], written: Written | None, audit: Path | None, undo: str, *, yes: bool
) -> None:
    from daq.writeback.drive_target import DriveTarget
    from daq.writeback.gates.gate import Gate

    console = output_console()
    edit = proposal.edit
    target = proposal.target
    if proposal.refusals:
        # The review of a changed base is all that is missing, and this dry run is that review.
        if not yes and {refusal.gate for refusal in proposal.refusals} == {Gate.BASE}:
            console.print(
                "Nothing was written. If this change of the current gains is right, "
                "repeat the command with:"
            )
            console.print(f"  --yes --base {edit.base}")
    elif written is not None and isinstance(target, DriveTarget):
        console.print(
            f"Written to the drives and read back; {written.backup} has the previous gains.",
            end=" ",
        )
        console.print(_saving_text(target.saving))
        console.print(f"To undo: {undo}")
    elif written is not None:
        if written.backup is None:
            backup = "none"
        else:
            backup = written.backup.name
        console.print(
            terminal_text(f"Written to {edit.subject}, backup {backup}; audit log {audit}.")
        )
        console.print(terminal_text(f"To undo: {undo}"))
    elif not edit.has_effect:
        console.print("Nothing to write: the controller file has these gains already.")
    else:
        if edit.before == edit.after:
            console.print("The drives have these gains already; --yes would only let them save.")
        console.print(
            "Dry run, nothing was written. To write exactly this, repeat the command with:"
        )
        console.print(f"  --yes --base {edit.base}")


def tightened(
    policy: ApplyPolicy,
    change_percent: float | None,
    nameplate_percent: float | None,
    std_percent: float | None,
) -> ApplyPolicy:
    """Take bounds of the command line [%] into the cell's policy, none of them wider;
    None leaves the cell's.
    """
    names = ("max_change_percent", "max_nameplate_percent", "max_std_percent")
    asked = zip(names, (change_percent, nameplate_percent, std_percent), strict=True)
    tighter: dict[str, Any] = {name: bound for name, bound in asked if bound is not None}
    for name, bound in tighter.items():
        allowed = getattr(policy, name)
        if not bound <= allowed:
            raise UsageError(
                f"--{name.replace('_', '-')} {bound:g}",
                found="a bound that is wider than the cell's",
                expected=f"at most {allowed:g}",
                remedy="the person responsible for the cell may widen it in its file: "
                f"`policy: {{apply: {{{name}: ...}}}}`",
            )
    return replace(policy, **tighter)


def entered_masses(entries: Sequence[str], calibration: Calibration) -> dict[str, float]:
    """Parse the values of --payload-mass, NAME=KG of payloads in the calibration's logs:
    masses by payload [kg].
    """
    mounted = tuple(
        dict.fromkeys(one.payload for one in calibration.sources if one.payload is not None)
    )
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
                expected="NAME=KG with one of "
                f"{', '.join(mounted) or 'none: the calibration has no payload'}",
                remedy="correct the option",
            )
        found[name] = mass_kg
    return found


def rollback_verb(
    cell: Annotated[
        Path | None, typer.Argument(help="Cell file; it names the controller file and the audit.")
    ] = None,
    to: Annotated[
        Path | None, typer.Option("--to", help="Another controller file than the cell's.")
    ] = None,
    by: ByOption = None,
    drives: DrivesOption = False,
    ram_only: RamOnlyOption = False,
    save_unknown: SaveUnknownOption = False,
    yes: Annotated[
        bool, typer.Option("--yes", help="With --drives: write, not only show.")
    ] = False,
    audit: Annotated[
        Path | None, typer.Option("--audit", help="Audit file, where no cell file names it.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Undo the last write to a controller file;
    the replaced content is backed up too, so a second rollback undoes it.

    A file that was edited since, and a backup that was changed, are refused. With --to alone the
    audit is not known: give it with --audit, or the rollback is not in an audit. Drives are shown
    first and written with --yes: their values are in no file that could be reviewed.
    """
    from daq.ledger.ledger import MAY_LACK, is_damaged
    from daq.report.proposal import file_rollback_report, show_file_rollback
    from daq.writeback import target
    from daq.writeback.file_target import FileTarget

    saving = saving_of(ram_only, save_unknown, drives=drives)
    declared = None if cell is None else read_cell(cell)
    at_most_one(audit=audit, cell=cell)  # writes to a cell's controller are in the cell's audit
    if drives:
        at_most_one(drives=drives, to=to)
    if cell is None and (to is None or drives):
        raise UsageError(
            "rollback",
            found="no cell" if drives else "neither a cell nor a controller file",
            expected="CELL, which says where the gains are",
            remedy="name the cell whose controller is to be rolled back",
        )
    if audit is not None:
        require_separate_audit(audit, (to,))
    now = datetime.now(UTC)
    actor = applier(by)
    if declared is not None:
        audit = audit_of(declared, (cell, to))
    if audit is not None and is_damaged(audit):
        _LOG.warning(MAY_LACK)
    if drives and declared is not None:
        rollback_drives(
            declared, now=now, actor=actor, saving=saving, audit=audit, yes=yes, json=json
        )
        return
    path = to if declared is None else to or declared.controller_path
    if path is None:
        raise ConfigurationInconsistent(
            f"{cell}: controller", found="no file", expected="one", remedy="give it with --to FILE"
        )
    if declared is None or declared.controller is None:
        format_ = None
    else:
        format_ = declared.controller.format
    with interruptible():
        with delay_signals(), write_output(path):
            file = FileTarget(path, format=format_, cell=declared)
            written = target.rollback(file, now, audit=audit, who=str(actor))
        if json:
            print_json(file_rollback_report(written, audit))
            return
        console = output_console()
        show_file_rollback(written, console)
        if audit is None:
            console.print("No audit log has this rollback: neither a cell nor --audit was given.")


def rollback_drives(
    declared: Cell,
    *,
    now: datetime,
    actor: Applier,
    saving: Saving,
    audit: Path | None,
    yes: bool,
    json: bool,
) -> None:
    """Show the previous gains of the drives, and restore them with `yes`;
    a second time undoes it.
    """
    from daq.report.proposal import drive_rollback_report, show_drive_rollback
    from daq.writeback import target
    from daq.writeback.drive_target import record_folder

    written: Written | None = None
    console = output_console()
    with drives_on_the_bus(declared, saving) as drives:
        planned = drives.plan_rollback()
        if not json:
            show_drive_rollback(planned, console)
        if yes:
            _require_shown(json=json)
            with write_output(record_folder(declared)):
                written = target.rollback(drives, now, audit=audit, who=str(actor), planned=planned)
    if json:
        print_json(drive_rollback_report(planned, written))
    elif written is None:
        console.print(
            "Dry run, nothing was written. To restore them, repeat the command with --yes."
        )
    else:
        backup = "" if written.backup is None else written.backup.name
        console.print(
            f"Restored the gains of {planned.source}; the replaced gains are in {backup}.", end=" "
        )
        console.print(_saving_text(saving))


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
        if self.name == self.login:
            return self.name
        return f"{self.name} (login {self.login})"


def applier(by: str | None) -> Applier:
    """Return the operator, by the name given, which must be printable."""
    user = login()
    require_printable("--by", by)
    return Applier(by or user, user)


def audit_of(cell: Cell, others: Iterable[Path | None]) -> Path | None:
    """Return the audit file of a cell, which is no other file of the command;
    None for a cell read from a log.
    """
    if cell.history is None:
        return None
    require_separate_audit(cell.history.audit, (cell.history.store, cell.controller_path, *others))
    return cell.history.audit


def require_separate_audit(audit: Path, others: Iterable[Path | None]) -> None:
    """Refuse an audit that is another file of the command, by any name,
    whether it exists or not.
    """
    for other in others:
        if other is None:
            continue
        same = os.path.realpath(audit) == os.path.realpath(other)
        with suppress(OSError):
            same = same or audit.samefile(other)
        if same:
            raise AuditUnusable(
                str(audit),
                found=f"the same file as {other}",
                expected="a file of the audit's own",
                remedy="correct `history.audit` of the cell file, or --audit; nothing was written",
            )


def saving_of(ram_only: bool, save_unknown: bool, *, drives: bool = True) -> Saving:
    """Combine the two options, which exclude each other and need --drives."""
    from drivers.canopen.parameters import Saving

    at_most_one(ram_only=ram_only, save_unknown=save_unknown)
    if not drives and (ram_only or save_unknown):
        name = "--ram-only" if ram_only else "--save-unknown"
        raise UsageError(
            name,
            found="no --drives",
            expected="both, or neither",
            remedy="a file has nothing to save",
        )
    if ram_only:
        return Saving.RAM
    return Saving.ANY if save_unknown else Saving.KNOWN


@contextmanager
def drives_on_the_bus(declared: Cell, saving: Saving) -> Iterator[DriveTarget]:
    """Open the drives of a cell, its buses locked;
    Ctrl-C and SIGTERM restore the values written until then.
    """
    from daq.config.cell_buses import cell_address, drive_axes
    from daq.workflow.bus_lock import bus_lock
    from daq.writeback.drive_target import DriveTarget
    from drivers.canopen.network import CanopenNetwork

    address = cell_address(declared)
    axes = drive_axes(declared)
    try:
        with (
            bus_lock(declared),
            interruptible() as block_signals,
            CanopenNetwork(address, axes, block_signals=block_signals) as network,
        ):
            yield DriveTarget(declared, network, saving)
    except KeyboardInterrupt as interrupt:
        if WRITTEN:
            written = "the drives were written"
        else:
            written = "nothing was written to the drives"
        said = "; ".join(all_notes(interrupt)) or written
        say_last(f"interrupted: {said}")
        raise typer.Exit(ExitCode.INTERRUPTED) from interrupt


def _saving_text(saving: Saving) -> str:
    from drivers.canopen.parameters import Saving

    if saving is Saving.RAM:
        return "The drives have NOT saved: the gains are lost when they lose power."
    return "The drives have saved."
