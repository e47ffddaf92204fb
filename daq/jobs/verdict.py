"""What becomes of a calibration: nothing, a proposal for a person, or the controller's new gains."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Self

from daq.config.cell import Cell
from daq.config.policy import AppliedBy, HistoryPlace
from daq.errors import DaqError, OutputFailed
from daq.files import replace_file, sha256, sha256_of
from daq.jobs import session as sessions
from daq.jobs.journal import Journal, Level
from daq.jobs.recording import JobContext
from daq.jobs.session import CALIBRATION, Decision, JudgedGain, Outcome, Session, Target, WatchedGain
from daq.ledger.audit import AuditAction, append
from daq.ledger.audit import read as read_audit
from daq.ledger.judgement import Known, judge, known_of
from daq.ledger.ledger import Ledger
from daq.ledger.watch import alarm_text, watch
from daq.workflow.calibration_file import read
from daq.writeback.file_access import resolve_links
from daq.writeback.file_target import FileEdit, FileTarget
from daq.writeback.gates.gate import Gate
from daq.writeback.request import GainChange, Request
from daq.writeback.target import Proposal, Written
from ident.calibration import Calibration
from ident.drift.change import FALSE_ALARM

# What the cell's history says of the gains in force, and what a job adds to it.


class GainHistory:
    """The history of a cell, open; a context manager.

    Args:
        cell: that it is of.
        place: of its files.
        controller: file whose gains are in force.
        now: wall clock.
        who: the job.
    """

    def __init__(
        self, cell: Cell, place: HistoryPlace, controller: Path, now: Callable[[], datetime], who: str
    ) -> None:
        self._target = str(resolve_links(controller))
        self._now = now
        self._store = Ledger(cell, place, who)
        self._digest = ""

    def __enter__(self) -> Self:
        """Open it.

        Raises:
            HistoryUnreadable: see `daq.ledger.store`.
        """
        self._store.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._store.__exit__(kind, error, trace)

    def enter(self, calibration: Calibration, path: Path) -> None:
        """Enter this session's calibration; once, however often a session is taken up.

        Raises:
            DataError, HistoryUnreadable, OutputFailed: see `daq.ledger.store`.
        """
        self._digest = sha256_of(path) or ""
        self._store.add(calibration, digest=self._digest, at=self._now())

    def note_applied(self, sha256_after: str) -> None:
        """Enter, once, that the controller's file has this session's gains and this SHA-256. Raises as `enter`."""
        self._store.record_applied(self._digest, at=self._now(), target=self._target, sha256_after=sha256_after)

    def watched(self) -> tuple[WatchedGain, ...]:
        """What the charts of all gains say, in the order of the axes. Raises as `keep`."""
        series = watch(self._store.entries(), self._store.acknowledgements())
        return tuple(WatchedGain(axis=one.axis, alarm=alarm_text(one) or "") for one in series)

    def known(self, changes: Sequence[GainChange]) -> Known:
        """What the changes by this session's calibration are judged by. Raises as `keep`."""
        return known_of(self._store, self._target, self._digest, changes)


CHANGED_SINCE_START = "The controller's file was written or rolled back since the session began: a person decides."
PROPOSAL, DIFF = "proposal.json", "proposal.diff"


def decide_outcome(
    context: JobContext, session: Session, calibration: Calibration, gain_history: GainHistory, journal: Journal
) -> Session:
    """Compare a calibration with the gains in the controller, and do what follows from it; the state has the outcome.

    Raises:
        CalibrationRefused: a gate is closed; the controller's file stands as it was, and the session is over.
        AuditUnusable, OutputFailed: see `daq.writeback.target`.
    """
    session = _written_before(context, session, gain_history, journal)
    if session.state.outcome is not None:
        return session
    path, now = session.folder / CALIBRATION, context.tools.now()
    request = Request(calibration, now, file=path, content=read(path))
    proposal = context.tools.propose(FileTarget.of(context.cell), request)
    edit = proposal.edit
    decision = decision_of(proposal, gain_history)
    differs, touched = any(gain.differs for gain in decision.gains), _written_since(context, session)
    if differs and touched:
        decision = decision.model_copy(update={"remark": f"{decision.remark} {CHANGED_SINCE_START}"})
    journal.say(Level.NOTICE, "compared with the gains in the controller", words=decision.remark)
    after = sha256(edit.after)
    target = Target(
        file=str(edit.file),
        base_sha256=edit.base_sha256,
        after_sha256=after,
        looked_at=edit.base,
        unsigned=any(refusal.gate is Gate.SIGNATURE for refusal in proposal.refusals),
    )
    _write_proposal(session, proposal, after)
    # Before anything is written: whoever finds this state after a kill sees by the file's digest whether it was.
    session = sessions.save(replace(session, state=session.state.with_(decision=decision, target=target)))
    closed = [refusal for refusal in proposal.refusals if refusal.gate is not Gate.SIGNATURE]
    if closed:
        for refusal in closed:
            journal.say(Level.ERROR, "a gate is closed", gate=refusal.gate.value, text=str(refusal))
        sessions.save(_with_outcome(session, Outcome.REFUSED))
        _apply(context, proposal, now)  # which refuses it, and writes that down
    if not edit.has_effect or not differs:
        return sessions.save(_with_outcome(session, Outcome.UNCHANGED))
    if proposal.refusals or needs_person(context) or touched:
        _propose(context, session, target, journal)
        return sessions.save(_with_outcome(session, Outcome.PROPOSED))
    written = _apply(context, proposal, now)
    if written is not None:
        journal.say(Level.NOTICE, "written to the controller's file", file=edit.subject, backup=str(written.backup))
    _note(context, gain_history, after, journal)
    return sessions.save(_with_outcome(session, Outcome.APPLIED))


def _apply(context: JobContext, proposal: Proposal[FileEdit], now: datetime) -> Written | None:
    try:
        return context.tools.apply(proposal, now, audit=context.target.history.audit, who=context.who)
    except OSError as error:
        raise OutputFailed.of(proposal.edit.file, error) from error


def _note(context: JobContext, gain_history: GainHistory, after_sha256: str, journal: Journal) -> None:
    """The history's turn. The controller has its gains, and no trouble of the history's may call that undone."""
    try:
        gain_history.note_applied(after_sha256)
    except DaqError as error:
        journal.say(Level.WARNING, "the history does not know of this write", text=str(error))


def needs_person(context: JobContext) -> bool:
    """Whether a person applies: by the cell's policy, and wherever drives are written to."""
    return context.cell.apply.by is AppliedBy.PERSON or bool(context.target.controller.objects)


def decision_of(proposal: Proposal[FileEdit], gain_history: GainHistory) -> Decision:
    """Whether any gain differs from the controller's by more than chance (`daq.ledger.judgement`).

    An axis differs by itself where its probability among all of them says so.
    """
    known = gain_history.known(proposal.edit.changes)
    found = judge(proposal.edit.changes, known)
    changes = {change.axis: change for change in proposal.edit.changes}
    gains = tuple(
        JudgedGain(
            axis=axis,
            unit=changes[axis].unit,
            old=changes[axis].old,
            old_std=known.stds[axis],
            new=changes[axis].new,
            new_std=changes[axis].std,
            change_percent=_finite(drift.percent),
            drift_sigma=_finite(drift.sigmas),
            differs=probability <= FALSE_ALARM,
        )
        for axis, drift, probability in zip(found.axes, found.changes, found.adjusted, strict=True)
    )
    return Decision(gains=gains, remark=found.words)


def _written_before(context: JobContext, session: Session, gain_history: GainHistory, journal: Journal) -> Session:
    """A job that was killed behind its write has written all the same: it is noted, and never done twice."""
    target = session.state.target
    if target is None or target.base_sha256 == target.after_sha256:
        return session
    if sha256_of(Path(target.file)) != target.after_sha256:
        return session
    journal.say(Level.NOTICE, "the controller's file has these gains already: an earlier job of this session wrote it")
    _note(context, gain_history, target.after_sha256, journal)
    return sessions.save(_with_outcome(session, Outcome.APPLIED))


def _written_since(context: JobContext, session: Session) -> bool:
    """Whether the audit tells of a write of the controller's file, or of a way back, since the session began.

    An earlier job of it may have been killed right behind its write, and a person may have rolled that back since: the
    file is then what it was before, and the job must not do again what the person has undone.
    """
    entries = read_audit(context.target.history.audit)
    begun = [
        index
        for index, entry in enumerate(entries)
        if entry.action is AuditAction.RECALIBRATION_BEGUN and entry.subject == str(session.folder)
    ]
    file = str(resolve_links(context.target.file))
    ends = (AuditAction.APPLIED, AuditAction.ROLLED_BACK)
    # Of an audit that does not know the begin, all of it is later: the part that knew it was moved away.
    return any(entry.action in ends and entry.subject == file for entry in entries[begun[0] if begun else 0 :])


def _propose(context: JobContext, session: Session, target: Target, journal: Journal) -> None:
    append(
        context.target.history.audit,
        AuditAction.PROPOSED,
        at=context.tools.now(),
        who=context.who,
        subject=str(resolve_links(context.target.file)),
        details={
            "session": session.state.session,
            "calibration_sha256": sha256_of(session.folder / CALIBRATION) or "",
            "sha256_before": target.base_sha256,
            "sha256_after": target.after_sha256,
        },
    )
    journal.say(Level.NOTICE, "proposed: a person must apply it", folder=str(session.folder))


def _write_proposal(session: Session, proposal: Proposal[FileEdit], after_sha256: str) -> None:
    """The change as a person and a program read it, beside the calibration."""
    document = {
        "file": str(proposal.edit.file),
        "base_sha256": proposal.edit.base_sha256,
        "after_sha256": after_sha256,
        "changes": [
            {
                "axis": change.axis,
                "key": change.key,
                "old": _finite(change.old),
                "new": _finite(change.new),
                "std": _finite(change.std),
                "unit": change.unit,
                "change_percent": _finite(change.change_percent),
            }
            for change in proposal.edit.changes
        ],
        "refusals": [{"gate": refusal.gate.value, "text": str(refusal)} for refusal in proposal.refusals],
    }
    try:
        replace_file(session.folder / PROPOSAL, (json.dumps(document, indent=2, ensure_ascii=False) + "\n").encode())
        replace_file(session.folder / DIFF, proposal.edit.diff.encode())
    except OSError as error:
        raise OutputFailed.of(session.folder / PROPOSAL, error) from error


def _with_outcome(session: Session, outcome: Outcome) -> Session:
    return replace(session, state=session.state.with_(outcome=outcome))


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None
