"""`report.html`: the effects that were added and what they changed, for reading and printing; and both report files."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from unicodedata import category

from daq.errors import writing
from daq.files import replace_file
from daq.report.effect_names import effect_text, variable_text
from daq.report.fit import coefficients, identifiability_notes, start_of
from daq.report.gains import partial_note, plot_gain_changes, with_deviation
from daq.report.plots import draw_effect, draw_torques, plot_ranking
from daq.report.residual import WHEN, error_rows, residual_document, summary
from daq.report.text import json_text, percent_text
from daq.workflow.fit import Fit
from ident.calibration import Calibration
from ident.discovery.before_after import Account, BeforeAfter
from ident.discovery.evidence import Evidence
from ident.discovery.loop import Step
from ident.effects.effect import PlacedEffect
from ident.effects.unnamed import is_unnamed

PAGE, DOCUMENT = "report.html", "residual.json"
FORMAT, VERSION = "drivegain-residual", 1
MARKS = {PAGE: '<meta name="generator" content="drivegain">', DOCUMENT: f'"format": "{FORMAT}"'}
"""Text at the beginning of each file of a report, by which an earlier report is recognised."""
_SHOWN = 10  #: Candidates of a turn that are drawn; residual.json has them all
_UNSEEN = ("Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp")
"""Unicode categories: control, format, surrogates, private, unassigned, separators of lines and paragraphs."""
_STYLE = """
body { font: 11pt/1.45 sans-serif; color: #111; max-width: 60em; margin: 2em auto; padding: 0 1em; }
h1 { font-size: 1.5em; } h2 { font-size: 1.2em; margin-top: 2em; border-bottom: 1px solid #999; }
table { border-collapse: collapse; margin: 0.8em 0; font-variant-numeric: tabular-nums; }
caption { text-align: left; font-weight: bold; padding: 0.2em 0; }
th, td { padding: 0.15em 0.7em; border-bottom: 1px solid #ddd; text-align: right; }
th:first-child, td:first-child { text-align: left; }
figure { margin: 1em 0; } figcaption { color: #444; font-size: 0.9em; }
img { max-width: 100%; }
.summary { border-left: 4px solid #0072B2; padding-left: 1em; }
@media print { body { margin: 0; max-width: none; font-size: 9.5pt; } figure, table { break-inside: avoid; } }
"""


def page(title: str, body: Iterable[str]) -> str:
    """Build a document that needs no other file: no script, no address, pictures inside.

    The pieces of the body come from the functions below, which escape every text.
    """
    # The security policy keeps a browser from opening an address, whatever text a file holds.
    pieces = "\n".join(body)
    return f"""\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
{MARKS[PAGE]}
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{_spelled(title)}</title>
<style>{_STYLE}</style>
</head>
<body>
<h1>{_spelled(title)}</h1>
{pieces}
</body>
</html>
"""


def section(title: str, *body: str) -> str:
    """Build a section under a heading."""
    return "\n".join(("<section>", f"<h2>{_spelled(title)}</h2>", *body, "</section>"))


def paragraph(text: str) -> str:
    """Build a paragraph of plain text."""
    return f"<p>{_spelled(text)}</p>"


def listed(texts: Iterable[str], kind: str = "") -> str:
    """Build a list of plain texts; its kind is a CSS class."""
    entries = "".join(f"<li>{_spelled(text)}</li>" for text in texts)
    return f'<ul class="{kind}">{entries}</ul>' if kind else f"<ul>{entries}</ul>"


def table(caption: str, headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Build a table of plain texts; the first cell of each row is its heading."""
    head = "".join(f'<th scope="col">{_spelled(heading)}</th>' for heading in headings)
    lines = [f"<table><caption>{_spelled(caption)}</caption>", f"<thead><tr>{head}</tr></thead>", "<tbody>"]
    for first, *others in rows:
        cells = "".join(f"<td>{_spelled(cell)}</td>" for cell in others)
        lines.append(f'<tr><th scope="row">{_spelled(first)}</th>{cells}</tr>')
    return "\n".join((*lines, "</tbody></table>"))


def picture(png: bytes, caption: str) -> str:
    """Embed a picture with its caption."""
    data = base64.b64encode(png).decode("ascii")
    words = _spelled(caption)
    return f'<figure><img alt="{words}" src="data:image/png;base64,{data}"><figcaption>{words}</figcaption></figure>'


def _spelled(text: str) -> str:
    """Escape markup and spell out invisible characters.

    HTML allows no control characters, and those that reverse the direction of writing (U+202E and others of category
    Cf) can make a name look like another.
    """
    return escape("".join(c if c == "\n" or category(c) not in _UNSEEN else f"\\u{ord(c):04x}" for c in text))


def save_report(fitted: Fit, account: Account, calibration: Calibration, folder: Path) -> None:
    """Write report.html and residual.json, each whole or not at all.

    Raises:
        OutputFailed: the file system refuses.
    """
    document = {"format": FORMAT, "version": VERSION, **residual_document(fitted, account, calibration)}
    content = {PAGE: residual_page(fitted, account, calibration), DOCUMENT: json_text(document)}
    with writing(folder):
        for name, text in content.items():
            replace_file(folder / name, text.encode())


def residual_page(fitted: Fit, account: Account, calibration: Calibration) -> str:
    """Build the page of a closed loop, the account of its turns, and the calibration with the accepted effects."""
    axes = fitted.cell.axis_names
    note = partial_note(calibration)
    errors = [(name, *map(percent_text, (*error.axes, error.total))) for name, error in error_rows(account)]
    sections, before = [], start_of(fitted)
    for step, turn in zip(fitted.steps, account.turns, strict=True):
        if turn is not None:
            sections += [_effect(fitted, before, step, turn, placed) for placed in turn.added]
        before = step.after
    return page(
        f"Residual of cell {fitted.cell.name}",
        (
            *(() if note is None else (paragraph(note),)),
            listed(summary(fitted, account), "summary"),
            section(
                "Before and after",
                table("Relative error ‖e‖/‖v‖ [%]", ("", *axes, "total"), errors),
                paragraph(
                    "Error: the share of each motor's current that the model leaves, ‖e‖/‖v‖, over the rows in motion; "
                    "in total with each current weighted by its gain. Compare errors only under the same filters (end "
                    "of this page). Noise floor: the share that the current's noise would leave, as measured at "
                    "standstill or between repeated moves, whichever is smaller."
                ),
            ),
            *sections,
            section("Torques", picture(draw_torques(before, fitted.cell), "Measured and predicted joint torques")),
            _gains(fitted, account),
            *(_turn(fitted, number, step) for number, step in enumerate(fitted.steps, start=1)),
            _limits(fitted),
            _origin(calibration),
        ),
    )


def _effect(fitted: Fit, before: Evidence, step: Step, turn: BeforeAfter, placed: PlacedEffect) -> str:
    axes = fitted.cell.axis_names
    axis, final = axes[placed.axis], fitted.steps[-1].after
    kept = placed in final.effects
    rivals = () if step.accepted is None else step.accepted.ambiguity
    ambiguous = ", ".join(rival.name_among(axes) for rival in rivals)
    sentences = (
        f"Effect {placed.name_among(axes)}.",
        f"These data cannot distinguish it from: {ambiguous}."
        if ambiguous
        else "Every other candidate is clearly worse.",
        *(() if kept else ("A later turn removed it again, because it no longer reduced the error.",)),
    )
    pairs = (
        ("fit", turn.before.in_sample, turn.after.in_sample),
        ("moves left out", turn.before.cross_validated, turn.after.cross_validated),
        ("held out", turn.before.holdout, turn.after.holdout),
    )
    errors = [
        (name, percent_text(first.axes[placed.axis]), percent_text(second.axes[placed.axis]))
        for name, first, second in pairs
        if first is not None and second is not None
    ]
    # The coefficients of a term without a name mean nothing one by one; the certificate draws its curve.
    found = () if is_unnamed(placed.effect) else coefficients(final if kept else step.after, placed)
    sizes = [(one.name, with_deviation(one.value, one.std), one.unit) for one in found]
    return section(
        f"{axis}: {effect_text(placed.effect, axes)}",
        paragraph(" ".join(sentences)),
        table("Identified coefficients", ("coefficient", "value ± σ", "unit"), sizes) if sizes else "",
        table(f"Relative error of {axis} [%]", ("", *WHEN), errors),
        picture(
            draw_effect(before, step.after, placed, fitted.cell),
            f"Residual of {axis} over time and against {variable_text(placed.effect, axes)}, without and with the "
            "effect. A mean away from zero is torque that the model still lacks.",
        ),
    )


def _gains(fitted: Fit, account: Account) -> str:
    axes, changes = fitted.cell.axis_names, account.total.gains
    if fitted.estimate.gains_fixed:
        return section("Drive gains", paragraph("The gains were held at their nameplate values."))
    rows = [
        (
            axis.name,
            with_deviation(change.before, change.before_std),
            with_deviation(change.after, change.after_std),
            f"{change.change_percent:+.2f} ± {change.change_std_percent:.2f}",
            "yes" if change.significant else "no",
            axis.gain_unit,
        )
        for axis, change in zip(fitted.cell.axes, changes, strict=True)
    ]
    return section(
        "Drive gains",
        table("Before and after", ("axis", *WHEN, "change ± σ [%]", "more than noise", "unit"), rows),
        picture(
            plot_gain_changes(changes, axes, title=f"Drive gains of {fitted.cell.name}"),
            "Gains with their intervals, before and after, in per cent of the gain before; * changed by more than "
            "noise. Both estimates share their noise, so overlapping intervals do not exclude a change.",
        ),
    )


def _turn(fitted: Fit, number: int, step: Step) -> str:
    axes, added = fitted.cell.axis_names, step.accepted
    shown = (*step.findings[:_SHOWN], *(finding for finding in step.structures[:_SHOWN] if finding.passed))
    best = added or next(iter(step.findings), None)
    outcome = "Nothing passed every gate and nothing was added."
    if added is not None:
        outcome = f"Added: {PlacedEffect(added.effect, added.axis).name_among(axes)}."
    ranking = paragraph("No candidate could be tried.")
    if shown:
        ranked = sorted(shown, key=lambda finding: -finding.held_out_fall)
        rivals = () if best is None else best.ambiguity
        ranking = picture(
            plot_ranking(ranked, rivals, axes, title=f"Turn {number}: the best candidates"),
            "Candidates by how much they reduce the error of left-out moves.",
        )
    refused = [
        f"Not added: {PlacedEffect(aside.finding.effect, aside.finding.axis).name_among(axes)}: {aside.reason(axes)}."
        for aside in step.set_aside
    ]
    return section(f"Turn {number}: what was tried", paragraph(" ".join((outcome, *refused))), ranking)


def _limits(fitted: Fit) -> str:
    held = fitted.estimate.gains_fixed
    limits = (
        *identifiability_notes(fitted),
        "A torque constant that is wrong by a constant factor is part of the gain, and an effect that is the same at "
        "every speed, load and position is part of the parameters: neither leaves a residual.",
        *(("The gains were held: an error in them is hidden in the parameters.",) if held else ()),
        "Backlash or elasticity behind an encoder on the motor may leave no trace in these signals.",
        "An effect is named after the variable it depends on and the shape of that dependence; another cause with the "
        "same dependence would get the same name. Indistinguishable effects are listed with each effect.",
        "The noise floor is a lower bound: an error above it need not be an effect.",
    )
    return section("What these data can and cannot show", listed(limits))


def _origin(calibration: Calibration) -> str:
    filters = [
        (name, ", ".join(f"{v:g}" for v in value) if isinstance(value, list) else f"{value:g}")
        for name, value in calibration.filter.items()
    ]
    return section(
        "Filters and sources",
        table("Filter settings", ("setting", "value"), filters),
        table("Logs", ("log", "role", "sha256"), [(s.name, s.role, s.sha256) for s in calibration.sources]),
        paragraph(
            f"{calibration.rows} rows, condition {calibration.condition:.0f}, configuration "
            f"{calibration.configuration_sha256}, made {calibration.created} by {calibration.software}."
        ),
    )
