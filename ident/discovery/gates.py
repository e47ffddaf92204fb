"""Limits of the search, and gates beside the scores: physics, parts left out, gains, other effects.

A column declares which values physics allows its coefficient (`ident.model.model.Column`);
`impossible` compares an estimate with them. `PartsLeftOut` predicts parts of the data without and
with a candidate: whole runs, because moves of one run share its temperature, payload and wear; or,
where no run can be left out, regions of the workspace, because neighbouring moves of one trajectory
share their postures. Moves left out alone flatter an effect that holds in this recording, or here,
only. How the errors of each motor change is judged by `ident.discovery.error_change`.
`without_effects_of` takes effects out of a joint fit again. No refit is needed: at the optimum the
residual is orthogonal to all columns, so without Φ with the coefficients c it becomes e + Φ⊥ c, Φ⊥
being what the other columns J leave of Φ, and the other unknowns move by (JᵀJ)⁻¹JᵀΦ c. The
derivative to a gain is the torque of its motor, so it changes with Φ c too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from math import ceil

import numpy as np
import scipy  # loads scipy.special when it is first used: a fit needs none of it
from scipy import linalg

from ident.arrays import BoolArray, FloatArray, IntArray, require_count, require_number
from ident.discovery.candidates import SMALLEST_SINGULAR, SearchProblem
from ident.discovery.error_change import ErrorChange, change_of_errors, describe_noise
from ident.effects.effect import Effect, PlacedEffect
from ident.equations.linearisation import (
    RIDGE,
    CholeskyFactor,
    Folds,
    cut_into_folds,
    lower_factor,
    sum_of_squares,
)
from ident.equations.observation import Observation
from ident.errors import ModelError
from ident.estimators.estimate import Estimate
from ident.model.model import Column

SIGMAS = 2.0  #: A coefficient outside its possible values by more than this many σ is impossible
AMPLITUDE_SIGMAS = 3.0  #: An amplitude is at least this many σ at every angle
MIN_RUNS = 3  #: With two runs, one left out leaves a fit of the other alone
REGIONS = 8  #: Of the workspace, that are left out in turn where no run can be
MOVES_OF_REGION = 2  #: Fewest moves of a region
CONFIDENCE = 0.95  #: Of a coefficient that is not zero
CERTAIN_DELAY_SIGMAS = 5.0
"""σ by which a delay that explains little must differ from zero.

A wrong zero that explains little bends gains, and a delay of a millisecond does not: it may wait
for more data. Without this limit, one of 28 clean cells had a position late by 0.7 ms, 4 σ, and an
elastic gear one that was early by 0.5 ms (docs/evidence/effects-study.md).
"""


@dataclass(frozen=True, slots=True)
class Gates:
    """Limits that a candidate must pass before it may join the model."""

    false_alarm: float = 0.01  #: largest probability that noise makes one this strong anywhere
    folds_better: float = 0.75  #: least share of folds on which the candidate lowers the error
    explained: float = 0.03  #: least share of the motor's squared residual
    error_fall: float = 0.02  #: least relative fall of the motor's error on left-out moves
    # With few moves the bootstrap has little power, and a correct prediction is evidence of another
    # kind.
    strong_folds: float = 0.875  #: as `folds_better`, for a strong candidate
    strong_fall: float = 0.1  #: as `error_fall`, for a strong candidate
    strong_false_alarm: float = 0.05  #: as `false_alarm`, for a strong candidate
    draws: int = 999  #: number of draws of the bootstrap

    @property
    def smallest_share(self) -> float:
        """Share of a motor's squared residual below which an effect fails a gate.

        Held-out moves are taken to fall as all do.
        """
        smallest_fall = 1.0 - (1.0 - self.error_fall) ** 2
        return max(self.explained, smallest_fall)


def require_gates(gates: Gates) -> None:
    """Refuse limits that are no shares, and a number of draws that is none, or with which no
    candidate can be as unlikely as asked.

    Raises:
        ModelError: for the limit.
    """
    for field in fields(gates):
        label = f"{field.name} of the gates"
        value = getattr(gates, field.name)
        if field.name == "draws":
            if not require_count(label, value, remedy="999 is usual"):
                raise ModelError(f"{label} is 0; expected at least 1; 999 is usual")
            continue
        share = require_number(label, value, remedy=f"{field.default:g} is usual")
        if not 0.0 <= share <= 1.0:
            raise ModelError(
                f"{label} is {share:g}; expected a share from 0 to 1; {field.default:g} is usual"
            )
    # The smallest probability that draws can show is 1/(draws + 1).
    smallest_probability = 1.0 / (gates.draws + 1)
    rounding = 1.0 + 1e-9
    if smallest_probability > gates.false_alarm * rounding:
        needed = "a probability above zero"
        if gates.false_alarm > 0.0:
            draws = ceil(1.0 / (gates.false_alarm * rounding)) - 1
            needed = f"at least {draws} draws"
        raise ModelError(
            f"draws of the gates is {gates.draws}, which shows no probability below "
            f"{smallest_probability:.2g}, and false_alarm is {gates.false_alarm:g}; expected "
            f"{needed}; 999 is usual"
        )


def impossible(
    columns: Sequence[Column], values: FloatArray, deviations: FloatArray, tolerance: float = SIGMAS
) -> str:
    """Name the coefficients, shape (p,), outside their possible values by a number of σ, (p,);
    empty without any.
    """
    found: list[str] = []
    for column, value, std in zip(columns, values, deviations, strict=True):
        if value < column.least - tolerance * std:
            limit = f"no less than {column.least:g}"
        elif value > column.largest + tolerance * std:
            limit = f"no more than {column.largest:g}"
        else:
            continue
        size = f"{value:.3g} ± {std:.2g} {column.unit}"
        found.append(f"{column.name} is {size}; physics allows {limit}")
    return ", ".join(found)


def possible_values(
    columns: Sequence[Column], values: FloatArray, covariance: FloatArray
) -> FloatArray:
    """Move the first values into what physics allows, and the others by their covariance, (n,).

    It is what the same fit finds, to first order, if the values that are outside are held at their
    bounds.

    Args:
        columns: of the first values, with their bounds.
        values: of a fit, shape (n,).
        covariance: of all of them, shape (n, n).
    """
    count = len(columns)
    least = np.array([column.least for column in columns])
    largest = np.array([column.largest for column in columns])
    held: dict[int, float] = {}
    moved = values
    for _ in range(count):  # one that is held can push another one out
        inside = np.clip(moved[:count], least, largest)
        outside = np.flatnonzero(inside != moved[:count])
        if not len(outside):
            break
        held |= {int(place): float(inside[place]) for place in outside}
        places = list(held)
        wanted = np.array(list(held.values()))
        # χ + C_h C_hh⁻¹ (bound − χ_h), of those that are held, h.
        own_covariance = covariance[np.ix_(places, places)]
        precision = np.linalg.pinv(own_covariance, hermitian=True)
        missing = wanted - values[places]
        moved = values + covariance[:, places] @ precision @ missing
        moved[places] = wanted
    return moved


def in_noise(values: FloatArray, covariance: FloatArray, confidence: float = CONFIDENCE) -> str:
    """Why coefficients, shape (p,), may all be zero by Wald's test; empty where they may not."""
    probability = probability_of_zero(values, covariance)
    if probability <= 1.0 - confidence:
        return ""
    return f"its coefficients may all be zero (p = {probability:.2f})"


def uncertain_amplitude(values: FloatArray, covariance: FloatArray) -> str:
    """Why the torque of a cosine and a sine is not known at every angle; empty where it is.

    The data may show it where the axis has been, and leave it open at other angles: the torque
    there is a guess. On a real arm whose position friction was 5 Nm, with a cosine of −3.2 ± 1.1
    and a sine of −3.8 ± 2.2 Nm, a region that was left out was off by 9 % of the torque, and by 2 %
    without. So the largest σ at any angle, the root of the largest eigenvalue of the covariance,
    must be at most 1/AMPLITUDE_SIGMAS of the amplitude.

    Args:
        values: coefficients of the cosine and the sine, shape (2,).
        covariance: of these, shape (2, 2).
    """
    amplitude = float(np.linalg.norm(values))
    largest_std = float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    if AMPLITUDE_SIGMAS * largest_std <= amplitude:
        return ""
    return (
        f"its amplitude is {amplitude:.3g}, and its σ up to {largest_std:.2g} at some angles, more "
        f"than 1/{AMPLITUDE_SIGMAS:g} of it; record moves in which this axis turns further"
    )


def certain_delays(seconds: FloatArray, deviations: FloatArray) -> BoolArray:
    """Which delays differ from zero by CERTAIN_DELAY_SIGMAS, shape (p,) each."""
    return np.asarray(np.abs(seconds) > CERTAIN_DELAY_SIGMAS * deviations)


def probability_of_zero(values: FloatArray, covariance: FloatArray) -> float:
    """Probability by Wald's test that coefficients of zero are estimated as far from it, (p,)."""
    precision = np.linalg.pinv(covariance, hermitian=True)
    wald = float(values @ precision @ values)
    return float(scipy.special.chdtrc(len(values), wald))


def runs_to_leave_out(observation: Observation) -> tuple[int, ...]:
    """Runs, of at least MIN_RUNS, that can be left out.

    The payload of each, or the lack of one, is in another run too.
    """
    runs = np.unique(observation.run)
    mounted = np.array([observation.mounting[observation.run == run][0] for run in runs])
    if len(runs) < MIN_RUNS:
        return ()
    found: list[int] = []
    for run, own in zip(runs.tolist(), mounted, strict=True):
        with_payload = np.sum(mounted == own)
        if with_payload > 1:
            found.append(run)
    return tuple(found)


def regions_to_leave_out(observation: Observation, position: FloatArray) -> IntArray:
    """Region of the workspace of each row, shape (r,); empty where moves are too few to leave out.

    Moves are parted by their mean posture, each joint in units of its scatter: the region with the
    most moves is cut at the median along the direction in which its moves differ most, until there
    are REGIONS.

    Args:
        observation: the rows.
        position: of each joint in each row, shape (joints, r).
    """
    moves, move_of_row = np.unique(observation.move, return_inverse=True)
    if len(moves) < MOVES_OF_REGION * REGIONS:
        return np.zeros(0, dtype=np.int64)
    rows = np.bincount(move_of_row)
    means = np.stack([np.bincount(move_of_row, joint) / rows for joint in position], axis=1)
    scatter = means.std(axis=0)
    unit = np.where(scatter > 0.0, scatter, 1.0)
    posture = (means - means.mean(axis=0)) / unit
    region = np.zeros(len(moves), dtype=np.int64)
    for new in range(1, REGIONS):
        largest = np.argmax(np.bincount(region))
        members = np.flatnonzero(region == largest)
        centred = posture[members] - posture[members].mean(axis=0)
        _, _, directions = np.linalg.svd(centred, full_matrices=False)
        order = np.argsort(centred @ directions[0], kind="stable")
        upper_half = order[len(order) // 2 :]
        region[members[upper_half]] = new
    return np.asarray(region[move_of_row])


def _can_be_left_out(observation: Observation, region: IntArray) -> tuple[int, ...]:
    """Regions without which every payload, and the arm without one, is still in the data."""
    found: list[int] = []
    for own in range(REGIONS):
        rest = region != own
        mounted = set(observation.mounting[~rest])
        mounted_elsewhere = set(observation.mounting[rest])
        if mounted <= mounted_elsewhere:
            found.append(own)
    return tuple(found)


@dataclass(frozen=True, slots=True)
class _Others:
    """A fit of all parts but one."""

    factor: CholeskyFactor  #: of JᵀJ
    score: FloatArray  #: Jᵀe, shape (f,)


@dataclass(frozen=True, slots=True)
class PartsLeftOut:
    """A linearised problem cut into parts, of which the others predict each.

    Parts are runs or regions of the workspace.
    """

    search_problem: SearchProblem  #: the problem
    name: str  #: of the parts, in words
    part_of: IntArray  #: part of each of its clusters, shape (clusters,)
    #: of each part, None for one that stays; empty where none can be left out
    others: tuple[_Others | None, ...]

    @classmethod
    def of(cls, search_problem: SearchProblem) -> PartsLeftOut:
        """Cut a search problem into its runs, or into regions where no run can be left out."""
        folds = search_problem.folds
        observation = search_problem.observation
        left_out = runs_to_leave_out(observation)
        part_of_row = observation.run
        name = "runs"
        if not left_out:
            position = np.concatenate([run.position_rad for run in search_problem.rows], axis=1)
            part_of_row = regions_to_leave_out(observation, position)
            name = "regions of the workspace"
            if not len(part_of_row):
                return cls(search_problem, name, part_of_row, ())
            left_out = _can_be_left_out(observation, part_of_row)
        part_of = folds.linearisation.of_clusters(part_of_row)
        hessian = folds.cluster_hessian
        score = folds.cluster_score
        seen_by_all = np.diag(hessian.sum(axis=0))
        others: list[_Others | None] = []
        for part in range(int(part_of_row.max()) + 1):
            if part not in left_out:
                others.append(None)
                continue
            rest = part_of != part
            factor = _factor(hessian[rest].sum(axis=0), seen_by_all)
            others.append(_Others(factor, score[rest].sum(axis=0)))
        if not left_out:
            others = []
        return cls(search_problem, name, part_of, tuple(others))

    def change(self, columns: FloatArray) -> ErrorChange:
        """Change of the errors on parts left out with whitened columns, (rows, p), in the model."""
        folds = self.search_problem.folds
        problem = folds.linearisation
        observation = self.search_problem.observation
        phi = columns.T
        count = len(self.others)
        width = len(phi)
        unknowns = problem.jacobian.width
        # ΦᵀΦ, Φᵀe and ΦᵀJ of each part.
        grams = np.zeros((count, width, width))
        scores = np.zeros((count, width))
        crossed = np.zeros((count, width, unknowns))
        for motor in folds.motors:
            part_of = self.part_of[motor.cluster]
            own = phi[:, motor.rows]
            np.add.at(grams, part_of, motor.sums(own, own))
            beside = motor.sums(own, motor.equations)
            np.add.at(scores, part_of, beside[..., -2])
            for part in np.unique(part_of):
                own_jacobian = beside[part_of == part][..., :-2]
                crossed[part][:, motor.seen] += own_jacobian.sum(axis=0)
        gram_of_all = grams.sum(axis=0)
        squares = np.maximum(np.diag(gram_of_all), np.finfo(np.float64).tiny)
        unit = np.sqrt(squares)
        units = np.outer(unit, unit)
        # What the fit of the others predicts of each part, without the columns, and what these
        # change of it.
        steps = np.zeros((count, 2, unknowns))
        coefficients = np.zeros((count, width))
        for part, fit in enumerate(self.others):
            if fit is None:
                continue
            rest = crossed.sum(axis=0) - crossed[part]
            along = linalg.cho_solve(fit.factor, rest.T).T
            left = gram_of_all - grams[part] - rest @ along.T
            drive = scores.sum(axis=0) - scores[part] - along @ fit.score
            inverse = np.linalg.pinv(left / units, rcond=SMALLEST_SINGULAR)
            coefficients[part] = inverse @ (drive / unit) / unit
            steps[part, 0] = linalg.cho_solve(fit.factor, fit.score)
            steps[part, 1] = coefficients[part] @ along
        predicted: list[FloatArray] = []
        for motor in folds.motors:
            part_of = self.part_of[motor.cluster]
            predicted.append(motor.predicted(list(steps[part_of])))
        without, turned = np.concatenate(predicted, axis=1)
        part_of_row = self.part_of[problem.cluster]
        # e − J x without the columns; with them e − J x + J w c − Φ c.
        before = problem.residual - without
        added = np.einsum("rp,rp->r", columns, coefficients[part_of_row])
        after = before + turned - added
        is_shown = np.array([fit is not None for fit in self.others])
        shown = is_shown[part_of_row]
        source = problem.source[shown]
        return change_of_errors(
            before=before[shown] ** 2,
            after=after[shown] ** 2,
            motor=problem.motor[shown],
            move=observation.move[source],
            run=observation.run[source],
            motors=len(problem.gamma),
        )

    def refusal(self, columns: FloatArray, coefficients: FloatArray) -> str:
        """Why an effect may not join; empty where it may, or nothing can be left out.

        Args:
            columns: Φ, whitened, shape (rows, p).
            coefficients: c of all parts, shape (p,).
        """
        if not self.others:
            return ""
        change = self.change(columns)
        data = f"{self.name} left out"
        harm = change.harm(data)
        if harm:
            return harm
        # Too few blocks show nothing, but forbid nothing either: the folds of moves have judged.
        problem = self.search_problem.folds.linearisation
        # ‖Φ c‖² of each motor: columns alone have the units of their coefficients.
        effect = columns @ coefficients
        of_motor = np.bincount(problem.motor, effect**2)
        most_affected = int(np.argmax(of_motor))
        if not change.is_enough or change.is_fall(most_affected):
            return ""
        return describe_noise(change.total, data)


def whitened_columns(search_problem: SearchProblem, effect: Effect, axis: int) -> FloatArray:
    """Columns of an effect beside the Jacobian of a search problem, shape (rows, p)."""
    torque = search_problem.torque(effect, axis)
    to_motor = search_problem.model.drive_train.to_motor
    return search_problem.folds.linearisation.whitened(torque, to_motor)


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
    names: set[str] = set()
    for placed in effects:
        names.update(column.name for column in placed.columns)
    places = [index for index, column in enumerate(estimate.unknowns) if column.name in names]
    return np.array(places, dtype=np.int64)


def values_of(estimate: Estimate, own: IntArray) -> FloatArray:
    """Values of some parameters with what was applied to the robot's description, shape (p,)."""
    applied = np.array([estimate.unknowns[index].about for index in own])
    return np.asarray(estimate.parameters[own] + applied)


def covariance_of(estimate: Estimate, own: IntArray) -> FloatArray:
    """Covariance of some parameters, shape (p, p); gains come before them in that of all."""
    index = len(estimate.gains) + own
    return estimate.covariance[np.ix_(index, index)]


def without_effects_of(
    search_problem: SearchProblem, estimate: Estimate, effects: Sequence[PlacedEffect]
) -> Reduced:
    """Take effects out of a joint fit, to first order, without a refit.

    Args:
        search_problem: linearised around the joint fit.
        estimate: the joint fit.
        effects: in the fit.
    """
    own = own_unknowns(estimate, effects)
    gains = len(estimate.gains)
    problem = search_problem.folds.linearisation
    taken = np.isin(problem.free, gains + own)
    columns = problem.jacobian.columns(np.flatnonzero(taken)) / problem.scale[taken]
    torque = columns @ values_of(estimate, own)
    rest = problem.jacobian.only(np.flatnonzero(~taken))
    free_gains = problem.free[problem.free < gains]
    for place, motor in enumerate(free_gains):
        # ∂(γ τ)/∂g = −γ² τ, and τ loses these effects; with preload ∂e/∂g_i = (T_D)_i (v_i − σ_i
        # e_i), in all rows.
        lost = torque[problem.rows_of(motor)]
        scale = problem.scale[place]
        if problem.transform is None:
            own_gain = rest.seen[motor] == place
            rest.parts[motor][own_gain] += lost * problem.gamma[motor] * scale
            continue
        for other, (part, seen) in enumerate(zip(rest.parts, rest.seen, strict=True)):
            rows = problem.source[problem.rows_of(other)]
            passed = problem.transform[rows, other, motor]
            part[seen == place] += lost * passed * problem.noise[motor] * scale
    # Around the estimate, from which the torque was taken.
    residual = problem.residual + problem.jacobian @ search_problem.step + torque
    hessian = sum_of_squares(rest)
    factor = _factor(hessian, np.diag(hessian))
    step = linalg.cho_solve(factor, rest.on_columns(residual))
    reduced = replace(
        problem,
        jacobian=rest,
        residual=residual - rest @ step,
        free=problem.free[~taken],
        scale=problem.scale[~taken],
    )
    # The rows keep their order: they are dealt to the same folds again.
    move_of = problem.of_clusters(search_problem.observation.move)
    folds = cut_into_folds(reduced, move_of=move_of)
    return Reduced(replace(search_problem, folds=folds, step=step), columns, torque)


def gain_shifts(folds: Folds, torque: FloatArray) -> FloatArray:
    """Shift of each gain by a whitened torque in the model [Nm at the joint per A], shape (m,).

    Args:
        folds: the problem.
        torque: that joins the model, shape (rows,).
    """
    problem = folds.linearisation
    count = len(problem.gamma)
    last = int(problem.free[-1])
    return shifts_by(folds, torque, max(count, last + 1))[:count]


def shifts_by(folds: Folds, torque: FloatArray, size: int) -> FloatArray:
    """Shift of (gains, parameters) by a whitened torque in the model, shape (size,).

    It is zero for what is fixed and for what the problem does not hold.

    Args:
        folds: the problem.
        torque: that joins the model, shape (rows,).
        size: number of gains and parameters.
    """
    problem = folds.linearisation
    shifts = np.zeros(size)
    score = problem.jacobian.on_columns(problem.correlated(torque))
    shifts[problem.free] = -linalg.cho_solve(folds.estimate_factor, score) * problem.scale
    return shifts


def moved_gains(shifts: FloatArray, gains_std: FloatArray) -> tuple[tuple[int, float], ...]:
    """Index of each gain that moves by more than its σ, and by how many of them; shifts and σ have
    shape (m,). Fixed gains never move.
    """
    sigmas = np.zeros_like(shifts)
    np.divide(np.abs(shifts), gains_std, where=gains_std > 0.0, out=sigmas)
    return tuple((motor, size) for motor, size in enumerate(sigmas.tolist()) if size > 1.0)


def _factor(hessian: FloatArray, seen_by_all: FloatArray) -> CholeskyFactor:
    """Cholesky factor of JᵀJ; directions that the rows do not show stay where they are.

    Args:
        hessian: of some rows, shape (f, f). An effect that acts at one end of the workspace may
            have none among them.
        seen_by_all: diagonal of JᵀJ of all rows, positive, shape (f,).
    """
    regular = hessian + RIDGE * np.diag(seen_by_all)
    return lower_factor(regular)
