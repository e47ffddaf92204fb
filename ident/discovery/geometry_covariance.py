"""An identification with the geometry that the encoders of a redundant drive show, and what its σ does to the gains.

The corrections come from positions alone (`ident.estimators.geometry_estimate`), before any torque is looked at, so
that they cannot take up what belongs to gains or effects. The gains depend on them through all columns: for each
direction of their covariance, the rows are built and estimated once more with the geometry one step beside.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ident.arrays import FloatArray
from ident.discovery.evidence import Evidence, with_covariance
from ident.equations.observation import observe
from ident.errors import IdentificationError
from ident.estimators.estimate import Estimate, Identification
from ident.estimators.geometry_estimate import GeometryFinding
from ident.estimators.identify import estimate_with
from ident.model.geometry import GeometryChange
from ident.model.geometry_derivatives import model_with_geometry
from ident.model.model import Model

LEAST_STEP = 1e-4
"""Step [rad or m] of a refit whose difference is taken: far above the tolerance of the gains' iteration, and a tenth of
what bends gains by one percent."""


def geometry_covariance(found: Identification, described: Model, finding: GeometryFinding) -> FloatArray:
    """Covariance that the corrected geometry adds to (gains, parameters), shape (m + p, m + p).

    Other explanations of the same misfit are as likely: the largest difference that one of them makes counts as σ of
    one more direction.

    Args:
        found: with the corrected geometry and without effects; it has kept its rows.
        described: the model before the correction.
        finding: the corrections.

    Raises:
        IdentificationError: the estimate with a geometry beside the corrected one failed.
    """
    if found.gathered is None:
        raise IdentificationError("the identification has not kept its rows; expected identify(..., keep_rows=True)")
    center = _vector(found.estimate)
    parameters = [one.parameter for one in finding.corrections]
    values = np.array([one.change for one in finding.corrections])
    variance, ways = np.linalg.eigh(finding.covariance)
    shifts: list[FloatArray] = []
    for size, way in zip(np.sqrt(np.maximum(variance, 0.0)), ways.T, strict=True):
        step = max(LEAST_STEP, float(size))
        beside = values + step * way
        changes = [GeometryChange(*pair) for pair in zip(parameters, beside.tolist(), strict=True)]
        moved = _vector(_estimated(found, model_with_geometry(described, changes))) - center
        shifts.append(moved * (size / step))
    others = [_alternative(found, described, finding, number) - center for number in range(len(finding.alternatives))]
    if others:
        shifts.append(max(others, key=lambda shift: float(np.linalg.norm(shift[: len(found.estimate.gains)]))))
    columns = np.stack(shifts, axis=1)
    return np.asarray(columns @ columns.T)


def _alternative(found: Identification, described: Model, finding: GeometryFinding, number: int) -> FloatArray:
    """Gains and parameters with another explanation of the misfit."""
    changes = [GeometryChange(one.parameter, one.change) for one in finding.alternatives[number]]
    return _vector(_estimated(found, model_with_geometry(described, changes)))


def _vector(estimate: Estimate) -> FloatArray:
    return np.concatenate((estimate.gains, estimate.parameters))


def _estimated(found: Identification, model: Model) -> Estimate:
    """Estimate the runs of an identification with another geometry."""
    assert found.gathered is not None
    datasets, _ = found.gathered
    of_fit = datasets[: len(found.system.runs)]
    system = observe(model, of_fit, found.conditioning, found.system).system()
    fixed = found.estimate.gains if found.estimate.gains_fixed else None
    return estimate_with(found.estimate.method, system, fixed)


def with_geometry_covariance(found: Identification, covariance: FloatArray) -> Identification:
    """Add the uncertainty of the geometry to an estimate without effects."""
    estimate = found.estimate
    return replace(found, estimate=replace(estimate, covariance=estimate.covariance + covariance))


def evidence_with_geometry(evidence: Evidence, covariance: FloatArray) -> Evidence:
    """Add the uncertainty of the geometry to an estimate with effects, whose own parameters it leaves alone.

    Args:
        evidence: with effects.
        covariance: of (gains, parameters) without effects, as of `geometry_covariance`.
    """
    estimate = evidence.estimate
    gains = len(estimate.gains)
    leading = gains + len(evidence.training.base.names)
    effects = len(estimate.covariance) - len(covariance)
    every = np.arange(len(estimate.covariance))
    shared = np.delete(every, np.arange(leading, leading + effects))
    whole = estimate.covariance.copy()
    whole[np.ix_(shared, shared)] += covariance
    return with_covariance(evidence, whole)
