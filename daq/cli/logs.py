"""`drivegain info`, `import`, `salvage` and `export`: logs, and the files of other programs."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from daq.cli.terminal import (
    WRITTEN,
    one_of,
    output_console,
    print_view,
    progress_bar,
    say,
    status,
    write_new_folder,
)
from daq.cli.verb import (
    CalibrationArgument,
    CellOption,
    JsonOption,
    corrected_cell,
    output_option,
    print_json,
    read_calibration,
)
from daq.environment import software
from daq.errors import DaqError, LogForeign, OutputFailed, counted
from daq.report.text import printable

NewLogOption = Annotated[Path, output_option("--out", "Log to write (.mcap); must not exist.")]


def info(
    log: Annotated[Path, typer.Argument(help="A log (.mcap).")],
    extract_cell: Annotated[
        Path | None,
        output_option(
            "--extract-cell",
            "New folder for the cell description in the log: cell file, URDF, drives.",
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Show what is in a log: role and payload, duration, losses, moves, validity.

    With --extract-cell also write the description of the cell as files that every verb takes as
    --cell.
    """
    from daq.report.document import json_tree
    from daq.report.log import info_report, log_lines

    try:
        report = info_report(log)
    except LogForeign as error:
        with suppress(DaqError):
            read_calibration(log)
            error.found = "a calibration"
            error.remedy = f"`drivegain certificate {log}` reads it"
        raise
    if extract_cell is None:
        written = None
    else:
        written = _extract_cell(log, extract_cell)
    if json:
        print_json(report)
    else:
        print_view(log_lines(json_tree(report), output_console().width), written)


def _extract_cell(log: Path, folder: Path) -> Path:
    """Write the cell description of a log into a new or empty folder, all files or none;
    return the cell file.

    Raises:
        UsageError: the folder has something in it.
        OutputFailed: what was written is not read as the cell of the log.
    """
    from daq.config.cell_file import load_cell
    from daq.config.extracted_cell import extracted_cell
    from daq.config.same_cell import differing_sections
    from daq.log.reader import read_log

    head = read_log(log).head
    place, files = extracted_cell(head.files)
    with write_new_folder(folder) as whole:
        for path, content in files.items():
            target = whole / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(content)
        differing = differing_sections(head.cell(log), load_cell(whole / place))
        if differing:
            raise OutputFailed(
                str(folder),
                found=f"another {', '.join(differing)} on reading back",
                expected="the description in the log",
                remedy="nothing was written; please report this log",
            )
    return folder / place


def import_files(
    description: Annotated[
        Path, typer.Argument(help="Import description (YAML): columns, units, rate.")
    ],
    out: NewLogOption,
    data: Annotated[
        Path | None,
        typer.Option("--data", help="Folder of the files; the description's when left out."),
    ] = None,
    cell: Annotated[
        Path | None, typer.Option("--cell", help="Another cell file than the description's.")
    ] = None,
    holdout: Annotated[
        Path | None,
        output_option(
            "--holdout", "Log to write of the part that `holdout` of the description names (.mcap)."
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Convert CSV files, MATLAB files or ROS bags of another controller to a log, or to two,
    one held out.
    """
    from daq.log.importing import import_recording
    from daq.report.log import import_report, timing_text

    folder = data or description.parent
    imported = import_recording(
        description, folder, out, software=software(), cell_path=cell, holdout=holdout
    )
    WRITTEN.append(out)
    statistics = imported.statistics
    timing = imported.timing
    if json:
        print_json(import_report(out, imported, holdout))
        return
    say(f"{out}: {counted(statistics.samples, 'sample')} of {len(statistics.missing)} axes")
    if holdout is not None and imported.holdout is not None:
        WRITTEN.append(holdout)
        say(f"{holdout}: {counted(imported.holdout.samples, 'sample')}, held out")
    for line in (*(() if timing is None else (timing_text(timing),)), *imported.remarks):
        say(printable(line))


def salvage_verb(
    log: Annotated[
        Path,
        typer.Argument(help="Unfinished (.mcap.part), cut off or damaged log; it is only read."),
    ],
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
    if statistics.valid:
        use = ": `fit` accepts it and says so; `apply` refuses the result"
    else:
        use = ""
    say(
        f"{printable(str(out))}: {statistics.samples} samples, {saved.duration_s:g} s, PARTIAL{use}"
    )
    if saved.left_out_bytes:
        say(f"left out: {saved.left_out_bytes} bytes, from {printable(saved.damage)}")
    if not statistics.valid:
        say(f"INVALID: {printable(statistics.reason)}; a fit will refuse it")


def export_verb() -> None:
    """Write a calibration or a log as a file of another program."""


def export_log_verb(
    log: Annotated[Path, typer.Argument(help="A log (.mcap).")],
    out: Annotated[Path, output_option("--out", "Table to write; must not exist.")],
    csv: Annotated[bool, typer.Option("--csv", help="Comma-separated text.")] = False,
    parquet: Annotated[
        bool, typer.Option("--parquet", help="Apache Parquet, needs drivegain[parquet].")
    ] = False,
    json: JsonOption = False,
) -> None:
    """Write the samples of a log into a table:
    a row per SYNC, joint positions and currents in SI, and the raw numbers.

    The log itself opens in Foxglove and PlotJuggler (configs/viewers).
    """
    from daq.log.export import TableFormat, export_log
    from daq.report.log import table_report

    one_of("choose the kind of table to write", csv=csv, parquet=parquet)
    kind = TableFormat.CSV if csv else TableFormat.PARQUET
    with status(f"writing {kind.value}"):
        done = export_log(log, out, kind)
    _warn(log, done.partial, done.valid, done.reason)
    if json:
        print_json(table_report(log, out, kind, done))
    else:
        rows = counted(done.rows, "row")
        print_view([f"{rows} of {counted(len(done.columns), 'column')}"], out)


def export_csv_verb(
    calibration: CalibrationArgument,
    log: Annotated[Path, typer.Argument(help="A log (.mcap) of the same cell.")],
    out: Annotated[Path, output_option("--out", "Table to write (.csv); must not exist.")],
    cell: CellOption = None,
    json: JsonOption = False,
) -> None:
    """Write what a calibration predicts of a log, what was measured, and the residual,
    for a spreadsheet.

    A row per equation of the fit: filtered and decimated as it was. Torque of each joint, current
    reference of each motor, and whether the row counts in the relative errors.
    """
    from daq.log.export import TableFormat, require_new_table, write_table
    from daq.report.validation import residual_table_report
    from daq.workflow.residual_table import residual_table

    require_new_table(out, TableFormat.CSV)
    with status("predicting"):
        found = residual_table(read_calibration(calibration), log, corrected_cell(cell))
    write_table(out, TableFormat.CSV, [found.columns])
    report = residual_table_report(found, calibration, log, out)
    if json:
        print_json(report)
    else:
        rows = counted(report.rows, "row")
        total = report.relative_error_percent.total
        print_view(
            [f"{rows} of {counted(len(report.columns), 'column')}; relative error {total:.3g} %"],
            out,
        )


def _warn(log: Path, partial: bool, valid: bool, reason: str) -> None:
    """Say on stderr what a log lacks."""
    if partial:
        say(f"{log} is PARTIAL: saved from an unfinished recording", err=True)
    if not valid:
        say(f"{log} is INVALID: {reason or 'no reason given'}; a fit refuses it", err=True)


def export_bag_verb(
    log: Annotated[Path, typer.Argument(help="A log (.mcap).")],
    out: Annotated[Path, output_option("--out", "Folder to write (rosbag2); must not exist.")],
    calibration: Annotated[
        Path | None,
        typer.Option(
            help="Calibration of the cell; its gains give the effort of the joint states."
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Write a log as a ROS 2 bag: /joint_states, currents in A, events and /robot_description.

    Joint states are at the full rate, with the names of the URDF's joints; effort only with
    --calibration.
    """
    from daq.log.bag_writer import export_bag
    from daq.report.log import bag_report

    if calibration is None:
        known = None
    else:
        known = read_calibration(calibration)
    with status("writing the bag"):
        done = export_bag(log, out, known)
    _warn(log, done.partial, done.valid, done.reason)
    if json:
        print_json(bag_report(log, out, done, effort=known is not None))
    else:
        print_view(
            [f"{topic}: {counted(count, 'message')}" for topic, count in done.messages.items()], out
        )
