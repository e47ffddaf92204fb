"""Find runs that do not carry the payload they declare: it was turned, left off or exchanged.

Where the declared masses of several payloads contradict each other, these are named, and no run.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy  # loads its modules when they are first used: a clean fit needs none of them

from ident.arrays import FloatArray
from ident.equations.currents import PreloadedCurrents
from ident.equations.linearisation import (
    MIN_MOVES_TO_LEAVE_OUT,
    left_out_shifts,
    motor_jacobians,
    scatter_of,
)
from ident.equations.system import System
from ident.errors import Diagnosis, PayloadDiffers
from ident.estimators.payload_ratio import MassContradiction, contradicting_masses

LEAST_SHARE = 0.15  #: Torque of a payload's difference, relative to the payload's
#: The same in a held-out run, where the errors of all other parameters are in it
UNSEEN_SHARE = 0.3
WRONG_SHARE = 0.6  #: The same, where the gains are not usable: a payload left off has 1 and more
#: The same, relative to the residual of the run: beside a light payload every error is large
LEAST_OF_RESIDUAL = 0.3
LARGEST_PROBABILITY = 1e-4  #: That chance makes a difference as large, over all runs
TIED = 0.7  #: Of the largest share: two runs of one mounting contradict each other alike
#: Sum of squares that the likelier one of two hypotheses leaves, relative to the other
CLEARLY_LESS = 0.9
SEEN = 0.02  #: Least share of a column that must remain beside all others, to be estimated
OF_A_BODY = np.array([0.04, 0.04, 0.04, 0.04, 0.04, 0.04, 0.2, 0.2, 0.2, 1.0])
"""Sizes of the ten parameters of 1 kg that is 0.2 m off the flange.

With few moves, what such a body shows most is estimated.
"""
LEAST_MOVES = 3  #: For each direction in which a run's payload is estimated


@dataclass(frozen=True, slots=True, eq=False)
class PayloadDifference:
    """By how much the body on the flange in one run differs from what the fit has there."""

    run: str  #: name of the run
    #: What must be added to the ten parameters in this run, as far as its moves see them [SI],
    #: shape (10,).
    difference: FloatArray
    #: torque of the difference, relative to that of the payload (root mean squares, as currents in
    #: σ)
    share: float
    #: That chance makes a difference as large: Wald test with the scatter of the moves, F
    #: distribution.
    probability: float
    loaded: bool  #: the run says that it carries a payload
    left: float  #: sum of squares that the difference leaves, relative to that of the fit


def payload_diagnoses(
    system: System, gains: FloatArray, parameters: FloatArray, held: int | None = None
) -> Iterator[Diagnosis]:
    """Name contradicting masses of payloads, or runs that carry another one than they say.

    Arguments as for `payload_differences`.

    Raises:
        PayloadDiffers: by more than WRONG_SHARE of its torque, in a run of the fit.
    """
    found = payload_differences(system, gains, parameters, held)
    if held == 0:
        masses = likeliest_masses(system, gains, parameters, found)
        if masses is not None:
            yield masses.diagnosis
            return
    worst = max(found, key=lambda one: one.share, default=None)
    if worst is None:
        return
    is_unseen = held is None
    if is_unseen:
        tied = found
    else:
        least_share = TIED * worst.share
        tied = _without_unlikely_bare_runs([one for one in found if one.share >= least_share])
        worst = max(tied, key=lambda one: one.share)
    runs = tuple(one.run for one in tied)
    percent = 100.0 * worst.share
    mass_kg = worst.difference[9]
    evidence = (
        f"on the flange a body that differs by {percent:.0f} % of the payload's torque, its mass "
        f"by {mass_kg:+.2g} kg (by chance with p = {worst.probability:.0e})"
    )
    expected = "the same body, mounted in the same way, in all runs that say so"
    if len(runs) > 1:
        expected += "; one of these runs"
    remedy = (
        "was it mounted in this run, and not turned? give each way of mounting a name of its own"
    )
    if not is_unseen and worst.share > WRONG_SHARE:
        place = f"run {', '.join(runs)}"
        raise PayloadDiffers(place, found=evidence, expected=expected, remedy=remedy)
    yield Diagnosis("payload-differs", runs, (), evidence, expected, remedy)


def likeliest_masses(
    system: System, gains: FloatArray, parameters: FloatArray, found: Sequence[PayloadDifference]
) -> MassContradiction | None:
    """Return contradicting masses, unless another payload in one run leaves clearly less.

    Args:
        system, gains, parameters: of a fit with free gains.
        found: of `payload_differences`.
    """
    masses = contradicting_masses(system, gains, parameters)
    if masses is None:
        return None
    clearly_less = CLEARLY_LESS * masses.left
    if any(one.left < clearly_less for one in found):
        return None
    return masses


def _without_unlikely_bare_runs(tied: list[PayloadDifference]) -> list[PayloadDifference]:
    """Leave out runs without load where another payload in a loaded run explains as much."""
    left_by_loaded = [one.left for one in tied if one.loaded]
    if not left_by_loaded:
        return tied
    clearly_less = CLEARLY_LESS * min(left_by_loaded)
    return [one for one in tied if one.loaded or one.left < clearly_less]


def payload_differences(
    system: System, gains: FloatArray, parameters: FloatArray, held: int | None = None
) -> list[PayloadDifference]:
    """Estimate what each run carries beside what it should; return what is not chance.

    A payload has the columns of the link that carries it. With δ for one run alone and all unknowns
    x,

        e = J x + X δ,    X = J_flange in the rows of this run,

    δ is estimated in the directions that J leaves visible. Its covariance is from leaving out
    moves.

    Args:
        system: of the fit, or of runs that it has not seen.
        gains, parameters: of the fit, shapes (m,) and (p,).
        held: how many of (gains, parameters) are not in x, because they were given; all of them
            when None, as in runs that the fit has not seen.

    Returns:
        differences above LEAST_SHARE of the payload's torque, and less probable than
        LARGEST_PROBABILITY.
    """
    leading = len(system.base.independent)
    leading_names = tuple(column.name for column in system.columns[:leading])
    if not system.payloads or leading_names != system.base.names:
        return []  # parameters were taken out, and the flange's columns with them
    if held is None:
        first_unknown = system.axis_count + len(parameters)
        least_share = UNSEEN_SHARE
    else:
        first_unknown = held
        least_share = LEAST_SHARE
    has_given_gains = bool(held)
    moves = _move_equations(system, gains, parameters, first_unknown, with_weight=has_given_gains)
    moves = _normalised(moves)
    fit = _normal_equations(moves)
    found: list[PayloadDifference] = []
    for run in range(len(system.runs)):
        difference = _difference_in(system, run, moves, fit, parameters, least_share)
        if difference is not None:
            found.append(difference)
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _MoveEquations:
    """Linearised equations e = J x + X δ of the rows of one move, each divided by its σ."""

    jacobian: FloatArray  #: J, derivative to the unknowns of all runs, shape (r, f)
    residual: FloatArray  #: e, shape (r,)
    flange: FloatArray  #: X, derivative to the ten parameters of the body, shape (r, 10)


@dataclass(frozen=True, slots=True, eq=False)
class _NormalEquations:
    """Normal equations of all moves together, without δ."""

    inverse: FloatArray  #: (JᵀJ)⁻¹, shape (f, f)
    score: FloatArray  #: Jᵀe, shape (f,)
    squares: float  #: eᵀe


def _move_equations(
    system: System,
    gains: FloatArray,
    parameters: FloatArray,
    first_unknown: int,
    *,
    with_weight: bool,
) -> list[_MoveEquations]:
    """Equations of each move; arguments as for `payload_differences`.

    Args:
        first_unknown: gains and parameters before this one are no unknowns.
        with_weight: the weight of the payload is one. With given gains, which may all be off, it is
            an unknown of all runs together.
    """
    first_base = system.axis_count
    last_base = first_base + len(system.base.independent)
    base_to_flange = system.base.grouping[:, system.model.flange]
    noise = system.currents.noise(gains, parameters)
    moves = []
    for index, cluster in enumerate(system.clusters):
        preload = system.preload_of(index)
        by_motor = list(motor_jacobians(cluster, preload, gains, parameters, noise))
        jacobian = np.concatenate([of_motor[0] for of_motor in by_motor])
        residual = np.concatenate([of_motor[1] for of_motor in by_motor])
        unknowns = jacobian[:, first_unknown:]
        if with_weight:
            weight = _payload_column(system, index, gains, noise)
            unknowns = np.column_stack((unknowns, weight))
        flange = jacobian[:, first_base:last_base] @ base_to_flange
        moves.append(_MoveEquations(unknowns, residual, flange))
    return moves


def _payload_column(system: System, index: int, gains: FloatArray, noise: FloatArray) -> FloatArray:
    """Current of the known payloads in the rows of one move, in σ of each motor, shape (r,)."""
    cluster = system.clusters[index]
    if system.model.is_redundant:
        currents = PreloadedCurrents.of_rows(list(cluster), system.preload_of(index))
        return currents.whitened(gains, noise).known
    by_motor = []
    for rows, gain, std in zip(cluster, gains, noise, strict=True):
        known_torque = rows[:, -1]
        by_motor.append(known_torque / (gain * std))
    return np.concatenate(by_motor)


def _normalised(moves: Sequence[_MoveEquations]) -> list[_MoveEquations]:
    """Equations with the columns of J divided by their norms over all moves."""
    squares_by_move = [np.sum(move.jacobian**2, axis=0) for move in moves]
    norms = np.sqrt(np.sum(squares_by_move, axis=0))
    norms = np.where(norms > 0.0, norms, 1.0)
    return [replace(move, jacobian=move.jacobian / norms) for move in moves]


def _normal_equations(moves: Sequence[_MoveEquations]) -> _NormalEquations:
    grams = [move.jacobian.T @ move.jacobian for move in moves]
    scores = [move.jacobian.T @ move.residual for move in moves]
    squares_by_move = [np.sum(move.residual**2) for move in moves]
    gram = np.sum(grams, axis=0)
    inverse = gram
    if len(gram):
        inverse = np.linalg.pinv(gram, rcond=1e-12, hermitian=True)
    squares = float(np.sum(squares_by_move))
    return _NormalEquations(inverse, np.sum(scores, axis=0), squares)


def _difference_in(
    system: System,
    run: int,
    moves: Sequence[_MoveEquations],
    fit: _NormalEquations,
    parameters: FloatArray,
    least_share: float,
) -> PayloadDifference | None:
    """Estimate δ of one run; None where it is small or may be chance.

    Args:
        system: of the runs.
        run: index of the run.
        moves: of all runs, normalised.
        fit: their normal equations.
        parameters: of the fit, shape (p,).
        least_share: torque of the difference that is reported, relative to the payload's.
    """
    owners = [owner for owner, _ in system.cluster_runs]
    inside = [index for index, owner in enumerate(owners) if owner == run]
    if len(inside) < MIN_MOVES_TO_LEAVE_OUT:
        return None
    own_moves = [moves[index] for index in inside]
    # XᵀX, XᵀJ and Xᵀe of this run, for a body of OF_A_BODY.
    body_size = OF_A_BODY[:, None]
    crosses = [move.flange.T @ move.jacobian for move in own_moves]
    scores = [move.flange.T @ move.residual for move in own_moves]
    flange = np.concatenate([move.flange for move in own_moves]) * OF_A_BODY
    cross = np.sum(crosses, axis=0) * body_size
    own_score = np.sum(scores, axis=0) * OF_A_BODY

    # Directions of δ that remain visible beside all other unknowns: eigenvectors of the Schur
    # complement XᵀX − XᵀJ (JᵀJ)⁻¹ JᵀX.
    schur_complement = flange.T @ flange - cross @ fit.inverse @ cross.T
    visible, directions = np.linalg.eigh(schur_complement)
    alone = np.sum((flange @ directions) ** 2, axis=0)
    is_beside_others = visible > SEEN * alone
    is_real = visible > 1e-9 * visible[-1]
    largest_count = len(inside) // LEAST_MOVES
    chosen = np.flatnonzero(is_beside_others & is_real)[-largest_count:]
    if not len(chosen):
        return None
    visible = visible[chosen]
    directions = directions[:, chosen]
    score_beside_others = own_score - cross @ (fit.inverse @ fit.score)
    amount = directions.T @ score_beside_others / visible
    body_per_amount = directions * body_size
    difference = body_per_amount @ amount

    _, mounting = system.cluster_runs[inside[0]]
    # In a run without load, relative to the first payload.
    body = _payload_parameters(system, parameters)[max(0, mounting)]
    residual = np.concatenate([move.residual for move in own_moves])
    residual_size = float(np.linalg.norm(residual))
    torque = float(np.linalg.norm(flange @ (difference / OF_A_BODY)))
    payload_torque = float(np.linalg.norm(flange @ (body / OF_A_BODY)))
    share = torque / payload_torque
    if share < least_share or torque < LEAST_OF_RESIDUAL * residual_size:
        return None
    score_beside_body = fit.score - cross.T @ (directions @ amount)
    other_unknowns = fit.inverse @ score_beside_body
    probability = _chance(moves, inside, body_per_amount, amount, other_unknowns)
    if probability * len(system.runs) >= LARGEST_PROBABILITY:
        return None
    explained = float(np.sum(visible * amount**2))
    left = 1.0 - explained / fit.squares
    return PayloadDifference(
        run=system.runs[run],
        difference=difference,
        share=share,
        probability=probability,
        loaded=mounting >= 0,
        left=left,
    )


def _chance(
    moves: Sequence[_MoveEquations],
    inside: Sequence[int],
    body_per_amount: FloatArray,
    amount: FloatArray,
    other_unknowns: FloatArray,
) -> float:
    """Probability of δ by Hotelling's T², its covariance from leaving out one move at a time.

    Args:
        moves: equations of each move.
        inside: moves of the run.
        body_per_amount: δ per unit of each of its visible directions, shape (10, q).
        amount: of each of these, shape (q,).
        other_unknowns: their step beside δ, shape (f,).
    """
    step = np.concatenate((other_unknowns, amount))
    other_count = len(other_unknowns)
    size = len(step)
    grams = np.zeros((len(moves), size, size))
    scores = np.zeros((len(moves), size))
    members = set(inside)
    for index, move in enumerate(moves):
        columns = np.zeros((len(move.residual), size))
        columns[:, :other_count] = move.jacobian
        if index in members:
            columns[:, other_count:] = move.flange @ body_per_amount
        left = move.residual - columns @ step
        grams[index] = columns.T @ columns
        scores[index] = columns.T @ left
    all_shifts = left_out_shifts(grams, scores)
    shifts = all_shifts[:, other_count:]
    wald = float(amount @ np.linalg.solve(scatter_of(shifts), amount))
    # T² (n − q) / (q (n − 1)) has an F distribution with q and n − q degrees of freedom.
    move_count = len(inside)
    directions = len(amount)
    freedom = move_count - directions
    scale = freedom / (directions * (move_count - 1))
    f_value = scale * wald
    return float(scipy.special.fdtrc(directions, freedom, f_value))


def _payload_parameters(system: System, parameters: FloatArray) -> list[FloatArray]:
    """All ten of each payload, known or estimated, shape (10,)."""
    first = len(system.columns)
    bodies = []
    for payload, indices in zip(system.payloads, system.payload_columns, strict=True):
        last = first + len(indices)
        body = payload.known_parameters
        body[list(indices)] = parameters[first:last]
        first = last
        bodies.append(body)
    return bodies
