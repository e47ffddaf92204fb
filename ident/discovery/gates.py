"""Limits of the search, and gates that are no matter of one score: physics, runs left out, gains, effects together.

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
from ident.equations.linearisation import RIDGE, Folds, cut_into_folds, sum_of_squares
from ident.equations.rows import Observation
from ident.estimators.estimate import Estimate
from ident.model.model import Column

SIGMAS = 2.0  #: A coefficient outside its possible values by more than this many σ is impossible
MIN_RUNS = 3  #: With two runs, one left out leaves a fit of the other alone
CONFIDENCE = 0.95  #: Of a coefficient that is not zero; one-sided, of a rise by more than noise


@dataclass(frozen=True, slots=True)
class Gates:
    """Limits that a candidate must pass before it may join the model."""

    false_alarm: float = 0.01  #: largest probability that noise makes one this strong anywhere
    folds_better: float = 0.75  #: least share of folds on which the candidate lowers the error
    explained: float = 0.03  #: least share of the motor's squared residual
    error_fall: float = 0.02  #: least relative fall of the motor's error on held-out moves
    # With few moves the bootstrap has little power, and a correct prediction is evidence of another kind.
    strong_folds: float = 0.875  #: as `folds_better`, for a strong candidate
    strong_fall: float = 0.1  #: as `error_fall`, for a strong candidate
    strong_false_alarm: float = 0.05  #: as `false_alarm`, for a strong candidate
    draws: int = 999  #: number of draws of the bootstrap

    @property
    def smallest_share(self) -> float:
        """Share of a motor's squared residual below which an effect fails a gate, if held-out moves fall as all do."""
        return max(self.explained, 1.0 - (1.0 - self.error_fall) ** 2)


def impossible(columns: Sequence[Column], values: FloatArray, deviations: FloatArray, tolerance: float = SIGMAS) -> str:
    """Name the coefficients that are outside their possible values by more than a number of σ; empty without any."""
    found = []
    for column, value, std in zip(columns, values, deviations, strict=True):
        size = f"{column.name} is {value:.3g} ± {std:.2g} {column.unit}; physics allows"
        if value < column.least - tolerance * std:
            found.append(f"{size} no less than {column.least:g}")
        elif value > column.largest + tolerance * std:
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
class _Others:
    """A fit of all runs but one."""

    factor: tuple[FloatArray, bool]  #: Cholesky factor of JᵀJ
    score: FloatArray  #: Jᵀe, shape (f,)


@dataclass(frozen=True, slots=True)
class RunsLeftOut:
    """A linearised problem cut into runs: each is predicted by a fit of the others."""

    search_problem: SearchProblem  #: the problem
    run_of: IntArray  #: run of each of its clusters, shape (clusters,)
    others: tuple[_Others | None, ...]  #: of each run, None for one that stays; empty where none can be left out

    @classmethod
    def of(cls, search_problem: SearchProblem) -> RunsLeftOut:
        """Cut a search problem into its runs."""
        folds, observation = search_problem.folds, search_problem.observation
        left_out, run_of = runs_to_leave_out(observation), folds.linearisation.of_clusters(observation.run)
        if not left_out:
            return cls(search_problem, run_of, ())
        hessian, score = folds.cluster_hessian, folds.cluster_score

        def others(run: int) -> _Others | None:
            if run not in left_out:
                return None
            rest = run_of != run
            return _Others(_factor(hessian[rest].sum(axis=0)), score[rest].sum(axis=0))

        return cls(search_problem, run_of, tuple(map(others, range(len(observation.runs)))))

    def change(self, columns: FloatArray) -> PairedChange:
        """Change of the error on runs left out when whitened columns, shape (rows, p), join the model."""
        folds = self.search_problem.folds
        problem, observation, phi = folds.linearisation, self.search_problem.observation, columns.T
        count, width, unknowns = len(self.others), len(phi), problem.jacobian.width
        # ΦᵀΦ, Φᵀe and ΦᵀJ of each run.
        grams, scores = np.zeros((count, width, width)), np.zeros((count, width))
        crossed = np.zeros((count, width, unknowns))
        for motor in folds.motors:
            run_of, own = self.run_of[motor.cluster], phi[:, motor.rows]
            np.add.at(grams, run_of, motor.sums(own, own))
            beside = motor.sums(own, motor.equations)
            np.add.at(scores, run_of, beside[..., -2])
            for run in np.unique(run_of):
                crossed[run][:, motor.seen] += beside[run_of == run][..., :-2].sum(axis=0)
        unit = np.sqrt(np.maximum(np.diag(grams.sum(axis=0)), np.finfo(np.float64).tiny))
        # What the fit of the others predicts of each run, without the columns, and what these change of it.
        steps, coefficients = np.zeros((count, 2, unknowns)), np.zeros((count, width))
        for run, fit in enumerate(self.others):
            if fit is None:
                continue
            rest = crossed.sum(axis=0) - crossed[run]
            along = linalg.cho_solve(fit.factor, rest.T).T
            left = grams.sum(axis=0) - grams[run] - rest @ along.T
            drive = scores.sum(axis=0) - scores[run] - along @ fit.score
            coefficients[run] = np.linalg.pinv(left / np.outer(unit, unit), rcond=UNSEEN) @ (drive / unit) / unit
            steps[run] = linalg.cho_solve(fit.factor, fit.score), coefficients[run] @ along
        without, turned = np.concatenate(
            [motor.predicted(list(steps[self.run_of[motor.cluster]])) for motor in folds.motors], axis=1
        )
        run_of_row = self.run_of[problem.cluster]
        before = problem.residual - without
        after = before + turned - np.einsum("rp,rp->r", columns, coefficients[run_of_row])
        shown = np.array([fit is not None for fit in self.others])[run_of_row]
        return compare_by_move((after**2 - before**2)[shown], observation.move[problem.source[shown]])

    def refusal(self, columns: FloatArray) -> str:
        """Why whitened columns may not join; empty where they may, or where no run can be left out."""
        if not self.others or not (change := self.change(columns)).is_rise:
            return ""
        return f"the squared error on runs left out rises by {change.rise:.3g} ± {change.std:.2g} noise variances"


def whitened_columns(search_problem: SearchProblem, effect: Effect, axis: int) -> FloatArray:
    """Columns of an effect beside the Jacobian of a search problem, shape (rows, p)."""
    torque = search_problem.torque(effect, axis)
    return search_problem.folds.linearisation.whitened(torque, search_problem.model.drive_train.to_motor)


@dataclass(frozen=True, slots=True)
class Reduced:
    """A joint fit without some of its effects."""

    search_problem: SearchProblem  #: linearised around the joint fit, without their columns
    columns: FloatArray  #: these, whitened, per unit of each coefficient, shape (rows, p)
    torque: FloatArray  #: whitened torque of these effects together, shape (rows,)

    @property
    def gain_shifts(self) -> FloatArray:
        """Shift of each gain by these effects [Nm at the joint per A], shape (m,)."""
        return gain_shifts(self.search_problem.folds, self.torque)


def own_unknowns(estimate: Estimate, effects: Sequence[PlacedEffect]) -> IntArray:
    """Places of the coefficients of effects among the parameters of an estimate, shape (p,)."""
    names = {column.name for placed in effects for column in placed.columns}
    return np.array([index for index, column in enumerate(estimate.unknowns) if column.name in names])


def values_of(estimate: Estimate, own: IntArray) -> FloatArray:
    """Values of some parameters, what was applied to the description of the robot included, shape (p,)."""
    applied = np.array([estimate.unknowns[index].about for index in own])
    return np.asarray(estimate.parameters[own] + applied)


def without_effects_of(search_problem: SearchProblem, estimate: Estimate, effects: Sequence[PlacedEffect]) -> Reduced:
    """Take effects out of a joint fit, to first order, without a refit.

    Args:
        search_problem: linearised around the joint fit.
        estimate: the joint fit.
        effects: in the fit.
    """
    own = own_unknowns(estimate, effects)
    problem = search_problem.folds.linearisation
    taken = np.isin(problem.free, len(estimate.gains) + own)
    columns = problem.jacobian.columns(np.flatnonzero(taken)) / problem.scale[taken]
    torque = columns @ values_of(estimate, own)
    rest = problem.jacobian.only(np.flatnonzero(~taken))
    for place, motor in enumerate(problem.free[problem.free < len(estimate.gains)]):
        # ∂(γ τ)/∂g = −γ² τ, and τ loses these effects; with preload ∂e/∂g_i = (T_D)_i (v_i − σ_i e_i), in all rows.
        lost, scale = torque[problem.rows_of(motor)], problem.scale[place]
        if problem.transform is None:
            rest.parts[motor][rest.seen[motor] == place] += lost * problem.gamma[motor] * scale
            continue
        for other, (part, seen) in enumerate(zip(rest.parts, rest.seen, strict=True)):
            passed = problem.transform[problem.source[problem.rows_of(other)], other, motor]
            part[seen == place] += lost * passed * problem.noise[motor] * scale
    # Around the estimate, from which the torque was taken.
    residual = problem.residual + problem.jacobian @ search_problem.step + torque
    step = linalg.cho_solve(_factor(sum_of_squares(rest)), rest.on_columns(residual))
    reduced = replace(
        problem,
        jacobian=rest,
        residual=residual - rest @ step,
        free=problem.free[~taken],
        scale=problem.scale[~taken],
    )
    # The rows keep their order: they are dealt to the same folds again.
    folds = cut_into_folds(reduced, move_of=problem.of_clusters(search_problem.observation.move))
    return Reduced(replace(search_problem, folds=folds, step=step), columns, torque)


def gain_shifts(folds: Folds, torque: FloatArray) -> FloatArray:
    """Shift of each gain when a whitened torque, shape (rows,), joins the model [Nm at the joint per A], shape (m,)."""
    count = len(folds.linearisation.gamma)
    return shifts_by(folds, torque, max(count, int(folds.linearisation.free[-1]) + 1))[:count]


def shifts_by(folds: Folds, torque: FloatArray, size: int) -> FloatArray:
    """Shift of (gains, parameters), size of them, when a whitened torque, shape (rows,), joins the model.

    It is zero for what is fixed and for what the problem does not hold.
    """
    problem, shifts = folds.linearisation, np.zeros(size)
    score = problem.jacobian.on_columns(problem.correlated(torque))
    shifts[problem.free] = -linalg.cho_solve(folds.estimate_factor, score) * problem.scale
    return shifts


def moved_gains(shifts: FloatArray, gains_std: FloatArray) -> tuple[tuple[int, float], ...]:
    """Index of each gain that moves by more than its σ, and by how many; fixed gains do not move."""
    times = np.divide(np.abs(shifts), gains_std, where=gains_std > 0.0, out=np.zeros_like(shifts))
    return tuple((motor, float(size)) for motor, size in enumerate(times) if size > 1.0)


def _factor(hessian: FloatArray) -> tuple[FloatArray, bool]:
    """Cholesky factor of JᵀJ; directions that the rows do not show stay where they are."""
    regular = hessian + RIDGE * np.diag(np.diag(hessian))
    factor, _ = linalg.cho_factor(regular, lower=True)
    return factor, True
