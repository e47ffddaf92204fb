"""Prints the tables of docs/reference/faults.md: ``python -m tests.faults``."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable

from drivers.messages import EventKind
from drivers.simulation.faults import FaultKind, FaultSpec
from tests.faults.cells import STRIKE, Outcome, run
from tests.faults.test_at_start import REFUSALS
from tests.faults.test_in_motion import GUARD_MS, STOPS, at

CUT_OFF: dict[str, tuple[FaultSpec, EventKind, Callable[[str, FaultSpec], Outcome]]] = {
    "cell silent": (at(FaultKind.SILENT, axis=None), EventKind.SAMPLE_LOST, run),
    "one axis silent": (at(FaultKind.SILENT), EventKind.SAMPLE_LOST, run),
    "one axis cut off, guarded": (
        at(FaultKind.SILENT),
        EventKind.SAMPLE_LOST,
        lambda name, fault: run(name, fault, guard_ms=GUARD_MS, afterwards=2 * GUARD_MS),
    ),
    "bus-off": (
        at(FaultKind.BUS_OFF, axis=None),
        EventKind.BUS_LOST,
        lambda name, fault: run(name, fault, guard_ms=GUARD_MS, afterwards=2 * GUARD_MS),
    ),
}
"""Faults that leave axes which do not answer."""
COUNTED = {
    "error passive": FaultSpec(FaultKind.ERROR_PASSIVE, None, STRIKE),
    **{
        f"one {kind.value} frame": at(kind, cycles=1)
        for kind in (FaultKind.LOST, FaultKind.LATE, FaultKind.DUPLICATE)
    },
    "one short frame": at(FaultKind.SHORT_PDO, cycles=1),
    "another device sends SDO requests": at(FaultKind.SDO_MASTER, cycles=5),
}
"""Faults with which the run goes on."""


def row(*cells: object) -> None:
    """One line of a table, as soon as it is known."""
    sys.stdout.write("| " + " | ".join(map(str, cells)) + " |\n")
    sys.stdout.flush()


def head(*cells: str) -> None:
    """The first two lines of a table."""
    sys.stdout.write("\n")
    row(*cells)
    row(*["---"] * len(cells))


def after(outcome: Outcome, kind: EventKind) -> str:
    """Cycles from the fault to the first such event; "-" where there is none."""
    cycles = [cycle - STRIKE for cycle in outcome.cycles_of(kind) if cycle >= STRIKE]
    return str(cycles[0]) if cycles else "-"


def ended(outcome: Outcome) -> tuple[str, str]:
    """States of the axes at the end, and whose settings are what they were."""
    states = ", ".join(sorted({state.name for state in outcome.states}))
    kept = outcome.restored_axes
    return (
        states,
        "all"
        if outcome.restored
        else f"axes {', '.join(str(axis + 1) for axis in kept)}"
        if kept
        else "none",
    )


def in_motion(named: Iterable[tuple[str, EventKind, Outcome]]) -> None:
    """The table of what ends a recording."""
    head(
        "fault",
        "error",
        "event, cycles after",
        "stop, cycles after",
        "states at the end",
        "settings back",
    )
    for name, event, outcome in named:
        row(name, type(outcome.error).__name__, f"{event.value}, {after(outcome, event)}",
            after(outcome, EventKind.STOP), *ended(outcome))  # fmt: skip


in_motion(
    (name, p.event, run(f"table {name}", p.fault, toggle_bit=p.toggle_bit))
    for name, p in STOPS.items()
)
in_motion(
    (name, event, ran(f"table {name}", fault)) for name, (fault, event, ran) in CUT_OFF.items()
)
head("fault", "the run", "counted", "states at the end", "settings back")
for name, fault in COUNTED.items():
    outcome = run(f"table {name}", fault)
    fields = ("missing", "late", "duplicate", "wrong_length")
    counts = [
        f"{field} {count}" for field in fields if (count := getattr(outcome.statistics, field))
    ]
    events = sorted(
        {
            event.kind.value
            for event in outcome.events
            if event.kind in (EventKind.BUS_PASSIVE, EventKind.BUS_BUSY)
        }
    )
    row(
        name,
        "goes on" if outcome.error is None else "ENDS",
        ", ".join(counts + events),
        *ended(outcome),
    )
head("fault from the start", "error", "moved", "states at the end", "settings back")
for kind in REFUSALS:
    outcome = run(f"table start {kind.value}", FaultSpec(kind, 1))
    row(
        kind.value,
        type(outcome.error).__name__,
        "yes" if outcome.cycles_of(EventKind.MOVE_START) else "no",
        *ended(outcome),
    )
