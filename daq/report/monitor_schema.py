"""JSON Schema of what `monitor` prints under `--json`: one reading of the bus."""

from __future__ import annotations

from pydantic import Field

from daq.config.yaml_file import StrictModel
from daq.report.fit_schemas import Figure


class Fault(StrictModel):
    """Error code of an axis in fault."""

    code: int
    hex: str
    text: str
    remedy: str


class PredictedCurrent(StrictModel):
    """Current of one axis beside the one that a calibration predicts [A], filtered as in the fit."""

    measured: Figure = Field(description="null at rest, or where the scale is not known")
    predicted: Figure = Field(description="null at rest")
    band: float = Field(description="half the band")
    residual_rms: Figure
    outside_share: float
    conspicuous: bool


class MonitoredAxis(StrictModel):
    """State of one axis; null where it is not known."""

    axis: str
    node_id: int | None
    position: Figure = Field(description="of the joint, in `unit`")
    unit: str
    position_counts: int | None
    current_a: Figure
    current_raw: int | None
    state: str | None = Field(description="state of CiA 402")
    enabled: bool | None
    in_fault: bool
    statusword: int | None
    nmt: str | None
    rate_hz: float
    lost: int
    silent: bool
    fault: Fault | None
    prediction: PredictedCurrent | None


class MonitoredBus(StrictModel):
    """Load of one bus, with every frame as long as bit stuffing can make it."""

    bus: str
    load_percent: float


class PredictionNote(StrictModel):
    """What the prediction assumes, or why there is none."""

    payload: str | None
    remark: str


class Notice(StrictModel):
    """An event in words."""

    axis: str | None
    kind: str
    code: int
    text: str
    remedy: str
    alarm: bool


class MonitorReport(StrictModel):
    """`monitor`."""

    cell: str
    source: str
    recorder: bool = Field(description="whether a recording of drivegain on this computer has the bus")
    seconds: float
    sync_hz: float
    frames_per_s: float
    bus_load_percent: float
    buses: list[MonitoredBus]
    axes: list[MonitoredAxis]
    prediction: PredictionNote | None
    events: list[str]
    notices: list[Notice]
