"""The pictures of a fit: torques as the paper's Fig. 2, the gains, and the residual before and after each effect."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.table import Table

from daq.config.cell import MILLIMETRE, Cell, JointUnit
from daq.report.effect_names import effect_text, other_axis, variable_text
from daq.report.gains import plot_gains
from daq.report.picture import BLACK, QUANTITY, SKY, FloatArray, legend_below, panels, save_png, thinned, unformatted
from daq.report.residual_plots import plot_residual
from daq.workflow.fit import DOUBTFUL_PERCENT, Fit
from drivers.profiles.profile import TapPoint
from ident.calibration import Calibration, Parameter
from ident.discovery.loop import Evidence, without_effects
from ident.effects.effect import PlacedEffect
from ident.effects.signals import Abscissa, fitted_signals, session_began_s
from ident.equations.rows import decimate_rows
from ident.estimators.comparison import Comparison, Trial
from ident.planning.verdict import GOOD_PERCENT, GainVerdict

# Measured against predicted torque of every axis, as the paper's Fig. 2.


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


def draw(fitted: Fit, calibration: Calibration, truth: dict[str, float] | None, out: Path) -> None:
    """Torques of the unused run (paper Fig. 2), residual before and after each effect, and the gains.

    Raises:
        OSError: from the file system.
    """
    before = start_of(fitted)
    final = fitted.steps[-1].after if fitted.steps else before
    draw_torques(out / "torques.png", final, fitted.cell)
    plot_gains(out / "gains.png", calibration.gains, truth, title="Joint drive gains")
    for step in fitted.steps:
        for placed in (placed for placed in step.after.effects if placed not in before.effects):
            name = fitted.cell.axis_names[placed.axis]
            draw_effect(out / f"residual-{name}-{placed.effect.name}.png", before, step.after, placed, fitted.cell)
        before = step.after


def start_of(fitted: Fit) -> Evidence:
    """The rows under the declared model; the logs are read again only where nobody has kept them.

    Raises:
        DataError: a log cannot be read any more.
    """
    if not fitted.steps:
        return fitted.evidence()
    return without_effects(fitted.steps[0].after, fitted.identification.estimate)


def draw_torques(path: Path | None, final: Evidence, cell: Cell) -> bytes:
    """Measured against predicted torque of the first run held out, or of the fit.

    Raises:
        OSError: from the file system.
    """
    rows = final.training if final.holdout is None else final.holdout
    rows = rows.only(rows.run == rows.run[0])
    measured = np.where(rows.use, rows.torque(final.estimate.gains), np.nan).T
    predicted = np.where(rows.use, final.estimate.predicted_torque(rows), np.nan).T
    which = "a run not used in the fit" if final.holdout is not None else "the first run of the fit"
    forces = tuple(axis.unit.force for axis in cell.axes)
    title = f"Joint torques of {which}"
    return plot_torques(path, rows.time_s, measured, predicted, cell.axis_names, title=title, forces=forces)


def draw_effect(path: Path | None, before: Evidence, after: Evidence, placed: PlacedEffect, cell: Cell) -> bytes:
    """The residual of an effect's axis before and after it joined the model, on the first run held out, or of the fit.

    Raises:
        OSError: from the file system.
    """
    index = len(after.trained) if after.held_out else 0
    rows_before = before.holdout if before.holdout is not None else before.training
    rows_after = after.holdout if after.holdout is not None else after.training
    chosen, data = rows_after.run == index, after.datasets[index]
    seen = fitted_signals(after.model, data, after.training, after.estimate, session_began_s(after.trained))
    along = seen.variable(placed.effect.abscissa, placed.axis, other_axis(placed.effect))
    variable, velocity = (
        decimate_rows(data, rows_after.conditioning, column[None])[0]
        for column in (along, data.velocity_rad_s[:, placed.axis])
    )
    use = rows_after.use[placed.axis, chosen]
    residuals = (
        np.where(use, model.estimate.residual_torque(rows)[placed.axis, chosen], np.nan)
        for model, rows in ((before, rows_before), (after, rows_after))
    )
    name, unit = cell.axes[placed.axis].name, cell.axes[placed.axis].unit
    return plot_residual(
        path,
        rows_after.time_s[chosen],
        *residuals,
        variable=variable,
        variable_label=_label(placed, cell.axis_names, unit),
        velocity_rad_s=velocity,
        title=f"{name}: {effect_text(placed.effect, cell.axis_names)}, run {data.name}",
        force=unit.force,
    )


def _label(placed: PlacedEffect, axes: tuple[str, ...], unit: JointUnit) -> str:
    """The variable with its unit at this joint: what acts on a prismatic one is a force, and its position is in m."""
    abscissa = placed.effect.abscissa
    words, _, measure = abscissa.value.partition(" [")
    label = f"{variable_text(placed.effect, axes) if other_axis(placed.effect) is not None else words} [{measure}"
    if unit is not MILLIMETRE or abscissa in {Abscissa.MOTOR_ANGLE, Abscissa.CURRENT, Abscissa.OTHER_VELOCITY}:
        return label
    return label.replace("rad", "m").replace("Nm", "N").replace("torque", "force")


# What the recorded current is, in words: a gain by the actual current is not one by the reference.


def current_signals(cell: Cell) -> dict[str, str]:
    """Of each axis with an amplifier: "current reference 6074h:00, rms" or "ACTUAL current 6077h:00, unstated"."""
    return {
        axis.name: f"{axis.profile.signal}, amplitude {axis.profile.amplitude.value}"
        for axis in cell.axes
        if axis.profile is not None
    }


def actual_current_note(cell: Cell) -> str | None:
    """A warning where an axis has no current reference, None where every axis has one."""
    actual = [axis for axis in cell.axes if axis.profile is not None and axis.profile.tap is TapPoint.ACTUAL]
    if not actual:
        return None
    drives = ", ".join(dict.fromkeys(axis.profile.name for axis in actual if axis.profile is not None))
    return (
        f"{', '.join(axis.name for axis in actual)}: ACTUAL current, not the reference ({drives} has none to log): its "
        "gains are Nm per A of actual current"
    )


# What a fit says of the coefficients of an effect in it.


def coefficients(evidence: Evidence, placed: PlacedEffect) -> tuple[Parameter, ...]:
    """The linear parameters of an effect with their σ, by their short names; empty where it is not in the model."""
    estimate = evidence.estimate
    index = {column.name: number for number, column in enumerate(estimate.unknowns)}
    return tuple(
        Parameter(
            short.name,
            float(estimate.parameters[index[whole.name]]),
            float(estimate.parameters_std[index[whole.name]]),
            whole.unit,
        )
        for short, whole in zip(placed.effect.coefficients, placed.columns, strict=True)
        if whole.name in index
    )


# What the data of a fit cannot tell, and by what they tell each gain, in words.


def identifiability_notes(fitted: Fit) -> tuple[str, ...]:
    """What no residual of these data could show, in words."""
    if fitted.estimate.gains_fixed:
        return ()
    mounted = {payload.mounting for payload in fitted.identification.system.payloads}
    known = [payload for payload in fitted.cell.payloads if payload.payload.mounting in mounted]
    scales = [
        f"{payload.name} was weighed to {payload.mass_kg:g} kg ± {payload.mass_tolerance_kg:g} kg, which is "
        f"± {100.0 * payload.mass_tolerance_kg / payload.mass_kg:.2g} % of every gain, not in σ"
        for payload in known
        if payload.mass_tolerance_kg > 0.0
    ]
    drawn = [payload.name for payload in fitted.identification.system.payloads if len(payload.known) > 1]
    return (
        *(
            (
                f"Of {', '.join(drawn)} more than the mass is taken as exact. A drawing that is off by some per cent "
                "moves the gains by as much, and no σ says so: compare with --known mass, the better in the paper.",
            )
            if drawn
            else ()
        ),
        "What these data cannot tell: a wrong payload mass scales all gains alike and leaves no residual"
        + (f" ({'; '.join(scales)}); " if scales else "; ")
        + "so does a wrong value of gravity; a gear efficiency that is the same in "
        "both directions is part of its gain.",
    )


def advice(fitted: Fit, judged: tuple[GainVerdict, ...]) -> tuple[str, ...]:
    """By what each gain is seen and what would help, where one is known worse than to a per cent."""
    if fitted.estimate.gains_fixed:
        return ()
    error = fitted.final.training_error.total
    if error > DOUBTFUL_PERCENT:
        return (
            f"DOUBTFUL: the model leaves {error:.3g} % of the torque, expected some 3 to 15 %. No σ tells how wrong "
            "the gains are then: channels, signs, drive train, gravity or payload are not as the cell file says.",
        )
    if not judged:
        return (f"Excitation: every gain is known to {GOOD_PERCENT:g} % or better.",)
    return ("Excitation:", *(f"  {gain.words(fitted.cell.axis_names[gain.axis])}" for gain in judged))


def verdict_document(gain: GainVerdict, axes: tuple[str, ...]) -> dict[str, Any]:
    """One gain's verdict, for --json."""
    return {
        "axis": axes[gain.axis],
        "std_percent": gain.std_percent,
        "verdict": gain.verdict.value,
        "seen_by": [source.value for source in gain.sources],
        "words": gain.words(axes[gain.axis]),
    }


# Every estimator side by side, and what scaling and filters do to it, for a person and for --json.


def comparison_tables(comparison: Comparison, axes: tuple[str, ...]) -> tuple[Table, Table]:
    """Gains under the declared filters, and by how much they change between half and twice the cut-offs.

    Args:
        comparison: of all estimators.
        axes: names, one a gain.
    """
    first = comparison.trials[0]
    filters = f"{first.position_cutoff_hz:g} Hz / {first.decimation_cutoff_hz:g} Hz"
    gains = _table(f"Gains by every estimator, filters {filters}", (*axes, "‖ρ‖/‖Y‖ %"))
    spreads = _table("Spread of the gains between half and twice these cut-offs [%]", axes)
    for trial in comparison.declared:
        if trial.gains is None:
            gains.add_row(trial.estimator, *("-" for _ in axes), trial.reason)
        else:
            values = (f"{gain:.4g}" for gain in trial.gains)
            gains.add_row(trial.estimator, *values, f"{trial.relative_error_percent:.2f}")
        spread = comparison.spread_percent(trial.estimator)
        spreads.add_row(trial.estimator, *("-" if spread is None else f"{spread[i]:.2f}" for i in range(len(axes))))
    return gains, spreads


def _table(title: str, headings: tuple[str, ...]) -> Table:
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    table.add_column("estimator", no_wrap=True)
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    return table


def comparison_document(comparison: Comparison, axes: tuple[str, ...]) -> list[dict[str, Any]]:
    """All trials, for --json."""
    return [_trial(trial, axes) for trial in comparison.trials]


def _trial(trial: Trial, axes: tuple[str, ...]) -> dict[str, Any]:
    document: dict[str, Any] = {
        "estimator": trial.estimator,
        "position_cutoff_hz": trial.position_cutoff_hz,
        "decimation_cutoff_hz": trial.decimation_cutoff_hz,
    }
    if trial.gains is None or trial.std is None:
        return {**document, "gains": None, "reason": trial.reason}
    gains = [
        {"axis": axis, "value": float(value), "std_percent": 100.0 * float(std / abs(value))}
        for axis, value, std in zip(axes, trial.gains, trial.std, strict=True)
    ]
    return {**document, "gains": gains, "relative_error_percent": trial.relative_error_percent}
