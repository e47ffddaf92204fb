"""Results in the files of a cell after a run:
gains, report, history and drift, proposals with the command to type.

Everything is read, and nothing written. The places are those of the cell file and of the command
line; a browser names none of them.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from daq.config.cell import Cell
from daq.config.same_cell import require_cell_of
from daq.documents.calibration_file import load_calibration
from daq.documents.session_state import GuidedState, Outcome
from daq.errors import CalibrationRefused, DaqError, ExitCode
from daq.jobs.guided import motion_left_s
from daq.jobs.position import position_of, sessions_folder
from daq.jobs.reporting import Conclusion, to_do
from daq.jobs.session import CALIBRATION, REPORT, Session, begun_until, sessions
from daq.ledger.ledger import MAY_LACK, Ledger, read_history
from daq.ledger.watch import Series, alarm_text, watch
from daq.report.residual_page import PAGE
from ident.calibration import Calibration
from ident.errors import IdentificationError

LARGEST_REPORT_BYTES = 64 << 20
#: Errors of reading files, also of those whose content no reader expected
UNREADABLE = (
    DaqError,
    IdentificationError,
    OSError,
    ValueError,
    LookupError,
    TypeError,
    ArithmeticError,
)


class Results:
    """Reads the files again when they have changed."""

    def __init__(
        self,
        cell_file: Path,
        cell: Cell,
        calibration: Path | None = None,
        report: Path | None = None,
        now: Callable[[], datetime] = lambda: datetime.now(UTC),
    ) -> None:
        """Store the places that may be read; calibration and folder of the report are those of the
        command line.
        """
        self._cell_file = cell_file
        self._cell = cell
        self._calibration = calibration
        self._report = report
        self._now = now
        self._read: dict[Path, tuple[tuple[int, int], Calibration]] = {}

    def calibration(self) -> tuple[Path, Calibration] | None:
        """Return the calibration of the command line, else that of the newest session;
        None without either.

        Raises:
            DaqError: it cannot be read.
        """
        newest = self._newest()
        path = self._calibration
        if path is None and newest is not None:
            path = newest.folder / CALIBRATION
        if path is None or not path.exists():
            return None
        status = path.stat()
        mark = (status.st_mtime_ns, status.st_size)
        if path in self._read:
            mark_read, calibration = self._read[path]
            if mark_read == mark:
                return path, calibration
        calibration = load_calibration(path)
        self._read = {path: (mark, calibration)}
        return path, calibration

    def report(self) -> bytes | None:
        """Return the page of the report, that of the command line or of the newest session;
        None without one.
        """
        path = self._report_path()
        if path is None or path.stat().st_size > LARGEST_REPORT_BYTES:
            return None
        return path.read_bytes()

    def document(self) -> dict[str, Any]:
        """Return everything for the page;
        a file that cannot be read is a sentence in `problems`.
        """
        problems: list[str] = []
        has_report = self._report_path() is not None
        found: dict[str, Any] = {"problems": problems, "report": has_report}
        parts: dict[str, Callable[[], Any]] = {
            "gains": self._gains,
            "history": self._history,
            "session": self._session,
            "guided": self._guided,
        }
        for name, read in parts.items():
            try:
                found[name] = read()
            except (DaqError, IdentificationError, OSError) as error:
                found[name] = None
                problems.append(str(error))
            except UNREADABLE as error:
                found[name] = None
                problems.append(f"{name} cannot be shown, a file does not fit: {error}")
        return found

    def _newest(self) -> Session | None:
        """Return the session of the job or of `calibrate` that was begun last;
        None without either.
        """
        candidates = (self._newest_job(), self._newest_guided())
        found = [session for session in candidates if session is not None]
        return max(found, key=lambda session: session.began, default=None)

    def _newest_job(self) -> Session | None:
        section = self._cell.recalibration
        if section is None:
            return None
        return self._newest_in(section.folder)

    def _newest_guided(self) -> Session | None:
        return self._newest_in(sessions_folder(self._cell_file))

    def _newest_in(self, folder: Path) -> Session | None:
        all_sessions = sessions(folder, self._cell.name)
        past = begun_until(all_sessions, self._now())
        if past:
            return past[-1]
        return None

    def _report_path(self) -> Path | None:
        newest = self._newest()
        folder = self._report
        if folder is None and newest is not None:
            folder = newest.folder / REPORT
        if folder is None:
            return None
        page = folder / PAGE
        if not page.is_file():
            return None
        return page

    def _gains(self) -> dict[str, Any] | None:
        known = self.calibration()
        if known is None:
            return None
        path, calibration = known
        require_cell_of(
            calibration,
            self._cell,
            CalibrationRefused,
            str(path),
            remedy="give the calibration of this cell",
        )
        error = calibration.holdout_error_percent
        measured_on = "held-out runs"
        if error is None:
            error = calibration.relative_error_percent
            measured_on = "the fit's own runs"
        axes = []
        for gain, error_percent in zip(calibration.gains, error.axes, strict=True):
            axis = {
                "axis": gain.axis,
                "unit": gain.unit,
                "value": gain.value,
                "std": gain.std,
                "nameplate": gain.nameplate,
                "change_percent": gain.change_percent,
                "error_percent": error_percent,
            }
            axes.append(axis)
        return {
            "file": path.name,
            "created": calibration.created,
            "error": measured_on,
            "axes": axes,
        }

    def _history(self) -> dict[str, Any] | None:
        ledger = Ledger.of(self._cell)
        if ledger is None:
            return None
        history = read_history(ledger)
        if not history.entries and not history.may_lack:
            return None
        series = watch(history.entries, history.acknowledgements)
        problem = None
        if history.may_lack:
            problem = MAY_LACK
        cell_file = shlex.quote(str(self._cell_file))
        return {
            "calibrations": len(history.entries),
            "problem": problem,
            "axes": [_axis_history(one) for one in series],
            "command": f"drivegain history {cell_file}",
        }

    def _guided(self) -> dict[str, Any] | None:
        """Return where the newest session of `calibrate` is,
        and σ of each gain after each block.
        """
        newest = self._newest_guided()
        if newest is None or not isinstance(newest.state, GuidedState):
            return None
        state = newest.state
        position = position_of(state)
        found: dict[str, Any] = {
            "session": state.session,
            "stage": position.stage.value,
            "next_step": position.next_step,
            "blocks": [run.name for run in state.runs],
            "missing": state.missing,
            "would_help": list(state.would_help),
            "precision": None,
            "acceptance": None,
        }
        if state.progress and state.gains:
            found["precision"] = _precision(self._cell, state)
        if state.acceptance is not None:
            found["acceptance"] = {
                "accepted": state.acceptance.accepted,
                "remark": state.acceptance.remark,
            }
        return found

    def _session(self) -> dict[str, Any] | None:
        newest = self._newest()
        if newest is None:
            return None
        state = newest.state
        outcome = state.outcome
        outcome_text = "not finished"
        steps: list[str] = []
        if outcome is not None:
            outcome_text = outcome.value
            exit_code = state.exit_code or ExitCode.OK
            ended = Conclusion(outcome, exit_code, newest, state.problem)
            steps = to_do(ended, self._cell_file)
        kind = "Scheduled recalibration"
        if isinstance(state, GuidedState):
            kind = "Session"
        runs = [{"name": run.name, "samples": run.samples} for run in state.runs]
        sentences = []
        if state.fitted is not None:
            sentences = list(state.fitted.sentences)
        return {
            "session": state.session,
            "kind": kind,
            "outcome": outcome_text,
            "waits": outcome is Outcome.PROPOSED,
            "problem": state.problem,
            "runs": runs,
            "sentences": sentences,
            "to_do": steps,
        }


def _axis_history(series: Series) -> dict[str, Any]:
    """Return the drift of one axis; null where there are fewer than two calibrations."""
    change_percent = None
    change_sigmas = None
    if series.drift is not None and len(series.points) >= 2:
        change_percent = series.drift.change_percent
        change_sigmas = series.drift.change_sigmas
    return {
        "axis": series.axis,
        "change_percent": change_percent,
        "change_sigmas": change_sigmas,
        "alarm": alarm_text(series),
    }


def _precision(cell: Cell, state: GuidedState) -> dict[str, Any]:
    """Return σ of each gain after each judged block, its target, the motion that is left,
    and why it is.
    """
    worst = max(state.gains, key=lambda gain: gain.std_percent / gain.target_percent)
    last = state.progress[-1]
    judged = state.blocks[: last.blocks]
    progress = [one.model_dump(mode="json") for one in state.progress]
    block_s = last.motion_s / last.blocks
    left_s = motion_left_s(cell, state.gains, judged, block_s)
    return {
        "axes": [gain.axis for gain in state.gains],
        "target_percent": state.gains[0].target_percent,
        "progress": progress,
        "worst": worst.axis,
        "why": worst.cause,
        "left_s": left_s,
    }
