"""The task of a fleet: the logs of one cell become a calibration, or the reason why not."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import Enum
from pathlib import Path

from daq.calibration_file import as_document, decode, encode
from daq.errors import CalibrationUnreadable, DaqError, ExitCode, LogsDiffer, LogUnreadable, exit_code
from daq.fit import calibration_of, close_loop, fit
from daq.fleet.log_store import StoredLog, at_hand, fingerprint
from daq.fleet.summary import Summary, summary_of
from daq.fleet.survey import CellLogs
from drivers.errors import DriverError
from ident.calibration import Calibration
from ident.errors import IdentificationError

SEED = 0
"""Of the significance test of the loop: that of `drivegain residual`."""


class Loop(Enum):
    """Whether effects that the model lacks are looked for."""

    OPEN = "open"
    CLOSED = "closed"


@dataclass(frozen=True, slots=True)
class Failure:
    """Why a cell has no calibration.

    Attributes:
        kind: name of the error's class.
        text: found, expected and to do, as a single fit would say it.
        exit_code: that a single fit would have ended with.
    """

    kind: str
    text: str
    exit_code: int


@dataclass(frozen=True, slots=True)
class Fitted:
    """What a worker sends back: small, whatever the logs weigh.

    Attributes:
        summary: of the calibration.
        content: of its file, found to say the same.
        seconds: that it took, reading included.
    """

    summary: Summary
    content: bytes
    seconds: float


@dataclass(frozen=True, slots=True)
class Unfitted:
    """What a worker sends back of a cell that cannot be fitted.

    Attributes:
        failure: why not.
        seconds: that it took to find out.
    """

    failure: Failure
    seconds: float


def fit_cell(
    cell: CellLogs, loop: Loop, created: datetime, clock: Callable[[], float] = time.perf_counter
) -> Fitted | Unfitted:
    """Fit one cell in this process, as `drivegain fit` (or `residual`) would with the same logs.

    Args:
        cell: with its logs, which this process can read.
        loop: whether to look for effects.
        created: when, for the calibration.
        clock: for the seconds.
    """
    begun_s = clock()
    paths: dict[Path, StoredLog] = {}
    with tempfile.TemporaryDirectory(prefix="drivegain-fleet-") as folder:
        try:
            for seen in (*cell.fit, *cell.holdout):
                _check_name(seen.log)
                paths[at_hand(seen.log, Path(folder))] = seen.log
            logs = list(paths)
            fitted = fit(logs[: len(cell.fit)], holdout=logs[len(cell.fit) :])
            if loop is Loop.CLOSED:
                fitted = close_loop(fitted, SEED)
            _check_unchanged(cell)
            calibration = calibration_of(fitted, created)
            content = _content(calibration, cell.cell)
        except (DaqError, DriverError, IdentificationError) as error:
            return Unfitted(failure_of(error, paths), clock() - begun_s)
    return Fitted(summary_of(calibration), content, clock() - begun_s)


def _check_name(log: StoredLog) -> None:
    """A calibration names its logs: a name that is no text has no place in it."""
    try:
        log.name.encode()
    except UnicodeEncodeError as error:
        raise LogUnreadable(
            log.address,
            found="bytes in its name that are no UTF-8",
            expected="a name that a calibration can tell",
            remedy="rename it",
        ) from error


def _check_unchanged(cell: CellLogs) -> None:
    """A log that somebody copies anew meanwhile: what was read of it is not what the calibration would stand for."""
    for seen in (*cell.fit, *cell.holdout):
        if fingerprint(seen.log) != seen.fingerprint:
            raise LogsDiffer(
                seen.log.address,
                found="another content than when the logs were looked through",
                expected="logs that nobody writes while they are fitted",
                remedy="start it again",
            )


def _content(calibration: Calibration, name: str) -> bytes:
    """Of the file, spelt and read back here: it takes a tenth of the time of a fit, and who collects them is alone."""
    content = encode(calibration)
    if as_document(decode(content, name)) != as_document(calibration):
        raise CalibrationUnreadable(
            name, found="another content on reading back", expected="what was fitted", remedy="report it: it is a fault"
        )
    return content


def failure_of(error: BaseException, paths: Mapping[Path, StoredLog] | None = None) -> Failure:
    """An error as the table tells it.

    Args:
        error: of ours, or one that nobody expected.
        paths: of copies, which nobody has seen: they are called by what they are copies of.
    """
    text = str(error) or type(error).__name__
    for path, log in (paths or {}).items():
        text = text.replace(str(path), log.address)
    return Failure(type(error).__name__, text, int(exit_code(type(error)) or ExitCode.UNEXPECTED))
