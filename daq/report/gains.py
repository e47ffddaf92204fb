"""The picture of the gains: how far each is from its nameplate, ± σ, and the truth of a simulated cell."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from rich import box
from rich.table import Table
from rich.text import Text

from daq.report.picture import BLUE, GREEN, GREY, ORANGE, grid, legend_below, save_png, unformatted
from daq.report.text import terminal_text
from ident.calibration import Calibration, Gain
from ident.discovery.before_after import GainChange

_SIGMAS = 2.0


def plot_gains(path: Path, gains: tuple[Gain, ...], truth: Mapping[str, float] | None = None, *, title: str) -> None:
    """Draw how far each identified gain is from its nameplate, with its uncertainty.

    Gains of different axes differ by an order of magnitude and may be negative, so all are shown in percent.

    Args:
        path: of the PNG.
        gains: one an axis.
        truth: true gain by axis, for a simulated cell only.
        title: says which cell it is.

    Raises:
        OSError: from the file system.
    """
    figure, ((place,),) = grid(1, (1.0,), title, height_in=3.2)
    positions = np.arange(len(gains))
    change = np.array([gain.change_percent for gain in gains])
    width = np.array([_SIGMAS * 100.0 * gain.std / abs(gain.nameplate) for gain in gains])
    place.axhline(0.0, color=GREY, linewidth=1.4, linestyle="--", label="nameplate")
    place.vlines(positions, 0.0, change, color=BLUE, linewidth=5, alpha=0.25)
    place.errorbar(
        positions, change, yerr=width, fmt="o", color=BLUE, capsize=6, markersize=5, label=f"identified ± {_SIGMAS:g} σ"
    )
    if truth is not None:
        true = [100.0 * (truth[gain.axis] / gain.nameplate - 1.0) for gain in gains]
        # Beside the estimate, or one would cover the other.
        place.plot(positions + 0.14, true, "D", color=GREEN, markersize=5, label="truth of the simulated cell")
    place.set_xticks(positions, [f"{gain.axis}\n{gain.value:.4g} {gain.unit}" for gain in gains])
    place.set_xlim(-0.6, len(gains) - 0.4)
    place.margins(y=0.15)
    place.set_ylabel("change from the nameplate [%]", fontsize=8)
    legend_below(figure, place)
    save_png(figure, path)


# The table of the gains: a priori, identified ± σ, and the error where the truth is known.


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


# The gains with their intervals before and after effects joined the model.


_BESIDE = 0.12


def plot_gain_changes(
    path: Path | None, changes: tuple[GainChange, ...], axes: tuple[str, ...], *, title: str
) -> bytes:
    """Draw each gain before and after, in per cent of the one before, with the interval of either.

    The two share their noise: whether a change is more than noise is told by the σ of the change, not by whether the
    intervals overlap; axes where it is are starred.

    Args:
        path: of the PNG; None where its bytes alone are wanted.
        changes: one an axis.
        axes: their names.
        title: says which cell it is.

    Returns:
        the PNG.

    Raises:
        OSError: from the file system.
    """
    figure, ((place,),) = grid(1, (1.0,), unformatted(title), height_in=2.8)
    places = np.arange(len(changes))
    scale = np.array([100.0 / abs(change.before) for change in changes])
    after = np.array([change.change_percent for change in changes])
    place.axhline(0.0, color=GREY, linewidth=0.8)
    kinds = (
        ("before", ORANGE, "s", -_BESIDE, np.zeros(len(changes)), np.array([c.before_std for c in changes])),
        ("after", BLUE, "o", _BESIDE, after, np.array([c.after_std for c in changes])),
    )
    for label, colour, marker, beside, values, std in kinds:
        place.errorbar(
            places + beside,
            values,
            yerr=_SIGMAS * std * scale,
            fmt=marker,
            color=colour,
            capsize=5,
            markersize=5,
            label=f"{label} ± {_SIGMAS:g} σ",
        )
    names = [f"{name} *" if change.significant else name for name, change in zip(axes, changes, strict=True)]
    place.set_xticks(places, [unformatted(name) for name in names])
    place.set_xlim(-0.6, len(changes) - 0.4)
    place.margins(y=0.15)
    place.set_ylabel("change of the gain [%]", fontsize=8)
    legend_below(figure, place)
    return save_png(figure, path)
