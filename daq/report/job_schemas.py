"""What `recalibrate`, `fleet`, `sign` and `demo` print under `--json`,
and what a recalibration leaves behind.
"""

from __future__ import annotations

from typing import Literal

from daq.documents.calibration_file import EffectEntry
from daq.documents.session_state import GuidedState, JobState, Outcome
from daq.report.document import Figure, Report


class FleetGain(Report):
    """A gain of a cell of the fleet."""

    axis: str
    value: float
    std: Figure
    std_percent: Figure
    unit: str


class FleetEffect(Report):
    """An accepted effect."""

    name: str
    axis: str


class FleetFailure(Report):
    """Why a cell has no calibration."""

    kind: str
    text: str


class FleetCell(Report):
    """One cell in one configuration."""

    cell: str
    configuration_sha256: str | None
    configurations: int
    fit: list[str]
    holdout: list[str]
    gains: list[FleetGain]
    worst: FleetGain | None
    error_percent: Figure
    error_on: Literal["holdout", "fit"] | None
    effects: list[FleetEffect]
    partial: bool | None
    seconds: float
    kept: bool
    calibration: str | None
    exit_code: int
    error: FleetFailure | None


class FleetReport(Report):
    """`fleet`."""

    cells: list[FleetCell]
    fitted: int
    failed: int


class KeyReport(Report):
    """`sign key`."""

    name: str
    secret_key: str
    public_key: str


class SignatureReport(Report):
    """`sign calibration`."""

    calibration: str
    signature: str
    name: str


class SignersReport(Report):
    """`sign check`."""

    signers: list[str]
    signatures_needed: int


class DryRunReport(Report):
    """`recalibrate --dry-run`."""

    dry_run: Literal[True]
    remark: str
    steps: list[str]


class RefusedJob(Report):
    """`recalibrate` where no session was begun."""

    outcome: Outcome
    exit_code: int
    remark: str
    to_do: list[str]


class ConcludedJob(RefusedJob):
    """How a job with a session ended."""

    folder: str


class JobReport(JobState, ConcludedJob):
    """`recalibrate`: what is left to do, and the state of its session."""

    # The keys of the last base come first. Both bases have these two: their types are those of a
    # job that has ended.
    outcome: Outcome
    exit_code: int


class SessionReport(GuidedState, ConcludedJob):
    """`calibrate`: what is left to do, and the state of its session."""

    outcome: Outcome
    exit_code: int


class ProposedGain(Report):
    """A current gain in the controller's file, and the gain that a job proposes."""

    axis: str
    key: str
    old: Figure
    """current gain; the key keeps its name"""
    new: Figure
    std: float
    unit: str
    change_percent: Figure


class FailedCheck(Report):
    """A check that failed, as a sentence."""

    gate: str
    text: str


class ProposalReport(Report):
    """`proposal.json`: the change of the controller's file that a job found."""

    file: str
    base_sha256: str
    after_sha256: str
    changes: list[ProposedGain]
    refusals: list[FailedCheck]


class DemoGain(Report):
    """A gain compared with the truth of the simulated cell."""

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
