"""The whitened equations of the motors' currents, for maximum likelihood, weighing and σ.

The errors are those of the currents, e_i ~ (0, σ_i²). With D = diag(g_i σ_i), and τ the torque that
links, friction and payload need of each motor, W χ + W_uL χ_uL + W_kL χ_kL through T
(DriveTrain.to_motor),

    e = T_D (V g − τ),    V = diag(v),    T_D = D⁻¹.

Each motor has an equation of its own then, and a triangle of its rows says all (`Currents`).

A redundantly driven robot has more motors than degrees of freedom: motors can work against each
other. This internal preload λ moves nothing and is not known, V g = τ + N λ with N the null space
of Aᵀ (`ident.model.closed_chain`). The most likely λ of each sample, for given g and σ, leaves

    e = T_D (V g − τ),    T_D = P D⁻¹,    P = 1 − D⁻¹N (NᵀD⁻²N)⁻¹ NᵀD⁻¹,

whose entries are the corrections of the currents in units of their σ: a total least squares, as
before. P changes from sample to sample, so the rows are kept (`PreloadedCurrents`). The columns of
g are those of corrected currents: with measured ones their noise would make the gains smaller
(errors in variables; Golub & Van Loan, SIAM J. Numer. Anal. 17 (1980)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ident.arrays import FloatArray, IntArray
from ident.equations.triangles import Triangles, least_squares, triangle_of

ROUNDS = 30  #: At most; σ and χ depend on each other
ROWS_FOR_TRIANGLE = 20  #: From so many rows a column on, they are reduced to a triangle first
SETTLED = 1e-10  #: Relative change of σ from round to round, below which it no longer changes


@dataclass(frozen=True, slots=True)
class Currents:
    """e = V g − W χ − W_kL χ_kL, rows of all motors; each holds the current of its motor alone.

    Whitened, each row has noise of one; with preload cov e = P, and ‖e‖² is still that of the
    likelihood, as P is a projection.
    """

    drive: FloatArray  #: V, per unit of each gain, shape (k, m)
    linear: FloatArray  #: W and W_uL, per unit of each parameter, shape (k, p)
    known: FloatArray  #: W_kL χ_kL, shape (k,)
    motor: IntArray  #: of each row, ascending, shape (k,)
    rows: IntArray  #: equations of each motor, of which these may be the triangle, shape (m,)

    @classmethod
    def of_motors(cls, triangles: Triangles) -> Currents:
        """Take apart the motors' rows [v_i | (T [W | W_uL])_i | (T W_kL χ_kL)_i]."""
        factors = triangles.factors
        count = len(factors)
        lengths = [len(factor) for factor in factors]
        motor = np.repeat(np.arange(count), lengths)
        stacked = np.concatenate(factors)
        row_count = len(stacked)
        rows = np.arange(row_count)
        own_current = stacked[:, 0]
        linear = stacked[:, 1:-1]
        known = stacked[:, -1]
        drive = np.zeros((row_count, count))
        drive[rows, motor] = own_current
        return cls(drive=drive, linear=linear, known=known, motor=motor, rows=triangles.rows)

    def residual(self, gains: FloatArray, parameters: FloatArray) -> FloatArray:
        """e, shape (k,)."""
        driven = self.drive @ gains
        explained = self.linear @ parameters
        return np.asarray(driven - explained - self.known)

    def parameters(self, gains: FloatArray) -> FloatArray:
        """χ for given gains, by least squares, shape (p,)."""
        driven = self.drive @ gains
        torque = driven - self.known
        if len(torque) < ROWS_FOR_TRIANGLE * self.linear.shape[1]:
            return least_squares(self.linear, torque)
        columns = np.vstack((self.linear.T, torque))
        factor = triangle_of(columns)
        linear = factor[:, :-1]
        right = factor[:, -1]
        return least_squares(linear, right)

    def whitened(self, gains: FloatArray, noise: FloatArray) -> Currents:
        """The equations in units of the noise.

        Args:
            gains: of each motor, for D, shape (m,).
            noise: σ of each current [A], shape (m,).
        """
        of_motor = gains * noise
        unit = of_motor[self.motor]
        row_unit = unit[:, None]
        return Currents(
            drive=self.drive / row_unit,
            linear=self.linear / row_unit,
            known=self.known / unit,
            motor=self.motor,
            rows=self.rows,
        )

    def corrected(
        self, gains: FloatArray, noise: FloatArray, whitened: Currents, residual: FloatArray
    ) -> FloatArray:
        """Drive columns with the corrected currents, shape (k, m): the derivative of e to g."""
        del noise
        rows = np.arange(len(residual))
        corrected = whitened.drive.copy()
        corrected[rows, self.motor] -= residual / gains[self.motor]
        return corrected

    def noise(
        self,
        gains: FloatArray,
        parameters: FloatArray,
        free: int = 0,
        before: FloatArray | None = None,
    ) -> FloatArray:
        """σ of each current [A] around an estimate, shape (m,); 1 for a motor without rows.

        Args:
            gains, parameters: of the estimate.
            free: number of estimated parameters, which are shared among the motors.
            before: σ so far, for one round; None for as many rounds as it takes. The root mean
                square of v − τ/g needs none.
        """
        del before
        count = len(gains)
        torque_nm = self.residual(gains, parameters)
        current_a = torque_nm / gains[self.motor]
        square_sum = np.bincount(self.motor, current_a**2, minlength=count)
        square_sum[self.rows == 0] = 1.0
        freedom = np.maximum(self.rows - free / count, 1.0)
        return np.asarray(np.sqrt(square_sum / freedom))

    def cost(self, gains: FloatArray, parameters: FloatArray, noise: FloatArray) -> float:
        """Cost of an estimate, Σ r_i log ‖e_i‖ at the best σ_i; with preload for this σ.

        Args:
            gains: shape (m,).
            parameters: shape (p,).
            noise: σ of each current [A], shape (m,); used with preload alone.
        """
        del noise
        std = self.noise(gains, parameters)
        size = std * np.sqrt(np.maximum(self.rows, 1.0))
        return float(self.rows @ np.log(size))

    def settled(self, gains: FloatArray, free: int) -> tuple[FloatArray, FloatArray]:
        """χ and σ of each current [A] for given gains, (p,) and (m,), by a few rounds."""
        even = np.ones(len(gains))
        parameters = self.whitened(gains, even).parameters(gains)
        noise = self.noise(gains, parameters, free, even)
        for _ in range(ROUNDS):
            parameters = self.whitened(gains, noise).parameters(gains)
            updated = self.noise(gains, parameters, free, noise)
            if np.allclose(updated, noise, rtol=SETTLED, atol=0.0):
                break
            noise = updated
        return parameters, noise


@dataclass(frozen=True, slots=True)
class PreloadedCurrents(Currents):
    """Motors that can work against each other: r rows a motor, each with the currents of all."""

    preload: FloatArray  #: N of each row of a motor, orthonormal, shape (r, m, m − d)

    @classmethod
    def of_rows(cls, rows: Sequence[FloatArray], preload: FloatArray) -> PreloadedCurrents:
        """Take apart the motors' rows [V_i | W_i | known_i], each of shape (r, m + p + 1).

        Args:
            rows: of each motor.
            preload: N of each row, shape (r, m, m − d).
        """
        count = len(rows)
        rows_of_motor = len(preload)
        stacked = np.concatenate(rows)
        motor = np.repeat(np.arange(count), rows_of_motor)
        row_counts = np.full(count, rows_of_motor)
        return cls(
            drive=stacked[:, :count],
            linear=stacked[:, count:-1],
            known=stacked[:, -1],
            motor=motor,
            rows=row_counts,
            preload=preload,
        )

    def transform(self, gains: FloatArray, noise: FloatArray) -> FloatArray:
        """T_D of each row, shape (r, m, m)."""
        return whitening_transform(self.preload, gains, noise)

    def whitened(self, gains: FloatArray, noise: FloatArray) -> Currents:
        """Take the most likely preload out of the rows.

        Args:
            gains: shape (m,).
            noise: σ of each current [A], shape (m,).
        """
        transform = self.transform(gains, noise)
        count = len(gains)

        def without_preload(columns: FloatArray) -> FloatArray:
            # Σ_j (T_D)_rij X_jrc of each motor i and row r
            of_motors = columns.reshape(count, len(transform), -1)
            torque = np.einsum("rij,jrc->irc", transform, of_motors, optimize=True)
            return np.asarray(torque).reshape(columns.shape)

        return Currents(
            drive=without_preload(self.drive),
            linear=without_preload(self.linear),
            known=without_preload(self.known),
            motor=self.motor,
            rows=self.rows,
        )

    def corrected(
        self, gains: FloatArray, noise: FloatArray, whitened: Currents, residual: FloatArray
    ) -> FloatArray:
        """Take the corrections σ e out of the measured currents: drive columns, shape (m r, m).

        Args:
            gains: shape (m,).
            noise: σ of each current [A], shape (m,).
            whitened: the rows without preload.
            residual: e, of the rows of one motor after the other, shape (m r,).
        """
        of_motors = residual.reshape(len(gains), -1)
        corrections = noise[:, None] * of_motors
        transform = self.transform(gains, noise)
        # (T_D)_rij c_jr: what the correction of motor j changes in the row of motor i
        change = np.einsum("rij,jr->irj", transform, corrections)
        drive = whitened.drive
        return np.asarray(drive - change.reshape(drive.shape))

    def noise(
        self,
        gains: FloatArray,
        parameters: FloatArray,
        free: int = 0,
        before: FloatArray | None = None,
    ) -> FloatArray:
        """σ of each current [A], shape (m,).

        It follows from its corrections and the share of its noise that they show, P_ii.

        The corrections of a motor have only what the preload has left of its noise (variance
        components: Förstner, Allgemeine Vermessungs-Nachrichten 86 (1979)).
        """
        count = len(gains)
        if before is None:
            noise = np.ones(count)
            for _ in range(ROUNDS):
                before = noise
                noise = self.noise(gains, parameters, free, noise)
                if np.allclose(before, noise, rtol=SETTLED, atol=0.0):
                    break
            return noise
        whitened = self.whitened(gains, before)
        residual = whitened.residual(gains, parameters)
        of_motors = residual.reshape(count, -1)
        square_sum = np.sum(of_motors**2, axis=1)
        # Σ_r P_rii, with P = T_D D
        projection = self.transform(gains, before) * (gains * before)
        visible = np.einsum("rii->i", projection)
        freedom = np.maximum(visible - free / count, 1.0)
        variance_ratio = square_sum / freedom
        return np.asarray(before * np.sqrt(variance_ratio))

    def cost(self, gains: FloatArray, parameters: FloatArray, noise: FloatArray) -> float:
        """½ ‖e‖², for this σ; arguments as for `Currents.cost`."""
        whitened = self.whitened(gains, noise)
        residual = whitened.residual(gains, parameters)
        return 0.5 * float(residual @ residual)


def whitening_transform(preload: FloatArray, gains: FloatArray, noise: FloatArray) -> FloatArray:
    """T_D = P D⁻¹ of each row, shape (r, m, m).

    Args:
        preload: N, shape (r, m, m − d).
        gains: shape (m,).
        noise: σ of each current [A], shape (m,).
    """
    inverse = 1.0 / (gains * noise)
    scaled = inverse[:, None] * preload  # D⁻¹N
    transposed = np.swapaxes(scaled, 1, 2)  # NᵀD⁻¹
    components = np.linalg.solve(transposed @ scaled, transposed)
    projection = np.eye(len(gains)) - scaled @ components
    return np.asarray(projection * inverse)
