"""`drivegain export log`: a log as a table for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from daq.cli.output import say_written
from daq.cli.progress import status
from daq.cli.verb import JsonOption, Verb, print_json
from daq.errors import UsageError
from daq.export import TableFormat, export_log


def export_log_verb(
    log: Annotated[Path, typer.Argument(help="A log (.mcap).")],
    out: Annotated[Path, typer.Option("--out", help="Table to write; must not exist.")],
    csv: Annotated[bool, typer.Option("--csv", help="Comma-separated text.")] = False,
    parquet: Annotated[
        bool, typer.Option("--parquet", help="Apache Parquet; needs pip install 'drivegain[parquet]'.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """Write the samples of a log into a table: a row a SYNC, joint positions and currents in SI beside raw numbers.

    The log itself opens in Foxglove and PlotJuggler as it is (configs/viewers).
    """
    kind = _format(csv, parquet)
    with status(f"writing {kind.value}"):
        done = export_log(log, out, kind)
    if done.partial:
        typer.echo(f"{log} is PARTIAL: saved from a recording that was never finished", err=True)
    if not done.valid:
        typer.echo(f"{log} is INVALID: {done.reason or 'no reason given'}; a fit refuses it", err=True)
    if json:
        print_json({"log": str(log), "table": str(out), "format": kind.value, "rows": done.rows,
                    "columns": list(done.columns), "partial": done.partial, "valid": done.valid})  # fmt: skip
    else:
        console = Console(soft_wrap=True, highlight=False)
        console.print(f"{done.rows} rows of {len(done.columns)} columns", markup=False)
        say_written(console, out)


def _format(csv: bool, parquet: bool) -> TableFormat:
    wanted = [kind for kind, asked in ((TableFormat.CSV, csv), (TableFormat.PARQUET, parquet)) if asked]
    if len(wanted) != 1:
        raise UsageError(
            "--csv, --parquet",
            found="both" if wanted else "neither",
            expected="one of them",
            remedy="say which kind of table to write",
        )
    return wanted[0]


EXPORT_LOG = Verb("log", export_log_verb, "drivegain export log loaded.mcap --csv --out loaded.csv")
