"""Prometheus metrics of a job, for the textfile collector of its node exporter."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from prometheus_client import CollectorRegistry, Gauge, write_to_textfile

from daq.errors import OutputFailed
from daq.recalibration.session import Outcome, SessionState
from ident.calibration import Calibration

PREFIX = "drivegain_recalibration_"
_Gauges = Callable[..., Gauge]


@dataclass(frozen=True, slots=True)
class Figures:
    """What is told of a job.

    Attributes:
        cell: name.
        outcome, exit_code: of this job.
        ended: when.
        duration_s: of this job [s].
        last_good: when the last good session began, None where there was none.
        state: of the session whose figures are shown: this one where it came to a calibration, else the last good one.
        calibration: of the same, None where there is none.
    """

    cell: str
    outcome: Outcome
    exit_code: int
    ended: datetime
    duration_s: float
    last_good: datetime | None
    state: SessionState | None
    calibration: Calibration | None


def registry_of(figures: Figures) -> CollectorRegistry:
    """The metrics, in a registry of their own."""
    registry = CollectorRegistry()

    def gauge(name: str, text: str, *labels: str) -> Gauge:
        return Gauge(PREFIX + name, text, ("cell", *labels), registry=registry)

    cell = figures.cell
    outcomes = gauge("outcome", "1 for the outcome of the last job, 0 for the others.", "outcome")
    for outcome in Outcome:
        outcomes.labels(cell, outcome.value).set(float(outcome is figures.outcome))
    gauge("exit_code", "Of the last job.").labels(cell).set(figures.exit_code)
    gauge("last_run_timestamp_seconds", "When the last job ended.").labels(cell).set(figures.ended.timestamp())
    gauge("duration_seconds", "Of the last job.").labels(cell).set(figures.duration_s)
    if figures.last_good is not None:
        last = gauge("last_success_timestamp_seconds", "When the last good calibration was begun.")
        last.labels(cell).set(figures.last_good.timestamp())
    if figures.state is not None:
        _tell_session(gauge, figures.state, cell)
    if figures.calibration is not None:
        _tell_calibration(gauge, figures.calibration, cell)
    return registry


def write_metrics(figures: Figures, folder: Path) -> Path:
    """Write them to a file that is replaced whole, and that the collector may read.

    Raises:
        OutputFailed: the file system refuses.
    """
    path = folder / f"drivegain_{file_stem(figures.cell)}.prom"
    try:
        write_to_textfile(str(path), registry_of(figures))
        # The collector is another user, and a service's umask may be strict.
        path.chmod(0o644)
    except OSError as error:
        raise OutputFailed.of(path, error) from error
    return path


def file_stem(cell: str) -> str:
    """A cell's name as a file's; with six digits of its hash where letters were lost that may tell two cells apart."""
    plain = re.sub(r"[^A-Za-z0-9_-]+", "_", cell)
    return plain if plain == cell else f"{plain}_{hashlib.sha256(cell.encode()).hexdigest()[:6]}"


def _tell_session(gauge: _Gauges, state: SessionState, cell: str) -> None:
    lost = gauge("lost_cycles", "Cycles that are not in any recording of a run.", "run")
    missing = gauge("missing_answers", "Answers of drives that never came, of all recordings of a run.", "run")
    attempts = gauge("recordings", "Of a run, until its recorder stood for it.", "run")
    for run in state.runs:
        lost.labels(cell, run.name).set(run.lost_cycles)
        missing.labels(cell, run.name).set(sum(run.missing))
        attempts.labels(cell, run.name).set(run.attempts)
    if state.watched:
        alarm = gauge("drift_alarm", "1 where the chart of all calibrations raises an alarm, else 0.", "axis")
        for watched in state.watched:
            alarm.labels(cell, watched.axis).set(float(bool(watched.alarm)))
    if state.decision is not None:
        drift = gauge("gain_drift_sigma", "Change from the gain in the controller, in σ of the change.", "axis")
        in_force = gauge("gain_in_force", "In the controller when the job looked, in Nm or N per A.", "axis", "unit")
        for gain in state.decision.gains:
            in_force.labels(cell, gain.axis, gain.unit).set(gain.old)
            if gain.drift_sigma is not None:
                drift.labels(cell, gain.axis).set(gain.drift_sigma)


def _tell_calibration(gauge: _Gauges, calibration: Calibration, cell: str) -> None:
    value = gauge("gain", "Identified drive gain, in Nm or N per A.", "axis", "unit")
    std = gauge("gain_std", "Its standard deviation, in the same unit.", "axis", "unit")
    for gain in calibration.gains:
        value.labels(cell, gain.axis, gain.unit).set(gain.value)
        std.labels(cell, gain.axis, gain.unit).set(gain.std)
    residual = gauge("residual_percent", "Relative error of the torques.", "axis", "data")
    axes = [gain.axis for gain in calibration.gains]
    errors = (("fit", calibration.relative_error_percent), ("holdout", calibration.holdout_error_percent))
    for data, error in errors:
        if error is not None:
            for axis, percent in zip((*axes, "total"), (*error.axes, error.total), strict=True):
                residual.labels(cell, axis, data).set(percent)
