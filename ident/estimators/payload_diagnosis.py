"""Whether each run carries the payload that it says: a body that was turned, left off or exchanged, by run.

Where the declared masses of several payloads contradict each other, these are named, and no run.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # loads its modules when they are first used: a clean fit needs none of them

from ident.arrays import FloatArray
from ident.equations.currents import PreloadedCurrents
from ident.equations.linearisation import MIN_MOVES_TO_LEAVE_OUT, left_out_shifts, motor_jacobians
from ident.equations.system import System
from ident.errors import Diagnosis, PayloadDiffers
from ident.estimators.payload_ratio import MassContradiction, contradicting_masses

LEAST_SHARE = 0.15  #: Torque of a payload's difference, relative to the payload's
UNSEEN_SHARE = 0.3  #: The same in a held-out run, where the errors of all other parameters are in it
WRONG_SHARE = 0.6  #: The same, where the gains are not usable: a payload left off has 1 and more
LEAST_OF_RESIDUAL = 0.3  #: The same, relative to the residual of the run: beside a light payload every error is large
LARGEST_PROBABILITY = 1e-4  #: That chance makes a difference as large, over all runs
TIED = 0.7  #: Of the largest share: two runs of one mounting contradict each other alike
CLEARLY_LESS = 0.9  #: Sum of squares that the likelier one of two hypotheses leaves, relative to the other
SEEN = 0.02  #: Least share of a column that must remain beside all others, to be estimated
OF_A_BODY = np.array([0.04] * 6 + [0.2] * 3 + [1.0])
"""Sizes of the ten parameters of 1 kg that is 0.2 m off the flange: with few moves, what such a body shows most."""
LEAST_MOVES = 3  #: For each direction in which a run's payload is estimated


@dataclass(frozen=True, slots=True, eq=False)
class PayloadDifference:
    """By how much the body on the flange in one run differs from what the fit has there."""

    run: str  #: name of the run
    #: What must be added to the ten parameters in this run, as far as its moves see them [SI], shape (10,).
    difference: FloatArray
    share: float  #: torque of the difference, relative to that of the payload (root mean squares, as currents in σ)
    #: That chance makes a difference as large: Wald test with the scatter of the moves, F distribution.
    probability: float
    loaded: bool  #: the run says that it carries a payload
    left: float  #: sum of squares that the difference leaves, relative to that of the fit


def payload_diagnoses(
    system: System, gains: FloatArray, parameters: FloatArray, held: int | None = None
) -> Iterator[Diagnosis]:
    """Name payloads whose masses contradict each other, or runs that carry another payload than they say.

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
    tied = [one for one in found if one.share >= TIED * worst.share or held is None]
    if held is not None:
        tied = _without_unlikely_bare_runs(tied)
        worst = max(tied, key=lambda one: one.share)
    runs = tuple(one.run for one in tied)
    evidence = (
        f"on the flange a body that differs by {100.0 * worst.share:.0f} % of the payload's torque, its mass by "
        f"{worst.difference[9]:+.2g} kg (by chance with p = {worst.probability:.0e})"
    )
    expected = "the same body, mounted in the same way, in all runs that say so" + "; one of these runs" * (
        len(runs) > 1
    )
    remedy = "was it mounted in this run, and not turned? give each way of mounting a name of its own"
    if held is not None and worst.share > WRONG_SHARE:
        raise PayloadDiffers(f"run {', '.join(runs)}", found=evidence, expected=expected, remedy=remedy)
    yield Diagnosis("payload-differs", runs, (), evidence, expected, remedy)


def likeliest_masses(
    system: System, gains: FloatArray, parameters: FloatArray, found: Sequence[PayloadDifference]
) -> MassContradiction | None:
    """Return the contradiction of masses, unless another payload in a single run leaves clearly less.

    Args:
        system, gains, parameters: of a fit with free gains.
        found: of `payload_differences`.
    """
    masses = contradicting_masses(system, gains, parameters)
    if masses is None or any(one.left < CLEARLY_LESS * masses.left for one in found):
        return None
    return masses


def _without_unlikely_bare_runs(tied: list[PayloadDifference]) -> list[PayloadDifference]:
    """Leave out runs without load where another payload in a loaded run explains as much."""
    loaded = [one.left for one in tied if one.loaded]
    if not loaded:
        return tied
    return [one for one in tied if one.loaded or one.left < CLEARLY_LESS * min(loaded)]


def payload_differences(
    system: System, gains: FloatArray, parameters: FloatArray, held: int | None = None
) -> list[PayloadDifference]:
    """Estimate what each run carries beside what it should, with all other unknowns, and return what is not chance.

    A payload has the columns of the link that carries it. With δ for one run alone and all unknowns x,

        e = J x + X δ,    X = J_flange in the rows of this run,

    δ is estimated in the directions that J leaves visible. Its covariance is from leaving out moves.

    Args:
        system: of the fit, or of runs that it has not seen.
        gains, parameters: of the fit, shapes (m,) and (p,).
        held: how many of (gains, parameters) are not in x, because they were given; all of them when None, as in runs
            that the fit has not seen.

    Returns:
        differences above LEAST_SHARE of the payload's torque, and less probable than LARGEST_PROBABILITY.
    """
    leading = len(system.base.independent)
    if not system.payloads or tuple(column.name for column in system.columns[:leading]) != system.base.names:
        return []  # parameters were taken out, and the flange's columns with them
    count = system.axis_count
    of_base = system.base.grouping[:, system.model.flange]
    noise = system.currents.noise(gains, parameters)
    first, least = (held, LEAST_SHARE) if held is not None else (count + len(parameters), UNSEEN_SHARE)
    blocks = []  # J, e and X of each move
    for index, cluster in enumerate(system.clusters):
        parts = motor_jacobians(cluster, system.preload_of(index), gains, parameters, noise)
        jacobian, residual, _ = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        if system.model.is_redundant:
            currents = PreloadedCurrents.of_rows(list(cluster), system.preload_of(index))
            weight = [currents.whitened(gains, noise).known]
        else:
            weight = [rows[:, -1] / (g * std) for rows, g, std in zip(cluster, gains, noise, strict=True)]
        # With given gains, which may all be off, the weight of the payload is an unknown of all runs together.
        others = np.column_stack((jacobian[:, first:], np.concatenate(weight))) if held else jacobian[:, first:]
        blocks.append((others, residual, jacobian[:, count : count + leading] @ of_base))
    norms = np.sqrt(np.sum([np.sum(jacobian**2, axis=0) for jacobian, _, _ in blocks], axis=0))
    blocks = [(jacobian / np.where(norms > 0.0, norms, 1.0), e, x) for jacobian, e, x in blocks]
    gram = np.sum([jacobian.T @ jacobian for jacobian, _, _ in blocks], axis=0)
    score = np.sum([jacobian.T @ e for jacobian, e, _ in blocks], axis=0)
    inverse = np.linalg.pinv(gram, rcond=1e-12, hermitian=True) if len(gram) else gram
    total = float(np.sum([np.sum(e**2) for _, e, _ in blocks]))
    found: list[PayloadDifference] = []
    for run, name in enumerate(system.runs):
        inside = [index for index, (owner, _) in enumerate(system.cluster_runs) if owner == run]
        if len(inside) < MIN_MOVES_TO_LEAVE_OUT:
            continue
        flange = np.concatenate([blocks[index][2] for index in inside]) * OF_A_BODY
        cross = np.sum([blocks[index][2].T @ blocks[index][0] for index in inside], axis=0) * OF_A_BODY[:, None]
        own = np.sum([blocks[index][2].T @ blocks[index][1] for index in inside], axis=0) * OF_A_BODY
        visible, directions = np.linalg.eigh(flange.T @ flange - cross @ inverse @ cross.T)
        alone = np.sum((flange @ directions) ** 2, axis=0)
        kept = np.flatnonzero((visible > SEEN * alone) & (visible > 1e-9 * visible[-1]))[
            -(len(inside) // LEAST_MOVES) :
        ]
        if not len(kept):
            continue
        directions = directions[:, kept]
        amount = directions.T @ (own - cross @ (inverse @ score)) / visible[kept]
        seen = directions * OF_A_BODY[:, None]
        mounting = system.cluster_runs[inside[0]][1]
        body = _payload_parameters(system, parameters)[max(0, mounting)]  # without load, relative to the first payload
        torque = float(np.linalg.norm(flange @ (seen @ amount / OF_A_BODY)))
        share = torque / float(np.linalg.norm(flange @ (body / OF_A_BODY)))
        left = float(np.linalg.norm(np.concatenate([blocks[index][1] for index in inside])))
        if share < least or torque < LEAST_OF_RESIDUAL * left:
            continue
        probability = _chance(blocks, inside, seen, amount, inverse @ (score - cross.T @ (directions @ amount)))
        if probability * len(system.runs) < LARGEST_PROBABILITY:
            explained = float(np.sum(visible[kept] * amount**2))
            is_loaded = mounting >= 0
            found.append(PayloadDifference(name, seen @ amount, share, probability, is_loaded, 1.0 - explained / total))
    return found


def _chance(
    blocks: Sequence[tuple[FloatArray, FloatArray, FloatArray]],
    inside: Sequence[int],
    seen: FloatArray,
    amount: FloatArray,
    others: FloatArray,
) -> float:
    """Probability of δ by Hotelling's T², its covariance from leaving out one move at a time.

    Args:
        blocks: J, e and X of each move.
        inside: moves of the run.
        seen: δ per unit of each of its visible directions, shape (10, q).
        amount: of each of these, shape (q,).
        others: the step of all other unknowns beside δ, shape (f,).
    """
    whole, size = np.concatenate((others, amount)), len(others) + len(amount)
    grams, scores = np.zeros((len(blocks), size, size)), np.zeros((len(blocks), size))
    members = set(inside)
    for index, (jacobian, e, x) in enumerate(blocks):
        columns = np.zeros((len(e), size))
        columns[:, : len(others)] = jacobian
        if index in members:
            columns[:, len(others) :] = x @ seen
        grams[index], scores[index] = columns.T @ columns, columns.T @ (e - columns @ whole)
    shifts = left_out_shifts(grams, scores)[:, len(others) :]
    centred = shifts - shifts.mean(axis=0)
    covariance = (len(blocks) - 1) / len(blocks) * (centred.T @ centred)
    moves, directions = len(inside), len(amount)
    wald = float(amount @ np.linalg.solve(covariance, amount))
    return float(
        scipy.special.fdtrc(directions, moves - directions, (moves - directions) / (directions * (moves - 1)) * wald)
    )


def _payload_parameters(system: System, parameters: FloatArray) -> list[FloatArray]:
    """All ten of each payload, known or estimated, shape (10,)."""
    first, bodies = len(system.columns), []
    for payload, indices in zip(system.payloads, system.payload_columns, strict=True):
        body = payload.known_parameters
        body[list(indices)] = parameters[first : first + len(indices)]
        first += len(indices)
        bodies.append(body)
    return bodies
