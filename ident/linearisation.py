"""The problem around an estimate as a linear one: whitened residuals and their Jacobian, motor by motor.

e_i = (v_i − γ_i (T τ)_i)/σ_i with the unknowns (g_1 … g_n, χ, χ_uL); see estimators/maximum_likelihood.py. The gain
direction is built from the *predicted* torque, not the measured current, so that the noise does not enter it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ident.observation import Observation

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Linearisation:
    """Rows of all motors below each other, motor 1 first.

    Attributes:
        jacobian: ∂(γ (T τ)/σ) per unit of each free unknown in its own scale, shape (rows, f).
        residual: whitened, shape (rows,).
        current: measured, whitened: what the residual is relative to, shape (rows,).
        motor: of each row, shape (rows,).
        cluster: move of each row, numbered 0 … without gaps, shape (rows,).
        source: index of each row among the observation's decimated rows, shape (rows,).
        gamma: 1/g, shape (n,).
        noise: σ_i [A], shape (n,).
        free: which of (gains, parameters) are free, shape (f,).
        scale: unit of each free unknown: a step of one in the scaled unknown is this much of the real one, shape (f,).
    """

    jacobian: FloatArray
    residual: FloatArray
    current: FloatArray
    motor: IntArray
    cluster: IntArray
    source: IntArray
    gamma: FloatArray
    noise: FloatArray
    free: IntArray
    scale: FloatArray

    @property
    def moves(self) -> int:
        """Number of clusters."""
        return int(self.cluster.max()) + 1

    def ordered(self, order: IntArray) -> Linearisation:
        """The same rows in another order."""
        return replace(
            self,
            jacobian=self.jacobian[order],
            residual=self.residual[order],
            current=self.current[order],
            motor=self.motor[order],
            cluster=self.cluster[order],
            source=self.source[order],
        )

    def whitened(self, torque_nm: FloatArray, to_motor: FloatArray) -> FloatArray:
        """Joint torque columns, shape (n, extra, r), as columns beside the Jacobian, shape (rows, extra).

        Args:
            torque_nm: per unit of each column.
            to_motor: T (DriveTrain.to_motor).
        """
        columns = np.zeros((len(self.motor), torque_nm.shape[1]))
        felt = [bool(np.any(torque)) for torque in torque_nm]
        for motor, row in enumerate(to_motor):
            rows = np.flatnonzero(self.motor == motor)
            for joint in np.flatnonzero(row):
                if felt[joint]:
                    weight = row[joint] * self.gamma[motor] / self.noise[motor]
                    columns[rows] += weight * torque_nm[joint][:, self.source[rows]].T
        return columns


def linearise(
    observation: Observation, gains: FloatArray, parameters: FloatArray, noise: FloatArray, *, gains_fixed: bool
) -> Linearisation:
    """Around given gains [Nm/A], parameters and current noise [A] of each motor."""
    linear, known = observation.motor_torque()
    count = len(gains)
    gamma = 1.0 / gains
    jacobian, residual, currents, motors, clusters, sources = [], [], [], [], [], []
    for motor in range(count):
        used = np.flatnonzero(observation.motor_use[motor])
        columns = linear[motor][:, used]
        torque = parameters @ columns + known[motor, used]
        rows = np.zeros((len(used), count + len(parameters)))
        # ∂(γ τ)/∂g = −γ² τ; in units of the gain itself, −γ τ.
        rows[:, motor] = -gamma[motor] * torque / noise[motor]
        rows[:, count:] = columns.T * (gamma[motor] / noise[motor])
        jacobian.append(rows)
        residual.append((observation.current[motor, used] - gamma[motor] * torque) / noise[motor])
        currents.append(observation.current[motor, used] / noise[motor])
        motors.append(np.full(len(used), motor))
        clusters.append(observation.move[used])
        sources.append(used)
    matrix = np.concatenate(jacobian)
    free = np.arange(count if gains_fixed else 0, matrix.shape[1])
    norms = np.linalg.norm(matrix, axis=0)
    unit = np.concatenate((gains, np.divide(1.0, norms[count:], where=norms[count:] > 0, out=np.ones(len(parameters)))))
    matrix[:, count:] *= unit[count:]
    return Linearisation(
        jacobian=matrix[:, free],
        residual=np.concatenate(residual),
        current=np.concatenate(currents),
        motor=np.concatenate(motors),
        cluster=np.unique(np.concatenate(clusters), return_inverse=True)[1].astype(np.int64),
        source=np.concatenate(sources),
        gamma=gamma,
        noise=noise,
        free=free,
        scale=unit[free],
    )
