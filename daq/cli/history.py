"""`drivegain history`: every calibration of a cell, how its gains have changed, and whether they drift."""

from __future__ import annotations

import hashlib
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from daq.atomic_file import replace_file
from daq.calibration_file import decode, read
from daq.cli.applier import applier
from daq.cli.history_audit import verify_history
from daq.cli.history_deeds import deed_words, in_force
from daq.cli.history_view import describe, show, show_axis
from daq.cli.output import say_written
from daq.cli.verb import JsonOption, Verb, print_json, printable
from daq.configuration.cell import Cell
from daq.configuration.cell_file import load_cell
from daq.configuration.history_place import HistoryPlace
from daq.errors import (
    ConfigurationInconsistent,
    HistoryMixed,
    OutputExists,
    OutputFailed,
    UsageError,
)
from daq.history.audited import catch_up
from daq.history.entry import Acknowledgement, utc
from daq.history.store import HistoryStore
from daq.history.watch import Series, watch
from daq.report.history import plot_history
from daq.report.history_table import COLUMNS, csv_text
from daq.write_back.audit import AuditAction, append
from daq.write_back.link import followed

_PICTURES = {".png": b"\x89PNG", ".svg": b"<?xml"}
"""Suffixes of pictures, and how such a file begins."""


def history_verb(
    cell: Annotated[Path, typer.Argument(help="Cell file; it says where its history is.")],
    axis: Annotated[str | None, typer.Option("--axis", help="One axis: every calibration of its gain.")] = None,
    plot: Annotated[Path | None, typer.Option("--plot", help="Picture to write, .png or .svg.")] = None,
    csv: Annotated[Path | None, typer.Option("--csv", help="Table to write, for a spreadsheet.")] = None,
    add: Annotated[Path | None, typer.Option("--add", help="Enter a calibration by hand.")] = None,
    acknowledge: Annotated[
        str | None, typer.Option("--acknowledge", metavar="AXIS", help="A change is explained: a new baseline begins.")
    ] = None,
    by: Annotated[
        str | None, typer.Option("--by", help="With --acknowledge: who explains it; you, by default.")
    ] = None,
    why: Annotated[str | None, typer.Option("--why", help="With --acknowledge: what happened.")] = None,
    since: Annotated[
        str | None,
        typer.Option("--since", metavar="DATE", help="With --acknowledge: first day that counts for the new baseline."),
    ] = None,
    verify: Annotated[
        bool,
        typer.Option("--verify", help="Check audit and history, by themselves and together; exit code 4 if broken."),
    ] = False,
    json: JsonOption = False,
) -> None:
    """Show the calibrations of a cell, which were applied, the change of each gain with its σ, and alarms.

    An alarm means that a gain has changed by more than noise: a drift that adds up (CUSUM), a steady trend, or one
    calibration far off. What it may come from is asked, not claimed. docs/history.md says how often an alarm is false.
    """
    declared = load_cell(cell)
    place = _place(declared, cell)
    picture = None if plot is None else _picture(plot)
    _check_csv(csv)
    if acknowledge is None and (why is not None or since is not None or by is not None):
        raise UsageError(
            "--by, --why, --since",
            found="no --acknowledge",
            expected="them with --acknowledge AXIS",
            remedy="name the axis whose change is explained",
        )
    now = datetime.now(UTC)
    with HistoryStore(place.store) as store:
        if add is not None:
            _add(store, declared, place, add, now)
        all_series = watch(store.entries(), store.acknowledgements())
        if acknowledge is not None:
            _acknowledge(store, place, _named(all_series, acknowledge, declared), by, why, since, now)
            all_series = watch(store.entries(), store.acknowledgements())
        chosen = all_series if axis is None else (_named(all_series, axis, declared),)
        if picture is not None:
            _plot(picture, chosen, declared)
        if csv is not None:
            _write_csv(csv, chosen)
        entries = store.entries()
        current = in_force(declared, store)
        deeds = deed_words(entries, store.events(), current)
        if verify and declared.controller_path is not None:
            # Where its links lead decides which writes are this cell's: another user's link could hide some.
            followed(declared.controller_path)
        checked = verify_history(declared, place, store) if verify else None
        console = Console(soft_wrap=True, highlight=False, markup=False)
        if json:
            document = describe(declared.name, entries, chosen, all_series, current)
            print_json(document if checked is None else {**document, "audit": checked.document})
        else:
            if checked is not None:
                checked.say(console)
            elif axis is not None:
                show_axis(chosen[0], all_series, deeds, console)
            else:
                show(entries, all_series, deeds, console)
            say_written(console, picture, csv)
        if checked is not None:
            checked.require()


def _place(cell: Cell, file: Path) -> HistoryPlace:
    if cell.history is None:
        raise ConfigurationInconsistent(
            str(file), found="no history", expected="a cell file", remedy="give the cell file, not a log"
        )
    return cell.history


def _add(store: HistoryStore, cell: Cell, place: HistoryPlace, file: Path, now: datetime) -> None:
    content = read(file)
    calibration = decode(content, str(file))
    if calibration.cell != cell.name:
        raise HistoryMixed(
            str(file),
            found=f"a calibration of cell {calibration.cell!r}",
            expected=f"one of {cell.name!r}",
            remedy="give the file of the cell that it belongs to; nothing was entered",
        )
    new = store.add(calibration, digest=hashlib.sha256(content).hexdigest(), at=now)
    told = "entered" if new else "it was in the history already"
    console = Console(stderr=True, soft_wrap=True, highlight=False, markup=False)
    console.print(f"{file.name}: {told}.")
    # Whoever wrote it may have been killed before the history knew.
    for write in catch_up(cell, place, store):
        console.print(f"Entered too: {printable(str(write))}.")
    left = verify_history(cell, place, store)
    if left.unknown or not left.verdict.holds:
        console.print("Not all writes that the audit tells of could be entered: see `drivegain history CELL --verify`.")


def _acknowledge(
    store: HistoryStore,
    place: HistoryPlace,
    series: Series,
    by: str | None,
    why: str | None,
    since: str | None,
    now: datetime,
) -> None:
    if not why or not why.strip():
        raise UsageError(
            "--why",
            found="nothing",
            expected="what happened, for whoever reads this in a year",
            remedy='give it: --why "gearbox changed"',
        )
    # Of a drift, only the newest calibration surely shows the gain as it is now; a log's clock may be ahead of ours.
    begins = min(series.points[-1].entry.recorded, now) if since is None else _day(since, now)
    who = str(applier(by))
    try:
        entry = append(
            place.audit,
            AuditAction.ACKNOWLEDGED,
            at=now,
            who=who,
            subject=f"gain of {series.axis}",
            details={"axis": series.axis, "since": begins.isoformat(), "why": why},
        )
    except OSError as error:
        raise OutputFailed.of(place.audit, error) from error
    store.acknowledge(Acknowledgement(series.axis, begins, now, who, why, entry.sha256))


def _day(text: str, now: datetime) -> datetime:
    never = datetime.min.replace(tzinfo=UTC)
    found = utc(text, never)
    if found == never:
        raise UsageError(
            "--since", found=repr(text), expected="a date, 2026-03-02, or a time with its zone", remedy="spell it so"
        )
    if found > now:
        # Until then every calibration would be left out, and no alarm of the axis told.
        raise UsageError(
            "--since",
            found=f"{text!r}, which is {found:%Y-%m-%d %H:%M:%S} UTC",
            expected=f"no later than now, {now:%Y-%m-%d %H:%M:%S} UTC",
            remedy="give the day of the change, with its zone where the day here is not that of UTC "
            "(2026-03-02T00:00+10:00); of a change that is still to come acknowledge the alarm when it is told",
        )
    return found


def _named(all_series: tuple[Series, ...], axis: str, cell: Cell) -> Series:
    known = {series.axis: series for series in all_series}
    if axis not in cell.axis_names:
        raise UsageError(
            "axis", found=repr(axis), expected=f"one of {', '.join(cell.axis_names)}", remedy="give its name"
        )
    if axis not in known or not known[axis].points:
        raise UsageError(
            "history",
            found=f"no identified gain of {axis}",
            expected="at least one calibration",
            remedy="enter one: drivegain history CELL --add CALIBRATION",
        )
    return known[axis]


def _picture(path: Path) -> Path:
    begins = _PICTURES.get(path.suffix.lower())
    if begins is None:
        raise UsageError("--plot", found=path.name, expected="a name in .png or .svg", remedy="give one")
    _require_replaceable(path, begins)
    return path


def _check_csv(path: Path | None) -> None:
    if path is not None:
        _require_replaceable(path, ",".join(COLUMNS[:3]).encode())


def _require_replaceable(path: Path, begins: bytes) -> None:
    """A file of another kind is not written over."""
    if path.is_dir() or (path.is_file() and path.stat().st_size and not path.read_bytes().startswith(begins)):
        raise OutputExists(
            str(path),
            found="something of another kind",
            expected="no file, or an earlier one of the same kind",
            remedy="choose another name, or move it away",
        )


def _plot(path: Path, chosen: tuple[Series, ...], cell: Cell) -> None:
    drawn = [series for series in chosen if series.points]
    if not drawn:
        raise UsageError(
            "--plot", found="an empty history", expected="at least one calibration", remedy="fit and apply one first"
        )
    try:
        plot_history(path, drawn, title=f"Drive gains of {cell.name}")
    except OSError as error:
        raise OutputFailed.of(path, error) from error


def _write_csv(path: Path, chosen: tuple[Series, ...]) -> None:
    try:
        replace_file(path, csv_text(chosen).encode())
    except OSError as error:
        raise OutputFailed.of(path, error) from error


HISTORY = Verb("history", history_verb, "drivegain history cells/demo.yaml --axis J4 --plot history.png")
