"""`residual.json`: every finding of `drivegain residual`, by stable names (docs/reference/residual-json.md)."""

from __future__ import annotations

from typing import Any

from daq.report.effect_names import placed_name
from daq.report.fit import coefficients
from daq.report.residual import summary, time_skew
from daq.workflow.calibration_file import as_document
from daq.workflow.fit import Fit
from ident.calibration import Calibration
from ident.discovery.before_after import Account, BeforeAfter, Errors, GainChange, LeftOutRuns
from ident.discovery.loop import Step
from ident.discovery.search import Finding
from ident.effects.effect import PlacedEffect
from ident.estimators.estimate import RelativeError

FORMAT = "drivegain-residual"
VERSION = 1
METRIC = (
    "‖e‖/‖v‖ of each motor's current over the rows that count; in total √(Σ w²‖e‖²/Σ w²‖v‖²), w the gains of the "
    "declared model"
)


def residual_document(fitted: Fit, account: Account, calibration: Calibration) -> dict[str, Any]:
    """Build the object of `residual --json`, which is also the body of `residual.json`.

    Args:
        fitted: with the turns of the loop.
        account: of them.
        calibration: with the accepted effects.
    """
    axes = fitted.cell.axis_names
    return {
        **as_document(calibration),
        "summary": list(summary(fitted, account)),
        "axes": list(axes),
        "metric": METRIC,
        "noise_floor": {
            "motors": [
                None
                if floor is None
                else {
                    "axis": axis,
                    "noise": floor.noise_a,
                    "std_percent": floor.std_percent,
                    "dwells": floor.dwells,
                    "degrees_of_freedom": floor.freedom,
                }
                for axis, floor in zip(axes, account.floors, strict=True)
            ],
            "relative_error_percent": _error(account.floor),
            "holdout_error_percent": _error(account.holdout_floor),
        },
        "time_skew": _time_skew(fitted),
        **_before_after(fitted, account.total),
        "turns": [_turn(fitted, step, turn) for step, turn in zip(fitted.steps, account.turns, strict=True)],
    }


def _time_skew(fitted: Fit) -> dict[str, float] | None:
    skew = time_skew(fitted)
    return None if skew is None else {"seconds": skew[0], "std": skew[1]}


def _turn(fitted: Fit, step: Step, turn: BeforeAfter | None) -> dict[str, Any]:
    nothing = {"before": None, "after": None, "gain_changes": None}
    added, removed = ((), ()) if turn is None else (turn.added, turn.removed)
    return {
        "accepted": None if step.accepted is None else _finding(fitted, step.accepted),
        "added": [_effect(fitted, step, placed) for placed in added],
        "removed": [placed_name(placed, fitted.cell.axis_names) for placed in removed],
        **(nothing if turn is None else _before_after(fitted, turn)),
        "findings": [_finding(fitted, finding) for finding in step.findings],
        "structures": [_finding(fitted, finding) for finding in step.structures],
        "detection_limits": [
            {"axis": axis.name, "rms": float(limit), "unit": axis.unit.force}
            for axis, limit in zip(fitted.cell.axes, step.limits_nm, strict=True)
        ],
    }


def _effect(fitted: Fit, step: Step, placed: PlacedEffect) -> dict[str, Any]:
    return {
        "effect": placed.effect.name,
        "axis": fitted.cell.axis_names[placed.axis],
        "settings": {name: float(value) for name, value in placed.effect.settings.items()},
        "coefficients": [
            {"name": c.name, "value": c.value, "std": c.std, "unit": c.unit} for c in coefficients(step.after, placed)
        ],
    }


def _before_after(fitted: Fit, compared: BeforeAfter) -> dict[str, Any]:
    return {
        "before": _errors(compared.before),
        "after": _errors(compared.after),
        "gain_changes": [
            _gain_change(axis.name, axis.gain_unit, change)
            for axis, change in zip(fitted.cell.axes, compared.gains, strict=True)
        ],
    }


def _gain_change(axis: str, unit: str, change: GainChange) -> dict[str, Any]:
    return {
        "axis": axis,
        "unit": unit,
        "before": change.before,
        "before_std": change.before_std,
        "after": change.after,
        "after_std": change.after_std,
        "change_percent": change.change_percent,
        "change_std_percent": change.change_std_percent,
        "significant": change.significant,
    }


def _errors(errors: Errors) -> dict[str, Any]:
    return {
        "relative_error_percent": _error(errors.in_sample),
        "cross_validated_error_percent": _error(errors.cross_validated),
        "left_out_runs": _left_out_runs(errors.left_out_runs),
        "holdout_error_percent": _error(errors.holdout),
    }


def _left_out_runs(left_out: LeftOutRuns | None) -> dict[str, Any] | None:
    if left_out is None:
        return None
    return {
        "error_percent": _error(left_out.together),
        "runs": [
            {"run": run.run, "error_percent": _error(run.error), "reason": run.reason or None} for run in left_out.runs
        ],
    }


def _error(error: RelativeError | None) -> dict[str, Any] | None:
    return None if error is None else {"axes": list(error.axes), "total": error.total}


def _finding(fitted: Fit, finding: Finding) -> dict[str, Any]:
    axes = fitted.cell.axis_names
    return {
        "effect": finding.effect.name,
        "axis": axes[finding.axis],
        "settings": {name: float(value) for name, value in finding.effect.settings.items()},
        "variable": finding.effect.abscissa.value,
        "coefficients": [
            {"name": column.name, "value": float(value), "std": float(std), "unit": column.unit}
            for column, value, std in zip(
                finding.effect.coefficients, finding.coefficients, finding.deviations, strict=True
            )
        ],
        "probability": finding.probability,
        "folds_better": finding.folds_better,
        "explained": finding.explained,
        "error_before_percent": finding.error_before_percent,
        "error_after_percent": finding.error_after_percent,
        "error_fall": finding.error_fall,
        "held_out_fall": finding.held_out_fall,
        "passed": finding.passed,
        "share_of_excess": finding.share_of_excess,
        # For findings that failed a gate it would be most of the file and of no use.
        "ambiguity": [placed_name(rival, axes) for rival in finding.ambiguity] if finding.passed else None,
    }
