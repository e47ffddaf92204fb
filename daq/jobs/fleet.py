"""Fit the cells of a fleet in parallel, and report a row for each: as a table, as CSV and as JSON.

The workers are threads of this process, processes of this machine, or the workers of a dask
scheduler.
"""

from __future__ import annotations

import csv
import io
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    CancelledError,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from datetime import datetime
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any, Literal, TypeVar

from rich.console import RenderableType
from rich.text import Text

from daq.errors import ConfigurationMissing, UsageError, WorkersLost
from daq.jobs.cell_fit import (
    CalibrationCache,
    Failure,
    FleetFit,
    Loop,
    Summary,
    failure_of,
    fit_cell,
)
from daq.jobs.fleet_survey import CellLogs, SeenLog, StoredLog, UnknownLog, by_cell, survey
from daq.report.gains import with_deviation
from daq.report.job_schemas import FleetCell, FleetEffect, FleetFailure, FleetReport
from daq.report.text import Sentence, WholeTable, inert, inert_row, printable, spelled_bytes

HERE = "127.0.0.1"
TRIMMING = "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_"
"""By which dask lets its workers give memory back after every use:
a fit would spend a fifth of its time on that.
"""
WORKER_LOG = "distributed.nanny.pre-spawn-environ.DASK_LOGGING__DISTRIBUTED"
"""By which workers choose what they log.

A fit that fails is an error of its task; what they log besides is about their end, where on a busy
machine a heartbeat finds the scheduler gone: a traceback that says nothing to anybody.
"""
CONNECT_S = 10  #: How long a scheduler may take to answer [s]


@dataclass(frozen=True, slots=True)
class WorkerPool:
    """Running workers."""

    executor: Executor  #: runs functions
    workers: int  #: tasks that it does at the same time; no more are ever given to it
    present: Callable[[], bool]  #: whether any worker is left


def worker_pool(scheduler: str, workers: int | None) -> AbstractContextManager[WorkerPool]:
    """Choose the workers for --scheduler and --workers; they run until the block ends.

    Args:
        scheduler: threads, processes, or the address of a dask scheduler, tcp://HOST:PORT.
        workers: None for as many as there are processors, or as the scheduler has threads.

    Raises:
        UsageError: it is none of these; on entering, no scheduler answers at the address, or it has
            no workers.
        ConfigurationMissing: on entering, dask.distributed is not installed.
    """
    here = workers or len(os.sched_getaffinity(0))
    if scheduler == "threads":
        return _threads(here)
    if scheduler == "processes":
        return _processes(here)
    if "://" not in scheduler:
        raise UsageError(
            "--scheduler",
            found=repr(scheduler),
            expected="threads, processes, or the address of a dask scheduler",
            remedy="for instance --scheduler processes, or --scheduler tcp://127.0.0.1:8786",
        )
    return _scheduler(scheduler, workers)


@contextmanager
def _threads(workers: int) -> Iterator[WorkerPool]:
    """Yield a pool of threads; no installation is needed.

    Much of a fit is Python, of which one thread runs at a time.

    At the end, running tasks are waited for and waiting ones are given up.
    """
    executor = ThreadPoolExecutor(workers, thread_name_prefix="fleet")
    try:
        yield WorkerPool(executor, workers, lambda: True)
    finally:
        executor.shutdown(cancel_futures=True)


@contextmanager
def _processes(workers: int) -> Iterator[WorkerPool]:
    distributed = _distributed()
    dask = import_module("dask")
    # On this machine alone: who reaches a scheduler can run anything on its workers. Its dashboard
    # is left out; its HTTP server cannot be, and takes a free port: on the usual one it would warn
    # of any other cluster.
    with (
        dask.config.set({TRIMMING: None, WORKER_LOG: "critical"}),
        distributed.LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            host=HERE,
            dashboard_address=None,
            scheduler_kwargs={"dashboard": False, "dashboard_address": f"{HERE}:0"},
        ) as cluster,
        _scheduler(cluster.scheduler_address, workers) as pool,
    ):
        yield pool


@contextmanager
def _scheduler(address: str, workers: int | None) -> Iterator[WorkerPool]:
    """Connect to a scheduler, here or on another machine;
    it and its workers go on when the block ends.
    """
    try:
        client = _distributed().Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise UsageError(
            f"--scheduler {address}",
            found=str(error) or type(error).__name__,
            expected="a dask scheduler that answers",
            remedy="start `dask scheduler`, and `dask worker ADDRESS` on each machine; or use "
            "--scheduler processes",
        ) from error
    with client:
        threads = sum(client.nthreads().values())
        if not threads:
            raise UsageError(
                f"--scheduler {address}",
                found="no workers",
                expected="one or more",
                remedy=f"start some: `dask worker {address} --nthreads 1`",
            )
        executor = client.get_executor(pure=False)
        try:
            yield WorkerPool(executor, workers or threads, lambda: bool(client.nthreads()))
        finally:
            executor.shutdown(wait=False)


def _distributed() -> Any:
    """Import the optional extra, which takes a second and has no types where it is used here."""
    try:
        return import_module("distributed")
    except ImportError as error:
        raise ConfigurationMissing(
            "--scheduler",
            found="no package dask.distributed",
            expected="that of the optional extra `fleet`",
            remedy="pip install 'drivegain[fleet]', or leave --scheduler out for threads",
        ) from error


@dataclass(frozen=True, slots=True)
class FleetRow:
    """Result of one cell: a summary, or the failure."""

    cell: str  #: its name; that of the log where the cell is unknown
    configuration_sha256: str  #: of its configuration; empty where it is unknown
    fit: tuple[str, ...]  #: names of the logs of the fit
    holdout: tuple[str, ...]  #: names of the held-out logs
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
"""Logs whose heads one task reads: a cell's logs lie together,
and share a configuration that is read once.
"""

#: Time without a result after which the workers are checked; a cell may well take longer
WORKER_CHECK_S = 30.0

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

    def row_of(cell: CellLogs, result: Summary | Failure, seconds: float) -> FleetRow:
        fit = tuple(seen.log.name for seen in cell.fit)
        holdout = tuple(seen.log.name for seen in cell.holdout)
        return FleetRow(
            cell.cell,
            cell.configuration_sha256,
            fit,
            holdout,
            result,
            seconds,
            configurations[cell.cell],
        )

    missing = []
    for cell in cells:
        cached = None
        if cache is not None:
            cached = cache.cached(cell)
        if cache is None or cached is None:
            missing.append(cell)
        else:
            rows.append(replace(row_of(cell, *cached), file=cache.file(cell), kept=True))
    report_progress(len(rows), len(cells), "")

    def submit(cell: CellLogs) -> Future[FleetFit | Failure]:
        return pool.executor.submit(fit_cell, cell, loop, now())

    for cell, made in each(submit, missing, pool):
        # An exception is a worker that was killed, or an error of ours: the other cells have
        # nothing to do with it.
        if isinstance(made, BaseException):
            found: FleetFit | Failure = failure_of(made)
        else:
            found = made
        if isinstance(found, Failure):
            rows.append(row_of(cell, found, found.seconds))
        else:
            file = None
            if cache is not None:
                file = cache.store(cell, found)
            rows.append(replace(row_of(cell, found.summary, found.seconds), file=file))
        report_progress(len(rows), len(cells), cell.cell)
    rows.sort(key=lambda row: (row.cell, row.configuration_sha256))
    for log in unknown:
        name = log.log.name
        rows.append(FleetRow(name, "", (name,), (), failure_of(log.error), 0.0))
    return tuple(rows)


def each(
    submit: Callable[[Work], Future[Made]], work: Iterable[Work], pool: WorkerPool
) -> Iterator[tuple[Work, Made | BaseException]]:
    """Run work in a pool, and yield the results as they finish.

    No more is submitted than there are workers, so that neither tasks nor results pile up.

    Yields:
        each piece with its result or its exception.

    Raises:
        UsageError: the workers are gone.
    """
    waiting = iter(work)
    running = {submit(piece): piece for piece in islice(waiting, pool.workers)}
    absent = 0
    while running:
        done, _ = wait(running, WORKER_CHECK_S, return_when=FIRST_COMPLETED)
        # A worker that died may be restarting: it is gone when it is missing twice.
        is_absent = not done and not pool.present()
        absent = absent + 1
        if not is_absent:
            absent = 0
        if absent > 1:
            raise _gone("no workers any more")
        for future in done:
            piece = running.pop(future)
            try:
                outcome = future.exception() or future.result()
            except CancelledError as lost:
                raise _gone("the connection to the scheduler lost") from lost
            running |= {submit(following): following for following in islice(waiting, 1)}
            yield piece, outcome


def _gone(found: str) -> WorkersLost:
    return WorkersLost(
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
    for portion, found in each(
        lambda portion: pool.executor.submit(survey, portion), portions, pool
    ):
        if isinstance(found, BaseException):  # a worker that was killed, or an error of ours
            unknown += [UnknownLog(log, found) for log in portion]
        else:
            seen += [log for log in found if isinstance(log, SeenLog)]
            unknown += [log for log in found if isinstance(log, UnknownLog)]
        surveyed += len(portion)
        report_progress(surveyed, len(logs), "heads of logs")
    return by_cell(seen), sorted(unknown, key=lambda log: log.log.name)


FIRST_COLUMNS = ("cell", "configuration_sha256", "fit", "holdout")
LAST_COLUMNS = (
    *("worst_axis", "worst_std_percent", "error_percent", "error_on", "effects", "partial"),
    *("seconds", "exit_code", "error_kind", "error", "calibration"),
)


def fleet_view(rows: Sequence[FleetRow]) -> Iterator[RenderableType]:
    """Table of the cells, a row each, and remarks on it; errors are red."""
    table = WholeTable()
    table.add_column("cell", overflow="fold")
    table.add_column("gains ± σ", ratio=1)
    table.add_column("worst σ %", justify="right", no_wrap=True)
    table.add_column("error %", justify="right", no_wrap=True)
    effects = any(isinstance(row.result, Summary) and row.result.effects for row in rows)
    if effects:
        table.add_column("effects")
    table.add_column("s", justify="right", no_wrap=True)
    for row in rows:
        if isinstance(row.result, Failure):
            cells = (printable(f"{row.result.kind}, see below"), "", "", "")
            style = "bold red"
        else:
            cells = _summary_cells(row.result)
            style = None
        shown = [*cells, f"{row.seconds:.2f}"]
        if not effects:
            shown = [*cells[:3], f"{row.seconds:.2f}"]
        table.add_row(*map(Text, (printable(row.cell), *shown)), style=style)
    yield table
    yield from map(Sentence, _remarks(rows))
    for row in rows:
        if isinstance(row.result, Failure):
            yield Sentence(f"{row.cell}: {row.result.kind}: {row.result.text}", "bold red")


def _summary_cells(summary: Summary) -> tuple[str, str, str, str]:
    """Gains, the worst of them, the error and the effects."""
    # Lines break between gains, not within one.
    texts = [with_deviation(gain.value, gain.std) for gain in summary.gains]
    gains = ", ".join(text.replace(" ", "\xa0") for text in texts)
    units = ", ".join(dict.fromkeys(gain.unit for gain in summary.gains))
    worst = f"{summary.worst.axis} {summary.worst.std_percent:.2f}"
    error = f"{summary.error_percent:.2f}" + ("" if summary.held_out else "*")
    effects = ", ".join(f"{name} {axis}" for name, axis in summary.effects)
    return f"{gains} {printable(units)}", printable(worst), error, printable(effects)


def _remarks(rows: Sequence[FleetRow]) -> list[str]:
    fitted = [(row, row.result) for row in rows if isinstance(row.result, Summary)]
    cached = sum(row.kept for row, _ in fitted)
    again = ""
    if cached:
        again = f" ({cached} of them kept from earlier, with the same logs)"
    lines = [f"{len(fitted)} of {len(rows)} fitted{again}."]
    if not all(summary.held_out for _, summary in fitted):
        lines.append(
            "* on the moves of the fit: the cell has no second run with the same payload "
            "to hold out."
        )
    several = {row.cell: row.configurations for row in rows if row.configurations > 1}
    lines += [
        f"{cell}: logs of {count} configurations, each fitted on its own; check which one "
        "is current."
        for cell, count in several.items()
    ]
    lines += [
        f"{row.cell}: PARTIAL or lossy data: not for a controller; `apply` refuses it."
        for row, summary in fitted
        if summary.partial
    ]
    return lines


def fleet_csv(rows: Sequence[FleetRow]) -> str:
    """Write a line per cell, with all digits;
    gain, σ and unit of every axis that any of the cells has.

    Missing values are empty. No text is a formula to a spreadsheet.
    """
    summaries = [row.result for row in rows if isinstance(row.result, Summary)]
    axes: dict[str, None] = {}
    for summary in summaries:
        axes |= dict.fromkeys(gain.axis for gain in summary.gains)
    of_axes: list[str] = []
    for axis in axes:
        of_axes += (f"{axis} gain", f"{axis} std", f"{axis} unit")
    text = io.StringIO()
    headings = (*FIRST_COLUMNS, *of_axes, *LAST_COLUMNS)
    table = csv.DictWriter(text, headings, restval="", lineterminator="\n")
    table.writerow({heading: inert(heading) for heading in headings})
    for row in rows:
        table.writerow(inert_row(_line(row)))
    return text.getvalue()


def fleet_report(rows: Sequence[FleetRow]) -> FleetReport:
    """Return the cells of a fleet."""
    fitted = sum(row.fitted for row in rows)
    cells = [_fleet_cell(row) for row in rows]
    failed = len(rows) - fitted
    return FleetReport(cells=cells, fitted=fitted, failed=failed)


def _line(row: FleetRow) -> dict[str, Any]:
    result = row.result
    line: dict[str, Any] = {
        "cell": row.cell,
        "configuration_sha256": row.configuration_sha256,
        "fit": " ".join(row.fit),
        "holdout": " ".join(row.holdout),
        "seconds": f"{row.seconds:.3f}",
    }
    if isinstance(result, Failure):
        return line | {
            "exit_code": result.exit_code,
            "error_kind": result.kind,
            "error": result.text,
        }
    for gain in result.gains:
        line[f"{gain.axis} gain"] = gain.value
        line[f"{gain.axis} std"] = gain.std
        line[f"{gain.axis} unit"] = gain.unit
    calibration = ""
    if row.file is not None:
        calibration = str(row.file)
    return line | {
        "worst_axis": result.worst.axis,
        "worst_std_percent": result.worst.std_percent,
        "error_percent": result.error_percent,
        "error_on": _measured_on(result),
        "effects": "; ".join(f"{name} {axis}" for name, axis in result.effects),
        "partial": result.partial,
        "exit_code": 0,
        "calibration": calibration,
    }


def _fleet_cell(row: FleetRow) -> FleetCell:
    result = row.result
    calibration = None
    if row.file is not None:
        calibration = spelled_bytes(str(row.file))
    about: dict[str, Any] = {
        "cell": spelled_bytes(row.cell),
        "configuration_sha256": row.configuration_sha256 or None,
        "configurations": row.configurations,
        "fit": list(map(spelled_bytes, row.fit)),
        "holdout": list(map(spelled_bytes, row.holdout)),
        "seconds": row.seconds,
        "kept": row.kept,
        "calibration": calibration,
    }
    if isinstance(result, Failure):
        return FleetCell(
            **about,
            gains=[],
            worst=None,
            error_percent=None,
            error_on=None,
            effects=[],
            partial=None,
            exit_code=result.exit_code,
            error=FleetFailure(kind=result.kind, text=spelled_bytes(result.text)),
        )
    return FleetCell.of(
        result,
        **about,
        error_on=_measured_on(result),
        effects=[FleetEffect(name=name, axis=axis) for name, axis in result.effects],
        exit_code=0,
        error=None,
    )


def _measured_on(summary: Summary) -> Literal["holdout", "fit"]:
    if summary.held_out:
        return "holdout"
    return "fit"
