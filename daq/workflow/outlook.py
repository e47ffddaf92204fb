"""What the recorded blocks say of the next ones:
why a gain takes long, what would help, and moves for the worst.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from daq.workflow.accepted_room import AcceptedRoom
from daq.workflow.experiment import Experiment
from daq.workflow.fit import Fit
from daq.workflow.plan import PlanGoal
from daq.workflow.verdicts import design_after, excitations
from ident.arrays import FloatArray
from ident.planning.excitation import Design
from ident.planning.gain_verdict import verdicts
from ident.planning.target import SlowCause, recorded_information, slow_cause

ADVICE_OF_CAUSE = {
    SlowCause.NO_PAYLOAD: "record blocks with the payload",
    SlowCause.PRELOAD: "let the platform shift and turn farther, by wider joint limits in the "
    "cell file",
    SlowCause.MOTION: "give {axis} wider limits of position, speed and acceleration in the "
    "cell file",
    SlowCause.NOISE: "find what disturbs the current of {axis}: its channel, its cable, or the "
    "tuning of its loop",
    SlowCause.INERTIA: "give {axis} more speed and acceleration in the cell file, or mount a body "
    "whose mass lies farther from its axis",
    SlowCause.COUPLING: "mount a body that loads {axis} more: a heavier one, or one whose mass "
    "lies farther from its axis",
    SlowCause.TIME: "",
}
"""What makes σ of a gain fall faster, besides more time."""


@dataclass(frozen=True, slots=True, eq=False)
class Outlook:
    """What the recorded blocks say of the next ones."""

    design: Design  #: unknowns, with gains, parameters and noise of the last estimate
    information: FloatArray  #: of the blocks behind that estimate, shape (p, p)
    causes: tuple[SlowCause, ...]  #: why each gain takes long
    #: σ of the last estimate over the one that the design predicts for the same blocks, shape (n,).
    #: A design predicts ratios of σ well, but not the level.
    scale: FloatArray

    def goal(self, target_percent: float) -> PlanGoal:
        """Return the goal of the next moves: the gain that is farthest from its target by the last
        estimate.

        Args:
            target_percent: σ that every gain shall reach [%].
        """
        return PlanGoal(self.information, target_percent / self.scale)

    def experiment(
        self, experiment: Experiment, *, is_loaded: bool, room: AcceptedRoom
    ) -> Experiment:
        """Return the experiment that the next block is:
        moves with or without load, inside the accepted room.

        Args:
            experiment: of the cell with the payload of the session.
            is_loaded: whether the block carries it.
            room: of the moves that were accepted.
        """
        mounted = (0,) if is_loaded else (None,)
        scene = room.scene(experiment.scene)
        return replace(experiment, design=self.design, scene=scene, mounted=mounted)


def outlook_of(fitted: Fit, experiment: Experiment, std_percent: FloatArray) -> Outlook:
    """Return what the blocks of a fit say of the next ones; the logs are read again.

    Args:
        fitted: the fit of the blocks, with free gains.
        experiment: that the blocks were planned for.
        std_percent: σ of each gain by the last estimate [% of it], shape (n,).

    Raises:
        IdentificationError, DataError: as from the fit.
    """
    design = design_after(fitted.identification)
    runs = list(excitations(fitted))
    judged = verdicts(design, runs)
    information = recorded_information(design, runs)
    noise_ratio = design.expectation.noise_a / experiment.design.expectation.noise_a
    mounted = set[int | None]()
    for _, payloads in runs:
        mounted.update(payloads)
    has_payload = bool(mounted - {None})
    causes = []
    for gain, ratio in zip(judged.gains, noise_ratio, strict=True):
        causes.append(slow_cause(gain, has_payload=has_payload, noise_ratio=float(ratio)))
    predicted = design.std_percent(information)
    is_finite = np.isfinite(predicted) & np.isfinite(std_percent)
    is_known = is_finite & (std_percent > 0.0)
    scale = np.ones(len(predicted))
    scale[is_known] = std_percent[is_known] / predicted[is_known]
    return Outlook(design, information, tuple(causes), scale)


def help_with(cause: SlowCause, axis: str) -> str:
    """Say what makes σ of a gain fall faster, besides more time; empty where nothing else does."""
    return ADVICE_OF_CAUSE[cause].format(axis=axis)
