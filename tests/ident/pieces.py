"""Short recordings of one arm, without and with its payload, for fits that grow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ident.data.run import Run
from tests.ident.recordings import MOUNTED, FloatArray, Truth, record
from tests.ident.weighed import RATE_HZ, coloured

SECONDS = 4.0
NOISE = 0.04  #: Of the current, as a share of its root mean square; lag one of rows 0.67


def noisy_pieces(
    truth: Truth, seed: int, count: int = 8, seconds: float = SECONDS
) -> tuple[Run, ...]:
    """Runs in the order bare, loaded, loaded, bare, …, each with moves and noise of its own."""
    rng = np.random.default_rng(seed)
    pieces = []
    for number in range(count):
        payload = MOUNTED if number % 4 in (1, 2) else None
        clean = record(truth, f"piece {number + 1}", rng, payload, seconds=seconds, rate_hz=RATE_HZ)
        pieces.append(with_noise(clean, rng))
    return tuple(pieces)


def with_noise(run: Run, rng: np.random.Generator, share: float = NOISE) -> Run:
    """The same run with correlated noise of its currents."""
    current = run.current_a
    rms_current = np.sqrt(np.mean(current**2, axis=0))
    size: FloatArray = share * rms_current
    current_a = current + size * coloured(rng, current.shape)
    return replace(run, current_a=current_a)


def first_samples(run: Run, count: int) -> Run:
    """The run as it was after so many samples."""
    return replace(
        run,
        time_s=run.time_s[:count],
        position_rad=run.position_rad[:count],
        current_a=run.current_a[:count],
    )
