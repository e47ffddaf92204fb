"""Histories for tests: calibrations a week apart, with or without a drift."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from daq.config.cell_file import load_cell
from daq.documents.calibration_file import encode_calibration
from daq.environment import shipped_configurations
from daq.ledger.audit import AuditAction, AuditEntry, append
from daq.ledger.fold import History
from daq.ledger.ledger import Ledger, enter_calibration, read_history
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
        replace(one, sha256=hashlib.sha256(f"{one.name} of week {week}".encode()).hexdigest())
        for one in demo.sources
    )
    calibration = replace(demo, gains=gains, sources=logs, created=at.isoformat())
    return recorded(calibration, at)


def digest_of(calibration: Calibration) -> str:
    """SHA-256 of its file."""
    return hashlib.sha256(encode_calibration(calibration)).hexdigest()


def ledger_in(folder: Path) -> Ledger:
    """The ledger of the demo cell with its audit log in a folder."""
    path = shipped_configurations() / "cells" / "demo.yaml"
    demo = load_cell(path)
    return Ledger(demo, folder / "demo.audit.jsonl")


def ledger_of(cell: Path) -> Ledger:
    """The ledger of a cell file."""
    ledger = Ledger.of(load_cell(cell))
    assert ledger is not None
    return ledger


def history_of(cell: Path) -> History:
    """The history of a cell file."""
    return read_history(ledger_of(cell))


def enter(ledger: Ledger, calibration: Calibration) -> str:
    """Add it at the time that it was made."""
    digest = digest_of(calibration)
    at = datetime.fromisoformat(calibration.created)
    enter_calibration(ledger, calibration, digest=digest, who="anna", at=at)
    return digest


def write(
    ledger: Ledger,
    target: str,
    after: str,
    *,
    digest: str | None = None,
    at: datetime = BEGIN,
    who: str = "anna",
    before: str = "0" * 64,
) -> AuditEntry:
    """Enter a write to a controller as `apply` does,
    or as `rollback` does where it is of no calibration.

    Args:
        ledger: that gets the entries.
        target: that was written.
        after: SHA-256 of its content afterwards.
        digest: of the calibration.
        at: time.
        who: wrote.
        before: SHA-256 of the content before.

    Returns:
        the entry that ends the write.
    """
    begun = AuditAction.ROLLBACK_BEGUN
    ended = AuditAction.ROLLED_BACK
    details: dict[str, object] = {"sha256_before": before, "sha256_after": after}
    if digest is not None:
        begun = AuditAction.APPLY_BEGUN
        ended = AuditAction.APPLIED
        details["calibration"] = {"sha256": digest, "cell": ledger.cell.name}
    first = append(ledger.audit, begun, at=at, who=who, subject=target, details=details)
    return append(
        ledger.audit, ended, at=at, who=who, subject=target, details={"begun": first.number}
    )


def fill(
    ledger: Ledger, weeks: int, true: Callable[[int], tuple[float, ...]], seed: int = 3
) -> tuple[str, ...]:
    """Enter calibrations with their noise.

    Args:
        ledger: to fill.
        weeks: number of calibrations.
        true: factor of each gain in that week.
        seed: of the noise.

    Returns:
        their digests.
    """
    rng = np.random.default_rng(seed)
    noise = 1.0 + STD * rng.standard_normal((weeks, 6))
    return tuple(
        enter(ledger, calibration_of(week, tuple(map(float, np.array(true(week)) * noise[week]))))
        for week in range(weeks)
    )
