"""Fit the cells of a fleet in parallel, and report a row for each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import islice
from pathlib import Path
from typing import TypeVar

from daq.errors import UsageError
from daq.jobs.cell_fit import CalibrationCache, Failure, Fitted, Loop, Unfitted, failure_of, fit_cell
from daq.jobs.fleet_survey import CellLogs, SeenLog, StoredLog, Summary, UnknownLog, by_cell, survey
from daq.jobs.workers import WorkerPool


@dataclass(frozen=True, slots=True)
class FleetRow:
    """Result of one cell: a summary, or the failure."""

    cell: str  #: its name; that of the log where the cell is unknown
    configuration_sha256: str  #: of its configuration; empty where it is unknown
    fit: tuple[str, ...]  #: names of the logs
    holdout: tuple[str, ...]  #: names of the logs
    result: Summary | Failure  #: summary of the calibration, or the failure
    seconds: float  #: that it took
    configurations: int = 1  #: in how many different ones the cell's logs were made; each has a row
    file: Path | None = None  #: of the calibration, where it is kept
    kept: bool = False  #: it was cached, and its logs are unchanged

    @property
    def fitted(self) -> bool:
        """Whether there is a calibration."""
        return isinstance(self.result, Summary)


SURVEYED = 16
"""Logs whose heads one task reads: a cell's logs lie together, and share a configuration that is read once."""

LOOK_S = 30.0  #: Time without a result after which the workers are checked; a cell may well take longer

ProgressCallback = Callable[[int, int, str], None]  #: Done, total, and a remark
Work = TypeVar("Work")
Made = TypeVar("Made")


def fit_fleet(
    logs: tuple[StoredLog, ...],
    pool: WorkerPool,
    loop: Loop,
    cache: CalibrationCache | None,
    now: Callable[[], datetime],
    report_progress: ProgressCallback = lambda _done, _total, _remark: None,
) -> tuple[FleetRow, ...]:
    """Fit every cell that has logs; the failure of one is in its row.

    Args:
        logs: of all cells.
        pool: workers.
        loop: whether missing effects are added.
        cache: of calibrations, None for none.
        now: time of day, for the calibrations.
        report_progress: of progress, by cells; while heads are read, by logs.

    Returns:
        the rows, by cell and configuration; logs of unknown cells come last.

    Raises:
        UsageError: the workers are gone; finished calibrations are cached.
        UsageError: a file in the cache folder must not be replaced; no cell was fitted.
        OutputFailed: a calibration could not be stored.
    """
    cells, unknown = _surveyed(logs, pool, report_progress)
    configurations = Counter(cell.cell for cell in cells)
    rows: list[FleetRow] = []
    missing = []
    for cell in cells:
        cached = None if cache is None else cache.cached(cell)
        if cache is None or cached is None:
            missing.append(cell)
        else:
            row = _row_of(cell, *cached, configurations[cell.cell])
            rows.append(replace(row, file=cache.file(cell), kept=True))
    report_progress(len(rows), len(cells), "")

    def submit(cell: CellLogs) -> Future[Fitted | Unfitted]:
        return pool.executor.submit(fit_cell, cell, loop, now())

    for cell, found in each(submit, missing, pool):
        rows.append(_row(cell, found, configurations[cell.cell], cache))
        report_progress(len(rows), len(cells), cell.cell)
    rows.sort(key=lambda row: (row.cell, row.configuration_sha256))
    return (*rows, *(FleetRow(log.log.name, "", (log.log.name,), (), failure_of(log.error), 0.0) for log in unknown))


def each(
    submit: Callable[[Work], Future[Made]], work: Iterable[Work], pool: WorkerPool
) -> Iterator[tuple[Work, Made | BaseException]]:
    """Run work in a pool, and yield the results as they finish.

    No more is submitted than there are workers, so that neither tasks nor results pile up.

    Args:
        submit: submits a piece to the pool.
        work: in pieces.
        pool: workers.

    Yields:
        each piece with its result or its exception.

    Raises:
        UsageError: the workers are gone.
    """
    waiting = iter(work)
    running = {submit(piece): piece for piece in islice(waiting, pool.workers)}
    absent = 0
    while running:
        done, _ = wait(running, LOOK_S, return_when=FIRST_COMPLETED)
        # A worker that died may be restarting: it is gone when it is missing twice.
        absent = absent + 1 if not done and not pool.present() else 0
        if absent > 1:
            raise _gone("no workers any more")
        for future in done:
            piece = running.pop(future)
            outcome = _outcome(future)
            running |= {submit(following): following for following in islice(waiting, 1)}
            yield piece, outcome


def _outcome(future: Future[Made]) -> Made | BaseException:
    try:
        error = future.exception()
        if error is None:
            return future.result()
    except CancelledError as lost:
        raise _gone("the connection to the scheduler lost") from lost
    return error


def _gone(found: str) -> UsageError:
    return UsageError(
        "--scheduler",
        found=found,
        expected="a scheduler and workers that last until the end",
        remedy="look at their own logs; started again with the same --out, it goes on where it was",
    )


def _surveyed(
    logs: tuple[StoredLog, ...], pool: WorkerPool, report_progress: ProgressCallback
) -> tuple[tuple[CellLogs, ...], list[UnknownLog]]:
    portions = [logs[first : first + SURVEYED] for first in range(0, len(logs), SURVEYED)]
    seen: list[SeenLog] = []
    unknown: list[UnknownLog] = []
    surveyed = 0

    def submit(portion: tuple[StoredLog, ...]) -> Future[tuple[SeenLog | UnknownLog, ...]]:
        return pool.executor.submit(survey, portion)

    for portion, found in each(submit, portions, pool):
        if isinstance(found, BaseException):  # a worker that was killed, or an error of ours
            unknown += [UnknownLog(log, found) for log in portion]
        else:
            seen += [log for log in found if isinstance(log, SeenLog)]
            unknown += [log for log in found if isinstance(log, UnknownLog)]
        surveyed += len(portion)
        report_progress(surveyed, len(logs), "heads of logs")
    return by_cell(seen), sorted(unknown, key=lambda log: log.log.name)


def _row(
    cell: CellLogs, found: Fitted | Unfitted | BaseException, configurations: int, cache: CalibrationCache | None
) -> FleetRow:
    if isinstance(found, BaseException):
        # A worker that was killed, or an error of ours: the other cells have nothing to do with it.
        return _row_of(cell, failure_of(found), 0.0, configurations)
    if isinstance(found, Unfitted):
        return _row_of(cell, found.failure, found.seconds, configurations)
    row = _row_of(cell, found.summary, found.seconds, configurations)
    return row if cache is None else replace(row, file=cache.store(cell, found))


def _row_of(cell: CellLogs, result: Summary | Failure, seconds: float, configurations: int) -> FleetRow:
    fit, holdout = (tuple(seen.log.name for seen in logs) for logs in (cell.fit, cell.holdout))
    return FleetRow(cell.cell, cell.configuration_sha256, fit, holdout, result, seconds, configurations)
