"""One error for every model and every data set: what a model leaves of each motor's current.

Of motor i, over the rows that count for it (Observation.motor_use), with γ_i = 1/g_i and T from the drive train,

    e_i = v_i − γ_i (T τ)_i,        ε_i = ‖e_i‖/‖v_i‖,        ε = √(Σ_i w_i²‖e_i‖² / Σ_i w_i²‖v_i‖²).

The current is what was measured: ‖v_i‖ is the same for every model of the same rows, while Y = V g (paper Table 6)
grows and shrinks with the gains that a model finds. The weights w turn currents of different motors into torques at the
joint, so that a robot without coupled axes has the ε of Table 6. They are one set of gains for all that is compared.
Whitened by σ_i instead, ε would have a yardstick that an accepted effect moves. A robot with prismatic and revolute
axes adds Nm to N in ε, as Table 6 would; its ε_i stand for themselves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident.estimate import Estimate
from ident.observation import Observation
from ident.relative_error import RelativeError, of_squares
from ident.residual import Folds

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class CurrentError:
    """Sums over rows, so that parts of the data can be put together.

    Attributes:
        size: ‖v_i‖² of each motor [A²], shape (n,).
        left: ‖e_i‖² [A²], same shape.
    """

    size: FloatArray
    left: FloatArray

    def __add__(self, other: CurrentError) -> CurrentError:
        """Of the rows of both."""
        return CurrentError(self.size + other.size, self.left + other.left)

    def relative(self, weights_nm_a: FloatArray) -> RelativeError:
        """ε_i and ε [%]; NaN for a motor without a row.

        Args:
            weights_nm_a: w, one set of gains for all that is compared, shape (n,).
        """
        return of_squares(self.size * weights_nm_a**2, self.left * weights_nm_a**2)


def error_on(observation: Observation, estimate: Estimate) -> CurrentError:
    """Of an estimate on rows, those of its fit or others with the same columns."""
    use, measured = observation.motor_use, observation.current
    asked = observation.drive_train.to_motor @ estimate.predicted_torque(observation)
    residual = measured - asked / estimate.gains[:, None]
    return CurrentError(np.sum(measured**2, axis=1, where=use), np.sum(residual**2, axis=1, where=use))


def error_left_out(folds: Folds) -> CurrentError:
    """Of each fold's rows, predicted by a fit that has not seen their moves."""
    problem = folds.problem
    size, left = np.zeros(len(problem.noise)), np.zeros(len(problem.noise))
    np.add.at(size, problem.motor, (problem.current * problem.noise[problem.motor]) ** 2)
    np.add.at(left, problem.motor, (folds.residual * problem.noise[problem.motor]) ** 2)
    return CurrentError(size, left)
