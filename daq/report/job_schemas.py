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
    """of this cell; each of them has an entry"""
    fit: list[str]
    holdout: list[str]
    gains: list[FleetGain]
    worst: FleetGain | None
    """gain with the largest relative standard deviation"""
    error_percent: Figure
    error_on: Literal["holdout", "fit"] | None
    effects: list[FleetEffect]
    partial: bool | None
    """whether a log of the fit was salvaged"""
    seconds: float
    """time that the fit took"""
    kept: bool
    """whether the calibration is from an earlier call, with the same logs"""
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


# Pydantic puts the keys of the last base first: how the job ended comes before its state.
class JobReport(JobState, ConcludedJob):
    """`recalibrate`: what is left to do, and the state of its session."""

    # Both bases have these two keys: their types are those of a job that has ended.
    outcome: Outcome
    exit_code: int


class SessionReport(GuidedState, ConcludedJob):
    """`calibrate`: what is left to do, and the state of its session."""

    # As in `JobReport`
    outcome: Outcome
    exit_code: int


class ProposedGain(Report):
    """A current gain in the controller's file, and the gain that a job proposes."""

    axis: str
    key: str
    """under which the file has the gain"""
    old: Figure
    """current gain"""
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
    """of the file before the change"""
    after_sha256: str
    """of the file after it"""
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
    """gain by total least squares, the estimator of the paper"""


class DemoPlan(Report):
    """A plan of the demonstration."""

    moves: int
    condition: float
    """condition number"""
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
