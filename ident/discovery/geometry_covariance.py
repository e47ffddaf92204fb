"""The geometry that the encoders of a redundant drive show, and what its σ does to the gains.

The corrections come from positions alone (`ident.estimators.geometry_estimate`), before any torque
is looked at, so that they cannot take up what belongs to gains or effects. The gains depend on them
through all columns: for each direction of their covariance, the rows are built and estimated once
more with the geometry one step beside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ident.arrays import FloatArray
from ident.discovery.evidence import Evidence, with_estimate
from ident.equations.observation import observe
from ident.errors import IdentificationError
from ident.estimators.estimate import Estimate, Identification
from ident.estimators.geometry_estimate import GeometryFinding
from ident.estimators.identify import estimate_with
from ident.model.geometry import GeometryChange, model_with_geometry
from ident.model.model import Column, Model

LEAST_STEP = 1e-4
"""Step [rad or m] of a refit whose difference is taken:
far above the tolerance of the gains' iteration, and a tenth of what bends gains by one percent.
"""


def geometry_covariance(
    found: Identification, described: Model, finding: GeometryFinding
) -> FloatArray:
    """Covariance that the corrected geometry adds to (gains, parameters), shape (m + p, m + p).

    Other explanations of the same misfit are as likely: the one that moves the gains by most of
    their σ counts as σ of one more direction. Where the gains are fixed, it is the one that moves
    the parameters by most.

    Args:
        found: with the corrected geometry and without effects; it has kept its rows.
        described: the model before the correction.
        finding: the corrections.

    Raises:
        IdentificationError: the estimate with a geometry beside the corrected one failed.
    """
    if found.gathered is None:
        raise IdentificationError(
            "the identification has not kept its rows; expected identify(..., keep_rows=True)"
        )
    center = _gains_and_parameters(found.estimate)
    parameters = [one.parameter for one in finding.corrections]
    values = np.array([one.change for one in finding.corrections])
    variance, directions = np.linalg.eigh(finding.covariance)
    deviations = np.sqrt(np.maximum(variance, 0.0))
    shifts: list[FloatArray] = []
    for std, direction in zip(deviations, directions.T, strict=True):
        step = max(LEAST_STEP, float(std))
        beside = values + step * direction
        changes = [GeometryChange(*pair) for pair in zip(parameters, beside.tolist(), strict=True)]
        moved = _estimated(found, described, changes) - center
        shifts.append(moved * (std / step))
    others: list[FloatArray] = []
    for alternative in finding.alternatives:
        changes = [GeometryChange(one.parameter, one.change) for one in alternative]
        others.append(_estimated(found, described, changes) - center)
    if others:
        largest = max(others, key=lambda shift: shift_in_sigmas(shift, found.estimate))
        shifts.append(largest)
    columns = np.stack(shifts, axis=1)
    return np.asarray(columns @ columns.T)


def shift_in_sigmas(shift: FloatArray, estimate: Estimate) -> float:
    """Size of a shift of (gains, parameters), shape (m + p,), in σ of the gains.

    Beside fixed gains it is in σ of the parameters. A gain of 100 Nm/A that moves by 1 moves less
    than one of 1 Nm/A that moves by 0.1.
    """
    gains = len(estimate.gains)
    if estimate.gains_fixed:
        part = slice(gains, None)
    else:
        part = slice(gains)
    std = np.sqrt(np.diag(estimate.covariance))[part]
    in_sigmas = np.zeros_like(std)
    np.divide(shift[part], std, out=in_sigmas, where=std > 0.0)
    return float(np.linalg.norm(in_sigmas))


def _gains_and_parameters(estimate: Estimate) -> FloatArray:
    return np.concatenate((estimate.gains, estimate.parameters))


def _estimated(
    found: Identification, described: Model, changes: Sequence[GeometryChange]
) -> FloatArray:
    """Gains and parameters by the runs of an identification with another geometry."""
    assert found.gathered is not None
    datasets, _ = found.gathered
    model = model_with_geometry(described, changes)
    of_fit = datasets[: len(found.system.runs)]
    system = observe(model, of_fit, found.conditioning, found.system).system()
    first = found.estimate
    return _gains_and_parameters(estimate_with(first.method, system, first.fixed_gains))


def with_geometry_covariance(found: Identification, covariance: FloatArray) -> Identification:
    """Add the uncertainty of the geometry, shape (m + p, m + p), to an estimate without effects."""
    estimate = found.estimate
    return replace(found, estimate=replace(estimate, covariance=estimate.covariance + covariance))


def evidence_with_geometry(
    evidence: Evidence, covariance: FloatArray, unknowns: Sequence[Column]
) -> Evidence:
    """Add the uncertainty of the geometry to an estimate with effects.

    The parameters of the effects stay as they are. Rows are found by the names of the parameters:
    where gravity was turned, there are other base parameters. Those that are new have no part in
    it.

    Args:
        evidence: with effects.
        covariance: of (gains, parameters) without effects, as of `geometry_covariance`.
        unknowns: these parameters, in the order of the covariance.
    """
    estimate = evidence.estimate
    gains = len(estimate.gains)
    place_of = {column.name: gains + number for number, column in enumerate(estimate.unknowns)}
    targets = list(range(gains))
    sources = list(range(gains))
    for source, column in enumerate(unknowns, start=gains):
        if column.name in place_of:
            targets.append(place_of[column.name])
            sources.append(source)
    total = estimate.covariance.copy()
    total[np.ix_(targets, targets)] += covariance[np.ix_(sources, sources)]
    return with_estimate(evidence, replace(estimate, covariance=total))
