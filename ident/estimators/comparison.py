"""Comparison of estimators, their filters and scaling; the essential parameters (paper §4.2)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from ident.arrays import FloatArray
from ident.data.conditioning import Conditioning
from ident.data.run import Run
from ident.equations.reduction import reduce_runs, regrouped
from ident.equations.system import System
from ident.errors import IdentificationError
from ident.estimators.estimate import Estimate
from ident.estimators.least_squares import Scaling, ls, tls, wls
from ident.estimators.maximum_likelihood import iv, ml
from ident.model.model import Model

CUTOFF_FACTORS = (0.5, 1.0, 2.0)
"""Factors of both cut-offs: an estimator of the data alone has the same gains over two octaves."""


RATIO = 20.0  #: r_σ of essential parameters; the paper finds 10 to 30 right, depending on the noise


ESTIMATORS: dict[str, Callable[[System], Estimate]] = {
    "ls": ls,
    "wls": wls,
    "tls, unscaled": lambda system: tls(system, Scaling.NONE),
    "tls, rows (paper)": lambda system: tls(system, Scaling.ROWS),
    "tls, residuals": lambda system: tls(system, Scaling.RESIDUALS),
    "tls, columns": lambda system: tls(system, Scaling.COLUMNS),
    "tls, both": lambda system: tls(system, Scaling.BOTH),
    "ml": ml,
    "iv": iv,
}


@dataclass(frozen=True, slots=True)
class EstimatorTrial:
    """One estimator under one filter."""

    estimator: str  #: its name
    position_cutoff_hz: float  #: cut-off of the position filter
    decimation_cutoff_hz: float  #: cut-off of the decimation filter
    gains: FloatArray | None  #: Nm/A, shape (m,); None where it found none
    std: FloatArray | None  #: of the gains, same shape
    #: ‖ρ‖/‖Y‖ of the fit; it means nothing beside that of another filter
    relative_error_percent: float | None
    reason: str = ""  #: why there are no gains


@dataclass(frozen=True, slots=True)
class EstimatorComparison:
    """All trials, those of the declared filters first."""

    trials: tuple[EstimatorTrial, ...]

    @property
    def declared(self) -> tuple[EstimatorTrial, ...]:
        """Trials under the declared filters."""
        return self.trials[: len(ESTIMATORS)]

    def spread_percent(self, estimator: str) -> FloatArray | None:
        """Range of gains over the filters [% of their mean], shape (m,); None with a failure."""
        gains: list[FloatArray] = []
        for trial in self.trials:
            if trial.estimator != estimator:
                continue
            if trial.gains is None:
                return None
            gains.append(trial.gains)
        by_filter = np.stack(gains)
        gain_range = np.ptp(by_filter, axis=0)
        mean = by_filter.mean(axis=0)
        return np.asarray(100.0 * gain_range / np.abs(mean))


def try_estimators(
    model: Model,
    runs: Callable[[], Iterable[Run]],
    conditioning: Conditioning,
    progress: Callable[[str], None] = lambda _: None,
) -> EstimatorComparison:
    """Run every estimator under the declared filters, and under half and twice their cut-offs.

    Args:
        model: the declared model.
        runs: gives the runs of the fit, anew at each call.
        conditioning: the declared filters.
        progress: called with what is being done.

    Raises:
        DataUnfit: the runs cannot be used under the declared filters.
    """
    trials: list[EstimatorTrial] = []
    for factor in sorted(CUTOFF_FACTORS, key=lambda factor: factor != 1.0):
        position_hz = factor * conditioning.position_cutoff_hz
        decimation_hz = factor * conditioning.decimation_cutoff_hz
        filters = replace(
            conditioning, position_cutoff_hz=position_hz, decimation_cutoff_hz=decimation_hz
        )
        progress(f"estimators under {position_hz:g} Hz / {decimation_hz:g} Hz")
        try:
            reduced = reduce_runs(model, runs(), filters, instruments=True)
            system = regrouped(reduced)
        except IdentificationError as error:
            if factor == 1.0:
                raise
            trials += [_failed(name, filters, error) for name in ESTIMATORS]
            continue
        for name, estimator in ESTIMATORS.items():
            try:
                estimate = estimator(system)
            except IdentificationError as error:
                trials.append(_failed(name, filters, error))
                continue
            error_percent = estimate.relative_error(system).total
            trial = EstimatorTrial(
                estimator=name,
                position_cutoff_hz=position_hz,
                decimation_cutoff_hz=decimation_hz,
                gains=estimate.gains,
                std=estimate.gains_std,
                relative_error_percent=error_percent,
            )
            trials.append(trial)
    return EstimatorComparison(tuple(trials))


def _failed(estimator: str, filters: Conditioning, error: IdentificationError) -> EstimatorTrial:
    return EstimatorTrial(
        estimator=estimator,
        position_cutoff_hz=filters.position_cutoff_hz,
        decimation_cutoff_hz=filters.decimation_cutoff_hz,
        gains=None,
        std=None,
        relative_error_percent=None,
        reason=str(error),
    )


@dataclass(frozen=True, slots=True)
class Removal:
    """A base parameter that was taken out."""

    name: str  #: of the parameter
    std_percent: float  #: its relative standard deviation at that step (eq. 11) [%]


@dataclass(frozen=True, slots=True)
class Essential:
    """Essential parameters of a system, and the others that were taken out."""

    system: System  #: without the columns that were taken out
    estimate: Estimate  #: of that system
    removed: tuple[Removal, ...]  #: in the order in which they went
    #: the same estimate among all unknowns; a parameter that was taken out is zero and certain
    whole: Estimate


def essential(
    system: System, estimator: Callable[[System], Estimate], ratio: float = RATIO
) -> Essential:
    """Take out base parameters with a large relative σ, one by one.

    The one with the largest leaves, and the others are estimated again, until max/min of them is
    below r_σ. Gains, columns of effects and the payload's parameters are no base parameters of
    the robot: they stay.

    Args:
        system: with all base parameters.
        estimator: any; its own σ decide.
        ratio: r_σ.

    Raises:
        ValueError: a ratio of one or less leaves nothing.
        IdentificationError: the estimator refuses.
    """
    if not ratio > 1.0:
        raise ValueError(
            f"r_σ is {ratio:g}; it compares a largest with a smallest, so it must be above 1"
        )
    kept = list(range(len(system.columns)))
    removed: list[Removal] = []
    current = system
    estimate = estimator(system)
    base_count = len(system.base.independent)
    while True:
        candidates = sum(index < base_count for index in kept)
        std_percent = relative_std_percent(estimate.parameters, estimate.parameters_std)
        std_percent = std_percent[:candidates]
        if candidates < 2:
            break
        if float(np.max(std_percent)) < ratio * float(np.min(std_percent)):
            break
        worst = int(np.argmax(std_percent))
        name = system.columns[kept[worst]].name
        removed.append(Removal(name, float(std_percent[worst])))
        current = current.holding({worst: 0.0})
        del kept[worst]
        estimate = estimator(current)
    whole = _among_all_unknowns(estimate, system, kept)
    return Essential(current, estimate, tuple(removed), whole)


def _among_all_unknowns(estimate: Estimate, system: System, kept: list[int]) -> Estimate:
    """Estimate with the columns that were taken out: zero and certain.

    Args:
        estimate: without them.
        system: with all of them.
        kept: columns of the robot that were not taken out; those of payloads are behind them.
    """
    gain_count = system.axis_count
    count = len(system.unknowns)
    places = [*kept, *range(len(system.columns), count)]
    parameters = np.zeros(count)
    parameters[places] = estimate.parameters
    entries = [*range(gain_count), *(gain_count + place for place in places)]
    size = gain_count + count
    covariance = np.zeros((size, size))
    covariance[np.ix_(entries, entries)] = estimate.covariance
    return replace(estimate, unknowns=system.unknowns, parameters=parameters, covariance=covariance)


def relative_std_percent(values: FloatArray, std: FloatArray) -> FloatArray:
    """100 σ/|χ| (eq. 11) [%] of each value, shape (p,); infinite for a value of zero."""
    with np.errstate(divide="ignore", invalid="ignore"):
        percent = 100.0 * std / np.abs(values)
    return np.nan_to_num(percent, nan=np.inf, posinf=np.inf)
