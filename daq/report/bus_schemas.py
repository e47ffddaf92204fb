"""What `scan`, `monitor` and `explain-emcy` print under `--json`."""

from __future__ import annotations

from pydantic import Field

from daq.report.document import Report


class ErrorCodeEntry(Report):
    """An error code of EMCY or 603Fh in words."""

    code: int
    hex: str
    text: str
    remedy: str


class ErrorCodeReport(ErrorCodeEntry):
    """`explain-emcy`."""

    standard: bool = Field(description="whether CiA 301 or CiA 402 names it; else its class is described")


class PredictedCurrent(Report):
    """Current of one axis by a calibration, half a second ago, filtered as in the fit [unit of the gain's current]."""

    measured: float | None = Field(description="null at standstill, or where the scale of the current is unknown")
    predicted: float | None = Field(description="null at standstill")
    band: float | None = Field(description="null for a calibration that does not say what it left of the currents")
    residual_rms: float | None = Field(description="over the last 10 s in which the axis moved; null before any")
    outside_share: float = Field(description="share of that time in which the residual is outside the band")
    conspicuous: bool = Field(description="it is outside for more than half of at least 2 s of motion")


class RefusedObject(Report):
    """Object that an axis does not give."""

    object: str = Field(description="index and sub-index, as 6041h:00")
    abort_code: int | None = Field(description="of the SDO abort; null for an answer that is no value of this size")


class MonitoredAxis(Report):
    """One axis."""

    axis: str
    node_id: int
    position: float | None
    unit: str = Field(description="of the position")
    position_counts: int | None
    current_a: float | None
    current_raw: int | None
    state: str | None = Field(description="state of CiA 402")
    enabled: bool | None = Field(description="whether the motor has torque")
    in_fault: bool
    statusword: int | None
    nmt: str | None = Field(description="NMT state of CiA 301")
    rate_hz: float = Field(description="of complete answers")
    lost: int = Field(description="SYNCs or requests without an answer")
    silent: bool = Field(description="it should answer, and sent nothing at all, not even a heartbeat")
    delay_s: float | None = Field(description="longest time until an answer; null where nothing was asked or answered")
    refused: list[RefusedObject]
    remark: str = Field(description="answers that are late or without a value; empty if there are none")
    fault: ErrorCodeEntry | None = Field(description="of an axis in fault, where its code is known")
    prediction: PredictedCurrent | None


class MonitoredBus(Report):
    """Load of one bus."""

    bus: str
    load_percent: float = Field(description="with every frame as long as bit stuffing can make it")


class PredictionState(Report):
    """Premise of the predicted currents."""

    payload: str | None
    remark: str = Field(description="why there are none; empty if there are")


class Notice(Report):
    """A recent event."""

    axis: str | None
    kind: str
    code: int
    text: str
    remedy: str
    alarm: bool


class MonitorReport(Report):
    """`monitor`."""

    cell: str
    source: str = Field(description="asked, or overheard while another master leads the bus")
    recorder: bool = Field(description="whether a recording or job of drivegain has the bus")
    seconds: float
    sync_hz: float
    frames_per_s: float
    bus_load_percent: float = Field(description="of the most loaded bus")
    buses: list[MonitoredBus]
    axes: list[MonitoredAxis]
    prediction: PredictionState | None = Field(description="null without --calibration")
    events: list[str] = Field(description="texts of recent events")
    notices: list[Notice] = Field(description="the same events with what to do")


class ScannedNode(Report):
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


class ScanReport(Report):
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
