"""What `demo` prints under `--json`, and writes into `summary.json`."""

from __future__ import annotations

from daq.documents.calibration_file import EffectEntry
from daq.report.document import Figure, Report
from daq.report.job_schemas import FleetEffect


class DemoGain(Report):
    """A gain beside the truth of the simulated cell."""

    axis: str
    nameplate: float
    identified: float
    std_percent: Figure
    truth: float
    error_percent: float
    paper_tls: Figure


class DemoPlan(Report):
    """A plan of the demonstration."""

    moves: int
    condition: float
    predicted_std_percent: list[Figure]


class DemoLog(Report):
    """A log of the demonstration."""

    log: str
    samples: int
    lost_cycles: int
    valid: bool


class DemoReport(Report):
    """`demo`."""

    gains: list[DemoGain]
    effect: FleetEffect | None
    effects: list[EffectEntry]
    error_before_percent: Figure
    error_after_percent: Figure
    error_before_percent_axes: list[Figure] | None
    error_after_percent_axes: list[Figure] | None
    plans: list[DemoPlan]
    logs: list[DemoLog]
    controller_diff: str
    applied: bool
    seconds: float
