"""The bodies that `drivegain export urdf` writes,
and how far their torque is from the identified one.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from rich.console import RenderableType
from rich.text import Text

from daq.report.document import Figure, Report
from daq.report.fit import Errors
from daq.report.text import plain_table, printable, terminal_text
from daq.workflow.urdf_export import JointUpdate, PhysicalRobot, Updated
from daq.workflow.validate import CORRECTIONS
from ident.calibration import Calibration
from ident.model.bodies import LOADED
from ident.physical.consistency import MARGIN

_SHOWN_SHIFTS = 5


class ShiftedParameter(Report):
    """Identified parameter, and the nearest one of a physical robot."""

    name: str
    identified: float
    physical: float
    standard_deviations: Figure


class UrdfJoint(Report):
    """Body and friction of one moving joint."""

    name: str
    link: str
    mass_kg: float
    centre_m: list[float]
    inertia_kg_m2: list[list[float]]
    damping: float
    friction: float
    smallest_eigenvalue: float
    prior_assumed: bool


class NotInUrdf(Report):
    """Parameter that a URDF cannot hold."""

    name: str
    value: float
    unit: str


class UrdfReport(Report):
    """`export urdf`."""

    urdf: str
    calibration: str | None
    """name of its cell; None without one"""
    same_configuration: bool | None
    exact: bool
    torque_change_percent: Errors
    shifts: list[ShiftedParameter]
    margin: float
    joints: list[UrdfJoint]
    merged_links: list[str]
    not_in_urdf: list[NotInUrdf]
    effects_left_out: list[str]
    closures_left_out: list[str]


def urdf_view(
    calibration: Calibration,
    robot: PhysicalRobot,
    updates: dict[str, JointUpdate],
    updated: Updated,
    same_configuration: bool | None,
) -> Iterator[RenderableType]:
    """Bodies by link, the change of torque, and the identified parameters that a URDF cannot hold.

    `same_configuration` says whether the cell file is that of the fit; None without a cell file.
    """
    table = plain_table(
        ("joint", "link", "mass kg", "centre of mass m", "damping", "friction"), left=(0, 1)
    )
    for name, update in updates.items():
        centre = " ".join(f"{value:+.3f}" for value in update.body.centre_m)
        table.add_row(
            terminal_text(name),
            terminal_text(updated.links[name]),
            f"{update.body.mass_kg:.3g}",
            centre,
            f"{update.damping:.3g}",
            f"{update.friction:.3g}",
        )
    yield table
    if robot.parameters.exact:
        yield "The torque of these bodies is exactly the identified one."
    else:
        change = robot.parameters.torque_change_percent
        axes = ", ".join(f"{value:.2f}" for value in change.axes)
        shown = robot.shifts[:_SHOWN_SHIFTS]
        shifts = ", ".join(f"{shift.name} by {shift.deviations:.1f} σ" for shift in shown)
        yield (
            "No physical robot has exactly the identified parameters; the torque of this one "
            f"differs by {change.total:.2g} % (axes: {axes} %). Largest shifts: {shifts}."
        )
    if robot.prior.assumed:
        joints = robot.parameters.model.robot.joints
        names = ", ".join(joints[number].name for number in robot.prior.assumed)
        yield printable(
            f"The URDF has no possible inertia behind {names}; a ball was assumed where the data "
            "have none."
        )
    if updated.merged:
        yield printable(
            f"Merged into the moving link that carries them: {', '.join(updated.merged)}."
        )
    left_out = ["rotor inertias", "offsets"]
    if robot.parameters.model.drive_train.coupled:
        left_out.append("friction of coupled motors")
    corrected: list[str] = []
    for effect in calibration.effects:
        name = f"{effect.name} on {effect.axis}"
        if effect.name not in CORRECTIONS:
            left_out.append(name)
        elif any(one.value != 0.0 for one in effect.coefficients):
            corrected.append(name)
    left_out += [f"closure {closure.name}" for closure in robot.parameters.model.robot.closures]
    yield printable(f"A URDF cannot hold: {', '.join(left_out)} (see --json).")
    if corrected:
        text = (
            "CHECK the description: the bodies are those of the robot as corrected by "
            f"{', '.join(corrected)}, and the joints of this URDF are as they were described. "
            "Correct the cell file, fit the logs again, then export."
        )
        yield Text(printable(text), style="bold")
    if same_configuration is False:
        yield Text(
            "The cell's configuration has changed since the fit; check the difference.",
            style="bold",
        )


def urdf_report(
    calibration: Calibration,
    robot: PhysicalRobot,
    updates: dict[str, JointUpdate],
    updated: Updated,
    out: Path,
    same_configuration: bool | None,
) -> UrdfReport:
    """Return the bodies of a URDF that was written, and what it does not hold of the calibration.

    Args:
        calibration, robot, updates, updated, same_configuration: as in `urdf_view`.
        out: the URDF.
    """
    parameters = robot.parameters
    shifts = [
        ShiftedParameter.of(shift, physical=shift.realised, standard_deviations=shift.deviations)
        for shift in robot.shifts
    ]
    joints = []
    for number, update in enumerate(updates.values()):
        joints.append(_joint(robot, number, update, updated))
    columns = zip(parameters.model.columns, parameters.standard, strict=True)
    not_in_urdf = [
        NotInUrdf.of(column, value=value) for column, value in columns if _is_of_motor(column.name)
    ]
    effects = [f"{effect.name} on {effect.axis}" for effect in calibration.effects]
    closures = [closure.name for closure in parameters.model.robot.closures]
    return UrdfReport.of(
        parameters,
        urdf=out,
        calibration=calibration.cell or None,
        same_configuration=same_configuration,
        shifts=shifts,
        margin=MARGIN,
        joints=joints,
        merged_links=updated.merged,
        not_in_urdf=not_in_urdf,
        effects_left_out=effects,
        closures_left_out=closures,
    )


def _is_of_motor(name: str) -> bool:
    """Whether a parameter is of a motor, which a URDF has no place for."""
    return name.startswith(("Ia", "off", "fvm", "fsm")) and not name.endswith(LOADED)


def _joint(robot: PhysicalRobot, number: int, update: JointUpdate, updated: Updated) -> UrdfJoint:
    name = robot.parameters.model.robot.joints[number].name
    return UrdfJoint.of(
        update,
        update.body,
        name=name,
        link=updated.links[name],
        smallest_eigenvalue=robot.parameters.eigenvalues[number],
        prior_assumed=number in robot.prior.assumed,
    )
