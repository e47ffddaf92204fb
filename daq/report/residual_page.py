"""`report.html`: the effects that were added and what they changed, for reading and printing;
and both report files.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Literal

from daq.config.cell import Cell
from daq.config.yaml_file import StrictModel
from daq.errors import writing
from daq.files import replace_file
from daq.ledger.ledger import Standing
from daq.report.certificate import Origin, certify
from daq.report.certificate_page import certificate_page
from daq.report.comparison import Comparison, without_controller
from daq.report.described_geometry import geometry_before_search
from daq.report.document import json_text
from daq.report.effect_names import effect_text, variable_text
from daq.report.fit import coefficients, identifiability_notes, start_of
from daq.report.gains import value_rows, with_deviation
from daq.report.html import MARK, figure, folded, html_list, pair, paragraph, table
from daq.report.plots import draw_effect, draw_torques, drawn_axis, plot_ranking
from daq.report.residual import (
    CANDIDATE_HEADINGS,
    CANDIDATES,
    WHEN,
    candidate_rows,
    declared_sentences,
    doubted_name,
    effect_sizes,
    error_rows,
    errors_by_data,
    gains_sentence,
    searched_steps,
    summary,
    turn_sentences,
)
from daq.report.residual_document import ResidualFile, residual_report
from daq.report.svg import Interval, intervals
from daq.report.text import percent_text
from daq.workflow.fit import Fit
from ident.calibration import Calibration
from ident.discovery.before_after import Account, BeforeAfter
from ident.discovery.evidence import Evidence
from ident.discovery.loop import Step
from ident.effects.effect import PlacedEffect
from ident.effects.unnamed import is_unnamed

PAGE = "report.html"
DOCUMENT = "residual.json"
FORMAT = "drivegain-residual"
VERSION = 1
MARKS = {PAGE: MARK, DOCUMENT: f'"format": "{FORMAT}"'}
"""Text at the beginning of each file of a report, by which an earlier report is recognised."""
_SHOWN = 10  #: Candidates of a turn that are drawn; residual.json has them all


def save_report(
    fitted: Fit,
    account: Account,
    calibration: Calibration,
    folder: Path,
    comparison: Comparison | None = None,
    session: str | None = None,
) -> None:
    """Write report.html and residual.json, each completely or not at all;
    without a comparison, with the nameplate's.

    Args:
        fitted, account: the fit with its effects, and what they changed.
        calibration: of the fit.
        folder: to write into.
        comparison: with the controller.
        session: name of the session that made the calibration; None where there was none.

    Raises:
        OutputFailed: the file system refuses.
    """
    body = residual_report(fitted, account, calibration)
    # Not strictly: a document that is made takes every sequence for a list, and a calibration has
    # tuples.
    fields = {"format": FORMAT, "version": VERSION, **dict(body)}
    document = ResidualFile.model_validate(fields, strict=False)
    page = residual_page(fitted, account, calibration, comparison, session)
    text = json_text(document)
    for path, content in ((folder / PAGE, page), (folder / DOCUMENT, text)):
        with writing(path):
            replace_file(path, content.encode())


def beside_nameplate(fitted: Fit, calibration: Calibration) -> Comparison:
    """Compare the gains of a fit with the nameplate: a fit reads no controller."""
    unread = (
        "The controller was not read; `drivegain certificate calibration.yaml --cell CELL` "
        "compares with its gains."
    )
    now = datetime.fromisoformat(calibration.created)
    compared = without_controller(calibration, unread, now, fitted.cell)
    # It was made just now.
    return replace(compared, standing=Standing(now))


def residual_page(
    fitted: Fit,
    account: Account,
    calibration: Calibration,
    comparison: Comparison | None = None,
    session: str | None = None,
) -> str:
    """Build the certificate of a closed loop with the account of its turns folded below;
    see `save_report`.
    """
    comparison = comparison or beside_nameplate(fitted, calibration)
    certificate = certify(calibration, comparison, origin=Origin.of(calibration, session))
    details = page_details(fitted, account, calibration)
    return certificate_page(certificate, details.consequence, details.sections)


class PageDetails(StrictModel):
    """What a page shows of a closed loop, in addition to the calibration; a session keeps it."""

    format: Literal["drivegain-page-details"] = "drivegain-page-details"
    version: Literal[1] = 1
    consequence: str  #: what the effects change in the gains, a sentence
    sections: tuple[str, ...]  #: folded sections, HTML


def page_details(fitted: Fit, account: Account, calibration: Calibration) -> PageDetails:
    """Return the account of a closed loop's turns for its page; see `save_report`."""
    effects = []
    before = start_of(fitted)
    for step, turn in zip(fitted.steps, account.turns, strict=True):
        if turn is not None:
            effects += [_effect(fitted, before, step, turn, placed) for placed in turn.added]
        before = step.after
    sentences = [*declared_sentences(fitted), *summary(fitted, account, calibration.effects)]
    names = html_list(effect_sizes(calibration))
    turns = []
    for number, step in enumerate(searched_steps(fitted), start=1):
        turns.append(_turn(fitted, number, step))
    sections = (
        folded("What was found, in sentences", html_list(sentences)),
        _errors(fitted, account),
        *effects,
        _torques(before, fitted.cell),
        _gains(fitted, account),
        folded("Effects by their names in files and commands", names),
        *turns,
        _limits(fitted, calibration),
    )
    return PageDetails(consequence=gains_sentence(fitted, account), sections=sections)


def _errors(fitted: Fit, account: Account) -> str:
    headings = ("", *fitted.cell.axis_names, "total")
    rows = []
    for name, error in error_rows(account).items():
        cells = map(percent_text, (*error.axes, error.total))
        rows.append((name, *cells))
    explanation = (
        "Error: the share of each motor's current that the model leaves, ‖e‖/‖v‖, over the rows in "
        "motion; in total with each current weighted by its gain. Compare errors only under the "
        "same filters (end of this page). Noise, estimate: what the current's noise alone would "
        "leave, as measured at standstill or between repeated moves, whichever is smaller, and at "
        "most the error. Noise, at least: its lower limit at 95 % confidence, where moves were "
        "repeated: in 19 of 20 cases no model's error is smaller."
    )
    return folded(
        "Errors without and with the effects",
        table("Relative error of the motor currents [%]", headings, rows, "names"),
        paragraph(explanation),
    )


def _torques(final: Evidence, cell: Cell) -> str:
    drawings = draw_torques(final, cell)
    return folded(
        "Measured and predicted torques",
        paragraph("Gaps: samples left out, most of them at standstill."),
        pair(map(figure, drawings)),
    )


def _effect(
    fitted: Fit, before: Evidence, step: Step, turn: BeforeAfter, placed: PlacedEffect
) -> str:
    axes = fitted.cell.place_names
    axis = axes[placed.axis]
    final = fitted.steps[-1].after
    has_motor = placed.axis < len(fitted.cell.axes)
    shown_axis = axes[drawn_axis(before, step.after, placed)]
    of_joint = f" of {axis}"
    error_of = "all axes"
    if has_motor:
        of_joint = ""
        error_of = axis
    is_in_model = placed in final.effects
    sentences = [f"Name in files and commands: `{placed.name_among(axes)}`."]
    doubt = doubted_name(step, placed, axes)
    if doubt:
        sentences.append(
            "Its name is not certain. Chosen without an eighth of the moves, each in "
            f"turn, {doubt}."
        )
    if step.accepted is not None and step.accepted.ambiguity:
        rivals = "; ".join(
            f"{axes[one.axis]}: {effect_text(one.effect, axes)}" for one in step.accepted.ambiguity
        )
        sentences.append(f"These data cannot distinguish it from: {rivals}.")
    else:
        sentences.append("These data distinguish it from every other candidate that passed.")
    if not is_in_model:
        sentences.append("A later round removed it again, because it no longer reduced the error.")
    before_by_data = errors_by_data(turn.before)
    after_by_data = errors_by_data(turn.after)
    errors = []
    for data in ("fit", "moves left out", "held out"):
        first = before_by_data[data]
        second = after_by_data[data]
        if first is not None and second is not None:
            without = percent_text(first.at(placed.axis))
            with_it = percent_text(second.at(placed.axis))
            errors.append((data, without, with_it))
    # The coefficients of a term without a name mean nothing one by one; the certificate draws its
    # curve.
    model = step.after
    if is_in_model:
        model = final
    sizes = ""
    if not is_unnamed(placed.effect):
        rows = value_rows(coefficients(model, placed))
        if rows:
            sizes = table("Identified coefficients", ("coefficient", "value ± σ", "unit"), rows)
    drawings = draw_effect(before, step.after, placed, fitted.cell)
    variable = f"{variable_text(placed.effect, axes)}{of_joint}"
    explanation = (
        f"Residual of {shown_axis} over time and against {variable}, without and with the effect. "
        "A mean away from zero is torque that the model still lacks. Gaps: samples left out."
    )
    return folded(
        f"{axis}: {effect_text(placed.effect, axes)}",
        paragraph(" ".join(sentences)),
        sizes,
        table(f"Relative error of {error_of} [%]", ("", *WHEN), errors),
        pair(map(figure, drawings)),
        paragraph(explanation),
    )


def _gains(fitted: Fit, account: Account) -> str:
    if fitted.estimate.gains_fixed:
        return folded(
            "Gains without and with the effects", paragraph("The gains were held at the nameplate.")
        )
    rows = []
    shifts = []
    for axis, change in zip(fitted.cell.axes, account.total.gains, strict=True):
        percent = change.change_percent
        std_percent = change.change_std_percent
        before = with_deviation(change.before, change.before_std)
        after = with_deviation(change.after, change.after_std)
        verdict = "within noise"
        if change.significant:
            verdict = "more than noise"
        change_text = f"{percent:+.2f} ± {std_percent:.2f}"
        rows.append((axis.name, before, f"{after} {axis.gain_unit}", change_text, verdict))
        label = f"{percent:+.2f} %"
        shifts.append(Interval(axis.name, percent, 2.0 * std_percent, -math.inf, math.inf, label))
    drawing = intervals(shifts, "Change of each gain by the effects", "change by the effects [%]")
    caption = (
        "0 is the gain without the effects. Bar: ± 2 σ of the change, whose noise both "
        "estimates share in part."
    )
    return folded(
        "Gains without and with the effects",
        table("", ("axis", *WHEN, "change ± σ [%]", "verdict"), rows, "words"),
        figure(drawing, caption),
    )


def _turn(fitted: Fit, number: int, step: Step) -> str:
    axes = fitted.cell.place_names
    added = step.accepted
    rivals: Sequence[PlacedEffect] = ()
    if added is not None:
        rivals = added.ambiguity
    named = step.ranked(_SHOWN)
    own = [one.placed for one in named]
    structures = [one for one in step.structures[:_SHOWN] if one.passed and one.placed not in own]
    shown = (*named, *structures)
    ranking = paragraph("No candidate could be tried.")
    if shown:
        ranked = sorted(shown, key=lambda finding: -finding.left_out_fall)
        caption = (
            "Candidates by how much they reduce the error of left-out moves. Full: passed every "
            "check of the search; the fit of everything together comes after it. Pale: these data "
            "cannot distinguish it from the added one. Hollow: failed a check. The scale counts "
            "the squared noise of one sample as 1."
        )
        ranking = figure(plot_ranking(ranked, rivals, axes), caption)
    rows = candidate_rows(fitted, step, _SHOWN)
    return folded(
        f"Search, turn {number}: what was tried",
        html_list(turn_sentences(fitted, step)),
        ranking,
        table(f"Turn {number}: {CANDIDATES}", CANDIDATE_HEADINGS, rows, "names"),
    )


def _limits(fitted: Fit, calibration: Calibration) -> str:
    limits = [
        *geometry_before_search(fitted, calibration.diagnoses),
        *identifiability_notes(fitted, calibration.payload_mass),
        "A torque constant that is wrong by a constant factor is part of the gain, and an effect "
        "that is the same at every speed, load and position is part of the parameters: neither "
        "leaves a residual.",
    ]
    if fitted.estimate.gains_fixed:
        limits.append("The gains were held: an error in them is hidden in the parameters.")
    limits += [
        "Backlash or elasticity behind an encoder on the motor may leave no trace in "
        "these signals.",
        "An effect is named after the variable it depends on and the shape of that dependence; "
        "another cause with the same dependence would get the same name. Indistinguishable effects "
        "are listed with each effect.",
        "Noise that was measured at standstill alone bounds nothing: in motion it may be smaller "
        "or larger. Between repeated moves its lower limit bounds any model's error (95 % "
        "confidence), often loosely: an error above it need not be an effect.",
    ]
    return folded("What these data can and cannot show", html_list(limits))
