"""The bodies that `drivegain export urdf` writes,
and how far their torque is from the identified one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.console import RenderableType
from rich.text import Text

from daq.report.chosen_parameters import ChosenParameter, chosen_parameters, names_by_prior
from daq.report.document import Figure, Report
from daq.report.fit import Errors
from daq.report.text import plain_table, printable, terminal_text
from daq.workflow.full_choice import ChosenBy, FullChoice
from daq.workflow.urdf_export import JointUpdate, Updated
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
    """of its pseudo-inertia, as a share of its prior's"""
    prior_assumed: bool
    """whether the URDF had no possible inertia, and a ball was assumed"""


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
    chosen_by: str
    """where the bodies come from"""
    exact: bool
    torque_change_percent: Errors
    shifts: list[ShiftedParameter]
    margin: float
    """least `smallest_eigenvalue` that is allowed"""
    joints: list[UrdfJoint]
    parameters: list[ChosenParameter]
    merged_links: list[str]
    not_in_urdf: list[NotInUrdf]
    effects_left_out: list[str]
    """all effects of the calibration: the torque of the URDF is without them, and its joints are as
    described also where the calibration corrects the description"""
    closures_left_out: list[str]


def urdf_view(
    calibration: Calibration,
    choice: FullChoice,
    updates: dict[str, JointUpdate],
    updated: Updated,
    same_configuration: bool | None,
    missing: Sequence[str] = (),
) -> Iterator[RenderableType]:
    """Bodies by link, the change of torque, and the identified parameters that a URDF cannot hold.

    Args:
        calibration: that was exported, without the effects that are not installed.
        choice: its full parameters.
        updates: body and friction of each joint, by its name.
        updated: the URDF that was written.
        same_configuration: whether the cell file is that of the fit; None without a cell file.
        missing: effects of the calibration that are not installed.
    """
    model = choice.model
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
    yield from _choice_lines(choice)
    if updated.merged:
        yield printable(
            f"Merged into the moving link that carries them: {', '.join(updated.merged)}."
        )
    left_out = ["rotor inertias", "offsets"]
    if model.drive_train.coupled:
        left_out.append("friction of coupled motors")
    corrected: list[str] = []
    for effect in calibration.effects:
        name = f"{effect.name} on {effect.axis}"
        if effect.name not in CORRECTIONS:
            left_out.append(name)
        # A correction of zero is in the cell file since the fit.
        elif any(coefficient.value != 0.0 for coefficient in effect.coefficients):
            corrected.append(name)
    left_out += missing
    left_out += [f"closure {closure.name}" for closure in model.robot.closures]
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


def _choice_lines(choice: FullChoice) -> Iterator[RenderableType]:
    """Say how far the torque of the bodies is from the identified one, where they come from,
    and what rests on the prior or was assumed.
    """
    if choice.exact:
        yield "The torque of these bodies is exactly the identified one."
    else:
        change = choice.torque_change_percent
        axes = ", ".join(f"{value:.2f}" for value in change.axes)
        shown = choice.robot.shifts[:_SHOWN_SHIFTS]
        shifts = ", ".join(f"{shift.name} by {shift.deviations:.1f} σ" for shift in shown)
        if choice.chosen_by is ChosenBy.NEAREST_BODIES:
            subject = (
                "No physical robot has exactly the identified parameters; the torque of this one"
            )
        else:
            subject = "The torque of these bodies"
        yield (
            f"{subject} differs by {change.total:.2g} % (axes: {axes} %). Largest shifts: {shifts}."
        )
    parameters = list(chosen_parameters(choice))
    by_prior = names_by_prior(choice)
    yield printable(
        f"Bodies: {choice.chosen_by.value}. {len(by_prior)} of {len(parameters)} parameters rest "
        "on the prior."
    )
    if choice.assumed:
        yield printable(
            f"The URDF has no possible inertia behind {', '.join(choice.assumed)}; a ball was "
            "assumed where the data have none."
        )


def urdf_report(
    calibration: Calibration,
    choice: FullChoice,
    updates: dict[str, JointUpdate],
    updated: Updated,
    out: Path,
    same_configuration: bool | None,
    missing: Sequence[str] = (),
) -> UrdfReport:
    """Return the bodies of a URDF that was written, and what it does not hold of the calibration.

    Args:
        calibration, choice, updates, updated, same_configuration, missing: as in `urdf_view`.
        out: the URDF.
    """
    shifts = []
    for shift in choice.robot.shifts:
        shifted = ShiftedParameter.of(
            shift, physical=shift.realised, standard_deviations=shift.deviations
        )
        shifts.append(shifted)
    joints = []
    for number, (name, update) in enumerate(updates.items()):
        joints.append(_joint(choice, number, name, update, updated))
    not_in_urdf = []
    for column, value in zip(choice.model.columns, choice.standard, strict=True):
        if _is_of_motor(column.name):
            not_in_urdf.append(NotInUrdf.of(column, value=value))
    effects = [f"{effect.name} on {effect.axis}" for effect in calibration.effects]
    effects += missing
    closures = [closure.name for closure in choice.model.robot.closures]
    return UrdfReport.of(
        choice.robot.parameters,
        urdf=out,
        calibration=calibration.cell or None,
        same_configuration=same_configuration,
        chosen_by=choice.chosen_by.value,
        shifts=shifts,
        margin=MARGIN,
        joints=joints,
        parameters=list(chosen_parameters(choice)),
        merged_links=updated.merged,
        not_in_urdf=not_in_urdf,
        effects_left_out=effects,
        closures_left_out=closures,
    )


def _is_of_motor(name: str) -> bool:
    """Whether a parameter is of a motor, which a URDF has no place for: inertia of a rotor (Ia and
    Iam), offset (off), or friction of a motor that turns with several joints (fvm, fsm).

    What a payload adds to friction (LOADED) is no part of the robot without one, which a URDF
    describes: it is not listed as left out either.
    """
    return name.startswith(("Ia", "off", "fvm", "fsm")) and not name.endswith(LOADED)


def _joint(
    choice: FullChoice, number: int, name: str, update: JointUpdate, updated: Updated
) -> UrdfJoint:
    """Return a joint, whose number is its place among the robot's joints."""
    return UrdfJoint.of(
        update,
        update.body,
        name=name,
        link=updated.links[name],
        smallest_eigenvalue=choice.robot.parameters.eigenvalues[number],
        prior_assumed=name in choice.assumed,
    )
