"""The last stage of a guided session: new moves with the current gains, and a verdict."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from daq.config.recalibration import PlannedRun
from daq.documents.session_state import Acceptance, Outcome, ScaleOfAxis, finite
from daq.errors import ControllerChanged
from daq.files import sha256_of
from daq.jobs.context import NextRun, SessionContext, before_motion
from daq.jobs.guided import guided, plan_with_room, require_same_cell, say_moves, write_plan
from daq.jobs.journal import Level
from daq.jobs.recording import log_of, record_valid
from daq.jobs.reporting import audit_entry, undo_command
from daq.jobs.session import CALIBRATION, Session
from daq.jobs.stages import calibration_made
from daq.ledger.audit import AuditAction
from daq.ledger.ledger import read_history
from daq.workflow.experiment import experiment_of
from daq.workflow.validate import Validation
from ident.calibration import Calibration

RUN = "acceptance"  #: Name of its log
SEED_STEP = 900  #: Added to the seed of the session: moves that no block has made
DURATION_S = 10.0
PIECES = 10  #: Of the run, for the σ of a scale
SIGMAS = 4.0  #: Distance of a scale from 1 that noise does not make, on any of some six axes
TOLERANCE = 0.02  #: Distance from 1 that is no mistake: friction of another moment


@dataclass(frozen=True, slots=True)
class Accept:
    """Record new moves, and compare the torques by the previous and the current gains with the
    predicted ones.
    """

    duration_s: float = DURATION_S

    def run(self, context: SessionContext, session: Session) -> Session:
        """Do nothing where nothing was written;
        the run is made once, and its result entered in the audit log once.

        Raises:
            DaqError, DriverError: as from a recording, or because the audit log takes no entry.
        """
        state = guided(session)
        if state.outcome is not Outcome.APPLIED:
            return session
        context = context.within("accept")
        if state.acceptance is None:
            session = session.update(acceptance=self._made(context, session))
        _enter(context, session)
        return session

    def _made(self, context: SessionContext, session: Session) -> Acceptance:
        """Make the run, and judge it."""
        before_motion(context)  # the command may have been started again for this run alone
        require_same_cell(context, session)
        _require_written(context, session)
        last = guided(session).blocks[-1]
        path = session.folder / f"plan-{RUN}.yaml"
        body = next(block.payload for block in guided(session).blocks if block.payload is not None)
        experiment = experiment_of(context.cell, body)
        made, _ = plan_with_room(
            context, experiment, context.settings.seed + SEED_STEP, self.duration_s
        )
        plan = write_plan(context, path, made)
        say_moves(context, RUN, path)
        planned = PlannedRun(
            name=RUN, payload=last.payload, mass_kg=last.mass_kg, plan_file=path, holdout=True
        )
        context.operator.mount(planned)
        record_valid(context, session, NextRun(planned, plan))
        return judge_acceptance(context, session)


def _require_written(context: SessionContext, session: Session) -> None:
    """Read the gains back from the drives before anything moves;
    a file is compared when it is written.

    Raises:
        ControllerChanged: the drives have other values than those that were written.
        DriverError: a drive does not answer.
    """
    planned = session.state.target
    if planned is None or not planned.in_drives:
        return
    found = context.content_sha256(calibration_made(session))
    if found != planned.after_sha256:
        raise ControllerChanged(
            context.target.subject,
            found="other values than those that this session wrote",
            expected="the written gains, read back before the moves that accept them",
            remedy="nothing has moved; see whether the drives lost power before they saved, or "
            "were written since (`drivegain history`), and write them again with `drivegain apply "
            "--drives`",
        )
    context.journal.say(Level.INFO, "the gains were read back from the drives")


def _enter(context: SessionContext, session: Session) -> None:
    """Enter the result in the audit log, unless an earlier command of this session was killed
    after that.
    """
    acceptance = guided(session).acceptance
    if acceptance is None:
        return
    known = read_history(context.ledger).acceptances
    if any(one.log_sha256 == acceptance.log_sha256 for one in known):
        return
    digest = sha256_of(session.folder / CALIBRATION)
    details: dict[str, object] = {
        "calibration_sha256": digest,
        "log_sha256": acceptance.log_sha256,
        "old_error_percent": acceptance.old_error_percent,
        "new_error_percent": acceptance.new_error_percent,
        "scales": [scale.model_dump() for scale in acceptance.scales],
        "remark": acceptance.remark,
    }
    if acceptance.accepted:
        audit_entry(context, AuditAction.ACCEPTED, session, details)
        context.journal.say(Level.NOTICE, "accepted", text=acceptance.remark)
        return
    undo = undo_command(context.file, in_drives=context.target.in_drives)
    audit_entry(context, AuditAction.NOT_ACCEPTED, session, {**details, "undo": undo})
    context.journal.say(Level.ERROR, "not accepted", text=acceptance.remark, undo=undo)


def judge_acceptance(context: SessionContext, session: Session) -> Acceptance:
    """Compare predicted torques with those of the currents,
    by the gains before and after the write.
    """
    calibration = calibration_made(session)
    decision = session.state.decision
    previous_gains = {}
    if decision is not None:
        previous_gains = {gain.axis: gain.old for gain in decision.gains}
    before = _predicted(_with_gains(calibration, previous_gains), context, session)
    after = _predicted(calibration, context, session)
    scales = []
    rows = zip(context.cell.axis_names, axis_scales(before), axis_scales(after), strict=True)
    for axis, (old, _), (new, std) in rows:
        scale = ScaleOfAxis(axis=axis, old=finite(old), new=finite(new), std=finite(std))
        scales.append(scale)
    off = [one for one in scales if not _is_right(one)]
    remark = (
        f"the error of the torques is {after.error.total:.2f} % with the current gains, "
        f"{before.error.total:.2f} % with the previous gains"
    )
    if off:
        listed = ", ".join(_scale_text(one) for one in off)
        remark = f"torques by the current gains are not those that the model predicts: {listed}"
    return Acceptance(
        log_sha256=sha256_of(log_of(session, RUN)) or "",
        scales=tuple(scales),
        old_error_percent=finite(before.error.total),
        new_error_percent=finite(after.error.total),
        accepted=not off,
        remark=remark,
    )


def _is_right(scale: ScaleOfAxis) -> bool:
    """Whether a scale is 1 within its σ; that of an axis that did not move shows nothing,
    and accepts nothing.
    """
    if scale.new is None or scale.std is None:
        return False
    bound = max(TOLERANCE, SIGMAS * scale.std)
    return abs(scale.new - 1.0) <= bound


def _scale_text(scale: ScaleOfAxis) -> str:
    """Say by how much the torque of an axis is off."""
    if scale.new is None or scale.std is None:
        return f"{scale.axis} did not move"
    percent = 100.0 * (scale.new - 1.0)
    std_percent = 100.0 * scale.std
    return f"{scale.axis} {percent:+.1f} ± {std_percent:.1f} %"


def axis_scales(found: Validation) -> list[tuple[float, float]]:
    """Return Σ τ̂ τ/Σ τ̂² of each joint, with its σ by leaving out each of PIECES pieces of the run
    in turn.

    τ̂ is what the calibration predicts, τ what the currents and gains say: a gain that is 3 % too
    small gives 0.97.
    """
    scales: list[tuple[float, float]] = []
    for predicted, measured, use in zip(
        found.predicted_nm, found.measured_nm, found.use, strict=True
    ):
        products = np.array_split((predicted * measured)[use], PIECES)
        squares = np.array_split((predicted**2)[use], PIECES)
        product = np.array([part.sum() for part in products])
        square = np.array([part.sum() for part in squares])
        scale = float(product.sum() / square.sum())
        left_out = (product.sum() - product) / (square.sum() - square)
        # Jackknife: σ² = (n − 1)/n Σ (θ_i − mean)².
        deviation = left_out - left_out.mean()
        variance = (PIECES - 1) / PIECES * float(np.sum(deviation**2))
        scales.append((scale, float(np.sqrt(variance))))
    return scales


def _predicted(calibration: Calibration, context: SessionContext, session: Session) -> Validation:
    (found,) = context.tools.validate(calibration, [log_of(session, RUN)], context.cell)
    return found


def _with_gains(calibration: Calibration, values: dict[str, float]) -> Calibration:
    """Return a calibration with other gains, by axis."""
    gains = tuple(
        replace(gain, value=values.get(gain.axis, gain.value)) for gain in calibration.gains
    )
    return replace(calibration, gains=gains)
