"""A motion that can be evaluated anywhere:
benchmarks of millions of samples hold no more than the piece at hand.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident.model.robot import Motion

FloatArray = NDArray[np.float64]

RATE_HZ = 1000.0


@dataclass(frozen=True, slots=True, eq=False)
class Sinusoids:
    """q_j(t) = Σ_h a_jh sin(ω_jh t + φ_jh), arrays of shape (n, harmonics)."""

    amplitude_rad: FloatArray
    frequency_rad_s: FloatArray
    phase_rad: FloatArray

    def motion(self, time_s: FloatArray) -> Motion:
        """Position, velocity and acceleration at these instants, exact."""
        phase = self.frequency_rad_s[:, :, None] * time_s + self.phase_rad[:, :, None]
        sine = np.sin(phase)
        cosine = np.cos(phase)
        rate = self.amplitude_rad * self.frequency_rad_s
        return Motion(
            np.einsum("jh,jhk->kj", self.amplitude_rad, sine),
            np.einsum("jh,jhk->kj", rate, cosine),
            np.einsum("jh,jhk->kj", -rate * self.frequency_rad_s, sine),
        )

    def pieces(self, samples: int, piece: int) -> Iterator[Motion]:
        """So many samples at RATE_HZ, piece by piece."""
        for first in range(0, samples, piece):
            yield self.motion(np.arange(first, min(first + piece, samples)) / RATE_HZ)


def sinusoids(joints: int, seed: int) -> Sinusoids:
    """Five harmonics a joint, up to 0.6 Hz: ranges and speeds of an industrial arm."""
    rng = np.random.default_rng(seed)
    shape = (joints, 5)
    return Sinusoids(
        rng.uniform(0.2, 0.6, shape),
        2.0 * np.pi * rng.uniform(0.05, 0.6, shape),
        rng.uniform(0.0, 2.0 * np.pi, shape),
    )
