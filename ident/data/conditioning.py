"""The filters, chosen once and reported beside every relative error."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import signal

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Conditioning:
    """How raw samples become rows (paper §2.3).

    Attributes:
        position_cutoff_hz, position_order: zero-phase Butterworth on the position, before the central differences.
        decimation_cutoff_hz: of the parallel decimation of every column; a row is kept every 1/(2.5 cut-off).
        standstill_rad_s: a joint slower than this stands still, one speed a joint (m/s for a prismatic one).
        standstill_share: a row goes when standstill fills more than this share of its filter window.
    """

    position_cutoff_hz: float = 40.0
    position_order: int = 4
    decimation_cutoff_hz: float = 20.0
    standstill_rad_s: tuple[float, ...] = ()
    standstill_share: float = 0.1

    def document(self) -> dict[str, float | list[float]]:
        """The settings by name, for a report."""
        return {
            "position_cutoff_hz": self.position_cutoff_hz,
            "position_order": self.position_order,
            "decimation_cutoff_hz": self.decimation_cutoff_hz,
            "standstill_rad_s": list(self.standstill_rad_s),
            "standstill_share": self.standstill_share,
        }


@dataclass(frozen=True, slots=True)
class Decimator:
    """A symmetric FIR low-pass that keeps every q-th output: zero phase, and a window of finite length.

    The finite window is what makes it exact at the edges of a chunk, and what makes "standstill fills a tenth of the
    window" a definite statement.

    Attributes:
        taps: weights, odd number, summing to one.
        factor: q.
    """

    taps: FloatArray
    factor: int

    @property
    def half(self) -> int:
        """Samples on either side of a window's centre."""
        return len(self.taps) // 2

    def rows(self, samples: int) -> int:
        """Outputs whose whole window lies inside so many samples."""
        inside = samples - 2 * self.half
        return 0 if inside < 1 else (inside - 1) // self.factor + 1

    def centres(self, samples: int) -> NDArray[np.int64]:
        """Index of the sample at the centre of each output's window."""
        return self.half + self.factor * np.arange(self.rows(samples))

    def __call__(self, columns: FloatArray) -> FloatArray:
        """Filter and decimate along the last axis: shape (..., k) → (..., rows(k))."""
        shape = columns.shape
        count, factor = self.rows(shape[-1]), self.factor
        # Window r starts at sample r·q, so with the taps cut into blocks of q it is a sum over blocks of samples: one
        # matrix product that reads every sample once.
        blocks = -(-len(self.taps) // factor)
        taps = np.zeros(blocks * factor)
        taps[: len(self.taps)] = self.taps
        length = (count + blocks - 1) * factor
        flat = np.zeros((int(np.prod(shape[:-1])), length))
        flat[:, : min(length, shape[-1])] = columns.reshape(-1, shape[-1])[:, :length]
        weighted = flat.reshape(-1, factor) @ taps.reshape(blocks, factor).T
        weighted = weighted.reshape(len(flat), count + blocks - 1, blocks)
        out = np.zeros((len(flat), count))
        for block in range(blocks):
            out += weighted[:, block : block + count, block]
        return out.reshape(*shape[:-1], count)


@lru_cache(maxsize=64)
def decimator(rate_hz: float, cutoff_hz: float) -> Decimator:
    """The decimator for a sampling rate: Hamming-windowed, −6 dB at the cut-off, transition as wide as the cut-off."""
    factor = max(1, round(rate_hz / (2.5 * cutoff_hz)))
    count = 2 * round(3.3 * rate_hz / cutoff_hz / 2.0) + 1
    taps = signal.firwin(count, cutoff_hz, fs=rate_hz, window="hamming")
    return Decimator(np.asarray(taps, dtype=np.float64), factor)
