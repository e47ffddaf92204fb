"""Propose orders of torque ripple that are no whole numbers:
a periodogram of the residual against an axis' angle.

A belt, a strain-wave gear or a cam gives ripple at an order k that no list holds. With a candidate
a cos kθ + b sin kθ at full rate, filtered into rows by D and whitened by w, its score is

    S(k) = Σ_t (Dᵀ w e)_t exp(−i k θ_t).

So the residual e of the rows is spread over the samples by the adjoint of the decimation, summed in
bins of θ, and a Fourier transform of the bins gives all orders at once, move by move. With S_m of
the moves as vectors of two numbers,

    T(k) = SᵀV⁻¹S,        S = Σ S_m,        V = Σ S_m S_mᵀ,

needs no model of the noise: it is that of moves as a whole. Orders are searched, so an order is
proposed only if its T exceeds the largest of all orders, angles and axes in 99 % of draws that give
every move a random sign (`Gates.false_alarm`; V does not change with the signs). A proposed order
then has to pass all gates of the search, beside all other candidates.

Lines closer than one period over the range of the angle cannot be separated. Orders of less than
four periods over it are left to gravity, springs, compensators and smooth functions of the
position.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ident.arrays import FloatArray
from ident.data.conditioning import torque_rows
from ident.discovery.candidates import SearchProblem
from ident.discovery.gates import Gates
from ident.discovery.structure import MIN_MOVES_FOR_STRUCTURE
from ident.effects.effect import Effect, PlacedEffect
from ident.effects.electrical import Cogging
from ident.effects.transmission import Ripple

LARGEST_ORDER = {0: 12.5, 1: 200.0}  #: Per revolution of the motor (0) and of the joint (1)
FEWEST_PERIODS = 4.0  #: Over the range of the angle
BINS_A_PERIOD = 8  #: Of the highest order: rounding an angle to its bin takes 3 % of that line
STEPS_A_LINE = 2  #: Orders of the periodogram within the width of a line, one period over the range
FAMILY = (-2.0, -1.0, 0.0, 1.0, 2.0)
"""Members of a proposed family around its order, in sixths of a line's width:
the refinement needs neighbours.
"""
LINES_AN_AXIS = 2  #: Most orders proposed at once
DRAWS = 199  #: Of random signs; the smallest probability is 1/200
#: Probability that independent orders reach the largest T, above which no draw is made
HOPELESS = 0.3


@dataclass(frozen=True, slots=True)
class Periodogram:
    """Score of every order on one angle of one axis."""

    axis: int  #: index
    of_joint: int  #: 1 for the joint's angle, 0 for the motor's
    range_rev: float  #: of the angle over the runs, in revolutions
    orders: FloatArray  #: periods a revolution, shape (k,)
    scores: FloatArray  #: real and imaginary part of S_m, shape (2, moves, k)

    def statistic(self, signs: FloatArray) -> FloatArray:
        """T of every order with these signs of the moves, shape (draws, moves) → (draws, k)."""
        cosine, sine = self.scores
        a = np.sum(cosine**2, axis=0)
        b = np.sum(cosine * sine, axis=0)
        c = np.sum(sine**2, axis=0)
        # V = (a b; b c) of each order, and S = (x, y): SᵀV⁻¹S = (c x² − 2 b x y + a y²)/(a c − b²).
        determinant = a * c - b**2
        usable = determinant > 1e-9 * (a * c + np.finfo(np.float32).tiny)
        divisor = np.where(usable, determinant, 1.0)
        signs = signs.astype(cosine.dtype)  # halves the work of the two products
        x = signs @ cosine
        y = signs @ sine
        square = c * x**2 - 2.0 * b * x * y + a * y**2
        square = square / divisor
        return np.asarray(np.where(usable, square, 0.0))


def propose_orders(
    search_problem: SearchProblem,
    effects: Iterable[PlacedEffect],
    rng: np.random.Generator,
    gates: Gates,
) -> Mapping[int, tuple[tuple[Effect, ...], ...]]:
    """Find lines in the residual that noise does not make: families of ripple by axis.

    Args:
        search_problem: the residual.
        effects: in the model; orders that they have are not proposed again.
        rng: of the signs.
        gates: of the search; `false_alarm` is the probability of a false line among all.
    """
    if search_problem.folds.moves < MIN_MOVES_FOR_STRUCTURE:
        return {}
    made: list[Periodogram] = []
    for axis in range(search_problem.axes):
        tried = [periodogram(search_problem, axis, one) for one in _angles(search_problem, axis)]
        made += (one for one in tried if one is not None)
    clusters = search_problem.folds.linearisation.cluster_count
    unchanged = np.ones((1, clusters))
    observed = [one.statistic(unchanged)[0] for one in made]
    if not made or _independent_probability(observed, clusters) > HOPELESS:
        return {}
    signs = rng.choice((-1.0, 1.0), size=(DRAWS, clusters))
    largest = np.max([one.statistic(signs).max(axis=1) for one in made], axis=0)
    limit = float(np.quantile(largest, 1.0 - gates.false_alarm, method="higher"))
    proposed: dict[int, tuple[tuple[Effect, ...], ...]] = {}
    for one, statistic in zip(made, observed, strict=True):
        taken = _orders_in_model(one, effects)
        peaks = _peaks(one, statistic, limit, taken)
        families = tuple(_family(one, order) for order in peaks)
        if families:
            proposed[one.axis] = (*proposed.get(one.axis, ()), *families)
    return proposed


def _orders_in_model(one: Periodogram, effects: Iterable[PlacedEffect]) -> list[float]:
    """Orders of a periodogram's angle that the model has already."""
    orders: list[float] = []
    for placed in effects:
        if placed.axis != one.axis or not isinstance(placed.effect, Ripple | Cogging):
            continue
        settings = placed.effect.settings
        if int(settings.get("of_joint", 0)) == one.of_joint:
            orders.append(float(settings["order"]))
    return orders


def periodogram(search_problem: SearchProblem, axis: int, of_joint: int) -> Periodogram | None:
    """Score all orders of ripple on an angle of an axis; None where it turns too little for a line.

    Args:
        search_problem: the residual.
        axis: index of the axis.
        of_joint: 1 for the joint's angle, 0 for the motor's.
    """
    angles: list[FloatArray] = []
    for run in search_problem.runs:
        if of_joint:
            positions = run.position_rad
        else:
            positions = run.motor_position_rad
        angles.append(positions[axis])
    lowest = min(float(angle.min()) for angle in angles)
    highest = max(float(angle.max()) for angle in angles)
    range_rev = (highest - lowest) / (2.0 * np.pi)
    largest = LARGEST_ORDER[of_joint]
    if range_rev * largest <= FEWEST_PERIODS:
        return None
    width_rev = 1.0 / (BINS_A_PERIOD * largest)
    bins = _fast_length(STEPS_A_LINE * range_rev / width_rev)
    first = int(np.ceil(STEPS_A_LINE * FEWEST_PERIODS))
    last = bins // BINS_A_PERIOD
    width_rad = 2.0 * np.pi * width_rev
    places = [((angle - lowest) / width_rad).astype(np.int64) for angle in angles]
    problem = search_problem.folds.linearisation
    observation = search_problem.observation
    if of_joint:
        torque = search_problem.model.drive_train.to_motor[:, axis]
    else:
        torque = np.eye(search_problem.axes)[axis]
    # A whitened line is T_D times its torque at the axes. T_D = P D⁻¹ and P e = e: T_Dᵀe = D⁻¹e,
    # also with preload.
    weights = torque * problem.gamma / problem.noise
    filters = [
        torque_rows(data.rate_hz, observation.conditioning) for data in search_problem.datasets
    ]
    # A line is decorrelated as the residual was: (V^(−1/2)Φ)ᵀe = Φᵀ(V^(−1/2)e).
    residual = problem.decorrelated(problem.residual)
    starts = np.searchsorted(observation.run, np.arange(len(angles)))
    scores = np.zeros((problem.cluster_count, last - first), dtype=np.complex64)
    for rows, _, cluster, motor in search_problem.folds.blocks:
        if weights[motor] == 0.0:
            continue
        source = problem.source[rows]
        run_number = int(observation.run[source[0]])
        begin = int(source.min())
        end = int(source.max())
        # Dᵀ w e: the rows stand apart by the factor of the decimation, and the taps spread each.
        filter_ = filters[run_number]
        samples_apart = np.zeros((end - begin) * filter_.factor + 1)
        samples_apart[(source - begin) * filter_.factor] = weights[motor] * residual[rows]
        at_samples = np.convolve(samples_apart, filter_.taps)
        sample = (begin - int(starts[run_number])) * filter_.factor
        place = places[run_number][sample : sample + len(at_samples)]
        binned = np.bincount(place, at_samples, minlength=bins)
        scores[cluster] += np.fft.rfft(binned)[first:last]
    orders = np.arange(first, last) / (bins * width_rev)
    real_and_imaginary = (scores.real, scores.imag)
    return Periodogram(axis, of_joint, range_rev, orders, np.stack(real_and_imaginary))


def _fast_length(least: float) -> int:
    """Smallest length from there on whose Fourier transform is fast.

    One of a prime length takes twenty times as long. The bins beyond the range stay empty.
    """
    fast: list[int] = []
    for odd in (1, 3, 5, 9, 15, 25, 27, 45, 75):
        fast += (2**twos * odd for twos in range(1, 31))
    return min(length for length in fast if length >= least)


def _angles(search_problem: SearchProblem, axis: int) -> tuple[int, ...]:
    """Angles that show different lines, as `Periodogram.of_joint`.

    Where the motor turns with its joint alone, the joint's angle adds nothing.
    """
    moved_joints = np.count_nonzero(search_problem.model.drive_train.ratio[axis])
    if moved_joints == 1:
        return (0,)
    return (0, 1)


def _independent_probability(observed: Sequence[FloatArray], clusters: int) -> float:
    """Probability that one of so many independent orders reaches the largest T.

    T/m has a beta distribution.
    """
    count = sum(len(statistic) for statistic in observed) / STEPS_A_LINE
    largest = max(float(statistic.max(initial=0.0)) for statistic in observed)
    share = min(largest / clusters, 1.0)
    return float(count * (1.0 - share) ** (0.5 * (clusters - 2)))


def _peaks(
    one: Periodogram, statistic: FloatArray, limit: float, taken: Sequence[float]
) -> list[float]:
    """Orders of the highest lines above the limit, none within a line's width of another one."""
    chosen: list[float] = []
    for index in np.argsort(-statistic):
        if statistic[index] <= limit or len(chosen) == LINES_AN_AXIS:
            break
        order = float(one.orders[index])
        others = (*chosen, *taken)
        if all(abs(order - other) * one.range_rev > 1.0 for other in others):
            chosen.append(order)
    return chosen


def _family(one: Periodogram, order: float) -> tuple[Effect, ...]:
    """Ripples of orders around a line."""
    width = 1.0 / one.range_rev
    members: list[Effect] = []
    for step in FAMILY:
        near = order + step * width / 6.0
        members.append(Ripple(float(f"{near:.6g}"), one.of_joint))
    return tuple(members)
