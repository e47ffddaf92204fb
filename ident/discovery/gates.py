"""Gates that are no matter of one score: physics, runs left out, gains, and every effect against all the others.

A column declares which values physics allows its coefficient (`ident.model.model.Column`); `impossible` compares an
estimate with them. `RunsLeftOut` predicts whole runs without and with a candidate: moves of one run share its
temperature, payload and wear, so moves left out alone flatter an effect that only this recording has. Both errors are
compared move by move (`compare_by_move`): with d_m the rise of the squared error in move m of M,

    Σ d_m > t_(95 %, M − 1) · √(M/(M − 1) Σ (d_m − mean)²)

is a rise by more than noise. `without_effects_of` takes effects out of a joint fit again. No refit is needed: at the
optimum the residual is orthogonal to all columns, so without Φ with the coefficients c it becomes e + Φ⊥ c, Φ⊥ being
what the other columns J leave of Φ, and the other unknowns move by (JᵀJ)⁻¹JᵀΦ c. The derivative to a gain is the
torque of its motor, so it changes with Φ c too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy  # loads scipy.special when it is first used: a fit needs none of it
from scipy import linalg

from ident.arrays import FloatArray, IntArray
from ident.discovery.candidates import UNSEEN, SearchProblem
from ident.effects.effect import Effect, PlacedEffect
from ident.equations.linearisation import Folds, cut_into_folds
from ident.equations.rows import Observation
from ident.estimators.estimate import Estimate
from ident.model.model import Column

SIGMAS = 2.0  #: A coefficient outside its possible values by more than this many σ is impossible
MIN_RUNS = 3  #: With two runs, one left out leaves a fit of the other alone
CONFIDENCE = 0.95  #: Of a coefficient that is not zero; one-sided, of a rise by more than noise
_RIDGE = 1e-10  #: Share of the diagonal of JᵀJ added to it


def impossible(columns: Sequence[Column], values: FloatArray, deviations: FloatArray) -> str:
    """Name the coefficients that are outside their possible values by more than SIGMAS σ; empty without any."""
    found = []
    for column, value, std in zip(columns, values, deviations, strict=True):
        size = f"{column.name} is {value:.3g} ± {std:.2g} {column.unit}; physics allows"
        if value < column.least - SIGMAS * std:
            found.append(f"{size} no less than {column.least:g}")
        elif value > column.largest + SIGMAS * std:
            found.append(f"{size} no more than {column.largest:g}")
    return ", ".join(found)


def in_noise(values: FloatArray, covariance: FloatArray, confidence: float = CONFIDENCE) -> str:
    """Why coefficients, shape (p,), may all be zero by Wald's test; empty where they may not."""
    wald = float(values @ np.linalg.pinv(covariance, hermitian=True) @ values)
    probability = float(scipy.special.chdtrc(len(values), wald))
    return "" if probability <= 1.0 - confidence else f"its coefficients may all be zero (p = {probability:.2f})"


@dataclass(frozen=True, slots=True)
class PairedChange:
    """Change of a squared error on the same rows, and its noise by the scatter of moves."""

    rise: float  #: Σ ‖e‖² after − before; negative where the error falls
    std: float  #: its σ
    moves: int  #: number of moves with rows

    @property
    def is_rise(self) -> bool:
        """Whether the error rises by more than its noise."""
        return self.moves > 1 and self.rise > float(scipy.special.stdtrit(self.moves - 1, CONFIDENCE)) * self.std


def compare_by_move(change: FloatArray, move: IntArray) -> PairedChange:
    """Sum the change of each row's squared error, shape (r,), with σ by clusters of moves, shape (r,)."""
    by_move = np.bincount(np.unique(move, return_inverse=True)[1], change)
    count = len(by_move)
    spread = np.sum((by_move - by_move.mean()) ** 2) * count / max(count - 1, 1)
    return PairedChange(float(by_move.sum()), float(np.sqrt(spread)), count)


def runs_to_leave_out(observation: Observation) -> tuple[int, ...]:
    """Runs that can be left out: of at least MIN_RUNS, those whose payload, or lack of one, is in another run too."""
    runs = np.unique(observation.run)
    mounted = np.array([observation.mounting[observation.run == run][0] for run in runs])
    if len(runs) < MIN_RUNS:
        return ()
    return tuple(int(run) for run, own in zip(runs, mounted, strict=True) if np.sum(mounted == own) > 1)


@dataclass(frozen=True, slots=True)
class _Run:
    """Rows of one run, and what a fit of all other runs predicts of them."""

    rows: IntArray  #: indices among those of the problem, shape (k,)
    move: IntArray  #: of each row, shape (k,)
    residual: FloatArray  #: e of the rows, shape (k,)
    #: Cholesky factor of JᵀJ of the other runs, and their Jᵀe; None for a run that cannot be left out.
    others: tuple[tuple[FloatArray, bool], FloatArray] | None


@dataclass(frozen=True, slots=True)
class RunsLeftOut:
    """A linearised problem cut into runs: each is predicted by a fit of the others."""

    search_problem: SearchProblem  #: the problem
    runs: tuple[_Run, ...]  #: its runs; none where no run can be left out

    @classmethod
    def of(cls, search_problem: SearchProblem) -> RunsLeftOut:
        """Cut a search problem into its runs."""
        problem, observation = search_problem.folds.problem, search_problem.observation
        left_out = runs_to_leave_out(observation)
        if not left_out:
            return cls(search_problem, ())
        run_of = observation.run[problem.source]
        parts = [(run, np.flatnonzero(run_of == run)) for run in np.unique(run_of)]
        grams = [problem.jacobian[rows].T @ problem.jacobian[rows] for _, rows in parts]
        scores = [problem.residual[rows] @ problem.jacobian[rows] for _, rows in parts]
        gram, score = sum(grams[1:], grams[0]), sum(scores[1:], scores[0])
        return cls(
            search_problem,
            tuple(
                _Run(
                    rows,
                    observation.move[problem.source[rows]],
                    problem.residual[rows],
                    (_factor(gram - own_gram), score - own_score) if run in left_out else None,
                )
                for (run, rows), own_gram, own_score in zip(parts, grams, scores, strict=True)
            ),
        )

    def change(self, columns: FloatArray) -> PairedChange:
        """Change of the error on runs left out when whitened columns, shape (rows, p), join the model."""
        problem = self.search_problem.folds.problem
        inside, jacobian = ([array[run.rows] for run in self.runs] for array in (columns, problem.jacobian))
        crossed = [of_run.T @ own for of_run, own in zip(jacobian, inside, strict=True)]
        gram, score = columns.T @ columns, columns.T @ problem.residual
        unit = np.sqrt(np.maximum(np.diag(gram), np.finfo(np.float64).tiny))
        changes, moves = [], []
        for run, of_run, own, own_crossed in zip(self.runs, jacobian, inside, crossed, strict=True):
            if run.others is None:
                continue
            factor, pull = run.others
            rest = sum(crossed[1:], crossed[0]) - own_crossed
            along = linalg.cho_solve(factor, rest)
            left = gram - own.T @ own - along.T @ rest
            drive = score - own.T @ run.residual - along.T @ pull
            fitted = np.linalg.pinv(left / np.outer(unit, unit), rcond=UNSEEN) @ (drive / unit) / unit
            before = run.residual - of_run @ linalg.cho_solve(factor, pull)
            changes.append((before - (own - of_run @ along) @ fitted) ** 2 - before**2)
            moves.append(run.move)
        return compare_by_move(np.concatenate(changes), np.concatenate(moves))

    def refusal(self, columns: FloatArray) -> str:
        """Why whitened columns may not join; empty where they may, or where no run can be left out."""
        if not self.runs or not (change := self.change(columns)).is_rise:
            return ""
        return f"the squared error on runs left out rises by {change.rise:.3g} ± {change.std:.2g} noise variances"


def whitened_columns(search_problem: SearchProblem, effect: Effect, axis: int) -> FloatArray:
    """Columns of an effect beside the Jacobian of a search problem, shape (rows, p)."""
    torque = search_problem.torque(effect, axis)
    return search_problem.folds.problem.whitened(torque, search_problem.model.drive_train.to_motor)


@dataclass(frozen=True, slots=True)
class Reduced:
    """A joint fit without some of its effects."""

    search_problem: SearchProblem  #: linearised around the joint fit, without their columns
    columns: FloatArray  #: these, whitened, per unit of each coefficient, shape (rows, p)
    torque: FloatArray  #: whitened torque of these effects together, shape (rows,)

    @property
    def gain_shifts(self) -> FloatArray:
        """Shift of each gain by these effects [Nm at the joint per A], shape (n,)."""
        return gain_shifts(self.search_problem.folds, self.torque)


def own_unknowns(estimate: Estimate, effects: Sequence[PlacedEffect]) -> IntArray:
    """Places of the coefficients of effects among the parameters of an estimate, shape (p,)."""
    names = {column.name for placed in effects for column in placed.columns}
    return np.array([index for index, column in enumerate(estimate.unknowns) if column.name in names])


def without_effects_of(search_problem: SearchProblem, estimate: Estimate, effects: Sequence[PlacedEffect]) -> Reduced:
    """Take effects out of a joint fit, to first order, without a refit.

    Args:
        search_problem: linearised around the joint fit.
        estimate: the joint fit.
        effects: in the fit.
    """
    own = own_unknowns(estimate, effects)
    problem, observation = search_problem.folds.problem, search_problem.observation
    taken = np.isin(problem.free, len(estimate.gains) + own)
    columns = problem.jacobian[:, taken] / problem.scale[taken]
    torque = columns @ estimate.parameters[own]
    rest = problem.jacobian[:, ~taken]
    for place, motor in enumerate(problem.free[problem.free < len(estimate.gains)]):
        # ∂(γ τ)/∂g = −γ² τ, and τ loses these effects.
        rows = problem.motor == motor
        rest[rows, place] += torque[rows] * problem.gamma[motor] * problem.scale[place]
    absorbed = linalg.cho_solve(_factor(rest.T @ rest), rest.T @ torque)
    reduced = replace(
        problem,
        jacobian=rest,
        residual=problem.residual + torque - rest @ absorbed,
        free=problem.free[~taken],
        scale=problem.scale[~taken],
    )
    _, first = np.unique(problem.cluster, return_index=True)
    # The rows keep their order: they are dealt to the same folds again.
    folds = cut_into_folds(reduced, move_of=observation.move[problem.source[first]])
    return Reduced(replace(search_problem, folds=folds), columns, torque)


def gain_shifts(folds: Folds, torque: FloatArray) -> FloatArray:
    """Shift of each gain when a whitened torque, shape (rows,), joins the model [Nm at the joint per A], shape (n,)."""
    count = len(folds.problem.gamma)
    return shifts_by(folds, torque, max(count, int(folds.problem.free[-1]) + 1))[:count]


def shifts_by(folds: Folds, torque: FloatArray, size: int) -> FloatArray:
    """Shift of (gains, parameters), size of them, when a whitened torque, shape (rows,), joins the model.

    It is zero for what is fixed and for what the problem does not hold.
    """
    problem, shifts = folds.problem, np.zeros(size)
    shifts[problem.free] = -linalg.cho_solve(folds.full_factor, problem.jacobian.T @ torque) * problem.scale
    return shifts


def moved_gains(shifts: FloatArray, gains_std: FloatArray) -> tuple[tuple[int, float], ...]:
    """Index of each gain that moves by more than its σ, and by how many; fixed gains do not move."""
    times = np.divide(np.abs(shifts), gains_std, where=gains_std > 0.0, out=np.zeros_like(shifts))
    return tuple((motor, float(size)) for motor, size in enumerate(times) if size > 1.0)


def _factor(hessian: FloatArray) -> tuple[FloatArray, bool]:
    """Cholesky factor of JᵀJ; directions that the rows do not show stay where they are."""
    regular = hessian + _RIDGE * np.diag(np.diag(hessian))
    return linalg.cho_factor(regular, lower=True)
