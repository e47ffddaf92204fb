"""`residual.json`, and what `residual` prints under `--json`;
docs/reference/residual-json.md describes its keys.
"""

from __future__ import annotations

from typing import Any, Literal, TypeVar

from daq.config.cell import robot_of
from daq.documents.calibration_file import CalibrationBody
from daq.report.described_geometry import CheckedGeometry, checked_geometry
from daq.report.document import Figure, Report
from daq.report.fit import Errors, coefficients, with_calibration
from daq.report.residual import summary
from daq.report.split_names import names_by_split
from daq.workflow.fit import Fit
from ident.calibration import Calibration
from ident.discovery.before_after import Account, BeforeAfter, RelativeErrors
from ident.discovery.effect_verdict import EffectVerdict
from ident.discovery.gear_loss import gear_losses
from ident.discovery.loop import Step
from ident.discovery.noise_floor import CONFIDENCE, FloorSource, MotorNoiseFloor
from ident.discovery.search import Finding
from ident.effects.effect import PlacedEffect

NamedT = TypeVar("NamedT", bound="NamedEffect")


class MotorNoise(Report):
    """Noise of one motor at rest or between repeated moves."""

    axis: str
    noise: float
    """estimate, in the unit of the current reference"""
    least: Figure
    """lower limit of the noise, below which no model's error can be; null without repeated moves"""
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
    """The same whether or not they confirm it, besides the estimate of the fit [s]."""

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
    """relative change of the gain by a loss too small to be seen"""
    gain_carries_it: bool
    """whether a loss that these data do not show could matter to the gain"""


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
    """part of `after_std` from the choice of effects"""
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
    """abscissa of its picture"""
    coefficients: list[Coefficient]
    probability: Figure
    """by noise alone; null where it rests on too few moves for a test"""
    folds_better: float
    """share of the folds of left-out moves in which the error falls"""
    explained: Figure
    """share of the squared residual of the most affected motor"""
    error_before_percent: Figure
    error_after_percent: Figure
    error_fall: Figure
    """relative, of that motor on left-out moves"""
    held_out_fall: Figure
    """fall of the squared error on moves left out in folds, in variances of the noise; not on
    held-out runs, despite its name"""
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
    """Name of the best candidate when a part of the moves is left out of the choice."""

    splits: int
    """number of such parts with which this name is chosen"""


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
    """smooth and periodic terms, of no named effect"""
    set_aside: list[AsideEntry]
    detection_limits: list[DetectionLimit]


class VerdictEntry(NamedEffect):
    """What held-out runs say of one effect."""

    judgement: str
    reason: str
    written: bool
    blocks: int
    """independent blocks of held-out moves"""
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
    geometry: CheckedGeometry | None
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


# Pydantic puts the keys of the last base first: the file begins with its format.
class ResidualFile(ResidualReport, ResidualFormat):
    """`residual.json`."""


_METRIC = (
    "‖e‖/‖v‖ of each motor's current over the rows that count; in total √(Σ w²‖e‖²/Σ w²‖v‖²), w "
    "the gains of the declared model"
)


def residual_report(fitted: Fit, account: Account, calibration: Calibration) -> ResidualReport:
    """Return the document of a search for effects: the calibration, the errors before and after,
    and every turn of the search.
    """
    axes = fitted.cell.axis_names
    last = fitted.steps[-1]
    confirmed_skew = None
    if account.skew is not None and account.skew.confirmed:
        confirmed_skew = account.skew
    worse_holdout = None
    if account.holdout_change is not None:
        worse_holdout = account.holdout_change.is_harm
    geometry = checked_geometry(
        fitted.description, axes, robot_of(fitted.cell), calibration.diagnoses
    )
    gear_loss = []
    for axis, gear in zip(axes, gear_losses(last), strict=True):
        gear_loss.append(GearLossEntry.of(gear, axis=axis))
    turns = []
    for step, turn in zip(fitted.steps, account.turns, strict=True):
        turns.append(_turn(fitted, step, turn))
    places = fitted.cell.place_names
    return with_calibration(
        ResidualReport,
        calibration,
        summary=summary(fitted, account, calibration.effects),
        axes=axes,
        metric=_METRIC,
        noise_floor=_noise_floor(account, axes),
        time_skew=confirmed_skew,
        time_skew_by_instruments=account.skew,
        geometry=geometry,
        gear_loss=gear_loss,
        before=_model_errors(account.total.before),
        after=_model_errors(account.total.after),
        gain_changes=_changed_gains(fitted, account.total),
        worse_holdout=worse_holdout,
        verdicts=[_verdict(verdict, places) for verdict in last.verdicts],
        turns=turns,
    )


def _noise_floor(account: Account, axes: tuple[str, ...]) -> NoiseFloor:
    left_by_axis_a = account.left_a.tolist()
    motors = []
    for axis, floor, left_a in zip(axes, account.floors, left_by_axis_a, strict=True):
        noise = None
        if floor is not None:
            noise = _motor_noise(axis, floor, left_a)
        motors.append(noise)
    return NoiseFloor.of(
        motors=motors,
        relative_error_percent=account.floor,
        holdout_error_percent=account.holdout_floor,
        least_error_percent=account.least_floor,
        least_holdout_error_percent=account.least_holdout_floor,
        confidence=CONFIDENCE,
    )


def _motor_noise(axis: str, floor: MotorNoiseFloor, left_a: float) -> MotorNoise:
    least_a = None
    if floor.is_bound:
        least_a = floor.least_a
    dwells = None
    pairs = None
    if floor.source is FloorSource.STANDSTILL:
        dwells = floor.parts
    elif floor.source is FloorSource.REPEATED_MOVES:
        pairs = floor.parts
    return MotorNoise.of(
        floor,
        axis=axis,
        noise=floor.noise_a,
        least=least_a,
        dwells=dwells,
        pairs=pairs,
        degrees_of_freedom=floor.freedom,
        left=left_a,
        refuted=floor.is_refuted(left_a),
    )


def _turn(fitted: Fit, step: Step, turn: BeforeAfter | None) -> TurnEntry:
    """Return one turn of the search; `turn` is None where it changed nothing."""
    places = fitted.cell.place_names
    # Without a change, the other keys of one are null: `TurnEntry.of` makes null what it is not
    # given, as its source is None.
    changes: dict[str, Any] = {"added": [], "removed": []}
    if turn is not None:
        added = []
        for placed in turn.added:
            fitted_coefficients = coefficients(step.after, placed)
            added.append(
                _named(PlacedEffectEntry, placed, places, coefficients=fitted_coefficients)
            )
        changes = {
            "added": added,
            "removed": [placed.name_among(places) for placed in turn.removed],
            "before": _model_errors(turn.before),
            "after": _model_errors(turn.after),
            "gain_changes": _changed_gains(fitted, turn),
        }
    accepted = None
    if step.accepted is not None:
        accepted = _finding(step.accepted, places)
    split_names = []
    for name in names_by_split(step):
        split_names.append(_named(SplitNameEntry, name.placed, places, splits=name.splits))
    set_aside = []
    for rejected in step.set_aside:
        finding = _finding(rejected.finding, places)
        set_aside.append(AsideEntry.of(finding, reason=rejected.reason(places)))
    detection_limits = []
    for axis, limit_nm in zip(fitted.cell.axes, step.limits_nm, strict=True):
        limit = DetectionLimit.of(axis=axis.name, rms=limit_nm, unit=axis.unit.force)
        detection_limits.append(limit)
    return TurnEntry.of(
        None,
        **changes,
        accepted=accepted,
        names_by_split=split_names,
        findings=[_finding(finding, places) for finding in step.findings],
        structures=[_finding(finding, places) for finding in step.structures],
        set_aside=set_aside,
        detection_limits=detection_limits,
    )


def _changed_gains(fitted: Fit, compared: BeforeAfter) -> list[ChangedGain]:
    changed = []
    for axis, change in zip(fitted.cell.axes, compared.gains, strict=True):
        changed.append(ChangedGain.of(change, axis=axis.name, unit=axis.gain_unit))
    return changed


def _model_errors(errors: RelativeErrors) -> ModelErrors:
    left_out = None
    if errors.left_out_runs is not None:
        runs = []
        for run in errors.left_out_runs.runs:
            reason = run.reason or None
            runs.append(LeftOutRun.of(run, error_percent=run.error, reason=reason))
        left_out = LeftOutRuns.of(error_percent=errors.left_out_runs.together, runs=runs)
    return ModelErrors.of(
        relative_error_percent=errors.in_sample,
        cross_validated_error_percent=errors.cross_validated,
        left_out_runs=left_out,
        holdout_error_percent=errors.holdout,
    )


def _named(
    kind: type[NamedT],
    placed: PlacedEffect,
    places: tuple[str, ...],
    *sources: object,
    **others: Any,
) -> NamedT:
    """Return a part of the document about an effect, with its name, axis and settings.

    Args:
        kind: type of the part.
        placed: the effect.
        places: names of the cell's axes, passive joints and pivots.
        sources, others: as in `Report.of`.
    """
    settings = {name: float(value) for name, value in placed.effect.settings.items()}
    return kind.of(
        *sources,
        effect=placed.effect.name,
        axis=placed.axis_name(places),
        settings=settings,
        **others,
    )


def _verdict(verdict: EffectVerdict, places: tuple[str, ...]) -> VerdictEntry:
    return _named(
        VerdictEntry,
        verdict.placed,
        places,
        verdict,
        blocks=verdict.change.total.blocks,
        error_before_percent=verdict.before,
        error_after_percent=verdict.after,
    )


def _finding(finding: Finding, places: tuple[str, ...]) -> FindingEntry:
    estimated = zip(
        finding.effect.coefficients, finding.coefficients, finding.deviations, strict=True
    )
    entries = []
    for declared, value, std in estimated:
        entry = Coefficient.of(name=declared.name, value=value, std=std, unit=declared.unit)
        entries.append(entry)
    # The ambiguity of findings that failed a gate would be most of the file, and of no use.
    ambiguity = None
    if finding.passed:
        ambiguity = [rival.name_among(places) for rival in finding.ambiguity]
    return _named(
        FindingEntry,
        finding.placed,
        places,
        finding,
        variable=finding.effect.abscissa,
        coefficients=entries,
        held_out_fall=finding.left_out_fall,
        ambiguity=ambiguity,
    )
