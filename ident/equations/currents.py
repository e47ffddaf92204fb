"""The equations of the motors' currents, whitened: what maximum likelihood, weighing and error bars stand on.

The errors are those of the currents, e_i ~ (0, σ_i²). With D = diag(g_i σ_i), and τ the torque that links, friction and
payload need of each motor, W χ + W_uL χ_uL + W_kL χ_kL through T (DriveTrain.to_motor),

    e = T_D (V g − τ),    V = diag(v),    T_D = D⁻¹.

Each motor has an equation of its own then, and a triangle of its rows says all (`OwnCurrents`).

A redundantly driven robot has more motors than degrees of freedom: motors can work against each other. This internal
preload λ moves nothing and is not known, V g = τ + N λ with N the null space of Aᵀ (`ident.model.closed_chain`). The
most likely λ of each sample, for given g and σ, leaves

    e = T_D (V g − τ),    T_D = P D⁻¹,    P = 1 − D⁻¹N (NᵀD⁻²N)⁻¹ NᵀD⁻¹,

whose entries are the corrections of the currents in units of their σ: a total least squares, as before. P changes from
sample to sample, so the rows are kept (`PreloadedCurrents`). The columns of g are those of corrected currents: with
measured ones their noise would make the gains smaller (errors in variables; Golub & Van Loan, SIAM J. Numer. Anal. 17
(1980)).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ident.arrays import FloatArray, IntArray
from ident.equations.triangles import Triangles, solve, triangle_of

ROUNDS = 30  #: At most; σ and χ depend on each other
LONG = 20  #: So many rows a column are reduced to a triangle first


@dataclass(frozen=True, slots=True)
class Whitened:
    """e = drive g − linear χ − known, all rows below each other, in units of the noise.

    Each row has noise of one; with preload cov e = P, and ‖e‖² is still that of the likelihood, as P is a projection.
    """

    drive: FloatArray  #: per unit of each gain, shape (rows, m)
    linear: FloatArray  #: per unit of each parameter, shape (rows, p)
    known: FloatArray  #: of known payloads, shape (rows,)

    def residual(self, gains: FloatArray, parameters: FloatArray) -> FloatArray:
        """e, shape (rows,)."""
        return np.asarray(self.drive @ gains - self.linear @ parameters - self.known)

    def parameters(self, gains: FloatArray) -> FloatArray:
        """χ for given gains, by least squares, shape (p,)."""
        right = self.drive @ gains - self.known
        if len(right) < LONG * self.linear.shape[1]:
            return solve(self.linear, right)[0]
        factor = triangle_of(np.vstack((self.linear.T, right)))
        return solve(factor[:, :-1], factor[:, -1])[0]


class Currents(ABC):
    """Equations of m currents in (g, χ)."""

    @property
    @abstractmethod
    def rows(self) -> IntArray:
        """Equations of each motor, shape (m,)."""

    @abstractmethod
    def whitened(self, gains: FloatArray, noise: FloatArray) -> Whitened:
        """Equations in units of the noise.

        Args:
            gains: of each motor, for D, shape (m,).
            noise: σ of each current [A], shape (m,).
        """

    @abstractmethod
    def corrected(self, gains: FloatArray, noise: FloatArray, whitened: Whitened, residual: FloatArray) -> FloatArray:
        """Drive columns with the corrected currents, shape (rows, m): the derivative of e to each gain."""

    @abstractmethod
    def noise(
        self, gains: FloatArray, parameters: FloatArray, free: int = 0, before: FloatArray | None = None
    ) -> FloatArray:
        """σ of each current [A] around an estimate, shape (m,); 1 for a motor without rows.

        Args:
            gains, parameters: of the estimate.
            free: number of estimated parameters, which are shared among the motors.
            before: σ so far, for one round; None for as many rounds as it takes.
        """

    @abstractmethod
    def cost(self, gains: FloatArray, parameters: FloatArray, noise: FloatArray) -> float:
        """Cost that an estimate makes least: −log L up to constants, and with preload for this σ alone."""

    def settled(self, gains: FloatArray, free: int) -> tuple[FloatArray, FloatArray]:
        """χ and σ of each current [A] for given gains, shapes (p,) and (m,): a fixed point of a few rounds."""
        even = np.ones(len(gains))
        noise = self.noise(gains, self.whitened(gains, even).parameters(gains), free, even)
        for _ in range(ROUNDS):
            parameters = self.whitened(gains, noise).parameters(gains)
            updated = self.noise(gains, parameters, free, noise)
            if np.allclose(updated, noise, rtol=1e-10):
                break
            noise = updated
        return parameters, noise


@dataclass(frozen=True, slots=True)
class OwnCurrents(Currents):
    """Each motor's equation holds its own current alone."""

    triangles: Triangles  #: of each motor's rows [v_i | (T [W | W_uL])_i | (T W_kL χ_kL)_i]

    @property
    def rows(self) -> IntArray:
        """Equations of each motor, shape (m,)."""
        return self.triangles.rows

    def whitened(self, gains: FloatArray, noise: FloatArray) -> Whitened:
        """Scale each triangle by 1/(g σ)."""
        factors = self.triangles.factors
        scaled = [factor / scale for factor, scale in zip(factors, gains * noise, strict=True)]
        stacked = np.concatenate(scaled)
        drive = np.zeros((len(stacked), len(factors)))
        motor = np.repeat(np.arange(len(factors)), [len(factor) for factor in factors])
        drive[np.arange(len(stacked)), motor] = stacked[:, 0]
        return Whitened(drive, stacked[:, 1:-1], stacked[:, -1])

    def corrected(self, gains: FloatArray, noise: FloatArray, whitened: Whitened, residual: FloatArray) -> FloatArray:
        """Put the predicted current in place of the measured one."""
        del noise
        out = whitened.drive.copy()
        motor = np.repeat(np.arange(len(gains)), [len(factor) for factor in self.triangles.factors])
        out[np.arange(len(motor)), motor] -= residual / gains[motor]
        return out

    def noise(
        self, gains: FloatArray, parameters: FloatArray, free: int = 0, before: FloatArray | None = None
    ) -> FloatArray:
        """Root mean square of v − τ/g, which needs no rounds."""
        del before
        gamma = 1.0 / gains
        vectors = (np.concatenate(([1.0], -g * parameters, [-g])) for g in gamma)
        size = np.array(
            [float(np.sum((f @ vector) ** 2)) for f, vector in zip(self.triangles.factors, vectors, strict=True)]
        )
        size[self.rows == 0] = 1.0
        return np.asarray(np.sqrt(size / np.maximum(self.rows - free / len(gamma), 1.0)))

    def cost(self, gains: FloatArray, parameters: FloatArray, noise: FloatArray) -> float:
        """Σ r_i log ‖e_i‖, with each σ_i at its optimum."""
        del noise
        size = self.noise(gains, parameters) * np.sqrt(np.maximum(self.rows, 1.0))
        return float(self.rows @ np.log(size))


@dataclass(frozen=True, slots=True)
class PreloadedCurrents(Currents):
    """Motors that can work against each other: the rows of all of them, r a motor."""

    drive: FloatArray  #: V, torque at each axis per unit of each gain, without preload, shape (r, m, m)
    linear: FloatArray  #: W and W_uL, shape (r, m, p)
    known: FloatArray  #: W_kL χ_kL, shape (r, m)
    preload: FloatArray  #: N, orthonormal, shape (r, m, m − d)

    @classmethod
    def of_rows(cls, rows: Sequence[FloatArray], preload: FloatArray) -> PreloadedCurrents:
        """Sort the motors' rows [V_i | W_i | known_i], each of shape (r, m + p + 1).

        Args:
            rows: of each motor.
            preload: N of each row, shape (r, m, m − d).
        """
        stacked = np.stack(rows, axis=1)
        count = len(rows)
        return cls(stacked[:, :, :count], stacked[:, :, count:-1], stacked[:, :, -1], preload)

    @property
    def rows(self) -> IntArray:
        """Equations of each motor, shape (m,)."""
        return np.full(self.drive.shape[1], len(self.drive))

    def transform(self, gains: FloatArray, noise: FloatArray) -> FloatArray:
        """T_D of each row, shape (r, m, m)."""
        return whitening_transform(self.preload, gains, noise)

    def whitened(self, gains: FloatArray, noise: FloatArray) -> Whitened:
        """Take the most likely preload out of the rows, motor by motor below each other."""
        transform = self.transform(gains, noise)
        parts = transform @ self.drive, transform @ self.linear, (transform @ self.known[:, :, None])
        drive, linear, known = (np.swapaxes(part, 0, 1).reshape(-1, part.shape[2]) for part in parts)
        return Whitened(drive, linear, known[:, 0])

    def corrected(self, gains: FloatArray, noise: FloatArray, whitened: Whitened, residual: FloatArray) -> FloatArray:
        """Take the corrections σ e out of the measured currents."""
        count = len(gains)
        corrections = noise[:, None] * residual.reshape(count, -1)
        felt = np.swapaxes(self.transform(gains, noise), 0, 1)  # (m, r, m): a motor's current, without preload
        return np.asarray(whitened.drive - (felt * corrections.T).reshape(-1, count))

    def noise(
        self, gains: FloatArray, parameters: FloatArray, free: int = 0, before: FloatArray | None = None
    ) -> FloatArray:
        """σ of each current from its corrections, and from the share of its noise that they show, P_ii.

        The corrections of a motor hold only what the preload has left of its noise (variance components: Förstner,
        Allgemeine Vermessungs-Nachrichten 86 (1979)).
        """
        if before is None:
            noise = np.ones(len(gains))
            for _ in range(ROUNDS):
                before, noise = noise, self.noise(gains, parameters, free, noise)
                if np.allclose(before, noise, rtol=1e-10):
                    break
            return noise
        residual = self.whitened(gains, before).residual(gains, parameters).reshape(len(gains), -1)
        shown = np.einsum("rii->i", self.transform(gains, before) * (gains * before))
        return np.asarray(before * np.sqrt(np.sum(residual**2, axis=1) / np.maximum(shown - free / len(gains), 1.0)))

    def cost(self, gains: FloatArray, parameters: FloatArray, noise: FloatArray) -> float:
        """½ ‖e‖², for this σ."""
        residual = self.whitened(gains, noise).residual(gains, parameters)
        return 0.5 * float(residual @ residual)


def whitening_transform(preload: FloatArray, gains: FloatArray, noise: FloatArray) -> FloatArray:
    """T_D = P D⁻¹ of each row, shape (r, m, m).

    Args:
        preload: N, shape (r, m, m − d).
        gains: shape (m,).
        noise: σ of each current [A], shape (m,).
    """
    inverse = 1.0 / (gains * noise)
    scaled = inverse[:, None] * preload
    along = np.swapaxes(scaled, 1, 2)
    projection = np.eye(len(gains)) - scaled @ np.linalg.solve(along @ scaled, along)
    return np.asarray(projection * inverse)
