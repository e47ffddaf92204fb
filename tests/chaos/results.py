"""Rows of a run of chaos, one a round, in a CSV file:
a run that was broken off goes on behind its last row.
"""

from __future__ import annotations

import csv
import os
from dataclasses import dataclass, fields
from pathlib import Path

from tests.chaos.judge import Round

SEPARATOR = "; "


@dataclass(frozen=True)
class Row:
    """One round."""

    seed: int
    number: int  #: of the round
    bus: str  #: kernel or hub
    faults: tuple[str, ...]  #: that came
    code: str  #: exit code of the recorder
    values: int  #: compared with the bus
    neighbours: int  #: of these, of the cycle before or after (`tests.vcan.judgement.TWICE`)
    stops: int  #: after faults in motion
    latest_s: float  #: of these stops, beside its bound [s]
    writes: int  #: of gains, and looks at the audit log
    violations: int
    seconds: float  #: that it took
    load: float  #: mean load of the machine in the last minute

    @classmethod
    def of(cls, seed: int, number: int, on_kernel: bool, outcome: Round, seconds: float) -> Row:
        """Return the row of a round."""
        return cls(
            seed,
            number,
            "kernel" if on_kernel else "hub",
            tuple(fault.name for fault in outcome.injected),
            str(outcome.code),
            outcome.compared,
            outcome.neighbours,
            len(outcome.late_s),
            round(max(outcome.late_s.values(), default=0.0), 3),
            len(outcome.written),
            len(outcome.violations),
            round(seconds, 1),
            round(os.getloadavg()[0], 1),
        )


NAMES = tuple(field.name for field in fields(Row))


def append_row(path: Path, row: Row) -> None:
    """Append a row, under a head in a new file."""
    is_new = not path.exists()
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        if is_new:
            writer.writerow(NAMES)
        values = [getattr(row, name) for name in NAMES]
        values[NAMES.index("faults")] = SEPARATOR.join(row.faults)
        writer.writerow(values)


def read_rows(path: Path | None, seed: int) -> list[Row]:
    """Return the rows of a seed; none without a file."""
    if path is None or not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return [_row(one) for one in csv.DictReader(file) if int(one["seed"]) == seed]


def _row(one: dict[str, str]) -> Row:
    faults = tuple(name for name in one["faults"].split(SEPARATOR) if name)
    return Row(
        int(one["seed"]),
        int(one["number"]),
        one["bus"],
        faults,
        one["code"],
        int(one["values"]),
        int(one["neighbours"]),
        int(one["stops"]),
        float(one["latest_s"]),
        int(one["writes"]),
        int(one["violations"]),
        float(one["seconds"]),
        float(one["load"]),
    )
