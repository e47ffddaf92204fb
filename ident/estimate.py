"""What an estimator found, and its certificate."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from ident.model import Column
from ident.observation import Observation
from ident.relative_error import RelativeError, of_squares
from ident.system import System

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


class Method(Enum):
    """The estimators, by the names technicians use."""

    LS = "ls"
    WLS = "wls"
    TLS = "tls"
    ML = "ml"


@dataclass(frozen=True, slots=True)
class Estimate:
    """Gains and parameters of one observation.

    Attributes:
        method: which estimator.
        gains: g of each motor [Nm at the joint per A], shape (n,).
        gains_fixed: the gains were given, not estimated.
        unknowns: name and unit of each parameter: χ, then χ_uL.
        parameters: their values, shape (p,).
        covariance: of (gains, parameters), shape (n + p, n + p); gains' rows are zero where they were fixed.
        axis_noise: standard deviation of the residual [Nm for joint equations, A for ml's motor equations], shape (n,).
        singular_values: of the weighted observation matrix W_r (``tls``: of W_tot).
        condition: of W_r, rows of a joint divided by the deviation of this estimate's residual, as in Table 5.
        rows: equations used.
        iterations: of an iterative estimator.
    """

    method: Method
    gains: FloatArray
    gains_fixed: bool
    unknowns: tuple[Column, ...]
    parameters: FloatArray
    covariance: FloatArray
    axis_noise: FloatArray
    singular_values: FloatArray
    condition: float
    rows: int
    iterations: int = 0

    @property
    def gains_std(self) -> FloatArray:
        """σ of each gain, shape (n,)."""
        return np.sqrt(np.diag(self.covariance)[: len(self.gains)])

    @property
    def parameters_std(self) -> FloatArray:
        """σ of each parameter, shape (p,)."""
        return np.sqrt(np.diag(self.covariance)[len(self.gains) :])

    def predicted_torque(self, observation: Observation) -> FloatArray:
        """W χ + W_uL χ_uL + W_kL χ_kL [Nm], shape (n, r): what the model says the joints need."""
        return np.asarray(np.einsum("jpr,p->jr", observation.linear(), self.parameters) + observation.known())

    def residual_torque(self, observation: Observation) -> FloatArray:
        """ρ = V g − W χ − … (eq. 13) [Nm], shape (n, r)."""
        return observation.torque(self.gains) - self.predicted_torque(observation)

    def relative_error(self, system: System) -> RelativeError:
        """‖ρ_j‖/‖Y_j‖ of each joint over its used rows, and of all together [%] (paper Table 6)."""
        rest = np.zeros(len(self.parameters))
        left = system.joints.square_sum(np.concatenate((self.gains, self.parameters, [1.0])))
        return of_squares(system.joints.square_sum(np.concatenate((self.gains, rest, [0.0]))), left)
