"""The picture of the gains: how far each is from its nameplate, ± σ, and the truth of a simulated cell."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from daq.report.picture import BLUE, GREEN, GREY, grid, legend_below, save_png
from ident.calibration import Gain

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
