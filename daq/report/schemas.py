"""JSON Schema (2020-12) of what verbs print under `--json`, and of their errors.

A model has the keys of one document: it forbids others and requires all that have no default. The verbs build their
documents themselves, because a model as a builder would say every key twice. Instead every document that is printed in
any test is held against its model (tests/conftest.py), so that the two cannot drift apart. The site publishes the
schemas (docs/reference/schemas.md), made from the models in the way of those of the files.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from daq.config.yaml_file import StrictModel
from daq.documents.calibration_file import EffectEntry
from daq.documents.session_state import SessionState
from daq.report.bus_schemas import ErrorCodeReport, MonitorReport
from daq.report.controller_schemas import (
    CertificateReport,
    DriveChange,
    DriveRollback,
    FileChange,
    FileRollback,
    HistoryReport,
)
from daq.report.fit_schemas import (
    CasesReport,
    ComparedGain,
    ContactReport,
    Errors,
    Figure,
    FitReport,
    JudgedGain,
    ResidualReport,
    ValidateReport,
    WeighReport,
)


class ErrorReport(StrictModel):
    """One line on stderr for a command that failed."""

    error: str = Field(description="subject, or the whole message where that says what was found")
    found: str
    expected: str
    do: str
    exit_code: int
    kind: str = Field(description="class of the error")
    kept: str = Field("", description="files that were written before")
    hint: str = ""
    axes: str = Field("", description="axes that had power and are not confirmed without it")
    unconfirmed: list[str] = Field([], description="what could not be confirmed")


class ScannedNode(StrictModel):
    """A node that is in the cell file or on the bus."""

    bus: str
    node_id: int
    axis: str | None
    vendor_id: int | None
    product_code: int | None
    serial: int | None
    device_name: str | None
    nmt: str | None = Field(description="NMT state of CiA 301")
    state: str | None = Field(description="state of CiA 402")
    enabled: bool | None = Field(description="whether the motor has torque")
    in_fault: bool
    verdict: str
    remarks: list[str] = Field(description="what is wrong with it")


class ScanReport(StrictModel):
    """`scan`."""

    bus: str = Field(description="address of all buses")
    nodes: list[ScannedNode]
    reset: list[str] = Field(description="axes whose fault was reset")
    faults: dict[str, str] = Field(description="the fault of each of them")
    current: dict[str, str] = Field(description="recorded current of each axis")
    mistyped: list[str] = Field(description="nameplate gains that plan or record would refuse")
    warnings: list[str] = Field(
        description="what record would warn of, such as a gain that is near √2 times the drive's"
    )


class PlannedGain(JudgedGain):
    """Prediction for one gain."""

    predicted_std_percent: Figure
    known_preload_std_percent: Figure = Field(description="σ if internal preload of redundant motors were known [%]")
    hidden_by: Literal["preload", "motion"] | None = Field(description="why the gain is unseen, or weak by preload")
    alone_percent: dict[str, Figure] = Field(description="σ that each source of information gives alone [%]")


class PlanReport(StrictModel):
    """`plan`."""

    plan: str
    cell: str
    seed: int
    payload: str
    moves: int
    duration_s: float
    condition: float
    assumed: list[str]
    rank: int = Field(description="independent directions of the gains that the moves determine to 10 %")
    known_preload_rank: int | None = Field(description="the same if internal preload were known")
    hidden: list[str] = Field(description="sentences on gains that the moves do not show, with what to do")
    gains: list[PlannedGain]


class BusLoadEntry(StrictModel):
    """Load of one bus [%]."""

    bus: str
    mean_percent: float
    worst_percent: float


class LogSize(StrictModel):
    """A log and its samples."""

    log: str
    samples: int
    lost_cycles: int
    valid: bool


class WrittenLog(LogSize):
    """A log that was written, and its losses."""

    missing: list[int] = Field(description="samples without an answer, an axis each")
    reason: str = Field(description="why it is not valid")


class RecordReport(WrittenLog):
    """`record`."""

    warnings: list[str]
    bus_load: list[BusLoadEntry]


class Stamps(StrictModel):
    """Time stamps of an imported recording, and the uniform clock that its log has."""

    rows: int
    rate_hz: float
    usual_step_s: float
    longest_step_s: float
    jitter_s: float
    drift_s: float
    missing: int
    resampled: bool
    duplicates: int
    close: int
    started_s: Figure


class MountedPayload(StrictModel):
    """Payload of a log."""

    name: str
    mounting: str
    known: dict[str, float]


class LogEvent(StrictModel):
    """Event of a recording that is no routine."""

    time_ns: int
    axis: int | None = Field(description="index from 0; null for the cell")
    kind: str
    code: int
    text: str


class InfoReport(StrictModel):
    """`info`."""

    log: str
    sha256: str
    run_id: str
    cell: str
    cell_sha256: str
    axes: list[str]
    current: dict[str, str]
    role: str
    payload: MountedPayload | None
    rate_hz: float
    speed: float
    samples: int
    duration_s: float
    stamped_duration_s: float
    moves: int
    slow_readings: dict[str, int]
    lost_cycles: int
    missing: dict[str, int]
    partial: bool
    valid: bool
    reason: str
    events: list[LogEvent]
    operator: str
    software: str
    started: str | None
    wall_minus_monotonic_s: float
    wall_clock_step_s: Figure
    origin: str
    timing: Stamps | None
    attachments: dict[str, int] = Field(description="size of each [bytes]")


class FleetGain(ComparedGain):
    """A gain of a cell of the fleet."""

    std: Figure
    unit: str


class FleetEffect(StrictModel):
    """An accepted effect."""

    name: str
    axis: str


class FleetFailure(StrictModel):
    """Why a cell has no calibration."""

    kind: str
    text: str


class FleetCell(StrictModel):
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


class FleetReport(StrictModel):
    """`fleet`."""

    cells: list[FleetCell]
    fitted: int
    failed: int


class ImportReport(WrittenLog):
    """`import`."""

    partial: bool
    wall_minus_monotonic_ns: int | None
    timing: Stamps | None
    remarks: list[str]


class SalvageReport(WrittenLog):
    """`salvage`."""

    partial: bool
    duration_s: float
    left_out_bytes: int
    damage: str


class TableReport(StrictModel):
    """`export log`."""

    log: str
    table: str
    format: str
    rows: int
    columns: list[str]
    partial: bool
    valid: bool


class BagReport(StrictModel):
    """`export bag`."""

    log: str
    bag: str
    duration_s: float
    messages: dict[str, int]
    effort: bool
    partial: bool
    valid: bool


class ShiftedParameter(StrictModel):
    """Identified parameter, and the nearest one of a physical robot."""

    name: str
    identified: float
    physical: float
    standard_deviations: Figure


class UrdfJoint(StrictModel):
    """Body and friction of one moving joint."""

    name: str
    link: str
    mass_kg: float
    centre_m: list[float]
    inertia_kg_m2: list[list[float]] | list[float]
    damping: float
    friction: float
    smallest_eigenvalue: float
    prior_assumed: bool


class NotInUrdf(StrictModel):
    """Parameter that a URDF cannot hold."""

    name: str
    value: float
    unit: str


class UrdfReport(StrictModel):
    """`export urdf`."""

    urdf: str
    calibration: str
    same_configuration: bool | None
    exact: bool
    torque_change_percent: Errors
    shifts: list[ShiftedParameter]
    margin: float
    joints: list[UrdfJoint]
    merged_links: list[str]
    not_in_urdf: list[NotInUrdf]
    effects_left_out: list[str]


class KeyReport(StrictModel):
    """`sign key`."""

    name: str
    secret_key: str
    public_key: str


class SignatureReport(StrictModel):
    """`sign calibration`."""

    calibration: str
    signature: str
    name: str


class SignersReport(StrictModel):
    """`sign check`."""

    signers: list[str]
    signatures_needed: int


class DryRunReport(StrictModel):
    """`recalibrate --dry-run`."""

    dry_run: Literal[True]
    remark: str
    steps: list[str]


class RefusedJob(StrictModel):
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


class DemoGain(StrictModel):
    """A gain beside the truth of the simulated cell."""

    axis: str
    nameplate: float
    identified: float
    std_percent: Figure
    truth: float
    error_percent: float
    paper_tls: Figure


class DemoPlan(StrictModel):
    """A plan of the demonstration."""

    moves: int
    condition: float
    predicted_std_percent: list[Figure]


class DemoReport(StrictModel):
    """`demo`."""

    gains: list[DemoGain]
    effect: FleetEffect | None
    effects: list[EffectEntry]
    error_before_percent: Figure
    error_after_percent: Figure
    error_before_percent_axes: list[Figure] | None
    error_after_percent_axes: list[Figure] | None
    plans: list[DemoPlan]
    logs: list[LogSize]
    controller_diff: str
    applied: bool
    seconds: float


REPORTS: dict[str, Any] = {
    "demo": DemoReport,
    "scan": ScanReport,
    "monitor": MonitorReport,
    "explain-emcy": ErrorCodeReport,
    "plan": PlanReport,
    "record": RecordReport,
    "fit": FitReport | CasesReport,
    "residual": ResidualReport,
    "validate": ValidateReport,
    "report": CertificateReport,
    "apply": FileChange | DriveChange,
    "rollback": FileRollback | DriveRollback,
    "info": InfoReport,
    "history": HistoryReport,
    "recalibrate": DryRunReport | JobReport | RefusedJob,
    "sign": KeyReport | SignatureReport | SignersReport,
    "fleet": FleetReport,
    "salvage": SalvageReport,
    "import": ImportReport,
    "export": TableReport | BagReport | UrdfReport,
    "weigh": WeighReport,
    "contact": ContactReport,
}
"""Types of the documents by the verb that prints them."""
