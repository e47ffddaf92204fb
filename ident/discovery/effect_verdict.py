"""What held-out runs say of one effect: confirmed, refuted, or undecided."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from ident.discovery.error_change import CONFIDENCE, FEWEST_BLOCKS, ErrorChange, describe_noise
from ident.effects.effect import PlacedEffect
from ident.estimators.estimate import RelativeError


class Judgement(Enum):
    """Result of a comparison of two models on data that neither has seen."""

    CONFIRMED = "confirmed"  #: the error falls by more than noise, and rises nowhere by more
    UNDECIDED = "undecided"  #: neither
    REFUTED = "refuted"  #: the error rises by more than noise, in total or of a motor


@dataclass(frozen=True, slots=True)
class EffectVerdict:
    """Held-out error without an effect, everything else refitted, and with it."""

    placed: PlacedEffect  #: the effect
    judgement: Judgement  #: of held-out runs
    reason: str  #: in words
    change: ErrorChange  #: of the squared errors by the effect
    #: error of the held-out torques without the effect, everything else refitted [%]
    before: RelativeError
    after: RelativeError  #: the same with it [%]
    written: bool = True  #: whether the effect stays in the model
    #: nothing can be fitted without it: it is judged together with all others
    is_needed: bool = False

    def error_text(self) -> str:
        """Say how the held-out error in total changes."""
        return (
            f"{self.before.total:.2f} % of the held-out torques without it, "
            f"{self.after.total:.2f} % with it"
        )


def judge_change(change: ErrorChange, motor: int | None = None) -> tuple[Judgement, str]:
    """Judge a change of errors on held-out runs, and say why.

    Args:
        change: by an effect.
        motor: on which the effect acts; None for one that acts on all of them, or on a joint
            without a motor.
    """
    if harm := change.harm("held-out runs"):
        return Judgement.REFUTED, harm
    blocks = change.total.blocks
    if blocks < FEWEST_BLOCKS:
        few = (
            f"held-out runs have {blocks} independent blocks of moves, and fewer than "
            f"{FEWEST_BLOCKS} show nothing"
        )
        return Judgement.UNDECIDED, few
    # Of two errors that are asked, each has half the level: a search has gates before this one, a
    # verdict has none. Either is asked by two tests, so that noise passes one of the four in up to
    # 9 % of all cases, not in 5 %.
    each = CONFIDENCE if motor is None else 0.5 * (1.0 + CONFIDENCE)
    if not change.is_fall(motor, each):
        return Judgement.UNDECIDED, describe_noise(change.total, "held-out runs")
    if doubtful := change.doubtful_motors:
        rise = f"the error of motor {doubtful[0] + 1} on held-out runs rises by much"
        return Judgement.UNDECIDED, f"{rise}, although that may be noise"
    return Judgement.CONFIRMED, "the error on held-out runs falls by more than noise"
