"""The side that drives each gear, and the part of its loss that the data show.

A gear of efficiency η takes τ/η from a motor that drives the load, and ητ where the load drives the
motor. With c = (1 − η²)/(1 + η²) and the torque τ through the gear,

    τ_motor = (τ + c |τ| sign(q̇)) / √(1 − c²).

`load-friction` and `efficiency` estimate c, the contrast of the two sides. Where one side gives
nearly all torque, |τ| sign(q̇) is ±τ: the gain takes up the loss, and the residual stays silent. The
factor 1/√(1 − c²) scales everything, and the gain always carries it: g is the motor's gain times
√(1 − c²) if both directions lose the same share of the power. No residual can show whether they do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.discovery.loop import Step
from ident.effects.effect import Effect
from ident.effects.friction import LoadFriction
from ident.effects.transmission import Efficiency
from ident.equations.observation import Observation
from ident.estimators.estimate import Estimate

CERTAIN = 2.0  #: Standard deviations of the loss that count against the gain
SMALL_SHIFT = 0.01  #: Relative error of a gain below which an unseen loss does not matter
NAN = float("nan")


@dataclass(frozen=True, slots=True)
class GearLoss:
    """One axis: which side drives, and the loss with its σ."""

    motoring_rows: float  #: share of the moving rows in which the motor drives the load
    #: the same share of the squared load torque; NaN for a joint without load
    motoring_torque: float
    loss: float | None  #: c, the contrast of the two sides; None where the search could not test it
    loss_std: float | None  #: its σ

    @property
    def lean(self) -> float:
        """Part of the loss that an estimate without it puts into the gain.

        It is 1 where the motor drives throughout.
        """
        return 2.0 * self.motoring_torque - 1.0

    @property
    def hidden_shift(self) -> float | None:
        """Relative change of the gain by a loss too small to be seen; None where not known."""
        if self.loss_std is None or not np.isfinite(self.lean):
            return None
        return CERTAIN * self.loss_std * abs(self.lean)

    @property
    def gain_carries_it(self) -> bool:
        """Whether a loss that these data do not show could matter to the gain."""
        return self.hidden_shift is None or self.hidden_shift > SMALL_SHIFT

    @property
    def efficiency(self) -> float | None:
        """η of a gear that loses the same share of the power in both directions.

        None for a loss outside 0 to 1.
        """
        if self.loss is None or not 0.0 <= self.loss < 1.0:
            return None
        return float(np.sqrt((1.0 - self.loss) / (1.0 + self.loss)))

    @property
    def gain_factor(self) -> float | None:
        """Gain of the motor of such a gear over the gain found with the loss in the model.

        None as for `efficiency`.
        """
        if self.efficiency is None or self.loss is None:
            return None
        return float(1.0 / np.sqrt(1.0 - self.loss**2))


def gear_losses(step: Step) -> tuple[GearLoss, ...]:
    """Judge every axis by the last turn of a search.

    That turn has tested the loss beside all that is in the model.
    """
    after = step.after
    losses: list[GearLoss] = []
    for axis, shares in enumerate(driving_shares(after.training, after.estimate)):
        motoring_rows, motoring_torque = shares
        loss, loss_std = _loss(step, axis)
        losses.append(GearLoss(motoring_rows, motoring_torque, loss, loss_std))
    return tuple(losses)


def driving_shares(observation: Observation, estimate: Estimate) -> tuple[tuple[float, float], ...]:
    """Share of each joint's moving rows in which the motor drives the load, and of their torque².

    The load torque is the model's, for links and payload; the direction of motion is that of the
    dry friction. Both shares are NaN for a joint without rows or without friction in the model.
    """
    standard = np.array(observation.base.independent)
    # Payload columns follow those of the effects, which follow the base parameters.
    is_load = np.ones(len(estimate.parameters), dtype=np.bool_)
    is_load[: len(observation.columns)] = False
    is_load[: len(standard)] = np.isin(standard, observation.model.link_columns)
    known = observation.known()
    friction_columns = observation.model.dry_friction_columns
    shares: list[tuple[float, float]] = []
    for joint, friction in enumerate(friction_columns):
        used = observation.use[joint]
        dry = np.flatnonzero(standard == friction)
        if not len(dry) or not used.any():
            shares.append((NAN, NAN))
            continue
        linear = observation.of_joint(joint, used)
        torque = estimate.parameters[is_load] @ linear[is_load] + known[joint, used]
        # The column of dry friction is the sign of the velocity.
        drives = torque * linear[dry[0]] > 0.0
        size = float(np.sum(torque**2))
        of_rows = float(np.mean(drives))
        if size:
            of_torque = float(np.sum(torque[drives] ** 2)) / size
        else:
            of_torque = NAN
        shares.append((of_rows, of_torque))
    return tuple(shares)


def _loss(step: Step, axis: int) -> tuple[float | None, float | None]:
    """Loss and σ: fitted where it is in the model, else as the search tested it."""
    evidence = step.after
    estimate = evidence.estimate
    first = len(evidence.rows_without_effects.columns)
    for placed in evidence.effects:
        if placed.axis == axis and is_gear_loss(placed.effect):
            return float(estimate.parameters[first]), float(estimate.parameters_std[first])
        first += len(placed.effect.coefficients)
    for found in step.findings:
        if found.axis == axis and isinstance(found.effect, Efficiency):
            return float(found.coefficients[0]), float(found.deviations[0])
    return None, None


def is_gear_loss(effect: Effect) -> bool:
    """Whether an effect is the contrast of the two sides, c."""
    if isinstance(effect, LoadFriction):
        return effect.speed_exponent == 0
    return isinstance(effect, Efficiency)
