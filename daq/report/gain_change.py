"""The gains with their intervals before and after effects joined the model."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from daq.report.picture import BLUE, GREY, ORANGE, grid, legend_below, save_png, unformatted
from ident.before_after import GainChange

_SIGMAS = 2.0
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
