"""Measured against predicted torque of every axis, as the paper's Fig. 2."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from daq.report.picture import BLACK, QUANTITY, SKY, FloatArray, legend_below, panels, save_png, thinned, unformatted


def plot_torques(
    path: Path | None,
    time_s: FloatArray,
    measured_nm: FloatArray,
    predicted_nm: FloatArray,
    axes: tuple[str, ...],
    *,
    title: str,
    forces: tuple[str, ...] = (),
    shown_s: float = 10.0,
) -> bytes:
    """Draw τ = V g with the identified gains (full) and the model's τ (dotted), one panel an axis.

    The relative error over each panel is that of the whole run, not only of what is drawn.

    Args:
        path: of the PNG; None where its bytes alone are wanted.
        time_s: shape (k,) [s].
        measured_nm: torque from current and identified gain, shape (k, n) [forces]; NaN where a row was left out.
        predicted_nm: torque from the model, same shape [forces].
        axes: names of the n axes.
        title: says which run it is.
        forces: "Nm" or, along a prismatic joint, "N", for each axis; all are "Nm" when left out.
        shown_s: length of the stretch that is drawn, from the beginning [s]; longer ones hide the model in the lines.

    Returns:
        the PNG.

    Raises:
        OSError: from the file system.
    """
    shown = time_s <= time_s[0] + shown_s
    whole_s = float(time_s[-1] - time_s[0])
    extent = f", first {shown_s:g} s of {whole_s:.0f} s" if whole_s > shown_s else ""
    figure, places = panels(
        len(axes), 2, f"{unformatted(title)}{extent}\ngaps: samples left out, most of them at standstill"
    )
    units = forces or ("Nm",) * len(axes)
    for index, (name, unit, place) in enumerate(zip(axes, units, places, strict=True)):
        measured, predicted = measured_nm[shown, index], predicted_nm[shown, index]
        place.plot(*thinned(time_s[shown], measured), color=SKY, linewidth=2.4, label="current × identified gain")
        place.plot(*thinned(time_s[shown], predicted), color=BLACK, linewidth=1.5, linestyle=":", label="model")
        both = np.isfinite(measured_nm[:, index]) & np.isfinite(predicted_nm[:, index])
        error = _relative_error_percent(measured_nm[both, index], predicted_nm[both, index])
        place.set_title(f"{unformatted(name)}   relative error {error:.1f} %", fontsize=9, loc="left")
        place.set_ylabel(f"{QUANTITY[unit]} [{unit}]", fontsize=8)
        if index >= len(axes) - 2:
            place.set_xlabel("time [s]", fontsize=8)
    legend_below(figure, places[0])
    return save_png(figure, path)


def _relative_error_percent(measured: FloatArray, predicted: FloatArray) -> float:
    """‖ρ‖/‖Y‖ (paper, Table 6) of what is drawn [%]; NaN where nothing is."""
    norm = float(np.linalg.norm(measured))
    return 100.0 * float(np.linalg.norm(measured - predicted)) / norm if norm else float("nan")
