"""`drivegain history`: every calibration of a cell, how its gains have changed,
and whether they drift.
"""

from __future__ import annotations

import logging
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from daq.cli.apply import applier
from daq.cli.terminal import (
    CHANGED,
    check_replaceable,
    delay_signals,
    output_console,
    say,
    say_written,
    write_file,
)
from daq.cli.verb import JsonOption, output_option, print_json, read_cell
from daq.errors import (
    AuditUnusable,
    ConfigurationInconsistent,
    DaqError,
    DataError,
    HistoryUnreadable,
    UsageError,
    counted,
    evidence,
    first_few,
)
from daq.files import sha256
from daq.report.text import printable

if TYPE_CHECKING:
    from daq.config.cell import Cell
    from daq.ledger.fold import History
    from daq.ledger.ledger import Ledger, Verification
    from daq.ledger.watch import Series

_LOG = logging.getLogger("drivegain")

_SHOWN = 5  #: Sentences of a kind in an error; --json has all

#: Suffixes of pictures, and text at the beginning of such a file
_PICTURES = {".png": "PNG\r\n", ".svg": "<?xml"}


def history_verb(
    cell: Annotated[Path, typer.Argument(help="Cell file; it says where its history is.")],
    axis: Annotated[
        str | None, typer.Option("--axis", help="One axis: every calibration of its gain.")
    ] = None,
    plot: Annotated[Path | None, output_option("--plot", "Picture to write, .png or .svg.")] = None,
    csv: Annotated[
        Path | None, output_option("--csv", "Table to write, for a spreadsheet.")
    ] = None,
    add: Annotated[Path | None, typer.Option("--add", help="Enter a calibration by hand.")] = None,
    acknowledge: Annotated[
        str | None,
        typer.Option(
            "--acknowledge",
            metavar="AXIS",
            help="The change of an axis is explained: begin a new baseline.",
        ),
    ] = None,
    by: Annotated[
        str | None,
        typer.Option(
            "--by", help="With --acknowledge, --add or --rename: who does it; you by default."
        ),
    ] = None,
    why: Annotated[
        str | None, typer.Option("--why", help="With --acknowledge: what happened.")
    ] = None,
    since: Annotated[
        str | None,
        typer.Option(
            "--since", metavar="DATE", help="With --acknowledge: first day of the baseline."
        ),
    ] = None,
    verify: Annotated[
        bool, typer.Option("--verify", help="Check audit and history; exit code 4 if broken.")
    ] = False,
    migrate: Annotated[
        bool,
        typer.Option(
            "--migrate",
            "--rebuild",
            help="Take the SQLite file of earlier versions into the audit.",
        ),
    ] = False,
    rename: Annotated[
        str | None,
        typer.Option(
            "--rename",
            metavar="OLD",
            help="The cell was called OLD: take its history and sessions over.",
        ),
    ] = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="With --rename: do it; without it, it is only shown.")
    ] = False,
    sessions: Annotated[
        Path | None,
        typer.Option(
            "--sessions", help="With --rename: folder of sessions, where `calibrate` got one."
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Show the calibrations of a cell, which were applied, the change of each gain with its σ,
    and alarms.

    An alarm means that a gain has changed by more than noise: a drift that adds up (CUSUM), a
    steady trend, or one calibration far off. Possible causes are printed as questions.
    docs/evidence/drift.md says how often an alarm is false.
    """
    from daq.ledger.ledger import MAY_LACK, Ledger
    from daq.report.history import (
        describe_actions,
        history_report,
        in_force,
        say_verification,
        show_axis,
        show_history,
    )
    from daq.writeback.file_access import resolve_links

    declared = read_cell(cell)
    ledger = Ledger.of(declared)
    if ledger is None:
        raise ConfigurationInconsistent(
            str(cell),
            found="no history",
            expected="a cell file",
            remedy="give the cell file, not a log",
        )
    _check_files(plot, csv)
    _check_companions("--acknowledge AXIS", acknowledge, {"--why": why, "--since": since})
    has_entry = not (acknowledge is None and add is None and rename is None)
    _check_companions(
        "--acknowledge, --add or --rename", "given" if has_entry else None, {"--by": by}
    )
    _check_companions("--rename OLD", rename, {"--yes": yes or None, "--sessions": sessions})
    now = datetime.now(UTC)
    who = str(applier(by))
    _migrate(ledger, who, now, forced=migrate)
    if rename is not None:
        _rename(ledger, cell, rename, sessions, who, now, confirmed=yes)
    if add is not None:
        _add(ledger, add, who, now)
    needed = (acknowledge, axis)
    checked, history, all_series = _read(ledger, verify, needed, needs_any_gain=plot is not None)
    if acknowledge is not None:
        _acknowledge(ledger, _named(all_series, acknowledge, declared), who, why, since, now)
        checked, history, all_series = _read(ledger, verify)
    if checked is None and history.may_lack:
        _LOG.warning(MAY_LACK)
    _say_names(history if rename is None else replace(history, possible_names=()), cell)
    chosen = all_series if axis is None else (_named(all_series, axis, declared),)
    _write_files(chosen, declared, plot, csv)
    current = in_force(declared, history)
    actions = describe_actions(history.entries, history.events, current)
    if verify and declared.controller_path is not None:
        # Where its links lead decides which writes are this cell's: another user's link could hide
        # some.
        resolve_links(declared.controller_path)
    console = output_console()
    # Before a rename is made, the new name has no entries yet.
    is_known_to_be_empty = not history.may_lack and rename is None
    if json:
        print_json(history_report(declared.name, history, chosen, all_series, current, checked))
    else:
        if checked is not None:
            _require_log(ledger, checked)  # before the page calls the history sound
            say_verification(checked, console)
        elif axis is not None:
            show_axis(chosen[0], all_series, actions, console)
        elif history.entries or is_known_to_be_empty:
            show_history(history.entries, all_series, actions, console)
        say_written(console, plot, csv)
    if checked is not None:
        _require(ledger, checked)
        _require_log(ledger, checked)


def _check_companions(
    option: str, given: str | None, companions: Mapping[str, object | None]
) -> None:
    """Refuse options that mean something together with another one only."""
    lonely = [name for name, value in companions.items() if value is not None]
    if given is None and lonely:
        raise UsageError(
            ", ".join(lonely),
            found=f"no {option.split(maxsplit=1)[0]}".rstrip(","),
            expected=f"it with {option}",
            remedy=f"give {option}, too",
        )


def _require_log(ledger: Ledger, checked: Verification) -> None:
    """Refuse to call a history whole whose audit log is absent,
    where backups show that there were writes.
    """
    from daq.writeback.file_access import backups_without_log, resolve_links

    controller = ledger.cell.controller_path
    if controller is None or not checked.verdict.holds:  # what is broken is said first
        return
    count = backups_without_log(ledger.audit, resolve_links(controller))
    if count > 0:
        raise DataError(
            str(ledger.audit),
            found=f"no file, although {controller} has {counted(count, 'backup')} of earlier "
            "writes next to it",
            expected="the audit log with these writes",
            remedy="restore it with its `.head`, and ask who removed it; if it is kept elsewhere "
            "on purpose, go on: the next write begins a new log, and says so in it",
        )


def _read(
    ledger: Ledger, verify: bool, axes: Sequence[str | None] = (), *, needs_any_gain: bool = False
) -> tuple[Verification | None, History, tuple[Series, ...]]:
    """Read the history and the chart of each gain, from a verification if that is wanted.

    Args:
        ledger: of the cell.
        verify: check it.
        axes: whose gains are needed.
        needs_any_gain: a gain of any axis is needed.
    """
    from daq.ledger.ledger import read_history
    from daq.ledger.watch import watch

    checked = _verified(ledger) if verify else None
    history = read_history(ledger) if checked is None else checked.history
    all_series = watch(history.entries, history.acknowledgements)
    if history.may_lack:
        _require_gains(ledger, checked, all_series, axes, needs_any_gain=needs_any_gain)
    return checked, history, all_series


def _require_gains(
    ledger: Ledger,
    checked: Verification | None,
    all_series: tuple[Series, ...],
    axes: Sequence[str | None],
    *,
    needs_any_gain: bool,
) -> None:
    """Refuse to call gains absent that a changed audit log may have; args as of `_read`."""
    from daq.ledger.ledger import audit_error

    known = {series.axis for series in all_series if series.points}
    missing = [axis for axis in axes if axis in ledger.cell.axis_names and axis not in known]
    if missing:
        found = f"no identified gain of {missing[0]}"
    elif needs_any_gain and not known:
        found = "no identified gain"
    else:
        return
    if checked is not None:
        raise audit_error(checked.audit, checked.verdict)
    raise HistoryUnreadable(
        str(ledger.audit),
        found=f"{found} that can be read; changed lines may have one",
        expected="an audit log whose entries were never changed",
        remedy="see what is wrong with it: drivegain history CELL --verify; no entry was made",
    )


def _verified(ledger: Ledger) -> Verification:
    """Check audit and history; an audit that is no regular file is as broken as one that was
    edited.
    """
    from daq.ledger.ledger import verify_ledger

    try:
        return verify_ledger(ledger, _session_heads(ledger.cell))
    except AuditUnusable as error:
        remedy = "correct `history.audit` of the cell file"
        raise DataError(
            error.subject, found=error.found, expected=error.expected, remedy=remedy
        ) from error


def _session_heads(cell: Cell) -> list[str]:
    """SHA-256 of the entries that end the sessions of scheduled recalibrations."""
    from daq.jobs.session import sessions

    past = () if cell.recalibration is None else sessions(cell.recalibration.folder, cell.name)
    return [
        session.state.audit_sha256 for session in past if session.state.audit_sha256 is not None
    ]


def _require(ledger: Ledger, checked: Verification) -> None:
    """Raise what is wrong: with the audit log, with the history, or with a write that it lacks."""
    from daq.ledger.ledger import audit_error, stored_error

    if not checked.verdict.holds:
        raise audit_error(checked.audit, checked.verdict)
    unknown = [f"no event of {one}" for one in checked.unknown]
    if checked.broken and ledger.outdated:
        raise stored_error(ledger, [printable(one) for one in (*checked.broken, *unknown)])
    if checked.broken:
        raise HistoryUnreadable(
            str(checked.audit),
            found=_first([*checked.broken, *unknown]),
            expected="calibrations that this version can read",
            remedy="use the version of drivegain that entered them, or keep this file and begin "
            "another one under a new name (`history.audit`)",
        )
    if checked.unknown:
        raise HistoryUnreadable(
            str(checked.audit),
            found=_first(unknown),
            expected="a calibration in the history, and an end, of every write to this cell's "
            "controller",
            remedy="`drivegain history CELL --add CALIBRATION` for each calibration that was "
            "written, which also enters its writes from the audit; of a rollback with any one. "
            "Where a calibration is lost, keep the file and begin another one under a new name "
            "(`history.audit`)",
        )


def _first(sentences: Sequence[str]) -> str:
    texts = [printable(sentence) for sentence in sentences]
    return first_few(texts, _SHOWN, note=" (--json has all)")


def _check_files(plot: Path | None, csv: Path | None) -> None:
    from daq.report.history import COLUMNS

    if plot is not None:
        mark = _PICTURES.get(plot.suffix.lower())
        if mark is None:
            raise UsageError(
                "--plot", found=plot.name, expected="a name in .png or .svg", remedy="give one"
            )
        check_replaceable(plot, mark, "picture")
    if csv is not None:
        check_replaceable(csv, ",".join(COLUMNS[:3]), "table of a history")


def _migrate(ledger: Ledger, who: str, now: datetime, *, forced: bool) -> None:
    """Migrate a history of an earlier version;
    where that fails unasked, reading it reports what is wrong.
    """
    from daq.ledger.ledger import migrate

    if not forced and not ledger.outdated:
        return
    try:
        with delay_signals():
            done = migrate(ledger, who=who, at=now, forced=forced)
            if done.entries or done.aside is not None:
                CHANGED.append(f"the history of an earlier version was migrated to {ledger.audit}")
    except DaqError as error:
        if forced:
            raise
        _LOG.warning("the history of an earlier version stays where it is: %s", evidence(error))
        return
    if done.aside is None:
        say(f"There is no history of an earlier version; {ledger.audit} is the history.", err=True)
        return
    say(
        f"Migrated to {ledger.audit}: {done.entries} entries. The old history is {done.aside}.",
        err=True,
    )
    if done.flaws:
        say(
            f"The old history was broken ({_first(done.flaws)}): what only it had was not "
            "taken over.",
            err=True,
        )


def _say_names(history: History, cell_file: Path) -> None:
    """Say which calibrations are of another robot, and where those of this one may be."""
    for foreign in history.other_robots[:_SHOWN]:
        _LOG.warning("%s; no change of a gain is computed with it", printable(str(foreign)))
    more = len(history.other_robots) - _SHOWN
    if more > 0:
        _LOG.warning("and %s of another robot (--json has all)", counted(more, "more calibration"))
    if history.not_compared:
        texts = [str(one) for one in history.not_compared]
        _LOG.warning(
            "%s left out of tables, drift and alarms, for other axes or units than the newest one: "
            "%s",
            counted(len(texts), "calibration"),
            _first(texts),
        )
    if history.renamed is not None:
        _LOG.warning(
            "this cell was renamed: found the name %r, expected %r, since %s; %s",
            history.renamed.old,
            history.renamed.new,
            history.renamed.at,
            history.renamed.remedy,
        )
        return
    for name in history.possible_names:
        command = f"drivegain history {shlex.quote(str(cell_file))} --rename {shlex.quote(name)}"
        _LOG.warning(
            "this cell has no calibration here, and cell %r, of a robot with the same joints and "
            "drives, has; if this is that robot under a new name: `%s`",
            printable(name),
            command,
        )


def _rename(
    ledger: Ledger,
    cell_file: Path,
    old: str,
    named_folder: Path | None,
    who: str,
    now: datetime,
    *,
    confirmed: bool,
) -> None:
    """Take the history and the sessions of a cell's earlier name over;
    without `confirmed`, say what that would be.

    Sessions are looked for in the scheduled job's folder, in that of the cell file, in those that
    cell files of other names have left next to it, and in the one that was named.
    """
    from daq.jobs.position import former_session_folders, sessions_folder
    from daq.jobs.session import rename_sessions, sessions_to_rename
    from daq.jobs.units import unit_name
    from daq.ledger.ledger import plan_rename, rename_cell
    from daq.workflow.bus_lock import bus_lock

    cell = ledger.cell
    if old == cell.name:
        raise UsageError(
            "--rename",
            found=f"{old!r}, the name in {cell_file}",
            expected="the name that the cell had before",
            remedy="write the new name into the cell file (`name:`) first, then give the "
            "old one here",
        )
    if named_folder is not None and not named_folder.is_dir():
        raise UsageError(
            "--sessions",
            found=f"{named_folder}, which is no folder",
            expected="the folder that `drivegain calibrate` got with --sessions",
            remedy="correct its name; nothing was renamed",
        )
    own_folder = sessions_folder(cell_file)
    guided = {own_folder, *former_session_folders(cell_file)}
    if named_folder is not None:
        guided.add(named_folder)
    folders = set(guided)
    if cell.recalibration is not None:
        folders.add(cell.recalibration.folder)
    with bus_lock(cell):  # a job that runs would write its state under the old name again
        planned = plan_rename(ledger, old)
        until = planned.entered_at or now
        found = {folder: len(sessions_to_rename(folder, old, until)) for folder in folders}
        count = sum(found.values())
        taken = ", ".join(
            (
                counted(planned.calibrations, "calibration"),
                counted(planned.writes, "write"),
                counted(planned.acknowledgements, "explained change"),
                counted(count, "session"),
            )
        )
        if planned.undescribed:
            say(
                f"{counted(planned.undescribed, 'calibration')} of earlier versions do not say of "
                "which robot: the names of the axes are the same, and nothing else could be "
                "compared.",
                err=True,
            )
        if not confirmed:
            say(
                f"Would rename {old!r} to {cell.name!r}: {taken}. Nothing was renamed; "
                "--yes does it.",
                err=True,
            )
            return
        with delay_signals():
            rename_cell(ledger, planned, who=who, at=now)
            if planned.entered_at is None:
                CHANGED.append(
                    f"{ledger.audit} has the rename of {old!r} to {cell.name!r}; the same command "
                    "renames the sessions that still have the old name"
                )
            rename_sessions(folders, old, cell.name, until)
    if planned.entered_at is None:
        say(f"Renamed {old!r} to {cell.name!r}: {taken}.", err=True)
    else:
        say(
            f"{old!r} was renamed to {cell.name!r} on {planned.entered_at:%Y-%m-%d}; "
            f"{counted(count, 'session')} taken over now.",
            err=True,
        )
    for folder in sorted(guided - {own_folder}):
        if found[folder]:
            say(
                f"{counted(found[folder], 'session')} in {folder}, where `drivegain calibrate` "
                f"looks with --sessions alone: without it, it looks in {own_folder}.",
                err=True,
            )
    say(
        "Logs, plans and calibration files keep the old name: make new ones. A schedule of the old "
        f"name ({unit_name(replace(cell, name=old))}.timer) has to be disabled, and made again: "
        "drivegain schedule.",
        err=True,
    )


def _acknowledge(
    ledger: Ledger, series: Series, who: str, why: str | None, since: str | None, now: datetime
) -> None:
    from daq.ledger.ledger import acknowledge

    if not why or not why.strip():
        reason = "what happened, for a reader in a year"
        raise UsageError(
            "--why", found="nothing", expected=reason, remedy='give it: --why "gearbox changed"'
        )
    # Of a drift, only the newest calibration surely shows the gain as it is now; a log's clock may
    # be ahead of ours.
    begins = min(series.points[-1].entry.recorded, now) if since is None else _day(since, now)
    with delay_signals():
        acknowledge(ledger, series.axis, since=begins, at=now, who=who, why=why)
        CHANGED.append(f"the change of {series.axis} was entered as explained into {ledger.audit}")


def _add(ledger: Ledger, file: Path, who: str, now: datetime) -> None:
    from daq.documents.calibration_file import decode_calibration, read_calibration_bytes
    from daq.ledger.ledger import enter_calibration, verify_ledger

    content = read_calibration_bytes(file)
    calibration = decode_calibration(content, str(file))
    if calibration.cell != ledger.cell.name:
        raise DataError(
            str(file),
            found=f"a calibration of cell {calibration.cell!r}",
            expected=f"one of {ledger.cell.name!r}",
            remedy="give the file of the cell that it belongs to; it was not entered",
        )
    before = verify_ledger(ledger).unknown
    with delay_signals():  # an interrupt says what was entered
        new = enter_calibration(ledger, calibration, digest=sha256(content), who=who, at=now)
        if new:
            CHANGED.append(f"{file} was entered into {ledger.audit}")
    say(f"{file.name}: {'entered' if new else 'it was in the history already'}.", err=True)
    # The process that wrote it may have been killed before it was entered.
    checked = verify_ledger(ledger, _session_heads(ledger.cell))
    left = {write.ended.number for write in checked.unknown}
    for write in before:
        if write.ended.number not in left:
            say(f"Entered too: {printable(str(write))}.", err=True)
    if not checked.complete:
        say(
            "Not all writes in the audit could be entered: see `drivegain history CELL --verify`.",
            err=True,
        )


def _day(text: str, now: datetime) -> datetime:
    from daq.ledger.fold import utc

    never = datetime.min.replace(tzinfo=UTC)
    found = utc(text, never)
    if found == never:
        raise UsageError(
            "--since",
            found=repr(text),
            expected="a date, 2026-03-02, or a time with its zone",
            remedy="spell it so",
        )
    if found > now:
        # Until then every calibration would be left out, and no alarm of the axis shown.
        raise UsageError(
            "--since",
            found=f"{text!r}, which is {found:%Y-%m-%d %H:%M:%S} UTC",
            expected=f"no later than now, {now:%Y-%m-%d %H:%M:%S} UTC",
            remedy="give the day of the change, with its zone where the day here is not that of "
            "UTC (2026-03-02T00:00+10:00); acknowledge the alarm of a coming change when it is "
            "shown",
        )
    return found


def _named(all_series: tuple[Series, ...], axis: str, cell: Cell) -> Series:
    known = {series.axis: series for series in all_series}
    if axis not in cell.axis_names:
        raise UsageError(
            "axis",
            found=repr(axis),
            expected=f"one of {', '.join(cell.axis_names)}",
            remedy="give its name",
        )
    if axis not in known or not known[axis].points:
        raise UsageError(
            "history",
            found=f"no identified gain of {axis}",
            expected="at least one calibration",
            remedy="enter one: drivegain history CELL --add CALIBRATION",
        )
    return known[axis]


def _write_files(
    chosen: tuple[Series, ...], cell: Cell, picture: Path | None, csv: Path | None
) -> None:
    from daq.report.history import csv_text, plot_history

    drawn = [series for series in chosen if series.points]
    if picture is not None:
        if not drawn:
            raise UsageError(
                "--plot",
                found="an empty history",
                expected="at least one calibration",
                remedy="fit and apply one first",
            )
        kind = picture.suffix.lower().removeprefix(".")
        write_file(picture, plot_history(drawn, kind, title=f"Drive gains of {cell.name}"))
    if csv is not None:
        write_file(csv, csv_text(chosen))
