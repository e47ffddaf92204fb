"""`drivegain fleet`: many cells' logs, a calibration each, and a table of them all."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from daq.cli.terminal import progress_bar, say_written
from daq.cli.verb import JsonOption, Verb, print_json, printable
from daq.errors import ExitCode, OutputFailed, UsageError
from daq.files import replace_file
from daq.jobs.cell_fit import Failure, Loop, open_cache
from daq.jobs.fleet import FleetRow, fit_fleet
from daq.jobs.fleet_survey import Summary, list_logs
from daq.jobs.workers import worker_pool
from daq.report.fleet import FIRST_COLUMNS, fleet_csv, fleet_document
from daq.report.gains import with_deviation


def fleet_verb(
    logs: Annotated[str, typer.Argument(help="Folder with the logs of many cells, or an address (s3://BUCKET/PATH).")],
    scheduler: Annotated[
        str,
        typer.Option(
            help="threads of this process; processes of this machine; or the address of a dask scheduler "
            "(tcp://127.0.0.1:8786). The last two need pip install 'drivegain[fleet]'."
        ),
    ] = "threads",
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Cells at a time; by default one a processor, or a thread of the scheduler."),
    ] = None,
    residual: Annotated[
        bool, typer.Option("--residual", help="Of every cell, also find what the model lacks, and add it: slow.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", help="Folder for a calibration a cell; what stands there of the same logs is not fitted again."
        ),
    ] = None,
    csv: Annotated[Path | None, typer.Option("--csv", help="File for the table; an earlier table is replaced.")] = None,
    json: JsonOption = False,
) -> None:
    """Fit the logs of many cells, one task a cell; a cell that cannot be fitted is a line with its error.

    The logs say themselves of which cell they are, and with which payload. Where a cell has a second run with the same
    payload, the newest is held out. Exit code 4 where any cell could not be fitted.
    """
    loop = Loop.CLOSED if residual else Loop.OPEN
    check_table(csv)
    wanted = worker_pool(scheduler, workers)
    found = list_logs(logs)
    cache = None if out is None else open_cache(out, loop)
    with progress_bar("fitting the fleet") as report_progress, wanted.start_pool() as pool:
        rows = fit_fleet(found, pool, loop, cache, lambda: datetime.now(UTC), report_progress)
    if csv is not None:
        try:
            replace_file(csv, fleet_csv(rows).encode())
        except OSError as error:
            raise OutputFailed.of(csv, error) from error
    if json:
        print_json(fleet_document(rows))
    else:
        console = Console()
        console.print(fleet_table(rows))
        for line in remarks(rows):
            console.print(Text(printable(line)))
        say_written(Console(soft_wrap=True), out, csv)
    if not all(row.fitted for row in rows):
        raise typer.Exit(ExitCode.DATA_UNFIT)


def check_table(path: Path | None) -> None:
    """Refuse a table that could not be written, or would replace something else than a table of a fleet.

    Raises:
        UsageError: there is another file of that name.
        OutputFailed: its folder is not there.
    """
    if path is None:
        return
    if not path.parent.is_dir():
        raise OutputFailed.of(path, FileNotFoundError(2, "No such folder"))
    if path.exists() and not (path.is_file() and _is_table(path)):
        raise UsageError(
            str(path),
            found="something that is no table of a fleet",
            expected="no file, or an earlier table",
            remedy="choose another name, or move it away",
        )


def _is_table(path: Path) -> bool:
    header = ",".join(FIRST_COLUMNS).encode()
    with path.open("rb") as stream:
        return stream.read(len(header)) == header


def fleet_table(rows: Sequence[FleetRow]) -> Table:
    """A row a cell, for a person; errors are red."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    table.add_column("cell", overflow="fold")
    table.add_column("gains ± σ", ratio=1)
    table.add_column("worst σ %", justify="right", no_wrap=True)
    table.add_column("error %", justify="right", no_wrap=True)
    effects = any(isinstance(row.result, Summary) and row.result.effects for row in rows)
    if effects:
        table.add_column("effects")
    table.add_column("s", justify="right", no_wrap=True)
    for row in rows:
        cells = _failure(row.result) if isinstance(row.result, Failure) else _summary(row.result)
        style = "bold red" if isinstance(row.result, Failure) else None
        shown = (*cells[:3], *(cells[3:] if effects else ()), f"{row.seconds:.2f}")
        table.add_row(*map(Text, (printable(row.cell), *shown)), style=style)
    return table


def _failure(failure: Failure) -> tuple[str, str, str, str]:
    return printable(f"{failure.kind}: {failure.text}"), "", "", ""


def _summary(summary: Summary) -> tuple[str, str, str, str]:
    """Gains, the worst of them, the error and the effects."""
    # Lines break between gains, not within one.
    gains = ", ".join(with_deviation(gain.value, gain.std).replace(" ", "\xa0") for gain in summary.gains)
    units = ", ".join(dict.fromkeys(gain.unit for gain in summary.gains))
    worst = f"{summary.worst.axis} {summary.worst.std_percent:.2f}"
    error = f"{summary.error_percent:.2f}" + ("" if summary.held_out else "*")
    effects = ", ".join(f"{name} {axis}" for name, axis in summary.effects)
    return f"{gains} {printable(units)}", printable(worst), error, printable(effects)


def remarks(rows: Sequence[FleetRow]) -> list[str]:
    """What the table cannot tell."""
    fitted = [(row, row.result) for row in rows if isinstance(row.result, Summary)]
    kept = sum(row.kept for row, _ in fitted)
    again = f" ({kept} of them stood already, of the same logs)" if kept else ""
    lines = [f"{len(fitted)} of {len(rows)} fitted{again}."]
    if not all(summary.held_out for _, summary in fitted):
        lines.append("* on the moves of the fit itself: the cell has no second run with the same payload to hold out.")
    several = {row.cell: row.configurations for row in rows if row.configurations > 1}
    lines += [
        f"{cell}: logs of {count} configurations, each fitted by itself: which one is the cell's?"
        for cell, count in several.items()
    ]
    lines += [
        f"{row.cell}: PARTIAL or lossy data: not for a controller; `apply` refuses it."
        for row, summary in fitted
        if summary.partial
    ]
    return lines


FLEET = Verb("fleet", fleet_verb, "drivegain fleet logs --scheduler processes --out calibrations --csv fleet.csv")
