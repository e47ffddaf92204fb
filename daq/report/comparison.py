"""Every estimator side by side, and what scaling and filters do to it, for a person and for --json."""

from __future__ import annotations

from typing import Any

from rich import box
from rich.table import Table

from ident.comparison import Comparison, Trial


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
