"""The functions of other rooms that a job calls, handed in: its tests run the real ones, or know what they would do."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from daq.config.cell import Cell
from daq.jobs.interlock import Runner, check_drives, run_command
from daq.workflow.fit import Fit, calibration_of, close_loop, fit
from daq.workflow.plan import Plan, plan
from daq.workflow.record import Recorded, record
from daq.workflow.safeguards import FreeBytes, free_bytes
from daq.writeback.file_target import FileEdit
from daq.writeback.target import Proposal, Written, apply, propose
from drivers.canopen.network import SignalBlocker
from ident.calibration import Calibration
from ident.discovery.before_after import Account, account

SaveReport = Callable[[Fit, Account, Calibration, Path], None]


@dataclass(frozen=True, slots=True)
class Tools:
    """What a job does its work with.

    Attributes:
        save_report: writes the report of a fit into a folder.
        drives: looks at the drives before anything moves.
        plan, record, fit, close_loop, calibration, account, propose, apply: steps of the workflow and the write-back.
        run: runs a command of the cell's.
        free: tells the room on a disk.
        now: wall clock with time zone.
        monotonic_s: for durations [s].
    """

    save_report: SaveReport
    drives: Callable[[Cell, SignalBlocker], None] = check_drives
    plan: Callable[..., Plan] = plan
    record: Callable[..., Recorded] = record
    fit: Callable[..., Fit] = fit
    close_loop: Callable[..., Fit] = close_loop
    calibration: Callable[[Fit, datetime], Calibration] = calibration_of
    account: Callable[..., Account] = account
    propose: Callable[..., Proposal[FileEdit]] = propose
    apply: Callable[..., Written | None] = apply
    run: Runner = run_command
    free: FreeBytes = free_bytes
    now: Callable[[], datetime] = lambda: datetime.now(UTC)
    monotonic_s: Callable[[], float] = time.monotonic
