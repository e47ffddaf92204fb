"""`residual.json`: everything that `drivegain residual` found, by stable names (docs/reference/residual-json.md)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from daq.report.effect_names import effect_text, is_unnamed, placed_name
from daq.report.fit import coefficients
from daq.workflow.calibration_file import as_document
from daq.workflow.fit import Fit
from ident.calibration import Calibration
from ident.discovery.before_after import Account, BeforeAfter, Errors, GainChange
from ident.discovery.current_error import LeftOutRuns
from ident.discovery.loop import MAX_EFFECTS, Step
from ident.discovery.search import Finding
from ident.effects.effect import PlacedEffect, Side
from ident.effects.timing import TimeSkew
from ident.estimators.estimate import RelativeError

# What the closing of the loop came to, in words that need no other page.


ErrorRow = tuple[str, RelativeError]
"""What is measured on what, and the error [%]."""
WHEN = ("before", "after")


def summary(fitted: Fit, account: Account) -> tuple[str, ...]:
    """Sentences: one for each accepted effect, the whole, the gains, and what would have been found.

    Args:
        fitted: with the turns of the loop.
        account: of them.
    """
    kept = fitted.steps[-1].after.effects
    found = tuple(
        _effect_sentence(fitted, account, turn, placed, step.accepted.share_of_excess)
        for step, turn in zip(fitted.steps, account.turns, strict=True)
        if step.accepted is not None and turn is not None
        for placed in turn.added
        if placed in kept
    )
    if not found:
        error, where = strictest_error(account.total.after)
        return (
            f"No structure found: the error {where} is {error.total:.1f} %{_of_all(account)}.",
            _silence(fitted),
            *_skew_sentence(fitted),
        )
    (before, _), (after, where) = strictest_error(account.total.before), strictest_error(account.total.after)
    return (
        *found,
        f"All axes together: the error {where} {error_change_text(before.total, after.total)}{_of_all(account)}.",
        *(() if fitted.estimate.gains_fixed else (_gains_sentence(fitted.cell.axis_names, account.total.gains),)),
        _silence(fitted),
        *_skew_sentence(fitted),
    )


def time_skew(fitted: Fit) -> tuple[float, float] | None:
    """How much later currents were sampled than positions, on all axes alike, and its σ [s]; None where unknown.

    Of the last turn, where no accepted effect stands for it any more.
    """
    skews = [finding for finding in fitted.steps[-1].findings if finding.effect == TimeSkew()]
    return None if not skews else (float(skews[0].coefficients[0]), float(skews[0].deviations[0]))


def _skew_sentence(fitted: Fit) -> tuple[str, ...]:
    skew = time_skew(fitted)
    if skew is None:
        return ()
    seconds, std = skew
    beside = " beside the effects found" if fitted.steps[-1].after.effects else ""
    return (
        f"Currents were sampled {1e3 * abs(seconds):.2f} ± {1e3 * std:.2f} ms {'after' if seconds > 0 else 'before'} "
        f"the positions on all axes alike{beside}.",
    )


def error_rows(account: Account) -> tuple[ErrorRow, ...]:
    """The rows of the table of errors; what nobody asked for or nobody knows is left out."""
    before, after = account.total.before, account.total.after
    pairs = (
        ("fit", before.in_sample, after.in_sample),
        ("moves left out", before.cross_validated, after.cross_validated),
        ("runs left out", _together(before), _together(after)),
        ("unused", before.holdout, after.holdout),
    )
    floors = (("noise floor", account.floor), ("noise floor, unused", account.holdout_floor))
    named = [(f"{name}, {when}", error) for name, *both in pairs for when, error in zip(WHEN, both, strict=True)]
    return tuple(
        (name, error) for name, error in (*named, *floors) if error is not None and any(map(math.isfinite, error.axes))
    )


def percent_text(percent: float) -> str:
    """Two decimals; a dash for what is not known."""
    return f"{percent:.2f}" if math.isfinite(percent) else "-"


def strictest_error(errors: Errors) -> tuple[RelativeError, str]:
    """The error that has seen least of what it is measured on, and on what that was."""
    if errors.holdout is not None:
        return errors.holdout, "on runs that were not used"
    if errors.left_out_runs is not None and errors.left_out_runs.together is not None:
        return errors.left_out_runs.together, "on runs left out in turn"
    return errors.cross_validated, "on moves left out in turn"


def error_change_text(before_percent: float, after_percent: float) -> str:
    """`falls from 6.9 to 2.8 %`; what rises is said to."""
    before, after = f"{before_percent:.1f}", f"{after_percent:.1f}"
    if before == after:
        return f"stays at {after} %"
    return f"{'falls' if after_percent < before_percent else 'rises'} from {before} to {after} %"


def _effect_sentence(
    fitted: Fit, account: Account, turn: BeforeAfter, placed: PlacedEffect, share_of_excess: float | None
) -> str:
    axes = fitted.cell.axis_names
    name = axes[placed.axis]
    (before, _), (after, where) = strictest_error(turn.before), strictest_error(turn.after)
    floor = _floor(account).axes[placed.axis]
    floor_text = f"noise floor {floor:.1f} %" if math.isfinite(floor) else "noise floor not known"
    excess = ""
    if is_unnamed(placed.effect) and share_of_excess is not None:
        excess = f" ({100.0 * share_of_excess:.0f} % of what the model leaves beyond noise)"
    if placed.effect.side is Side.ALL_MOTORS:
        before_all, after_all = (strictest_error(errors)[0].total for errors in (turn.before, turn.after))
        change = error_change_text(before_all, after_all)
        return f"The recording has {effect_text(placed.effect, axes)}: the error {where} {change}."
    return (
        f"{name} has {effect_text(placed.effect, axes)}{excess}: the error of {name} {where} "
        f"{error_change_text(before.axes[placed.axis], after.axes[placed.axis])} ({floor_text})."
    )


def _floor(account: Account) -> RelativeError:
    """Of the rows that `strictest_error` speaks of."""
    return account.floor if account.holdout_floor is None else account.holdout_floor


def _of_all(account: Account) -> str:
    floor = _floor(account).total
    return f" (noise floor {floor:.1f} %)" if math.isfinite(floor) else ""


def _gains_sentence(axes: Sequence[str], changes: Sequence[GainChange]) -> str:
    parts = [
        f"{axis} by {change.change_percent:+.1f} %"
        for axis, change in zip(axes, changes, strict=True)
        if change.significant
    ]
    if not parts:
        return "No drive gain changes by more than noise."
    return f"Drive gains that change by more than noise: {', '.join(parts)}."


def _silence(fitted: Fit) -> str:
    last = fitted.steps[-1]
    if last.accepted is not None:
        return (
            f"The search ended after {MAX_EFFECTS} effects with more to find: look at the declared model first "
            "(drive train, payload, channels)."
        )
    limits = ", ".join(
        f"{limit:.2g} {axis.unit.force} on {axis.name}"
        for axis, limit in zip(fitted.cell.axes, last.limits_nm, strict=True)
    )
    ended = f"The search ended early: {last.ended}. " if last.ended else ""
    return (
        f"{ended}An effect that the declared model cannot mimic would have been found above this torque (root mean "
        f"square in motion): {limits}."
    )


def _together(errors: Errors) -> RelativeError | None:
    return None if errors.left_out_runs is None else errors.left_out_runs.together


FORMAT = "drivegain-residual"
VERSION = 1
METRIC = (
    "‖e‖/‖v‖ of each motor's current over the rows that count; in total √(Σ w²‖e‖²/Σ w²‖v‖²), w the gains of the "
    "declared model"
)


def residual_document(fitted: Fit, account: Account, calibration: Calibration) -> dict[str, Any]:
    """The object of `residual --json`, and the body of `residual.json`.

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
        # Of what has a closed gate nobody asks it, and all pairs would be most of the file.
        "ambiguity": [placed_name(rival, axes) for rival in finding.ambiguity] if finding.passed else None,
    }
