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
from daq.workflow.calibration_file import CalibrationBody
from ident.errors import Diagnosis

Figure = float | None  #: null where it is not known


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
    axes: str = Field("", description="present where a stop of the axes is not confirmed")
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


class ScanReport(StrictModel):
    """`scan`."""

    bus: str = Field(description="address of all buses")
    nodes: list[ScannedNode]
    reset: list[str] = Field(description="axes whose fault was reset")
    faults: dict[str, str] = Field(description="the fault of each of them")
    current: dict[str, str] = Field(description="recorded current of each axis")
    mistyped: list[str] = Field(description="nameplate gains that plan or record would refuse")


class PlannedGain(StrictModel):
    """Prediction for one gain."""

    axis: str
    predicted_std_percent: Figure
    verdict: str
    seen_by: list[str]
    alone_percent: dict[str, Figure] = Field(description="σ that each source of information gives alone [%]")
    words: str


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
    gains: list[PlannedGain]


class BusLoadEntry(StrictModel):
    """Load of one bus [%]."""

    bus: str
    mean_percent: float
    worst_percent: float


class RecordReport(StrictModel):
    """`record`."""

    log: str
    samples: int
    lost_cycles: int
    missing: list[int] = Field(description="samples without an answer, an axis each")
    valid: bool
    reason: str
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


class Errors(StrictModel):
    """Relative errors [%], null for an axis that did not move."""

    axes: list[Figure]
    total: Figure


class ComparedGain(StrictModel):
    """A gain by another estimator."""

    axis: str
    value: float
    std_percent: Figure


class ComparedFit(StrictModel):
    """The paper's total least squares on the same rows."""

    gains: list[ComparedGain]
    condition: Figure


class OwnTorque(StrictModel):
    """Slope of the drive's own torque over the current."""

    axis: str
    slope: Figure
    std: Figure = None
    ratio: Figure = None
    ratio_std: Figure = None
    readings: int = 0


class RemovedParameter(StrictModel):
    """Parameter that is not essential."""

    name: str
    std_percent: Figure


class GainWords(StrictModel):
    """Verdict on how well the data show a gain."""

    axis: str
    std_percent: Figure
    verdict: str
    seen_by: list[str]
    words: str


class Trial(StrictModel):
    """One estimator under one filter."""

    estimator: str
    position_cutoff_hz: float
    decimation_cutoff_hz: float
    gains: list[ComparedGain] | None
    relative_error_percent: Figure = None
    reason: str = ""


class FitReport(CalibrationBody):
    """`fit`."""

    compared: dict[Literal["tls"], ComparedFit]
    torque_channel: tuple[OwnTorque, ...] = ()
    removed: list[RemovedParameter]
    verdicts: list[GainWords]
    comparison: tuple[Trial, ...] = ()


class CaseReport(CalibrationBody):
    """One case of the paper."""

    title: str
    known: str
    removed: list[RemovedParameter]


class CasesReport(StrictModel):
    """`fit --cases`."""

    cases: dict[str, CaseReport]


class MotorNoise(StrictModel):
    """Noise floor of one motor."""

    axis: str
    noise: float = Field(description="in the unit of the current reference")
    source: str
    std_percent: Figure
    dwells: int | None
    pairs: int | None
    degrees_of_freedom: Figure
    left: Figure = Field(description="what the last model leaves in motion")
    refuted: bool


class NoiseFloor(StrictModel):
    """Error that noise alone would leave."""

    motors: list[MotorNoise | None]
    relative_error_percent: Errors
    holdout_error_percent: Errors | None


class Skew(StrictModel):
    """Delay of currents against positions [s]."""

    seconds: float
    std: float


class GearLossEntry(StrictModel):
    """Which side of a gear drives, and its loss."""

    axis: str
    motoring_rows: Figure
    motoring_torque: Figure
    loss: Figure
    loss_std: Figure
    efficiency: Figure
    gain_factor: Figure
    hidden_shift: Figure
    gain_carries_it: bool


class LeftOutRun(StrictModel):
    """Error of one run by a fit of the others, or why there is none."""

    run: str
    error_percent: Errors | None
    reason: str | None


class LeftOutRuns(StrictModel):
    """Errors of runs left out in turn."""

    error_percent: Errors | None
    runs: list[LeftOutRun]


class ModelErrors(StrictModel):
    """Errors of one model."""

    relative_error_percent: Errors
    cross_validated_error_percent: Errors
    left_out_runs: LeftOutRuns | None
    holdout_error_percent: Errors | None


class ChangedGain(StrictModel):
    """A gain before and after effects."""

    axis: str
    unit: str
    before: float
    before_std: Figure
    after: float
    after_std: Figure
    choice_std: Figure
    change_percent: Figure
    change_std_percent: Figure
    significant: bool


class Coefficient(StrictModel):
    """Linear parameter of an effect."""

    name: str
    value: float
    std: Figure
    unit: str


class PlacedEffectEntry(StrictModel):
    """An effect on an axis."""

    effect: str
    axis: str
    settings: dict[str, float]
    coefficients: list[Coefficient]


class FindingEntry(PlacedEffectEntry):
    """Result of testing one effect on one axis."""

    variable: str
    probability: float
    folds_better: float
    explained: Figure
    error_before_percent: Figure
    error_after_percent: Figure
    error_fall: Figure
    held_out_fall: Figure
    passed: bool
    share_of_excess: Figure
    refusals: list[str]
    ambiguity: list[str] | None


class AsideEntry(FindingEntry):
    """Finding that passed and did not join the model."""

    reason: str


class DetectionLimit(StrictModel):
    """Torque that an effect needs to be detected, root mean square in motion."""

    axis: str
    rms: Figure
    unit: str


class TurnEntry(StrictModel):
    """One turn of the loop."""

    accepted: FindingEntry | None
    added: list[PlacedEffectEntry]
    removed: list[str]
    before: ModelErrors | None
    after: ModelErrors | None
    gain_changes: list[ChangedGain] | None
    findings: list[FindingEntry]
    structures: list[FindingEntry]
    set_aside: list[AsideEntry]
    detection_limits: list[DetectionLimit]


class ResidualReport(CalibrationBody):
    """`residual`, and the body of `residual.json`."""

    summary: list[str]
    axes: list[str]
    metric: str
    noise_floor: NoiseFloor
    time_skew: Skew | None
    gear_loss: list[GearLossEntry]
    before: ModelErrors
    after: ModelErrors
    gain_changes: list[ChangedGain]
    worse_holdout: bool | None
    turns: list[TurnEntry]


class ValidatedLog(StrictModel):
    """Errors of one log."""

    log: str
    sha256: str
    seen_by_fit: bool
    partial: bool
    held_out: bool
    same_configuration: bool
    rows: int
    relative_error_percent: Errors
    picture: str | None


class Together(StrictModel):
    """Errors of all logs together."""

    relative_error_percent: Errors


class CheckedLog(StrictModel):
    """One log under every calibration."""

    log: str
    condition: Figure
    relative_error_percent: dict[str, Errors | None]
    left_out: str | None
    seen_by: list[str]


class FoundMass(StrictModel):
    """Mass of a payload by one calibration, or why it was not found."""

    reason: str = ""
    mass_kg: Figure = None
    std_percent: Figure = None
    std_with_gains_percent: Figure = None
    error_percent: Figure = None


class CheckedPayload(StrictModel):
    """A weighed payload."""

    log: str
    payload: str
    mounting: str
    weighed_kg: Figure
    with_bare_runs: bool
    masses: dict[str, FoundMass]


class ValidateReport(StrictModel):
    """`validate`."""

    cell: str
    axes: list[str]
    filter: dict[str, int | float | list[float]]
    fit_relative_error_percent: Errors
    logs: list[ValidatedLog]
    together: Together | None
    calibrations: list[str]
    diagnoses: list[Diagnosis]
    runs: list[CheckedLog]
    payloads: list[CheckedPayload]


class Acknowledged(StrictModel):
    """A change that was explained."""

    since: str
    at: str
    who: str
    why: str


class HistoryPoint(StrictModel):
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
    cusum_up: float
    cusum_down: float
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


class HistoryAxis(StrictModel):
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


class HistoryReport(StrictModel):
    """`history`."""

    cell: str
    calibrations: int
    in_force: str | None
    chart: dict[str, float] = Field(description="limits of the control chart")
    pattern: str
    questions: list[str]
    axes: list[HistoryAxis]
    audit: dict[str, Any] | None = Field(None, description="with --verify")


REPORTS: dict[str, Any] = {
    "scan": ScanReport,
    "plan": PlanReport,
    "record": RecordReport,
    "fit": FitReport | CasesReport,
    "residual": ResidualReport,
    "validate": ValidateReport,
    "info": InfoReport,
    "history": HistoryReport,
}
"""Types of the documents by the verb that prints them."""
