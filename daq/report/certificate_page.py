"""The certificate as a page: one sheet to print and sign, and on the screen what it rests on,
folded below.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

from daq.report.certificate import AxisRow, Certificate, Verdict, identity, status_text
from daq.report.effect_names import WORDS, accepted_text, curve_of, size_text
from daq.report.gains import MASS_HEADINGS, mass_rows, value_rows, warning_texts, with_deviation
from daq.report.html import (
    element,
    figure,
    folded,
    html_list,
    html_page,
    on_paper,
    on_screen,
    pair,
    paragraph,
    part,
    section,
    signature_line,
    table,
    terms,
)
from daq.report.picture import QUANTITY
from daq.report.svg import Interval, Line, before_after_drawing, chart, intervals
from daq.report.text import SHOWN_SIGMAS, minute_text, percent_text
from daq.writeback.file_target import FileEdit
from daq.writeback.request import GainChange
from ident.calibration import AcceptedEffect, Calibration, Source
from ident.estimators.estimate import RelativeError

_LOOK = {
    Verdict.REFUSED: "act",
    Verdict.WAITING: "act",
    Verdict.UNCHANGED: "quiet",
    Verdict.NOT_COMPARED: "quiet",
}
"""CSS class of the verdict; blue without one. Orange asks the reader to act."""
_SIGN = {
    Verdict.READY: "✓",
    Verdict.UNCHANGED: "=",
    Verdict.WAITING: "…",
    Verdict.NOT_COMPARED: "•",
    Verdict.REFUSED: "✕",
}
_FILTERS = {
    "position_cutoff_hz": "cut-off of the positions [Hz]",
    "position_order": "order of that filter",
    "decimation_cutoff_hz": "cut-off before decimation [Hz]",
    "standstill_rad_s": "standstill below, of each axis [rad/s]",
    "standstill_share": "share of standstill in the filter's window, at most",
}
_METHODS = {
    "ls": "least squares",
    "wls": "weighted least squares",
    "tls": "total least squares",
    "ml": "maximum likelihood",
    "iv": "instrumental variables",
}
_ROLES = {"holdout": "held out"}


def certificate_page(
    certificate: Certificate, consequence: str = "", details: Sequence[str] = ()
) -> str:
    """Build the page.

    Args:
        certificate: judged calibration.
        consequence: what the effects change in the gains, a sentence; empty where it is not known.
        details: further folded sections, before those of the calibration itself.
    """
    calibration = certificate.calibration
    look = _LOOK.get(certificate.verdict, "")
    sign = _SIGN[certificate.verdict]
    if certificate.contradicted:
        look = _LOOK[Verdict.REFUSED]
        sign = _SIGN[Verdict.REFUSED]
    elif certificate.comparison.in_force is not None and certificate.verdict is not Verdict.REFUSED:
        look = ""
        sign = _SIGN[Verdict.READY]
    if calibration.diagnoses and look == "quiet":
        look = "act"
    return html_page(
        f"Calibration of cell {calibration.cell}, certificate {certificate.origin.id}",
        (
            '<main class="sheet">',
            paragraph(f"Calibration certificate {certificate.origin.id}", "kind"),
            element("h1", f"Cell {calibration.cell}"),
            paragraph(f"{sign} {certificate.sentence}", f"verdict {look}"),
            *_next(certificate, look),
            *_warnings(certificate),
            terms(_facts(certificate).items()),
            _gains(certificate),
            _effects(calibration, consequence),
            _digests(certificate),
            signature_line("Name", "Date", "Signature"),
            "</main>",
            *_since(certificate),
            '<section class="details">',
            element("h2", "Details"),
            *details,
            *_evidence(certificate),
            "</section>",
        ),
    )


def _facts(certificate: Certificate) -> dict[str, str]:
    """State, session and identity of the calibration, by name."""
    facts = {"Status": status_text(certificate.comparison)}
    if certificate.origin.session is not None:
        facts["Session"] = certificate.origin.session
    return facts | identity(certificate.calibration)


def _next(certificate: Certificate, look: str) -> Iterator[str]:
    """The next step, below the verdict."""
    comparison = certificate.comparison
    if comparison.in_force is not None:
        acceptance = comparison.standing.acceptance
        if acceptance is not None and acceptance.undo:
            yield paragraph(f"To undo the write: `{acceptance.undo}`.", f"next {look}")
        return
    if comparison.unread:
        yield paragraph(comparison.unread, f"next {look}")
    elif comparison.command and certificate.verdict in {Verdict.READY, Verdict.WAITING}:
        yield paragraph(
            f"To review the change: `{comparison.command}`. With `--yes` it is written.",
            f"next {look}",
        )


def _warnings(certificate: Certificate) -> Iterator[str]:
    """Checks to make and actions to take; what a diagnosis says is said once,
    and checks that failed alike are one.
    """
    texts = warning_texts(certificate.calibration)
    diagnosed = {one.found for one in certificate.calibration.diagnoses}
    failed: dict[str, list[str]] = {}
    for one in certificate.comparison.refusals:
        if one.found in diagnosed:
            continue
        text = f"found {one.found}; expected {one.expected}; {one.remedy}"
        failed.setdefault(text, []).append(one.subject)
    actions = list(texts)
    for text, subjects in failed.items():
        actions.append(f"{', '.join(subjects)}: {text}.")
    if actions:
        yield html_list(actions)


def _gains(certificate: Certificate) -> str:
    compared = certificate.compared_with
    headings = ("axis", compared, "identified ± σ", "change [%]", "limit [%]", "verdict")
    rows = []
    for gain, row in zip(certificate.calibration.gains, certificate.shown_rows, strict=True):
        change = row.change
        compared_gain = f"{change.compared_gain:.5g}"
        identified = f"{with_deviation(gain.value, gain.std)} {gain.unit}"
        change_text = _percent(change.change_percent)
        limit = _limit(row.allowed_percent)
        rows.append((change.axis, compared_gain, identified, change_text, limit, row.words))
    note = certificate.note
    drawings = (_changes(certificate), *_errors(certificate.calibration), _write(certificate))
    return section(
        "Drive gains",
        table("", headings, rows, "words"),
        paragraph(f"{note[0].upper()}{note[1:]}."),
        pair(drawings),
    )


def _interval(row: AxisRow) -> Interval:
    change = row.change
    value = change.change_percent
    half = math.nan
    if change.compared_gain:
        half = 100.0 * SHOWN_SIGMAS * change.std / abs(change.compared_gain)
    if not math.isfinite(value) or not math.isfinite(half):
        value = math.nan
        half = 0.0
    return Interval(
        change.axis, value, half, *row.allowed_percent, f"{_percent(change.change_percent)} %"
    )


def _changes(certificate: Certificate) -> str:
    """Gains beside their limits."""
    compared = certificate.compared_with
    drawn = intervals(
        [_interval(row) for row in certificate.shown_rows],
        "Change of each gain",
        f"from the {compared} [%]",
    )
    caption = (
        f"0 is the {compared}. Bar: ± 2 σ, often shorter than the dot. Shaded: within the limits."
    )
    return figure(drawn, caption, f"Change from the {compared}")


def _errors(calibration: Calibration) -> Iterator[str]:
    """Error of each axis and of all, before and after; NaN where it is not known."""
    caption = "Error of the predicted torque, as a share of the measured torque."
    holdout = calibration.holdout_error_percent
    if holdout is None:
        drawing = _error_drawing(calibration, None, calibration.relative_error_percent)
        caption = (
            f"{caption} No run was held out: the error on data that the fit has not used is "
            "not known."
        )
        yield figure(drawing, caption, "Error on the data of the fit")
        return
    nameplate = calibration.nameplate_holdout_error_percent
    caption = f"{caption} Full: with the identified gains."
    if nameplate is not None:
        caption = f"{caption} Hollow: the same model with the nameplate."
    drawing = _error_drawing(calibration, nameplate, holdout)
    yield figure(drawing, caption, "Error on held-out runs")


def _error_drawing(
    calibration: Calibration, before: RelativeError | None, after: RelativeError
) -> str:
    """Draw the error of each axis and of all; `before` is hollow."""
    names = [gain.axis for gain in calibration.gains]
    names.append("all")
    before_percent = [math.nan] * len(names)
    if before is not None:
        before_percent = [*before.axes, before.total]
    after_percent = [*after.axes, after.total]
    rows = list(zip(names, before_percent, after_percent, strict=True))
    return before_after_drawing(rows, "Error of each axis", "error [%]")


def _percent(percent: float) -> str:
    """Signed with one decimal, with two where it is small."""
    if not math.isfinite(percent):
        return "-"
    # Adding 0 turns -0.0 into 0.0.
    if abs(percent) >= 10.0:
        return f"{percent:+.1f}"
    return f"{round(percent, 2) + 0.0:+.2f}"


def _limit(allowed: tuple[float, float]) -> str:
    low, high = allowed
    if not math.isfinite(low) or not math.isfinite(high):
        return "-"
    if math.isclose(-low, high):
        return f"±{high:.3g}"
    return f"{low:+.3g} to {high:+.3g}"


def _effects(calibration: Calibration, consequence: str) -> str:
    if not calibration.effects:
        return section(
            "Effects", paragraph("The calibration holds no effect beyond the declared model.")
        )
    body = [_effect(effect, calibration) for effect in calibration.effects]
    if consequence:
        body.append(paragraph(consequence))
    return section("Effects", *body)


def _effect(effect: AcceptedEffect, calibration: Calibration) -> str:
    before = percent_text(effect.error_before_percent)
    after = percent_text(effect.error_after_percent)
    has_holdout = any(source.role == "holdout" for source in calibration.sources)
    data = "on moves left out in turn, which its choice has seen"
    if has_holdout:
        data = "on data that the fit has not used"
    name = accepted_text(effect, calibration)
    size = size_text(effect, calibration)
    text = paragraph(
        f"{effect.axis} has {name}: {size}. Error of the predicted torque of {effect.axis} {data}: "
        f"{before} % without this effect, {after} % with it."
    )
    if effect.package is not None:
        text += paragraph(f"The effect {effect.name!r} is one of {effect.package}.")
    shown = curve_of(effect, calibration)
    if shown is None:
        return text
    band = "Band: ± 2 σ."
    if shown.half_nm is None:
        band = "The uncertainty is not known."
    against = ""
    if shown.turns:
        against = ", against the motion"
    torque = f"{QUANTITY[shown.force]} [{shown.force}]{against}"
    title = f"{effect.axis}: {QUANTITY[shown.force]} that the declared model lacks"
    drawn = chart(
        (Line(shown.x, shown.torque_nm),), title, (shown.variable, torque), half=shown.half_nm
    )
    return text + on_screen(figure(drawn, band, title))


def _write(certificate: Certificate) -> str:
    """What was written into the controller's file, or would be;
    empty for gains that must not be written.
    """
    comparison = certificate.comparison
    edit = comparison.edit
    if edit is None:
        return ""
    place = "/".join(edit.file.parts[-2:])
    if comparison.in_force is not None and certificate.before_write is not None:
        previous = {one.axis: one.compared_gain for one in certificate.before_write.changes}
        rows = [
            _written_row(one, previous[one.axis], f"{one.current_gain:.9g}") for one in edit.changes
        ]
        return part(
            f"What was written into {place}",
            table("", ("axis", "key", "line", "previous gain", "current gain"), rows),
            *_old_comments(edit),
        )
    if comparison.in_force is not None or certificate.verdict is Verdict.REFUSED:
        return ""
    if not edit.has_effect:
        return part(
            "What would be written",
            paragraph(f"Nothing: {edit.file.name} has these gains already."),
        )
    rows = [_written_row(one, one.current_gain, one.spelling or "-") for one in edit.changes]
    return part(
        f"What would be written into {place}",
        table("", ("axis", "key", "line", "current gain", "new"), rows),
        paragraph("This page writes nothing."),
    )


def _written_row(change: GainChange, gain_before: float, after: str) -> tuple[str, ...]:
    return change.axis, change.key, str(change.line), f"{gain_before:.9g}", after


def _old_comments(edit: FileEdit) -> Iterator[str]:
    """Say that comments after the gains are those of the previous gains:
    a write changes numbers alone.
    """
    comments = edit.comments
    if comments:
        axis, text = next(iter(comments.items()))
        yield paragraph(
            "A write changes numbers only, so comments after the gains may describe the previous "
            f"gains. {axis}: “{text}”."
        )


def _digests(certificate: Certificate) -> str:
    """Digests of all files that the certificate rests on, for paper:
    the screen has them in the details.
    """
    calibration = certificate.calibration
    rows = [("calibration", certificate.origin.sha256)]
    if calibration.configuration_sha256:
        rows.append(("configuration", calibration.configuration_sha256))
    rows += [(_log_name(source), source.sha256) for source in calibration.sources]
    return on_paper(element("h3", "SHA-256"), terms(rows))


def _log_name(source: Source) -> str:
    if source.role == "fit":
        return source.name
    return f"{source.name} ({_ROLES.get(source.role, source.role)})"


def _since(certificate: Certificate) -> Iterator[str]:
    """Differences from an earlier calibration."""
    earlier = certificate.earlier
    calibration = certificate.calibration
    if earlier is None:
        return
    earlier_gains = {gain.axis: gain for gain in earlier.gains}
    headings = ("axis", "earlier ± σ", "this one ± σ", "change [%]", "in σ of both", "verdict")
    rows = []
    shifts = []
    for gain, row in zip(calibration.gains, certificate.rows_since_earlier, strict=True):
        earlier_gain = earlier_gains[gain.axis]
        earlier_text = with_deviation(earlier_gain.value, earlier_gain.std)
        this_text = with_deviation(gain.value, gain.std)
        change_text = _percent(row.change.change_percent)
        sigmas = f"{abs(row.judged.sigmas):.1f}"
        rows.append((gain.axis, earlier_text, this_text, change_text, sigmas, row.words))
        # The limits are those of a change from the current gain, not of one from here.
        shifts.append(replace(_interval(row), lower=-math.inf, upper=math.inf))
    before = _effects_in_words(earlier)
    after = _effects_in_words(calibration)
    facts = [f"New: {axis} has {words}." for axis, words in sorted(after - before)]
    facts += [f"No longer: {axis} has {words}." for axis, words in sorted(before - after)]
    now = identity(calibration)
    for name, then in identity(earlier).items():
        if now.get(name, then) != then:
            facts.append(f"{name}: {then}; now {now[name]}.")
    drawing = intervals(shifts, "Change of each gain", "from the earlier calibration [%]")
    caption = "0 is the earlier calibration. Bar: ± 2 σ of this one."
    change = figure(drawing, caption, "Change from the earlier calibration")
    errors = ""
    holdout = calibration.holdout_error_percent
    # `certify` has refused calibrations of other axes, and errors of another number of them.
    if earlier.holdout_error_percent is not None and holdout is not None:
        caption = (
            "Hollow: earlier. Full: this one. The runs differ, so that only large "
            "differences count."
        )
        drawing = _error_drawing(calibration, earlier.holdout_error_percent, holdout)
        errors = figure(drawing, caption, "Error on held-out runs")
    yield section(
        "Compared with the earlier calibration",
        table("", headings, rows, "words"),
        pair((change, errors)),
        html_list(facts),
    )


def _effects_in_words(calibration: Calibration) -> set[tuple[str, str]]:
    return {(effect.axis, accepted_text(effect, calibration)) for effect in calibration.effects}


def _rival_text(rival: str) -> str:
    """Describe `load-friction on J2` in words."""
    name, _, where = rival.partition(" ")
    return f"{WORDS.get(name, name)} {where}"


def _filter_text(value: float | list[float]) -> str:
    if isinstance(value, list):
        return ", ".join(f"{one:g}" for one in value)
    return f"{value:g}"


def _evidence(certificate: Certificate) -> Iterator[str]:
    """Basis of the calibration: ambiguity, parameters, filters and logs."""
    calibration = certificate.calibration
    rivals = []
    for effect in calibration.effects:
        if not effect.ambiguity:
            continue
        name = accepted_text(effect, calibration)
        others = "; ".join(map(_rival_text, effect.ambiguity))
        rivals.append((effect.axis, name, others))
    if rivals:
        yield folded(
            "Effects that these data cannot distinguish",
            table("", ("axis", "effect", "not distinguishable from"), rivals, "words"),
        )
    if calibration.payload_mass:
        yield folded(
            "Dependence of the gains on the payload's mass",
            paragraph(
                "To first order. A wrong mass is in every gain; where the mass is all that is "
                "known of the payload, no residual shows it. σ by the tolerance of the weighing is "
                "not included in σ of the gains."
            ),
            table("", MASS_HEADINGS, mass_rows(calibration), "names"),
        )
    of_effects: set[str] = set()
    for effect in calibration.effects:
        of_effects.update(one.name for one in effect.coefficients)
    parameters = [one for one in calibration.parameters if one.name not in of_effects]
    yield folded(
        "Dynamic parameters",
        paragraph(
            "The number is that of the axis. I: moment of inertia of the link (Ia: of the motor), "
            "m: its mass, mx, my, mz: mass × centre of mass, fv: viscous friction, fs: dry "
            "friction, off: constant torque, m in the middle of a name (Iam, fvm, fsm): coupled "
            "motors, _loaded at its end: what is added while a payload is mounted. A sum is what "
            "motion shows of several links together; a name after a colon is a payload."
        ),
        table("", ("parameter", "value ± σ", "unit"), value_rows(parameters), "stacked"),
    )
    filters = []
    for name, value in calibration.filter.items():
        label = _FILTERS.get(name, name.replace("_", " "))
        filters.append((label, _filter_text(value)))
    logs = [(one.name, _ROLES.get(one.role, one.role), one.sha256) for one in calibration.sources]
    method = _METHODS.get(calibration.method, calibration.method)
    left = percent_text(calibration.relative_error_percent.total)
    configuration = calibration.configuration_sha256 or "not known"
    software = calibration.software or "software not known"
    origin = (
        f"Estimator {method}, {calibration.rows} rows, condition {calibration.condition:.0f}; on "
        f"the data of the fit the model leaves {left} %. Calibration {certificate.origin.sha256}, "
        f"configuration {configuration}, made {minute_text(calibration.created)} by {software}."
    )
    yield folded(
        "Filters, logs and digests",
        table("Filters", ("setting", "value"), filters, "stacked"),
        table("Logs", ("log", "used for", "sha256"), logs, "names"),
        paragraph(origin),
    )
