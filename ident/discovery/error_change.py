"""Change of the errors of all motors on data that a fit has not seen, compared with its noise.

Two models predict the same rows. With the B blocks of moves, and d_b the rise of the squared error
in block b, the error rises by more than noise where

    Σ d_b > t_(p, B − 1) · √(B/(B − 1) Σ (d_b − mean)²).

One block in which an error changes much, either way, makes this σ so large that it hides a change
which all other blocks share. So a change of the same sign by the trimmed mean counts as well (Yuen
1974: the largest and the smallest tenth of the blocks left out, one block each at least): 10 of 11
blocks better prove an effect, although one is worse. The reverse is not enough: a fall that two
blocks make alone is none.

There are two tests, the mean and the trimmed mean, so noise passes one of them more often than the
confidence says: where it says 5 %, 5.9 to 8.5 % of changes that are noise alone pass, and 3.0 to
4.6 % where it says 2.5 % (12 000 draws of normal and of Student-3 blocks; most with five blocks).
The confidences of this module are those of one test.

Blocks are moves, and neighbouring moves of a run are joined in pairs while their changes correlate:
an error that differs over a region of the workspace differs in a dozen moves at once, which prove
no more than one of them. Fewer blocks than FEWEST_BLOCKS show nothing, even where the error falls
in each of them: in four blocks that happens by chance once in 16 times. One block that outweighs
all others does not show anything either: t is then near one.

A model can be worse on one motor and better in total. So the total is judged at CONFIDENCE, and a
rise of any motor at MOTOR_CONFIDENCE, one-sided, for all motors together. A fall of the motor on
which an effect acts counts as one, too: the effect names it before these data are used. A rise by
less than SAME_ERROR of the error is none, however certain it is: 5.76 % against 5.76 % refutes
nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy  # loads scipy.special when it is first used: a fit needs none of it

from ident.arrays import FloatArray, IntArray
from ident.equations.linearisation import CORRELATED, every_other_of_run
from ident.estimators.estimate import SAME_ERROR

CONFIDENCE = 0.95  #: One-sided, of a change of the whole squared error by more than noise
#: One-sided: probability that the error of no motor seems to rise where there is noise alone
MOTOR_CONFIDENCE = 0.99
FEWEST_BLOCKS = 5  #: 2⁻⁵ < 1 − CONFIDENCE < 2⁻⁴: in fewer, equal signs of all blocks are no rarity
TRIMMED_SHARE = 0.1  #: Share of the blocks at either end that a trimmed mean leaves out
#: Rise of ‖e‖ of a motor, as a share of it, above which it is named, although it may be noise
DOUBTFUL_SHARE = 0.1


@dataclass(frozen=True, slots=True)
class PairedChange:
    """Change of a squared error on the same rows, and its noise by blocks of moves."""

    rise: float  #: Σ ‖e‖² after − before; negative where the error falls
    std: float  #: its σ
    blocks: int  #: number of independent blocks of moves
    #: the change in each of them, the smallest first; empty where it is not known
    by_block: tuple[float, ...] = ()

    @property
    def sigmas(self) -> float:
        """The change in units of its σ; 0 where no σ is known."""
        if self.std > 0.0:
            return self.rise / self.std
        return 0.0

    def rises(self, confidence: float) -> bool:
        """Whether the error rises by more than its noise, at a one-sided confidence.

        Either by the sum of the blocks, or by their trimmed mean.
        """
        if self.blocks < 2 or self.rise <= 0.0:
            return False
        limit = _student_limit(self.blocks - 1, confidence)
        if self.rise > limit * self.std:
            return True
        return self._rises_by_trimmed_mean(confidence)

    def falls(self, confidence: float) -> bool:
        """Whether the error falls by more than its noise, at a one-sided confidence."""
        opposite_blocks = tuple(-change for change in reversed(self.by_block))
        opposite = PairedChange(-self.rise, self.std, self.blocks, opposite_blocks)
        return opposite.rises(confidence)

    def _rises_by_trimmed_mean(self, confidence: float) -> bool:
        """Whether the trimmed mean of the blocks is larger than zero by more than its noise."""
        count = len(self.by_block)
        if count < FEWEST_BLOCKS:
            return False
        trimmed = max(1, int(TRIMMED_SHARE * count))
        changes = np.array(self.by_block)
        inner = changes[trimmed:-trimmed]
        inner_count = len(inner)
        # σ² of a mean of h inner changes of n is (n − 1) s_w²/(h (h − 1)). s_w² is the variance of
        # the winsorised changes: those that are trimmed take the value of the nearest inner one.
        winsorised = np.clip(changes, inner[0], inner[-1])
        scatter = (count - 1) * np.var(winsorised, ddof=1)
        std = float(np.sqrt(scatter / (inner_count * (inner_count - 1))))
        limit = _student_limit(inner_count - 1, confidence)
        return float(inner.mean()) > limit * std


@dataclass(frozen=True, slots=True)
class ErrorChange:
    """Change of the whitened squared errors of all motors on data that the fit has not seen."""

    total: PairedChange  #: over all motors
    motors: tuple[PairedChange, ...]  #: of each motor
    before: FloatArray  #: ‖e_i‖² before, shape (m,)

    @property
    def each_confidence(self) -> float:
        """One-sided confidence at which one motor is judged (Bonferroni's correction)."""
        return 1.0 - (1.0 - MOTOR_CONFIDENCE) / len(self.motors)

    @property
    def largest_sigmas(self) -> float:
        """The largest rise in units of its σ, of the whole error or of a motor's."""
        return max(self.total.sigmas, *(motor.sigmas for motor in self.motors))

    @property
    def worse_motors(self) -> tuple[int, ...]:
        """Motors whose error rises by more than noise, and by more than the tolerance."""
        found: list[int] = []
        for motor, change in enumerate(self.motors):
            if change.blocks < FEWEST_BLOCKS:
                continue
            is_large = _rises_by_share(change, self.before[motor], SAME_ERROR)
            if is_large and change.rises(self.each_confidence):
                found.append(motor)
        return tuple(found)

    @property
    def doubtful_motors(self) -> tuple[int, ...]:
        """Motors whose error rises by much, although it may be noise."""
        found: list[int] = []
        for motor, change in enumerate(self.motors):
            is_large = _rises_by_share(change, self.before[motor], DOUBTFUL_SHARE)
            if is_large and change.rise > change.std:
                found.append(motor)
        return tuple(found)

    @property
    def is_enough(self) -> bool:
        """Whether there are blocks enough to tell a change from noise."""
        return self.total.blocks >= FEWEST_BLOCKS

    @property
    def is_rise(self) -> bool:
        """Whether the whole error rises by more than noise, and by more than the tolerance."""
        is_large = _rises_by_share(self.total, float(self.before.sum()), SAME_ERROR)
        return self.is_enough and is_large and self.total.rises(CONFIDENCE)

    @property
    def is_harm(self) -> bool:
        """Whether an error rises by more than noise, in total or of a motor."""
        return self.is_rise or bool(self.worse_motors)

    def is_fall(self, motor: int | None = None, each: float = CONFIDENCE) -> bool:
        """Whether the error falls by more than noise, in total or of one motor.

        Args:
            motor: that a model claims to know better; None where the total alone is judged.
            each: one-sided confidence at which the total is judged, and likewise the motor. With
                two judgements, noise counts as a fall more often than with one.
        """
        if not self.is_enough:
            return False
        if motor is None:
            return self.total.falls(each)
        if self.total.falls(each):
            return True
        own = self.motors[motor]
        return own.blocks >= FEWEST_BLOCKS and own.falls(each)

    def harm(self, data: str) -> str:
        """Say which error on some data rises by more than noise; empty where none does."""
        if self.is_rise:
            return f"the squared error on {data} rises by {_describe_size(self.total)}"
        worse = self.worse_motors
        if not worse:
            return ""
        worst = max(worse, key=lambda motor: self.motors[motor].sigmas)
        size = _describe_size(self.motors[worst])
        return f"the squared error of motor {worst + 1} on {data} rises by {size}"


def _student_limit(freedom: int, confidence: float) -> float:
    """Quantile of Student's t at a one-sided confidence."""
    return float(scipy.special.stdtrit(freedom, confidence))


def _rises_by_share(change: PairedChange, before: float, share: float) -> bool:
    """Whether an error ‖e‖ rises by more than a share of it; before is ‖e‖² before the change."""
    largest_rise = ((1.0 + share) ** 2 - 1.0) * before
    return change.rise > largest_rise


def _describe_size(change: PairedChange) -> str:
    """Size of a rise or fall of a squared error with its σ, in words."""
    return f"{abs(change.rise):.3g} ± {change.std:.2g} noise variances"


def describe_noise(change: PairedChange, data: str) -> str:
    """Say in which direction a change goes that may be noise, and by how much.

    Args:
        change: of the squared error.
        data: that have this error.
    """
    verb = "rises"
    if change.rise < 0:
        verb = "falls"
    return f"the squared error on {data} {verb} by {_describe_size(change)}, which may be noise"


def compare_by_block(change: FloatArray, move: IntArray, run: IntArray) -> PairedChange:
    """Sum the change of each row's squared error, with σ by independent blocks of moves.

    Neighbouring moves of a run are joined in pairs, again and again, while the changes of
    neighbours correlate by more than CORRELATED standard errors (batch means, as in
    `ident.equations.linearisation.independent_blocks`).

    Args:
        change: of each row, shape (r,).
        move: number of each row's move, shape (r,). Later moves have larger numbers; the rows may
            be in any order.
        run: of each row, shape (r,).
    """
    _, first, move_of_row = np.unique(move, return_index=True, return_inverse=True)
    sums = np.asarray(np.bincount(move_of_row, change), dtype=np.float64)
    runs = run[first]
    while len(sums) >= 2 * FEWEST_BLOCKS:  # fewer blocks than FEWEST_BLOCKS would judge nothing
        centred = sums - sums.mean()
        are_of_one_run = runs[1:] == runs[:-1]
        products = (centred[1:] * centred[:-1])[are_of_one_run]
        # Of the sum of the products, whose mean is zero without correlation
        standard_error = float(np.linalg.norm(products))
        if float(products.sum()) <= CORRELATED * standard_error:
            break
        starts = every_other_of_run(runs)
        if len(starts) == len(sums):
            break
        sums = np.add.reduceat(sums, starts)
        runs = runs[starts]
    return change_of_blocks(sums)


def change_of_errors(
    *,
    before: FloatArray,
    after: FloatArray,
    motor: IntArray,
    move: IntArray,
    run: IntArray,
    motors: int,
) -> ErrorChange:
    """Compare whitened squared errors of two models on the same rows.

    Args:
        before, after: squared error of each row, the rows of one motor after those of another,
            shape (rows,).
        motor: of each row, shape (rows,).
        move, run: of each row, shape (rows,).
        motors: number of motors; the error of one without rows does not change.
    """
    change = after - before
    by_motor: list[PairedChange] = []
    for number in range(motors):
        is_own = motor == number
        if is_own.any():
            motor_change = compare_by_block(change[is_own], move[is_own], run[is_own])
        else:
            motor_change = PairedChange(0.0, 0.0, 0)
        by_motor.append(motor_change)
    squares_before = np.bincount(motor, before, minlength=motors)
    return ErrorChange(
        total=compare_by_block(change, move, run),
        motors=tuple(by_motor),
        before=np.asarray(squares_before, dtype=np.float64),
    )


def change_of_blocks(sums: FloatArray) -> PairedChange:
    """Return the change in all blocks together, with its σ by their scatter.

    Args:
        sums: change of the squared error in each block, shape (blocks,).
    """
    count = len(sums)
    deviation = sums - sums.mean()
    variance = np.sum(deviation**2) * count / max(count - 1, 1)
    return PairedChange(
        rise=float(sums.sum()),
        std=float(np.sqrt(variance)),
        blocks=count,
        by_block=tuple(np.sort(sums).tolist()),
    )
