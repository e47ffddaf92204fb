"""Histories for tests: calibrations a week apart, with or without a drift."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np

from daq.documents.calibration_file import encode_calibration
from daq.ledger.store import HistoryStore
from ident.calibration import Calibration
from tests.daq.calibrations import demo_calibration, recorded

BEGIN = datetime(2026, 1, 5, 6, 0, 0, tzinfo=UTC)
STD = 0.004
RECALIBRATION = """
recalibration:
  runs:
    - {name: bare, plan: {seed: 1}}
    - {name: loaded, payload: disc, mass_kg: 4.59, plan: {seed: 1}}
    - {name: held-out, payload: disc, mass_kg: 4.59, plan: {seed: 3}, holdout: true}
  interlock: {file: interlock}
  mount: {command: ["true"]}
"""
"""To follow a cell file: a job of three runs."""


def calibration_of(week: int, factors: tuple[float, ...] = (1.0,) * 6) -> Calibration:
    """The demo calibration of logs of that week, each gain times a factor."""
    demo = demo_calibration()
    gains = tuple(
        replace(gain, value=float(gain.value * factor), std=STD * abs(gain.value))
        for gain, factor in zip(demo.gains, factors, strict=True)
    )
    at = BEGIN + timedelta(weeks=week)
    logs = tuple(
        replace(one, sha256=hashlib.sha256(f"{one.name} of week {week}".encode()).hexdigest()) for one in demo.sources
    )
    return recorded(replace(demo, gains=gains, sources=logs, created=at.isoformat()), at)


def digest_of(calibration: Calibration) -> str:
    """SHA-256 of its file."""
    return hashlib.sha256(encode_calibration(calibration)).hexdigest()


def enter(store: HistoryStore, calibration: Calibration) -> str:
    """Add it at the time that it was made."""
    digest = digest_of(calibration)
    store.add(calibration, digest=digest, at=datetime.fromisoformat(calibration.created))
    return digest


def fill(store: HistoryStore, weeks: int, true: Callable[[int], tuple[float, ...]], seed: int = 3) -> tuple[str, ...]:
    """Enter calibrations with their noise.

    Args:
        store: to fill.
        weeks: number of calibrations.
        true: factor of each gain in that week.
        seed: of the noise.

    Returns:
        their digests.
    """
    rng = np.random.default_rng(seed)
    noise = 1.0 + STD * rng.standard_normal((weeks, 6))
    return tuple(
        enter(store, calibration_of(week, tuple(map(float, np.array(true(week)) * noise[week]))))
        for week in range(weeks)
    )
