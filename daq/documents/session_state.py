"""The state of a session: what `state.json` in its folder says of the stages that are done."""

from __future__ import annotations

import math
from enum import Enum
from typing import Annotated, Literal

from pydantic import Field

from daq.config.yaml_file import StrictModel

_Count = Annotated[int, Field(ge=0, le=2**53)]  #: Exact in a metric, which is a float


class Outcome(Enum):
    """How a job ended."""

    NOT_DUE = "not due"  #: The last good calibration is recent enough; no session was begun
    APPLIED = "applied"
    UNCHANGED = "unchanged"  #: No gain differs significantly from the current gain
    PROPOSED = "proposed"  #: An operator has to apply it
    REFUSED = "refused"  #: A check of the write-back failed
    UNFIT = "unfit"  #: The recordings cannot be used
    STOPPED = "stopped"  #: An error ended the job; the next job resumes the session
    INTERRUPTED = "interrupted"  #: Like STOPPED, by a signal

    @property
    def good(self) -> bool:
        """Whether the calibration is valid."""
        return self in (Outcome.APPLIED, Outcome.UNCHANGED, Outcome.PROPOSED)

    @property
    def concluded(self) -> bool:
        """Whether the session is over: the same logs would end the same way."""
        return self not in (Outcome.STOPPED, Outcome.INTERRUPTED)


class RecordedRun(StrictModel):
    """A finished log: its digest, the number of recordings it took,
    and the losses of all of them.
    """

    name: str
    sha256: str
    attempts: _Count
    samples: _Count
    lost_cycles: _Count
    missing: tuple[_Count, ...]


class Fitted(StrictModel):
    """Digest of the calibration file, and the residual in words."""

    calibration_sha256: str
    sentences: tuple[str, ...]


class JudgedGain(StrictModel):
    """An identified gain compared with the current gain, with their σ,
    and whether they differ significantly.

    `old` and `new` are keys of `state.json` and of `--json`, which stay.
    """

    axis: str
    unit: str
    old: float  #: current gain
    old_std: float  #: σ of the current gain; 0 where it is not known
    new: float  #: identified gain
    new_std: float  #: σ of the identified gain
    change_percent: float | None  #: None where the current gain is 0
    #: difference in σ of the difference, None where both σ are 0; an unknown σ is 0
    drift_sigma: float | None
    differs: bool


class Decision(StrictModel):
    """The decision, with the gains it rests on."""

    gains: tuple[JudgedGain, ...]
    remark: str


class PlannedWrite(StrictModel):
    """The planned write, saved before it is made:
    after a kill, the file's digest shows whether it was made.
    """

    file: str
    base_sha256: str
    after_sha256: str
    looked_at: str = ""  #: value for `apply --base`
    unsigned: bool = False  #: required signatures are missing
    in_drives: bool = False  #: into the drives, not into a file


class WatchedGain(StrictModel):
    """Alarm of the drift chart of a gain (`daq.ledger.watch`), empty where there is none."""

    axis: str
    alarm: str


class SessionState(StrictModel):
    """What all sessions share; results of steps that are not done yet are None or missing from the
    list.
    """

    format: str  #: kind of session
    version: Literal[1] = 1
    session: str
    cell: str
    configuration_sha256: str
    plans_sha256: str = ""  #: of the approved plans that the runs name
    began: str
    attempt: _Count = 1
    attempt_began: str
    runs: tuple[RecordedRun, ...] = ()
    fitted: Fitted | None = None
    watched: tuple[WatchedGain, ...] = ()
    decision: Decision | None = None
    target: PlannedWrite | None = None
    outcome: Outcome | None = None
    exit_code: _Count | None = None
    problem: str = ""
    ended: str | None = None
    audit_sha256: str | None = None  #: of the audit entry about the end of the session

    @property
    def is_over(self) -> bool:
        """Whether no command goes on with it.

        A command that was killed before it reported its end did not end it; nor did one that an
        error ended after the decision, before the certificate had it.
        """
        if self.outcome is None or self.ended is None:
            return False
        is_cut_short = self.outcome.good and bool(self.problem)
        return self.outcome.concluded and not is_cut_short

    def with_(self, **changed: object) -> SessionState:
        """A copy with other values."""
        return self.model_copy(update=changed)


class JobState(SessionState):
    """`state.json` of a scheduled job."""

    format: Literal["drivegain-recalibration"] = "drivegain-recalibration"


class Block(StrictModel):
    """A run of a guided session, as it was decided before it was recorded."""

    name: str  #: of its log
    payload: str | None  #: what it carries, None without load
    mass_kg: float | None  #: None without load
    holdout: bool  #: not used by the fit
    plan: str  #: file name of its moves
    duration_s: float = 0.0  #: that its moves had room for [s]; 0 in sessions of earlier versions


class GainSoFar(StrictModel):
    """A gain after a block, with its target."""

    axis: str
    unit: str
    value: float
    std_percent: float
    target_percent: float
    cause: str = ""  #: why it takes long; empty where it is not known

    @property
    def is_precise(self) -> bool:
        """Whether its σ is at the target."""
        return self.std_percent <= self.target_percent


class Progress(StrictModel):
    """σ of all gains after a number of blocks."""

    blocks: _Count
    motion_s: float  #: of these blocks
    fitted_s: float = 0.0  #: of those that are not held out
    std_percent: tuple[float, ...]  #: of each gain


class ScaleOfAxis(StrictModel):
    """Measured over predicted torque of a joint on new moves:
    1 where its gain is right, None where it did not move.
    """

    axis: str
    old: float | None  #: with the previous gain, which the controller had before the write
    new: float | None  #: with the current gain, which was written
    std: float | None  #: σ of the new one


class Acceptance(StrictModel):
    """The short run after the write: torques of the currents compared with those that the
    calibration predicts.
    """

    log_sha256: str
    scales: tuple[ScaleOfAxis, ...]
    #: of all axes, with the previous gains; None where it is no number
    old_error_percent: float | None
    new_error_percent: float | None  #: of all axes, with the current gains
    accepted: bool
    remark: str


class GuidedState(SessionState):
    """`state.json` of a guided session."""

    format: Literal["drivegain-session"] = "drivegain-session"
    blocks: tuple[Block, ...] = ()
    #: of the payload, as read from the scale, twice; None before the first loaded block
    mass_kg: float | None = None
    rehearsed: _Count = 0  #: number of blocks that were rehearsed at low speed
    #: duration of the blocks that are to come [s], where it is longer than the asked one
    block_s: float = 0.0
    #: number of bare blocks before the first one with the payload
    bare_first: Annotated[int, Field(ge=1)] = 1
    gains: tuple[GainSoFar, ...] = ()  #: after the last block that was judged
    judged_blocks: _Count = 0  #: number of blocks behind these gains
    progress: tuple[Progress, ...] = ()  #: after each block that was judged
    checked_blocks: _Count = 0  #: number of blocks in which mistakes were looked for
    #: names of blocks that were recorded again because of a mistake, once each time
    repeated: tuple[str, ...] = ()
    complete: bool = False  #: nothing is left to record
    missing: str = ""  #: what was not reached when the recording ended, in words
    would_help: tuple[str, ...] = ()  #: what would help to reach it, a sentence each
    acceptance: Acceptance | None = None

    @property
    def is_over(self) -> bool:
        """Whether no command goes on with it: what was written must be accepted, too."""
        lacks_acceptance = self.outcome is Outcome.APPLIED and self.acceptance is None
        return super().is_over and not lacks_acceptance


def finite(number: float) -> float | None:
    """Return a number as a state has it: None for NaN and infinity."""
    if math.isfinite(number):
        return number
    return None
