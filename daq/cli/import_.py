"""`drivegain import`: CSV files of another controller become a log."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from daq.cli.verb import JsonOption, Verb, print_json
from daq.importing import import_csv
from daq.version import software


def import_files(
    description: Annotated[Path, typer.Argument(help="Import description (YAML): columns, units, rate.")],
    data: Annotated[Path, typer.Option("--data", help="Folder of the CSV files.")],
    out: Annotated[Path, typer.Option("--out", help="Log to write (.mcap); must not exist.")],
    cell: Annotated[Path | None, typer.Option("--cell", help="Another cell file than the description's.")] = None,
    json: JsonOption = False,
) -> None:
    """Make a log of the CSV files that another controller wrote."""
    statistics = import_csv(description, data, out, software=software(), cell_path=cell)
    if json:
        print_json({"log": str(out), **asdict(statistics)})
    else:
        typer.echo(f"{out}: {statistics.samples} samples of {len(statistics.missing)} axes")


IMPORT = Verb(
    "import", import_files, "drivegain import configs/imports/tx40.yaml --data ../shared/data/tx40 --out tx40.mcap"
)
