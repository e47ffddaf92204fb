"""`drivegain export`: what a calibration or a log holds, in the files of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.table import Table

from daq.cli.terminal import check_output, say_written, status
from daq.cli.verb import JsonOption, Verb, VerbGroup, print_json, printable
from daq.config.cell import model_of
from daq.config.cell_file import URDF, bundle, load_cell
from daq.config.yaml_file import read_bytes
from daq.environment import software
from daq.errors import ConfigurationInconsistent, ModelContradicted, OutputFailed, UsageError
from daq.files import replace_file
from daq.log.export import TableFormat, export_log
from daq.workflow.calibration_file import load
from daq.workflow.fit import DOUBTFUL_PERCENT
from daq.workflow.urdf_export import (
    FORMAT,
    JointUpdate,
    PhysicalRobot,
    Updated,
    cell_limits,
    parse_markup,
    physical_robot,
    require_solver,
    update_urdf,
)
from ident.calibration import Calibration
from ident.model.bodies import body_of
from ident.model.model import DriveTrain, Model
from ident.model.robot import robot_from_urdf
from ident.physical.inertia_prior import urdf_links
from ident.physical.programme import MARGIN

# `drivegain export log`: a log as a table for other programs.


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


FloatArray = NDArray[np.float64]

_SHOWN_SHIFTS = 5


def export_verb() -> None:
    """Write what a calibration or a log holds into a file of another program."""


def export_urdf_verb(
    calibration: Annotated[Path, typer.Argument(help="calibration.yaml of `drivegain fit`.")],
    out: Annotated[Path, typer.Option("--out", help="URDF to write.")],
    cell: Annotated[Path | None, typer.Option("--cell", help="Cell file: URDF, gravity, drive train, limits.")] = None,
    urdf: Annotated[
        Path | None,
        typer.Option("--urdf", help="Instead of --cell, for a robot with a motor for each joint, base upright."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Write masses, centres of mass, inertias and joint friction into a copy of the robot's URDF.

    The identified parameters are combinations; a URDF needs bodies. The nearest bodies that can exist are found with a
    semidefinite programme (pip install 'drivegain[physical]'), and the change of torque is reported.
    """
    given = _one_of(cell, urdf)
    require_solver()
    check_output(out, (calibration, given), FORMAT)
    known = load(calibration)
    require_good(known, str(calibration))
    content = bundle(given)[URDF] if urdf is None else read_bytes(given)
    if out.exists() and out.read_bytes() == content:
        raise UsageError(str(out), found="the URDF to read", expected="a name of its own", remedy="choose another name")
    parse_markup(content, str(given))  # before any other reader sees it
    text = content.decode("utf-8")
    model, limits, same = _declared(known, given) if urdf is None else (*_plain(text), None)
    with status("looking for the nearest robot that can exist"):
        robot = physical_robot(known, model, limits, text)
    updates = joint_updates(robot)
    provenance = f"Inertias by {software()} from the calibration of {known.cell}, {known.created}"
    updated = update_urdf(content, str(given), updates, provenance)
    _write(updated, robot, out)
    if json:
        print_json(report(known, robot, updates, updated, out, same))
    else:
        show(known, robot, updates, updated, out, same, Console(soft_wrap=True, highlight=False))


def require_good(calibration: Calibration, name: str) -> None:
    """A model that leaves a quarter of the torque says nothing of bodies.

    Raises:
        ModelContradicted: the calibration's relative error is above DOUBTFUL_PERCENT.
    """
    left = calibration.relative_error_percent.total
    if not left <= DOUBTFUL_PERCENT:
        raise ModelContradicted(
            name,
            found=f"a relative error of {left:.3g} %",
            expected=f"at most {DOUBTFUL_PERCENT:g} %",
            remedy="fit again; `drivegain fit` says what to look for",
        )


def joint_updates(robot: PhysicalRobot) -> dict[str, JointUpdate]:
    """Body and friction of each moving joint; a friction that is only a part of its axis' and negative counts as 0."""
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


def report(
    calibration: Calibration,
    robot: PhysicalRobot,
    updates: dict[str, JointUpdate],
    updated: Updated,
    out: Path,
    same_configuration: bool | None,
) -> dict[str, Any]:
    """What was found and how near it is, for --json."""
    parameters = robot.parameters
    change = parameters.torque_change_percent
    joints = parameters.model.robot.joints
    return {
        "urdf": str(out),
        "calibration": calibration.cell,
        "same_configuration": same_configuration,
        "exact": parameters.exact,
        "torque_change_percent": {"axes": list(change.axes), "total": change.total},
        "shifts": [
            {
                "name": shift.name,
                "identified": shift.identified,
                "physical": shift.realised,
                "standard_deviations": shift.deviations,
            }
            for shift in robot.shifts
        ],
        "margin": MARGIN,
        "joints": [
            {
                "name": joint.name,
                "link": updated.links[joint.name],
                "mass_kg": update.body.mass_kg,
                "centre_m": update.body.centre_m.tolist(),
                "inertia_kg_m2": update.body.inertia_kg_m2.tolist(),
                "damping": update.damping,
                "friction": update.friction,
                "smallest_eigenvalue": float(eigenvalue),
                "prior_assumed": number in robot.prior.assumed,
            }
            for number, (joint, update, eigenvalue) in enumerate(
                zip(joints, updates.values(), parameters.eigenvalues, strict=True)
            )
        ],
        "merged_links": list(updated.merged),
        "not_in_urdf": [
            {"name": column.name, "value": float(value), "unit": column.unit}
            for column, value in zip(parameters.model.columns, parameters.standard, strict=True)
            if column.name.startswith(("Ia", "off", "fvm", "fsm"))
        ],
        "effects_left_out": [f"{effect.name} on {effect.axis}" for effect in calibration.effects],
    }


def show(
    calibration: Calibration,
    robot: PhysicalRobot,
    updates: dict[str, JointUpdate],
    updated: Updated,
    out: Path,
    same_configuration: bool | None,
    console: Console,
) -> None:
    """The same for a person."""
    console.print(link_table(updates, updated))
    change = robot.parameters.torque_change_percent
    if robot.parameters.exact:
        console.print("These bodies need exactly the identified torque.")
    else:
        axes = ", ".join(f"{value:.2f}" for value in change.axes)
        console.print(
            f"No robot has exactly the identified parameters; this one's torque differs by {change.total:.2g} % "
            f"(axes: {axes} %). Moved most: "
            + ", ".join(f"{shift.name} by {shift.deviations:.1f} σ" for shift in robot.shifts[:_SHOWN_SHIFTS])
            + "."
        )
    if robot.prior.assumed:
        names = ", ".join(robot.parameters.model.robot.joints[number].name for number in robot.prior.assumed)
        console.print(
            f"The URDF has no possible inertia behind {names}: where the data say nothing, a ball was assumed.",
            markup=False,
        )
    if updated.merged:
        console.print(
            f"Now part of the moving link that holds them: {printable(', '.join(updated.merged))}.", markup=False
        )
    left_out = ["rotor inertias", "offsets"]
    left_out += ["friction of coupled motors"] if robot.parameters.model.drive_train.coupled else []
    left_out += [f"{effect.name} on {effect.axis}" for effect in calibration.effects]
    console.print(f"A URDF has no place for: {printable(', '.join(left_out))} (see --json).", markup=False)
    if same_configuration is False:
        console.print("The cell's configuration has changed since the fit: look at what.", style="bold")
    say_written(console, out)


def link_table(updates: dict[str, JointUpdate], updated: Updated) -> Table:
    """Mass and centre of mass of each link, friction of its joint."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    table.add_column("joint", no_wrap=True)
    table.add_column("link", no_wrap=True)
    for heading in ("mass kg", "centre of mass m", "damping", "friction"):
        table.add_column(heading, justify="right", no_wrap=True)
    for name, update in updates.items():
        centre = " ".join(f"{value:+.3f}" for value in update.body.centre_m)
        table.add_row(
            printable(name),
            printable(updated.links[name]),
            f"{update.body.mass_kg:.3g}",
            centre,
            f"{update.damping:.3g}",
            f"{update.friction:.3g}",
        )
    return table


def _one_of(cell: Path | None, urdf: Path | None) -> Path:
    given = [path for path in (cell, urdf) if path is not None]
    if len(given) != 1:
        raise UsageError(
            "--cell, --urdf",
            found="both" if given else "neither",
            expected="one of them",
            remedy="give the cell file; --urdf is for a robot without one",
        )
    return given[0]


def _declared(calibration: Calibration, path: Path) -> tuple[Model, FloatArray, bool]:
    cell = load_cell(path)
    if cell.name != calibration.cell:
        raise ConfigurationInconsistent(
            str(path),
            found=f"cell {cell.name!r}",
            expected=f"cell {calibration.cell!r}, as in the calibration",
            remedy="give the cell that was calibrated",
        )
    return model_of(cell), cell_limits(cell), cell.digest == calibration.configuration_sha256


def _plain(urdf: str) -> tuple[Model, FloatArray]:
    """A motor for each joint, and ranges of the size that arms have."""
    robot = robot_from_urdf(urdf)
    count = robot.joint_count
    return Model(robot, DriveTrain(np.eye(count))), np.repeat(np.array([[0.0], [np.pi], [3.0], [10.0]]), count, axis=1)


def _write(updated: Updated, robot: PhysicalRobot, out: Path) -> None:
    """Whole or not at all, after the new file has been read as a robot with these links.

    Raises:
        OutputFailed: the file system refuses, or the file gives back other inertias.
    """

    def check(content: bytes) -> None:
        if not np.allclose(urdf_links(content.decode("utf-8")), robot.parameters.links, rtol=1e-9, atol=1e-12):
            raise OutputFailed(
                str(out),
                found="other inertias on reading back",
                expected="those that were written",
                remedy="nothing was written; please report this URDF",
            )

    try:
        replace_file(out, updated.content, check=check)
    except OSError as error:
        raise OutputFailed.of(out, error) from error


EXPORT_URDF = Verb(
    "urdf", export_urdf_verb, "drivegain export urdf calibration.yaml --cell cells/demo.yaml --out robot.urdf"
)
EXPORT = VerbGroup("export", export_verb, EXPORT_URDF.example, (EXPORT_URDF, EXPORT_LOG))
