"""External torque of the joints: what the motors supply beyond the prediction, its band,
and a threshold for alarms.

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
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls
from scipy.special import gammaincinv

from ident.arrays import BoolArray, FloatArray, IntArray, require_kind, require_number, takes
from ident.calibration import Calibration
from ident.data.conditioning import Conditioning, as_recorded
from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.equations.rows import row_filter, row_masks
from ident.errors import DataUnfit
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
        found = []
        over = np.abs(self.torque_nm) / self.threshold_nm
        for axis, beyond in enumerate(self.use & (over > 1.0)):
            for rows in _stretches(
                np.flatnonzero(beyond), self.time_s, 2.0 * self.band.correlation_s[axis]
            ):
                peak = rows[np.argmax(over[axis, rows])]
                start_s, end_s = (float(self.time_s[row]) for row in (rows[0], rows[-1]))
                found.append(
                    Contact(
                        axis,
                        start_s,
                        end_s,
                        float(self.torque_nm[axis, peak]),
                        float(over[axis, peak]),
                    )
                )
        return tuple(sorted(found, key=lambda contact: contact.start_s))


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
    rows = _residual(calibration, model, run, conditioning or calibration.conditioning)
    itself = band is None
    left_out = 0
    if band is None:
        quiet, left_out = _quiet(rows)
        band = _band([quiet], ALARMS_PER_HOUR)
    scale = np.einsum("jd,jdr->jr", band.scale, rows.drivers)
    return ExternalTorque(rows.time_s, rows.torque_nm, scale, rows.use, band, itself, left_out)


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
    filters = conditioning or calibration.conditioning
    return _band([_residual(calibration, model, run, filters) for run in quiet], alarms_per_hour)


def _residual(
    calibration: Calibration, model: Model, run: Run, conditioning: Conditioning
) -> _Residual:
    require_kind(
        "an entry of the runs", run, Run, "write Run(name, time_s, position_rad, current_a)"
    )
    data = differentiate(run, model.drive_train, conditioning)
    filter_ = row_filter(data, conditioning)
    use, _ = row_masks(model, data, conditioning)
    if not use.any():
        raise DataUnfit(
            data.name, "no row is left after the standstill and validity masks; did the robot move?"
        )
    needed_nm = predict_torque(calibration, model, data).T
    predicted = as_recorded(data.rate_hz, conditioning, needed_nm)
    measured = measured_torque(calibration, model, data.current_a, data.motion()).T
    torque, needed, speed, acceleration = (
        filter_(one)
        for one in (
            measured - predicted,
            predicted,
            data.velocity_rad_s.T,
            data.acceleration_rad_s2.T,
        )
    )
    drivers = np.stack(
        (np.ones_like(torque), np.abs(needed), np.abs(speed), np.abs(acceleration)), axis=1
    )
    centres = filter_.centres(len(data.time_s))
    return _Residual(
        data.time_s[centres] - data.time_s[0], torque, drivers, use, data.move[centres]
    )


def _quiet(rows: _Residual) -> tuple[_Residual, int]:
    """The rows without the stretches that are far out on any joint, and the number of these."""
    scale = _scales([rows], robust=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(
            rows.use, np.abs(rows.torque_nm) / np.einsum("jd,jdr->jr", scale, rows.drivers), 0.0
        )
    moves, of_move = np.unique(rows.move, return_inverse=True)
    largest = np.stack(
        [ratio[:, of_move == move].max(axis=1) for move in range(len(moves))], axis=1
    )
    lower, upper = np.quantile(largest, (0.25, 0.75), axis=1)
    loud = np.any(largest > (upper + FAR_OUT * (upper - lower))[:, None], axis=0)
    use = rows.use & ~loud[of_move]
    return _Residual(rows.time_s, rows.torque_nm, rows.drivers, use, rows.move), int(loud.sum())


def _scales(parts: Sequence[_Residual], *, robust: bool = False) -> FloatArray:
    """(a, b, c, d) of each joint, shape (m, 4); robust:
    rows beyond four times the scale are left out.
    """
    out = np.zeros((len(parts[0].use), len(DRIVERS)))
    for joint in range(len(out)):
        size = np.concatenate([np.abs(part.torque_nm[joint, part.use[joint]]) for part in parts])
        drivers = np.concatenate(
            [part.drivers[joint][:, part.use[joint]] for part in parts], axis=1
        )
        if not size.size or not size.any():
            continue
        scale = np.full(len(size), np.median(size) or size.mean())
        unit = drivers.max(axis=1)
        unit[unit == 0.0] = 1.0
        for _ in range(4):
            # A scale near zero would make the weights of a few rows everything.
            weight = 1.0 / np.maximum(scale, 0.1 * scale.mean())
            if robust:
                weight = np.where(size > 4.0 * scale, 0.0, weight)
            out[joint] = nnls((drivers / unit[:, None] * weight).T, size * weight)[0] / unit
            scale = out[joint] @ drivers
    return out


def _band(parts: Sequence[_Residual], alarms_per_hour: float) -> Band:
    if not parts:
        raise DataUnfit("", "no quiet run was given; expected at least one without contact")
    scale = _scales(parts)
    count = len(scale)
    factor, threshold, correlation_s, quiet_s = (np.full(count, np.nan) for _ in range(4))
    row_s = float(np.median(np.diff(parts[0].time_s)))
    for joint in range(count):
        runs = []
        for part in parts:
            with np.errstate(divide="ignore", invalid="ignore"):
                signed = part.torque_nm[joint] / (scale[joint] @ part.drivers[joint])
            runs.append(np.where(part.use[joint] & np.isfinite(signed), signed, np.nan))
        signed = np.concatenate(runs)
        rows = int(np.isfinite(signed).sum())
        quiet_s[joint], correlation_s[joint] = rows * row_s, row_s
        if rows < 2:
            continue
        correlation_s[joint] = row_s * _correlation(runs)
        factor[joint] = np.nanquantile(np.abs(signed), PREDICTED_SHARE)
        times = np.concatenate([part.time_s + 1e6 * index for index, part in enumerate(parts)])
        level = alarm_level(
            np.abs(signed),
            times,
            2.0 * correlation_s[joint],
            alarms_per_hour / count,
            quiet_s[joint],
        )
        threshold[joint] = np.nan if level is None else level
    return Band(scale, factor, threshold, correlation_s, quiet_s, alarms_per_hour)


def alarm_level(
    ratio: FloatArray, time_s: FloatArray, gap_s: float, alarms_per_hour: float, observed_s: float
) -> float | None:
    """Level that a signal exceeds, on average, less often an hour than given,
    extrapolated from its peaks; see the top.

    The signal may grow by SCALE_MARGIN.

    Args:
        ratio: the signal, not negative; NaN where it is not observed, shape (r,).
        time_s: of each entry, shape (r,).
        gap_s: exceedances closer than this are one.
        alarms_per_hour: occasions in an hour of observed signal.
        observed_s: how long it was observed.

    Returns:
        the level; None with fewer than MIN_PEAKS peaks.
    """
    for start in np.nanquantile(ratio, PEAK_QUANTILES).tolist():
        beyond = np.flatnonzero(np.nan_to_num(ratio) > start)
        peaks = np.array([ratio[rows].max() for rows in _stretches(beyond, time_s, gap_s)]) - start
        count = len(peaks)
        if count >= ENOUGH_PEAKS:
            break
    if count < MIN_PEAKS:
        return None
    mean = float(peaks.mean())
    shape = tail_shape_bound(peaks)
    # The sum of exponential peaks has a gamma distribution: the bound of its scale.
    scale = (1.0 - shape) * mean * count / float(gammaincinv(count, 1.0 - TAIL_CONFIDENCE))
    # An hour of signal has so many times more peaks than alarms are allowed.
    factor = max(1.0, count * 3600.0 / observed_s / alarms_per_hour)
    if shape < 1e-9:
        beyond_start = np.log(factor)
    else:
        beyond_start = (factor**shape - 1.0) / shape
    return float(SCALE_MARGIN * (start + scale * beyond_start))


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
    variance = (
        (1.0 + k)
        * (2.0 + k) ** 2
        * (1.0 + k + 2.0 * k**2)
        / ((1.0 + 2.0 * k) * (3.0 + 2.0 * k))
        / count
    )
    return float(np.clip(shape + SHAPE_SIGMAS * np.sqrt(variance), 0.0, LARGEST_SHAPE))


def _correlation(runs: Sequence[FloatArray]) -> float:
    """Rows until the autocorrelation of a signal with gaps (NaN) falls below 1/e, interpolated;
    at least 1.
    """
    before = 1.0
    for lag in range(1, 200):
        first = np.concatenate([run[:-lag] for run in runs])
        second = np.concatenate([run[lag:] for run in runs])
        both = np.isfinite(first) & np.isfinite(second)
        if both.sum() < 10:
            return float(lag)
        value = float(first[both] @ second[both]) / float(
            np.sqrt((first[both] ** 2).sum() * (second[both] ** 2).sum())
        )
        if value < np.exp(-1.0):
            return float(max(1.0, lag - 1 + (before - np.exp(-1.0)) / (before - value)))
        before = value
    return 200.0


def _stretches(rows: IntArray, time_s: FloatArray, gap_s: float) -> list[IntArray]:
    """Rows parted where more than a gap lies between two of them."""
    if not len(rows):
        return []
    return np.split(rows, np.flatnonzero(np.diff(time_s[rows]) > gap_s) + 1)
