"""The calibration: drive gains with their σ, parameters, effects and the sources of all of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ident.arrays import FloatArray, as_array, require_entries, require_kind, require_names, takes
from ident.data.conditioning import Conditioning
from ident.data.run import Recording
from ident.errors import Diagnosis, ModelError
from ident.estimators.estimate import SAME_ERROR, RelativeError
from ident.model.bodies import LOADED, Payload
from ident.physical.full_set import FullSet

if TYPE_CHECKING:  # reading a calibration needs no estimator
    from ident.discovery.evidence import Evidence
    from ident.discovery.loop import Step
    from ident.discovery.search import Finding
    from ident.effects.effect import Effect, PlacedEffect
    from ident.equations.system import System
    from ident.estimators.estimate import Estimate, Identification
    from ident.estimators.payload_mass import MassResponse

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
        """Whether it is, or leads with, what a payload adds to friction.

        See `Model.friction_by_payload`.
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
    """An effect beside the declared model: found by a search, or declared by the cell."""

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
    #: alternatives that passed the search before this one joined, and do not pass beside it
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
    def is_harmless(self) -> bool:
        """Whether it does not raise the error on unseen data by more than SAME_ERROR of it."""
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
        influences: list[MassInfluence] = []
        for slope, gain in zip(gain_per_kg, gains, strict=True):
            relative = slope * mass_kg / gain.value
            influences.append(MassInfluence(gain.axis, float(slope), float(relative), 0.0))
        rounded = tuple(float(f"{slope:.6g}") for slope in parameters_per_kg)
        return cls(payload, mass_kg, 0.0, tuple(influences), rounded)

    def weighed_to(self, tolerance_kg: float) -> PayloadMass:
        """Return the same with the tolerance of the weighing."""
        influences: list[MassInfluence] = []
        for influence in self.gains:
            std = abs(influence.per_kg) * tolerance_kg
            influences.append(replace(influence, tolerance_std=std))
        return replace(self, tolerance_kg=tolerance_kg, gains=tuple(influences))


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
    """How well redundant encoders of a robot fit its loops, and why not better."""

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
    """A drive of the robot of a calibration; None where its description leaves a number open."""

    axis: str  #: name of the axis
    node_id: int | None
    vendor_id: int | None
    product_code: int | None


@dataclass(frozen=True, slots=True)
class CalibratedRobot:
    """What tells the robot of a calibration from another one of the same name and axes."""

    #: of joints, their kinds and order, and the motors of a closed chain, hex; as in a plan
    kinematics_sha256: str
    drives_sha256: str  #: of node id, vendor and product code of each axis, hex; as in a plan
    #: that move, in the order of the description; empty in plans of earlier versions, as `drives`
    joints: tuple[CalibratedJoint, ...] = ()
    drives: tuple[CalibratedDrive, ...] = ()  #: one an axis
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
        """Covariance of (gains, parameters), shape (m + p, m + p); None without one.

        Raises:
            ModelError: its factor has another shape.
        """
        factor = self.covariance_factor
        if factor is None:
            return None
        gain_count = len(self.gains)
        parameter_count = len(self.parameters)
        size = gain_count + parameter_count
        if [len(row) for row in factor] != list(range(1, size + 1)):
            raise ModelError(
                f"covariance_factor of the calibration of cell {self.cell!r} has {len(factor)} "
                f"rows; expected {size} of one to {size} entries, for {gain_count} gains and "
                f"{parameter_count} parameters: fit the logs again"
            )
        lower = np.zeros((size, size))
        lower[np.tril_indices(size)] = np.concatenate(factor)
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

    last: Evidence | None = None
    start = found
    if steps:
        from ident.discovery.loop import Step as StepKind  # noqa: PLC0415

        require_entries("steps", steps, StepKind, "give the result of ident.find_effects")
        last = steps[-1].after
        found = last.identification
    system = found.system
    if last is None and len(system.columns) > len(system.base.names):
        name = system.columns[-1].name
        raise ModelError(
            f"the identification holds {name!r}, a parameter of an effect; give the one without "
            "effects, and steps=find_effects(...)"
        )
    estimate = found.estimate
    nameplate_gains = np.atleast_1d(as_array("nameplate", nameplate))
    if nameplate_gains.ndim != 1 or not nameplate_gains.all():
        raise ModelError(
            f"nameplate is {nameplate_gains.tolist()}; expected one gain per axis, none of them "
            "zero: take them from the data sheet, or the identified ones"
        )
    axis_count = len(axes)
    units = units or ("Nm/A",) * axis_count
    if not axis_count == len(nameplate_gains) == len(units) == len(estimate.gains):
        raise ModelError(
            f"{axis_count} axis names, {len(nameplate_gains)} nameplate gains and {len(units)} "
            f"units for {len(estimate.gains)} identified gains; expected one of each for each axis"
        )
    gains: list[Gain] = []
    identified = zip(axes, estimate.gains, estimate.gains_std, units, nameplate_gains, strict=True)
    for axis, gain, std, unit, entered in identified:
        gains.append(Gain(axis, float(gain), float(std), unit, float(entered)))
    parameters = _parameters_of(estimate)
    undriven = found.model.robot.undriven_names
    effects: list[AcceptedEffect] = []
    own_effects: tuple[Effect, ...] = ()
    began_s: float | None = None
    if last is not None:
        places = (*axes, *undriven)
        for placed in last.effects:
            effects.append(_accepted(start, steps, placed, places, parameters))
        own_effects = _own_effects(last)
        began_s = session_began_s(last.fit_runs)
    responses = mass_responses(system, estimate)
    return Calibration(
        cell=robot,
        method=estimate.method.value,
        gains=tuple(gains),
        parameters=parameters,
        effects=tuple(effects),
        relative_error_percent=found.training_error,
        holdout_error_percent=found.holdout_error,
        condition=estimate.condition,
        rows=estimate.rows,
        filter=found.conditioning.document(),
        sources=_sources_of(system),
        configuration_sha256="",
        created="",
        software="",
        session_began_s=began_s,
        covariance_factor=factor_of(estimate.covariance),
        current_residual=found.current_residual,
        passive_joints=undriven,
        own_effects=own_effects,
        payload_mass=_payload_masses(responses, system.payloads, gains),
    )


def _parameters_of(estimate: Estimate) -> tuple[Parameter, ...]:
    """Parameters of an estimate; of a correction, the whole of it."""
    parameters: list[Parameter] = []
    identified = zip(estimate.unknowns, estimate.parameters, estimate.parameters_std, strict=True)
    for column, change, std in identified:
        value = float(change + column.about)
        parameters.append(Parameter(column.name, value, float(std), column.unit))
    return tuple(parameters)


def _sources_of(system: System) -> tuple[Source, ...]:
    """A source for each payload, with no file."""
    runs = ", ".join(system.runs)
    sources: list[Source] = []
    for payload in system.payloads:
        source = Source(
            name=runs,
            sha256="",
            role="fit",
            payload=payload.name,
            mass_kg=payload.known.get("m"),
            mounting=payload.mounting,
        )
        sources.append(source)
    return tuple(sources)


def _payload_masses(
    responses: Sequence[MassResponse], payloads: Sequence[Payload], gains: Sequence[Gain]
) -> tuple[PayloadMass, ...]:
    """How the gains depend on the mass of each payload, with the largest tolerance of each."""
    tolerance_kg: dict[str, float] = {}
    for payload in payloads:
        known_kg = tolerance_kg.get(payload.name, 0.0)
        tolerance_kg[payload.name] = max(payload.mass_tolerance_kg, known_kg)
    masses: list[PayloadMass] = []
    for response in responses:
        mass = PayloadMass.of(
            response.payload,
            response.mass_kg,
            response.gain_per_kg.tolist(),
            gains,
            response.parameters_per_kg.tolist(),
        )
        masses.append(mass.weighed_to(tolerance_kg[response.payload]))
    return tuple(masses)


def factor_of(covariance: FloatArray) -> tuple[tuple[float, ...], ...] | None:
    """Rows of L with the covariance L Lᵀ, shape (u, u), to six digits; None where σ is not finite.

    Unlike Cholesky's factor, it exists with fewer moves than unknowns too.
    """
    if not np.isfinite(covariance).all():
        return None
    std = np.sqrt(np.diag(covariance))
    unit = np.where(std > 0.0, std, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    # V √Λ √Λ Vᵀ = Rᵀ R
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    upper = np.asarray(np.linalg.qr(root.T, mode="r"))
    lower = upper.T * unit[:, None]
    return tuple(_rounded(row[: index + 1]) for index, row in enumerate(lower))


def _rounded(row: FloatArray) -> tuple[float, ...]:
    return tuple(float(f"{value:.6g}") for value in row)


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

    number, finding = _turn_that_added(placed, steps)
    step = steps[number]
    error_before = start.holdout_error
    if number:
        error_before = steps[number - 1].after.holdout_error
    held_out = error_before, step.after.holdout_error
    for verdict in steps[-1].verdicts:
        if verdict.placed == placed:
            held_out = verdict.before, verdict.after
            break
    axis = placed.axis_name(places)
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
    coefficients = [parameter for parameter in found if parameter.name in names]
    settings = {name: float(value) for name, value in placed.effect.settings.items()}
    rivals = [rival.name_among(places) for rival in finding.ambiguity]
    before_percent, after_percent = errors
    return AcceptedEffect(
        name=placed.effect.name,
        axis=axis,
        settings=settings,
        coefficients=tuple(coefficients),
        error_before_percent=before_percent,
        error_after_percent=after_percent,
        ambiguity=tuple(rivals),
        largest_torque=_largest_torque(steps[-1].after, placed),
        package=package_of(placed.effect),
    )


def _turn_that_added(placed: PlacedEffect, steps: Sequence[Step]) -> tuple[int, Finding]:
    """Index and finding of the last turn that added an effect: it may have been dropped before."""
    for number in reversed(range(len(steps))):
        step = steps[number]
        is_there = placed in step.after.effects
        was_there = number > 0 and placed in steps[number - 1].after.effects
        if step.accepted is not None and is_there and not was_there:
            return number, step.accepted
    raise LookupError(f"{placed} is in the model, and no turn of the loop added it")


def _largest_torque(evidence: Evidence, placed: PlacedEffect) -> tuple[float, ...] | None:
    """Largest torque of an effect at each axis, in the fit [Nm; N]; None where it is a rate."""
    if placed.effect.is_rate:
        return None
    rows = evidence.training
    estimate = evidence.estimate
    first = len(rows.columns) - rows.effects.shape[1]
    names = {column.name for column in placed.columns}
    of_effects = [column.name for column in rows.columns[first:]]
    of_unknowns = [column.name for column in estimate.unknowns]
    own = [index for index, name in enumerate(of_effects) if name in names]
    own_unknowns = [index for index, name in enumerate(of_unknowns) if name in names]
    coefficients = estimate.parameters[own_unknowns]
    # τ_mr = Σ_p c_p φ_mpr
    torque = np.einsum("p,mpr->mr", coefficients, rows.effects[:, own])
    largest = np.max(np.abs(torque), axis=1, where=rows.use, initial=0.0)
    return tuple(float(f"{value:.4g}") for value in largest)
