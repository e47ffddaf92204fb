"""What came of a job, for a person and for a program: summary.txt and summary.json of the session."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daq.jobs.session import CALIBRATION, REPORT, JudgedGain, Outcome, Session

SUMMARY_TEXT, SUMMARY_JSON = "summary.txt", "summary.json"


@dataclass(frozen=True, slots=True)
class Conclusion:
    """How a job ended.

    Attributes:
        outcome: of it.
        exit_code: that the command ends with.
        session: as it stands, None where none was begun.
        remark: why, in one sentence.
    """

    outcome: Outcome
    exit_code: int
    session: Session | None
    remark: str


def document(conclusion: Conclusion, cell_file: Path) -> dict[str, Any]:
    """As `recalibrate --json` and summary.json have it."""
    found: dict[str, Any] = {
        "outcome": conclusion.outcome.value,
        "exit_code": conclusion.exit_code,
        "remark": conclusion.remark,
        "to_do": to_do(conclusion, cell_file),
    }
    if conclusion.session is not None:
        session = conclusion.session
        found |= {"folder": str(session.folder), **session.state.model_dump(mode="json")}
        found["outcome"], found["exit_code"] = conclusion.outcome.value, conclusion.exit_code
    return found


def text(conclusion: Conclusion, cell_file: Path) -> str:
    """For a person."""
    session = conclusion.session
    # The words of the decision stand above its table.
    decided = session is not None and session.state.decision is not None and not session.state.problem
    lines = [
        f"Outcome: {conclusion.outcome.value} (exit code {conclusion.exit_code})",
        *(() if decided or not conclusion.remark else (conclusion.remark,)),
    ]
    if session is not None:
        state = session.state
        lines += [
            f"Session {state.session} of cell {state.cell}, begun {state.began}, job {state.attempt} of it.",
            *(_run_line(run.name, run.samples, run.lost_cycles, run.attempts) for run in state.runs),
        ]
        if state.fitted is not None:
            lines += ["", "Residual:", *(f"  {sentence}" for sentence in state.fitted.sentences)]
        if state.decision is not None:
            lines += ["", f"Gains: {state.decision.remark}", *map(_gain_line, state.decision.gains)]
        drifts = [gain.alarm for gain in state.watched if gain.alarm]
        if drifts:
            lines += ["", "Drift (`drivegain history` shows it):", *(f"  {alarm}" for alarm in drifts)]
        lines += ["", f"Folder: {session.folder}"]
        if (session.folder / REPORT / "report.html").exists():
            lines.append(f"Report: {session.folder / REPORT / 'report.html'}")
    lines += ["", "To do:", *(f"  {line}" for line in to_do(conclusion, cell_file))]
    return "\n".join(lines) + "\n"


def to_do(conclusion: Conclusion, cell_file: Path) -> list[str]:
    """What a person should do now, a line each."""
    session, outcome = conclusion.session, conclusion.outcome
    if outcome is Outcome.PROPOSED and session is not None and session.state.target is not None:
        calibration, cell = shlex.quote(str(session.folder / CALIBRATION)), shlex.quote(str(cell_file))
        sign = f"let a second person sign it: drivegain sign calibration {calibration} --key KEY --name NAME"
        return [
            *([sign] if session.state.target.unsigned else []),
            f"drivegain apply {calibration} --cell {cell}",
            "look at the change, and if it is right, write it:",
            f"drivegain apply {calibration} --cell {cell} --yes --base {session.state.target.looked_at}",
        ]
    if outcome is Outcome.APPLIED and session is not None and session.state.target is not None:
        return [
            "let the controller load the file",
            f"to undo it: drivegain rollback --cell {shlex.quote(str(cell_file))}",
        ]
    return {
        Outcome.REFUSED: ["see why the gate is closed; the next job records anew"],
        Outcome.UNFIT: ["see what is wrong with the recordings (`drivegain info LOG`); the next job records anew"],
        Outcome.STOPPED: ["see to what stood in the way; the next job goes on with this session while it is young"],
        Outcome.INTERRUPTED: ["nothing, or run the job again: it goes on with this session while it is young"],
    }.get(outcome, ["nothing"])


def _run_line(name: str, samples: int, lost_cycles: int, recordings: int) -> str:
    return f"  {name}: {samples} samples, {lost_cycles} cycles lost, {recordings} recording{'s' * (recordings != 1)}"


def _gain_line(gain: JudgedGain) -> str:
    change = "" if gain.change_percent is None else f", {gain.change_percent:+.2f} %"
    drift = "" if gain.drift_sigma is None else f" ({abs(gain.drift_sigma):.1f} σ)"
    return (
        f"  {gain.axis}: {gain.old:.5g} in the controller, {gain.new:.5g} ± {gain.new_std:.2g} {gain.unit} "
        f"found{change}{drift}{': differs' if gain.differs else ''}"
    )
