"""Prints the tables of docs/reference/faults.md: ``python -m tests.faults``."""

from __future__ import annotations

import sys
from collections.abc import Callable

from drivers.messages import EventKind
from drivers.simulation.faults import FaultKind, FaultSpec
from tests.faults.cells import STRIKE, Outcome, run
from tests.faults.test_at_start import REFUSALS
from tests.faults.test_in_motion import GUARD_MS, STOPS, at

STOP_HEADINGS = (
    "fault",
    "error",
    "event, cycles after",
    "stop, cycles after",
    "states at the end",
    "settings back",
)


def guarded(name: str, fault: FaultSpec) -> Outcome:
    """A run whose axes watch the heartbeat of the recorder, and some time after it."""
    return run(name, fault, guard_ms=GUARD_MS, afterwards=2 * GUARD_MS)


SILENT_CELL = at(FaultKind.SILENT, axis=None)
SILENT_AXIS = at(FaultKind.SILENT)
BUS_OFF = at(FaultKind.BUS_OFF, axis=None)
CUT_OFF: dict[str, tuple[FaultSpec, EventKind, Callable[[str, FaultSpec], Outcome]]] = {
    "cell silent": (SILENT_CELL, EventKind.SAMPLE_LOST, run),
    "one axis silent": (SILENT_AXIS, EventKind.SAMPLE_LOST, run),
    "one axis cut off, guarded": (SILENT_AXIS, EventKind.SAMPLE_LOST, guarded),
    "bus-off": (BUS_OFF, EventKind.BUS_LOST, guarded),
}
"""Faults that leave axes which do not answer."""
COUNTED = {
    "error passive": FaultSpec(FaultKind.ERROR_PASSIVE, None, STRIKE),
    "one lost frame": at(FaultKind.LOST, cycles=1),
    "one late frame": at(FaultKind.LATE, cycles=1),
    "one duplicate frame": at(FaultKind.DUPLICATE, cycles=1),
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
    for cycle in outcome.cycles_of(kind):
        if cycle >= STRIKE:
            return str(cycle - STRIKE)
    return "-"


def states(outcome: Outcome) -> str:
    """States of the axes at the end."""
    names = {state.name for state in outcome.states}
    return ", ".join(sorted(names))


def restored(outcome: Outcome) -> str:
    """Axes that have their settings back."""
    if outcome.restored:
        return "all"
    if not outcome.restored_axes:
        return "none"
    numbers = [str(axis + 1) for axis in outcome.restored_axes]
    return f"axes {', '.join(numbers)}"


def row_of_stop(name: str, event: EventKind, outcome: Outcome) -> None:
    """One line of the table of what ends a recording."""
    error = type(outcome.error).__name__
    noticed = f"{event.value}, {after(outcome, event)}"
    stopped = after(outcome, EventKind.STOP)
    row(name, error, noticed, stopped, states(outcome), restored(outcome))


def ends() -> None:
    """The table of what ends a recording."""
    head(*STOP_HEADINGS)
    for name, stop in STOPS.items():
        outcome = run(f"table {name}", stop.fault, toggle_bit=stop.toggle_bit)
        row_of_stop(name, stop.event, outcome)


def cut_off() -> None:
    """The table of axes that do not answer any more."""
    head(*STOP_HEADINGS)
    for name, (fault, event, ran) in CUT_OFF.items():
        outcome = ran(f"table {name}", fault)
        row_of_stop(name, event, outcome)


def counted(outcome: Outcome) -> str:
    """Frames that the statistics count, and events of the bus."""
    found = []
    for field in ("missing", "late", "duplicate", "wrong_length"):
        count = getattr(outcome.statistics, field)
        if count:
            found.append(f"{field} {count}")
    kinds = {event.kind for event in outcome.events}
    of_the_bus = kinds & {EventKind.BUS_PASSIVE, EventKind.BUS_BUSY}
    found += sorted(kind.value for kind in of_the_bus)
    return ", ".join(found)


def goes_on() -> None:
    """The table of faults that are counted."""
    head("fault", "the run", "counted", "states at the end", "settings back")
    for name, fault in COUNTED.items():
        outcome = run(f"table {name}", fault)
        if outcome.error is None:
            verdict = "goes on"
        else:
            verdict = "ENDS"
        row(name, verdict, counted(outcome), states(outcome), restored(outcome))


def refused() -> None:
    """The table of faults that are there from the start."""
    head("fault from the start", "error", "moved", "states at the end", "settings back")
    for kind in REFUSALS:
        outcome = run(f"table start {kind.value}", FaultSpec(kind, 1))
        error = type(outcome.error).__name__
        if outcome.cycles_of(EventKind.MOVE_START):
            moved = "yes"
        else:
            moved = "no"
        row(kind.value, error, moved, states(outcome), restored(outcome))


ends()
cut_off()
goes_on()
refused()
