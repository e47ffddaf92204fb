"""Whether the declared masses of several payloads agree with each other.

The weight of the payloads gives the gains their scale, so one wrong mass alone leaves no residual.
Two of them do: the torques show how many times as heavy one is as the other. The hypothesis is one
more unknown, the factor s − 1 of what is known of one body,

    v_i = γ_i (T W χ + T W_uL χ_uL + T W_kL χ_kL + (s − 1) T W_kL χ_kL[body])_i + e_i.

It competes with the hypothesis that a single run carries another body than it says
(`payload_diagnosis`): what leaves less is named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy  # loads its modules when they are first used: a clean fit needs none of them

from ident.arrays import FloatArray
from ident.equations.linearisation import (
    MIN_MOVES_TO_LEAVE_OUT,
    even_unit,
    left_out_shifts,
    scatter_of,
    sums_of_motors,
)
from ident.equations.system import System
from ident.errors import Diagnosis

#: Of a mass beside the others: an effect that the model lacks may look like a smaller one
LEAST_CHANGE = 0.1
LARGEST_PROBABILITY = 1e-4  #: That chance makes as large a factor, over all bodies
SAME = 1.01  #: What two hypotheses leave, relative to each other, where neither is the likelier one
STEPS = 10  #: Of Gauss-Newton
SMALLEST_STEP = 1e-4  #: Of the factor, at which it ends


@dataclass(frozen=True, slots=True)
class MassContradiction:
    """A payload that is not as heavy beside the others as declared."""

    body: str
    others: tuple[str, ...]
    ratio: float  #: how many times as heavy as declared, beside the others
    std: float  #: σ of the ratio, from leaving out moves
    left: float  #: sum of squares that it leaves, relative to that of the fit

    @property
    def diagnosis(self) -> Diagnosis:
        """Both sides are named: the torques show the ratio alone."""
        names = " and ".join((self.body, *self.others))
        beside = " and ".join(self.others)
        evidence = (
            f"the masses of {names} contradict each other: by the torques {self.body} is "
            f"{self.ratio:.2f} ± {self.std:.2f} times as heavy beside {beside} as declared"
        )
        expected = "masses that the torques confirm"
        advice = (
            f"weigh {names} again, and look what was mounted in each run; a wrong mass of any of "
            "them makes every gain wrong"
        )
        return Diagnosis("masses-contradict", (), (), evidence, expected, advice)


def contradicting_masses(
    system: System, gains: FloatArray, parameters: FloatArray
) -> MassContradiction | None:
    """Find the payload whose mass contradicts those of the others most; None where no mass does.

    Args:
        system: of the fit.
        gains, parameters: of the fit, shapes (m,) and (p,).
    """
    bodies = _known_bodies(system)
    if len(bodies) < 2 or system.model.is_redundant:
        return None
    if len(system.clusters) < MIN_MOVES_TO_LEAVE_OUT:
        return None
    found: list[MassContradiction] = []
    for body, mountings in bodies.items():
        others = tuple(name for name in bodies if name != body)
        one = _with_factor(system, gains, parameters, body, others, mountings)
        if one is not None:
            found.append(one)
    least = min((one.left for one in found), default=0.0)
    likely = [one for one in found if one.left <= SAME * least]
    # Of two bodies, each may be the wrong one: the heavier one is named first.
    return max(likely, key=lambda one: one.ratio, default=None)


def _known_bodies(system: System) -> dict[str, list[int]]:
    """Mountings of each body of which something is known, by its name."""
    bodies: dict[str, list[int]] = {}
    for mounting, payload in enumerate(system.payloads):
        if payload.known:
            bodies.setdefault(payload.name, []).append(mounting)
    return bodies


def _with_factor(
    system: System,
    gains: FloatArray,
    parameters: FloatArray,
    body: str,
    others: tuple[str, ...],
    mountings: Sequence[int],
) -> MassContradiction | None:
    """Fit the factor of one body with all other unknowns; None where it is one."""
    noise = system.currents.noise(gains, parameters)
    extended = _extended(system, mountings)
    count = len(gains)
    values = np.concatenate((gains, parameters, [0.0]))
    before = 0.0

    def sums_at(values: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        return sums_of_motors(extended, extended, values[:count], values[count:], noise)

    grams, scores, left = sums_at(values)
    for _ in range(STEPS):
        before = before or left
        step = _solved(grams.sum(axis=0), scores.sum(axis=0))
        while True:
            trial = values + step
            keeps_signs = np.all(trial[:count] * values[:count] > 0.0)
            if keeps_signs:
                trial_grams, trial_scores, trial_left = sums_at(trial)
                if trial_left <= left:
                    break
            step = 0.5 * step
            if abs(step[-1]) < SMALLEST_STEP:
                break
        if abs(step[-1]) < SMALLEST_STEP:
            break
        values = trial
        grams = trial_grams
        scores = trial_scores
        left = trial_left
    factor = float(values[-1])
    shifts = left_out_shifts(grams, scores)
    covariance = scatter_of(shifts)
    std = float(np.sqrt(covariance[-1, -1]))
    moves = len(system.clusters)
    probability = 2.0 * float(scipy.special.stdtr(moves - 1, -abs(factor) / std))
    if abs(factor) < LEAST_CHANGE or probability * (len(others) + 1) > LARGEST_PROBABILITY:
        return None
    return MassContradiction(body, others, 1.0 + factor, std, left / before)


def _extended(system: System, mountings: Sequence[int]) -> System:
    """The motors' rows, with what is known of one body in the last column but one."""
    clusters: list[tuple[FloatArray, ...]] = []
    for (_, mounting), rows in zip(system.cluster_runs, system.clusters, strict=True):
        is_mounted = float(mounting in mountings)
        own: list[FloatArray] = []
        for motor in rows:
            unknown = motor[:, :-1]
            known = motor[:, -1:]
            of_body = is_mounted * known
            own.append(np.concatenate((unknown, of_body, known), axis=1))
        clusters.append(tuple(own))
    return replace(system, clusters=tuple(clusters))


def _solved(gram: FloatArray, score: FloatArray) -> FloatArray:
    """Step of least squares, in units in which every unknown is seen equally well."""
    unit = even_unit(gram)
    scaled_gram = gram * np.outer(unit, unit)
    scaled_step = np.linalg.lstsq(scaled_gram, score * unit, rcond=None)[0]
    return unit * np.asarray(scaled_step)
