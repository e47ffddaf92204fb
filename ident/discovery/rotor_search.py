"""Propose what the rotor takes of the load, for losses at a gear whose load contains the rotor.

Which axes these are follows from the base parameters: the column of the rotor's inertia depends on
columns of links. There `load-friction` and `efficiency` are proposed in a second form, with the
rotor's inertia as a setting and the rest of it as a coefficient (`ident.effects.rotor`). It is
tried only where the plain form explains what the gates require, so a search without such a loss
costs a few trials.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ident.arrays import FloatArray
from ident.discovery.candidates import CandidateTrial, SearchProblem, shares_explained
from ident.discovery.gates import Gates, impossible
from ident.effects.effect import Effect, PlacedEffect
from ident.effects.rotor import next_inertia
from ident.equations.observation import Observation
from ident.errors import EffectRefused

Families = tuple[tuple[Effect, ...], ...]

#: Of the mass matrix of a redundant drive, in parts of the largest, that is not zero
SMALLEST_EIGENVALUE = 1e-6
MOST_STEPS = 6  #: Of a rotor's inertia; each is a fraction of the one before
SETTLED_SHARE = 0.01  #: Of the largest inertia, a step after which the joint fit does the rest
CLOSE_ENOUGH = 0.1  #: Standard deviations of the inertia below which a step no longer matters


def axes_with_rotor_in_load(observation: Observation) -> tuple[int, ...]:
    """Indices of the axes whose predicted load contains the rotor: links move as it does."""
    model = observation.model
    base = observation.base
    links = set(model.link_columns.ravel().tolist())
    of_links = np.array([column in links for column in base.independent])
    found = []
    for axis, column in enumerate(model.rotor_columns.tolist()):
        weights = base.grouping[:, column]
        if column not in base.independent and weights[of_links].any():
            found.append(axis)
    return tuple(found)


def propose_rotors(
    search_problem: SearchProblem,
    gates: Gates,
    families: Families,
    proposed: Mapping[int, Families],
) -> dict[int, Families]:
    """Return each family of losses with the form that leaves the rotor out, by axis.

    Args:
        search_problem: around the model.
        gates: the plain form must explain their least share of a motor's squared residual.
        families: the dictionary.
        proposed: what is proposed for each axis already; it is kept.
    """
    losses = [family for family in families if family[0].has_rotor_form]
    found = dict(proposed)
    if not losses:
        return found
    for axis in axes_with_rotor_in_load(search_problem.observation):
        for family in losses:
            better = _better_forms(search_problem, gates, family, axis)
            if better:
                found[axis] = (*found.get(axis, ()), (*family, *better))
    return found


def _better_forms(
    search_problem: SearchProblem, gates: Gates, family: tuple[Effect, ...], axis: int
) -> list[Effect]:
    """Forms of a family of losses that leave the rotor out, and are better than the plain ones."""
    tested = search_problem.test((family,), axis, at_rows=True)
    if not tested:
        return []
    members = tested[0].members
    shares = shares_explained(search_problem, [trial for _, trial in members])
    if max(shares) < gates.smallest_share:
        return []
    better: list[Effect] = []
    for effect, trial in members:
        form = without_rotor(search_problem, effect, trial, axis)
        if form is not None:
            better.append(form)
    return better


def declared_forms(
    placed: PlacedEffect, observation: Observation, axes: Sequence[str]
) -> tuple[PlacedEffect, ...]:
    """Return the forms in which a declared effect may be fitted, the best first.

    A loss leaves the rotor out where the load contains it and no inertia is declared; a declared
    one, as from a data sheet, is kept.

    Args:
        placed: the declared effect.
        observation: rows of the fit.
        axes: names of the axes, for the error.

    Raises:
        EffectRefused: a rotor's inertia is declared where the load does not contain the rotor.
    """
    effect = placed.effect
    if not effect.has_rotor_form:
        return (placed,)
    given = effect.known_rotor_kg_m2 > 0.0 or effect.fits_rotor
    contains_rotor = placed.axis in axes_with_rotor_in_load(observation)
    if given and not contains_rotor:
        raise EffectRefused(
            f"the declared {placed.name_among(axes)} is given a rotor; the load of that axis does "
            "not contain its rotor's inertia, which is a parameter of its own: leave "
            "rotor_inertia_kg_m2 and with_rotor out"
        )
    if given or not contains_rotor:
        return (placed,)
    fitted = effect.with_settings({"with_rotor": 1})
    return (replace(placed, effect=fitted), placed)


def without_rotor(
    search_problem: SearchProblem, effect: Effect, plain: CandidateTrial, axis: int
) -> Effect | None:
    """Return the form of a loss that leaves the rotor out, with the inertia that fits best.

    None where no inertia is better than the plain form. Its second coefficient costs certainty:
    where the moves do not show the rotor, they are predicted worse with it.

    Args:
        search_problem: around the model.
        effect: the plain form.
        plain: its trial.
        axis: index of its joint.
    """
    largest_kg_m2 = largest_inertia(search_problem, axis)
    inertia_kg_m2 = search_problem.runs[0].rotor_inertia(axis)
    for _ in range(MOST_STEPS):
        effect = effect.with_settings({"with_rotor": 1, "rotor_inertia_kg_m2": inertia_kg_m2})
        (trial,) = search_problem.trials([search_problem.torque_at_rows(effect, axis)])
        if trial is None or not trial.coefficients[0] > 0.0:
            return None
        before_kg_m2 = inertia_kg_m2
        inertia_kg_m2 = next_inertia(before_kg_m2, trial.coefficients, largest_kg_m2)
        if abs(inertia_kg_m2 - before_kg_m2) <= SETTLED_SHARE * largest_kg_m2:
            break
    found = effect.with_settings({"rotor_inertia_kg_m2": inertia_kg_m2})
    (trial,) = search_problem.trials([search_problem.torque_at_rows(found, axis)])
    if trial is None or trial.left_out.sum() >= plain.left_out.sum():
        return None
    return found


def refined_rotor(
    search_problem: SearchProblem,
    effect: Effect,
    axis: int,
    coefficients: FloatArray,
    deviations: FloatArray,
) -> Effect:
    """Return a loss with the rotor's inertia that its fit calls for.

    The same effect is returned where its inertia is close enough. Where the fit calls for a rotor
    whose inertia is certainly negative, the data show none: the loss then multiplies the load with
    the rotor in it.

    Args:
        search_problem: around the fit.
        effect: the loss, with the inertia as a setting.
        axis: index of its joint.
        coefficients: of the fit, c and d, shape (2,).
        deviations: their σ, shape (2,).
    """
    before_kg_m2 = effect.known_rotor_kg_m2
    if impossible(effect.coefficients[1:], coefficients[1:], deviations[1:]):
        return effect.with_settings({"with_rotor": 0})
    largest_kg_m2 = largest_inertia(search_problem, axis)
    inertia_kg_m2 = next_inertia(before_kg_m2, coefficients, largest_kg_m2)
    change_kg_m2 = abs(inertia_kg_m2 - before_kg_m2)
    if change_kg_m2 * abs(coefficients[0]) <= CLOSE_ENOUGH * deviations[1]:
        return effect
    return effect.with_settings({"rotor_inertia_kg_m2": inertia_kg_m2})


def largest_inertia(search_problem: SearchProblem, axis: int) -> float:
    """Return the largest inertia that the rotor of an axis can have [kg m²].

    Links have no negative inertia. With M the mass matrix that contains it, M − J e eᵀ has no
    negative eigenvalue for J ≤ 1/(eᵀ M⁺ e). M_jj, which is larger, is used where M is invertible:
    it needs no other estimate than its own. The least of all postures counts; zero where the model
    has none.
    """
    least = np.inf
    for run in search_problem.runs:
        inertia_kg_m2 = run.inertia_kg_m2[axis, axis]
        if search_problem.model.is_redundant:
            by_posture = np.moveaxis(run.inertia_kg_m2, -1, 0)
            mobility = np.linalg.pinv(by_posture, rcond=SMALLEST_EIGENVALUE, hermitian=True)
            inertia_kg_m2 = 1.0 / mobility[:, axis, axis]
        least = min(least, float(np.min(inertia_kg_m2)))
    return max(0.0, least)
