"""`drivegain info`, `import` and `salvage`: show a log, convert other recordings, save a damaged log."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from daq.cli.terminal import WRITTEN, output_console, print_view, progress_bar
from daq.cli.verb import JsonOption, Verb, output_option, print_json
from daq.environment import software
from daq.errors import DaqError, LogForeign
from daq.report.text import printable

NewLogOption = Annotated[Path, output_option("--out", "Log to write (.mcap); must not exist.")]


def info(log: Annotated[Path, typer.Argument(help="A log (.mcap).")], json: JsonOption = False) -> None:
    """Show what is in a log: role and payload, duration, losses, moves, validity."""
    from daq.documents.calibration_file import load_calibration
    from daq.report.document import json_tree
    from daq.report.log import info_report, log_lines

    try:
        report = info_report(log)
    except LogForeign as error:
        with suppress(DaqError):
            load_calibration(log)
            error.found = "a calibration"
            error.remedy = f"`drivegain report {log}` reads it"
        raise
    if json:
        print_json(report)
    else:
        print_view(log_lines(json_tree(report), output_console().width))


INFO = Verb("info", info, "drivegain info loaded.mcap")


def import_files(
    description: Annotated[Path, typer.Argument(help="Import description (YAML): columns, units, rate.")],
    data: Annotated[Path, typer.Option("--data", help="Folder of the files.")],
    out: NewLogOption,
    cell: Annotated[Path | None, typer.Option("--cell", help="Another cell file than the description's.")] = None,
    json: JsonOption = False,
) -> None:
    """Convert CSV files, MATLAB files or ROS 2 bags of another controller to a log."""
    from daq.log.importing import import_recording
    from daq.report.log import import_report, timing_text

    imported = import_recording(description, data, out, software=software(), cell_path=cell)
    WRITTEN.append(out)
    statistics = imported.statistics
    timing = imported.timing
    if json:
        print_json(import_report(out, imported))
        return
    typer.echo(f"{out}: {statistics.samples} samples of {len(statistics.missing)} axes")
    for line in (*(() if timing is None else (timing_text(timing),)), *imported.remarks):
        typer.echo(printable(line))


IMPORT = Verb(
    "import", import_files, "drivegain import press-4/imports/press-4.yaml --data csv-files --out imported.mcap"
)


def salvage_verb(
    log: Annotated[Path, typer.Argument(help="Unfinished (.mcap.part), cut off or damaged log; it is only read.")],
    out: NewLogOption,
    json: JsonOption = False,
) -> None:
    """Save the readable part of an unfinished or damaged log as a new log that is labelled partial.

    `fit` accepts a valid partial log and says so; `apply` refuses the result.
    """
    from daq.log.salvage import salvage
    from daq.report.log import salvage_report

    with progress_bar("salvaging") as report_progress:
        saved = salvage(log, out, lambda samples: report_progress(samples, 0, "samples"))
    WRITTEN.append(out)
    statistics = saved.statistics
    if json:
        print_json(salvage_report(out, saved))
        return
    use = ": `fit` accepts it and says so; `apply` refuses the result" if statistics.valid else ""
    typer.echo(f"{printable(str(out))}: {statistics.samples} samples, {saved.duration_s:g} s, PARTIAL{use}")
    if saved.left_out_bytes:
        typer.echo(f"left out: {saved.left_out_bytes} bytes, from {printable(saved.damage)}")
    if not statistics.valid:
        typer.echo(f"INVALID: {printable(statistics.reason)}; a fit will refuse it")


SALVAGE = Verb("salvage", salvage_verb, "drivegain salvage loaded.mcap.part --out loaded-partial.mcap")
