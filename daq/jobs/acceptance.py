"""The last stage of a guided session: new moves with the current gains, and a verdict."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from daq.config.recalibration import PlannedRun
from daq.documents.session_state import Acceptance, Outcome, ScaleOfAxis
from daq.files import sha256_of
from daq.jobs.context import NextRun, SessionContext
from daq.jobs.guided import guided, plan_moves, require_same_cell
from daq.jobs.journal import Level
from daq.jobs.recording import log_of, record_valid
from daq.jobs.session import Session
from daq.jobs.stages import calibration_made
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
    """Record new moves, and compare the torques by the previous and the current gains with the predicted ones."""

    duration_s: float = DURATION_S

    def run(self, context: SessionContext, session: Session) -> Session:
        """Do nothing where nothing was written, or where the run was judged already."""
        state = guided(session)
        if state.outcome is not Outcome.APPLIED or state.acceptance is not None:
            return session
        context = context.within("accept")
        require_same_cell(context)
        last = state.blocks[-1]
        path = session.folder / f"plan-{RUN}.yaml"
        seed = context.settings.seed + SEED_STEP
        plan = plan_moves(context, RUN, path, seed, self.duration_s)
        planned = PlannedRun(name=RUN, payload=last.payload, mass_kg=last.mass_kg, plan_file=path, holdout=True)
        context.operator.mount(planned)
        record_valid(context, session, NextRun(planned, plan))
        acceptance = judge_acceptance(context, session)
        level = Level.NOTICE if acceptance.accepted else Level.ERROR
        context.journal.say(level, "accepted" if acceptance.accepted else "not accepted", text=acceptance.remark)
        return session.update(acceptance=acceptance)


def judge_acceptance(context: SessionContext, session: Session) -> Acceptance:
    """Compare predicted torques with those of the currents, by the gains before and after the write."""
    calibration = calibration_made(session)
    decision = session.state.decision
    previous_gains = {} if decision is None else {gain.axis: gain.old for gain in decision.gains}
    before = _predicted(_with_gains(calibration, previous_gains), context, session)
    after = _predicted(calibration, context, session)
    scales = tuple(
        ScaleOfAxis(axis=axis, old=old, new=new, std=std)
        for axis, (old, _), (new, std) in zip(
            context.cell.axis_names, axis_scales(before), axis_scales(after), strict=True
        )
    )
    off = [one for one in scales if abs(one.new - 1.0) > max(SIGMAS * one.std, TOLERANCE)]
    remark = (
        f"the error of the torques is {after.error.total:.2f} % with the current gains, {before.error.total:.2f} % "
        "with the previous gains"
    )
    if off:
        listed = ", ".join(f"{one.axis} {100.0 * (one.new - 1.0):+.1f} ± {100.0 * one.std:.1f} %" for one in off)
        remark = f"torques by the current gains are not those that the model predicts: {listed}"
    return Acceptance(
        log_sha256=sha256_of(log_of(session, RUN)) or "",
        scales=scales,
        old_error_percent=before.error.total,
        new_error_percent=after.error.total,
        accepted=not off,
        remark=remark,
    )


def axis_scales(found: Validation) -> list[tuple[float, float]]:
    """Return Σ τ̂ τ/Σ τ̂² of each joint, with its σ by leaving out each of PIECES pieces of the run in turn.

    τ̂ is what the calibration predicts, τ what the currents and gains say: a gain that is 3 % too small gives 0.97.
    """
    scales: list[tuple[float, float]] = []
    for predicted, measured, use in zip(found.predicted_nm, found.measured_nm, found.use, strict=True):
        products = np.array_split((predicted * measured)[use], PIECES)
        squares = np.array_split((predicted**2)[use], PIECES)
        product = np.array([part.sum() for part in products])
        square = np.array([part.sum() for part in squares])
        whole = float(product.sum() / square.sum())
        left_out = (product.sum() - product) / (square.sum() - square)
        # Jackknife: σ² = (n − 1)/n Σ (θ_i − mean)².
        variance = (PIECES - 1) / PIECES * float(np.sum((left_out - left_out.mean()) ** 2))
        scales.append((whole, float(np.sqrt(variance))))
    return scales


def _predicted(calibration: Calibration, context: SessionContext, session: Session) -> Validation:
    (found,) = context.tools.validate(calibration, [log_of(session, RUN)], context.cell)
    return found


def _with_gains(calibration: Calibration, values: dict[str, float]) -> Calibration:
    """Return a calibration with other gains, by axis."""
    gains = tuple(replace(gain, value=values.get(gain.axis, gain.value)) for gain in calibration.gains)
    return replace(calibration, gains=gains)
