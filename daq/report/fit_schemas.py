"""What `fit` and `residual` print under `--json`.

docs/reference/residual-json.md describes the keys of `residual`.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from daq.documents.calibration_file import CalibrationBody
from daq.report.document import Figure, Report


class Errors(Report):
    """Relative errors [%]; null for an axis that did not move, and in total where none did."""

    axes: list[Figure]
    total: Figure


class ComparedGain(Report):
    """A gain by another estimator."""

    axis: str
    value: float
    std_percent: Figure


class ComparedFit(Report):
    """The paper's total least squares on the same rows."""

    gains: list[ComparedGain]
    condition: Figure
    #: Axes for which σ_W^j (eq. 22) is not the noise of a current, so that these gains are bent.
    misjudged: list[str]


class OwnTorque(Report):
    """Slope of the drive's own torque over the current."""

    axis: str
    slope: Figure
    std: Figure = None
    ratio: Figure = None
    ratio_std: Figure = None
    readings: int = 0


class RemovedParameter(Report):
    """Parameter that is not essential."""

    name: str
    std_percent: Figure


class GainWords(Report):
    """Verdict on how well the data of a fit show a gain."""

    axis: str
    std_percent: Figure
    verdict: str
    seen_by: list[str]
    words: str


class Trial(Report):
    """One estimator under one filter."""

    estimator: str
    position_cutoff_hz: float
    decimation_cutoff_hz: float
    gains: list[ComparedGain] | None
    relative_error_percent: Figure = None
    reason: str = ""


class FoundGravity(Report):
    """Direction of gravity by the torques, beside the declared one."""

    declared_m_s2: list[Figure]
    found_m_s2: list[Figure]
    turn_deg: Figure
    turn_std_deg: Figure


class CheckedGeometry(Report):
    """What the torques say of the description of the robot."""

    gravity: FoundGravity | None
    hidden_zeros: list[str]


class FitReport(CalibrationBody, Report):
    """`fit`."""

    compared: dict[Literal["tls"], ComparedFit]
    geometry: CheckedGeometry | None
    torque_channel: list[OwnTorque] = Field(default=[])
    removed: list[RemovedParameter]
    verdicts: list[GainWords]
    comparison: list[Trial] = Field(default=[])


class CaseTitle(Report):
    """Name of a case, and what it takes as known of the payload."""

    title: str
    known: str


# The keys of the last base come first.
class CaseReport(CalibrationBody, CaseTitle):
    """One case of the paper."""

    removed: list[RemovedParameter]


class CasesReport(Report):
    """`fit --cases`."""

    cases: dict[str, CaseReport]


class MotorNoise(Report):
    """Noise of one motor at rest or between repeated moves."""

    axis: str
    noise: float
    """estimate, in the unit of the current reference"""
    least: Figure
    """its lower limit where that bounds any model's error: known from repeated moves"""
    source: str
    std_percent: Figure
    dwells: int | None
    pairs: int | None
    degrees_of_freedom: Figure
    left: Figure
    """what the last model leaves in motion"""
    refuted: bool


class NoiseFloor(Report):
    """Error that noise alone would leave: estimates, and their lower limits."""

    motors: list[MotorNoise | None]
    relative_error_percent: Errors
    holdout_error_percent: Errors | None
    least_error_percent: Errors
    least_holdout_error_percent: Errors | None
    confidence: float


class Skew(Report):
    """Delay of currents against positions that instruments confirm [s]."""

    seconds: float
    std: float


class SkewByInstruments(Skew):
    """The same whether or not they confirm it, beside the estimate of the fit [s]."""

    fit_seconds: float
    fit_std: float
    confirmed: bool
    is_in_model: bool


class GearLossEntry(Report):
    """Side that drives a gear, and its loss."""

    axis: str
    motoring_rows: Figure
    motoring_torque: Figure
    loss: Figure
    loss_std: Figure
    efficiency: Figure
    gain_factor: Figure
    hidden_shift: Figure
    gain_carries_it: bool


class LeftOutRun(Report):
    """Error of one run by a fit of the others, or why there is none."""

    run: str
    error_percent: Errors | None
    reason: str | None


class LeftOutRuns(Report):
    """Errors of runs left out in turn."""

    error_percent: Errors | None
    runs: list[LeftOutRun]


class ModelErrors(Report):
    """Errors of one model."""

    relative_error_percent: Errors
    cross_validated_error_percent: Errors
    left_out_runs: LeftOutRuns | None
    holdout_error_percent: Errors | None


class ChangedGain(Report):
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


class Coefficient(Report):
    """Linear parameter of an effect."""

    name: str
    value: float
    std: Figure
    unit: str


class NamedEffect(Report):
    """An effect, and the axis that it is on."""

    effect: str
    axis: str
    settings: dict[str, float]


class PlacedEffectEntry(NamedEffect):
    """An effect on an axis, with its size."""

    coefficients: list[Coefficient]


class FindingEntry(NamedEffect):
    """Result of testing one effect on one axis."""

    variable: str
    coefficients: list[Coefficient]
    probability: Figure
    """by noise alone; null where it rests on too few moves for a test"""
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


class DetectionLimit(Report):
    """Torque that an effect needs to be detected, root mean square in motion."""

    axis: str
    rms: Figure
    unit: str


class SplitNameEntry(NamedEffect):
    """Name that splits of the data choose for what a turn added."""

    splits: int


class TurnEntry(Report):
    """One turn of the loop."""

    accepted: FindingEntry | None
    added: list[PlacedEffectEntry]
    removed: list[str]
    names_by_split: list[SplitNameEntry]
    before: ModelErrors | None
    after: ModelErrors | None
    gain_changes: list[ChangedGain] | None
    findings: list[FindingEntry]
    structures: list[FindingEntry]
    set_aside: list[AsideEntry]
    detection_limits: list[DetectionLimit]


class VerdictEntry(NamedEffect):
    """What held-out runs say of one effect."""

    judgement: str
    reason: str
    written: bool
    blocks: int
    error_before_percent: Errors | None
    error_after_percent: Errors | None


class ResidualReport(CalibrationBody, Report):
    """`residual`, and the body of `residual.json`."""

    summary: list[str]
    axes: list[str]
    metric: str
    noise_floor: NoiseFloor
    time_skew: Skew | None
    time_skew_by_instruments: SkewByInstruments | None
    gear_loss: list[GearLossEntry]
    before: ModelErrors
    after: ModelErrors
    gain_changes: list[ChangedGain]
    worse_holdout: bool | None
    verdicts: list[VerdictEntry]
    turns: list[TurnEntry]


class ResidualFormat(Report):
    """How `residual.json` begins."""

    format: Literal["drivegain-residual"]
    version: int


# The keys of the last base come first.
class ResidualFile(ResidualReport, ResidualFormat):
    """`residual.json`."""
