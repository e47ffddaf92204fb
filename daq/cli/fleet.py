"""`drivegain fleet`: fit the logs of many cells, and tabulate their calibrations."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from daq.cli.terminal import check_replaceable, print_view, progress_bar, write_file
from daq.cli.verb import JsonOption, output_option, print_json
from daq.errors import ExitCode, OutputFailed


def fleet_verb(
    logs: Annotated[
        str,
        typer.Argument(
            help="Folder with the logs of many cells, or an address (s3://BUCKET/PATH)."
        ),
    ],
    scheduler: Annotated[
        str,
        typer.Option(
            help="threads of this process, processes of this machine, or the address of a dask "
            "scheduler (tcp://127.0.0.1:8786). The last two need pip install 'drivegain[fleet]'."
        ),
    ] = "threads",
    workers: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Cells fitted at a time; by default one per processor or thread of the scheduler.",
        ),
    ] = None,
    residual: Annotated[
        bool, typer.Option("--residual", help="Also detect missing effects: slow.")
    ] = False,
    out: Annotated[
        Path | None,
        output_option(
            "--out",
            "Folder for a calibration of each cell; a cell is not fitted again from the same logs.",
        ),
    ] = None,
    csv: Annotated[
        Path | None,
        output_option("--csv", "File for the table; an earlier table is replaced."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Fit the logs of many cells, one task per cell;
    a cell that cannot be fitted is a line with its error.

    Cell and payload are read from the logs. Where a cell has a second run with the same payload,
    the newest is held out. The exit code is 4 if any cell could not be fitted.
    """

    from daq.jobs.cell_fit import Loop, open_cache
    from daq.jobs.fleet import (
        FIRST_COLUMNS,
        fit_fleet,
        fleet_csv,
        fleet_report,
        fleet_view,
        worker_pool,
    )
    from daq.jobs.fleet_survey import list_logs

    loop = Loop.CLOSED if residual else Loop.OPEN
    if csv is not None:
        # Refused before any work: a missing folder, and a file of another kind.
        if not csv.parent.is_dir():
            raise OutputFailed.of(csv, FileNotFoundError(2, "No such folder"))
        check_replaceable(csv, ",".join(FIRST_COLUMNS), "table of a fleet")
    wanted = worker_pool(scheduler, workers)
    found = list_logs(logs)
    cache = None if out is None else open_cache(out, loop)
    with progress_bar("fitting the fleet") as report_progress, wanted as pool:
        rows = fit_fleet(found, pool, loop, cache, lambda: datetime.now(UTC), report_progress)
    if csv is not None:
        write_file(csv, fleet_csv(rows))
    if json:
        print_json(fleet_report(rows))
    else:
        print_view(fleet_view(rows), out, csv)
    if not all(row.fitted for row in rows):
        raise typer.Exit(ExitCode.DATA_UNFIT)
