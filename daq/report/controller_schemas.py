"""What `apply`, `rollback`, `report` and `history` print under `--json`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from daq.report.document import Figure, Report
from daq.report.fit_schemas import Errors
from ident.calibration import EncoderMisfit, PayloadMass


class Refused(Report):
    """A check that failed."""

    gate: str
    subject: str
    found: str
    expected: str
    remedy: str


class FileGain(Report):
    """A gain in the controller's file and its planned value."""

    axis: str
    key: str
    line: int
    old: Figure
    new: Figure = Field(description="as it is read back; null where there is none to write")
    change_percent: Figure
    change_sigmas: Figure = Field(description="signed as change_percent")
    significant: bool
    std_percent: Figure
    nameplate: float
    nameplate_percent: Figure
    unit: str


class FileChange(Report):
    """`apply` to the controller's file."""

    file: str
    base_sha256: str
    base: str = Field(description="BEFORE-AFTER of this change, for --base")
    applied: bool
    backup: str | None
    changes: list[FileGain]
    refusals: list[Refused]
    diff: str


class DriveGain(Report):
    """An object in a drive and its planned value."""

    axis: str
    object: str
    old: Figure = Field(description="null where the drive has no number")
    new: Figure
    std: float
    nameplate: float
    unit: str


class DriveChange(Report):
    """`apply --drives`; `record`, `source` and `saved` are there once the drives are written."""

    cell: str | None
    base_sha256: str
    base: str
    applied: bool
    record: str = ""
    source: str | None = None
    saved: bool = False
    changes: list[DriveGain]
    refusals: list[Refused]


class FileRollback(Report):
    """`rollback` of the controller's file."""

    file: str
    restored: str = Field(description="backup that was restored")
    backup: str | None = Field(description="of the content before")
    diff: str
    audit: str | None


class RestoredObject(Report):
    """An object in a drive before and after."""

    axis: str
    object: str
    old: Figure = Field(description="null where the drive has no number")
    new: Figure


class DriveRollback(Report):
    """`rollback --drives`; the last two are there once the drives are written."""

    drives: str
    source: str
    restored: bool
    changes: list[RestoredObject]
    record: str = ""
    saved: bool = False


class CertifiedGain(Report):
    """A gain beside the one in the controller, or beside the nameplate."""

    axis: str
    key: str | None = Field(description="in the controller's file; null where it was not read")
    line: int | None
    old: Figure
    new: Figure
    std: float
    std_percent: Figure
    unit: str
    nameplate: float
    change_percent: Figure
    written: str | None
    allowed_percent: list[Figure] = Field(description="limits of the change; null: none")
    change_sigmas: Figure = Field(description="signed as change_percent")
    significant: bool
    verdict: str


class CertifiedEffect(Report):
    """An effect in words."""

    axis: str
    effect: str
    size: str
    error_before_percent: Figure
    error_after_percent: Figure
    ambiguity: list[str]


class EarlierCalibration(Report):
    """An earlier calibration, and the gains beside it."""

    created: str
    axes: list[CertifiedGain]
    holdout_error_percent: Errors | None


class CertificateReport(Report):
    """`report`: the numbers of the certificate."""

    format: Literal["drivegain-certificate"]
    version: Literal[1]
    cell: str
    identity: dict[str, str]
    verdict: str
    sentence: str
    controller: str | None
    controller_unread: str | None
    axes: list[CertifiedGain]
    refusals: list[Refused]
    holdout_error_percent: Errors | None
    nameplate_holdout_error_percent: Errors | None
    relative_error_percent: Errors
    payload_mass: list[PayloadMass]
    encoder_misfit: EncoderMisfit | None
    effects: list[CertifiedEffect]
    beside: EarlierCalibration | None


class Acknowledged(Report):
    """A change that was explained."""

    since: str
    at: str
    who: str
    why: str


class HistoryPoint(Report):
    """One calibration of a gain; the columns of `--csv`."""

    axis: str
    recorded: str
    gain: float
    std: float
    unit: str
    nameplate: float
    change_percent: Figure
    change_sigmas: Figure
    change_probability: Figure
    deviation_sigmas: Figure
    cusum_up: Figure
    cusum_down: Figure
    trend_sigmas: Figure
    alarm: str | None
    baseline: Figure
    applied_at: str | None
    applied_by: str | None
    applied_to: str | None
    error_percent: Figure
    holdout_percent: Figure
    rows: int
    method: str
    software: str
    configuration_sha256: str
    created: str
    entered: str
    digest: str


class HistoryAxis(Report):
    """One gain over time."""

    axis: str
    unit: str
    dispersion: Figure
    alarmed: bool
    alarm: str | None
    since: str | None
    change_percent: Figure
    change_sigmas: Figure
    baseline: Figure
    baseline_std: Figure
    acknowledged: list[Acknowledged]
    points: list[HistoryPoint]


class FlawedLine(Report):
    """A line of the audit log that is not what was written."""

    line: int = Field(description="in the file, from 1")
    flaw: str
    says: str = Field(description="the same as a sentence")


class NamedEntry(Report):
    """An entry of the audit log."""

    number: int = Field(description="from 1")
    at: str
    who: str
    file: str = Field(description="the controller's file, or the drives")


class UnendedWrite(NamedEntry):
    """A write that was begun and never ended."""

    content: str = Field(description="of the file afterwards")


class UnknownWrite(NamedEntry):
    """A write that the history lacks."""

    action: str
    calibration_sha256: str | None


class AuditReport(Report):
    """State of the audit log and of the history in it."""

    file: str
    entries: int
    holds: bool = Field(description="no line was changed or removed, as far as the chain shows it")
    broken_line: int | None = Field(description="the first that is not what was written")
    flaws: list[FlawedLine]
    torn_lines: list[int] = Field(description="left by a writer that was killed; they are no flaw")
    open_writes: list[UnendedWrite]
    history_broken: list[str] = Field(description="what the history cannot show")
    unknown_writes: list[UnknownWrite]


class HistoryReport(Report):
    """`history`."""

    cell: str
    calibrations: int
    in_force: str | None
    chart: dict[str, int | float] = Field(description="limits of the control chart")
    pattern: str
    questions: list[str]
    axes: list[HistoryAxis]
    audit: AuditReport | None = Field(default=None, description="with --verify")
