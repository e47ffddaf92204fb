"""The filters between samples and rows (paper §2.3),
chosen once and reported with every relative error.

Positions go through a zero-phase Butterworth low-pass before they are differentiated. Every column
of the equations, and the currents, then go through one decimator. Both are written out here: they
are twenty lines each, and importing scipy.signal for them would take longer than fitting a minute
of data. The tests compare both with scipy.signal.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from math import ceil, inf
from numbers import Real
from typing import Any, Self

import numpy as np

from ident.arrays import (
    FloatArray,
    IntArray,
    Refusal,
    require_count,
    require_kind,
    require_no_flag,
    require_number,
)
from ident.errors import ModelError

FILTER_ORDER = (1, 10)  #: Least and largest order of the filter of the positions

FULL_FILTER_HZ = 125.0
"""Sampling rate from which the usual cut-offs hold, that of a real arm in the tests;
below, they fall with it.
"""

#: Settings of the currents' low-pass; a document of currents as they flowed lacks them
CURRENT_FILTER = ("current_cutoff_hz", "current_order")
#: Settings that a refusal does not list as numbers to give: a list, and optional ones
NO_REQUIRED_NUMBER = frozenset({"standstill_rad_s", *CURRENT_FILTER})

ROWS_PER_PERIOD = 2.5  #: Rows in a period of the decimation's cut-off: above the two of Nyquist
#: A Hamming window of N taps has a transition of 3.3/N of the sampling rate
HAMMING_TRANSITION = 3.3

#: Share of Σ|h| of the currents' low-pass h that its truncation to a finite window drops
TRUNCATED_SHARE = 0.01
#: Periods of its cut-off on either side for which h is computed before it is truncated; what is
#: beyond them is less than TRUNCATED_SHARE
RESPONSE_PERIODS = 3.0


@dataclass(frozen=True, slots=True)
class Conditioning:
    """How raw samples become rows."""

    #: zero-phase Butterworth on the position, before the central differences
    position_cutoff_hz: float = 40.0
    position_order: int = 4  #: order of that filter
    #: Of the parallel decimation of every column; there is a row every 1/(2.5 cut-off).
    decimation_cutoff_hz: float = 20.0
    #: Speed below which a joint is at standstill, one a joint (m/s for a prismatic one); if empty,
    #: it is derived from each run (`ident.data.dataset.standstill_speed`).
    standstill_rad_s: tuple[float, ...] = ()
    #: a row is left out when standstill fills more than this share of its filter window
    standstill_share: float = 0.1
    #: Cut-off of a low-pass that the currents went through before they were recorded; every torque
    #: that is compared with them goes through it. 0 for currents as they flowed.
    current_cutoff_hz: float = 0.0
    #: Order of that low-pass, a Butterworth forwards and backwards, −6 dB at the cut-off: what was
    #: made smooth after the recording. 0 for a causal one of first order, as drives have it.
    current_order: int = 0

    @classmethod
    def for_rates(cls, rates_hz: Iterable[float]) -> Self:
        """Return filters for recordings of some sampling rates:
        the usual ones, lower for slow recordings.

        Raises:
            ModelError: this is no list of numbers above zero.
        """
        remedy = "give a list of sampling rates, such as [500.0]"
        require_kind("rates_hz", rates_hz, Iterable, remedy)
        share = 1.0
        for rate_hz in rates_hz:
            require_number("an entry of rates_hz", rate_hz, above=0.0, remedy=remedy)
            share = min(share, rate_hz / FULL_FILTER_HZ)
        usual = cls()
        return cls(
            position_cutoff_hz=share * usual.position_cutoff_hz,
            decimation_cutoff_hz=share * usual.decimation_cutoff_hz,
        )

    @classmethod
    def of_document(cls, document: Mapping[str, float | Iterable[float]]) -> Self:
        """Return the filters that `document` has described.

        Raises:
            ModelError: a setting is missing, unknown, or no number.
        """
        remedy = "give what `Conditioning.document` returns"
        require_kind("the filter of the calibration", document, Mapping, remedy)
        expected = asdict(cls())
        found: dict[str, Any] = dict(document)
        for name in CURRENT_FILTER:
            found.setdefault(name, 0)
        lists = [name for name, value in found.items() if isinstance(value, list)]
        has_one_list = lists == ["standstill_rad_s"]
        if found.keys() != expected.keys() or not has_one_list:
            given = ", ".join(f"{name}: {value}" for name, value in document.items()) or "nothing"
            numbers = ", ".join(sorted(expected.keys() - NO_REQUIRED_NUMBER))
            raise ModelError(
                f"the filter of the calibration: found {given}; expected a list standstill_rad_s "
                f"and numbers {numbers}; give `conditioning`, or fit again"
            )
        for name, value in found.items():
            if name != "standstill_rad_s":
                require_number(f"{name} of the calibration's filter", value, remedy=remedy)
        order = round(found.pop("position_order"))
        current_order = round(found.pop("current_order"))
        speeds = tuple(found.pop("standstill_rad_s"))
        _require_speeds(speeds)
        return cls(
            **found, position_order=order, current_order=current_order, standstill_rad_s=speeds
        )

    def document(self) -> dict[str, float | list[float]]:
        """Settings by name, for a report."""
        document = asdict(self)
        document["standstill_rad_s"] = list(self.standstill_rad_s)
        if not self.current_cutoff_hz:
            # Calibrations of currents as they flowed stay as they were before it was known.
            for name in CURRENT_FILTER:
                del document[name]
        return document


def require_settings(conditioning: Conditioning) -> None:
    """Refuse settings that are no numbers of their range, and orders that no filter has.

    Cut-offs are compared with the sampling rate of each run.

    Raises:
        ModelError: for the setting.
    """
    numbers = {
        "position_cutoff_hz": conditioning.position_cutoff_hz,
        "decimation_cutoff_hz": conditioning.decimation_cutoff_hz,
        "current_cutoff_hz": conditioning.current_cutoff_hz,
        "standstill_share": conditioning.standstill_share,
    }
    for name, value in numbers.items():
        label = f"{name} of the conditioning"
        require_kind(label, value, Real, "give a number")
        require_no_flag(label, value, "leave it out if you do not know it")
    if not 0.0 <= conditioning.standstill_share <= 1.0:
        raise ModelError(
            f"standstill_share of the conditioning is {conditioning.standstill_share:g}; expected "
            "0 to 1; 0.1 is usual"
        )
    _require_speeds(conditioning.standstill_rad_s)
    least, largest = FILTER_ORDER
    _require_order("position_order", conditioning.position_order, least, largest)
    _require_order("current_order", conditioning.current_order, 0, largest)


def require_cutoffs(conditioning: Conditioning, refuse: Refusal = ModelError) -> None:
    """Refuse cut-offs that no filter has at any sampling rate.

    Raises:
        Exception: made by ``refuse``, where one is not above 0 Hz.
    """
    cutoffs_hz = [conditioning.position_cutoff_hz, conditioning.decimation_cutoff_hz]
    if conditioning.current_cutoff_hz != 0.0:
        cutoffs_hz.append(conditioning.current_cutoff_hz)
    for cutoff_hz in cutoffs_hz:
        if not 0.0 < cutoff_hz < inf:  # nor is NaN
            raise refuse(
                f"filtered with a cut-off of {cutoff_hz:g} Hz; expected above 0 Hz, and finite: "
                "see Conditioning"
            )


def _require_speeds(speeds: object) -> None:
    """Refuse standstill speeds that are no tuple or list of numbers, zero or above."""
    label = "standstill_rad_s of the conditioning"
    remedy = "give one a joint, (0.03, 0.03), or leave it out"
    if not isinstance(speeds, (tuple, list)):
        found = type(speeds).__name__
        raise ModelError(f"{label} is of type {found}; expected a tuple of numbers; {remedy}")
    for number, speed in enumerate(speeds, start=1):
        entry = require_number(f"entry {number} of {label}", speed, remedy=remedy)
        if entry < 0.0:
            raise ModelError(f"entry {number} of {label} is {entry:g}; expected 0 or more")


def _require_order(name: str, value: object, least: int, largest: int) -> None:
    label = f"{name} of the conditioning"
    order = require_count(label, value, remedy="give a number such as 4")
    if not least <= order <= largest:
        raise ModelError(f"{label} is {order}; expected {least} to {largest}; 4 is usual")


def low_pass(values: FloatArray, rate_hz: float, cutoff_hz: float, order: int) -> FloatArray:
    """Filter with a Butterworth low-pass forwards and backwards: no phase, −6 dB at the cut-off.

    Either end is continued by its odd mirror image, as scipy.signal.sosfiltfilt does it by default.

    Args:
        values: time last, shape (c, k), longer than 3 (order + 1) samples.
        rate_hz: sampling rate.
        cutoff_hz: below half the sampling rate.
        order: of the filter in one direction.

    Returns:
        shape (c, k).
    """
    pad = 3 * (order + 1)
    # 2 x_end − x_j: the samples next to an end, mirrored at the point of its last sample.
    before = 2.0 * values[:, :1] - values[:, pad:0:-1]
    after = 2.0 * values[:, -1:] - values[:, -2 : -pad - 2 : -1]
    sections = _butterworth(order, cutoff_hz / rate_hz)
    padded = np.concatenate((before, values, after), axis=1)
    forwards = _filtered(sections, padded)
    backwards = _filtered(sections, forwards[:, ::-1])
    return backwards[:, ::-1][:, pad:-pad]


def central_differences(
    smooth: FloatArray, rate_hz: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Position, velocity and acceleration of all samples but the first and last;
    time last, (c, k) → (c, k − 2).
    """
    before = smooth[:, :-2]
    position = smooth[:, 1:-1]
    after = smooth[:, 2:]
    velocity = (after - before) * (0.5 * rate_hz)
    acceleration = (after - 2.0 * position + before) * rate_hz**2
    return position, velocity, acceleration


@dataclass(frozen=True, slots=True)
class _Section:
    """A section y_k + a_1 y_k−1 + a_2 y_k−2 = b_0 x_k + b_1 x_k−1 + b_2 x_k−2."""

    b0: float
    b1: float
    b2: float
    a1: float
    a2: float


def _butterworth(order: int, cutoff: float) -> list[_Section]:
    """Sections of second order with gain one at rest, by the bilinear transform.

    w = tan(π cut-off) is the cut-off of the analogue prototype, pre-warped so that the digital
    filter has its −3 dB where they are asked for (Oppenheim & Schafer, Discrete-Time Signal
    Processing, ch. 7).

    Args:
        order: N; an odd one ends with a section of first order.
        cutoff: as a share of the sampling rate.
    """
    w = float(np.tan(np.pi * cutoff))
    sections: list[_Section] = []
    for pair in range(order // 2):
        # s² + 2 sin θ w s + w²: a pair of poles on the circle of radius w.
        angle = np.pi * (2 * pair + 1) / (2 * order)
        damping = 2.0 * float(np.sin(angle)) * w
        scale = 1.0 + damping + w**2
        gain = w**2 / scale
        section = _Section(
            b0=gain,
            b1=2.0 * gain,
            b2=gain,
            a1=2.0 * (w**2 - 1.0) / scale,
            a2=(1.0 - damping + w**2) / scale,
        )
        sections.append(section)
    if order % 2:
        gain = w / (1.0 + w)
        feedback = (w - 1.0) / (1.0 + w)
        sections.append(_Section(b0=gain, b1=gain, b2=0.0, a1=feedback, a2=0.0))
    return sections


def _filtered(sections: list[_Section], values: FloatArray) -> FloatArray:
    """Run the sections over values that were constant before their first sample, shape (c, k)."""
    from scipy.linalg import lapack  # noqa: PLC0415 - a cell file has filter settings, and reading it needs no LAPACK

    start = values[:, :1]
    out = values - start
    # The three diagonals 1, a_1 and a_2, one a row, as LAPACK stores a band.
    band = np.ones((3, out.shape[1]), order="F")
    for section in sections:
        driven = section.b0 * out
        driven[:, 1:] += section.b1 * out[:, :-1]
        driven[:, 2:] += section.b2 * out[:, :-2]
        # y_k + a_1 y_k−1 + a_2 y_k−2 = driven_k is a triangular system with two bands.
        band[1] = section.a1
        band[2] = section.a2
        solution, _ = lapack.dtbtrs(band, driven.T, uplo="L", diag="U")
        out = solution.T
    return np.asarray(out + start)


#: Samples from which on a series is decimated by itself: several would not fit a core's cache
LONG_SERIES = 16_384


@dataclass(frozen=True, slots=True)
class Decimator:
    """A symmetric FIR low-pass of which every q-th output is used:
    zero phase, and a window of finite length.

    The finite window makes it exact at the edges of a chunk, and makes "standstill fills a tenth of
    the window" a definite statement.
    """

    taps: FloatArray  #: weights, odd number, summing to one
    factor: int  #: q

    @property
    def half(self) -> int:
        """Samples on either side of a window's centre."""
        return len(self.taps) // 2

    def rows(self, samples: int) -> int:
        """Outputs whose complete window lies inside so many samples."""
        inside = samples - 2 * self.half
        if inside < 1:
            return 0
        return (inside - 1) // self.factor + 1

    def centres(self, samples: int) -> IntArray:
        """Index of the sample at the centre of each output's window."""
        return self.half + self.factor * np.arange(self.rows(samples))

    def __call__(self, columns: FloatArray) -> FloatArray:
        """Filter and decimate along the last axis: shape (..., k) → (..., rows(k))."""
        *leading, samples = columns.shape
        count = self.rows(samples)
        flat = columns.reshape(-1, samples)
        if samples >= LONG_SERIES:
            rows = [self._of_long_series(series, count) for series in flat]
            return np.reshape(rows, (*leading, count))
        return self._of_series(flat, count).reshape(*leading, count)

    @property
    def _taps_of_blocks(self) -> FloatArray:
        """Taps cut into blocks of q, with zeros after the last one, shape (blocks, q).

        Window r starts at sample r·q, so it is a sum over blocks of samples: one matrix product
        that reads every sample once. Taps come first in it: its sums then run along memory.
        """
        blocks = ceil(len(self.taps) / self.factor)
        taps = np.zeros(blocks * self.factor)
        taps[: len(self.taps)] = self.taps
        return taps.reshape(blocks, self.factor)

    def _of_series(self, flat: FloatArray, count: int) -> FloatArray:
        """The first ``count`` outputs of several series together, shape (c, k) → (c, count).

        With t_j the j-th block of taps and x_b the b-th block of samples, output r is the sum of
        t_j · x_r+j over all j.
        """
        taps = self._taps_of_blocks
        blocks = len(taps)
        samples = flat.shape[1]
        needed = (count + blocks - 1) * self.factor
        if samples != needed:  # to complete blocks: zeros meet only the zeros behind the last tap
            padded = np.zeros((len(flat), needed))
            padded[:, : min(needed, samples)] = flat[:, :needed]
            flat = padded
        products = taps @ flat.reshape(-1, self.factor).T
        by_taps = products.reshape(blocks, len(flat), -1)
        out = np.zeros((len(flat), count))
        for block, of_taps in enumerate(by_taps):
            out += of_taps[:, block : block + count]
        return out

    def _of_long_series(self, series: FloatArray, count: int) -> FloatArray:
        """The same of one series, shape (k,) → (count,), without a copy of it.

        Its products stay in the cache's reach. A last block of samples that the series does not
        fill is met by the last window alone, and only by its last block of taps.
        """
        taps = self._taps_of_blocks
        blocks = len(taps)
        needed_blocks = count + blocks - 1
        full_blocks = min(needed_blocks, len(series) // self.factor)
        end = full_blocks * self.factor
        products = taps @ series[:end].reshape(full_blocks, self.factor).T
        out = np.zeros(count)
        for block, of_taps in enumerate(products):
            inside = of_taps[block : block + count]
            out[: len(inside)] += inside
        if full_blocks < needed_blocks:
            rest = series[end:]
            out[-1] += taps[-1, : len(rest)] @ rest
        return out


@lru_cache(maxsize=64)
def decimator(rate_hz: float, cutoff_hz: float) -> Decimator:
    """Decimator for a sampling rate: Hamming-windowed, −6 dB at the cut-off,
    transition as wide as the cut-off.
    """
    rows_per_s = ROWS_PER_PERIOD * cutoff_hz
    factor = max(1, round(rate_hz / rows_per_s))
    length = HAMMING_TRANSITION * rate_hz / cutoff_hz
    half = round(length / 2.0)
    samples = np.arange(-half, half + 1)
    # The ideal low-pass, sin(2π f_c t)/(2π f_c t).
    ideal = np.sinc(2.0 * cutoff_hz / rate_hz * samples)
    taps = ideal * np.hamming(2 * half + 1)
    return Decimator(taps / taps.sum(), factor)


def current_rows(rate_hz: float, conditioning: Conditioning) -> Decimator:
    """Decimator of the currents, and of whatever else is wanted at the rows.

    Its windows are as long as those of `torque_rows`, so both have the same rows.
    """
    plain = decimator(rate_hz, conditioning.decimation_cutoff_hz)
    if not conditioning.current_cutoff_hz:
        return plain
    zeros_a_side = rows_lost(rate_hz, conditioning) * plain.factor
    return Decimator(np.pad(plain.taps, zeros_a_side), plain.factor)


def torque_rows(rate_hz: float, conditioning: Conditioning) -> Decimator:
    """Decimator of the torques that are compared with the currents.

    It has the low-pass of the currents, too; without such a low-pass it is that of the currents.
    """
    plain = decimator(rate_hz, conditioning.decimation_cutoff_hz)
    if not conditioning.current_cutoff_hz:
        return plain
    response = _current_response(rate_hz, conditioning)
    # A tap weights the sample at its place in the window: the past comes first.
    taps = np.convolve(plain.taps, response[::-1])
    # The convolution has made the window longer already; zeros make it as long as the currents'.
    added_a_side = len(response) // 2
    zeros_a_side = rows_lost(rate_hz, conditioning) * plain.factor - added_a_side
    return Decimator(np.pad(taps, zeros_a_side), plain.factor)


def rows_lost(rate_hz: float, conditioning: Conditioning) -> int:
    """Number of rows that a run loses at either end to the low-pass of the currents.

    Their windows, longer by its response, would reach beyond the run. The other rows are those that
    the run has without the low-pass.
    """
    plain = decimator(rate_hz, conditioning.decimation_cutoff_hz)
    return ceil(memory_samples(rate_hz, conditioning) / plain.factor)


def memory_samples(rate_hz: float, conditioning: Conditioning) -> int:
    """Number of samples on either side of one that the low-pass of the currents mixes into it."""
    if not conditioning.current_cutoff_hz:
        return 0
    return len(_current_response(rate_hz, conditioning)) // 2


def as_recorded(rate_hz: float, conditioning: Conditioning, columns: FloatArray) -> FloatArray:
    """Columns of torque as the recorded currents show them, shape (..., k), at the same rate.

    They go through the low-pass of the currents where there is one. Before the first and after the
    last entry they are taken to stay as they are there.

    Args:
        rate_hz: of the series; that of the rows where the columns were made of decimated motion.
        conditioning: the filters.
        columns: of a run from its beginning to its end.
    """
    if not conditioning.current_cutoff_hz:
        return columns
    response = _current_response(rate_hz, conditioning)
    memory = len(response) // 2
    along_time_only = [(0, 0)] * (columns.ndim - 1) + [(memory, memory)]
    padded = np.pad(columns, along_time_only, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, len(response), axis=-1)
    return np.asarray(windows @ response[::-1])


def _current_response(rate_hz: float, conditioning: Conditioning) -> FloatArray:
    """Response of the currents' low-pass to a unit sample, shape (2 l + 1,), with the sum one."""
    return _response(rate_hz, conditioning.current_cutoff_hz, conditioning.current_order)


@lru_cache(maxsize=256)
def _response(rate_hz: float, cutoff_hz: float, order: int) -> FloatArray:
    """The same for a cut-off and an order, of a length l that drops TRUNCATED_SHARE of Σ|h|."""
    if order:
        full = _zero_phase_response(rate_hz, cutoff_hz, order)
    else:
        full = _lag_response(rate_hz, cutoff_hz)
    middle = len(full) // 2
    size = np.abs(full)
    at_distance = size[middle + 1 :] + size[:middle][::-1]  # on both sides of the middle
    within = size[middle] + np.cumsum(at_distance)  # Σ|h| up to the distances 1, 2, …
    kept = (1.0 - TRUNCATED_SHARE) * within[-1]
    length = 1 + int(np.searchsorted(within, kept))
    response = full[middle - length : middle + length + 1]
    return np.asarray(response / response.sum())


def _zero_phase_response(rate_hz: float, cutoff_hz: float, order: int) -> FloatArray:
    """Response of a Butterworth low-pass that is applied forwards and backwards."""
    length = ceil(RESPONSE_PERIODS * rate_hz / cutoff_hz)
    impulse = np.zeros((1, 2 * length + 1))
    impulse[0, length] = 1.0
    return np.asarray(low_pass(impulse, rate_hz, cutoff_hz, order)[0])


def _lag_response(rate_hz: float, cutoff_hz: float) -> FloatArray:
    """Response of a causal low-pass of first order, as drives have it.

    T ẏ + y = x with T = 1/(2π cut-off) is solved exactly for an x that is straight between
    samples: y_k = a y_k−1 + b_0 x_k + b_1 x_k−1 with w = 1/(rate T), a = e^−w, b_0 = 1 − μ,
    b_1 = μ − a and μ = (1 − a)/w, the mean decay over a sample. The response to a unit sample is
    h_0 = b_0 and h_k = (a b_0 + b_1) a^(k−1).
    """
    w = 2.0 * np.pi * cutoff_hz / rate_hz
    decay = float(np.exp(-w))
    mean_decay = (1.0 - decay) / w
    length = ceil(RESPONSE_PERIODS * rate_hz / cutoff_hz)
    before = np.zeros(length)
    first = 1.0 - mean_decay
    second = first * decay + mean_decay - decay
    after = second * decay ** np.arange(length)
    return np.concatenate((before, [first], after))
