"""What becomes of a calibration: nothing, a proposal for a person, or the controller's new gains."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from daq.atomic_file import replace_file
from daq.calibration_file import read
from daq.configuration.apply_policy import AppliedBy
from daq.digest import sha256, sha256_of
from daq.errors import DaqError, OutputFailed
from daq.history.judgement import judge
from daq.recalibration import session as sessions
from daq.recalibration.journal import Journal, Level
from daq.recalibration.past import Past
from daq.recalibration.recording import Cellside
from daq.recalibration.session import CALIBRATION, Decision, JudgedGain, Outcome, Session, Target
from daq.write_back.apply import Proposal
from daq.write_back.audit import AuditAction, append
from daq.write_back.audit import read as read_audit
from daq.write_back.controller_write import Written
from daq.write_back.gates import Gate
from daq.write_back.link import followed
from daq.write_back.request import Request
from ident.calibration import Calibration
from ident.drift import FALSE_ALARM

TOUCHED = "The controller's file was written or rolled back since the session began: a person decides."
PROPOSAL, DIFF = "proposal.json", "proposal.diff"


def settle(side: Cellside, session: Session, calibration: Calibration, past: Past, journal: Journal) -> Session:
    """Compare a calibration with the gains in the controller, and do what follows from it; the state has the outcome.

    Raises:
        CalibrationRefused: a gate is closed; the controller's file stands as it was, and the session is over.
        ControllerChanged, ControllerBusy, ControllerUnfit, AuditUnusable, OutputFailed: see `daq.write_back.apply`.
    """
    session = _written_before(side, session, past, journal)
    if session.state.outcome is not None:
        return session
    path, now = session.folder / CALIBRATION, side.tools.now()
    request = Request(calibration, now, file=path, content=read(path))
    proposal = side.tools.propose(side.cell, request)
    decision = decision_of(proposal, past)
    differs, touched = any(gain.differs for gain in decision.gains), _written_since(side, session)
    if differs and touched:
        decision = decision.model_copy(update={"remark": f"{decision.remark} {TOUCHED}"})
    journal.say(Level.NOTICE, "compared with the gains in the controller", words=decision.remark)
    after = sha256(proposal.after_content)
    target = Target(
        file=str(proposal.file),
        base_sha256=proposal.base_sha256,
        after_sha256=after,
        looked_at=proposal.looked_at,
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
        _apply(side, proposal, now)  # which refuses it, and writes that down
    if proposal.after_content == proposal.before_content or not differs:
        return sessions.save(_with_outcome(session, Outcome.UNCHANGED))
    if proposal.refusals or by_a_person(side) or touched:
        _propose(side, session, target, journal)
        return sessions.save(_with_outcome(session, Outcome.PROPOSED))
    written = _apply(side, proposal, now)
    if written is not None:
        journal.say(
            Level.NOTICE, "written to the controller's file", file=str(written.file), backup=str(written.backup)
        )
    _note(side, past, after, journal)
    return sessions.save(_with_outcome(session, Outcome.APPLIED))


def _apply(side: Cellside, proposal: Proposal, now: datetime) -> Written | None:
    try:
        return side.tools.apply(proposal, now, audit=side.target.history.audit, who=side.who)
    except OSError as error:
        raise OutputFailed.of(proposal.file, error) from error


def _note(side: Cellside, past: Past, after_sha256: str, journal: Journal) -> None:
    """The history's turn. The controller has its gains, and no trouble of the history's may call that undone."""
    try:
        past.note_applied(side.target.history.audit, after_sha256)
    except DaqError as error:
        journal.say(Level.WARNING, "the history does not know of this write", text=str(error))


def by_a_person(side: Cellside) -> bool:
    """Whether a person applies: by the cell's policy, and wherever drives are written to."""
    return side.cell.apply.by is AppliedBy.PERSON or bool(side.target.controller.objects)


def decision_of(proposal: Proposal, past: Past) -> Decision:
    """Whether any gain differs from the controller's by more than chance (`daq.history.judgement`).

    An axis differs by itself where its probability among all of them says so.
    """
    known = past.known(proposal.changes)
    found = judge(proposal.changes, known)
    changes = {change.axis: change for change in proposal.changes}
    gains = tuple(
        JudgedGain(
            axis=axis,
            unit=changes[axis].unit,
            old=changes[axis].old,
            old_std=known.stds[axis],
            new=changes[axis].new,
            new_std=changes[axis].std,
            change_percent=_finite(told.percent),
            drift_sigma=_finite(told.sigmas),
            differs=probability <= FALSE_ALARM,
        )
        for axis, told, probability in zip(found.axes, found.changes, found.adjusted, strict=True)
    )
    return Decision(gains=gains, remark=found.words)


def _written_before(side: Cellside, session: Session, past: Past, journal: Journal) -> Session:
    """A job that was killed behind its write has written all the same: it is noted, and never done twice."""
    target = session.state.target
    if target is None or target.base_sha256 == target.after_sha256:
        return session
    if sha256_of(Path(target.file)) != target.after_sha256:
        return session
    journal.say(Level.NOTICE, "the controller's file has these gains already: an earlier job of this session wrote it")
    _note(side, past, target.after_sha256, journal)
    return sessions.save(_with_outcome(session, Outcome.APPLIED))


def _written_since(side: Cellside, session: Session) -> bool:
    """Whether the audit tells of a write of the controller's file, or of a way back, since the session began.

    An earlier job of it may have been killed right behind its write, and a person may have rolled that back since: the
    file is then what it was before, and the job must not do again what the person has undone.
    """
    entries = read_audit(side.target.history.audit)
    begun = [
        index
        for index, entry in enumerate(entries)
        if entry.action is AuditAction.RECALIBRATION_BEGUN and entry.subject == str(session.folder)
    ]
    file = str(followed(side.target.file))
    ends = (AuditAction.APPLIED, AuditAction.ROLLED_BACK)
    # Of an audit that does not know the begin, all of it is later: the part that knew it was moved away.
    return any(entry.action in ends and entry.subject == file for entry in entries[begun[0] if begun else 0 :])


def _propose(side: Cellside, session: Session, target: Target, journal: Journal) -> None:
    append(
        side.target.history.audit,
        AuditAction.PROPOSED,
        at=side.tools.now(),
        who=side.who,
        subject=str(followed(side.target.file)),
        details={
            "session": session.state.session,
            "calibration_sha256": sha256_of(session.folder / CALIBRATION) or "",
            "sha256_before": target.base_sha256,
            "sha256_after": target.after_sha256,
        },
    )
    journal.say(Level.NOTICE, "proposed: a person must apply it", folder=str(session.folder))


def _write_proposal(session: Session, proposal: Proposal, after_sha256: str) -> None:
    """The change as a person and a program read it, beside the calibration."""
    document = {
        "file": str(proposal.file),
        "base_sha256": proposal.base_sha256,
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
            for change in proposal.changes
        ],
        "refusals": [{"gate": refusal.gate.value, "text": str(refusal)} for refusal in proposal.refusals],
    }
    try:
        replace_file(session.folder / PROPOSAL, (json.dumps(document, indent=2, ensure_ascii=False) + "\n").encode())
        replace_file(session.folder / DIFF, proposal.diff.encode())
    except OSError as error:
        raise OutputFailed.of(session.folder / PROPOSAL, error) from error


def _with_outcome(session: Session, outcome: Outcome) -> Session:
    return replace(session, state=session.state.with_(outcome=outcome))


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None
