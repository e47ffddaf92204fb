"""`drivegain info`, `import`, `salvage` and `export`: logs, and the files of other programs."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from daq.cli.terminal import (
    WRITTEN,
    check_output,
    one_of,
    output_console,
    print_view,
    progress_bar,
    replace_output,
    say,
    status,
    write_new_folder,
)
from daq.cli.verb import JsonOption, output_option, print_json, read_calibration, read_cell
from daq.environment import require_packages, software
from daq.errors import ConfigurationInconsistent, DaqError, LogForeign, OutputFailed, UsageError, counted
from daq.files import replace_file
from daq.report.text import printable
from ident.errors import ModelContradicted
from ident.plausible import format_at_limit

if TYPE_CHECKING:
    from daq.config.cell import Cell
    from daq.workflow.urdf_export import JointUpdate, PhysicalRobot, Updated
    from ident.arrays import FloatArray
    from ident.calibration import Calibration
    from ident.model.model import Model

NewLogOption = Annotated[Path, output_option("--out", "Log to write (.mcap); must not exist.")]


def info(
    log: Annotated[Path, typer.Argument(help="A log (.mcap).")],
    extract_cell: Annotated[
        Path | None,
        output_option("--extract-cell", "New folder for the cell description in the log: cell file, URDF, drives."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Show what is in a log: role and payload, duration, losses, moves, validity.

    With --extract-cell also write the description of the cell as files that every verb takes as --cell.
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
    written = None if extract_cell is None else _extract_cell(log, extract_cell)
    if json:
        print_json(report)
    else:
        print_view(log_lines(json_tree(report), output_console().width), written)


def _extract_cell(log: Path, folder: Path) -> Path:
    """Write the cell description of a log into a new or empty folder, all files or none; return the cell file.

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
    description: Annotated[Path, typer.Argument(help="Import description (YAML): columns, units, rate.")],
    data: Annotated[Path, typer.Option("--data", help="Folder of the files.")],
    out: NewLogOption,
    cell: Annotated[Path | None, typer.Option("--cell", help="Another cell file than the description's.")] = None,
    holdout: Annotated[
        Path | None,
        output_option("--holdout", "Log to write of the part that `holdout` of the description names (.mcap)."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Convert CSV files, MATLAB files or ROS bags of another controller to a log, or to two, one held out."""
    from daq.log.importing import import_recording
    from daq.report.log import import_report, timing_text

    imported = import_recording(description, data, out, software=software(), cell_path=cell, holdout=holdout)
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
    say(f"{printable(str(out))}: {statistics.samples} samples, {saved.duration_s:g} s, PARTIAL{use}")
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
    parquet: Annotated[bool, typer.Option("--parquet", help="Apache Parquet, needs drivegain[parquet].")] = False,
    json: JsonOption = False,
) -> None:
    """Write the samples of a log into a table: a row per SYNC, joint positions and currents in SI beside raw numbers.

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
        Path | None, typer.Option(help="Calibration of the cell; its gains give the effort of the joint states.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Write a log as a ROS 2 bag: /joint_states, currents in A, events and /robot_description.

    Joint states are at the full rate, with the names of the URDF's joints; effort only with --calibration.
    """
    from daq.log.bag_writer import export_bag
    from daq.report.log import bag_report

    known = None if calibration is None else read_calibration(calibration)
    with status("writing the bag"):
        done = export_bag(log, out, known)
    _warn(log, done.partial, done.valid, done.reason)
    if json:
        print_json(bag_report(log, out, done, effort=known is not None))
    else:
        print_view([f"{topic}: {counted(count, 'message')}" for topic, count in done.messages.items()], out)


def export_urdf_verb(
    cell: Annotated[Path, typer.Argument(help="Cell file: URDF, gravity, drive train, limits; none with --urdf.")],
    out: Annotated[Path, output_option("--out", "URDF to write.")],
    calibration: Annotated[Path | None, typer.Argument(help="calibration.yaml written by `drivegain fit`.")] = None,
    urdf: Annotated[
        Path | None,
        typer.Option("--urdf", help="Instead of CELL, for a robot with a motor for each joint, base upright."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Write masses, centres of mass, inertias and joint friction into a copy of the robot's URDF.

    A URDF needs the bodies behind the identified parameter combinations. A semidefinite programme finds the nearest
    physical bodies (pip install 'drivegain[physical]'); the change of torque is reported. Serial robots only: closed
    chains are refused.
    """
    from daq.config.cell_file import URDF, bundle
    from daq.config.yaml_file import read_yaml_bytes
    from daq.report.urdf_views import urdf_report, urdf_view
    from daq.workflow.fit import DOUBTFUL_PERCENT
    from daq.workflow.urdf_export import FORMAT, cell_limits, parse_markup, physical_robot, update_urdf
    from daq.workflow.validate import on_cell

    if (calibration is None) == (urdf is None):
        raise UsageError(
            "export urdf",
            found="one file and no --urdf" if urdf is None else "a cell file and --urdf",
            expected="CELL CALIBRATION, or CALIBRATION --urdf FILE for a robot without a cell file",
            remedy="give the cell file, then the calibration; or leave the cell file out",
        )
    given = urdf or cell
    calibration = calibration or cell
    check_output(out, (calibration, given), FORMAT)
    known = read_calibration(calibration)
    left = known.relative_error_percent.total
    if not left <= DOUBTFUL_PERCENT:  # it explains too little of the torque to derive bodies from it
        raise ModelContradicted(
            str(calibration),
            found=f"a relative error of {format_at_limit(left, DOUBTFUL_PERCENT, 3, 'g')} %",
            expected=f"at most {DOUBTFUL_PERCENT:g} %",
            remedy="fit again; `drivegain fit` lists what to check",
        )
    content = bundle(given)[URDF] if urdf is None else read_yaml_bytes(given)
    if out.exists() and out.read_bytes() == content:
        raise UsageError(str(out), found="the input URDF", expected="a file of its own", remedy="choose another name")
    parse_markup(content, str(given))  # before any other reader sees it
    if urdf is None:
        declared = _declared(known, given)
        if declared.chain is not None:
            raise UsageError(
                f"cell {declared.name!r}",
                found="a closed chain: some of its joints have no motor",
                expected="a serial robot, each joint with a motor: for the links of a loop no masses are computed",
                remedy="no URDF is written; `drivegain validate`, `weigh` and `contact` predict with the calibration "
                "itself",
            )
        known, model = on_cell(known, declared)
        limits = cell_limits(declared)
        same = declared.digest == known.configuration_sha256
        content = declared.urdf.encode()  # held joints are fixed in it
    else:
        model, limits, same = *_plain(content.decode("utf-8")), None
    require_packages("physical parameters", "the semidefinite solver", "physical", "cvxpy", "clarabel")
    text = content.decode("utf-8")
    with status("finding the nearest physical robot"):
        robot = physical_robot(known, model, limits, text)
    updates = joint_updates(robot)
    provenance = f"Inertias by {software()} from the calibration of {known.cell}, {known.created}"
    updated = update_urdf(content, str(given), updates, provenance)
    _write(updated, robot, out)
    if json:
        print_json(urdf_report(known, robot, updates, updated, out, same))
    else:
        print_view(urdf_view(known, robot, updates, updated, same), out)


def joint_updates(robot: PhysicalRobot) -> dict[str, JointUpdate]:
    """Return body and friction of each moving joint; a negative friction, part of its axis' friction, counts as 0."""
    from daq.workflow.urdf_export import JointUpdate
    from ident.model.bodies import body_of

    parameters = robot.parameters
    values = dict(zip((column.name for column in parameters.model.columns), parameters.standard, strict=True))
    return {
        joint.name: JointUpdate(
            body_of(link), max(0.0, float(values[f"fv{number}"])), max(0.0, float(values[f"fs{number}"]))
        )
        for number, (joint, link) in enumerate(
            zip(parameters.model.robot.joints, parameters.links, strict=True), start=1
        )
    }


def _declared(calibration: Calibration, path: Path) -> Cell:
    from daq.config.same_cell import mismatch_of_calibration

    cell = read_cell(path)
    found = mismatch_of_calibration(calibration, cell)
    if found is not None:
        raise ConfigurationInconsistent(
            str(path), found=found.found, expected=found.expected, remedy="give the cell that was calibrated"
        )
    return cell


def _plain(urdf: str) -> tuple[Model, FloatArray]:
    """Return a model with a motor for each joint, and limits typical of arms."""
    import numpy as np

    from ident.model.model import DriveTrain, Model
    from ident.model.urdf import robot_from_urdf

    robot = robot_from_urdf(urdf)
    count = robot.joint_count
    return Model(robot, DriveTrain(np.eye(count))), np.repeat(np.array([[0.0], [np.pi], [3.0], [10.0]]), count, axis=1)


def _write(updated: Updated, robot: PhysicalRobot, out: Path) -> None:
    """Write the URDF whole or not at all, after reading it back as a robot with these links."""
    import numpy as np

    from ident.physical.physical import urdf_links

    def check(content: bytes) -> None:
        if not np.allclose(urdf_links(content.decode("utf-8")), robot.parameters.links, rtol=1e-9, atol=1e-12):
            raise OutputFailed(
                str(out),
                found="other inertias on reading back",
                expected="those that were written",
                remedy="nothing was written; please report this URDF",
            )

    with replace_output(out):
        replace_file(out, updated.content, check=check)
