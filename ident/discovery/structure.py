"""What no named effect explains: is the residual a function of something all the same?

The terms are smooth functions of one variable, or periodic ones of the motor's angle, and pass the same gates as named
effects. Silence is told with its size: what would have been found.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ident.discovery.candidates import SearchProblem
from ident.discovery.search import Finding, Gates, is_better, rank_families
from ident.effects.effect import Effect
from ident.effects.signals import Abscissa
from ident.effects.unnamed import FOLDED, INTERVALS, Periodic, Smooth

FloatArray = NDArray[np.float64]

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
"""Each variable, and whether its function is tried as it is (0) or turning with the direction of motion (1)."""
MUCH_MORE = 0.15
MIN_MOVES = 5 * (INTERVALS + 1)
"""Five for each coefficient of a term."""
TAIL = 0.005
"""Of the samples at either end of a variable's range: there a spline would rest on a handful of them."""


def find_structure(
    search_problem: SearchProblem, axes: Iterable[int], rng: np.random.Generator, gates: Gates
) -> tuple[Finding, ...]:
    """What the residual of some axes depends on, the best on left-out moves first.

    Args:
        inquiry: the residual.
        axes: to look at.
        rng: of the bootstrap.
        gates: what a term must show.
    """
    if search_problem.folds.moves < MIN_MOVES:
        return ()  # a term of many coefficients would fit the few moves that there are
    tested = [
        found for axis in axes for found in search_problem.test(_families(search_problem, axis), axis, at_rows=True)
    ]
    return rank_families(search_problem, tested, rng, gates)


def is_inadequate(named: Finding, structure: Finding) -> bool:
    """Whether a term that fits anything explains clearly and much more than an effect with a name.

    Then the name is that of something similar, and the residual is called unexplained rather than explained wrongly.
    """
    more = structure.held_out_fall > (1.0 + MUCH_MORE) * named.held_out_fall
    return structure.passed and more and is_better(structure, named)


def detection_limits_nm(search_problem: SearchProblem, gates: Gates) -> FloatArray:
    """Torque (root mean square over the moving rows) that an effect must have at each motor to be found, shape (n,).

    It is torque that the declared model cannot mimic: of an effect that looks much like gravity or viscous friction
    most is taken up by those.

    It is what opens the gates on the size of an effect whose shape the dictionary or a spline can follow; on a short
    recording noise asks for more.
    """
    problem = search_problem.folds.problem
    noise_a = np.array(
        [
            problem.noise[i] * float(np.sqrt(np.mean(problem.residual[problem.motor == i] ** 2)))
            for i in range(search_problem.axes)
        ]
    )
    return np.asarray(noise_a / np.abs(problem.gamma) * np.sqrt(gates.smallest_share))


def _families(search_problem: SearchProblem, axis: int) -> tuple[tuple[Effect, ...], ...]:
    """A family a variable, with the range that it has in these runs."""
    families: list[tuple[Effect, ...]] = []
    for variable, signs in VARIABLES:
        if variable is Abscissa.SESSION and not _has_session(search_problem):
            continue
        term = _ranged(search_problem, Smooth(variable), axis)
        families.append(tuple(replace(term, signed=sign) for sign in signs))
    families.append((Periodic(0), Periodic(1)))
    for other in range(search_problem.axes):
        if other != axis:
            term = _ranged(search_problem, Smooth(Abscissa.OTHER_VELOCITY, other_axis=other + 1), axis)
            families.append((replace(term, signed=1), replace(term, signed=0)))
    return tuple(families)


def _has_session(search_problem: SearchProblem) -> bool:
    return any(not np.array_equal(run.time_s, run.session_s) for run in search_problem.rows)


def _ranged(search_problem: SearchProblem, term: Smooth, axis: int) -> Smooth:
    other = term.other_axis - 1 if term.other_axis else None
    x = np.concatenate([run.variable(term.variable, axis, other) for run in search_problem.rows])
    x = x[search_problem.observation.use[axis]]
    if term.variable in FOLDED:
        x = np.abs(x)
    lower, upper = np.quantile(x, (0.0 if term.variable in FOLDED else TAIL, 1.0 - TAIL))
    return replace(term, lower=float(lower), upper=float(max(upper, lower + 1e-9)))
