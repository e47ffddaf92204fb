"""A proposed change of a controller's file: for a person as a table and a diff, for a program as a document."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from rich import box
from rich.console import Console
from rich.syntax import Syntax
from rich.table import Table

from daq.report.gain_table import with_deviation
from daq.report.terminal_text import terminal_lines, terminal_text
from daq.write_back.apply import Proposal
from daq.write_back.controller_write import Written
from daq.write_back.gain_gates import GainChange
from ident.drift import FALSE_ALARM, ChangeDecision, decide

_NOTHING_KNOWN: Mapping[str, float] = {}


def show(proposal: Proposal, console: Console, stds_in_file: Mapping[str, float] = _NOTHING_KNOWN) -> None:
    """The change as a table and as a diff; `stds_in_file` as of `significant`."""
    console.print(change_table(proposal.changes, stds_in_file))
    exact = [change.axis for change in proposal.changes if not stds_in_file.get(change.axis)]
    whose = "all axes" if len(exact) == len(proposal.changes) else ", ".join(exact)
    taken = f"the number in the file taken as exact ({whose})" if exact else "σ of both"
    told = f"* more than noise: probability below {100 * FALSE_ALARM:g} % among all axes, {taken}"
    console.print(terminal_text(told), style="dim")
    console.print()
    if proposal.diff:
        console.print(Syntax(terminal_lines(proposal.diff), "diff", background_color="default", word_wrap=True))


def change_table(changes: tuple[GainChange, ...], stds_in_file: Mapping[str, float] = _NOTHING_KNOWN) -> Table:
    """Old and new gain of each axis with what there is to judge the change by; fits a terminal of 80 columns.

    Args:
        changes: one an axis.
        stds_in_file: as of `significant`.
    """
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, collapse_padding=True)
    table.add_column("axis", no_wrap=True)
    for heading in ("in the file", "identified ± σ", "σ %", "Δ %", "Δ in σ", "nameplate", "off %"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    beyond_noise = significant(changes, stds_in_file)
    for change in changes:
        table.add_row(
            terminal_text(change.axis),
            f"{change.old:.5g}",
            with_deviation(change.new, change.std),
            f"{change.std_percent:.2f}",
            f"{change.change_percent:+.1f}",
            f"{_sigmas(change, stds_in_file):.1f} {'*' if change.axis in beyond_noise else ' '}",
            f"{change.nameplate:.5g}",
            f"{change.nameplate_percent:+.1f}",
            terminal_text(change.unit),
        )
    return table


def significant(changes: tuple[GainChange, ...], stds_in_file: Mapping[str, float] = _NOTHING_KNOWN) -> frozenset[str]:
    """Axes whose gain differs from the controller's by more than noise (`ident.drift`).

    Args:
        changes: one an axis.
        stds_in_file: σ of the numbers that are in the controller now, by axis [unit of the gain]; one that is not
            there, or 0, is taken as exact: somebody has entered it, or nothing is known of it.
    """
    comparable = [
        change
        for change in changes
        if all(map(math.isfinite, (change.old, change.new, change.std))) and change.std >= 0.0
    ]
    if not comparable:
        return frozenset()
    found: ChangeDecision = decide(
        tuple(change.axis for change in comparable),
        [change.old for change in comparable],
        [stds_in_file.get(change.axis, 0.0) for change in comparable],
        [change.new for change in comparable],
        [change.std for change in comparable],
    )
    return frozenset(axis for axis, p in zip(found.axes, found.adjusted, strict=True) if p <= FALSE_ALARM)


def _sigmas(change: GainChange, stds_in_file: Mapping[str, float]) -> float:
    """Change over σ of both; inf for a gain that was held fixed."""
    std = math.hypot(change.std, stds_in_file.get(change.axis, 0.0))
    return abs(change.new - change.old) / std if change.std else math.inf


def describe(
    proposal: Proposal, written: Written | None, stds_in_file: Mapping[str, float] = _NOTHING_KNOWN
) -> dict[str, Any]:
    """The proposal and its outcome for --json; `stds_in_file` as of `significant`."""
    beyond_noise = significant(proposal.changes, stds_in_file)
    return {
        "file": str(proposal.file),
        "base_sha256": proposal.base_sha256,
        "applied": written is not None,
        "backup": None if written is None else str(written.backup),
        "changes": [
            {
                "axis": change.axis,
                "key": change.key,
                "line": change.line,
                "old": change.old,
                "new": change.new,
                "change_percent": change.change_percent,
                "change_sigmas": _sigmas(change, stds_in_file),
                "significant": change.axis in beyond_noise,
                "std_percent": change.std_percent,
                "nameplate": change.nameplate,
                "nameplate_percent": change.nameplate_percent,
                "unit": change.unit,
            }
            for change in proposal.changes
        ],
        "refusals": [
            {
                "gate": refusal.gate.value,
                "subject": refusal.subject,
                "found": refusal.found,
                "expected": refusal.expected,
                "remedy": refusal.remedy,
            }
            for refusal in proposal.refusals
        ],
        "diff": proposal.diff,
    }
