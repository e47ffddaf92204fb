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
from math import ceil
from numbers import Real
from typing import Any, Self

import numpy as np

from ident.arrays import FloatArray, IntArray, require_count, require_kind
from ident.errors import ModelError

FILTER_ORDER = (1, 10)  #: Least and largest order of the filter of the positions

FULL_FILTER_HZ = 125.0
"""Sampling rate from which the usual cut-offs hold, that of a real arm in the tests;
below, they fall with it.
"""


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

    @classmethod
    def for_rates(cls, rates_hz: Iterable[float]) -> Self:
        """Return filters for recordings of some sampling rates:
        the usual ones, lower for slow recordings.
        """
        share = 1.0
        for rate_hz in rates_hz:
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
        expected = cls().document()
        found: dict[str, Any] = dict(document)
        lists = [name for name, value in found.items() if isinstance(value, list)]
        if found.keys() != expected.keys() or lists != ["standstill_rad_s"]:
            given = ", ".join(f"{name}: {value}" for name, value in found.items()) or "nothing"
            numbers = ", ".join(sorted(expected.keys() - {"standstill_rad_s"}))
            raise ModelError(
                f"the filter of the calibration: found {given}; expected a list standstill_rad_s "
                f"and numbers {numbers}; give `conditioning`, or fit again"
            )
        order = round(found.pop("position_order"))
        speeds = tuple(found.pop("standstill_rad_s"))
        return cls(**found, position_order=order, standstill_rad_s=speeds)

    def document(self) -> dict[str, float | list[float]]:
        """Settings by name, for a report."""
        document = asdict(self)
        document["standstill_rad_s"] = list(self.standstill_rad_s)
        return document


def require_settings(conditioning: Conditioning) -> None:
    """Refuse settings that are no numbers, and an order that no filter of positions has.

    Cut-offs are compared with the sampling rate of each run.

    Raises:
        ModelError: for the setting.
    """
    numbers = {
        "position_cutoff_hz": conditioning.position_cutoff_hz,
        "decimation_cutoff_hz": conditioning.decimation_cutoff_hz,
        "standstill_share": conditioning.standstill_share,
    }
    for name, value in numbers.items():
        require_kind(f"{name} of the conditioning", value, Real, "give a number")
    label = "position_order of the conditioning"
    least, largest = FILTER_ORDER
    order = require_count(label, conditioning.position_order, remedy="give a number such as 4")
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
            series = [self._of_long_series(own, count) for own in flat]
            return np.reshape(series, (*leading, count))
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
        """So many outputs of several series together, shape (c, k) → (c, count)."""
        taps = self._taps_of_blocks
        blocks = len(taps)
        samples = flat.shape[1]
        length = (count + blocks - 1) * self.factor
        if samples != length:
            padded = np.zeros((len(flat), length))
            padded[:, : min(length, samples)] = flat[:, :length]
            flat = padded
        weighted = taps @ flat.reshape(-1, self.factor).T
        by_block = weighted.reshape(blocks, len(flat), -1)
        out = np.zeros((len(flat), count))
        for block, share in enumerate(by_block):
            out += share[:, block : block + count]
        return out

    def _of_long_series(self, series: FloatArray, count: int) -> FloatArray:
        """So many outputs of one series, shape (k,) → (count,):
        it is not copied, and its products stay in the cache's reach.
        """
        taps = self._taps_of_blocks
        blocks = len(taps)
        whole_blocks = min(count + blocks - 1, len(series) // self.factor)
        end = whole_blocks * self.factor
        weighted = taps @ series[:end].reshape(whole_blocks, self.factor).T
        out = np.zeros(count)
        for block, share in enumerate(weighted):
            inside = share[block : block + count]
            out[: len(inside)] += inside
        if whole_blocks < count + blocks - 1:  # the last window ends within a block of samples
            rest = series[end:]
            out[-1] += taps[-1, : len(rest)] @ rest
        return out


@lru_cache(maxsize=64)
def decimator(rate_hz: float, cutoff_hz: float) -> Decimator:
    """Decimator for a sampling rate: Hamming-windowed, −6 dB at the cut-off,
    transition as wide as the cut-off.
    """
    factor = max(1, round(rate_hz / (2.5 * cutoff_hz)))
    half = round(3.3 * rate_hz / cutoff_hz / 2.0)
    samples = np.arange(-half, half + 1)
    response = np.sinc(2.0 * cutoff_hz / rate_hz * samples)
    taps = response * np.hamming(2 * half + 1)
    return Decimator(taps / taps.sum(), factor)
