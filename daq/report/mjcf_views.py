"""The model that `drivegain export mjcf` writes, what its numbers rest on,
and what it does not hold.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from rich.console import RenderableType
from rich.text import Text

from daq.report.chosen_parameters import ChosenParameter, choice_remarks, chosen_parameters
from daq.report.document import Report
from daq.report.fit import Errors
from daq.report.text import origin_text, plain_table, printable, terminal_text
from daq.workflow.full_choice import FullChoice
from daq.workflow.mjcf_effects import JointEffects
from daq.workflow.mjcf_export import Mjcf, MjcfSource, joint_drive
from daq.workflow.urdf_shapes import UrdfShapes
from ident.calibration import AcceptedEffect, Calibration
from ident.model.bodies import body_of
from ident.physical.drive_terms import drive_terms
from ident.physical.full_parameters import RestsOn


class MjcfJoint(Report):
    """Body and joint."""

    name: str
    mass_kg: float
    centre_m: list[float]
    inertia_kg_m2: list[list[float]]
    armature: float
    damping: float
    friction: float
    stiffness: float
    """of a spring, with its rest position; 0 without one"""
    spring_rest: float


class MjcfActuator(Report):
    """Motor of an axis."""

    axis: str
    acts_on: str
    """`joint NAME`, or `tendon NAME` of a motor that turns with several joints"""
    gear: float
    """drive gain; its input is the current reference"""
    unit: str
    """of the gear"""
    armature: float
    """of the tendon, besides those of the joints"""
    damping: float
    friction: float


class NotInMjcf(Report):
    """Standard parameter, or the part of it, that the model lacks:
    the torque of its column times this is missing.
    """

    name: str
    value: float
    unit: str


class EffectCoefficient(Report):
    """One coefficient of an effect."""

    name: str
    value: float
    unit: str


class EffectNotInMjcf(Report):
    """Effect of the calibration that the model lacks, with its numbers."""

    name: str
    axis: str
    package: str | None
    """package that has it; null of one that drivegain ships"""
    settings: dict[str, float]
    coefficients: list[EffectCoefficient]


class MjcfReport(Report):
    """`export mjcf`."""

    mjcf: str
    calibration: str | None
    """name of its cell; None without one"""
    same_configuration: bool | None
    """whether the cell file is that of the fit; None where the calibration does not name one"""
    chosen_by: str
    """where the bodies come from"""
    exact: bool
    """the torque of the bodies is that of the identified base parameters"""
    torque_change_percent: Errors
    assumed_links: list[str]
    """joints with links for which a ball was the prior, because the URDF has no possible inertia"""
    joints: list[MjcfJoint]
    actuators: list[MjcfActuator]
    parameters: list[ChosenParameter]
    not_in_mjcf: list[NotInMjcf]
    effects_at_joints: list[str]
    """effects that are in stiffness, damping and friction of their joint"""
    effects_left_out: list[str]
    effects_not_in_mjcf: list[EffectNotInMjcf]
    """the effects that are left out, with their settings and coefficients"""
    corrections_applied: list[str]
    """effects that correct the description:
    the joint frames or the gravity of the model are the corrected ones
    """
    mountings_left_out: list[str]
    """payloads that the calibration knows; the model is of the robot without one"""
    closures_left_out: list[str]
    """loops that no constraint of MuJoCo closes"""
    meshes: list[str]
    """files of meshes that the model names; they stay where they are"""
    shapes_left_out: list[str]
    """shapes of the URDF's links that the model lacks, each with its reason"""


def head_remarks(
    calibration: Calibration,
    choice: FullChoice,
    effects: JointEffects,
    shapes: UrdfShapes,
    software: str,
) -> Iterator[str]:
    """Lines for the head of the model.

    Args:
        calibration: that is exported.
        choice: its full parameters.
        effects: of it.
        shapes: of the robot's URDF.
        software: name and version.
    """
    yield (
        f"By {software} from {origin_text(calibration.cell, calibration.created)}. MuJoCo 3.3.1 "
        "or later."
    )
    yield from choice_remarks(choice)
    if effects.left_out:
        yield f"Effects NOT in this model: {', '.join(map(str, effects.left_out))}"
        for effect in effects.left_out:
            yield _effect_line(effect.accepted)
        yield "Minus their torque at the joints, coefficients times columns, goes to qfrc_applied"
    mountings = _mountings(calibration)
    if mountings:
        yield f"Payloads NOT in this model: {', '.join(mountings)}"
    if shapes.left_out:
        yield f"Shapes NOT in this model: {'; '.join(shapes.left_out)}"


def mjcf_report(
    calibration: Calibration,
    choice: FullChoice,
    source: MjcfSource,
    written: Mjcf,
    out: Path,
    same_configuration: bool | None,
) -> MjcfReport:
    """Return what a model that was written holds of a calibration, and what not.

    Args:
        calibration: that was exported.
        choice: its full parameters.
        source: what the model was written from.
        written: the model.
        out: its file.
        same_configuration: whether the cell file is that of the fit; None where the calibration
            does not name one.
    """
    return MjcfReport.of(
        choice,
        mjcf=out,
        calibration=calibration.cell or None,
        same_configuration=same_configuration,
        chosen_by=choice.chosen_by.value,
        assumed_links=choice.assumed,
        joints=list(_joints(source)),
        actuators=list(_actuators(source, written)),
        parameters=list(chosen_parameters(choice)),
        not_in_mjcf=[NotInMjcf.of(left) for left in written.left_over],
        effects_at_joints=source.effects.at_joints,
        effects_left_out=[str(effect) for effect in source.effects.left_out],
        effects_not_in_mjcf=[_effect_entry(effect.accepted) for effect in source.effects.left_out],
        corrections_applied=source.effects.in_geometry,
        mountings_left_out=_mountings(calibration),
        closures_left_out=written.open_closures,
        meshes=sorted({str(shape.mesh) for shape in source.shapes.found if shape.mesh is not None}),
        shapes_left_out=source.shapes.left_out,
    )


def _effect_line(effect: AcceptedEffect) -> str:
    numbers = [f"{name} = {value:g}" for name, value in effect.settings.items()]
    numbers += [f"{one.name} = {one.value:.6g} {one.unit}" for one in effect.coefficients]
    return f"{effect.name} on {effect.axis}: {', '.join(numbers)}"


def _effect_entry(effect: AcceptedEffect) -> EffectNotInMjcf:
    coefficients = [EffectCoefficient.of(one) for one in effect.coefficients]
    return EffectNotInMjcf.of(effect, coefficients=coefficients)


def mjcf_view(report: MjcfReport) -> Iterator[RenderableType]:
    """Bodies by joint, actuators, what the bodies rest on, and what the model lacks."""
    bodies = plain_table(
        ("joint", "mass kg", "centre of mass m", "armature", "damping", "friction"), left=(0,)
    )
    for joint in report.joints:
        bodies.add_row(
            terminal_text(joint.name),
            f"{joint.mass_kg:.3g}",
            " ".join(f"{value:+.3f}" for value in joint.centre_m),
            f"{joint.armature:.3g}",
            f"{joint.damping:.3g}",
            f"{joint.friction:.3g}",
        )
    yield bodies
    actuators = plain_table(("actuator", "acts on", "gear", "unit"), left=(0, 1, 3))
    for actuator in report.actuators:
        actuators.add_row(
            terminal_text(actuator.axis),
            terminal_text(actuator.acts_on),
            f"{actuator.gear:.5g}",
            actuator.unit,
        )
    yield actuators
    change = report.torque_change_percent.total
    if report.exact:
        yield "The torque of these bodies is exactly the identified one."
    elif change is None:
        yield "The calibration has no torque: all its parameters are zero."
    else:
        yield f"The torque of these bodies differs from the identified one by {change:.2g} %."
    by_prior = [
        parameter.name for parameter in report.parameters if parameter.basis == RestsOn.PRIOR.value
    ]
    yield printable(
        f"Bodies: {report.chosen_by}. {len(by_prior)} of {len(report.parameters)} "
        "parameters rest on it."
    )
    if report.assumed_links:
        names = ", ".join(report.assumed_links)
        yield printable(f"The URDF has no possible inertia behind {names}; a ball was assumed.")
    left_out = [f"{left.name} {left.value:+.3g} {left.unit}" for left in report.not_in_mjcf]
    left_out += report.effects_left_out
    left_out += [f"payload on {mounting}" for mounting in report.mountings_left_out]
    left_out += [f"closure {name}" for name in report.closures_left_out]
    if left_out:
        yield printable(f"Not in the model: {', '.join(left_out)}.")
    if report.shapes_left_out:
        yield printable(f"Shapes that are not in the model: {'; '.join(report.shapes_left_out)}.")
    if report.same_configuration is False:
        yield Text(
            "The cell's configuration has changed since the fit; check the difference.",
            style="bold",
        )


def _joints(source: MjcfSource) -> Iterator[MjcfJoint]:
    model = source.model
    terms = drive_terms(model, source.standard)
    for index, columns in enumerate(model.link_columns):
        joint = model.robot.joints[index]
        drive = joint_drive(source, terms, index)
        yield MjcfJoint.of(
            body_of(source.standard[columns]),
            name=joint.name,
            armature=drive["armature"],
            damping=drive["damping"],
            friction=drive["frictionloss"],
            stiffness=drive.get("stiffness", 0.0),
            spring_rest=drive.get("springref", 0.0),
        )


def _actuators(source: MjcfSource, written: Mjcf) -> Iterator[MjcfActuator]:
    terms = drive_terms(source.model, source.standard)
    for axis, gain in enumerate(source.gains):
        yield MjcfActuator.of(
            gain,
            acts_on=written.actuators[axis],
            gear=gain.value,
            armature=float(terms.inertia.of_motors[axis]),
            damping=float(terms.damping.of_motors[axis]),
            friction=float(terms.dry_friction.of_motors[axis]),
        )


def _mountings(calibration: Calibration) -> list[str]:
    split = (parameter.name.partition(":") for parameter in calibration.parameters)
    return list(dict.fromkeys(mounting for _, colon, mounting in split if colon))
