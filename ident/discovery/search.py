"""Find the effect that a residual asks for, or say that it asks for none.

The lag-one correlation of a residual is about 0.67, so textbook tests lie. A candidate must pass every gate:

1. cluster Wald, max-T: its statistic, clustered by move, is larger than the largest of all candidates' in 99 % of
   draws in which each move's noise keeps its size and gets a random sign (a wild bootstrap, Cameron et al. 2008), or in
   95 % where it is better on nearly all folds and by a tenth;
2. it is better on at least three quarters of the folds of left-out moves;
3. it explains at least 3 % of the squared residual of the motor that feels it most;
4. that motor's error on left-out moves falls by at least 2 %.

Candidates are ranked by left-out moves, and the setting of a family (its exponent, its speed) is chosen anew inside
each fold, by the other folds alone: the score of a family has not seen what it is scored on.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from ident.discovery.candidates import SearchProblem, TestedFamily, Trial
from ident.effects.dictionary import EFFECTS
from ident.effects.effect import Effect, PlacedEffect

FloatArray = NDArray[np.float64]
Place = tuple[str, int, tuple[int, ...]]

AS_GOOD = 0.99
"""Of the best one's fall on left-out moves."""
CLEARLY = 0.95
"""Confidence of a paired comparison over folds (Student's t; folds share training data, so it is a rough one)."""


@dataclass(frozen=True, slots=True)
class Gates:
    """What a candidate must show before it may join the model.

    Attributes:
        false_alarm: largest probability that noise makes one this strong anywhere.
        folds_better, explained, error_fall: least share of folds, of the motor's squared residual and of its error on
            left-out moves.
        strong_folds, strong_fall: whoever shows as much on left-out moves may have strong_false_alarm: with few moves
            the bootstrap sees little, and being right on what was not seen is evidence of another kind.
        strong_false_alarm: see there.
        draws: of the bootstrap.
    """

    false_alarm: float = 0.01
    folds_better: float = 0.75
    explained: float = 0.03
    error_fall: float = 0.02
    strong_folds: float = 0.875
    strong_fall: float = 0.1
    strong_false_alarm: float = 0.05
    draws: int = 999

    @property
    def smallest_share(self) -> float:
        """Of a motor's squared residual: what explains less passes no gate."""
        return max(self.explained, 1.0 - (1.0 - self.error_fall) ** 2)


@dataclass(frozen=True, slots=True)
class Finding:
    """One family on one axis, and what the data say of it.

    Attributes:
        effect: with the setting that explains most.
        axis: index of the joint (or motor).
        coefficients, deviations: first estimate of its linear parameters, and its σ by the scatter of moves.
        probability: that noise alone makes a candidate this strong somewhere among all.
        folds_better: share of folds on which it lowers the error.
        explained: share of the squared residual of the motor that feels it most.
        error_before_percent, error_after_percent: of that motor on left-out moves, ‖e‖/‖v‖ of its current [%].
        error_fall: relative fall from one to the other.
        held_out_fall: fall of the whole whitened ‖e‖² on left-out moves; the rank.
        passed: whether every gate is open.
        fold_errors: ‖e‖² of the whole on each fold, shape (folds,); what a paired comparison with another one needs.
        share_of_excess: of the motor's squared residual beyond its noise floor; None where that is not known.
        ambiguity: others whose left-out score cannot be told from this one's.
    """

    effect: Effect
    axis: int
    coefficients: FloatArray
    deviations: FloatArray
    probability: float
    folds_better: float
    explained: float
    error_before_percent: float
    error_after_percent: float
    error_fall: float
    held_out_fall: float
    passed: bool
    fold_errors: FloatArray
    ambiguity: tuple[PlacedEffect, ...] = ()
    share_of_excess: float | None = None


def rank_effects(
    search_problem: SearchProblem,
    rng: np.random.Generator,
    gates: Gates | None = None,
    families: tuple[tuple[Effect, ...], ...] = EFFECTS,
) -> tuple[Finding, ...]:
    """All families on all axes, the best on left-out moves first.

    Args:
        inquiry: the residual.
        rng: of the bootstrap.
        gates: what a candidate must show.
        families: the dictionary.
    """
    tested = [found for axis in range(search_problem.axes) for found in search_problem.test(families, axis)]
    return rank_families(search_problem, tested, rng, gates or Gates())


def choose_effect(findings: Sequence[Finding], taken: frozenset[Place] = frozenset()) -> Finding | None:
    """The best that passed; of those as good on the same axis, the one with the fewest parameters.

    A hinge that begins where the joint never comes is a spring, and is called one.

    Args:
        findings: ranked.
        taken: what is in the model already, or cannot be added; an effect joins an axis once.
    """
    passed = [finding for finding in findings if finding.passed and place_of(finding.effect, finding.axis) not in taken]
    if not passed:
        return None
    best = passed[0]
    alike = [
        finding
        for finding in passed
        if finding.axis == best.axis and finding.held_out_fall >= AS_GOOD * best.held_out_fall
    ]
    return min(alike, key=lambda finding: _parameters(finding.effect))


def place_of(effect: Effect, axis: int) -> Place:
    """What makes two effects the same whatever their real settings are: two orders of a ripple are two effects."""
    return effect.name, axis, tuple(value for value in effect.settings.values() if isinstance(value, int))


def rank_families(
    search_problem: SearchProblem, tested: Sequence[TestedFamily], rng: np.random.Generator, gates: Gates
) -> tuple[Finding, ...]:
    """What the data say of each family, ranked by left-out moves.

    Args:
        inquiry: the residual.
        tested: on it; they compete for the largest statistic that noise alone would give.
        rng: of the bootstrap.
        gates: what a candidate must show.
    """
    if not tested:
        return ()
    trials = tuple(trial for family in tested for _, trial in family.members)
    probabilities = iter(_max_t(trials, rng, gates.draws))
    before = search_problem.folds.square_sum(search_problem.folds.residual)
    findings = [_judge(search_problem, before, family, probabilities, gates) for family in tested]
    ranked = sorted(findings, key=lambda finding: -finding.held_out_fall)
    return tuple(replace(finding, ambiguity=_alike(finding, ranked)) for finding in ranked)


def is_better(one: Finding, other: Finding) -> bool:
    """Whether a paired comparison over folds tells that one explains more than another."""
    gain = other.fold_errors - one.fold_errors
    error = float(np.std(gain, ddof=1)) * float(np.sqrt(len(gain)))
    return float(gain.sum()) > float(special.stdtrit(len(gain) - 1, 0.5 + CLEARLY / 2.0)) * error


def _parameters(effect: Effect) -> int:
    return len(effect.coefficients) + len(effect.settings)


def _judge(
    search_problem: SearchProblem,
    before: FloatArray,
    family: TestedFamily,
    probabilities: Iterator[float],
    gates: Gates,
) -> Finding:
    problem, members = search_problem.folds.problem, family.members
    probability = [next(probabilities) for _ in members]
    best = int(np.argmax([float(trial.fallen.sum()) for _, trial in members]))
    effect, trial = members[best]
    after = family.nested()
    fall = before.sum(axis=1) - after.sum(axis=1)
    # A joint's torque may be another motor's to give (R): the drive in question is the one whose residual falls most.
    motor = int(np.argmax(trial.fallen))
    rows = problem.motor == motor
    own, size = float(np.sum(problem.residual[rows] ** 2)), float(np.sum(problem.current[rows] ** 2))
    explained = float(trial.fallen[motor] / own)
    error_before, error_after = (float(np.sqrt(part[:, motor].sum() / size)) for part in (before, after))
    error_fall = 1.0 - error_after / error_before
    folds_better = float(np.mean(fall > 0))
    strong = folds_better >= gates.strong_folds and error_fall >= gates.strong_fall
    passed = (
        probability[best] <= (gates.strong_false_alarm if strong else gates.false_alarm)
        and folds_better >= gates.folds_better
        and explained >= gates.explained
        and error_fall >= gates.error_fall
    )
    return Finding(
        effect=effect,
        axis=family.axis,
        coefficients=trial.coefficients,
        deviations=_deviations(trial),
        probability=float(probability[best]),
        folds_better=folds_better,
        explained=explained,
        error_before_percent=100.0 * error_before,
        error_after_percent=100.0 * error_after,
        error_fall=error_fall,
        held_out_fall=float(fall.sum()),
        passed=bool(passed),
        share_of_excess=_share_of_excess(search_problem, motor, float(trial.fallen[motor]), own),
        fold_errors=after.sum(axis=1),
    )


def _deviations(trial: Trial) -> FloatArray:
    """σ of the coefficients, G⁻¹XᵀXG⁻¹ over moves (Liang & Zeger, 1986)."""
    spread = trial.scatter @ np.linalg.pinv(trial.gram.sum(axis=0))
    return np.asarray(np.sqrt(np.sum(spread**2, axis=0)))


def _share_of_excess(search_problem: SearchProblem, motor: int, fallen: float, own: float) -> float | None:
    floor_a, problem = search_problem.floors_a[motor], search_problem.folds.problem
    if floor_a is None:
        return None
    excess = own - float(np.sum(problem.motor == motor)) * (floor_a / problem.noise[motor]) ** 2
    return None if excess <= 0.0 else min(fallen / excess, 1.0)


def _max_t(trials: tuple[Trial, ...], rng: np.random.Generator, draws: int) -> FloatArray:
    """Probability of each candidate's Wald statistic under random signs of the moves, for the largest of all."""
    moves = trials[0].scatter.shape[0]
    signs = rng.choice((-1.0, 1.0), size=(draws, moves))
    observed, largest = np.empty(len(trials)), np.full(draws, -np.inf)
    for index, trial in enumerate(trials):
        # The candidate is in the fit here: else its own torque would count as noise, and the strongest would hide best.
        inverse = np.linalg.pinv(trial.scatter.T @ trial.scatter)
        freedom = len(trial.score)
        # On the scale of −log p, so that candidates with one and with two coefficients compete alike.
        observed[index] = _surprise(trial.score @ inverse @ trial.score, freedom)
        largest = np.maximum(largest, _surprise(_drawn_wald(trial, signs), freedom))
    return np.asarray((1.0 + np.sum(largest[None] >= observed[:, None], axis=1)) / (draws + 1.0))


def _surprise(wald: FloatArray, freedom: int) -> FloatArray:
    """−log p of χ² statistics, finite however large they are."""
    return np.asarray(-np.log(np.maximum(special.chdtrc(freedom, wald), np.finfo(np.float64).tiny)))


def _drawn_wald(trial: Trial, signs: FloatArray) -> FloatArray:
    """The Wald statistic of each draw, with a scatter of its own: few moves would else look surer than they are.

    In a draw, x_m becomes s_m x_m; its sum S is taken for an effect β = G⁻¹S, and what is left in move m is
    s_m x_m − G_m β (the studentised wild bootstrap of Cameron, Gelbach & Miller, 2008).
    """
    x, gram = trial.scatter, trial.gram
    p = x.shape[1]
    sums = signs @ x
    fitted = sums @ np.linalg.pinv(gram.sum(axis=0))
    crossed = (signs @ np.einsum("ma,mbc->mabc", x, gram).reshape(len(x), -1)).reshape(-1, p * p, p)
    mixed = np.matmul(crossed, fitted[:, :, None]).reshape(-1, p, p)
    # Σ_m (G_m β)(G_m β)ᵀ, linear in ββᵀ: one matrix for all draws.
    squares = np.einsum("mab,mcd->bdac", gram, gram).reshape(p * p, p * p)
    pairs = (fitted[:, :, None] * fitted[:, None, :]).reshape(-1, p * p)
    left = x.T @ x - mixed - np.swapaxes(mixed, 1, 2) + (pairs @ squares).reshape(-1, p, p)
    left += 1e-12 * np.trace(left, axis1=1, axis2=2)[:, None, None] * np.eye(p)  # a coefficient that no draw scatters
    return np.asarray(np.sum(sums * np.linalg.solve(left, sums[:, :, None])[:, :, 0], axis=1))


def _alike(finding: Finding, ranked: Sequence[Finding]) -> tuple[PlacedEffect, ...]:
    """The others that a paired comparison over folds cannot tell from it."""
    return tuple(
        PlacedEffect(other.effect, other.axis)
        for other in ranked
        if other is not finding
        and other.held_out_fall > 0
        and not is_better(finding, other)
        and not is_better(other, finding)
    )


# The setting of an accepted effect, found between those that the dictionary tries.


STEPS = 6
"""Of the golden section: the bracket between two neighbours becomes an eighteenth."""
DECLARED = {"exponent": (0.8, 1.25)}
"""Settings between which an effect is nearly one that is declared: friction with exponent one is viscous."""
GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0


def refine_setting(
    search_problem: SearchProblem, effect: Effect, axis: int, families: Iterable[Sequence[Effect]]
) -> Effect:
    """Golden section on the squared residual, over the logarithm of a setting, between its neighbours in the family.

    An effect without a positive real setting, or at the end of its family, is returned as it is.

    Args:
        inquiry: the residual.
        effect, axis: accepted.
        families: the dictionary that it came from.
    """
    family = next((members for members in families if effect in members), None)
    if family is None:
        return effect
    for name, value in effect.settings.items():
        if not isinstance(value, float) or not is_dataclass(effect):
            continue
        others = {key: setting for key, setting in effect.settings.items() if key != name}
        grid = sorted(
            member.settings[name]
            for member in family
            if {key: setting for key, setting in member.settings.items() if key != name} == others
        )
        place = grid.index(value)
        if grid[0] > 0 and 0 < place < len(grid) - 1:
            lower, upper = _one_side(name, value, grid[place - 1], grid[place + 1])
            return _golden(search_problem, effect, axis, name, lower, upper)
    return effect


def _one_side(name: str, value: float, lower: float, upper: float) -> tuple[float, float]:
    """The part of a bracket on whose side of DECLARED the value lies."""
    if name not in DECLARED:
        return lower, upper
    below, above = DECLARED[name]
    return (lower, min(upper, below)) if value < below else (max(lower, above), upper)


def _golden(search_problem: SearchProblem, effect: Effect, axis: int, name: str, lower: float, upper: float) -> Effect:
    a, b = float(np.log(lower)), float(np.log(upper))

    def fall(x: float) -> float:
        (trial,) = search_problem.trials([search_problem.torque(_with(effect, name, float(np.exp(x))), axis)])
        return -np.inf if trial is None else float(trial.fallen.sum())

    inner, outer = b - GOLDEN * (b - a), a + GOLDEN * (b - a)
    at_inner, at_outer = fall(inner), fall(outer)
    for _ in range(STEPS):
        if at_inner > at_outer:
            b, outer, at_outer = outer, inner, at_inner
            inner = b - GOLDEN * (b - a)
            at_inner = fall(inner)
        else:
            a, inner, at_inner = inner, outer, at_outer
            outer = a + GOLDEN * (b - a)
            at_outer = fall(outer)
    best = float(f"{np.exp((a + b) / 2.0):.4g}")
    return _with(effect, name, best) if fall(np.log(best)) > fall(np.log(effect.settings[name])) else effect


def _with(effect: Effect, name: str, value: float) -> Effect:
    if not is_dataclass(effect) or name not in {part.name for part in fields(effect)}:
        return effect
    changed: Effect = replace(effect, **{name: value})
    return changed
