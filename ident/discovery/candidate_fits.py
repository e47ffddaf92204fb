"""Candidates fitted in-sample beside the declared model: what they explain, motor by motor.

Every number here follows from sums over all rows of a motor: ΦᵀJ, ΦᵀΦ and Φᵀe. A refinement of
settings, and a screening of proposals, ask for nothing else (`fit_candidates`); a trial with folds
and moves (`ident.discovery.candidates`) begins with it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy import linalg

from ident.arrays import BoolArray, FloatArray, IntArray
from ident.equations.linearisation import CholeskyFactor, Folds, MotorRows

#: Whitened columns of a candidate on the rows of each motor that it loads, (p, rows), by motor
WhitenedColumns = Mapping[int, FloatArray]
Result = TypeVar("Result")

#: Columns tested together: enough for fast products, few enough to keep memory small
BATCH_COLUMNS = 48
#: Share of a column that must be left when all declared directions are projected out of it
REDUNDANT_SHARE = 1e-6
LARGEST_CONDITION = 1e10  #: Of a candidate's projected columns, in their own units


@dataclass(frozen=True, slots=True)
class CandidateFit:
    """Result of fitting one candidate to all rows."""

    coefficients: FloatArray  #: in the unit of the columns, shape (p,)
    fall_by_motor: FloatArray  #: fall of ‖e‖² of each motor, shape (m,)


def fit_candidates(
    folds: Folds, candidates: Iterable[tuple[int, WhitenedColumns]]
) -> tuple[CandidateFit | None, ...]:
    """Fit candidates, each given by its number of columns and these.

    The numbers are those of the trials of the same candidates; None where the declared model
    contains one already.
    """

    def fit(width: int, batch: Sequence[WhitenedColumns]) -> Sequence[CandidateFit | None]:
        return _fitted_together(folds, width, batch)

    return in_batches(candidates, fit)


def in_batches(
    candidates: Iterable[tuple[int, WhitenedColumns]],
    judge: Callable[[int, Sequence[WhitenedColumns]], Sequence[Result]],
) -> tuple[Result, ...]:
    """Judge candidates in batches of equal numbers of columns; the results in their order."""
    results: dict[int, Result] = {}
    waiting: dict[int, dict[int, WhitenedColumns]] = {}

    def finish(width: int) -> None:
        batch = waiting.pop(width)
        judged = judge(width, list(batch.values()))
        results.update(zip(batch, judged, strict=True))

    for number, (width, columns) in enumerate(candidates):
        batch = waiting.setdefault(width, {})
        batch[number] = columns
        if len(batch) * width >= BATCH_COLUMNS:
            finish(width)
    for width in tuple(waiting):
        finish(width)
    return tuple(results[number] for number in range(len(results)))


@dataclass(frozen=True, slots=True)
class MotorSums:
    """Products of c candidates of p columns with the rows of each motor."""

    jacobian: FloatArray  #: ΦᵀJ, shape (m, c, p, f)
    gram: FloatArray  #: ΦᵀΦ, shape (m, c, p, p)
    score: FloatArray  #: Φᵀe, shape (m, c, p)

    @classmethod
    def empty(cls, folds: Folds, count: int, width: int) -> MotorSums:
        """Zeros for so many candidates of so many columns."""
        problem = folds.linearisation
        motors = len(problem.gamma)
        shape = (motors, count, width)
        return cls(
            jacobian=np.zeros((*shape, problem.jacobian.width)),
            gram=np.zeros((*shape, width)),
            score=np.zeros(shape),
        )

    @property
    def squares(self) -> FloatArray:
        """‖φ‖² of each column on all rows, shape (c, p)."""
        return np.diagonal(self.gram.sum(axis=0), axis1=1, axis2=2)

    def only(self, chosen: IntArray) -> MotorSums:
        """The same of some of the candidates."""
        return MotorSums(
            self.jacobian[:, chosen],
            self.gram[:, chosen],
            self.score[:, chosen],
        )

    def put(
        self,
        own: MotorRows,
        numbers: IntArray,
        *,
        jacobian: FloatArray,
        gram: FloatArray,
        score: FloatArray,
    ) -> None:
        """Put the products of some candidates with the rows of a motor into their places.

        Args:
            own: the motor.
            numbers: of these candidates.
            jacobian: ΦᵀJ of the motor's own unknowns, shape (k, p, s).
            gram: ΦᵀΦ, shape (k, p, p).
            score: Φᵀe, shape (k, p).
        """
        unknowns = self.jacobian.shape[-1]
        of_every_unknown = np.zeros((*score.shape, unknowns))
        of_every_unknown[..., own.seen] = jacobian
        self.jacobian[own.motor, numbers] = of_every_unknown
        self.gram[own.motor, numbers] = gram
        self.score[own.motor, numbers] = score


def sums_over_motors(folds: Folds, width: int, candidates: Sequence[WhitenedColumns]) -> MotorSums:
    """Sum products of candidates over all rows of each motor, one matrix product a motor."""
    sums = MotorSums.empty(folds, len(candidates), width)
    for own in folds.motors:
        numbers = candidates_of_motor(candidates, own.motor)
        if not len(numbers):
            continue
        columns = np.stack([candidates[number][own.motor] for number in numbers])
        flat = columns.reshape(-1, columns.shape[-1])
        equations = own.equations[:-1]  # J and e
        products = flat @ equations.T
        products = products.reshape(len(numbers), width, -1)
        sums.put(
            own,
            numbers,
            jacobian=products[..., :-1],
            gram=columns @ np.swapaxes(columns, -1, -2),
            score=products[..., -1],
        )
    return sums


def candidates_of_motor(candidates: Sequence[WhitenedColumns], motor: int) -> IntArray:
    """Numbers of the candidates that load a motor, ascending, shape (k,)."""
    numbers = [number for number, columns in enumerate(candidates) if motor in columns]
    return np.array(numbers, dtype=np.int64)


@dataclass(frozen=True, slots=True)
class Projection:
    """Candidates with the declared directions projected out of them, Φ⊥ = Φ − J H⁻¹ JᵀΦ."""

    along: FloatArray  #: H⁻¹JᵀΦ, transposed, shape (c, p, f)
    gram: FloatArray  #: Φ⊥ᵀΦ⊥ on all rows, shape (c, p, p)
    score: FloatArray  #: Φ⊥ᵀe on all rows, shape (c, p)

    @classmethod
    def of(cls, folds: Folds, sums: MotorSums) -> Projection:
        """Project by the Cholesky factor of the declared model's JᵀJ."""
        crossed = sums.jacobian.sum(axis=0)
        along = solved(folds.full_factor, crossed)
        hessian = folds.motor_hessian.sum(axis=0)
        along_hessian = times_hessian(along, hessian)
        full_gram = sums.gram.sum(axis=0)
        gram = projected_gram(full_gram, crossed, along, along_hessian)
        declared_score = folds.motor_score.sum(axis=0)
        score = sums.score.sum(axis=0)
        score -= along @ declared_score
        return cls(along, gram, score)

    def only(self, chosen: IntArray) -> Projection:
        """The same of some of the candidates."""
        return Projection(
            self.along[chosen],
            self.gram[chosen],
            self.score[chosen],
        )

    def coefficients(self) -> FloatArray:
        """Best coefficients of each candidate, shape (c, p)."""
        right = self.score[..., None]
        solution = np.linalg.solve(self.gram, right)
        return np.asarray(solution[..., 0])


def fall_of_motors(
    folds: Folds, sums: MotorSums, along: FloatArray, coefficients: FloatArray
) -> FloatArray:
    """Fall of ‖e‖² of each motor with candidates in the model, shape (c, m).

    Args:
        folds: the problem.
        sums: products of the candidates.
        along: as of `Projection`.
        coefficients: of each candidate, shape (c, p).
    """
    score = sums.score - times_score(along, folds.motor_score)
    along_hessian = times_hessian(along, folds.motor_hessian)
    gram = projected_gram(sums.gram, sums.jacobian, along, along_hessian)
    linear = np.einsum("ncp,cp->cn", score, coefficients)
    square = np.einsum("cp,ncpq,cq->cn", coefficients, gram, coefficients)
    return np.asarray(2.0 * linear - square)


def is_new(gram: FloatArray, squares: FloatArray) -> BoolArray:
    """Mask of candidates that the declared model lacks, shape (c,).

    Args:
        gram: Φ⊥ᵀΦ⊥ of each candidate, shape (c, p, p).
        squares: ‖φ‖² of its columns, shape (c, p).
    """
    size = np.diagonal(gram, axis1=1, axis2=2)
    is_left = size > REDUNDANT_SHARE * squares
    new = np.asarray(np.all(is_left, axis=1))
    if gram.shape[-1] == 1:  # a single column has the condition one
        return new
    root = np.sqrt(size[new])
    units = root[:, :, None] * root[:, None, :]
    in_own_units = gram[new] / units
    new[new] = np.linalg.cond(in_own_units) <= LARGEST_CONDITION
    return new


def _fitted_together(
    folds: Folds, width: int, candidates: Sequence[WhitenedColumns]
) -> Sequence[CandidateFit | None]:
    """Fit candidates with the same number of columns."""
    sums = sums_over_motors(folds, width, candidates)
    projection = Projection.of(folds, sums)
    new = np.flatnonzero(is_new(projection.gram, sums.squares))
    results: list[CandidateFit | None] = [None] * len(candidates)
    if not len(new):
        return results
    projection = projection.only(new)
    coefficients = projection.coefficients()
    fall_by_motor = fall_of_motors(folds, sums.only(new), projection.along, coefficients)
    for place, number in enumerate(new):
        results[number] = CandidateFit(coefficients[place], fall_by_motor[place])
    return results


def solved(factor: CholeskyFactor, right: FloatArray) -> FloatArray:
    """H⁻¹JᵀΦ of each candidate, transposed, from ΦᵀJ, both of shape (c, p, f)."""
    flat = right.reshape(-1, right.shape[-1])
    solution = linalg.cho_solve(factor, flat.T)
    return np.asarray(solution.T.reshape(right.shape))


def times_hessian(along: FloatArray, hessian: FloatArray) -> FloatArray:
    """w H of each part, shape (…, c, p, f), from w, shape (c, p, f), and H, shape (…, f, f)."""
    flat = along.reshape(-1, along.shape[-1])
    product = flat @ hessian
    parts = hessian.shape[:-2]
    return product.reshape(*parts, *along.shape)


def times_score(along: FloatArray, scores: FloatArray) -> FloatArray:
    """w s of each part, shape (parts, c, p), from w, shape (c, p, f), and s, shape (parts, f)."""
    flat = along.reshape(-1, along.shape[-1])
    product = scores @ flat.T
    return product.reshape(-1, *along.shape[:-1])


def crossed_gram(first: FloatArray, second: FloatArray) -> FloatArray:
    """A Bᵀ of each candidate, shape (…, p, p), from A and B, shape (…, p, f)."""
    return np.asarray(first @ np.swapaxes(second, -1, -2))


def projected_gram(
    gram: FloatArray, jacobian: FloatArray, along: FloatArray, along_hessian: FloatArray
) -> FloatArray:
    """(Φ − J w)ᵀ(Φ − J w) of each part, shape (…, p, p).

    Args:
        gram: ΦᵀΦ, shape (…, p, p).
        jacobian: ΦᵀJ, shape (…, p, f).
        along: wᵀ, same shape.
        along_hessian: wᵀJᵀJ, same shape.
    """
    crossed = crossed_gram(jacobian, along)
    transposed = np.swapaxes(crossed, -1, -2)
    of_declared = crossed_gram(along_hessian, along)
    return gram - crossed - transposed + of_declared
