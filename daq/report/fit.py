"""The pictures of a fit: torques as the paper's Fig. 2, the gains, and the residual before and after each effect."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from daq.configuration.cell import Cell
from daq.configuration.joint_unit import MILLIMETRE, JointUnit
from daq.fit import Fit
from daq.report.gains import plot_gains
from daq.report.picture import FloatArray
from daq.report.residual import plot_residual
from daq.report.torque import plot_torques
from ident.calibration import Calibration
from ident.effects.effect import Abscissa
from ident.loop import Evidence
from ident.rows import decimate_rows
from ident.signals import Signals, signals


def draw(fitted: Fit, calibration: Calibration, truth: dict[str, float] | None, out: Path) -> None:
    """Torques of the unused run (paper Fig. 2), residual before and after each effect, and the gains.

    Raises:
        OSError: from the file system.
    """
    before = fitted.evidence()
    final = fitted.steps[-1].after if fitted.steps else before
    names = fitted.cell.axis_names
    rows = final.holdout if final.holdout is not None else final.training.only(final.training.run == 0)
    measured = np.where(rows.use, rows.torque(final.estimate.gains), np.nan).T
    predicted = np.where(rows.use, final.estimate.predicted_torque(rows), np.nan).T
    which = "a run not used in the fit" if final.holdout is not None else "the first run of the fit"
    forces = tuple(axis.unit.force for axis in fitted.cell.axes)
    title = f"Joint torques of {which}"
    plot_torques(out / "torques.png", rows.time_s, measured, predicted, names, title=title, forces=forces)
    plot_gains(out / "gains.png", calibration.gains, truth, title="Joint drive gains")
    for step in fitted.steps:
        if step.accepted is not None:
            _draw_effect(before, step.after, fitted.cell, out)
            before = step.after


def _draw_effect(before: Evidence, after: Evidence, cell: Cell, out: Path) -> None:
    placed = after.effects[-1]
    index = len(after.datasets) - after.held_out if after.held_out else 0
    rows_before = before.holdout if before.holdout is not None else before.training
    rows_after = after.holdout if after.holdout is not None else after.training
    chosen = rows_after.run == index
    data = after.datasets[index]
    seen = signals(after.model, data, after.training, after.estimate)
    variable, velocity = (
        decimate_rows(data, rows_after.conditioning, column[None])[0]
        for column in (_along(placed.effect.abscissa, seen, placed.axis), data.velocity_rad_s[placed.axis])
    )
    use = rows_after.use[placed.axis, chosen]
    residuals = (
        np.where(use, identification.estimate.residual_torque(rows)[placed.axis, chosen], np.nan)
        for identification, rows in ((before, rows_before), (after, rows_after))
    )
    name, unit = cell.axes[placed.axis].name, cell.axes[placed.axis].unit
    plot_residual(
        out / f"residual-{name}-{placed.effect.name}.png",
        rows_after.time_s[chosen],
        *residuals,
        variable=variable,
        variable_label=_label(placed.effect.abscissa, unit),
        velocity_rad_s=velocity,
        title=f"{name}: {placed.effect.name}, run {data.name}",
        force=unit.force,
    )


def _label(abscissa: Abscissa, unit: JointUnit) -> str:
    """The variable with its unit at this joint: what acts on a prismatic one is a force, and its position is in m."""
    label: str = abscissa.value
    if unit is not MILLIMETRE or abscissa in {Abscissa.MOTOR_ANGLE, Abscissa.CURRENT}:
        return label
    return label.replace("rad", "m").replace("Nm", "N").replace("torque", "force")


def _along(abscissa: Abscissa, signals: Signals, axis: int) -> FloatArray:
    """The variable that a picture is drawn along, shape (k,)."""
    rate = np.gradient(signals.motor_torque_nm[axis]) * signals.rate_hz
    variables: dict[Abscissa, FloatArray] = {
        Abscissa.VELOCITY: signals.velocity_rad_s[axis],
        Abscissa.POSITION: signals.position_rad[axis],
        Abscissa.LOAD: signals.load_torque_nm[axis],
        Abscissa.MOTOR_ANGLE: np.mod(signals.motor_position_rad[axis], 2.0 * np.pi),
        Abscissa.CURRENT: signals.current_a[axis],
        Abscissa.TORQUE_RATE: np.asarray(rate),
    }
    return variables[abscissa]
