"""Writes of gains around a recording: a cell with its controller's file and audit log,
and acts against both.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence
from pathlib import Path

from daq.cli.app import main
from tests.chaos.clock import StepClock
from tests.chaos.faults import AFTERWARDS, Act
from tests.chaos.judge import FilesSeen, Round, Written
from tests.chaos.processes import Verb
from tests.daq.calibrations import IDENTIFIED, calibration_for

FACTORS = (1.0, 1.02)
WRITTEN_GAINS = (
    tuple(FACTORS[0] * gain for gain in IDENTIFIED),
    tuple(FACTORS[1] * gain for gain in IDENTIFIED),
)
WRITE_S = 60.0


class Office:
    """The cell's folder, in which gains are written by the verbs."""

    def __init__(self, cell: Path, outcome: Round, clock: StepClock | None) -> None:
        self._cell = cell
        self._outcome = outcome
        self._clock = clock
        self._calibrations = [calibration_for(cell, factor) for factor in FACTORS]
        self._audit = cell.with_name("cell.audit.jsonl")
        self._controller = cell.with_name("controller.yaml")
        self._torn = False
        self._count = 0
        #: controller's file before any write
        self.before = self._controller.read_text(encoding="utf-8")

    def write_first(self) -> None:
        """Write gains for the first time."""
        self._apply(0)

    def write_again(self) -> None:
        """Make the acts between two jobs, write other gains (twice if disturbed),
        and verify the log.
        """
        disturbed = False
        wrong_s = 0
        killed_s = None
        for fault in self._outcome.faults:
            if fault.kind not in AFTERWARDS:
                continue
            self._outcome.struck.append((fault, time.time_ns()))
            if fault.kind is Act.AUDIT_DELETED:
                self._audit.unlink(missing_ok=True)
            elif fault.kind is Act.AUDIT_CUT:
                self._cut()
            elif fault.kind is Act.CLOCK_WRONG:
                wrong_s = fault.clock_step_s
                disturbed = True
            elif fault.kind is Act.WRITE_KILL:
                killed_s = fault.for_s
                disturbed = True
        if disturbed:
            self._apply(1, wrong_s=wrong_s, killed_s=killed_s)
        self._apply(1)
        self._run("history", ["history", str(self._cell), "--verify"])

    def _cut(self) -> None:
        if self._audit.exists():
            lines = self._audit.read_bytes().splitlines(keepends=True)
            self._audit.write_bytes(b"".join(lines[:-1]))

    def _apply(self, number: int, wrong_s: int = 0, killed_s: float | None = None) -> None:
        arguments = ["apply", str(self._cell), str(self._calibrations[number]), "--yes"]
        self._run("apply", arguments, wrong_s, killed_s)

    def _run(
        self, verb: str, arguments: Sequence[str], wrong_s: int = 0, killed_s: float | None = None
    ) -> None:
        self._count += 1
        words = self._cell.with_name(f"{self._count}-{verb}.txt")
        if self._clock is not None:
            self._clock.step(wrong_s)
        running = Verb.start(words, lambda: main(arguments), clock=self._clock)
        if killed_s is not None and not running.wait(killed_s):
            os.kill(running.pid, signal.SIGKILL)
        running.wait(WRITE_S)
        code = running.end()
        if self._clock is not None:
            self._clock.step(0)
        killed = code == -signal.SIGKILL
        self._torn = self._torn or killed
        self._outcome.written.append(
            Written(verb, code, running.said, right_clock=wrong_s == 0, killed=killed_s is not None)
        )
        if self._audit.exists():
            audit = self._audit.read_text(encoding="utf-8")
        else:
            audit = ""
        controller = self._controller.read_text(encoding="utf-8", errors="replace")
        self._outcome.files.append(FilesSeen(controller, audit, torn=self._torn))
