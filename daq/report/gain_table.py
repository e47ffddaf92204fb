"""The table of the gains: a priori, identified ± σ, and the error where the truth is known."""

from __future__ import annotations

import math
from collections.abc import Mapping

from rich import box
from rich.table import Table
from rich.text import Text

from daq.report.terminal_text import terminal_text
from ident.calibration import Calibration, Gain


def gain_table(gains: tuple[Gain, ...], truth: Mapping[str, float] | None = None, *, title: str | None = None) -> Table:
    """One row an axis; fits a terminal of 80 columns.

    Args:
        gains: one an axis.
        truth: true gain by axis, for a simulated cell only.
        title: over the table.
    """
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    table.add_column("axis", no_wrap=True)
    headings = ["a priori", "identified ± σ", "σ %", "change %"] + ([] if truth is None else ["truth", "error %"])
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    for gain in gains:
        row: list[str | Text] = [
            terminal_text(gain.axis),
            f"{gain.nameplate:.4g}",
            with_deviation(gain.value, gain.std),
            f"{gain.std_percent:.2f}" if gain.std else "-",
            f"{gain.change_percent:+.1f}",
        ]
        if truth is not None:
            row += [f"{truth[gain.axis]:.4g}", f"{100.0 * (gain.value / truth[gain.axis] - 1.0):+.2f}"]
        table.add_row(*row, terminal_text(gain.unit))
    return table


def partial_note(calibration: Calibration) -> str | None:
    """What to say of a calibration that rests on a log that never finished, or lost frames."""
    partial = [source.name for source in calibration.sources if source.partial]
    return (
        f"PARTIAL or lossy data ({', '.join(partial)}): not for a controller; `apply` refuses it." if partial else None
    )


def with_deviation(value: float, std: float) -> str:
    """`33.90 ± 0.14`: both to the second digit of σ (ISO Guide 98-3, 7.2.6); `32.96 (fixed)` where σ is 0."""
    if std == 0:
        return f"{value:.4g} (fixed)"
    if not math.isfinite(std) or std < 0:
        return f"{value:.4g} ± {std:g}"
    decimals = max(1 - math.floor(math.log10(std)), 0)
    return f"{value:.{decimals}f} ± {std:.{decimals}f}"
