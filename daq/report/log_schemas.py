"""What `record`, `info`, `import`, `salvage`, `export log` and `export bag` print under `--json`."""

from __future__ import annotations

from pydantic import Field

from daq.report.document import Figure, Report


class BusLoadEntry(Report):
    """Load of one bus [%]."""

    bus: str
    mean_percent: float
    worst_percent: float


class RecordReport(Report):
    """`record`."""

    log: str
    samples: int
    lost_cycles: int
    missing: list[int] = Field(description="samples without an answer, an axis each")
    valid: bool
    reason: str = Field(description="why it is not valid")
    warnings: list[str]
    bus_load: list[BusLoadEntry]


class StampSummary(Report):
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


class MountedPayload(Report):
    """Payload of a log."""

    name: str
    mounting: str
    known: dict[str, float]


class LogEvent(Report):
    """Event of a recording that is no routine."""

    time_ns: int
    axis: int | None = Field(description="index from 0; null for the cell")
    kind: str
    code: int
    text: str


class InfoReport(Report):
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
    timing: StampSummary | None
    attachments: dict[str, int] = Field(description="size of each [bytes]")


class ImportReport(Report):
    """`import`."""

    log: str
    samples: int
    lost_cycles: int
    missing: list[int] = Field(description="samples without an answer, an axis each")
    valid: bool
    reason: str = Field(description="why it is not valid")
    partial: bool
    wall_minus_monotonic_ns: int | None
    timing: StampSummary | None
    remarks: list[str]


class SalvageReport(Report):
    """`salvage`."""

    log: str
    partial: bool
    samples: int
    duration_s: float
    lost_cycles: int
    missing: list[int] = Field(description="samples without an answer, an axis each")
    valid: bool
    reason: str = Field(description="why it is not valid")
    left_out_bytes: int
    damage: str


class TableReport(Report):
    """`export log`."""

    log: str
    table: str
    format: str
    rows: int
    columns: list[str]
    partial: bool
    valid: bool


class BagReport(Report):
    """`export bag`."""

    log: str
    bag: str
    duration_s: float
    messages: dict[str, int]
    effort: bool
    partial: bool
    valid: bool
