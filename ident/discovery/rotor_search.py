"""Search for losses at a gear with and without the rotor in the load that they multiply.

On some axes the load that the model predicts contains the torque of the rotor: its inertia is
regrouped with parameters of links (`ident.model.base`). A loss at the gear does not multiply that
torque. There, `load-friction` and `efficiency` are proposed in a second form, which leaves the
rotor out of the load. Its rotor inertia J is a setting, and a second coefficient d = c (Ia − J) is
fitted for the error of J (`ident.effects.rotor`). The second form is tried only where the plain one
explains what the gates require, so a search without such a loss costs a few trials.
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

#: Families of effects: those of one name, with the settings that the search tries
Families = tuple[tuple[Effect, ...], ...]

#: Smallest eigenvalue of a redundant drive's mass matrix that is not zero, as a share of the
#: largest
SMALLEST_EIGENVALUE = 1e-6
#: Steps from one guess of a rotor's inertia to the next; each is a fraction of the one before
MAX_STEPS = 6
#: Step after which the joint fit finds the rest, as a share of the largest possible inertia
CONVERGED_SHARE = 0.01
#: Change of d, in its own σ, below which an inertia is not changed any more
NEGLIGIBLE_SIGMAS = 0.1


def axes_with_rotor_in_load(observation: Observation) -> tuple[int, ...]:
    """Return the indices of the axes whose predicted load contains the torque of their rotor.

    There the rotor's inertia is no base parameter, and is regrouped with parameters of links.
    """
    model = observation.model
    base = observation.base
    link_columns = set(model.link_columns.ravel().tolist())
    is_of_link = np.array([column in link_columns for column in base.independent])
    axes: list[int] = []
    for axis, column in enumerate(model.rotor_columns.tolist()):
        weights = base.grouping[:, column]
        if column not in base.independent and weights[is_of_link].any():
            axes.append(axis)
    return tuple(axes)


def propose_losses_without_rotor(
    search_problem: SearchProblem,
    gates: Gates,
    families: Families,
    proposed: Mapping[int, Families],
) -> dict[int, Families]:
    """Add to each family of losses the forms that leave the rotor out of the load.

    Args:
        search_problem: around the model.
        gates: the plain form must explain their least share of a motor's squared residual.
        families: the dictionary.
        proposed: families that are proposed for each axis already.

    Returns:
        ``proposed``, with the extended families of each axis after those that were there.
    """
    losses = [family for family in families if family[0].has_rotor_form]
    by_axis = dict(proposed)
    if not losses:
        return by_axis
    for axis in axes_with_rotor_in_load(search_problem.observation):
        for family in losses:
            better = _better_without_rotor(search_problem, gates, family, axis)
            if better:
                extended = (*family, *better)
                by_axis[axis] = (*by_axis.get(axis, ()), extended)
    return by_axis


def _better_without_rotor(
    search_problem: SearchProblem, gates: Gates, family: tuple[Effect, ...], axis: int
) -> list[Effect]:
    """Forms of a family of losses without the rotor that are better than the plain ones."""
    tested = search_problem.test((family,), axis, at_rows=True)
    if not tested:
        return []
    effects_and_trials = tested[0].members
    trials = [trial for _, trial in effects_and_trials]
    shares = shares_explained(search_problem, trials)
    if max(shares) < gates.smallest_share:
        return []
    better: list[Effect] = []
    for effect, trial in effects_and_trials:
        form = _loss_without_rotor(search_problem, effect, trial, axis)
        if form is not None:
            better.append(form)
    return better


def declared_forms(
    placed: PlacedEffect, observation: Observation, axes: Sequence[str]
) -> tuple[PlacedEffect, ...]:
    """Return the forms in which a declared effect may be fitted, the best first.

    A loss leaves the rotor out of the load where the load contains it. An inertia that is declared
    with it, as from a data sheet, is kept.

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
    declares_rotor = effect.known_rotor_kg_m2 > 0.0 or effect.fits_rotor
    contains_rotor = placed.axis in axes_with_rotor_in_load(observation)
    if declares_rotor and not contains_rotor:
        raise EffectRefused(
            f"the declared {placed.name_among(axes)} is given a rotor; the load of that axis does "
            "not contain its rotor's inertia, which is a parameter of its own: leave "
            "rotor_inertia_kg_m2 and with_rotor out"
        )
    if declares_rotor or not contains_rotor:
        return (placed,)
    without_rotor = effect.with_settings({"with_rotor": 1})
    return (replace(placed, effect=without_rotor), placed)


def _loss_without_rotor(
    search_problem: SearchProblem, effect: Effect, plain: CandidateTrial, axis: int
) -> Effect | None:
    """Leave the rotor out of a loss, with the rotor's inertia that fits best.

    None where the moves left out are not predicted better than by the plain form: where the moves
    do not determine the rotor, its second coefficient makes the prediction worse.

    Args:
        search_problem: around the model.
        effect: the plain form.
        plain: its trial.
        axis: index of its joint.
    """
    largest_kg_m2 = largest_rotor_inertia(search_problem, axis)
    inertia_kg_m2 = search_problem.runs[0].rotor_inertia(axis)
    # Gauss-Newton: J ← J + d/c, with c and d fitted around J
    for _ in range(MAX_STEPS):
        effect = effect.with_settings({"with_rotor": 1, "rotor_inertia_kg_m2": inertia_kg_m2})
        (trial,) = search_problem.trials([search_problem.torque_at_rows(effect, axis)])
        if trial is None or not trial.coefficients[0] > 0.0:
            return None
        previous_kg_m2 = inertia_kg_m2
        inertia_kg_m2 = next_inertia(previous_kg_m2, trial.coefficients, largest_kg_m2)
        if abs(inertia_kg_m2 - previous_kg_m2) <= CONVERGED_SHARE * largest_kg_m2:
            break
    found = effect.with_settings({"rotor_inertia_kg_m2": inertia_kg_m2})
    (trial,) = search_problem.trials([search_problem.torque_at_rows(found, axis)])
    if trial is None or trial.left_out.sum() >= plain.left_out.sum():
        return None
    return found


def with_refined_rotor(
    search_problem: SearchProblem,
    effect: Effect,
    axis: int,
    coefficients: FloatArray,
    coefficients_std: FloatArray,
) -> Effect:
    """Return a loss with the next guess of its rotor's inertia, J + d/c.

    The same effect is returned where d would hardly change. Where d is certainly outside its
    possible values, so that the rotor's inertia would be negative, the data show no rotor: the loss
    then multiplies the load with the rotor in it.

    Args:
        search_problem: around the fit.
        effect: the loss, with the inertia as a setting.
        axis: index of its joint.
        coefficients: c and d of the fit, shape (2,).
        coefficients_std: their σ, shape (2,).
    """
    previous_kg_m2 = effect.known_rotor_kg_m2
    if impossible(effect.coefficients[1:], coefficients[1:], coefficients_std[1:]):
        return effect.with_settings({"with_rotor": 0})
    largest_kg_m2 = largest_rotor_inertia(search_problem, axis)
    inertia_kg_m2 = next_inertia(previous_kg_m2, coefficients, largest_kg_m2)
    change_kg_m2 = abs(inertia_kg_m2 - previous_kg_m2)
    # d = c (Ia − J): another J changes it by c times the change of J.
    if change_kg_m2 * abs(coefficients[0]) <= NEGLIGIBLE_SIGMAS * coefficients_std[1]:
        return effect
    return effect.with_settings({"rotor_inertia_kg_m2": inertia_kg_m2})


def largest_rotor_inertia(search_problem: SearchProblem, axis: int) -> float:
    """Return the largest inertia that the rotor of an axis can have [kg m²].

    The mass matrix M contains it, and what the rotor leaves of M is that of the links, which has no
    negative eigenvalue: M − J e eᵀ ⪰ 0 for J ≤ 1/(eᵀ M⁺ e), with e the unit vector of the axis. A
    redundant drive has this bound. Where M is invertible the larger M_jj is used, which depends on
    no other entry of the estimated M. The least of all postures counts, 0 where that is negative.
    """
    least_kg_m2 = np.inf
    for run in search_problem.runs:
        bound_kg_m2 = run.inertia_kg_m2[axis, axis]
        if search_problem.model.is_redundant:
            by_posture = np.moveaxis(run.inertia_kg_m2, -1, 0)
            inverse = np.linalg.pinv(by_posture, rcond=SMALLEST_EIGENVALUE, hermitian=True)
            bound_kg_m2 = 1.0 / inverse[:, axis, axis]
        least_kg_m2 = min(least_kg_m2, float(np.min(bound_kg_m2)))
    return max(0.0, least_kg_m2)
