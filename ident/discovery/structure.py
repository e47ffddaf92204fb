"""Find structure that no named effect explains, and the size of a detectable effect.

Candidates are smooth functions of one variable and periodic ones of the motor's angle
(`ident.effects.unnamed`). They pass the same gates as named effects (`ident.discovery.search`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from ident.arrays import FloatArray
from ident.discovery.candidates import FamilyTrials, SearchProblem
from ident.discovery.gates import Gates
from ident.discovery.search import Finding, is_better, rank_families
from ident.effects.effect import Effect
from ident.effects.signals import Abscissa
from ident.effects.unnamed import FOLDED, INTERVALS, Periodic, Smooth

VARIABLES = (
    (Abscissa.VELOCITY, (0, 1)),
    (Abscissa.POSITION, (0, 1)),
    (Abscissa.LOAD, (0, 1)),
    (Abscissa.TIME, (0, 1)),
    (Abscissa.SESSION, (0, 1)),
    (Abscissa.DISTANCE, (1,)),
    (Abscissa.CURRENT, (0,)),
    (Abscissa.TORQUE_RATE, (0,)),
    (Abscissa.LOAD_CURVATURE, (0,)),
)
"""Each variable, and whether its function is tried as it is (0)
or turning with the direction of motion (1).
"""
#: Share by which a term must explain more than a named effect to call the name wrong
MUCH_MORE = 0.15
MIN_MOVES_FOR_STRUCTURE = 5 * (INTERVALS + 1)  #: Five moves for each coefficient of a term
TAIL = 0.005
"""Share of the samples cut off at either end of a variable's range,
where a spline would rest on a handful of them.
"""


def find_structure(
    search_problem: SearchProblem, axes: Iterable[int], rng: np.random.Generator, gates: Gates
) -> tuple[Finding, ...]:
    """Find variables that the residual of some axes depends on, ranked by left-out moves."""
    if search_problem.folds.moves < MIN_MOVES_FOR_STRUCTURE:
        return ()  # a term of many coefficients would fit the few moves
    tested: list[FamilyTrials] = []
    for axis in axes:
        families = _families(search_problem, axis)
        tested.extend(search_problem.test(families, axis, at_rows=True))
    return rank_families(search_problem, tested, rng, gates)


def is_inadequate(named: Finding, structure: Finding) -> bool:
    """Whether a term that fits anything explains clearly and much more than a named effect.

    Then the true effect is only similar to the named one, and the residual counts as unexplained.
    """
    explains_much_more = structure.left_out_fall > (1.0 + MUCH_MORE) * named.left_out_fall
    if not structure.passed or not explains_much_more:
        return False
    return bool(is_better(structure.fold_errors, named.fold_errors))


def detection_limits_nm(search_problem: SearchProblem, gates: Gates) -> FloatArray:
    """Compute the torque of a detectable effect at each motor, shape (m,).

    It is the root mean square over the moving rows.

    It is torque that the declared model cannot mimic: most of an effect that resembles gravity or
    viscous friction is absorbed by those. The limit holds for effects whose shape the dictionary or
    a spline can follow; on a short recording noise raises it.
    """
    problem = search_problem.folds.linearisation
    squares = np.bincount(problem.motor, problem.residual**2)
    mean_square = squares / np.bincount(problem.motor)
    noise_a = problem.noise * np.sqrt(mean_square)
    noise_nm = noise_a / np.abs(problem.gamma)
    return np.asarray(noise_nm * np.sqrt(gates.smallest_share))


def _families(search_problem: SearchProblem, axis: int) -> tuple[tuple[Effect, ...], ...]:
    """One family a variable, with the range that it has in these runs."""
    families: list[tuple[Effect, ...]] = []
    has_session = not all(np.array_equal(run.time_s, run.session_s) for run in search_problem.rows)
    for variable, signs in VARIABLES:
        if variable is Abscissa.SESSION and not has_session:
            continue
        term = _ranged(search_problem, Smooth(variable), axis)
        members = tuple(replace(term, signed=sign) for sign in signs)
        families.append(members)
    families.append((Periodic(0), Periodic(1)))
    for other in range(search_problem.axes):
        if other == axis:
            continue
        of_other = Smooth(Abscissa.OTHER_VELOCITY, other_axis=other + 1)
        term = _ranged(search_problem, of_other, axis)
        signed = replace(term, signed=1)
        unsigned = replace(term, signed=0)
        families.append((signed, unsigned))
    return tuple(families)


def _ranged(search_problem: SearchProblem, term: Smooth, axis: int) -> Smooth:
    """The term over the range that its variable has in the rows of an axis."""
    if term.other_axis:
        other = term.other_axis - 1
    else:
        other = None
    of_runs = [run.variable(term.variable, axis, other) for run in search_problem.rows]
    is_used = search_problem.observation.use[axis]
    x = np.concatenate(of_runs)[is_used]
    lower_tail = TAIL
    if term.variable in FOLDED:
        x = np.abs(x)
        lower_tail = 0.0
    lower, upper = np.quantile(x, (lower_tail, 1.0 - TAIL))
    upper = max(upper, lower + 1e-9)
    return replace(term, lower=float(lower), upper=float(upper))
