"""The paper's cases 1 to 4 on the same logs (§4.2).

A case is an estimator, and the knowledge of the payload that it is given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np

from daq.config.cell import Cell, model_of
from daq.errors import ConfigurationInconsistent
from daq.workflow.choices import Known
from daq.workflow.diagnoses import named_causes, nameplate_of
from daq.workflow.fit import Fit, LogLoader, calibration_of, judged, refuse_effects
from ident.calibration import Calibration, Parameter, PayloadMass, Source, factor_of
from ident.data.run import SeenRuns
from ident.equations.reduction import reduce_runs, regrouped
from ident.equations.system import System, require_distinct
from ident.estimators.comparison import Essential, essential
from ident.estimators.estimate import Estimate, Identification
from ident.estimators.geometry_estimate import GeometryFinding
from ident.estimators.identify import each_run, estimate_with
from ident.estimators.least_squares import tls
from ident.estimators.method import Method
from ident.model.bodies import LINK_PARAMETERS, LINK_UNITS, Payload


@dataclass(frozen=True, slots=True)
class Case:
    """An estimator, and what it is given."""

    name: str  #: name of its calibration file
    title: str  #: heading of its column of a table
    method: Method  #: the estimator
    known: Known  #: known parameters of the payload
    gains_fixed: bool = False  #: whether the gains are fixed at the nameplate


CASES = (
    Case("manufacturer", "nameplate gains, WLS", Method.WLS, Known.NOTHING, gains_fixed=True),
    Case("case-1", "case 1: WLS, CAD", Method.WLS, Known.CAD),
    Case("case-2", "case 2: WLS, mass", Method.WLS, Known.MASS),
    Case("case-3", "case 3: TLS, CAD", Method.TLS, Known.CAD),
    Case("case-4", "case 4: TLS, mass", Method.TLS, Known.MASS),
    Case("ml", "ml, mass", Method.ML, Known.MASS),
)
"""The five cases of §4.3, and the default of drivegain. The paper's WLS and TLS weight the rows of
each joint.
"""


@dataclass(frozen=True, slots=True)
class ReducedLogs:
    """Logs of one cell as equations; they are read once for all cases."""

    cell: Cell  #: as the logs describe it, or as given
    logs: tuple[Path, ...]  #: logs of the fit
    holdout: tuple[Path, ...]  #: logs that the fit must not see
    sources: tuple[Source, ...]  #: all logs, with digests and roles
    used: System  #: equations of `logs`, in standard parameters
    unseen: System  #: equations of `holdout`, in standard parameters
    #: finding of redundant encoders on the geometry; None for a robot without them
    geometry: GeometryFinding | None = None


@dataclass(frozen=True, slots=True)
class CaseFit:
    """A fit, and the payloads with the parameters that it took as known."""

    fitted: Fit  #: without effects
    payloads: tuple[Payload, ...]  #: one for each mounting
    #: choice of the base parameters; None where all of them are in the fit
    essential: Essential | None


def reduce_logs(
    logs: Sequence[Path],
    holdout: Sequence[Path] = (),
    cell: Cell | None = None,
    *,
    instruments: bool = False,
) -> ReducedLogs:
    """Read logs, and reduce them to systems of equations.

    Args:
        logs: of the fit.
        holdout: logs that the fit must not see.
        cell: replaces the description in the logs.
        instruments: whether they will be fitted by ``iv``, too.

    Raises:
        DataError, ConfigurationError, IdentificationError: a log cannot be used, or not with the
            others.
        UsageError: the cell declares effects.
    """
    loader = LogLoader.of(logs, cell)
    refuse_effects(loader.cell, "--known, --cases")
    model = model_of(loader.cell)
    conditioning = loader.cell.conditioning
    fit_runs = loader.runs(logs, "fit")
    used = reduce_runs(model, fit_runs, conditioning, instruments=instruments)
    holdout_runs = loader.runs(holdout, "holdout")
    # A held-out run must have a mounting of the fit.
    checked_runs = each_run(holdout_runs, SeenRuns(), used.payloads)
    unseen = reduce_runs(model, checked_runs, conditioning, payloads=used.payloads)
    return ReducedLogs(
        cell=loader.cell,
        logs=tuple(logs),
        holdout=tuple(holdout),
        sources=tuple(loader.sources),
        used=used,
        unseen=unseen,
        geometry=loader.geometry(model),
    )


def fit_case(
    logs: ReducedLogs,
    method: Method,
    known: Known,
    *,
    gains_fixed: bool = False,
    ratio: float | None = None,
) -> CaseFit:
    """Fit logs that were reduced.

    Args:
        logs: as `reduce_logs` returns them.
        method: estimator.
        known: parameters of the payload that are taken as known.
        gains_fixed: whether the gains are fixed at the nameplate.
        ratio: r_σ, by which the essential parameters are chosen; None for all base parameters.

    Raises:
        ConfigurationInconsistent: CAD values are wanted, and the cell has none.
        IdentificationError: see ident/estimators/identify.py.
    """
    payloads = tuple(payload_as(payload, logs.cell, known) for payload in logs.used.payloads)
    used = replace(logs.used, payloads=payloads)
    system = regrouped(used)
    require_distinct(system, gains=not gains_fixed)
    fixed_gains = None
    if gains_fixed:
        fixed_gains = nameplate_of(logs.cell)
    estimate = estimate_with(method, system, fixed_gains)
    holdout_system = None
    if logs.unseen.runs:
        unseen = replace(logs.unseen, payloads=payloads)
        holdout_system = regrouped(unseen, system.base, system.payload_columns)
    identification = Identification(
        model=system.model,
        conditioning=logs.cell.conditioning,
        system=system,
        holdout=holdout_system,
        estimate=estimate,
    )
    if gains_fixed:
        paper = None
    else:
        paper = tls(system)
    unjudged = Fit(
        cell=logs.cell,
        logs=logs.logs,
        holdout=logs.holdout,
        sources=logs.sources,
        identification=identification,
        steps=(),
        paper=paper,
        given_cell=logs.cell,
        geometry=logs.geometry,
    )
    with named_causes(unjudged.recordings):
        fitted = judged(unjudged)
    if ratio is None:
        return CaseFit(fitted, payloads, essential=None)
    case_fit = essential_fit(fitted, ratio)
    return replace(case_fit, payloads=payloads)


def essential_fit(fitted: Fit, ratio: float) -> CaseFit:
    """Fit the essential parameters alone (§4.2); the others are zero, without uncertainty.

    Args:
        fitted: with all base parameters.
        ratio: r_σ, by which the essential parameters are chosen.

    Raises:
        IdentificationError: the estimator refuses.
        UsageError: the cell declares effects.
    """
    refuse_effects(fitted.cell, "--essential")
    identification = fitted.identification
    method = identification.estimate.method
    fixed_gains = identification.estimate.fixed_gains

    def estimator(system: System) -> Estimate:
        return estimate_with(method, system, fixed_gains)

    choice = essential(identification.system, estimator, ratio)
    reduced_identification = replace(identification, estimate=choice.whole)
    reduced_fit = replace(fitted, identification=reduced_identification)
    return CaseFit(reduced_fit, identification.system.payloads, choice)


def payload_as(payload: Payload, cell: Cell, known: Known) -> Payload:
    """Return a payload with the known parameters of a case alone.

    Args:
        payload: as the logs have it.
        cell: its payload of this name and mounting has the parameters of the drawing.
        known: the parameters that the case takes as known.

    Raises:
        ConfigurationInconsistent: the parameters of the drawing are wanted, and the cell has no
            more than the mass.
    """
    if known is Known.NOTHING:
        return replace(payload, known={})
    if known is Known.MASS:
        mass = {name: value for name, value in payload.known.items() if name == "m"}
        return replace(payload, known=mass)
    drawn: dict[str, float] = {}
    for declared in cell.payloads:
        if declared.name == payload.name and declared.mounting == payload.mounting:
            drawn.update(declared.known)
            break
    # Numbers of the log, such as the weighed mass, replace those of the cell.
    drawn.update(payload.known)
    if set(drawn) == {"m"}:
        raise ConfigurationInconsistent(
            f"cell {cell.name!r}, payload {payload.name!r}",
            found="its mass alone",
            expected="its centre_m and inertia_kg_m2, because they are asked for",
            remedy="add them to the cell file and name it with --cell, or fit with the mass alone",
        )
    return replace(payload, known=drawn)


def calibration_of_case(case: CaseFit, created: datetime) -> Calibration:
    """Return the calibration of a case; it has the known parameters of the payloads with σ = 0."""
    calibration = calibration_of(case.fitted, created)
    condition = calibration.condition
    removed_names = set()
    if case.essential is not None:
        condition = case.essential.estimate.condition
        removed_names = {removal.name for removal in case.essential.removed}
    estimated = []
    for parameter in calibration.parameters:
        if parameter.name not in removed_names:
            estimated.append(parameter)
    given = _given_parameters(case.payloads)
    covariance_factor = _covariance_factor(calibration, estimated, given)
    payload_mass = []
    for mass in calibration.payload_mass:
        payload_mass.append(_with_parameters(mass, calibration.parameters, estimated, given))
    return replace(
        calibration,
        parameters=(*estimated, *given),
        condition=condition,
        covariance_factor=covariance_factor,
        payload_mass=tuple(payload_mass),
    )


def _given_parameters(payloads: Sequence[Payload]) -> list[Parameter]:
    """Return the known parameters of payloads, with σ = 0."""
    given = []
    for payload in payloads:
        for name, unit in zip(LINK_PARAMETERS, LINK_UNITS, strict=True):
            if name in payload.known:
                parameter = Parameter(
                    name=f"{name}:{payload.mounting}",
                    value=payload.known[name],
                    std=0.0,
                    unit=unit,
                )
                given.append(parameter)
    return given


def _covariance_factor(
    calibration: Calibration,
    estimated: Sequence[Parameter],
    given: Sequence[Parameter],
) -> tuple[tuple[float, ...], ...] | None:
    """Return the factor of the covariance of gains, estimated and given parameters;
    rows and columns of the given ones are zero.

    Args:
        calibration: of all parameters of the fit.
        estimated: those of them that a case leaves.
        given: parameters of the payloads.
    """
    covariance = calibration.covariance
    if covariance is None:
        return None
    gain_count = len(calibration.gains)
    names = [parameter.name for parameter in calibration.parameters]
    indices = list(range(gain_count))
    for parameter in estimated:
        indices.append(gain_count + names.index(parameter.name))
    of_estimated = covariance[np.ix_(indices, indices)]
    padded = np.pad(of_estimated, (0, len(given)))
    return factor_of(padded)


def _with_parameters(
    mass: PayloadMass,
    fitted: Sequence[Parameter],
    estimated: Sequence[Parameter],
    given: Sequence[Parameter],
) -> PayloadMass:
    """Return a payload's mass with the derivatives of other parameters.

    Args:
        mass: with the derivatives of the fitted parameters.
        fitted: all parameters of the fit.
        estimated: those of them that a case leaves.
        given: parameters of the payloads.
    """
    names = [parameter.name for parameter in fitted]
    per_kg_by_name = dict(zip(names, mass.parameters_per_kg, strict=True))
    of_estimated = [per_kg_by_name[parameter.name] for parameter in estimated]
    # A prediction is for the robot without the columns of a payload, so the given parameters have
    # no influence on it.
    of_given = [0.0] * len(given)
    return replace(mass, parameters_per_kg=(*of_estimated, *of_given))
