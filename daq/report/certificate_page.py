"""The certificate as a page: the first sheet for everybody, what it rests on folded below."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from daq.report.certificate import AxisRow, Certificate, Verdict, identity
from daq.report.effect_names import accepted_text, curve_of, size_text
from daq.report.gains import diagnosis_texts, partial_note, with_deviation
from daq.report.html import element, figure, folded, listed, page, paragraph, section, table, terms
from daq.report.svg import Interval, before_after, curve, intervals
from daq.report.text import percent_text
from ident.calibration import AcceptedEffect, Calibration

_LOOK = {Verdict.REFUSED: "act", Verdict.WAITING: "act", Verdict.UNCHANGED: "quiet", Verdict.NOT_COMPARED: "quiet"}
"""CSS class of the verdict; blue without one. Orange asks the reader to act."""
_SIGN = {
    Verdict.READY: "✓",
    Verdict.UNCHANGED: "=",
    Verdict.WAITING: "…",
    Verdict.NOT_COMPARED: "?",
    Verdict.REFUSED: "✕",
}
_SIGMAS = 2.0


def certificate_page(certificate: Certificate, consequence: str = "", details: Sequence[str] = ()) -> str:
    """Build the page.

    Args:
        certificate: judged calibration.
        consequence: what the effects change in the gains, a sentence; empty where it is not known.
        details: further folded sections, before those of the calibration itself.
    """
    calibration = certificate.calibration
    return page(
        f"Calibration of cell {calibration.cell}",
        (
            '<main class="sheet">',
            paragraph("Calibration certificate", "kind"),
            element("h1", f"Cell {calibration.cell}"),
            paragraph(f"{_SIGN[certificate.verdict]} {certificate.sentence}", _verdict_class(certificate.verdict)),
            *_warnings(certificate),
            terms(identity(calibration)),
            _gains(certificate),
            _pictures(certificate),
            _errors(calibration),
            _effects(calibration, consequence),
            _write(certificate),
            "</main>",
            *_since(certificate),
            *details,
            *_evidence(calibration),
        ),
    )


def _verdict_class(verdict: Verdict) -> str:
    return f"verdict {_LOOK[verdict]}" if verdict in _LOOK else "verdict"


def _warnings(certificate: Certificate) -> Iterator[str]:
    note = partial_note(certificate.calibration)
    texts = (*(() if note is None else (note,)), *diagnosis_texts(certificate.calibration.diagnoses))
    of_axes = {row.change.axis for row in certificate.rows}
    # The failed checks of an axis are in its row of the table.
    failed = [str(one) for one in certificate.comparison.refusals if one.subject not in of_axes]
    if texts or failed:
        yield listed((*texts, *failed))


def _gains(certificate: Certificate) -> str:
    place = "in the controller" if certificate.comparison.edit is not None else "nameplate"
    rows = [
        (
            row.change.axis,
            f"{row.change.old:.5g}",
            with_deviation(gain.value, gain.std),
            gain.unit,
            _percent(row.change.change_percent),
            _limit(row.allowed_percent),
            row.words(certificate.place),
        )
        for gain, row in zip(certificate.calibration.gains, certificate.rows, strict=True)
    ]
    unread = certificate.comparison.unread
    return section(
        "Drive gains",
        *(paragraph(unread) for _ in range(bool(unread))),
        table("", ("axis", place, "identified ± σ", "unit", "change [%]", "limit [%]", "verdict"), rows, "words"),
    )


def _interval(row: AxisRow, earlier: float = math.nan) -> Interval:
    change, half = row.change, math.nan
    if change.old and math.isfinite(change.std):
        half = 100.0 * _SIGMAS * change.std / abs(change.old)
    known = math.isfinite(change.change_percent) and math.isfinite(half)
    return Interval(
        change.axis,
        change.change_percent if known else math.nan,
        half if known else 0.0,
        *row.allowed_percent,
        f"{_percent(change.change_percent)} %",
        earlier,
    )


def _pictures(certificate: Certificate) -> str:
    """Gains beside their limits and, with a held-out run, the errors before and after."""
    calibration = certificate.calibration
    gains = figure(
        intervals(
            [_interval(row) for row in certificate.rows],
            "Change of each gain with its interval and its limits",
            f"change from the {certificate.place} [%]",
        ),
        f"Line: the {certificate.place}. Dot with bar: identified gain ± 2 σ; a bar shorter than the dot is not seen. "
        "Orange lines: limits.",
    )
    held, nameplate = calibration.holdout_error_percent, calibration.nameplate_holdout_error_percent
    if held is None:
        return gains
    axes = [gain.axis for gain in calibration.gains]
    before = (math.nan,) * len(axes) if nameplate is None else nameplate.axes
    errors = figure(
        before_after(list(zip(axes, before, held.axes, strict=True)), "Error of each axis", "held-out error [%]"),
        "Full: error with the identified gains." + ("" if nameplate is None else " Hollow: with the nameplate gains."),
    )
    return f'<div class="pair">{gains}{errors}</div>'


def _percent(percent: float) -> str:
    """Signed with one decimal, with two where it is small."""
    if not math.isfinite(percent):
        return "-"
    return f"{percent:+.1f}" if abs(percent) >= 10.0 else f"{percent:+.2f}"


def _limit(allowed: tuple[float, float]) -> str:
    low, high = allowed
    if not math.isfinite(low) or not math.isfinite(high):
        return "-"
    return f"±{high:.3g}" if math.isclose(-low, high) else f"{low:+.3g} to {high:+.3g}"


def _errors(calibration: Calibration) -> str:
    axes = tuple(gain.axis for gain in calibration.gains)
    held, nameplate = calibration.holdout_error_percent, calibration.nameplate_holdout_error_percent
    if held is None:
        fit = calibration.relative_error_percent
        return section(
            "Error",
            paragraph(
                "No run was held out, so that the error on data that the fit has not seen is not known. On the data of "
                f"the fit the model leaves {percent_text(fit.total)} % of the torque."
            ),
            table("", ("[%]", *axes, "total"), [("data of the fit", *map(percent_text, (*fit.axes, fit.total)))]),
        )
    rows = [("identified gains", held)] if nameplate is None else [("nameplate gains", nameplate), ("identified", held)]
    return section(
        "Error on held-out runs",
        table(
            "",
            ("share of the torque left [%]", *axes, "total"),
            [(name, *map(percent_text, (*error.axes, error.total))) for name, error in rows],
        ),
    )


def _effects(calibration: Calibration, consequence: str) -> str:
    if not calibration.effects:
        return section("Effects", paragraph("The calibration holds no effect beyond the declared model."))
    return section(
        "Effects",
        *(_effect(effect, calibration) for effect in calibration.effects),
        *(paragraph(consequence) for _ in range(bool(consequence))),
    )


def _effect(effect: AcceptedEffect, calibration: Calibration) -> str:
    words, size = accepted_text(effect, calibration), size_text(effect, calibration)
    before, after = percent_text(effect.error_before_percent), percent_text(effect.error_after_percent)
    text = paragraph(
        f"{effect.axis} has {words}: {size}. Without it the model leaves {before} % on data that the fit has not used, "
        f"with it {after} %."
    )
    shown = curve_of(effect, calibration)
    if shown is None:
        return text
    torque = "torque against the motion [Nm]" if shown.turns else "torque [Nm]"
    band = "; its covariance is not known" if shown.half_nm is None else " ± 2 σ"
    return text + figure(
        curve(shown.x, shown.torque_nm, shown.half_nm, f"Torque of {effect.axis}", (shown.variable, torque)),
        f"{effect.axis}: torque that the model lacks, over the {shown.variable.partition(' [')[0]}{band}.",
    )


def _write(certificate: Certificate) -> str:
    comparison = certificate.comparison
    edit = comparison.edit
    if edit is None:
        return ""
    if not edit.has_effect:
        return section("What would be written", paragraph(f"Nothing: {edit.file.name} has these gains already."))
    rows = [(one.axis, one.key, f"line {one.line}", f"{one.old:.9g}", one.spelling or "-") for one in edit.changes]
    return section(
        "What would be written",
        table(f"Into {edit.file.name}", ("axis", "key", "place", "gain now", "number written"), rows),
        paragraph(
            "This page writes nothing."
            + (f" To review the change, and to write it with --yes: {comparison.command}" if comparison.command else "")
        ),
    )


def _since(certificate: Certificate) -> Iterator[str]:
    """What differs from an earlier calibration."""
    earlier, calibration = certificate.earlier, certificate.calibration
    if earlier is None:
        return
    axes = tuple(gain.axis for gain in calibration.gains)
    old = {gain.axis: gain for gain in earlier.gains}
    rows = [
        (
            gain.axis,
            with_deviation(old[gain.axis].value, old[gain.axis].std),
            with_deviation(gain.value, gain.std),
            _percent(row.change.change_percent),
            f"{row.sigmas:.1f}",
            "changed" if row.significant else "same within noise",
        )
        for gain, row in zip(calibration.gains, certificate.since, strict=True)
    ]
    errors = [
        (name, *map(percent_text, (*one.holdout_error_percent.axes, one.holdout_error_percent.total)))
        for name, one in (("earlier", earlier), ("this one", calibration))
        if one.holdout_error_percent is not None and len(one.holdout_error_percent.axes) == len(axes)
    ]
    lists = {
        name: {(e.axis, accepted_text(e, one)) for e in one.effects}
        for name, one in (("a", earlier), ("b", calibration))
    }
    effects = [
        *(f"New: {axis} has {words}." for axis, words in sorted(lists["b"] - lists["a"])),
        *(f"No longer: {axis} has {words}." for axis, words in sorted(lists["a"] - lists["b"])),
    ]
    facts = [
        f"{name}: {then}; now {now}."
        for (name, then), (_, now) in zip(identity(earlier), identity(calibration), strict=True)
        if then != now
    ]
    yield section(
        "Beside the earlier calibration",
        table("", ("axis", "earlier ± σ", "this one ± σ", "change [%]", "in σ of both", "verdict"), rows, "words"),
        figure(
            intervals(
                [_interval(row) for row in certificate.since], "Change since the earlier calibration", "change [%]"
            ),
            "Line: the earlier calibration. Dot with bar: this one ± 2 σ of its own.",
        ),
        table(
            "Error on held-out runs [%]; other runs, so that only large differences count", ("", *axes, "total"), errors
        )
        if errors
        else "",
        listed((*effects, *facts)),
    )


def _evidence(calibration: Calibration) -> Iterator[str]:
    """What the calibration rests on: ambiguity, parameters, filters and logs."""
    rivals = [
        (e.axis, accepted_text(e, calibration), ", ".join(e.ambiguity)) for e in calibration.effects if e.ambiguity
    ]
    if rivals:
        yield folded(
            "Effects that these data cannot distinguish",
            table("", ("axis", "effect", "not distinguishable from"), rivals, "words"),
        )
    of_effects = {one.name for effect in calibration.effects for one in effect.coefficients}
    yield folded(
        "Dynamic parameters",
        table(
            "",
            ("parameter", "value ± σ", "unit"),
            [
                (one.name, with_deviation(one.value, one.std), one.unit)
                for one in calibration.parameters
                if one.name not in of_effects
            ],
        ),
    )
    filters = [
        (name.replace("_", " "), ", ".join(f"{v:g}" for v in value) if isinstance(value, list) else f"{value:g}")
        for name, value in calibration.filter.items()
    ]
    fit = calibration.relative_error_percent
    yield folded(
        "Filters, logs and digests",
        table("Filters", ("setting", "value"), filters),
        table("Logs", ("log", "role", "sha256"), [(one.name, one.role, one.sha256) for one in calibration.sources]),
        paragraph(
            f"Method {calibration.method}, {calibration.rows} rows, condition {calibration.condition:.0f}; on the data "
            f"of the fit the model leaves {percent_text(fit.total)} %. Configuration "
            f"{calibration.configuration_sha256 or 'not known'}, made {calibration.created} by {calibration.software}."
        ),
    )
