"""What a job says while it runs: one line an event, for a person, a program or the system's journal.

Under systemd a line is JSON behind ``<N>``, its priority (sd-daemon(3)). That is chosen before the journal's own
protocol because it is one write to the stream that we were given: no socket that may be full or absent, no limit of a
datagram, and the order of everything else that goes to that stream is kept. ``journalctl -p err`` finds what is wrong,
and ``journalctl -o cat | jq`` reads the fields.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from enum import Enum, IntEnum
from pathlib import Path
from typing import TextIO

from prometheus_client import CollectorRegistry, Gauge, write_to_textfile

from daq.errors import OutputFailed
from daq.jobs.session import Outcome, SessionState
from ident.calibration import Calibration


class Level(IntEnum):
    """Priorities of syslog (RFC 5424, table 2)."""

    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6


class Form(Enum):
    """Who reads the lines."""

    TEXT = "text"
    """A person at a terminal."""
    JSON = "json"
    """A program."""
    JOURNAL = "journal"
    """systemd-journald, which takes the priority off."""


@dataclass(frozen=True, slots=True)
class Journal:
    """Where events go.

    Attributes:
        stream: that lines are written to.
        form: of the lines.
        now: wall clock with time zone.
        session, step: of what is said from here on.
    """

    stream: TextIO
    form: Form
    now: Callable[[], datetime]
    session: str = ""
    step: str = ""

    def within(self, *, session: str | None = None, step: str | None = None) -> Journal:
        """The same journal, in a session or a step of it."""
        return replace(
            self,
            session=self.session if session is None else session,
            step=self.step if step is None else step,
        )

    def say(self, level: Level, event: str, /, **fields: object) -> None:
        """Write one event.

        Args:
            level: how much it matters.
            event: what happened, always in the same words.
            fields: plain JSON; what JSON has no word for is spelt as text.
        """
        at = self.now().isoformat(timespec="milliseconds")
        if self.form is Form.TEXT:
            details = ", ".join(f"{name} {_text(value)}" for name, value in fields.items())
            line = f"{at} {self.step + ': ' if self.step else ''}{event}{': ' + details if details else ''}"
        else:
            known = {"session": self.session, "step": self.step}
            named = {key: value for key, value in known.items() if value}
            entry = {"time": at, "level": level.name.lower(), "event": event, **named, **fields}
            line = json.dumps(_plain(entry), ensure_ascii=False, allow_nan=False, default=str)
            if self.form is Form.JOURNAL:
                line = f"<{int(level)}>{line}"
        # A reader that has gone is no reason to leave a robot half-way through its job.
        with suppress(OSError, ValueError):
            self.stream.write(line + "\n")
            self.stream.flush()


def form_of(stream: TextIO, environment: Mapping[str, str]) -> Form:
    """What the reader of a stream takes.

    Args:
        stream: standard error.
        environment: of this process; systemd names device and inode of the stream that it reads in JOURNAL_STREAM
            (systemd.exec(5)), so that one which was redirected since is told from it.
    """
    if stream.isatty():
        return Form.TEXT
    with suppress(OSError, ValueError):
        found = os.fstat(stream.fileno())
        if environment.get("JOURNAL_STREAM") == f"{found.st_dev}:{found.st_ino}":
            return Form.JOURNAL
    return Form.JSON


def _text(value: object) -> str:
    text = f"{value:g}" if isinstance(value, float) else str(value)
    return "".join(letter if letter.isprintable() else " " for letter in text)


def _plain(value: object) -> object:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value


# Prometheus metrics of a job, for the textfile collector of its node exporter.


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
        _set_session_gauges(gauge, figures.state, cell)
    if figures.calibration is not None:
        _set_calibration_gauges(gauge, figures.calibration, cell)
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


def _set_session_gauges(gauge: _Gauges, state: SessionState, cell: str) -> None:
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


def _set_calibration_gauges(gauge: _Gauges, calibration: Calibration, cell: str) -> None:
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
