"""Essential parameters: the few base parameters that these data need (paper §4.2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ident.estimate import Estimate
from ident.system import System

FloatArray = NDArray[np.float64]

RATIO = 20.0
"""r_σ; the paper finds 10 to 30 right, depending on the noise."""


@dataclass(frozen=True, slots=True)
class Removal:
    """A base parameter that was taken out, and its relative standard deviation at that step (eq. 11) [%]."""

    name: str
    std_percent: float


@dataclass(frozen=True, slots=True)
class Essential:
    """What is left, and what was taken out.

    Attributes:
        system: without the columns that were taken out.
        estimate: of that system.
        removed: in the order in which they went.
        whole: the same estimate among all unknowns; a parameter that was taken out is zero and certain.
    """

    system: System
    estimate: Estimate
    removed: tuple[Removal, ...]
    whole: Estimate


def essential(system: System, estimator: Callable[[System], Estimate], ratio: float = RATIO) -> Essential:
    """Take out the base parameter with the largest relative σ, estimate again, until max/min of them is below r_σ.

    Gains, columns of effects and the payload's parameters are no base parameters of the robot: they stay.

    Args:
        system: with all base parameters.
        estimator: any; its own σ decide.
        ratio: r_σ.

    Raises:
        ValueError: a ratio of one or less leaves nothing.
        IdentificationError: the estimator refuses.
    """
    if not ratio > 1.0:
        raise ValueError(f"r_σ is {ratio:g}; it compares a largest with a smallest, so it must be above 1")
    kept = list(range(len(system.columns)))
    removed: list[Removal] = []
    current, estimate = system, estimator(system)
    while True:
        candidates = sum(index < len(system.base.independent) for index in kept)
        relative = relative_std_percent(estimate.parameters, estimate.parameters_std)[:candidates]
        if candidates < 2 or float(np.max(relative)) < ratio * float(np.min(relative)):
            break
        worst = int(np.argmax(relative))
        removed.append(Removal(system.columns[kept[worst]].name, float(relative[worst])))
        current = current.holding({worst: 0.0})
        del kept[worst]
        estimate = estimator(current)
    return Essential(current, estimate, tuple(removed), _among_all(estimate, system, kept))


def relative_std_percent(values: FloatArray, std: FloatArray) -> FloatArray:
    """100 σ/|χ| (eq. 11) [%]; infinite for a value of zero."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.nan_to_num(100.0 * std / np.abs(values), nan=np.inf, posinf=np.inf)


def _among_all(estimate: Estimate, system: System, kept: list[int]) -> Estimate:
    count, every = system.joint_count, len(system.unknowns)
    places = [*kept, *range(len(system.columns), every)]
    parameters = np.zeros(every)
    parameters[places] = estimate.parameters
    within = [*range(count), *(count + place for place in places)]
    covariance = np.zeros((count + every,) * 2)
    covariance[np.ix_(within, within)] = estimate.covariance
    return replace(estimate, unknowns=system.unknowns, parameters=parameters, covariance=covariance)
