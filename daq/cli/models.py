"""`drivegain export urdf` and `export mjcf`: a calibrated robot as the model of another program."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from daq.cli.terminal import check_output, print_view, replace_output, status
from daq.cli.verb import JsonOption, output_option, print_json, read_calibration, read_cell
from daq.environment import require_packages, software
from daq.errors import ConfigurationInconsistent, OutputFailed, UsageError
from daq.files import replace_file
from ident.errors import ModelContradicted
from ident.plausible import format_at_limit

if TYPE_CHECKING:
    from daq.config.cell import Cell
    from daq.workflow.full_choice import FullChoice
    from daq.workflow.mjcf_effects import LeftOutEffect
    from daq.workflow.urdf_export import JointUpdate, PhysicalRobot, Updated
    from ident.arrays import FloatArray
    from ident.calibration import Calibration
    from ident.model.model import Model


CellUnlessUrdf = Annotated[
    Path, typer.Argument(help="Cell file: URDF, gravity, drive train, limits; none with --urdf.")
]
CalibrationToExport = Annotated[
    Path | None, typer.Argument(help="calibration.yaml written by `drivegain fit`.")
]
UrdfOption = Annotated[
    Path | None,
    typer.Option(
        "--urdf", help="Instead of CELL, for a robot with a motor for each joint, base upright."
    ),
]


def export_urdf_verb(
    cell: CellUnlessUrdf,
    out: Annotated[Path, output_option("--out", "URDF to write.")],
    calibration: CalibrationToExport = None,
    urdf: UrdfOption = None,
    json: JsonOption = False,
) -> None:
    """Write masses, centres of mass, inertias and joint friction into a copy of the robot's URDF.

    Bodies are the full parameters of `fit --prior`; without them, a semidefinite programme finds
    the nearest physical bodies to the URDF (pip install 'drivegain[physical]'). The change of
    torque is reported. A URDF holds no loops: of a closed chain it has the tree, and the closures
    are named.
    """
    from daq.config.cell_file import URDF, bundle
    from daq.config.yaml_file import read_yaml_bytes
    from daq.report.chosen_parameters import choice_remarks
    from daq.report.text import origin_text
    from daq.report.urdf_views import urdf_report, urdf_view
    from daq.workflow.urdf_export import FORMAT, parse_markup, update_urdf

    given, known = _inputs("export urdf", FORMAT, out, cell, calibration, urdf)
    if urdf is None:
        content = bundle(given)[URDF]
    else:
        content = read_yaml_bytes(given)
    if out.exists() and out.read_bytes() == content:
        raise UsageError(
            str(out),
            found="the input URDF",
            expected="a file of its own",
            remedy="choose another name",
        )
    parse_markup(content, str(given))  # before any other reader sees it
    if urdf is None:
        described = _of_cell(known, given)
    else:
        described = _of_urdf(known, given)
    known = described.calibration
    choice = _choose(described)
    updates = joint_updates(choice.robot)
    remarks = (
        f"Inertias by {software()} from {origin_text(known.cell, known.created)}",
        *choice_remarks(choice),
    )
    # Held joints are fixed in the URDF that was described.
    updated = update_urdf(described.urdf.encode(), str(given), updates, ". ".join(remarks))
    _write(updated, choice.robot, out)
    missing = [str(effect) for effect in described.missing]
    if json:
        print_json(urdf_report(known, choice, updates, updated, out, described.same, missing))
    else:
        print_view(urdf_view(known, choice, updates, updated, described.same, missing), out)


def export_mjcf_verb(
    cell: CellUnlessUrdf,
    out: Annotated[Path, output_option("--out", "MJCF model to write (.xml).")],
    calibration: CalibrationToExport = None,
    urdf: UrdfOption = None,
    json: JsonOption = False,
) -> None:
    """Write the calibrated robot as an MJCF model for MuJoCo 3.3.1 or later.

    Masses, inertias, rotors, friction, and a motor for each axis: its gear is the drive gain, its
    input the current reference. Names, frames, shapes and meshes are those of the URDF. Bodies are
    the full parameters of `fit --prior`; without them, the nearest physical bodies to the URDF (pip
    install 'drivegain[physical]'). What the model cannot hold is listed in it and under --json.
    """
    from daq.report.mjcf_views import head_remarks, mjcf_report, mjcf_view
    from daq.workflow.mjcf_effects import joint_effects
    from daq.workflow.mjcf_export import FORMAT, MjcfSource, write_mjcf
    from daq.workflow.urdf_export import random_states
    from daq.workflow.urdf_shapes import shapes_of
    from ident.model.urdf import read_urdf

    given, known = _inputs("export mjcf", FORMAT, out, cell, calibration, urdf)
    if urdf is None:
        described = _of_cell(known, given)
    else:
        described = _of_urdf(known, given)
    known = described.calibration
    choice = _choose(described)
    followed = choice.model.follow(random_states(choice.model, described.limits))
    shapes = shapes_of(described.urdf, described.folder)
    effects = joint_effects(known, choice.model.robot)
    effects = replace(effects, left_out=(*effects.left_out, *described.missing))
    source = MjcfSource(
        name=known.cell,
        model=choice.model,
        standard=choice.standard,
        gains=known.gains,
        frames=read_urdf(described.urdf).links,
        lower=described.lower,
        upper=described.upper,
        shapes=shapes,
        folder=out.parent,
        effects=effects,
        remarks=tuple(head_remarks(known, choice, effects, shapes, software())),
    )
    written = write_mjcf(source, followed.joints.position_rad)
    with replace_output(out):
        replace_file(out, written.content)
    report = mjcf_report(known, choice, source, written, out, described.same)
    if json:
        print_json(report)
    else:
        print_view(mjcf_view(report), out)


@dataclass(frozen=True, eq=False)
class _Described:
    """A robot that a model is written of."""

    #: without effects that are not installed, with the corrections that the cell still needs
    calibration: Calibration
    missing: tuple[LeftOutEffect, ...]  #: effects that are not installed
    model: Model
    limits: FloatArray  #: ranges in which torques are compared, shape (4, m)
    lower: FloatArray  #: least position of each axis, -inf without a limit, shape (m,)
    upper: FloatArray
    urdf: str
    folder: Path  #: of the URDF, from where its meshes are found
    same: bool | None  #: whether the description is that of the fit; None where nothing says so


def _of_cell(calibration: Calibration, path: Path) -> _Described:
    """The robot of a cell file."""
    from daq.config.cell_file import urdf_path
    from daq.workflow.mjcf_effects import split_installed
    from daq.workflow.urdf_export import cell_limits
    from daq.workflow.validate import on_cell

    cell = _declared(calibration, path)
    same = _is_same(calibration, cell)
    installed, missing = split_installed(calibration)
    known, model = on_cell(installed, cell)
    limits = cell_limits(cell)
    return _Described(
        calibration=known,
        missing=missing,
        model=model,
        limits=limits,
        lower=limits[0] - limits[1],
        upper=limits[0] + limits[1],
        urdf=cell.urdf,
        folder=urdf_path(path).parent,
        same=same,
    )


def _of_urdf(calibration: Calibration, path: Path) -> _Described:
    """The robot of a URDF alone, with a motor for each joint."""
    import numpy as np

    from daq.config.yaml_file import read_yaml_bytes
    from daq.workflow.mjcf_effects import split_installed
    from daq.workflow.urdf_export import parse_markup
    from daq.workflow.urdf_shapes import joint_ranges

    content = read_yaml_bytes(path)
    parse_markup(content, str(path))  # before any other reader sees it
    urdf = content.decode("utf-8")
    model, limits = _plain(urdf)
    joints = [joint.name for joint in model.robot.joints]
    if len(joints) != len(calibration.gains):
        raise ConfigurationInconsistent(
            str(path),
            found=f"{len(joints)} moving joints: {', '.join(joints)}",
            expected=f"{len(calibration.gains)}, one for each axis of the calibration",
            remedy="give the URDF of the robot that was calibrated, or its cell file, which says "
            "what moves its joints",
        )
    installed, missing = split_installed(calibration)
    ranges = joint_ranges(urdf)
    bounds = np.array([ranges[name] for name in joints])
    return _Described(
        calibration=installed,
        missing=missing,
        model=model,
        limits=limits,
        lower=bounds[:, 0],
        upper=bounds[:, 1],
        urdf=urdf,
        folder=path.parent,
        same=None,
    )


def _choose(described: _Described) -> FullChoice:
    """Choose the full parameters of a robot: the same for every kind of model.

    Raises:
        ModelError: the calibration is of another robot.
        NotPhysical: no possible robot was found.
        ConfigurationMissing: the bodies have to be found, and the solver is not installed.
    """
    from daq.workflow.full_choice import full_choice

    known = described.calibration
    if known.full_parameters is None:
        require_packages(
            "physical parameters", "the semidefinite solver", "physical", "cvxpy", "clarabel"
        )
    missing = [effect.accepted for effect in described.missing]
    with status("choosing the bodies"):
        return full_choice(known, described.model, described.limits, described.urdf, missing)


def _inputs(
    verb: str, format_: str, out: Path, cell: Path, calibration: Path | None, urdf: Path | None
) -> tuple[Path, Calibration]:
    """Return the file that describes the robot, and the calibration:
    of CELL CALIBRATION or CALIBRATION --urdf FILE.
    """
    if (calibration is None) == (urdf is None):
        raise UsageError(
            verb,
            found="one file and no --urdf" if urdf is None else "a cell file and --urdf",
            expected="CELL CALIBRATION, or CALIBRATION --urdf FILE for a robot without a cell file",
            remedy="give the cell file, then the calibration; or leave the cell file out",
        )
    given = urdf or cell
    calibration_file = calibration or cell
    check_output(out, (calibration_file, given), format_)
    known = read_calibration(calibration_file)
    _require_explained(known, calibration_file)
    return given, known


def joint_updates(robot: PhysicalRobot) -> dict[str, JointUpdate]:
    """Return body and friction of each moving joint;
    a negative friction, part of its axis' friction, counts as 0.
    """
    from daq.workflow.urdf_export import JointUpdate
    from ident.model.bodies import body_of

    parameters = robot.parameters
    names = [column.name for column in parameters.model.columns]
    values = dict(zip(names, parameters.standard, strict=True))
    joints_and_links = zip(parameters.model.robot.joints, parameters.links, strict=True)
    updates = {}
    for number, (joint, link) in enumerate(joints_and_links, start=1):
        viscous = float(values[f"fv{number}"])
        coulomb = float(values[f"fs{number}"])
        updates[joint.name] = JointUpdate(body_of(link), max(0.0, viscous), max(0.0, coulomb))
    return updates


def _is_same(calibration: Calibration, cell: Cell) -> bool | None:
    """Whether a cell file is that of the fit;
    None where the calibration does not name one, as of a library.
    """
    if not calibration.configuration_sha256:
        return None
    return cell.digest == calibration.configuration_sha256


def _require_explained(calibration: Calibration, path: Path) -> None:
    """Refuse a calibration that explains too little of the torque to derive bodies from it."""
    from daq.workflow.fit import DOUBTFUL_PERCENT

    left = calibration.relative_error_percent.total
    if not left <= DOUBTFUL_PERCENT:
        raise ModelContradicted(
            str(path),
            found=f"a relative error of {format_at_limit(left, DOUBTFUL_PERCENT, 3, 'g')} %",
            expected=f"at most {DOUBTFUL_PERCENT:g} %",
            remedy="fit again; `drivegain fit` lists what to check",
        )


def _declared(calibration: Calibration, path: Path) -> Cell:
    from daq.config.same_cell import require_cell_of

    cell = read_cell(path)
    require_cell_of(
        calibration,
        cell,
        ConfigurationInconsistent,
        str(path),
        remedy="give the cell that was calibrated",
    )
    return cell


def _plain(urdf: str) -> tuple[Model, FloatArray]:
    """Return a model with a motor for each joint, and limits typical of arms."""
    import numpy as np

    from ident.model.model import DriveTrain, Model
    from ident.model.urdf import robot_from_urdf

    robot = robot_from_urdf(urdf)
    count = robot.joint_count
    model = Model(robot, DriveTrain(np.eye(count)))
    limits_of_a_joint = np.array([[0.0], [np.pi], [3.0], [10.0]])
    limits = np.repeat(limits_of_a_joint, count, axis=1)
    return model, limits


def _write(updated: Updated, robot: PhysicalRobot, out: Path) -> None:
    """Write the URDF whole or not at all, after reading it back as a robot with these links."""
    import numpy as np

    from ident.physical.physical import urdf_links

    def check(content: bytes) -> None:
        links = urdf_links(content.decode("utf-8"))
        if not np.allclose(links, robot.parameters.links, rtol=1e-9, atol=1e-12):
            raise OutputFailed(
                str(out),
                found="other inertias on reading back",
                expected="those that were written",
                remedy="nothing was written; please report this URDF",
            )

    with replace_output(out):
        replace_file(out, updated.content, check=check)
