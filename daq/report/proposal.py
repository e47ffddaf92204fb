"""A proposed change of a controller's file: for a person as a table and a diff, for a program as a document."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

from rich import box
from rich.console import Console
from rich.syntax import Syntax
from rich.table import Table

from daq.ledger.judgement import NOTHING, Known, judge
from daq.report.gains import with_deviation
from daq.report.text import terminal_lines, terminal_text
from daq.writeback.file_proposal import Proposal
from daq.writeback.file_target import Written
from daq.writeback.gates.target import GainChange
from ident.drift.change import FALSE_ALARM


def show(proposal: Proposal, console: Console, known: Known = NOTHING) -> None:
    """The change as a table and as a diff, judged by what a history knows."""
    show_changes(proposal.changes, console, known)
    if proposal.diff:
        console.print(Syntax(terminal_lines(proposal.diff), "diff", background_color="default", word_wrap=True))


def show_changes(
    changes: tuple[GainChange, ...], console: Console, known: Known = NOTHING, place: str = "in the file"
) -> None:
    """The table of `change_table`, and what its stars say."""
    console.print(change_table(changes, known, place))
    exact = [change.axis for change in changes if not known.stds.get(change.axis)]
    whose = "all axes" if len(exact) == len(changes) else ", ".join(exact)
    taken = f"the number {place} taken as exact ({whose})" if exact else "σ of both"
    note = f"* more than noise: probability below {100 * FALSE_ALARM:g} % among all axes, {taken}"
    console.print(terminal_text(note), style="dim")
    console.print()


def change_table(changes: tuple[GainChange, ...], known: Known = NOTHING, place: str = "in the file") -> Table:
    """Old and new gain of each axis with what there is to judge the change by; fits a terminal of 80 columns.

    Args:
        changes: one an axis.
        known: by a history.
        place: heading of the gains that are in the controller now.
    """
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, collapse_padding=True)
    table.add_column("axis", no_wrap=True)
    for heading in (place, "identified ± σ", "σ %", "Δ %", "Δ in σ", "nameplate", "off %"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    judged = _by_axis(changes, known)
    for change in changes:
        sigmas, beyond_noise = judged.get(change.axis, (math.nan, False))
        table.add_row(
            terminal_text(change.axis),
            f"{change.old:.5g}",
            with_deviation(change.new, change.std),
            f"{change.std_percent:.2f}",
            f"{change.change_percent:+.1f}",
            f"{sigmas:.1f} {'*' if beyond_noise else ' '}",
            f"{change.nameplate:.5g}",
            f"{change.nameplate_percent:+.1f}",
            terminal_text(change.unit),
        )
    return table


def significant(changes: tuple[GainChange, ...], known: Known = NOTHING) -> frozenset[str]:
    """Axes whose gain differs from the controller's by more than noise."""
    return frozenset(axis for axis, (_, beyond_noise) in _by_axis(changes, known).items() if beyond_noise)


def _by_axis(changes: tuple[GainChange, ...], known: Known) -> dict[str, tuple[float, bool]]:
    """Change in σ of both as calibrations scatter, and whether it is more than noise; of axes that can be compared."""
    found = judge(changes, known)
    return {
        axis: (abs(change.sigmas), probability <= FALSE_ALARM)
        for axis, change, probability in zip(found.axes, found.changes, found.adjusted, strict=True)
    }


def describe(proposal: Proposal, written: Written | None, known: Known = NOTHING) -> dict[str, Any]:
    """The proposal and its outcome for --json."""
    judged = _by_axis(proposal.changes, known)
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
                "change_sigmas": judged.get(change.axis, (None, False))[0],
                "significant": judged.get(change.axis, (None, False))[1],
                "std_percent": change.std_percent,
                "nameplate": change.nameplate,
                "nameplate_percent": change.nameplate_percent,
                "unit": change.unit,
            }
            for change in proposal.changes
        ],
        "refusals": [asdict(refusal) | {"gate": refusal.gate.value} for refusal in proposal.refusals],
        "diff": proposal.diff,
    }
