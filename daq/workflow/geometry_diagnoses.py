"""The geometry of a cell whose robot has more encoders than degrees of freedom:
what is said of it, and what is kept.

`ident.estimators.geometry_estimate` finds which numbers of the description the encoders contradict.
`fit` names them and keeps to the description; `residual` identifies with the corrected numbers, and
a calibration says which they are, so that `validate` and `weigh` predict with the same geometry.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from daq.config.cell import Cell, CellAxis, model_of
from daq.workflow.zero_text import DEGREES, MILLIMETRES, zero_off_text, zero_remedy
from ident.calibration import Calibration, EncoderMisfit, GeometryCorrection
from ident.errors import Diagnosis, ModelError
from ident.model.geometry import (
    GeometryChange,
    GeometryKind,
    GeometryParameter,
    described_length,
    model_with_geometry,
)
from ident.model.model import Model
from ident.model.robot import JointKind

if TYPE_CHECKING:  # who predicts with a calibration estimates no geometry
    from ident.estimators.geometry_estimate import GeometryEstimate, GeometryFinding

#: Diagnoses of one cause.
NAMES = {
    GeometryKind.ZERO: "zero-off",
    GeometryKind.LENGTH: "length-off",
    GeometryKind.PLACE: "place-off",
    GeometryKind.DELAY: "position-late",
}
SEVERAL = "geometry-off"  #: Diagnosis of several, and of a misfit without an explanation
UNEXPLAINED = "no zero, length, place on the base or late encoder explains, nor any three of them"
LOOK_FOR = (
    "look for arms that bend, play in joints, encoders that do not count evenly, and more than "
    "three wrong numbers; measure zeros, lengths and places, and correct cell file and URDF"
)
MM = 1e-3  #: [m]
MS = 1e-3  #: [s]
ANGLE = "rad"  #: Unit of misfits of a robot without prismatic axes
_SHOWN_ALTERNATIVES = 3


def geometry_diagnoses(
    finding: GeometryFinding | None, cell: Cell, *, applied: bool
) -> Iterator[Diagnosis]:
    """Name the numbers of the description that the encoders contradict.

    Args:
        finding: None for a robot without redundant encoders.
        cell: as it is described.
        applied: the gains are those of the corrected geometry.
    """
    if finding is None or not finding.is_significant:
        return
    unit = _misfit_unit(model_of(cell))
    misfit = f"encoders that miss the loops by {misfit_text(finding.misfit, unit)}"
    expected = f"{misfit_text(finding.noise, unit)}, the noise of the encoders"
    if applied:
        used = "the gains are those of the corrected geometry"
    elif finding.corrections:
        used = (
            "the gains are those of the described geometry: `drivegain residual` identifies "
            "with the corrected one"
        )
    else:
        used = "the gains are those of the described geometry"
    if not finding.causes:
        yield Diagnosis(
            name=SEVERAL,
            runs=(),
            axes=(),
            found=f"{misfit}, which {UNEXPLAINED}",
            expected=expected,
            remedy=f"{LOOK_FOR}; {used}",
        )
        return
    texts = [_correction_text(one, cell) for one in finding.causes]
    remedies = [_remedy(one, cell) for one in finding.causes]
    if len(finding.causes) > 1:
        name = SEVERAL
        explains = "explain together"
    else:
        name = NAMES[finding.causes[0].parameter.kind]
        explains = "explains alone"
    causes = " and ".join(texts)
    found = f"{misfit}, which {causes} {explains}"
    if finding.alternatives:
        alternatives = finding.alternatives[:_SHOWN_ALTERNATIVES]
        others = "; ".join(_explanation_text(other, cell) for other in alternatives)
        found += f" (not distinguishable from {others})"
    correct = ", and ".join(remedies)
    yield Diagnosis(
        name=name,
        runs=(),
        axes=tuple(_axes_of(finding.causes, cell)),
        found=found,
        expected=expected,
        remedy=f"{correct}; {used}",
    )


def _misfit_unit(model: Model) -> str:
    """Unit of misfits: that of the axes, or a share of the robot's size too."""
    kinds = {joint.kind for joint in model.robot.axes}
    if kinds == {JointKind.REVOLUTE}:
        return ANGLE
    return "rad or robot size"


def misfit_text(misfit: float, unit: str) -> str:
    """Write a misfit [unit] in thousandths."""
    thousandths = f"{1e3 * misfit:.2g}"
    if unit == ANGLE:
        return f"{thousandths} mrad"
    return f"{thousandths} thousandths ({unit})"


def _axes_of(corrections: Sequence[GeometryEstimate], cell: Cell) -> Iterator[str]:
    """Axes of the zeros and delays among causes."""
    for one in corrections:
        if one.parameter.kind in (GeometryKind.ZERO, GeometryKind.DELAY):
            yield _axis_of(one.parameter, cell).name


def _axis_of(parameter: GeometryParameter, cell: Cell) -> CellAxis:
    """Axis of a zero or a delay.

    Raises:
        ModelError: no axis has a joint of this name.
    """
    names = [joint.name for joint in model_of(cell).robot.axes]
    if parameter.joint not in names:
        raise ModelError(
            f"a zero of joint {parameter.joint!r} was corrected, and no axis of the robot has it: "
            f"{', '.join(names)}; give the cell file of the fit, or calibrate anew"
        )
    return cell.axes[names.index(parameter.joint)]


def _explanation_text(corrections: Sequence[GeometryEstimate], cell: Cell) -> str:
    return " and ".join(_correction_text(one, cell) for one in corrections)


def _correction_text(one: GeometryEstimate, cell: Cell) -> str:
    """Say how far a number is off: `the zero of M2 off by -0.102 ± 0.003°`."""
    match one.parameter.kind:
        case GeometryKind.ZERO:
            axis = _axis_of(one.parameter, cell)
            return zero_off_text(
                axis.name, one.change / axis.unit.si, one.std / axis.unit.si, _unit_of_zero(axis)
            )
        case GeometryKind.LENGTH:
            longer = "longer" if one.change > 0.0 else "shorter"
            size = _size_text(abs(one.change), one.std, MM)
            return f"a {one.parameter.name} that is {size} mm {longer} than described"
        case GeometryKind.PLACE:
            size = _size_text(one.change, one.std, MM, sign="+")
            place = f"the place of {one.parameter.joint} on the base"
            return f"{place} off by {size} mm in {one.parameter.end} (to be added to it)"
        case GeometryKind.DELAY:
            late = "late" if one.change > 0.0 else "early"
            size = _size_text(abs(one.change), one.std, MS)
            return f"an encoder of {_axis_of(one.parameter, cell).name} that is {late} by {size} ms"


def _unit_of_zero(axis: CellAxis) -> str:
    """Unit of an axis' zero, as people write it."""
    return DEGREES if axis.unit.si_name == "rad" else MILLIMETRES


def _size_text(value: float, std: float, unit_si: float, sign: str = "") -> str:
    """Write a size with σ, to a figure that a description can hold."""
    shown_std = max(std / unit_si, 5e-5)
    return f"{value / unit_si:{sign}.4f} ± {shown_std:.4f}"


def _remedy(one: GeometryEstimate, cell: Cell) -> str:
    match one.parameter.kind:
        case GeometryKind.ZERO:
            axis = _axis_of(one.parameter, cell)
            change = one.change / axis.unit.si
            std = one.std / axis.unit.si
            described = axis.zero_offset_rad / axis.unit.si
            return zero_remedy(axis.name, change, std, _unit_of_zero(axis), described)
        case GeometryKind.LENGTH | GeometryKind.PLACE:
            length_m = described_length(model_of(cell).robot, one.parameter)
            right = f"{(length_m + one.change) / MM:.3f} mm in place of {length_m / MM:.3f} mm"
            return f"correct the {one.parameter.name} in the URDF: {right}"
        case GeometryKind.DELAY:
            return (
                f"look for what delays the encoder of {_axis_of(one.parameter, cell).name} alone: "
                "a filter, a slower channel, another time stamp than that of the other axes"
            )


# What a calibration keeps


def encoder_misfit_of(
    finding: GeometryFinding | None, cell: Cell, *, applied: bool
) -> EncoderMisfit | None:
    """Make what a calibration keeps of a finding; arguments as for `geometry_diagnoses`."""
    if finding is None:
        return None
    return EncoderMisfit(
        described=_rounded(finding.misfit),
        noise=_rounded(finding.noise),
        late_encoders="" if finding.corrections else _late_text(finding, cell),
        left=_rounded(finding.misfit_left),
        unit=_misfit_unit(model_of(cell)),
        significant=finding.is_significant,
        corrections=tuple(_kept(one, cell) for one in finding.corrections),
        applied=applied,
        alternatives=tuple(_explanation_text(other, cell) for other in finding.alternatives),
        unobservable=finding.unobservable,
    )


def _late_text(finding: GeometryFinding, cell: Cell) -> str:
    """Explanations in which an encoder is late,
    and those that cannot be distinguished from them.
    """
    explanations = (finding.causes, *finding.alternatives)
    return "; or by ".join(_explanation_text(one, cell) for one in explanations)


def _kept(one: GeometryEstimate, cell: Cell) -> GeometryCorrection:
    parameter = one.parameter
    if parameter.kind is GeometryKind.ZERO:
        axis = _axis_of(parameter, cell)
        described = float(axis.zero_offset_rad)
        unit = axis.unit.si_name
    else:
        described = described_length(model_of(cell).robot, parameter)
        unit = "m"
    return GeometryCorrection(
        kind=parameter.kind.value,
        joint=parameter.joint,
        end=parameter.end,
        described=described,
        change=one.change,
        std=one.std,
        unit=unit,
    )


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


def calibrated_model(calibration: Calibration, cell: Cell) -> Model:
    """Build the model with which a calibration predicts:
    that of the cell, with the geometry of its fit.

    The corrected numbers hold, whatever the cell says now: one that was corrected meanwhile is not
    corrected twice.

    Raises:
        ModelError: the robot is described otherwise than at the fit.
    """
    model = model_of(cell)
    kept = calibration.encoder_misfit
    if kept is None or not kept.applied:
        return model
    changes: list[GeometryChange] = []
    for one in kept.corrections:
        parameter = GeometryParameter(GeometryKind(one.kind), one.joint, one.end)
        if parameter.kind is GeometryKind.ZERO:
            now = _axis_of(parameter, cell).zero_offset_rad
        else:
            now = described_length(model.robot, parameter)
        changes.append(GeometryChange(parameter, one.described + one.change - now))
    return model_with_geometry(model, changes)
