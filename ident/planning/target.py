"""How far each gain is from the σ that it shall reach, how long that takes,
and why the worst one takes longest.

σ of independent moves falls with the root of their number, so at the rate so far σ(t) = σ √(T/t)
after T seconds. The target σ* is reached at t = T (σ/σ*)², and T (σ/σ*)² − T are left. Moves that
are planned for the worst gain (`recorded_information`) are faster than that.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from ident.arrays import FloatArray
from ident.errors import ModelError
from ident.planning.excitation import Design
from ident.planning.gain_verdict import GainSource, GainVerdict, Hidden, Runs, Visibility

NOISY = 2.0
"""Times the planned noise from which on the noise counts as the cause:
four times the planned recording then.
"""


@dataclass(frozen=True, slots=True, eq=False)
class TimeToTarget:
    """Distance of all gains from their targets."""

    ratio: FloatArray  #: σ over target of each gain, shape (m,); inf for one that nothing shows yet
    #: of recording until each is at its target, shape (m,) [s]; inf where no rate is known yet
    left_s: FloatArray

    @property
    def worst(self) -> int:
        """Index of the gain that is farthest from its target; the first of equals."""
        return int(np.argmax(self.ratio))

    @property
    def longest_s(self) -> float:
        """Recording until every gain is at its target [s]."""
        return float(np.max(self.left_s))


def time_to_target(
    std_percent: FloatArray, target_percent: FloatArray, recorded_s: float
) -> TimeToTarget:
    """Say how long a recording must go on until σ of each gain is at its target,
    at the rate so far.

    Args:
        std_percent: σ of each gain so far [% of it], shape (m,); inf for one that nothing shows
            yet.
        target_percent: σ that it shall reach [%], shape (m,), above zero; inf for a gain that does
            not matter.
        recorded_s: recorded so far [s].

    Raises:
        ModelError: the shapes differ, a target is not above zero, or a σ is NaN.
    """
    std = np.asarray(std_percent, dtype=np.float64)
    target = np.asarray(target_percent, dtype=np.float64)
    if std.shape != target.shape:
        raise ModelError(
            f"target_percent has shape {target.shape}; expected {std.shape}, one per gain"
        )
    if not np.all(target > 0.0):
        raise ModelError(
            f"target_percent is {target.tolist()}; expected σ above 0 % for every gain"
        )
    if not np.all(std >= 0.0):
        raise ModelError(
            f"std_percent is {std.tolist()}; expected σ of every gain, inf for one that is not "
            "known"
        )
    ratio = np.zeros(std.shape)
    matters = np.isfinite(target)
    ratio[matters] = std[matters] / target[matters]
    left_s = np.full(std.shape, np.inf)
    left_s[ratio <= 1.0] = 0.0
    if recorded_s > 0.0:
        going = (ratio > 1.0) & np.isfinite(ratio)
        left_s[going] = recorded_s * (ratio[going] ** 2 - 1.0)
    return TimeToTarget(ratio, left_s)


class SlowCause(Enum):
    """Why a gain takes long, in words for a line of a terminal."""

    NO_PAYLOAD = "nothing recorded with the payload yet, which gives all gains their scale"
    PRELOAD = "internal preload of the motors hides it"
    MOTION = "the moves hardly show it: it needs wider and faster ones, in both directions"
    NOISE = "its current is noisier than planned"
    INERTIA = "no gravity acts on this axis: only its fast moves show it"
    COUPLING = "the payload hardly loads this axis: only moves together with other axes show it"
    TIME = "nothing is wrong with it: it needs more moves"


def slow_cause(verdict: GainVerdict, *, has_payload: bool, noise_ratio: float = 1.0) -> SlowCause:
    """Return the main reason why a gain takes longer than others.

    Args:
        verdict: on this gain in the moves so far (`ident.planning.gain_verdict.verdicts`).
        has_payload: anything was recorded with a payload of known mass.
        noise_ratio: noise of its current, measured over planned.
    """
    is_seen = np.isfinite(verdict.std_percent)
    causes = (
        (not has_payload, SlowCause.NO_PAYLOAD),
        (verdict.hidden_by is Hidden.PRELOAD, SlowCause.PRELOAD),
        (noise_ratio > NOISY and is_seen, SlowCause.NOISE),
        (verdict.verdict is Visibility.UNSEEN, SlowCause.MOTION),
        (not verdict.gravity_acts, SlowCause.INERTIA),
        (verdict.sources == (GainSource.COUPLING,), SlowCause.COUPLING),
    )
    for applies, cause in causes:
        if applies:
            return cause
    return SlowCause.TIME


def recorded_information(design: Design, runs: Runs) -> FloatArray:
    """Return the information of what has been recorded so far about all unknowns, shape (p, p).

    The next moves are planned on top of it: information is a sum over moves.

    Args:
        design: unknowns, and the gains, parameters and noise so far.
        runs: motions with what was mounted, `ident.planning.excitation.recorded` of each run.
    """
    information = np.zeros((design.size, design.size))
    for excitation, payloads in runs:
        information += design.information(excitation, payloads)
    return information
