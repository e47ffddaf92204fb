"""External torque of the joints beyond the prediction, its band, and a threshold for alarms.

    τ_ext = V g − (W χ + W_L χ_L + E c)

of every row (the filters of the calibration's fit), so some 0.05 s late; a robot that pushes
against its surroundings has τ_ext in the direction of its push. Rows at standstill do not count:
stiction hides any torque below it.

*Band.* The residual grows with what drives it: errors of gains with the torque, of friction with
the speed, of inertia and of time with the acceleration. The scale of joint j is

    s_j = a_j + b_j |τ_j| + c_j |q̇_j| + d_j |q̈_j|,        a, b, c, d ≥ 0,

the mean of |τ_ext| by least squares over quiet motion, rows weighted by 1/s. Half the band is the
95 % quantile of z = |τ_ext|/s times s.

*Threshold.* False alarms are rarer than recordings are long, so the tail of z is extrapolated by
its peaks over a threshold u, the highest quantile with enough of them (Davison & Smith 1990).
Exceedances closer than twice the correlation time are one peak, as they would be one alarm. Peaks
beyond u follow a generalised Pareto distribution, its shape ξ by probability-weighted moments.
Minutes of quiet motion show a heavy tail badly: the level is that of the upper 95 % bound of ξ, but
of ξ = 0, an exponential, at least, because a tail that seems to end is not believed; and of the
upper 90 % bound of the scale. So more quiet motion lowers the level. It is SCALE_MARGIN times
higher again: the scale of the residual differs from day to day. What remains to assume: the motion
to be watched is like the quiet motion (other loads, temperatures or speeds need their own), its
residual has a scale at most SCALE_MARGIN times as large, and no heavier tail begins beyond the
largest peak seen.

The allowed rate is one on average over bands, from five minutes of quiet motion on. Single bands of
a heavy tail (Student's with five degrees of freedom) exceed it: the worst of 40 by 3.5 times after
five minutes, by 1.3 times after thirty, at a scale SCALE_MARGIN times as large; after two minutes
the average can, too (docs/evidence/contact.md).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import nnls
from scipy.special import gammaincinv

from ident.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    as_array,
    require_number,
    require_real,
    takes,
)
from ident.calibration import Calibration
from ident.data.conditioning import Conditioning, as_recorded
from ident.data.dataset import differentiate
from ident.data.run import Run, require_entry
from ident.equations.rows import require_any_row, row_filter, row_masks
from ident.errors import DataUnfit, ModelError
from ident.model.model import Model
from ident.prediction import measured_torque, predict_torque

DRIVERS = ("constant", "torque", "speed", "acceleration")  #: Of the residual's scale
PREDICTED_SHARE = 0.95  #: Share of quiet rows inside the band
PEAK_QUANTILES = (0.99, 0.98, 0.97, 0.95, 0.9)  #: u, the first with enough peaks
#: With fewer, the shape of a tail like Student's with five degrees of freedom is not seen
ENOUGH_PEAKS = 100
MIN_PEAKS = 10  #: With fewer at the last of them, nothing can be said about the tail
TAIL_CONFIDENCE = 0.90  #: Of the tail's scale
SHAPE_SIGMAS = 1.645  #: By which the tail's shape is raised: its upper 95 % bound
LARGEST_SHAPE = 0.5  #: Of the tail; beyond, peaks have no variance
SCALE_MARGIN = 1.15  #: How much larger the scale of the residual may be than in the quiet motion
ALARMS_PER_HOUR = 1.0  #: False alarms of all joints together, in an hour of motion
FAR_OUT = 3.0  #: Interquartile ranges above the upper quartile (Tukey's "far out")


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """Band and thresholds of every joint, learned from quiet motion."""

    scale: FloatArray  #: (a, b, c, d) of each joint in the order of DRIVERS, shape (m, 4)
    factor: FloatArray  #: half the band over s, shape (m,)
    #: threshold over s; NaN where the quiet motion has fewer than MIN_PEAKS, shape (m,)
    threshold: FloatArray
    correlation_s: FloatArray  #: correlation time of the residual [s], shape (m,)
    quiet_s: FloatArray  #: time that each joint moved in the quiet motion [s], shape (m,)
    #: false alarms of all joints together that are allowed in an hour of motion, on average
    alarms_per_hour: float


@dataclass(frozen=True, slots=True)
class Contact:
    """A stretch beyond the threshold."""

    axis: int  #: index from 0
    start_s: float  #: since the start of the run
    end_s: float  #: since the start of the run
    peak_nm: float  #: largest external torque in it, signed [Nm; N for a prismatic joint]
    peak_over_threshold: float  #: the same over the threshold


@dataclass(frozen=True, slots=True, eq=False)
class ExternalTorque:
    """External torque of one run; arrays are joint-first, rows last."""

    time_s: FloatArray  #: of each row, since the start of the run, shape (r,)
    torque_nm: FloatArray  #: τ_ext, shape (m, r)
    scale_nm: FloatArray  #: s, shape (m, r)
    use: BoolArray  #: whether each row of a joint counts, moving and valid, shape (m, r)
    band: Band  #: learned from quiet runs, or from the run's own quiet stretches
    from_itself: bool  #: the band is from the run's own quiet stretches
    left_out: int  #: stretches of the run that were not quiet; 0 where the band is from other runs

    @property
    def band_nm(self) -> FloatArray:
        """Half the band, shape (m, r)."""
        return self.scale_nm * self.band.factor[:, None]

    @property
    def threshold_nm(self) -> FloatArray:
        """Threshold, shape (m, r)."""
        return self.scale_nm * self.band.threshold[:, None]

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """Stretches beyond the threshold, in order of time."""
        found: list[Contact] = []
        over_threshold = np.abs(self.torque_nm) / self.threshold_nm
        is_beyond = self.use & (over_threshold > 1.0)
        for axis, over in enumerate(over_threshold):
            beyond = np.flatnonzero(is_beyond[axis])
            gap_s = 2.0 * self.band.correlation_s[axis]
            for rows in _stretches(beyond, self.time_s, gap_s):
                peak = rows[np.argmax(over[rows])]
                contact = Contact(
                    axis=axis,
                    start_s=float(self.time_s[rows[0]]),
                    end_s=float(self.time_s[rows[-1]]),
                    peak_nm=float(self.torque_nm[axis, peak]),
                    peak_over_threshold=float(over[peak]),
                )
                found.append(contact)
        found.sort(key=lambda contact: contact.start_s)
        return tuple(found)


@dataclass(frozen=True, slots=True, eq=False)
class _Residual:
    """Decimated rows of one run."""

    time_s: FloatArray  #: shape (r,)
    torque_nm: FloatArray  #: shape (m, r)
    drivers: FloatArray  #: shape (m, 4, r)
    use: BoolArray  #: shape (m, r)
    move: IntArray  #: shape (r,)


@takes(
    calibration=Calibration,
    model=Model,
    run=Run,
    conditioning=Conditioning | None,
    band=Band | None,
)
def external_torque(
    calibration: Calibration,
    model: Model,
    run: Run,
    conditioning: Conditioning | None = None,
    band: Band | None = None,
) -> ExternalTorque:
    """Compute the external torque of a run.

    Args:
        calibration: of this robot; it knows the run's payload.
        model: the declared model that it was fitted with.
        run: any motion.
        conditioning: the filters; those of the fit when None.
        band: from `prediction_band`. Without one, it is learned from the run itself, less the
            stretches of at most two seconds in which some joint is far out; this works while
            contacts fill less than a quarter of the run.

    Raises:
        DataUnfit: the run is unfit, or no row of it counts.
        ModelError, EffectRefused: see `ident.predict_torque`.
    """
    if conditioning is None:
        conditioning = calibration.conditioning
    if band is not None:
        _require_band(band, model.robot.axis_count)
    residual = _residual(calibration, model, run, conditioning)
    from_itself = band is None
    left_out = 0
    if band is None:
        quiet, left_out = _quiet(residual)
        band = _band([quiet], ALARMS_PER_HOUR)
    return ExternalTorque(
        time_s=residual.time_s,
        torque_nm=residual.torque_nm,
        scale_nm=_scale_nm(band.scale, residual),
        use=residual.use,
        band=band,
        from_itself=from_itself,
        left_out=left_out,
    )


def _require_band(band: Band, count: int) -> None:
    """Refuse a band of another robot, or with numbers of another shape.

    Raises:
        ModelError: it is not one of so many joints.
    """
    expected = {
        "scale": (count, 4),
        "factor": (count,),
        "threshold": (count,),
        "correlation_s": (count,),
    }
    for name, shape in expected.items():
        label = f"{name} of the band"
        values = getattr(band, name)
        if name == "threshold":  # NaN where the quiet motion has too few peaks
            require_real(label, values, ModelError)
            values = np.nan_to_num(values)
        remedy = "one row per joint: make it with `prediction_band` and the model of this robot"
        as_array(label, values, shape, remedy)


@takes(calibration=Calibration, model=Model, quiet=Iterable, conditioning=Conditioning | None)
def prediction_band(
    calibration: Calibration,
    model: Model,
    quiet: Iterable[Run],
    conditioning: Conditioning | None = None,
    *,
    alarms_per_hour: float = ALARMS_PER_HOUR,
) -> Band:
    """Learn band and thresholds from runs without contact, best held out of the calibration's fit.

    Args:
        calibration, model, conditioning: as for `external_torque`.
        quiet: the runs, with the motion that is to be watched; five minutes or more for a heavy
            tail, and more minutes give lower thresholds.
        alarms_per_hour: false alarms of all joints together, in an hour of motion: fewer on
            average; see the top.

    Raises:
        DataUnfit, ModelError, EffectRefused: as from `external_torque`.
    """
    alarms_per_hour = require_number(
        "alarms_per_hour", alarms_per_hour, above=0.0, remedy="give a rate such as 1"
    )
    if conditioning is None:
        conditioning = calibration.conditioning
    residuals: list[_Residual] = []
    for run in quiet:
        residuals.append(_residual(calibration, model, run, conditioning))
    return _band(residuals, alarms_per_hour)


def _residual(
    calibration: Calibration, model: Model, run: Run, conditioning: Conditioning
) -> _Residual:
    require_entry(run)
    data = differentiate(run, model.drive_train, conditioning)
    filter_ = row_filter(data, conditioning)
    use, _ = row_masks(model, data, conditioning)
    require_any_row(data, use)
    needed_nm = predict_torque(calibration, model, data).T
    predicted = as_recorded(data.rate_hz, conditioning, needed_nm)
    measured = measured_torque(calibration, model, data.current_a, data.motion()).T
    torque_nm = filter_(measured - predicted)
    needed_nm = filter_(predicted)
    speed = filter_(data.velocity_rad_s.T)
    acceleration = filter_(data.acceleration_rad_s2.T)
    # In the order of DRIVERS
    drivers = np.stack(
        (np.ones_like(torque_nm), np.abs(needed_nm), np.abs(speed), np.abs(acceleration)), axis=1
    )
    centres = filter_.centres(len(data.time_s))
    return _Residual(
        time_s=data.time_s[centres] - data.time_s[0],
        torque_nm=torque_nm,
        drivers=drivers,
        use=use,
        move=data.move[centres],
    )


def _scale_nm(scale: FloatArray, residual: _Residual) -> FloatArray:
    """s_jr = Σ_d (a, b, c, d)_jd drivers_jdr of each joint and row, shape (m, r)."""
    return np.asarray(np.einsum("jd,jdr->jr", scale, residual.drivers))


def _quiet(residual: _Residual) -> tuple[_Residual, int]:
    """The rows without the stretches that are far out on any joint, and the number of these."""
    scale_nm = _scale_nm(_scales([residual], robust=True), residual)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.abs(residual.torque_nm) / scale_nm
    ratio = np.where(residual.use, ratio, 0.0)
    moves, move_of_row = np.unique(residual.move, return_inverse=True)
    largest = np.zeros((len(ratio), len(moves)))
    for move in range(len(moves)):
        of_move = ratio[:, move_of_row == move]
        largest[:, move] = of_move.max(axis=1)
    lower, upper = np.quantile(largest, (0.25, 0.75), axis=1)
    fence = upper + FAR_OUT * (upper - lower)
    is_loud = np.any(largest > fence[:, None], axis=0)
    use = residual.use & ~is_loud[move_of_row]
    return replace(residual, use=use), int(is_loud.sum())


def _scales(parts: Sequence[_Residual], *, robust: bool = False) -> FloatArray:
    """(a, b, c, d) of each joint, shape (m, 4).

    Args:
        parts: runs.
        robust: leave out rows beyond four times the scale.
    """
    scales = np.zeros((len(parts[0].use), len(DRIVERS)))
    for joint in range(len(scales)):
        used = [part.use[joint] for part in parts]
        sizes: list[FloatArray] = []
        drivers_of_parts: list[FloatArray] = []
        for part, rows in zip(parts, used, strict=True):
            sizes.append(np.abs(part.torque_nm[joint, rows]))
            drivers_of_parts.append(part.drivers[joint][:, rows])
        size = np.concatenate(sizes)
        if size.any():
            drivers = np.concatenate(drivers_of_parts, axis=1)
            scales[joint] = _scale_of_joint(size, drivers, robust=robust)
    return scales


def _scale_of_joint(size: FloatArray, drivers: FloatArray, *, robust: bool) -> FloatArray:
    """(a, b, c, d) ≥ 0 of one joint by least squares, weighted by the scale itself, shape (4,).

    Args:
        size: of the residual, not zero throughout, shape (r,).
        drivers: shape (4, r).
        robust: leave out rows beyond four times the scale.
    """
    usual_nm = np.median(size) or size.mean()
    row_scale = np.full(len(size), usual_nm)
    unit = drivers.max(axis=1)
    unit[unit == 0.0] = 1.0
    unit_drivers = drivers / unit[:, None]
    for _ in range(4):
        # A scale near zero would make the weights of a few rows everything.
        least = 0.1 * row_scale.mean()
        weight = 1.0 / np.maximum(row_scale, least)
        if robust:
            is_beyond = size > 4.0 * row_scale
            weight = np.where(is_beyond, 0.0, weight)
        in_units, _ = nnls((unit_drivers * weight).T, size * weight)
        scale = in_units / unit
        row_scale = scale @ drivers
    return np.asarray(scale)


def _band(parts: Sequence[_Residual], alarms_per_hour: float) -> Band:
    if not parts:
        raise DataUnfit("", "no quiet run was given; expected at least one without contact")
    scale = _scales(parts)
    count = len(scale)
    factor = np.full(count, np.nan)
    threshold = np.full(count, np.nan)
    correlation_s = np.full(count, np.nan)
    quiet_s = np.full(count, np.nan)
    row_s = float(np.median(np.diff(parts[0].time_s)))
    # Runs far apart in time: no stretch goes on from one to the next.
    times_s = np.concatenate([part.time_s + 1e6 * index for index, part in enumerate(parts)])
    for joint in range(count):
        runs = [_ratio_of_joint(part, joint, scale[joint]) for part in parts]
        ratio = np.concatenate(runs)
        rows = int(np.isfinite(ratio).sum())
        quiet_s[joint] = rows * row_s
        correlation_s[joint] = row_s
        if rows < 2:
            continue
        correlation_s[joint] = row_s * _correlation(runs)
        size = np.abs(ratio)
        factor[joint] = np.nanquantile(size, PREDICTED_SHARE)
        gap_s = 2.0 * correlation_s[joint]
        level = alarm_level(size, times_s, gap_s, alarms_per_hour / count, quiet_s[joint])
        if level is not None:
            threshold[joint] = level
    return Band(scale, factor, threshold, correlation_s, quiet_s, alarms_per_hour)


def _ratio_of_joint(part: _Residual, joint: int, scale: FloatArray) -> FloatArray:
    """Residual of a joint over its scale, shape (r,); NaN in rows that do not count."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = part.torque_nm[joint] / (scale @ part.drivers[joint])
    counts = part.use[joint] & np.isfinite(ratio)
    return np.where(counts, ratio, np.nan)


def alarm_level(
    ratio: FloatArray, time_s: FloatArray, gap_s: float, alarms_per_hour: float, observed_s: float
) -> float | None:
    """Level that a signal exceeds, on average, less often an hour than given.

    It is extrapolated from the signal's peaks; see the top. The signal may grow by SCALE_MARGIN.

    Args:
        ratio: the signal, not negative; NaN where it is not observed, shape (r,).
        time_s: of each entry, shape (r,).
        gap_s: exceedances closer than this are one.
        alarms_per_hour: occasions in an hour of observed signal.
        observed_s: how long it was observed.

    Returns:
        the level; None with fewer than MIN_PEAKS peaks.
    """
    observed = np.nan_to_num(ratio)
    for start in np.nanquantile(ratio, PEAK_QUANTILES).tolist():
        beyond = np.flatnonzero(observed > start)
        stretches = _stretches(beyond, time_s, gap_s)
        largest = np.array([ratio[rows].max() for rows in stretches])
        peaks = largest - start
        count = len(peaks)
        if count >= ENOUGH_PEAKS:
            break
    if count < MIN_PEAKS:
        return None
    mean = float(peaks.mean())
    shape = tail_shape_bound(peaks)
    # The sum of exponential peaks has a gamma distribution: the bound of its scale.
    least_sum = float(gammaincinv(count, 1.0 - TAIL_CONFIDENCE))
    scale = (1.0 - shape) * mean * count / least_sum
    # An hour of signal has so many times more peaks than alarms are allowed.
    peaks_per_hour = count * 3600.0 / observed_s
    factor = max(1.0, peaks_per_hour / alarms_per_hour)
    # Level of the generalised Pareto distribution: σ (nˢ − 1)/s, σ log n for s = 0
    if shape < 1e-9:
        beyond_start = np.log(factor)
    else:
        beyond_start = (factor**shape - 1.0) / shape
    level = start + scale * beyond_start
    return float(SCALE_MARGIN * level)


def tail_shape_bound(peaks: FloatArray) -> float:
    """Upper bound of the shape ξ of a generalised Pareto distribution, from 0 to LARGEST_SHAPE.

    ξ is estimated by probability-weighted moments, which a single largest peak moves less than a
    variance; its standard error is the asymptotic one (Hosking & Wallis 1987, eqs. for k = −ξ).

    Args:
        peaks: above the threshold, not negative, shape (n,).
    """
    count = len(peaks)
    ordered = np.sort(peaks)
    mean = float(ordered.mean())
    # α₁ = E[x (1 − F(x))], unbiased
    remaining = count - np.arange(1, count + 1)
    weighted = float(ordered @ remaining) / (count * (count - 1))
    if mean <= 2.0 * weighted:
        return 0.0  # equal peaks: no tail
    shape = 2.0 - mean / (mean - 2.0 * weighted)
    k = -float(np.clip(shape, -0.4, 0.4))  # where the asymptotic variance holds
    # (1 + k)(2 + k)²(1 + k + 2k²) / ((1 + 2k)(3 + 2k) n)
    numerator = (1.0 + k) * (2.0 + k) ** 2 * (1.0 + k + 2.0 * k**2)
    denominator = (1.0 + 2.0 * k) * (3.0 + 2.0 * k)
    variance = numerator / denominator / count
    upper_bound = shape + SHAPE_SIGMAS * np.sqrt(variance)
    return float(np.clip(upper_bound, 0.0, LARGEST_SHAPE))


def _correlation(runs: Sequence[FloatArray]) -> float:
    """Rows until the autocorrelation of a signal falls below 1/e, interpolated; at least 1.

    Args:
        runs: the signal, NaN in its gaps.
    """
    limit = np.exp(-1.0)
    before = 1.0
    for lag in range(1, 200):
        first = np.concatenate([run[:-lag] for run in runs])
        second = np.concatenate([run[lag:] for run in runs])
        both = np.isfinite(first) & np.isfinite(second)
        if both.sum() < 10:
            return float(lag)
        first = first[both]
        second = second[both]
        # Σ x_k x_k+l / √(Σ x_k² Σ x_k+l²)
        squares = (first**2).sum() * (second**2).sum()
        value = float(first @ second) / float(np.sqrt(squares))
        if value < limit:
            share = (before - limit) / (before - value)
            return float(max(1.0, lag - 1 + share))
        before = value
    return 200.0


def _stretches(rows: IntArray, time_s: FloatArray, gap_s: float) -> list[IntArray]:
    """Rows parted where more than a gap lies between two of them."""
    if not len(rows):
        return []
    apart_s = np.diff(time_s[rows])
    last_before_gap = np.flatnonzero(apart_s > gap_s)
    return np.split(rows, last_before_gap + 1)
