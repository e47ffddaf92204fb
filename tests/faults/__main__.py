"""Prints the table of docs/faults.md: ``python -m tests.faults``."""

from __future__ import annotations

import sys

from drivers.event import EventKind
from tests.faults.cells import STRIKE, run
from tests.faults.test_in_motion import STOPS

sys.stdout.write("| fault | error | event, cycles after | stop, cycles after | states at the end | settings back |\n")
sys.stdout.write("|---|---|---|---|---|---|\n")
for name, promise in STOPS.items():
    outcome = run(f"table {name}", promise.fault)
    told = next(cycle for cycle in outcome.told(promise.event) if cycle >= STRIKE) - STRIKE
    stop = outcome.told(EventKind.STOP)[0] - STRIKE
    states = ", ".join(sorted({state.name for state in outcome.states}))
    sys.stdout.write(
        f"| {name} | {type(outcome.error).__name__} | {promise.event.value}, {told} | {stop} | {states} "
        f"| {'yes' if outcome.restored else 'no'} |\n"
    )
