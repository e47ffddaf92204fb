"""Coloured noise of a simulated cell: of its reported currents,
and of the torque that disturbs its motors.

A first-order Gauss-Markov process n of standard deviation σ and correlation time T, at steps h
apart:

    n⁺ = m n + σ √(1 − m²) w,     m = exp(−h/T),     w standard normal,

whose autocovariance is σ² exp(−|t|/T) at every multiple of h. T = 0 is white noise.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drivers.simulation.spec import FloatArray

BLOCK = 1024  #: Numbers drawn at a time from each stream


class ColouredNoise:
    """Independent processes with a random stream each; the first value has the stationary variance.

    Attributes:
        value: present value of each process, shape (n,).
    """

    def __init__(
        self,
        streams: Sequence[np.random.Generator],
        sigma: FloatArray,
        correlation_s: FloatArray,
        step_s: float,
    ) -> None:
        """Draw the first values.

        Args:
            streams: of random numbers, n of them.
            sigma: standard deviations, shape (n,), in the unit of the values.
            correlation_s: correlation times, shape (n,).
            step_s: time between two values.
        """
        with np.errstate(divide="ignore"):
            self._memory = np.exp(-step_s / np.asarray(correlation_s, dtype=np.float64))
        self._drive = sigma * np.sqrt(1.0 - self._memory**2)
        self._streams = streams
        self.value: FloatArray = sigma * [stream.standard_normal() for stream in streams]
        self._block = np.zeros((0, len(streams)))
        self._used = 0

    def advance(self) -> FloatArray:
        """Return the next value of each process, shape (n,)."""
        if self._used == len(self._block):
            columns = [stream.standard_normal(BLOCK) for stream in self._streams]
            self._block = np.stack(columns, axis=1)
            self._used = 0
        white = self._block[self._used]
        self.value = self._memory * self.value + self._drive * white
        self._used += 1
        return self.value


def random_streams(seed: int, axes: int, *kind: int) -> list[np.random.Generator]:
    """Return a stream for each axis: its noise depends neither on the other axes nor on noise of
    another kind.
    """
    streams = []
    for axis in range(axes):
        sequence = np.random.SeedSequence(seed, spawn_key=(axis, *kind))
        streams.append(np.random.default_rng(sequence))
    return streams
