"""The tables of the paper, in their form:
parameters (1, 3), gains (2, 4) and cross-validation (5 to 8).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from rich.console import RenderableType

from daq.report.text import plain_table, printable, terminal_text
from daq.workflow.validate import NAMEPLATE_LABEL, CrossValidation
from ident.calibration import Calibration, Gain, Parameter
from ident.estimators.estimate import RelativeError

NONE = "—"
ERROR_ROW = "difference from the scale, %"
SIGMA_NOTE = (
    "%σ by the formulas of the method: eqs. (10) of wls and (23) of tls take rows as "
    "independent: too small."
)


@dataclass(frozen=True, slots=True)
class PaperTable:
    """Table of text, with the notes that belong to it."""

    title: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()
    number: int | None = None  #: in the paper; None of a table that it has not

    @property
    def numbered_title(self) -> str:
        """Title with the number of the paper's table, for a reader who compares the two."""
        if self.number is None:
            return self.title
        return f"Table {self.number}: {self.title}"

    def markdown(self) -> str:
        """Section of a Markdown page."""
        right_aligned = ["---:"] * (len(self.headings) - 1)
        rule = ("---", *right_aligned)
        lines = [f"## {self.numbered_title}", ""]
        lines += map(_markdown_row, (self.headings, rule, *self.rows))
        for note in self.notes:
            lines += ["", note]
        return "\n".join(lines) + "\n"

    def view(self, *, numbered: bool = True) -> Iterator[RenderableType]:
        """Table and notes for a terminal, with the paper's number or without."""
        title = self.numbered_title
        if not numbered:
            title = f"{self.title[0].upper()}{self.title[1:]}"
        table = plain_table(self.headings, title=title, wrap=range(len(self.headings)))
        for row in self.rows:
            table.add_row(*map(terminal_text, row))
        yield table
        yield from map(printable, self.notes)


def _markdown_row(cells: Sequence[str]) -> str:
    escaped = [cell.replace("|", r"\|") for cell in cells]
    return f"| {' | '.join(escaped)} |"


def case_tables(calibrations: Mapping[str, Calibration]) -> tuple[PaperTable, ...]:
    """Build Tables 1 to 4 from the calibrations by name of their case."""
    tables: list[PaperTable] = []
    for number, method in ((1, "IDIM-WLS"), (3, "IDIM-TLS")):
        first = calibrations[f"case-{number}"]
        second = calibrations[f"case-{number + 1}"]
        tables.append(parameter_table(number, first, second, method))
        tables.append(paper_gain_table(number + 1, first, second, method))
    return tuple(tables)


def parameter_table(
    number: int, first: Calibration, second: Calibration, method: str
) -> PaperTable:
    """Build Table 1 or 3: essential parameters with the payload's drawing (first)
    and with its mass alone (second).
    """
    ones = {parameter.name: parameter for parameter in first.parameters}
    others = {parameter.name: parameter for parameter in second.parameters}
    rows = []
    differences = []
    for name in _in_order(list(ones), list(others)):
        one = ones.get(name)
        other = others.get(name)
        difference = None
        if one is not None and other is not None and one.value:
            difference = 100.0 * abs((one.value - other.value) / one.value)
            # The mean is over the parameters that both identified; one given by the drawing is no
            # comparison.
            if one.std > 0.0:
                differences.append(difference)
        leading, *regrouped = name.split()
        short = leading
        if regrouped:
            short = f"{leading} R"
        rows.append((short, *_parameter(one), *_parameter(other), percent(difference)))
    left = f"{first.relative_error_percent.total:.2f} %"
    other_left = f"{second.relative_error_percent.total:.2f} %"
    rows.append(("‖ρ‖/‖Y‖", left, "", other_left, "", ""))
    mean = percent(_mean(differences))
    note = (
        f"%e is the difference from the first value; its mean is {mean} %. R: other parameters are "
        f"regrouped with this one. {NONE} for %σ: given. SI units."
    )
    return PaperTable(
        number=number,
        title=f"essential parameters, {method}",
        headings=("parameter", "10 CAD: value", "%σ", "mass alone: value", "%σ", "%e"),
        rows=tuple(rows),
        notes=(note, SIGMA_NOTE),
    )


def paper_gain_table(
    number: int, first: Calibration, second: Calibration, method: str
) -> PaperTable:
    """Build Table 2 or 4: nameplate and identified gains,
    with the payload's drawing and with its mass alone.
    """
    rows: list[tuple[str, ...]] = []
    for one, other in zip(first.gains, second.gains, strict=True):
        nameplate = f"{one.nameplate:.4g}"
        rows.append((one.axis, nameplate, *_gain_cells(one), *_gain_cells(other)))
    mean = percent(_mean_change(first))
    other_mean = percent(_mean_change(second))
    rows.append(("mean", "", "", "", mean, "", "", other_mean))
    return PaperTable(
        number=number,
        title=f"drive gains, {method}",
        headings=("axis", "nameplate", "10 CAD: gain", "%σ", "%e", "mass alone: gain", "%σ", "%e"),
        rows=tuple(rows),
        notes=("%e is the change from the nameplate.", SIGMA_NOTE),
    )


def _mean_change(calibration: Calibration) -> float | None:
    """Mean size of the changes from the nameplate [%]."""
    return _mean([abs(gain.change_percent) for gain in calibration.gains])


def _gain_cells(gain: Gain) -> tuple[str, str, str]:
    return f"{gain.value:.4g}", percent(gain.std_percent), percent(abs(gain.change_percent))


def condition_table(found: CrossValidation) -> PaperTable:
    """Build Table 5: condition number of each run."""
    names = [run.run for run in found.runs]
    conditions = []
    for run in found.runs:
        condition = NONE
        if run.condition is not None:
            condition = f"{run.condition:.0f}"
        conditions.append(condition)
    return PaperTable(
        number=5,
        title="condition number of each run's observation matrix",
        headings=("", *names),
        rows=(("cond(W)", *conditions),),
        notes=(
            "The smaller the number, the more evenly the moves show all base parameters. The "
            "payload counts as part of the last link. `plan` allows 3500, and 1e5 for a closed "
            "chain.",
        ),
    )


def paper_error_table(found: CrossValidation) -> PaperTable:
    """Build Table 6: relative error of each run and joint by every calibration."""
    labels = tuple(found.calibrations)
    axes = found.axes
    rows: list[tuple[str, ...]] = []
    for run in found.runs:
        if not run.errors:
            continue
        errors = [run.errors.get(label) for label in labels]
        for index, axis in enumerate(axes):
            cells = [_axis_error(error, index) for error in errors]
            rows.append((f"{run.run}, {axis}", *cells))
    means = [percent(_mean_error(found, label)) for label in labels]
    rows.append(("mean", *means))
    reasons: dict[str, list[str]] = {}
    for run in found.runs:
        if run.left_out:
            reasons.setdefault(run.left_out, []).append(run.run)
    notes = []
    seen = sorted({run.run for run in found.runs if run.seen_by})
    if seen:
        notes.append(f"Used by a fit: {', '.join(seen)}.")
    for reason, runs in reasons.items():
        notes.append(f"{', '.join(runs)}: {reason}.")
    return PaperTable(
        number=6,
        title="relative error norms ‖ρ‖/‖Y‖ [%]",
        headings=("run, joint", *labels),
        rows=tuple(rows),
        notes=tuple(notes),
    )


def _axis_error(error: RelativeError | None, index: int) -> str:
    if error is None:
        return NONE
    return percent(error.axes[index])


def _mean_error(found: CrossValidation, label: str) -> float | None:
    """Mean of the errors of all runs and joints by one calibration."""
    errors: list[float] = []
    for run in found.runs:
        if label in run.errors:
            errors.extend(run.errors[label].axes)
    return _mean(errors)


def mass_tables(found: CrossValidation) -> tuple[PaperTable, ...]:
    """Build Tables 7 and 8, one for each payload."""
    payloads = dict.fromkeys((run.payload.name, run.payload.mounting) for run in found.weighed)
    tables = []
    for index, (name, mounting) in enumerate(payloads):
        number = min(7 + index, 8)
        tables.append(_mass_table(found, name, mounting, number))
    return tuple(tables)


def _mass_table(found: CrossValidation, name: str, mounting: str, number: int) -> PaperTable:
    runs = [
        run for run in found.weighed if (run.payload.name, run.payload.mounting) == (name, mounting)
    ]
    labels: dict[str, None] = {}
    for run in runs:
        labels |= dict.fromkeys(run.masses)
    rows: list[tuple[str, ...]] = []
    errors: dict[str, list[float]] = {label: [] for label in labels}
    notes = []
    for run in runs:
        columns: list[tuple[str, ...]] = []
        for label in labels:
            mass = run.masses[label]
            if isinstance(mass, str):
                columns.append((NONE,) * 4)
                notes.append(f"{run.run}, {label}: {mass}")
                continue
            percents = (mass.std_percent, mass.std_with_gains_percent, mass.error_percent)
            columns.append((f"{mass.mass_kg:.3f}", *map(percent, percents)))
            if mass.error_percent is not None:
                errors[label].append(mass.error_percent)
        names = (f"{run.run}, kg", "σ %, moves alone", "σ %, with σ of the calibration", ERROR_ROW)
        *figures, difference = zip(names, *columns, strict=True)
        rows += figures
        if run.weighed_kg is not None:
            rows.append(difference)
    weighed = "not weighed"
    if runs[0].weighed_kg is not None:
        weighed = f"{runs[0].weighed_kg:g} kg"
        means = [percent(_mean(errors[label])) for label in labels]
        rows.append((f"mean {ERROR_ROW}", *means))
    how = "payload and friction are estimated from this run, the robot is that of the calibration"
    if found.with_bare_runs:
        how = "robot and payload are estimated together, from this run and the runs without load"
    # The label is a key of documents; a reader knows these gains as the nameplate.
    shown = list(labels)
    if NAMEPLATE_LABEL in labels and NAMEPLATE_LABEL not in found.calibrations:
        shown[shown.index(NAMEPLATE_LABEL)] = "nameplate"
    explanation = (
        f"Each column weighs with its own gains: {how}. Gains that find the right mass may still "
        "be wrong, because errors of several axes can cancel."
    )
    return PaperTable(
        number=number,
        title=f"mass of payload {name} ({mounting}), {weighed}",
        headings=("run", *shown),
        rows=tuple(rows),
        notes=(explanation, *dict.fromkeys(notes)),
    )


def paper_page(title: str, tables: Iterable[PaperTable], *, marker: str) -> str:
    """Markdown page of tables; its first line names the kind of file,
    so that no other file is overwritten.
    """
    sections = "\n".join(table.markdown() for table in tables)
    return f"<!-- format: {marker} -->\n# {title}\n\n{sections}"


def percent(value: float | None) -> str:
    """Two decimals, none from 100 % on; a dash for an unknown value."""
    if value is None or not math.isfinite(value):
        return NONE
    if abs(value) < 99.995:
        return f"{value:.2f}"
    return f"{value:.0f}"


def _parameter(parameter: Parameter | None) -> tuple[str, str]:
    if parameter is None:
        return NONE, NONE
    deviation = NONE
    if parameter.std and parameter.value:
        deviation = percent(100.0 * parameter.std / abs(parameter.value))
    return f"{parameter.value:.3g}", deviation


def _in_order(first: list[str], second: list[str]) -> list[str]:
    """Merge two lists of names in the order of each."""
    order = list(first)
    for index, name in enumerate(second):
        if name not in order:
            known = [earlier for earlier in second[:index] if earlier in order]
            place = 0
            if known:
                place = order.index(known[-1]) + 1
            order.insert(place, name)
    return order


def _mean(values: Sequence[float]) -> float | None:
    usable = [value for value in values if math.isfinite(value)]
    if usable:
        return sum(usable) / len(usable)
    return None
