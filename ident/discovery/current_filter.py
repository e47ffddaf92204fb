"""A low-pass that the currents went through before they were recorded, and the positions did not.

Public recordings are often made smooth before they are given away, and some controllers log a
current behind a slow filter. Friction then turns within milliseconds in the model and within
tenths of a second in the data, and whatever changes slowly around a reversal explains the rest: a
search writes friction that no joint has. The filter is not an effect of the robot. It is a property
of the recording, and every torque that is compared with the currents goes through it
(`Conditioning.current_cutoff_hz`).

`find_current_filter` measures it on the rows of a fit, in steps that each can end the search:

1. Do the currents have the fast part of the torque? With p the motors' torque by the model, y the
   measured one and h what a low-pass at FAST_SHARE of the rows' cut-off takes out, Σ h(p) h(y) over
   Σ h(p)² is one for currents as they flowed, whatever the noise in them, and far below it behind a
   low-pass. Only where it is below SLOPE for half of the motors the rest is computed.
2. The cut-off and the kind of filter by which the model fits the currents best, by likelihood.
3. The cut-off as one more unknown of the fit, with σ by leaving out moves in turn.
4. On stretches that are left out in turn, the model with the filter must have a smaller error than
   the model without, and than the model without whose currents are late by a delay of their own:
   by more than noise, on most motors, and nowhere a larger one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.arrays import BoolArray, FloatArray, IntArray, takes
from ident.data.conditioning import Conditioning, as_recorded, low_pass, rows_lost
from ident.discovery.before_after import change_of_squares, squares_left
from ident.discovery.error_change import ErrorChange
from ident.discovery.evidence import Evidence
from ident.discovery.joining import FIT_ERRORS
from ident.discovery.late_currents import rough_torque_rates
from ident.equations.observation import Observation, observe
from ident.equations.rows import row_masks
from ident.errors import TooFewMoves
from ident.estimators.estimate import Estimate
from ident.estimators.identify import estimate_with
from ident.estimators.method import Method
from ident.model.model import Column

FAST_SHARE = 0.25  #: Of the cut-off of the rows: torque above it is fast
FAST_ORDER = 4  #: Order of the filter that tells fast torque from slow
SLOPE = 0.5  #: Share of the fast torque that currents as they flowed have at least
#: Steps of the cut-off, an eighth of an octave to a factor of 16 below the fast torque
COARSE = 2.0 ** np.arange(1.0, -4.5, -0.5)
FINE = 2.0 ** np.array([-0.25, 0.0, 0.25])
#: Orders of filters without phase; 0 is a causal one of first order
ORDERS = (1, 2, 3, 4, 5)
CAUSAL = 0
FALLS = 2  #: Cut-offs below the best one that end the trial
DIFFERENCE = 0.01  #: Relative step of its derivative
STRETCHES = 5  #: Parts of the moves that are left out in turn
CERTAIN_SIGMAS = 5.0  #: Of the logarithm of the cut-off, by which it is known at least
LEAST_FALL = 0.1  #: Share of the left-out squared error that a filter takes away at least


@dataclass(frozen=True, slots=True)
class CurrentFilter:
    """A low-pass of the currents that the data show."""

    cutoff_hz: float  #: −6 dB of a filter without phase, −3 dB of a causal one
    cutoff_std_hz: float  #: σ, by leaving out moves in turn
    order: int  #: as `Conditioning.current_order`
    change: ErrorChange  #: of the squared errors of stretches that were left out, by the filter

    @property
    def fallen_share(self) -> float:
        """Share of the left-out squared error that it takes away."""
        return -self.change.total.rise / float(self.change.before.sum())

    def applied_to(self, conditioning: Conditioning) -> Conditioning:
        """The same filters with this one."""
        return replace(conditioning, current_cutoff_hz=self.cutoff_hz, current_order=self.order)

    def describe(self) -> str:
        """Say what it is."""
        kind = "a low-pass of first order"
        if self.order:
            kind = f"a low-pass of order {self.order}, forwards and backwards"
        return f"{kind} at {self.cutoff_hz:.3g} ± {self.cutoff_std_hz:.1g} Hz"


@takes(evidence=Evidence)
def find_current_filter(evidence: Evidence) -> CurrentFilter | None:
    """Measure a low-pass that all currents of a recording went through; None where there is none.

    Fit again with the filters of `CurrentFilter.applied_to` where there is one.

    Args:
        evidence: of a fit by the filters of the rows alone. Held-out runs are not looked at.

    Raises:
        ModelError: the argument is of another type.
    """
    if evidence.model.is_redundant or evidence.conditioning.current_cutoff_hz:
        return None
    if _fast_slope(evidence) >= SLOPE:
        return None
    try:
        if not evidence.estimate.method.is_of_currents:
            # Errors of currents are judged in units of their own noise [A], which the other
            # estimators lack; what is fitted below is fitted by ml anyway.
            by_likelihood, _ = _estimate(evidence, evidence.training)
            evidence = replace(evidence, estimate=by_likelihood)
        chosen = _chosen(_Trials(evidence))
        if chosen is None:
            return None
        return _measured(evidence, chosen)
    except (*FIT_ERRORS, TooFewMoves):
        return None


def _fast_slope(evidence: Evidence) -> float:
    """Share of the model's fast torque that the currents of the median motor have.

    1 where the recording is too short to tell.
    """
    rows = evidence.training
    estimate = evidence.estimate
    to_motor = evidence.model.drive_train.to_motor
    predicted_nm = to_motor @ estimate.predicted_torque(rows)
    measured_nm = estimate.gains[:, None] * rows.current
    common = np.zeros(len(to_motor))
    own = np.zeros(len(to_motor))
    for run in range(len(rows.runs)):
        of_run = np.flatnonzero(rows.run == run)
        if len(of_run) <= 3 * (FAST_ORDER + 1):
            continue
        rate_hz = _row_rate(rows, of_run)
        cutoff_hz = FAST_SHARE * evidence.conditioning.decimation_cutoff_hz
        fast_nm: list[FloatArray] = []
        for torque_nm in (predicted_nm[:, of_run], measured_nm[:, of_run]):
            slow_nm = low_pass(torque_nm, rate_hz, cutoff_hz, FAST_ORDER)
            fast_nm.append(np.where(rows.motor_use[:, of_run], torque_nm - slow_nm, 0.0))
        predicted, measured = fast_nm
        common += np.sum(predicted * measured, axis=1)
        own += np.sum(predicted**2, axis=1)
    seen = own > 0.0
    if not seen.any():
        return 1.0
    return float(np.median(common[seen] / own[seen]))


def _row_rate(rows: Observation, of_run: IntArray) -> float:
    """Rows of a run a second."""
    time_s = rows.time_s[of_run]
    return float((len(time_s) - 1) / (time_s[-1] - time_s[0]))


def _filtered(evidence: Evidence, conditioning: Conditioning) -> Observation:
    """The rows of the fit with the low-pass of the currents applied to their columns.

    Those count that count in a fit with it.
    """
    rows = evidence.training
    regressor = np.empty_like(rows.regressor)
    effects = np.empty_like(rows.effects)
    flange = np.empty_like(rows.flange)
    use = np.zeros_like(rows.use)
    motor_use = np.zeros_like(rows.motor_use)
    for run, data in enumerate(evidence.fit_runs):
        of_run = np.flatnonzero(rows.run == run)
        rate_hz = _row_rate(rows, of_run)
        for filtered, columns in (
            (regressor, rows.regressor),
            (effects, rows.effects),
            (flange, rows.flange),
        ):
            filtered[..., of_run] = as_recorded(rate_hz, conditioning, columns[..., of_run])
        lost = rows_lost(data.rate_hz, conditioning)
        kept = of_run[lost : len(of_run) - lost]
        if len(kept):
            use[:, kept], motor_use[:, kept] = row_masks(evidence.model, data, conditioning)
    return replace(
        rows,
        regressor=regressor,
        effects=effects,
        flange=flange,
        use=use & rows.use,
        motor_use=motor_use & rows.motor_use,
    )


@dataclass(frozen=True, slots=True)
class _Trial:
    """A filter, and the likelihood of a fit with it."""

    order: int
    cutoff_hz: float
    cost: float  #: Σ r_i log σ_i of the motors


class _Trials:
    """Fits of the same rows with different filters."""

    def __init__(self, evidence: Evidence) -> None:
        self.evidence = evidence
        self.fast_hz = FAST_SHARE * evidence.conditioning.decimation_cutoff_hz
        # The same rows for all of them: those that count with the filter in the middle.
        middle = replace(
            evidence.conditioning, current_cutoff_hz=0.5 * self.fast_hz, current_order=2
        )
        of_middle = _filtered(evidence, middle)
        self.use = of_middle.use
        self.motor_use = of_middle.motor_use

    def fitted(self, order: int, cutoff_hz: float) -> _Trial:
        """Fit with a filter; one that nothing can be fitted with has no likelihood."""
        conditioning = replace(
            self.evidence.conditioning, current_cutoff_hz=cutoff_hz, current_order=order
        )
        rows = _filtered(self.evidence, conditioning)
        rows = replace(rows, use=self.use, motor_use=self.motor_use)
        try:
            estimate, counts = _estimate(self.evidence, rows)
        except FIT_ERRORS:
            return _Trial(order, cutoff_hz, float("inf"))
        noise = np.maximum(estimate.axis_noise, np.finfo(np.float64).tiny)
        return _Trial(order, cutoff_hz, float(counts @ np.log(noise)))


def _estimate(evidence: Evidence, rows: Observation) -> tuple[Estimate, IntArray]:
    """Estimate by rows, and the number of rows of each motor."""
    system = rows.system()
    estimate = estimate_with(Method.ML, system, evidence.estimate.fixed_gains)
    return estimate, system.motors.rows


def _chosen(trials: _Trials) -> _Trial | None:
    """The filter of the largest likelihood; None where it is at an end of what is tried."""
    best: _Trial | None = None
    for order in (CAUSAL, 2):
        coarse = _coarse(trials, order)
        if coarse is None:
            continue
        orders = (CAUSAL,) if order == CAUSAL else ORDERS
        for own in orders:
            trial = _finest(trials, own, coarse.cutoff_hz)
            if best is None or trial.cost < best.cost:
                best = trial
    return best


def _coarse(trials: _Trials, order: int) -> _Trial | None:
    """The best of some cut-offs, tried from the highest one down until the likelihood falls.

    None where it is the first or the last of them.
    """
    steps = COARSE.tolist()
    tried: list[_Trial] = []
    place = 0
    for step in steps:
        tried.append(trials.fitted(order, trials.fast_hz * step))
        place = int(np.argmin([trial.cost for trial in tried]))
        if len(tried) - place > FALLS:
            break
    if place == 0 or place == len(steps) - 1 or not np.isfinite(tried[place].cost):
        return None
    return tried[place]


def _finest(trials: _Trials, order: int, cutoff_hz: float) -> _Trial:
    """The best cut-off of a kind of filter near one: at the lowest point of a parabola."""
    near = [trials.fitted(order, cutoff_hz * step) for step in FINE.tolist()]
    below, middle, above = (trial.cost for trial in near)
    bend = below - 2.0 * middle + above
    if np.isfinite(bend) and bend > 0.0:
        step = np.clip(0.5 * (below - above) / bend, -1.5, 1.5)
        near.append(trials.fitted(order, cutoff_hz * float(FINE[-1] ** step)))
    return min(near, key=lambda trial: trial.cost)


def _measured(evidence: Evidence, chosen: _Trial) -> CurrentFilter | None:
    """Fit the cut-off with everything else, and test the filter on stretches that are left out."""
    cutoff_hz = chosen.cutoff_hz

    def quick(conditioning: Conditioning) -> Observation:
        return _filtered(evidence, conditioning)

    def exact(conditioning: Conditioning) -> Observation:
        return observe(evidence.model, evidence.fit_runs, conditioning, evidence.training)

    # Rows are quick to filter, but half a percent of a cut-off is lost between them.
    for rows_behind in (quick, quick, quick, exact):
        if rows_behind is exact and evidence.effects:
            break
        step, std = _cutoff_step(evidence, rows_behind, chosen.order, cutoff_hz)
        cutoff_hz *= float(np.exp(np.clip(step, -0.3, 0.3)))
    if not std < 1.0 / CERTAIN_SIGMAS:
        return None
    conditioning = replace(
        evidence.conditioning, current_cutoff_hz=cutoff_hz, current_order=chosen.order
    )
    filtered = _filtered(evidence, conditioning)
    bare = replace(evidence.training, use=filtered.use, motor_use=filtered.motor_use)
    change = _change(evidence, bare, filtered)
    beside_delays = _change(evidence, _with_delays(evidence, bare), filtered)
    found = CurrentFilter(cutoff_hz, std * cutoff_hz, chosen.order, change)
    falls = [motor.rise < 0.0 for motor in change.motors if motor.blocks]
    is_shared = 2 * sum(falls) > len(falls)
    is_large = found.fallen_share >= LEAST_FALL
    is_better = change.is_fall() and beside_delays.is_fall() and not change.harm("left-out moves")
    if is_better and is_shared and is_large:
        return found
    return None


def _cutoff_step(
    evidence: Evidence,
    rows_behind: Callable[[Conditioning], Observation],
    order: int,
    cutoff_hz: float,
) -> tuple[float, float]:
    """Change of the logarithm of the cut-off that a fit with it as an unknown finds, and its σ.

    Args:
        evidence: of the fit.
        rows_behind: its rows with a low-pass of the currents.
        order, cutoff_hz: of the filter.
    """
    conditioning = replace(evidence.conditioning, current_cutoff_hz=cutoff_hz, current_order=order)
    of_filters: list[Observation] = []
    for factor in (1.0 - DIFFERENCE, 1.0, 1.0 + DIFFERENCE):
        near = replace(conditioning, current_cutoff_hz=factor * cutoff_hz)
        of_filters.append(rows_behind(near))
    below, rows, above = _at_common_times(of_filters)
    estimate, _ = _estimate(evidence, rows)
    below_nm = estimate.predicted_torque(below)
    above_nm = estimate.predicted_torque(above)
    derivative_nm = (above_nm - below_nm) / np.log((1.0 + DIFFERENCE) / (1.0 - DIFFERENCE))
    column = Column("logarithm of the cut-off of the currents", "1")
    extended = rows.extended((column,), derivative_nm[:, None])
    with_cutoff, _ = _estimate(evidence, extended)
    place = len(rows.columns)
    return float(with_cutoff.parameters[place]), float(with_cutoff.parameters_std[place])


def _at_common_times(of_filters: Sequence[Observation]) -> list[Observation]:
    """Keep the rows that all have: a lower cut-off costs rows at the ends of a run."""
    times = [list(zip(rows.run.tolist(), rows.time_s.tolist(), strict=True)) for rows in of_filters]
    common = set(times[0]).intersection(*times[1:])
    kept: list[Observation] = []
    for rows, own in zip(of_filters, times, strict=True):
        is_common = np.array([time in common for time in own], dtype=np.bool_)
        kept.append(rows.only(is_common))
    return kept


def _with_delays(evidence: Evidence, rows: Observation) -> Observation:
    """The rows with a delay of each current as an unknown."""
    rates_nm_s = rough_torque_rates(evidence)
    direction = evidence.model.drive_train.direction
    # Σ_i R_ij times the torque of motor i at joint j, per second of its delay
    columns = -np.einsum("ij,ir->jir", direction, rates_nm_s)
    names = [Column(f"delay of current {motor + 1}", "s") for motor in range(len(direction))]
    return rows.extended(tuple(names), columns)


def _change(evidence: Evidence, before: Observation, after: Observation) -> ErrorChange:
    """Compare two models of the same rows on stretches that are left out in turn."""
    return change_of_squares(
        before,
        _left_out_squares(evidence, before),
        _left_out_squares(evidence, after),
        evidence.estimate.axis_noise,
    )


def _left_out_squares(evidence: Evidence, rows: Observation) -> FloatArray:
    """Squared error of each motor and row whose stretch the fit leaves out [A²], shape (m, r)."""
    everything, _ = _estimate(evidence, rows)
    # Gains are few numbers, and stay those of all rows; all else is fitted without the stretch.
    gains = everything.gains
    squares = np.zeros(rows.current.shape)
    for own in _stretches(rows):
        system = rows.only(~own).system()
        free = len(system.unknowns)
        if not everything.gains_fixed:
            free += len(gains)
        parameters, _ = system.currents.settled(gains, free)
        squares[:, own] = squares_left(rows.only(own), replace(everything, parameters=parameters))
    return squares


def _stretches(rows: Observation) -> Iterator[BoolArray]:
    """Rows of every fifth move, and so on: what is left then has been nearly everywhere.

    The base parameters of a short recording say little of a part of the workspace that was left
    out, with the filter or without.
    """
    moves = np.unique(rows.move)
    for first in range(min(STRETCHES, len(moves))):
        yield np.isin(rows.move, moves[first::STRETCHES])
