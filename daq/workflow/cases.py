"""The paper's cases 1 to 4 on the same logs:
what is known of the payload, and by which estimator (§4.2).
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
from ident.estimators.estimate import Identification
from ident.estimators.geometry_estimate import GeometryFinding
from ident.estimators.identify import each_run, estimate_with
from ident.estimators.least_squares import tls
from ident.estimators.method import Method
from ident.model.bodies import LINK_PARAMETERS, LINK_UNITS, Payload


@dataclass(frozen=True, slots=True)
class Case:
    """One way of identifying."""

    name: str  #: of its calibration file
    title: str  #: over its column of a table
    method: Method  #: estimator
    known: Known  #: of the payload
    gains_fixed: bool = False  #: hold the gains at the nameplate


CASES = (
    Case("manufacturer", "nameplate gains, WLS", Method.WLS, Known.NOTHING, gains_fixed=True),
    Case("case-1", "case 1: WLS, CAD", Method.WLS, Known.CAD),
    Case("case-2", "case 2: WLS, mass", Method.WLS, Known.MASS),
    Case("case-3", "case 3: TLS, CAD", Method.TLS, Known.CAD),
    Case("case-4", "case 4: TLS, mass", Method.TLS, Known.MASS),
    Case("ml", "ml, mass", Method.ML, Known.MASS),
)
"""The five sets of §4.3, and ours. The paper's WLS and TLS weight the rows of each joint."""


@dataclass(frozen=True, slots=True)
class ReducedLogs:
    """Logs of one cell, read once; what is known of a payload is chosen afterwards."""

    cell: Cell  #: as the logs describe it, or as given
    logs: tuple[Path, ...]  #: of the fit
    holdout: tuple[Path, ...]  #: those that it must not see
    sources: tuple[Source, ...]  #: all of them, with digests and roles
    used: System  #: of `logs`, in standard parameters
    unseen: System  #: of `holdout`, likewise
    geometry: GeometryFinding | None = None  #: what redundant encoders say of the geometry


@dataclass(frozen=True, slots=True)
class CaseFit:
    """A fit, and the payloads as they were declared to it."""

    fitted: Fit  #: without effects
    payloads: tuple[Payload, ...]  #: one for each mounting, as the fit took them
    essential: Essential | None  #: how its base parameters were chosen, None where all of them stay


def reduce_logs(
    logs: Sequence[Path],
    holdout: Sequence[Path] = (),
    cell: Cell | None = None,
    *,
    instruments: bool = False,
) -> ReducedLogs:
    """Read and reduce logs; the fit must not see those held out,
    and `cell` replaces the description in the logs.

    With instruments they can be fitted by ``iv`` too.

    Raises:
        DataError, ConfigurationError, IdentificationError: a log cannot be used, or not with the
            others.
        UsageError: the cell declares effects.
    """
    reading = LogLoader.of(logs, cell)
    refuse_effects(reading.cell, "--known, --cases")
    model = model_of(reading.cell)
    conditioning = reading.cell.conditioning
    used = reduce_runs(model, reading.runs(logs, "fit"), conditioning, instruments=instruments)
    rest = each_run(reading.runs(holdout, "holdout"), SeenRuns(), used.payloads)
    unseen = reduce_runs(model, rest, conditioning, payloads=used.payloads)
    return ReducedLogs(
        reading.cell,
        tuple(logs),
        tuple(holdout),
        tuple(reading.sources),
        used,
        unseen,
        reading.geometry(model),
    )


def fit_case(
    logs: ReducedLogs,
    method: Method,
    known: Known,
    *,
    gains_fixed: bool = False,
    ratio: float | None = None,
) -> CaseFit:
    """One fit of logs that were read; with a ratio r_σ, of its essential parameters alone.

    Raises:
        ConfigurationInconsistent: CAD values are asked for, and the cell has none.
        IdentificationError: see ident/estimators/identify.py.
    """
    payloads = tuple(payload_as(payload, logs.cell, known) for payload in logs.used.payloads)
    system = regrouped(replace(logs.used, payloads=payloads))
    require_distinct(system, gains=not gains_fixed)
    estimate = estimate_with(method, system, nameplate_of(logs.cell) if gains_fixed else None)
    rest = None
    if logs.unseen.runs:
        unseen = replace(logs.unseen, payloads=payloads)
        rest = regrouped(unseen, system.base, system.payload_columns)
    result = Identification(system.model, logs.cell.conditioning, system, rest, estimate)
    paper = None if gains_fixed else tls(system)
    start = Fit(
        cell=logs.cell,
        logs=logs.logs,
        holdout=logs.holdout,
        sources=logs.sources,
        identification=result,
        steps=(),
        paper=paper,
        given_cell=logs.cell,
        geometry=logs.geometry,
    )
    with named_causes(start.recordings):
        fitted = judged(start)
    if ratio is None:
        return CaseFit(fitted, payloads, None)
    return replace(essential_fit(fitted, ratio), payloads=payloads)


def essential_fit(fitted: Fit, ratio: float) -> CaseFit:
    """The same fit with its essential parameters alone (§4.2, by the ratio r_σ);
    the others are zero, and certain.

    Raises:
        IdentificationError: the estimator refuses.
        UsageError: the cell declares effects.
    """
    refuse_effects(fitted.cell, "--essential")
    before = fitted.identification
    estimate = before.estimate
    fixed = estimate.fixed_gains
    found = essential(
        before.system, lambda system: estimate_with(estimate.method, system, fixed), ratio
    )
    after = replace(fitted, identification=replace(before, estimate=found.whole))
    return CaseFit(after, before.system.payloads, found)


def payload_as(payload: Payload, cell: Cell, known: Known) -> Payload:
    """Reduce a payload to the knowledge of a case.

    Args:
        cell: whose payload of that name and mounting says what its drawing says.

    Raises:
        ConfigurationInconsistent: the drawing is asked for, and the cell says no more than the
            mass.
    """
    if known is Known.NOTHING:
        return replace(payload, known={})
    if known is Known.MASS:
        return replace(
            payload, known={name: value for name, value in payload.known.items() if name == "m"}
        )
    of_cell = next(
        (p for p in cell.payloads if (p.name, p.mounting) == (payload.name, payload.mounting)), None
    )
    drawn = {**({} if of_cell is None else of_cell.known), **payload.known}
    if set(drawn) == {"m"}:
        raise ConfigurationInconsistent(
            f"cell {cell.name!r}, payload {payload.name!r}",
            found="its mass alone",
            expected="its centre_m and inertia_kg_m2, because they are asked for",
            remedy="add them to the cell file and name it with --cell, or fit with the mass alone",
        )
    return replace(payload, known=drawn)


def calibration_of_case(case: CaseFit, created: datetime) -> Calibration:
    """Make the calibration; the known payload parameters are in it without deviation."""
    calibration = calibration_of(case.fitted, created)
    if case.essential is None:
        removed = set()
    else:
        removed = {removal.name for removal in case.essential.removed}
    found = []
    for payload in case.payloads:
        for name, unit in zip(LINK_PARAMETERS, LINK_UNITS, strict=True):
            if name in payload.known:
                found.append(
                    Parameter(f"{name}:{payload.mounting}", payload.known[name], 0.0, unit)
                )
    given = tuple(found)
    kept = tuple(parameter for parameter in calibration.parameters if parameter.name not in removed)
    if case.essential is None:
        condition = calibration.condition
    else:
        condition = case.essential.estimate.condition
    covariance = calibration.covariance
    gains = len(calibration.gains)
    factor = None
    if covariance is not None:
        names = [parameter.name for parameter in calibration.parameters]
        places = [*range(gains), *(gains + names.index(parameter.name) for parameter in kept)]
        factor = factor_of(np.pad(covariance[np.ix_(places, places)], (0, len(given))))
    payload_mass = tuple(
        _of_parameters(one, calibration.parameters, kept, given) for one in calibration.payload_mass
    )
    return replace(
        calibration,
        parameters=kept + given,
        condition=condition,
        covariance_factor=factor,
        payload_mass=payload_mass,
    )


def _of_parameters(
    reference: PayloadMass,
    before: Sequence[Parameter],
    kept: Sequence[Parameter],
    given: Sequence[Parameter],
) -> PayloadMass:
    """Return a payload's mass with its derivatives of the parameters that a case leaves,
    and zeros for given ones.
    """
    slopes = dict(
        zip((parameter.name for parameter in before), reference.parameters_per_kg, strict=True)
    )
    of_kept = tuple(slopes[parameter.name] for parameter in kept)
    # The columns of a payload are no part of the robot that predicts: what is given of it moves
    # nothing.
    return replace(reference, parameters_per_kg=(*of_kept, *(0.0 for _ in given)))
