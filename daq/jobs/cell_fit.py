"""Fit one cell of a fleet, in any process: a calibration, or the reason for a failure;
and the cache of results.
"""

from __future__ import annotations

import json
import re
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from enum import Enum
from pathlib import Path
from typing import Literal

from daq.advice import for_command_line
from daq.config.yaml_file import MAX_BYTES, StrictModel
from daq.documents.calibration_file import as_document, decode_calibration, encode_calibration
from daq.environment import software
from daq.errors import (
    CalibrationUnreadable,
    DaqError,
    ExitCode,
    LogsDiffer,
    LogUnreadable,
    UsageError,
    exit_code,
    writing,
)
from daq.files import judge_target, read_regular, replace_file, sha256
from daq.jobs.fleet_survey import CellLogs, SeenLog, StoredLog, at_hand, fingerprint
from daq.workflow.fit import BOOTSTRAP_SEED, calibration_of, check_holdout, close_loop, fit
from drivers.errors import DriverError
from ident.calibration import Gain
from ident.errors import IdentificationError


class Loop(Enum):
    """Whether missing effects are detected and added."""

    OPEN = "open"
    CLOSED = "closed"


@dataclass(frozen=True, slots=True)
class Failure:
    """Why a cell has no calibration."""

    kind: str  #: name of the error's class
    text: str  #: found, expected and to do, as a single fit would say it
    exit_code: int  #: that a single fit would have ended with
    seconds: float = 0.0  #: that it took to find out


@dataclass(frozen=True, slots=True)
class Summary:
    """Summary of one calibration, small enough to be sent."""

    gains: tuple[Gain, ...]  #: one an axis
    effects: tuple[tuple[str, str], ...]  #: family and axis of each accepted effect
    #: ‖ρ‖/‖Y‖ in total on the run held out, of the fit where there is none [%]
    error_percent: float
    held_out: bool  #: whether it is that of a run held out
    partial: bool  #: it rests on a log that was never finished, or with losses

    @property
    def worst(self) -> Gain:
        """The gain that is known least well."""
        return max(self.gains, key=lambda gain: gain.std_percent)


@dataclass(frozen=True, slots=True)
class FleetFit:
    """Result of a worker; small, whatever the size of the logs."""

    summary: Summary  #: of the calibration
    content: bytes  #: of its file, found to say the same
    seconds: float  #: that it took, reading included


def fit_cell(cell: CellLogs, loop: Loop, created: datetime) -> FleetFit | Failure:
    """Fit one cell in this process, as `drivegain fit` (or `residual`) would with the same logs."""
    begun_s = time.perf_counter()
    every_log = (*cell.fit, *cell.holdout)
    paths: dict[Path, StoredLog] = {}
    with tempfile.TemporaryDirectory(prefix="drivegain-fleet-") as folder:
        try:
            for seen in every_log:
                try:
                    seen.log.name.encode()  # the calibration holds it
                except UnicodeEncodeError as error:
                    raise LogUnreadable(
                        seen.log.address,
                        found="bytes in its name that are no UTF-8",
                        expected="a name that a calibration can hold",
                        remedy="rename it",
                    ) from error
                paths[at_hand(seen.log, Path(folder))] = seen.log
            logs = list(paths)
            is_searched = loop is Loop.CLOSED
            fit_count = len(cell.fit)
            fitted = fit(
                logs[:fit_count],
                holdout=logs[fit_count:],
                keep_rows=is_searched,
                judge_holdout=not is_searched,
            )
            if is_searched:
                fitted = close_loop(fitted, BOOTSTRAP_SEED)
                check_holdout(fitted)
            for seen in every_log:
                if fingerprint(seen.log) != seen.fingerprint:
                    raise LogsDiffer(
                        seen.log.address,
                        found="another content than at the survey of the logs",
                        expected="logs that do not change while they are fitted",
                        remedy="start it again",
                    )
            calibration = calibration_of(fitted, created)
            # Encoded and verified in the worker: that takes a tenth of the time of a fit.
            content = encode_calibration(calibration)
            if as_document(decode_calibration(content, cell.cell)) != as_document(calibration):
                raise CalibrationUnreadable(
                    cell.cell,
                    found="another content on reading back",
                    expected="what was fitted",
                    remedy="report it: it is a fault",
                )
        except (DaqError, DriverError, IdentificationError) as error:
            return replace(failure_of(error, paths), seconds=time.perf_counter() - begun_s)
    unseen = calibration.holdout_error_percent
    measured = unseen or calibration.relative_error_percent
    effects = tuple((effect.name, effect.axis) for effect in calibration.effects)
    is_partial = any(source.partial for source in calibration.sources)
    summary = Summary(
        gains=calibration.gains,
        effects=effects,
        error_percent=measured.total,
        held_out=unseen is not None,
        partial=is_partial,
    )
    return FleetFit(summary, content, time.perf_counter() - begun_s)


def failure_of(error: BaseException, paths: Mapping[Path, StoredLog] | None = None) -> Failure:
    """Convert an error to a row of the table.

    Args:
        paths: temporary copies; the text names the logs instead.
    """
    text = for_command_line(str(error)) or type(error).__name__
    for path, log in (paths or {}).items():
        text = text.replace(str(path), log.address)
    return Failure(type(error).__name__, text, int(exit_code(type(error)) or ExitCode.UNEXPECTED))


STATE_VERSION = 1


class CachedFit(StrictModel):
    """What a cached calibration was made of, and its summary."""

    format: Literal["drivegain-fleet-state"] = "drivegain-fleet-state"
    inputs_sha256: str
    calibration_sha256: str
    seconds: float
    summary: Summary


@dataclass(frozen=True, slots=True)
class CalibrationCache:
    """A calibration file a cell, and next to each a small JSON file that says what it was made
    of.
    """

    folder: Path  #: made already
    loop: Loop  #: what is wanted of every cell

    def file(self, cell: CellLogs) -> Path:
        """Calibration file of a cell: its name in safe characters,
        and the first digits of its digest.
        """
        name = re.sub(r"[^\w.-]", "_", cell.cell)[:40]
        return self.folder / f"{name}-{cell.configuration_sha256[:12]}.yaml"

    def cached(self, cell: CellLogs) -> tuple[Summary, float] | None:
        """Summary of the cached calibration of these logs, and the seconds that it took;
        None where there is none.

        The file itself is not parsed: its digest identifies it.

        Raises:
            UsageError: a file is in the way that must not be replaced.
        """
        file = self.file(cell)
        for path in (file, file.with_suffix(".json")):
            _check_replaceable(path)
        try:
            # Read without waiting for a pipe, and no more than a calibration can have.
            state = read_regular(file.with_suffix(".json"), MAX_BYTES)
            found = CachedFit.model_validate_json(state)
            digest = sha256(read_regular(file, MAX_BYTES))
        except (OSError, ValueError):
            return None  # unreadable: made again
        if (found.inputs_sha256, found.calibration_sha256) != (self._inputs(cell), digest):
            return None
        return found.summary, found.seconds

    def store(self, cell: CellLogs, fitted: FleetFit) -> Path:
        """Store a calibration; after a kill at any point,
        the cache is whole or the entry is made anew.

        Raises:
            OutputFailed: the file system refuses.
        """
        file = self.file(cell)
        state = CachedFit(
            inputs_sha256=self._inputs(cell),
            calibration_sha256=sha256(fitted.content),
            seconds=fitted.seconds,
            summary=fitted.summary,
        )
        state_file = file.with_suffix(".json")
        contents = {file: fitted.content, state_file: state.model_dump_json(indent=1).encode()}
        for path, content in contents.items():
            with writing(path):
                replace_file(path, content)
        return file

    def _inputs(self, cell: CellLogs) -> str:
        """Digest of all that decides a calibration:
        software, options, configuration, logs and their roles.
        """
        logs = [_input("fit", seen) for seen in cell.fit]
        logs += [_input("holdout", seen) for seen in cell.holdout]
        decisive = (
            STATE_VERSION,
            software(),
            self.loop.value,
            cell.cell,
            cell.configuration_sha256,
            logs,
        )
        return sha256(json.dumps(decisive).encode())


def _input(role: str, seen: SeenLog) -> tuple[str, str, str, str | None]:
    """Return what of a log decides a calibration."""
    name = Path(seen.log.name).name
    return (role, name, seen.fingerprint, seen.mounting)


def open_cache(folder: Path, loop: Loop) -> CalibrationCache:
    """Make the folder, and see that files can be put there.

    Raises:
        UsageError: it is no folder.
        OutputFailed: the file system refuses.
    """
    if folder.exists() and not folder.is_dir():
        raise UsageError(
            str(folder), found="a file", expected="a folder, or none", remedy="choose another name"
        )
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    return CalibrationCache(folder, loop)


def _check_replaceable(path: Path) -> None:
    """Refuse, before the work is done, what `replace_file` would refuse."""
    try:
        found = ""
        if judge_target(path).is_dir():
            found = "a folder"
    except OSError as error:
        found = error.strerror or type(error).__name__
    if not found:
        return
    raise UsageError(
        str(path),
        found=found,
        expected="a file that an earlier fleet has left, or none",
        remedy="move it away, or choose another folder",
    )
