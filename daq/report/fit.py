"""A fit in tables, sentences and JSON:
gains, errors, what they rest on, and what the data cannot show.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, TypeVar

import numpy as np
from pydantic import Field
from rich.console import RenderableType
from rich.table import Table

from daq.config.cell import robot_of
from daq.documents.calibration_file import CalibrationBody, as_document
from daq.errors import counted
from daq.report import paper_tables
from daq.report.described_geometry import CheckedGeometry, checked_geometry, geometry_notes
from daq.report.document import Figure, Report
from daq.report.effect_names import size_text
from daq.report.full_parameters import full_parameter_view
from daq.report.gains import (
    OwnTorque,
    gain_table,
    mass_texts,
    own_torques,
    torque_sentences,
    torque_table,
    warning_texts,
)
from daq.report.text import Sentence, percent_text, plain_table
from daq.workflow.cases import CASES, CaseFit
from daq.workflow.fit import DOUBTFUL_PERCENT, Fit
from daq.workflow.nameplates import actual_current_note
from daq.workflow.verdicts import needed_verdicts
from ident.arrays import FloatArray
from ident.calibration import Calibration, Parameter, PayloadMass
from ident.discovery.evidence import Evidence, without_effects
from ident.effects.effect import PlacedEffect
from ident.estimators.comparison import EstimatorComparison, EstimatorTrial, Removal
from ident.estimators.estimate import Estimate, RelativeError
from ident.estimators.least_squares import misjudged_joints
from ident.estimators.method import Method
from ident.planning.gain_verdict import GOOD_PERCENT, GainVerdict


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


TLS_APART_SIGMAS = 3.0
TLS_APART_PERCENT = 2.0
"""Difference of a gain by the paper's total least squares from that by ml, in σ of ml and relative,
that is printed.
"""


BodyT = TypeVar("BodyT", bound=CalibrationBody)


def fit_view(
    found: CaseFit, calibration: Calibration, comparison: EstimatorComparison | None
) -> Iterator[RenderableType]:
    """Gains and errors, what they rest on, and what the data cannot show;
    `comparison` is of all estimators.
    """
    fitted = found.fitted
    axes = fitted.cell.axis_names
    estimate = fitted.estimate
    title = (
        f"Drive gains of {calibration.cell} by {calibration.method}; change % is from the nameplate"
    )
    yield gain_table(calibration.gains, title=title)
    yield from (Sentence(text, "bold") for text in warning_texts(calibration))
    for effect in calibration.effects:
        yield Sentence(
            f"{effect.axis}: {effect.name}, declared in the cell file: "
            f"{size_text(effect, calibration)}"
        )
    if (note := actual_current_note(fitted.cell)) is not None:
        yield Sentence(note)
    if fitted.torque_slopes:
        yield torque_table(fitted.torque_slopes, calibration.gains)
        yield from map(Sentence, torque_sentences(fitted.torque_slopes, calibration.gains))
    if fitted.paper is not None:
        apart = paper_note(axes, estimate, fitted.paper, misjudged_joints(fitted.final.system))
        if apart is not None:
            yield Sentence(apart)
    yield ""
    errors = {
        "fit": calibration.relative_error_percent,
        "held out": calibration.holdout_error_percent,
    }
    yield error_table("Relative error of the torques [%]", axes, errors)
    filter_ = fitted.identification.conditioning
    yield Sentence(
        f"{estimate.rows} rows, {len(fitted.final.system.columns)} base parameters and effects, "
        f"condition {estimate.condition:.0f}; position filter {filter_.position_cutoff_hz:g} Hz, "
        f"decimation {filter_.decimation_cutoff_hz:g} Hz. Compare relative errors only under the "
        "same filters."
    )
    notes = (
        *sigma_notes(fitted),
        *geometry_notes(fitted.description, axes, robot_of(fitted.cell), calibration.diagnoses),
        *identifiability_notes(fitted, calibration.payload_mass),
        *advice(fitted, needed_verdicts(fitted)),
    )
    yield from map(Sentence, notes)
    if comparison is not None:
        for table in comparison_tables(comparison, axes):
            yield ""
            yield table
    if calibration.full_parameters is not None:
        yield from full_parameter_view(calibration, calibration.full_parameters)
    if found.essential is not None:
        removed = ", ".join(step.name for step in found.essential.removed) or "none"
        yield f"{len(found.essential.system.columns)} essential parameters; removed: {removed}"


ROUGH_SIGMA = 0.1  #: Relative deviation of σ itself that is said: of less than fifty moves


def sigma_notes(fitted: Fit) -> Iterator[str]:
    """Say how well σ itself is known, where that is badly:
    the same plan then gives another σ in each session.

    A variance that is estimated from the scatter of N independent pieces has a relative deviation
    of √(2/(N − 1)); σ, its root, has half of it.
    """
    estimate = fitted.estimate
    if estimate.gains_fixed or not estimate.method.is_of_currents:
        return
    moves = len(fitted.identification.system.clusters)
    rough = 1.0 / math.sqrt(2.0 * max(moves - 1, 1))
    if rough <= ROUGH_SIGMA:
        return
    apart = "may be quite another"
    if 2.0 * rough < 1.0:
        ratio = (1.0 + 2.0 * rough) / (1.0 - 2.0 * rough)
        if ratio < LARGEST_FACTOR:
            apart = f"may differ by a factor of {ratio:.1f}"
    yield (
        f"σ rests on {counted(moves, 'move')} and is itself known to {100.0 * rough:.0f} % only: "
        f"that of another recording of the same plan {apart}."
    )


LARGEST_FACTOR = 5.0  #: Between two σ of one plan; beyond, the number means nothing


def paper_note(
    axes: Sequence[str], estimate: Estimate, paper: Estimate, misjudged: Sequence[int] = ()
) -> str | None:
    """Sentence on the gains for which the paper's total least squares differs from ml;
    None without any.

    On clean simulated cells at 5 % of noise the two differ by up to 3.3 σ and 1.9 % (`make
    tls-study`): never by more than both limits, so that a larger difference says something about
    the model. It does not hold with another estimator than ml, which noise may bias, nor where the
    weights of tls are wrong.

    Args:
        axes: their names.
        estimate: of the fit.
        paper: of ``tls`` on the same equations.
        misjudged: of `misjudged_joints`.
    """
    if estimate.method is not Method.ML or misjudged:
        return None
    change = paper.gains - estimate.gains
    sigmas = np.abs(change) / estimate.gains_std
    percent = 100.0 * change / estimate.gains
    is_certain = sigmas > TLS_APART_SIGMAS
    is_large = np.abs(percent) > TLS_APART_PERCENT
    far = np.flatnonzero(is_certain & is_large).tolist()
    if not far:
        return None
    texts = [f"{axes[axis]} {paper.gains[axis]:.4g} ({percent[axis]:+.1f} %)" for axis in far]
    values = ", ".join(texts)
    return (
        f"The paper's total least squares, which is not used here, finds {values}. With noise "
        "alone the two methods agree better: an effect that the model lacks may bend these gains "
        "(`drivegain residual` looks for it)."
    )


def fit_report(
    found: CaseFit, calibration: Calibration, comparison: EstimatorComparison | None
) -> FitReport:
    """Return a fit: the calibration, what other estimators find, and what the data cannot show."""
    fitted = found.fitted
    axes = fitted.cell.axis_names
    compared = {}
    if fitted.paper is not None:
        compared["tls"] = ComparedFit.of(
            fitted.paper,
            gains=_gains(axes, fitted.paper.gains, fitted.paper.gains_std),
            misjudged=[axes[joint] for joint in misjudged_joints(fitted.final.system)],
        )
    sometimes: dict[str, object] = {}
    if fitted.torque_slopes:
        sometimes["torque_channel"] = own_torques(fitted.torque_slopes, calibration.gains)
    if comparison is not None:
        sometimes["comparison"] = [_trial(trial, axes) for trial in comparison.trials]
    geometry = checked_geometry(
        fitted.description, axes, robot_of(fitted.cell), calibration.diagnoses
    )
    verdicts = []
    for gain in needed_verdicts(fitted):
        axis = axes[gain.axis]
        verdicts.append(GainWords.of(gain, axis=axis, seen_by=gain.sources, words=gain.words(axis)))
    return with_calibration(
        FitReport,
        calibration,
        compared=compared,
        geometry=geometry,
        removed=_removed(found),
        verdicts=verdicts,
        **sometimes,
    )


def with_calibration(kind: type[BodyT], calibration: Calibration, **others: object) -> BodyT:
    """Return a document that has all keys of a calibration.

    Args:
        kind: its type.
        calibration: the calibration.
        others: all other keys.
    """
    # Not strictly: `as_document` makes lists of the tuples that the type has.
    return kind.model_validate({**as_document(calibration), **others}, strict=False)


def _gains(axes: tuple[str, ...], gains: FloatArray, stds: FloatArray) -> list[ComparedGain]:
    compared = []
    for axis, value, std in zip(axes, gains, stds, strict=True):
        std_percent = 100.0 * (std / abs(value))
        compared.append(ComparedGain.of(axis=axis, value=value, std_percent=std_percent))
    return compared


def cases_report(
    fits: Mapping[str, CaseFit], calibrations: Mapping[str, Calibration]
) -> CasesReport:
    """Return the paper's cases and ours; both arguments are by the name of the case."""
    cases = {}
    for case in CASES:
        cases[case.name] = with_calibration(
            CaseReport,
            calibrations[case.name],
            title=case.title,
            known=case.known.value,
            removed=_removed(fits[case.name]),
        )
    return CasesReport(cases=cases)


def _removed(found: CaseFit) -> Sequence[Removal]:
    if found.essential is None:
        return ()
    return found.essential.removed


def cases_view(
    fits: Mapping[str, CaseFit], tables: tuple[paper_tables.PaperTable, ...]
) -> Iterator[RenderableType]:
    """Cases that failed, and the paper's tables."""
    for name, found in fits.items():
        left = found.fitted.identification.training_error.total
        if left > DOUBTFUL_PERCENT:
            yield Sentence(f"{name} failed: its relative error is {left:.3g} %.", "bold")
    for table in tables:
        yield from table.view()
        yield ""


def error_table(
    title: str, axes: tuple[str, ...], errors: Mapping[str, RelativeError | None]
) -> Table:
    """Relative error of each axis and of all together, a row for each entry that is known."""
    table = plain_table(("", *axes, "total"), title=title)
    for name, error in errors.items():
        if error is not None:
            table.add_row(name, *map(percent_text, (*error.axes, error.total)))
    return table


def start_of(fitted: Fit) -> Evidence:
    """Return the rows under the declared model;
    the logs are read again only where the rows were not kept.
    """
    if not fitted.steps:
        return fitted.evidence()
    return without_effects(fitted.steps[0].after, fitted.identification.estimate)


def coefficients(evidence: Evidence, placed: PlacedEffect) -> tuple[Parameter, ...]:
    """Linear parameters of an effect with their σ, by their short names;
    empty where the model lacks the effect.
    """
    estimate = evidence.estimate
    index = {column.name: number for number, column in enumerate(estimate.unknowns)}
    found = []
    for coefficient, column in zip(placed.effect.coefficients, placed.columns, strict=True):
        if column.name not in index:
            continue
        number = index[column.name]
        value = float(estimate.parameters[number] + column.about)
        std = float(estimate.parameters_std[number])
        found.append(Parameter(coefficient.name, value, std, column.unit))
    return tuple(found)


def identifiability_notes(fitted: Fit, influences: Sequence[PayloadMass]) -> Iterator[str]:
    """Describe errors that leave no residual in these data.

    Args:
        fitted: the fit.
        influences: of each payload's mass on its gains, as in its calibration.
    """
    if fitted.estimate.gains_fixed:
        return
    drawn = [
        payload.name for payload in fitted.identification.system.payloads if len(payload.known) > 1
    ]
    mistake = (
        "These data do not show a wrong payload mass, or a wrong value of gravity: either scales "
        "all gains alike and leaves no residual."
    )
    if drawn:
        mistake = (
            "These data hardly show a wrong payload mass: it changes all gains, and leaves a small "
            "residual. A wrong value of gravity leaves none."
        )
        yield (
            f"More than the mass of {', '.join(drawn)} is taken as exact. A drawing that is wrong "
            "by some per cent shifts the gains by as much, which σ does not show: compare with "
            "--known mass, better in the paper."
        )
    masses = ""
    for text in mass_texts(influences):
        masses += f" {text[0].upper()}{text[1:]}."
    yield (
        f"{mistake}{masses} A gear efficiency that is the same in both directions is part of "
        "its gain."
    )


def advice(fitted: Fit, judged: tuple[GainVerdict, ...]) -> Iterator[str]:
    """Describe which data identify each uncertain gain, and which moves would help."""
    error = fitted.final.training_error.total
    if fitted.estimate.gains_fixed:
        return
    if error > DOUBTFUL_PERCENT:
        yield (
            f"DOUBTFUL: the model leaves {error:.3g} % of the torque, expected some 3 to 15 %. σ "
            "does not cover this error: check channels, signs, drive train, gravity and payload "
            "against the cell file."
        )
    elif not judged:
        yield f"Excitation: every gain is known to {GOOD_PERCENT:g} % or better."
    else:
        yield "Excitation:"
        yield from (f"  {gain.words(fitted.cell.axis_names[gain.axis])}" for gain in judged)


def comparison_tables(
    comparison: EstimatorComparison, axes: tuple[str, ...]
) -> tuple[Table, Table]:
    """Gains by every estimator under the declared filters,
    and their spread between half and twice the cut-offs.
    """
    first = comparison.trials[0]
    filters = f"{first.position_cutoff_hz:g} Hz / {first.decimation_cutoff_hz:g} Hz"
    gains = plain_table(
        ("estimator", *axes, "‖ρ‖/‖Y‖ %"), title=f"Gains by every estimator, filters {filters}"
    )
    spreads = plain_table(
        ("estimator", *axes), title="Spread of the gains between half and twice these cut-offs [%]"
    )
    for trial in comparison.declared:
        if trial.gains is None:
            gains.add_row(trial.estimator, *("-" for _ in axes), trial.reason)
        else:
            values = (f"{gain:.4g}" for gain in trial.gains)
            gains.add_row(trial.estimator, *values, f"{trial.relative_error_percent:.2f}")
        spread = comparison.spread_percent(trial.estimator)
        shares = ["-"] * len(axes)
        if spread is not None:
            shares = [f"{share:.2f}" for share in spread]
        spreads.add_row(trial.estimator, *shares)
    return gains, spreads


def _trial(trial: EstimatorTrial, axes: tuple[str, ...]) -> Trial:
    gains = None
    outcome: dict[str, Any] = {"reason": trial.reason}
    if trial.gains is not None and trial.std is not None:
        gains = _gains(axes, trial.gains, trial.std)
        outcome = {"relative_error_percent": trial.relative_error_percent}
    return Trial(
        estimator=trial.estimator,
        position_cutoff_hz=trial.position_cutoff_hz,
        decimation_cutoff_hz=trial.decimation_cutoff_hz,
        gains=gains,
        **outcome,
    )
