"""Noise of each motor's current at rest and between repeated moves;
the latter bounds a model's error from below.

Two estimates of σ² are made of parts in which no model has anything to explain:

- a dwell: while a joint stands still, friction holds it within ±Fs, the amplifier's integrator
  creeps, and faster changes of the current are noise of measurement and control;
- a pair of repeated moves: two stretches in which the motor moves and all axes follow the same
  path. In the difference of their currents, divided by √2, torques that depend on the path cancel,
  and so do the errors of any model of them. Disturbances, quantisation, noise of encoder and
  control, and ripple whose phase is random remain.

A disturbance also moves the arm a little, and a model that is given the measured motion explains
the inertia's share of the current. So the differences of acceleration of all axes are fitted to
that of a pair and subtracted: without this, pairs exceed the error of the fit where a disturbance
acts inside the position loop. Differences of position and velocity stay in: the controller makes
its current of them, and they would take the disturbance away.

Parts longer than LONGEST_MOVE_S are cut, as moves are. Each is filtered and decimated like every
row (windows wholly inside), a parabola in time is subtracted, and the rest gives an estimate of σ²
from each part d,

    s_d² = ‖M_d v_d‖²/tr(M_d P_d),        M_d = I − H_d,

with H_d the projection on (1, t, t²) and the differences of acceleration, and P_d the correlation
that the filter itself gives to rows of white noise, so that a short part counts only by what the
projection leaves of it. s_d² is nearly σ² χ²_ν/ν with ν = tr(MP)²/tr(MPMP) (Satterthwaite 1946);
divided by the median of χ²_ν/ν every part is as likely above σ² as below, and σ² is their median,
weighted by ν. A median, because an axis slips or rings in some of its dwells and is disturbed in
some moves.

Pairs are neighbours in time, so that warm-up changes little between them; the parabola subtracts a
change of Coulomb friction. Of m repetitions they are m − 1 pairs, each of which shares a move with
the next: together they have 2(m − 1)²/(3m − 4) times the freedom of one (von Neumann, Kent,
Bellinson & Hart 1941), not m − 1 times.

The smaller estimate is taken: either can be too high, standstill where an axis hunts about its
target or a brake takes the load over in most dwells, repeated moves where the robot warms up or the
paths differ a little.

What it is. Repeated moves show a part of the noise in motion: ripple that repeats, commutation
error, and noise slower than a part are not in it. Where all noise is in the current, they show all
of it, and half of the estimates are too high, by their own σ. So no estimate is a bound, but its
lower 95 % limit is one, `MotorNoiseFloor.least_a`: of 96 limits on axes of clean simulated cells, 2
are above the error of a fit of the right model. It is not tight: where a torque disturbs the arm,
it is 0.8 to 0.9 of that error, and less where standstill shows less.

Standstill alone bounds nothing. The load of an axis that stands still changes while others move,
and its integrator follows: in recordings of 40 s, 12 of 47 limits from standstill are above the
error of the right model, by up to 58 %. Elsewhere it is a fraction of that error, 0.1 to 0.7 with a
disturbance (`tests/studies/floor_study.py`). Such an estimate is shown as one, and is no noise
floor (`MotorNoiseFloor.is_bound`).

A source may still be no part of the noise in motion, as a brake that takes over the load at rest.
An estimate far above the error of a model on rows in motion is refuted
(`MotorNoiseFloor.is_refuted`); a limit that chance has put above that error is shown as the error.
Parts with one constant number (power stage off, brake on, one run given twice) are no measurement
and are left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import lru_cache

import numpy as np
import scipy  # loads scipy.special when it is first used: a fit needs none of it

from ident.arrays import FloatArray, true_stretches
from ident.data.conditioning import Conditioning, decimator
from ident.data.dataset import LONGEST_MOVE_S, Dataset
from ident.equations.rows import row_filter

MIN_DWELLS = 8
#: Fewer than dwells: a stretch of motion is longer, and no brake or settling controller is in it
MIN_PAIRS = 4
MIN_FREEDOM = 20.0  #: σ is then known to 20 %
PATH_TOLERANCE = 2e-3
"""Largest distance between the paths of two repetitions, as a share of each axis's travel: the
torques of both then differ by about as small a share, and a difference that is left makes the
estimate too high, never too low.
"""
DURATION_TOLERANCE = 0.1  #: Largest difference in duration: an axis creeps into its target
CONFIDENCE = 0.95  #: That the noise is no less than the lower limit, one-sided
REFUTED_SIGMAS = 3.0  #: Under a perfect model, one floor in 700 is refuted by chance
#: Coefficients of the parabola: a straight line would leave the bend of a settling controller
_TREND = 3
#: Efficiency of a median of many against their mean (van der Vaart 1998, §21.2)
_MEDIAN_EFFICIENCY = 2.0 / np.pi


class FloorSource(Enum):
    """Rows that a noise floor is measured on."""

    STANDSTILL = "standstill"
    REPEATED_MOVES = "repeated moves"


@dataclass(frozen=True, slots=True)
class MotorNoiseFloor:
    """Noise of one motor's current, and whether it bounds the error of a model."""

    noise_a: float  #: estimate of σ of the current in the observation's rows [A]
    source: FloorSource
    #: number of standstills, or of pairs of repeated moves, used; long ones count as several
    parts: int
    freedom: float  #: their degrees of freedom; pairs that share a move count less
    #: whether repeated moves show no less: `least_a` then bounds the error of any model
    is_bound: bool = False

    @property
    def std_percent(self) -> float:
        """Relative standard deviation of noise_a itself, for Gaussian noise [%]."""
        return 100.0 / float(np.sqrt(2.0 * _MEDIAN_EFFICIENCY * self.freedom))

    @property
    def least_a(self) -> float:
        """Lower limit of this noise at CONFIDENCE [A]."""
        freedom = _MEDIAN_EFFICIENCY * self.freedom
        largest_chi2 = scipy.special.chdtri(freedom, 1.0 - CONFIDENCE)
        return float(self.noise_a * np.sqrt(freedom / largest_chi2))

    def is_refuted(self, left_a: float) -> bool:
        """Whether a model leaves so little on rows in motion that the floor is too high.

        Args:
            left_a: root mean square of the model's error there [A].
        """
        tolerance = REFUTED_SIGMAS * self.std_percent / 100.0
        return bool(self.noise_a > (1.0 + tolerance) * left_a)


@dataclass(frozen=True, slots=True)
class _Part:
    """One estimate of σ², from a dwell or from a pair of repeated moves."""

    variance_a2: float  #: s_d²
    freedom: float  #: ν
    weight: float  #: freedom that it adds to the others'


def noise_floors(
    datasets: Sequence[Dataset],
    conditioning: Conditioning,
    sources: Sequence[FloorSource] = tuple(FloorSource),
) -> tuple[MotorNoiseFloor | None, ...]:
    """Estimate the noise of each motor's current in rows.

    Args:
        datasets: of one robot.
        conditioning: the filter of the rows.
        sources: estimates to make.

    Returns:
        one a motor: the smallest of the estimates, None where the data allow none.

    Raises:
        DataUnfit: a run is too short for the filter.
    """
    for data in datasets:
        row_filter(data, conditioning)
    parts_of = {FloorSource.STANDSTILL: _dwells, FloorSource.REPEATED_MOVES: _pairs}
    floors: list[MotorNoiseFloor | None] = []
    for motor in range(datasets[0].current_a.shape[1]):
        made = [
            _floor(tuple(parts_of[source](datasets, conditioning, motor)), source)
            for source in sources
        ]
        known = [floor for floor in made if floor is not None]
        smallest = min(known, key=lambda floor: floor.noise_a, default=None)
        if smallest is not None:
            in_motion = any(floor.source is FloorSource.REPEATED_MOVES for floor in known)
            smallest = replace(smallest, is_bound=in_motion)
        floors.append(smallest)
    return tuple(floors)


def _floor(parts: Sequence[_Part], source: FloorSource) -> MotorNoiseFloor | None:
    """Weighted median of the parts, None if they are too few or too short."""
    if source is FloorSource.STANDSTILL:
        fewest = MIN_DWELLS
    else:
        fewest = MIN_PAIRS
    total = sum(part.weight for part in parts)
    if len(parts) < fewest or total < MIN_FREEDOM:
        return None
    variance = np.array([part.variance_a2 for part in parts])
    freedom = np.array([part.freedom for part in parts])
    weight = np.array([part.weight for part in parts])
    # s²ν over the median of χ²_ν: as likely above σ² as below.
    median_chi2 = scipy.special.chdtri(freedom, 0.5)
    likely = variance * freedom / median_chi2
    order = np.argsort(likely)
    share = np.cumsum(weight[order]) / total
    middle = int(np.searchsorted(share, 0.5))
    noise_a = float(np.sqrt(likely[order][middle]))
    return MotorNoiseFloor(noise_a, source, len(parts), float(total))


def _dwells(datasets: Sequence[Dataset], conditioning: Conditioning, motor: int) -> Iterator[_Part]:
    """Parts of the standstills of a motor."""
    for data in datasets:
        is_still = ~data.motor_moving[:, motor] & data.valid[:, motor]
        for first, end in true_stretches(is_still):
            current_a = data.current_a[first:end, motor]
            yield from _parts(current_a[None], data.rate_hz, conditioning)


def _pairs(datasets: Sequence[Dataset], conditioning: Conditioning, motor: int) -> Iterator[_Part]:
    """Parts of the differences between repeated moves of a motor."""
    for differences, rate_hz in _repetitions(datasets, motor):
        # Neighbouring pairs share a move.
        pairs = len(differences)
        share = 2.0 * pairs / (3.0 * pairs - 1.0)
        for difference in differences:
            # A difference has twice the variance of a move.
            signals = difference / np.sqrt(2.0)
            yield from _parts(signals, rate_hz, conditioning, share=share)


def _parts(
    signals: FloatArray, rate_hz: float, conditioning: Conditioning, share: float = 1.0
) -> Iterator[_Part]:
    """Variance and freedom by the rows of each piece of a part, unless it is short or constant.

    Args:
        signals: the current [A], and after it what is subtracted from it by least squares, shape
            (s, k).
        rate_hz: sampling rate.
        conditioning: the filter of the rows.
        share: of its freedom that a part adds to that of the others.
    """
    cutoff_hz = conditioning.decimation_cutoff_hz
    filter_ = decimator(rate_hz, cutoff_hz)
    longest = round(LONGEST_MOVE_S * rate_hz)
    for first in range(0, signals.shape[1], longest):
        piece = signals[:, first : first + longest]
        rows = filter_.rows(piece.shape[1])
        if rows < _TREND + len(piece) or np.ptp(piece[0]) == 0.0:
            continue
        current, *others = filter_(piece)
        powers, correlation = _of_length(rate_hz, cutoff_hz, rows)
        if others:
            columns = np.column_stack((powers, *others))
            basis, expected, freedom = _projection(columns, correlation)
        else:
            basis, expected, freedom = _detrending(rate_hz, cutoff_hz, rows)
        left = current - basis @ (basis.T @ current)
        variance_a2 = float(np.sum(left**2)) / expected
        yield _Part(variance_a2, freedom, share * freedom)


def _projection(columns: FloatArray, correlation: FloatArray) -> tuple[FloatArray, float, float]:
    """Orthonormal basis of the columns, tr(MP) and ν."""
    basis, _ = np.linalg.qr(columns)
    # M P M, the correlation of what is left.
    left = correlation - basis @ (basis.T @ correlation)
    left -= (left @ basis) @ basis.T
    expected = float(np.trace(left))
    freedom = expected**2 / float(np.sum(left**2))
    return basis, expected, freedom


@lru_cache(maxsize=1024)
def _detrending(rate_hz: float, cutoff_hz: float, rows: int) -> tuple[FloatArray, float, float]:
    """`_projection` on the powers of time alone: every dwell of this length has it."""
    return _projection(*_of_length(rate_hz, cutoff_hz, rows))


@dataclass(frozen=True, slots=True)
class _MoveChain:
    """Repetitions of one move of a motor, as they followed each other."""

    data: Dataset  #: run of the last one
    part: slice  #: its samples
    differences: tuple[FloatArray, ...]  #: of each and the one before, as of `_difference`


def _repetitions(
    datasets: Sequence[Dataset], motor: int
) -> Iterator[tuple[tuple[FloatArray, ...], float]]:
    """Differences between repetitions of each move of a motor, and their sampling rate [Hz].

    A move of the motor is a stretch between two standstills or reversals of it, so that continuous
    motion has moves.
    """
    moved = np.any([data.moving.any(axis=0) for data in datasets], axis=0)
    travel = np.max([np.ptp(data.position_rad, axis=0) for data in datasets], axis=0)
    # An axis that rests throughout has no path
    unit = np.where(moved, travel, 1.0)
    scale = np.where(moved, 1.0 / unit, 0.0)
    chains: list[_MoveChain] = []
    ends = np.empty((0, 2, len(scale)))  # of the last move of each chain
    for data in sorted(datasets, key=lambda data: data.started_s or 0.0):
        is_moving = data.motor_moving[:, motor] & data.valid[:, motor]
        for first, stop in true_stretches(is_moving):
            part = slice(first, stop)
            end = data.position_rad[[first, stop - 1]] * scale
            # Where a move begins is known to some samples only, in which other axes move on.
            is_near = np.abs(ends - end) < 10.0 * PATH_TOLERANCE
            for index in np.flatnonzero(np.all(is_near, axis=(1, 2))):
                chain = chains[index]
                difference = _difference(chain, data, part, motor, scale)
                if difference is not None:
                    chains[index] = _MoveChain(data, part, (*chain.differences, difference))
                    ends[index] = end
                    break
            else:
                chains.append(_MoveChain(data, part, ()))
                ends = np.concatenate((ends, end[None]))
    for chain in chains:
        if chain.differences:
            yield chain.differences, chain.data.rate_hz


def _difference(
    chain: _MoveChain, data: Dataset, part: slice, motor: int, scale: FloatArray
) -> FloatArray | None:
    """A move minus the last one of a chain, None if it is no repetition.

    Rows are the current [A] and the accelerations of all axes, shape (1 + m, k).

    The two are aligned by their paths, because neither log nor controller starts a move at a
    sample. With q' = q + λ q̇ where the later one is ahead by λ, λ is found by least squares over
    all axes, scaled by their travel.
    """
    before = chain.data
    rate = data.rate_hz
    lengths = (chain.part.stop - chain.part.start, part.stop - part.start)
    length = min(lengths)
    if max(lengths) > (1.0 + DURATION_TOLERANCE) * length or before.payload != data.payload:
        return None
    if not np.isclose(before.rate_hz, rate, rtol=1e-4):
        return None
    first = slice(chain.part.start, chain.part.start + length)
    path = before.position_rad[first]
    speed = before.velocity_rad_s[first] * scale
    start = part.start
    ahead = 0.0
    for _ in range(2):
        start -= round(ahead)
        if start < 1 or start + length >= len(data.time_s):
            return None
        apart = (data.position_rad[start : start + length] - path) * scale
        ahead = float(np.sum(speed * apart) / np.sum(speed**2)) * rate  # in samples
    beside_path = np.abs(apart - ahead / rate * speed)
    if np.max(beside_path) > PATH_TOLERANCE or abs(ahead) > 1.0:
        return None
    if ahead > 0.0:
        next_start = start - 1
    else:
        next_start = start + 1
    nearest = _signals(data, slice(start, start + length), motor)
    next_ = _signals(data, slice(next_start, next_start + length), motor)
    interpolated = nearest + abs(ahead) * (next_ - nearest)
    return interpolated - _signals(before, first, motor)


def _signals(data: Dataset, part: slice, motor: int) -> FloatArray:
    """Current of a motor [A] and accelerations of all axes, shape (1 + m, k)."""
    current_a = data.current_a[part, motor]
    accelerations = data.acceleration_rad_s2[part].T
    return np.stack((current_a, *accelerations))


@lru_cache(maxsize=1024)
def _of_length(rate_hz: float, cutoff_hz: float, rows: int) -> tuple[FloatArray, FloatArray]:
    """Powers of time of so many rows, shape (rows, 3), and P, shape (rows, rows)."""
    filter_ = decimator(rate_hz, cutoff_hz)
    taps = filter_.taps
    of_lag = np.zeros(rows)
    for row in range(rows):
        lag = filter_.factor * row
        if lag < len(taps):
            of_lag[row] = taps[lag:] @ taps[: len(taps) - lag]
    numbers = np.arange(rows)
    rows_apart = np.abs(np.subtract.outer(numbers, numbers))
    correlation = of_lag[rows_apart] / of_lag[0]
    time = np.linspace(-1.0, 1.0, rows)
    return np.vander(time, _TREND), correlation
