"""The result of an estimator, with its uncertainty and its relative error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ident.arrays import BoolArray, FloatArray

if TYPE_CHECKING:  # a calibration has relative errors, and reading one needs no LAPACK
    from ident.data.conditioning import Conditioning
    from ident.data.dataset import Dataset
    from ident.data.run_channels import RunChannels
    from ident.equations.instants import Instants
    from ident.equations.observation import Observation
    from ident.equations.system import System
    from ident.estimators.method import Method
    from ident.model.model import Column, Model

SAME_ERROR = 0.01
"""Share of an error by which another one may be larger and still be the same:
5.76 % and 5.76 % differ by chance.
"""


@dataclass(frozen=True, slots=True)
class RelativeError:
    """‖ρ‖/‖Y‖ of each axis and of all together [%]; only comparable under the same filter."""

    axes: tuple[float, ...]  #: of each axis [%]
    total: float  #: of all together [%]

    def at(self, place: int) -> float:
        """Error of an axis [%]; of all together for a joint without a motor (above the axes)."""
        if place < len(self.axes):
            return self.axes[place]
        return self.total


def relative_error(
    measured_nm: FloatArray, predicted_nm: FloatArray, use: BoolArray
) -> RelativeError:
    """‖ρ_j‖/‖Y_j‖ of each joint and of all together [%] (Table 6); NaN for a joint without rows.

    Args:
        measured_nm, predicted_nm: joint torque, shape (m, r).
        use: rows of each joint that count, shape (m, r).
    """
    size = np.sum(measured_nm**2, axis=1, where=use)
    return of_squares(size, np.sum((measured_nm - predicted_nm) ** 2, axis=1, where=use))


def of_squares(size: FloatArray, left: FloatArray) -> RelativeError:
    """Relative error from ‖Y_j‖² and ‖ρ_j‖² of each joint, both of shape (m,)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        axes = 100.0 * np.sqrt(left / size)
        total = 100.0 * np.sqrt(left.sum() / size.sum())
    return RelativeError(tuple(float(value) for value in axes), float(total))


@dataclass(frozen=True, slots=True)
class Estimate:
    """Gains and parameters, with their covariance and the condition of their equations."""

    method: Method  #: which estimator
    gains: FloatArray  #: g of each motor [Nm at the joint per A], shape (m,)
    gains_fixed: bool  #: the gains were given, not estimated
    unknowns: tuple[Column, ...]  #: name and unit of each parameter: χ, then χ_uL
    parameters: FloatArray  #: their values, shape (p,)
    #: of (gains, parameters), shape (m + p, m + p); gains' rows are zero where they were fixed
    covariance: FloatArray
    #: Standard deviation of the residual [Nm for joint equations, A for ml's motor equations],
    #: shape (m,).
    axis_noise: FloatArray
    singular_values: FloatArray  #: of the weighted observation matrix W_r (``tls``: of W_tot)
    #: of W_r, rows of a joint divided by the deviation of this estimate's residual, as in Table 5
    condition: float
    rows: int  #: equations used
    iterations: int = 0  #: of an iterative estimator

    @property
    def fixed_gains(self) -> FloatArray | None:
        """The gains that were given, shape (m,); None where they were estimated."""
        if self.gains_fixed:
            return self.gains
        return None

    @property
    def gains_std(self) -> FloatArray:
        """σ of each gain, shape (m,)."""
        return np.sqrt(np.diag(self.covariance)[: len(self.gains)])

    @property
    def parameters_std(self) -> FloatArray:
        """σ of each parameter, shape (p,)."""
        return np.sqrt(np.diag(self.covariance)[len(self.gains) :])

    def predicted_torque(self, observation: Observation) -> FloatArray:
        """W χ + W_uL χ_uL + W_kL χ_kL [Nm], shape (m, r)."""
        linear = [
            self.parameters @ observation.of_joint(joint) for joint in range(observation.axis_count)
        ]
        return np.stack(linear) + observation.known()

    def residual_torque(self, observation: Observation) -> FloatArray:
        """ρ = V g − W χ − … (eq. 13) [Nm], shape (m, r)."""
        return observation.torque(self.gains) - self.predicted_torque(observation)

    def relative_error(self, system: System) -> RelativeError:
        """‖ρ_j‖/‖Y_j‖ of each joint over its used rows, and of all together [%] (paper Table 6)."""
        rest = np.zeros(len(self.parameters))
        left = system.joints.square_sum(np.concatenate((self.gains, self.parameters, [1.0])))
        return of_squares(system.joints.square_sum(np.concatenate((self.gains, rest, [0.0]))), left)


@dataclass(frozen=True, slots=True)
class Identification:
    """An estimate with the equations it rests on, and those that it has not seen."""

    model: Model  #: the declared model
    conditioning: Conditioning  #: the filters
    system: System  #: of the fit
    #: of the runs that were held out, with the unknowns of the fit; None without any
    holdout: System | None
    estimate: Estimate  #: from ``system`` alone
    #: All runs, held-out runs last, and their rows; none unless they were asked for.
    gathered: tuple[tuple[Dataset, ...], Observation] | None = None
    channels: tuple[RunChannels, ...] = ()  #: faults of single channels of each run of the fit
    #: a few rows of each run of the fit, for `ident.estimators.turned_geometry`
    instants: tuple[Instants, ...] = ()

    @property
    def training_error(self) -> RelativeError:
        """Relative error on the rows of the fit [%]."""
        return self.estimate.relative_error(self.system)

    @property
    def holdout_error(self) -> RelativeError | None:
        """Relative error on held-out rows [%]; None without any."""
        if self.holdout is None:
            return None
        return self.estimate.relative_error(self.holdout)

    @property
    def current_residual(self) -> tuple[float, ...] | None:
        """Root mean square of what is left of each motor's current, as in a `Calibration`.

        None where a motor has no rows.
        """
        left = np.full(len(self.estimate.gains), np.nan)
        for system in (self.system, self.holdout):
            if system is not None:
                seen = system.motors.rows > 0
                size = system.currents.noise(self.estimate.gains, self.estimate.parameters)
                left[seen] = size[seen]
        if np.isfinite(left).all():
            return tuple(float(f"{one:.6g}") for one in left)
        return None
