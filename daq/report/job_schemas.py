"""What `recalibrate`, `fleet` and `sign` print under `--json`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from daq.documents.session_state import SessionState
from daq.report.document import Figure, Report
from daq.report.fit_schemas import ComparedGain


class FleetGain(ComparedGain):
    """A gain of a cell of the fleet."""

    std: Figure
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

    outcome: str
    exit_code: int
    remark: str
    to_do: list[str]


class JobReport(SessionState):
    """`recalibrate`: the state of its session, and what is left to do."""

    remark: str
    to_do: list[str]
    folder: str
