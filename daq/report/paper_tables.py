"""The tables of the paper, in their form: parameters (1, 3), gains (2, 4) and cross-validation (5 to 8)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from rich.console import RenderableType

from daq.report.text import plain_table, printable, terminal_text
from daq.workflow.validate import NAMEPLATE_LABEL, CrossValidation
from ident.calibration import Calibration, Gain, Parameter

NONE = "—"
ERROR_ROW = "difference from the scale, %"
SIGMA_NOTE = "%σ by the formulas of the method: eqs. (10) of wls and (23) of tls take rows as independent: too small."


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
        return self.title if self.number is None else f"Table {self.number}: {self.title}"

    def markdown(self) -> str:
        """Section of a Markdown page."""
        rule = ("---", *("---:" for _ in self.headings[1:]))
        rows = (" | ".join(cell.replace("|", r"\|") for cell in cells) for cells in (self.headings, rule, *self.rows))
        lines = [f"## {self.numbered_title}", "", *(f"| {row} |" for row in rows)]
        for note in self.notes:
            lines += ["", note]
        return "\n".join(lines) + "\n"

    def view(self, *, numbered: bool = True) -> Iterator[RenderableType]:
        """Table and notes for a terminal, with the paper's number or without."""
        title = self.numbered_title if numbered else f"{self.title[0].upper()}{self.title[1:]}"
        table = plain_table(self.headings, title=title, wrap=range(len(self.headings)))
        for row in self.rows:
            table.add_row(*map(terminal_text, row))
        yield table
        yield from map(printable, self.notes)


def case_tables(calibrations: Mapping[str, Calibration]) -> tuple[PaperTable, ...]:
    """Build Tables 1 to 4 from the calibrations by name of their case."""
    tables: list[PaperTable] = []
    for number, method in ((1, "IDIM-WLS"), (3, "IDIM-TLS")):
        pair = calibrations[f"case-{number}"], calibrations[f"case-{number + 1}"]
        tables += [parameter_table(number, *pair, method), paper_gain_table(number + 1, *pair, method)]
    return tuple(tables)


def parameter_table(number: int, first: Calibration, second: Calibration, method: str) -> PaperTable:
    """Build Table 1 or 3: essential parameters with the payload's drawing (first) and with its mass alone (second)."""
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
            # The mean is over the parameters that both identified; one given by the drawing is no comparison.
            if one.std > 0.0:
                differences.append(difference)
        leading, *regrouped = name.split()
        short = f"{leading} R" if regrouped else leading
        rows.append((short, *_parameter(one), *_parameter(other), percent(difference)))
    left, other_left = (f"{fit.relative_error_percent.total:.2f} %" for fit in (first, second))
    return PaperTable(
        number=number,
        title=f"essential parameters, {method}",
        headings=("parameter", "10 CAD: value", "%σ", "mass alone: value", "%σ", "%e"),
        rows=(*rows, ("‖ρ‖/‖Y‖", left, "", other_left, "", "")),
        notes=(
            f"%e is the difference from the first value; its mean is {percent(_mean(differences))} %. "
            f"R: other parameters are regrouped with this one. {NONE} for %σ: given. SI units.",
            SIGMA_NOTE,
        ),
    )


def paper_gain_table(number: int, first: Calibration, second: Calibration, method: str) -> PaperTable:
    """Build Table 2 or 4: nameplate and identified gains, with the payload's drawing and with its mass alone."""
    rows = [
        (one.axis, f"{one.nameplate:.4g}", *_gain_cells(one), *_gain_cells(other))
        for one, other in zip(first.gains, second.gains, strict=True)
    ]
    means = [_mean([abs(gain.change_percent) for gain in c.gains]) for c in (first, second)]
    return PaperTable(
        number=number,
        title=f"drive gains, {method}",
        headings=("axis", "nameplate", "10 CAD: gain", "%σ", "%e", "mass alone: gain", "%σ", "%e"),
        rows=(*rows, ("mean", "", "", "", percent(means[0]), "", "", percent(means[1]))),
        notes=("%e is the change from the nameplate.", SIGMA_NOTE),
    )


def _gain_cells(gain: Gain) -> tuple[str, str, str]:
    return f"{gain.value:.4g}", percent(gain.std_percent), percent(abs(gain.change_percent))


def condition_table(found: CrossValidation) -> PaperTable:
    """Build Table 5: condition number of each run."""
    return PaperTable(
        number=5,
        title="condition number of each run's observation matrix",
        headings=("", *(run.run for run in found.runs)),
        rows=(("cond(W)", *(NONE if run.condition is None else f"{run.condition:.0f}" for run in found.runs)),),
        notes=(
            "The smaller the number, the more evenly the moves show all base parameters. The payload counts as part of "
            "the last link. `plan` allows 3500, and 1e5 for a closed chain.",
        ),
    )


def paper_error_table(found: CrossValidation) -> PaperTable:
    """Build Table 6: relative error of each run and joint by every calibration."""
    labels, axes = tuple(found.calibrations), found.axes
    rows = []
    for run in found.runs:
        errors = [run.errors.get(label) for label in labels]
        for index, axis in enumerate(axes if run.errors else ()):
            cells = (NONE if error is None else percent(error.axes[index]) for error in errors)
            rows.append((f"{run.run}, {axis}", *cells))
    reasons: dict[str, list[str]] = {}
    for run in found.runs:
        if run.left_out:
            reasons.setdefault(run.left_out, []).append(run.run)
    unmet = [f"{', '.join(runs)}: {reason}." for reason, runs in reasons.items()]
    seen = sorted({run.run for run in found.runs if run.seen_by})
    return PaperTable(
        number=6,
        title="relative error norms ‖ρ‖/‖Y‖ [%]",
        headings=("run, joint", *labels),
        rows=(*rows, ("mean", *(percent(_mean_error(found, label)) for label in labels))),
        notes=(*([f"Used by a fit: {', '.join(seen)}."] if seen else ()), *unmet),
    )


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
    return tuple(
        _mass_table(found, name, mounting, 7 + index if index < 2 else 8)
        for index, (name, mounting) in enumerate(payloads)
    )


def _mass_table(found: CrossValidation, name: str, mounting: str, number: int) -> PaperTable:
    runs = [run for run in found.weighed if (run.payload.name, run.payload.mounting) == (name, mounting)]
    labels = dict.fromkeys(label for run in runs for label in run.masses)
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
        rows.append((f"mean {ERROR_ROW}", *(percent(_mean(errors[label])) for label in labels)))
    how = "payload and friction are estimated from this run, the robot is that of the calibration"
    if found.with_bare_runs:
        how = "robot and payload are estimated together, from this run and the runs without load"
    # The label is a key of documents; a reader knows these gains as the nameplate.
    shown = ("nameplate" if label == NAMEPLATE_LABEL and label not in found.calibrations else label for label in labels)
    return PaperTable(
        number=number,
        title=f"mass of payload {name} ({mounting}), {weighed}",
        headings=("run", *shown),
        rows=tuple(rows),
        notes=(
            f"Each column weighs with its own gains: {how}. Gains that find the right mass may still be wrong, because "
            "errors of several axes can cancel.",
            *dict.fromkeys(notes),
        ),
    )


def paper_page(title: str, tables: Iterable[PaperTable], *, marker: str) -> str:
    """Markdown page of tables; its first line names the kind of file, so that no other file is overwritten."""
    return f"<!-- format: {marker} -->\n# {title}\n\n" + "\n".join(table.markdown() for table in tables)


def percent(value: float | None) -> str:
    """Two decimals, none from 100 % on; a dash for an unknown value."""
    if value is None or not math.isfinite(value):
        return NONE
    return f"{value:.2f}" if abs(value) < 99.995 else f"{value:.0f}"


def _parameter(parameter: Parameter | None) -> tuple[str, str]:
    if parameter is None:
        return NONE, NONE
    deviation = percent(100.0 * parameter.std / abs(parameter.value)) if parameter.std and parameter.value else NONE
    return f"{parameter.value:.3g}", deviation


def _in_order(first: list[str], second: list[str]) -> list[str]:
    """Merge two lists of names, keeping the order of each."""
    order = list(first)
    for index, name in enumerate(second):
        if name not in order:
            before = next((n for n in reversed(second[:index]) if n in order), None)
            order.insert(0 if before is None else order.index(before) + 1, name)
    return order


def _mean(values: Sequence[float]) -> float | None:
    usable = [value for value in values if math.isfinite(value)]
    return sum(usable) / len(usable) if usable else None
