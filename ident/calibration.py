"""The calibration: drive gains with their uncertainty, parameters,
effects and where all of it came from.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ident.arrays import FloatArray, as_array, require_kind, require_names, takes
from ident.data.conditioning import Conditioning
from ident.data.run import Recording
from ident.errors import Diagnosis, ModelError
from ident.estimators.estimate import SAME_ERROR, RelativeError
from ident.model.bodies import LOADED
from ident.physical.full_set import FullSet

if TYPE_CHECKING:  # reading a calibration needs no estimator
    from ident.discovery.evidence import Evidence
    from ident.discovery.loop import Step
    from ident.effects.effect import Effect, PlacedEffect
    from ident.estimators.estimate import Identification

EXTRAPOLATED = 1.5
"""Times the largest torque of an effect in the fit that it may have in a prediction: a power of the
speed or of the current grows without end where nothing was recorded. Samples differ from the
filtered rows of a fit by less.
"""


@dataclass(frozen=True, slots=True)
class Gain:
    """One joint drive gain g = N·Gt·Kt (paper eq. 4)."""

    axis: str  #: name of the axis
    value: float  #: identified gain [unit]
    std: float  #: its standard deviation [unit], 0 where the gain was held fixed
    unit: str  #: Nm at the joint per unit of the current-loop reference
    nameplate: float  #: gain by the data sheet [unit]

    @property
    def std_percent(self) -> float:
        """Relative standard deviation (eq. 11) [%]."""
        return 100.0 * self.std / abs(self.value)

    @property
    def change_percent(self) -> float:
        """Change from the nameplate [%]."""
        return 100.0 * (self.value / self.nameplate - 1.0)


@dataclass(frozen=True, slots=True)
class Parameter:
    """One identified dynamic parameter, with the regrouping in its name where it has one."""

    name: str
    value: float
    std: float
    unit: str

    @property
    def is_payload_friction(self) -> bool:
        """Whether it is, or leads with, what a payload adds to friction
        (`Model.friction_by_payload`).
        """
        is_of_robot = ":" not in self.name  # after a colon is the mounting of a payload
        return is_of_robot and self.name.split(" ", 1)[0].endswith(LOADED)

    @property
    def std_percent(self) -> float:
        """Relative standard deviation (eq. 11) [%]; inf for a value of zero."""
        if self.value:
            return 100.0 * self.std / abs(self.value)
        return float("inf")


@dataclass(frozen=True, slots=True)
class AcceptedEffect:
    """An effect that the declared model lacked and that held-out data asked for."""

    name: str  #: family, as in ident/effects/
    axis: str  #: name of the axis, of a joint without a motor, or of all axes together
    settings: dict[str, float]  #: the searched (non-linear) parameters by name, units in the names
    coefficients: tuple[Parameter, ...]  #: the linear parameters, identified
    #: Error without the effect on data that the fit did not use [%]: of the axis's joint torque on
    #: held-out runs (in total for an effect on all motors, for a correction of the description, or
    #: on a joint without a motor); without such runs, of the most affected motor's current on
    #: left-out moves.
    error_before_percent: float
    error_after_percent: float  #: the same with the effect
    #: families whose held-out score does not differ from this one's
    ambiguity: tuple[str, ...] = ()
    #: Largest torque of the effect on the rows of the fit, at each axis [Nm; N]: no more was ever
    #: seen of it, and a prediction takes no more than EXTRAPOLATED times as much. None of an effect
    #: whose torque is a rate, which is far larger in a sample than in a filtered row, and in
    #: calibrations of earlier versions.
    largest_torque: tuple[float, ...] | None = None
    #: Of a correction of the robot's description: the number that it corrects, as the fit found it
    #: described (the zero offset of the axis [rad; m], or gravity [m/s²]). None of other effects,
    #: where nothing in the description is corrected, and in calibrations of earlier versions.
    described: tuple[float, ...] | None = None
    #: Name and version of the package that has the effect, or its module where no package has it:
    #: `module my_effects`. None of an effect that drivegain ships.
    package: str | None = None

    @property
    def is_confirmed(self) -> bool:
        """Whether it does not raise the error on data that the fit did not use,
        by more than SAME_ERROR of it.
        """
        return self.error_after_percent <= (1.0 + SAME_ERROR) * self.error_before_percent


@dataclass(frozen=True, slots=True)
class MassInfluence:
    """What the mass of a payload does to one gain, to first order."""

    axis: str  #: name of the axis
    per_kg: float  #: dg/dm [unit of the gain per kg]
    #: d ln g/d ln m: change of the gain [%] with a mass that is wrong by 1 %
    percent_per_percent: float
    #: |dg/dm| times the tolerance of the mass [unit of the gain]; it is not in the gain's σ
    tolerance_std: float


@dataclass(frozen=True, slots=True)
class PayloadMass:
    """A payload of which the mass is known, which gives the gains their scale."""

    payload: str  #: name of the body
    mass_kg: float  #: as the fit took it for known
    tolerance_kg: float  #: declared tolerance of the weighing, 0 where none is declared
    gains: tuple[MassInfluence, ...]  #: one an axis
    #: Derivative of each of the calibration's parameters to the mass [its unit per kg], in their
    #: order; empty in calibrations of earlier versions.
    parameters_per_kg: tuple[float, ...] = ()

    @classmethod
    def of(
        cls,
        payload: str,
        mass_kg: float,
        gain_per_kg: Sequence[float],
        gains: Sequence[Gain],
        parameters_per_kg: Sequence[float] = (),
    ) -> PayloadMass:
        """Influence on gains and parameters, without a tolerance, from the derivative of each."""
        influences = tuple(
            MassInfluence(gain.axis, float(slope), float(slope * mass_kg / gain.value), 0.0)
            for slope, gain in zip(gain_per_kg, gains, strict=True)
        )
        rounded = tuple(float(f"{slope:.6g}") for slope in parameters_per_kg)
        return cls(payload, mass_kg, 0.0, influences, rounded)

    def weighed_to(self, tolerance_kg: float) -> PayloadMass:
        """Return the same with the tolerance of the weighing."""
        influences = tuple(
            replace(one, tolerance_std=abs(one.per_kg) * tolerance_kg) for one in self.gains
        )
        return replace(self, tolerance_kg=tolerance_kg, gains=influences)


@dataclass(frozen=True, slots=True)
class GeometryCorrection:
    """A number of the robot's description that the encoders contradict."""

    kind: str  #: `zero` of a joint, `length` of a link, or `place` of a joint on the base
    joint: str  #: name of the joint with the zero, on the base, or of the one that moves the link
    #: Of a length: name of the joint or of the closure at the other end of the link; of a place: x,
    #: y or z.
    end: str
    #: as the fit found it described: the zero offset, the length, or the coordinate [unit]
    described: float
    change: float  #: what has to be added to it [unit]
    std: float  #: σ of the change [unit]
    unit: str  #: rad or m


@dataclass(frozen=True, slots=True)
class EncoderMisfit:
    """How well the encoders of a robot with more of them than degrees of freedom fit its loops,
    and why not better.
    """

    described: float  #: root mean square of the misfit with the described geometry [unit]
    #: the same with the explanation; without any, with all zeros and lengths that fit best [unit]
    left: float
    unit: str  #: rad; with prismatic axes `rad or robot size`
    significant: bool  #: the described one is more than noise makes
    #: The fewest numbers that explain it; empty without an explanation, and where late encoders
    #: explain it.
    corrections: tuple[GeometryCorrection, ...]
    #: the gains and parameters of the calibration are those of the corrected geometry
    applied: bool
    #: other explanations that these positions cannot distinguish from it
    alternatives: tuple[str, ...] = ()
    unobservable: tuple[str, ...] = ()  #: directions of zeros and lengths that no position shows
    #: of the encoders, likewise [unit]; None in calibrations of earlier versions
    noise: float | None = None
    late_encoders: str = ""  #: the explanation, in words, where an encoder is late; empty elsewhere


@dataclass(frozen=True, slots=True)
class Source:
    """One log that the calibration rests on."""

    name: str  #: of the log
    sha256: str  #: its digest
    role: str  #: use of the log, `fit` or `holdout`; not whether a payload was mounted
    #: It is what was saved of a recording that was never finished, or one with losses; nothing of
    #: it may reach a controller.
    partial: bool = False
    #: name of what was mounted; None without load, and in calibrations of earlier versions
    payload: str | None = None
    mass_kg: float | None = None  #: of it, as fitted; None where it was not declared
    #: how the log was made; None in calibrations of earlier versions
    recording: Recording | None = None
    #: how it was mounted; None without load, and in calibrations of earlier versions
    mounting: str | None = None


@dataclass(frozen=True, slots=True)
class CalibratedJoint:
    """A joint of the robot that a calibration is of."""

    name: str  #: as in the robot's description
    kind: str  #: revolute or prismatic
    parent: str  #: name of the joint before it, empty on the base


@dataclass(frozen=True, slots=True)
class CalibratedDrive:
    """A drive of the robot that a calibration is of;
    None for a number that its description leaves open.
    """

    axis: str  #: name of the axis
    node_id: int | None
    vendor_id: int | None
    product_code: int | None


@dataclass(frozen=True, slots=True)
class CalibratedRobot:
    """The robot that a calibration is of:
    what tells it from another one of the same name and axes.
    """

    #: of joints, their kinds and order, and the motors of a closed chain, hex; as in a plan
    kinematics_sha256: str
    drives_sha256: str  #: of node id, vendor and product code of each axis, hex; as in a plan
    joints: tuple[CalibratedJoint, ...]  #: that move, in the order of the description
    drives: tuple[CalibratedDrive, ...]  #: one an axis
    motors: tuple[str, ...] = ()  #: joints with a motor in a closed chain; empty for a serial robot


@dataclass(frozen=True, slots=True)
class Calibration:
    """Gains, parameters and effects of a cell, with their errors and sources."""

    cell: str  #: name of the cell
    method: str  #: ls, wls, tls, ml or iv
    gains: tuple[Gain, ...]  #: one an axis
    #: Base parameters of the robot, then the unknown parameters of each payload mounting.
    parameters: tuple[Parameter, ...]
    effects: tuple[AcceptedEffect, ...]  #: accepted effects
    relative_error_percent: RelativeError  #: on the data of the fit
    #: On a run that no fit has seen, None where there was none; NaN for an axis that did not move
    #: in it. It has judged the effects that a search found.
    holdout_error_percent: RelativeError | None
    condition: float  #: of the weighted observation matrix
    rows: int  #: of the observation after masks and decimation
    #: cut-offs, orders, decimation and standstill speeds, by name
    filter: dict[str, float | list[float]]
    sources: tuple[Source, ...]  #: logs, with digests and roles
    configuration_sha256: str  #: of the cell configuration that the logs carry
    created: str  #: ISO 8601 time, given by the caller
    software: str  #: name and version that made it
    #: When the first run of the fit began, by the clock of `Run.started_s`; None where a run has no
    #: clock.
    session_began_s: float | None = None
    #: On the held-out run, of the same model, effects included, fitted with the nameplate gains;
    #: the total weighs the axes by the torques under the identified gains. None where there is none
    #: to compare.
    nameplate_holdout_error_percent: RelativeError | None = None
    #: Digest of the part of the configuration that a recording depends on; None in calibrations of
    #: earlier versions.
    recording_configuration_sha256: str | None = None
    #: Lower triangle L of the covariance L Lᵀ of (gains, parameters), a row each; None in
    #: calibrations of earlier versions, and of an estimate without σ.
    covariance_factor: tuple[tuple[float, ...], ...] | None = None
    #: what was wrong with the recordings or the fit, by run and axis
    diagnoses: tuple[Diagnosis, ...] = ()
    #: Root mean square of what is left of each motor's current on the held-out run, filtered as in
    #: the fit [A, or the unit of the gains' current]; of the fit for a motor that did not move
    #: there. None in earlier versions.
    current_residual: tuple[float, ...] | None = None
    #: Joints of a closed chain without a motor, then the pivots that its loops are cut at: effects
    #: can act there, too.
    passive_joints: tuple[str, ...] = ()
    #: How the gains depend on the mass of each payload whose mass is known; empty for fixed gains,
    #: and in calibrations of earlier versions.
    payload_mass: tuple[PayloadMass, ...] = ()
    #: Of a robot with more encoders than degrees of freedom; None for others, and in calibrations
    #: of earlier versions.
    encoder_misfit: EncoderMisfit | None = None
    #: All standard parameters under a prior; None where none was asked for, and in calibrations of
    #: earlier versions.
    full_parameters: FullSet | None = None
    #: The robot that it is of; None of arrays, where nothing describes it, and in calibrations of
    #: earlier versions.
    robot: CalibratedRobot | None = None
    #: Effects of one's own that were given as an argument, one of each name or more: predictions
    #: find them here. No file has them; give them again to `daq.load_calibration`. An installed
    #: package needs no argument.
    own_effects: tuple[Effect, ...] = field(default=(), compare=False, repr=False)

    @property
    def places(self) -> tuple[str, ...]:
        """Names of the axes, then of the joints without a motor, as in `Robot.places`."""
        return (*(gain.axis for gain in self.gains), *self.passive_joints)

    @property
    def conditioning(self) -> Conditioning:
        """Filters of the fit.

        Raises:
            ModelError: `filter` does not have them all.
        """
        return Conditioning.of_document(self.filter)

    @property
    def friction_by_payload(self) -> bool:
        """Whether friction with a payload has parameters of its own."""
        return any(parameter.is_payload_friction for parameter in self.parameters)

    @property
    def gains_fixed(self) -> bool:
        """Whether the fit held every gain: none was identified."""
        return all(gain.std == 0.0 for gain in self.gains)

    @property
    def covariance(self) -> FloatArray | None:
        """Covariance of (gains, parameters), shape (m + p, m + p);
        None where the calibration has none.

        Raises:
            ModelError: its factor has another shape.
        """
        if self.covariance_factor is None:
            return None
        size = len(self.gains) + len(self.parameters)
        if [len(row) for row in self.covariance_factor] != list(range(1, size + 1)):
            raise ModelError(
                f"covariance_factor of the calibration of cell {self.cell!r} has "
                f"{len(self.covariance_factor)} rows; expected {size} of one to {size} entries, "
                f"for {len(self.gains)} gains and {len(self.parameters)} parameters: fit the logs "
                "again"
            )
        lower = np.zeros((size, size))
        lower[np.tril_indices(size)] = np.concatenate(self.covariance_factor)
        return np.asarray(lower @ lower.T)


@takes()
def calibration_of(
    found: Identification,
    axes: Sequence[str],
    nameplate: ArrayLike,
    *,
    units: Sequence[str] = (),
    robot: str = "robot",
    steps: Sequence[Step] = (),
) -> Calibration:
    """Calibration that an identification amounts to, without the logs that it came from.

    Its sources name the payloads with their masses and no file.

    Args:
        found: by `ident.identify`; with ``steps``, the one that they began with.
        axes: name of each axis.
        nameplate: gains by the data sheet, one an axis.
        units: of each gain; Nm/A where it is left out.
        robot: name of the robot or cell.
        steps: by `ident.find_effects`: the calibration is that of the last one, with the effects
            that it holds.

    Raises:
        ModelError: there is not one name, nameplate gain and unit for each axis, or the effects
            come without steps.
    """
    # Reading a calibration needs no effects and no estimator.
    from ident.effects.signals import session_began_s  # noqa: PLC0415
    from ident.estimators.estimate import Identification as IdentificationKind  # noqa: PLC0415
    from ident.estimators.payload_mass import mass_responses  # noqa: PLC0415

    require_kind("found", found, IdentificationKind, "give the result of ident.identify")
    require_names("axes", axes)
    require_names("units", units)
    require_kind("robot", robot, str, "give the name of the robot or cell")
    require_kind("steps", steps, Sequence, "give the result of ident.find_effects")

    last = steps[-1].after if steps else None
    start = found
    found = found if last is None else last.identification
    if last is None and len(found.system.columns) > len(found.system.base.names):
        effect = (
            f"the identification holds {found.system.columns[-1].name!r}, a parameter of an effect"
        )
        raise ModelError(f"{effect}; give the one without effects, and steps=find_effects(...)")
    estimate = found.estimate
    nameplate_gains = np.atleast_1d(as_array("nameplate", nameplate))
    if nameplate_gains.ndim != 1 or not nameplate_gains.all():
        raise ModelError(
            f"nameplate is {nameplate_gains.tolist()}; expected one gain per axis, none of them "
            "zero: take them from the data sheet, or the identified ones"
        )
    units = units or ("Nm/A",) * len(axes)
    if not len(axes) == len(nameplate_gains) == len(units) == len(estimate.gains):
        raise ModelError(
            f"{len(axes)} axis names, {len(nameplate_gains)} nameplate gains and {len(units)} "
            f"units for {len(estimate.gains)} identified gains; expected one of each for each axis"
        )
    parameters = tuple(
        Parameter(column.name, float(value + column.about), float(std), column.unit)
        for column, value, std in zip(
            estimate.unknowns, estimate.parameters, estimate.parameters_std, strict=True
        )
    )
    identified = zip(axes, estimate.gains, estimate.gains_std, units, nameplate_gains, strict=True)
    gains = tuple(
        Gain(axis, float(g), float(std), unit, float(entered))
        for axis, g, std, unit, entered in identified
    )
    responses = mass_responses(found.system, estimate)
    tolerance_kg: dict[str, float] = {}
    for payload in found.system.payloads:
        tolerance_kg[payload.name] = max(
            payload.mass_tolerance_kg, tolerance_kg.get(payload.name, 0.0)
        )
    undriven = found.model.robot.undriven_names
    places = (*axes, *undriven)
    return Calibration(
        cell=robot,
        method=estimate.method.value,
        gains=gains,
        parameters=parameters,
        effects=()
        if last is None
        else tuple(_accepted(start, steps, one, places, parameters) for one in last.effects),
        relative_error_percent=found.training_error,
        holdout_error_percent=found.holdout_error,
        condition=estimate.condition,
        rows=estimate.rows,
        filter=found.conditioning.document(),
        sources=tuple(
            Source(
                ", ".join(found.system.runs),
                "",
                "fit",
                payload=payload.name,
                mass_kg=payload.known.get("m"),
                mounting=payload.mounting,
            )
            for payload in found.system.payloads
        ),
        configuration_sha256="",
        created="",
        software="",
        session_began_s=None if last is None else session_began_s(last.fit_runs),
        covariance_factor=factor_of(estimate.covariance),
        current_residual=found.current_residual,
        passive_joints=undriven,
        own_effects=() if last is None else _own_effects(last),
        payload_mass=tuple(
            PayloadMass.of(
                one.payload,
                one.mass_kg,
                one.gain_per_kg.tolist(),
                gains,
                one.parameters_per_kg.tolist(),
            ).weighed_to(tolerance_kg[one.payload])
            for one in responses
        ),
    )


def factor_of(covariance: FloatArray) -> tuple[tuple[float, ...], ...] | None:
    """Rows of L with the covariance L Lᵀ, to six digits; None where σ is not finite.

    Unlike Cholesky's factor, it exists with fewer moves than unknowns too.
    """
    if not np.isfinite(covariance).all():
        return None
    std = np.sqrt(np.diag(covariance))
    unit = np.where(std > 0.0, std, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    upper = np.asarray(np.linalg.qr((vectors * np.sqrt(np.maximum(values, 0.0))).T, mode="r"))
    lower = upper.T * unit[:, None]
    return tuple(
        tuple(float(f"{value:.6g}") for value in row[: index + 1])
        for index, row in enumerate(lower)
    )


def _own_effects(last: Evidence) -> tuple[Effect, ...]:
    """Effects of the model that drivegain does not ship."""
    # Who reads a calibration needs no effects.
    from ident.effects.effect import is_shipped  # noqa: PLC0415

    return tuple(placed.effect for placed in last.effects if not is_shipped(placed.effect))


def _accepted(
    start: Identification,
    steps: Sequence[Step],
    placed: PlacedEffect,
    places: Sequence[str],
    found: Sequence[Parameter],
) -> AcceptedEffect:
    # Who reads a calibration needs no effects.
    from ident.effects.geometry_corrections import is_correction  # noqa: PLC0415
    from ident.effects.own import package_of  # noqa: PLC0415

    # The last turn that added it: an effect may have been dropped and added again.
    for number, step in reversed(list(enumerate(steps))):
        before = steps[number - 1].after if number else None
        finding = step.accepted
        if (
            finding is not None
            and placed in step.after.effects
            and not (before and placed in before.effects)
        ):
            break
    else:
        raise LookupError(f"{placed} is in the model, and no turn of the loop added it")
    axis = placed.axis_name(places)
    held_out = (before or start).holdout_error, step.after.holdout_error
    verdict = next((one for one in steps[-1].verdicts if one.placed == placed), None)
    if verdict is not None:
        held_out = verdict.before, verdict.after
    # A correction of the description is judged by all motors together, and so shown by them.
    has_own_error = axis in places and not is_correction(placed)
    errors: list[float] = []
    for error in held_out:
        if error is None:
            errors.append(math.nan)
        elif has_own_error:
            errors.append(error.at(placed.axis))
        else:
            errors.append(error.total)
    if not all(map(math.isfinite, errors)):
        # Without a run that was held out, the moves that were left out in turn must do.
        errors = [finding.error_before_percent, finding.error_after_percent]
    names = {column.name for column in placed.columns}
    return AcceptedEffect(
        name=placed.effect.name,
        axis=axis,
        settings={name: float(value) for name, value in placed.effect.settings.items()},
        coefficients=tuple(parameter for parameter in found if parameter.name in names),
        error_before_percent=errors[0],
        error_after_percent=errors[1],
        ambiguity=tuple(rival.name_among(places) for rival in finding.ambiguity),
        largest_torque=_largest_torque(steps[-1].after, placed),
        package=package_of(placed.effect),
    )


def _largest_torque(evidence: Evidence, placed: PlacedEffect) -> tuple[float, ...] | None:
    """Largest torque of an effect at each axis, over the rows of the fit [Nm; N];
    None where it is a rate.
    """
    if placed.effect.is_rate:
        return None
    rows = evidence.training
    estimate = evidence.estimate
    names = {column.name for column in placed.columns}
    first = len(rows.columns) - rows.effects.shape[1]
    own = [index for index, column in enumerate(rows.columns[first:]) if column.name in names]
    of_parameters = [
        index for index, column in enumerate(estimate.unknowns) if column.name in names
    ]
    torque = np.einsum("p,mpr->mr", estimate.parameters[of_parameters], rows.effects[:, own])
    largest = np.max(np.abs(torque), axis=1, where=rows.use, initial=0.0)
    return tuple(float(f"{value:.4g}") for value in largest)
