"""Every estimator side by side, and what scaling and filters do to it, for a person and for --json."""

from __future__ import annotations

from typing import Any

from rich import box
from rich.table import Table

from ident.comparison import Comparison, Trial


def comparison_table(comparison: Comparison, axes: tuple[str, ...]) -> Table:
    """Gains under the declared filters, and by how much they change between half and twice the cut-offs.

    Args:
        comparison: of all estimators.
        axes: names, one a gain.
    """
    first = comparison.trials[0]
    filters = f"filters {first.position_cutoff_hz:g} Hz / {first.decimation_cutoff_hz:g} Hz"
    table = Table(
        title=f"Gains by every estimator ({filters}; in brackets, the spread between half and twice these cut-offs)",
        title_justify="left",
        box=box.SIMPLE_HEAD,
        show_edge=False,
        pad_edge=False,
    )
    table.add_column("estimator")
    for axis in axes:
        table.add_column(axis, justify="right", no_wrap=True)
    table.add_column("‖ρ‖/‖Y‖ [%]", justify="right", no_wrap=True)
    for trial in comparison.declared:
        if trial.gains is None:
            table.add_row(trial.estimator, *("-" for _ in axes), trial.reason)
            continue
        spread = comparison.spread_percent(trial.estimator)
        cells = (
            f"{gain:.4g} ({'-' if spread is None else f'{spread[index]:.1f} %'})"
            for index, gain in enumerate(trial.gains)
        )
        table.add_row(trial.estimator, *cells, f"{trial.relative_error_percent:.2f}")
    return table


def comparison_document(comparison: Comparison, axes: tuple[str, ...]) -> list[dict[str, Any]]:
    """All trials, for --json."""
    return [_trial(trial, axes) for trial in comparison.trials]


def _trial(trial: Trial, axes: tuple[str, ...]) -> dict[str, Any]:
    told: dict[str, Any] = {
        "estimator": trial.estimator,
        "position_cutoff_hz": trial.position_cutoff_hz,
        "decimation_cutoff_hz": trial.decimation_cutoff_hz,
    }
    if trial.gains is None or trial.std is None:
        return {**told, "gains": None, "reason": trial.reason}
    gains = [
        {"axis": axis, "value": float(value), "std_percent": 100.0 * float(std / abs(value))}
        for axis, value, std in zip(axes, trial.gains, trial.std, strict=True)
    ]
    return {**told, "gains": gains, "relative_error_percent": trial.relative_error_percent}
