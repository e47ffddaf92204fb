"""Faults of a recording, by run, channel or axis, before any of its numbers is believed.

A fit may end with small deviations and be wrong: a payload turned between two runs, two currents
exchanged, mA read as A. Each mistake leaves a trace of its own. `diagnose` looks for them in the
equations of a fit; `exchanged_channels` reads the runs again, because the equations of a motor hold
its own current alone.

A mistake that leaves no usable number is an error (kinds of `ident.errors.ModelContradicted`), any
other a `Diagnosis`. The limits were set by `make diagnosis-study`; those of a single number are in
`ident.plausible`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import scipy  # loads its modules when they are first used: a clean fit needs none of them
from numpy.typing import ArrayLike

from ident.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    as_array,
    require_entries,
    require_names,
    require_real,
    takes,
)
from ident.data.conditioning import Conditioning
from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.data.run_channels import (
    clip_diagnoses,
    fault_diagnoses,
    held_diagnoses,
    limit_diagnoses,
    still_diagnoses,
)
from ident.data.unsigned_current import (
    missing_signs,
    one_sided_currents,
    refuse_unsigned,
    unsigned_currents,
)
from ident.equations.reduction import motor_support
from ident.equations.rows import motor_columns, rows_of
from ident.equations.system import System
from ident.equations.triangles import qr_update, triangle
from ident.errors import (
    GAIN_UNSEEN,
    CurrentUnsigned,
    DataUnfit,
    Diagnosis,
    IdentificationError,
    ModelError,
)
from ident.estimators.estimate import Estimate, Identification
from ident.estimators.least_squares import wls
from ident.estimators.maximum_likelihood import ml
from ident.estimators.method import Method
from ident.estimators.payload_diagnosis import payload_diagnoses
from ident.estimators.refusals import (
    idle_joints,
    joint_torques,
    numbers_text,
    refuse_mistakes,
    weight_off,
    with_channel_causes,
)
from ident.model.model import Model
from ident.plausible import CURRENT_RANGE, GAIN_RANGE, TORQUE_RATIO, WEIGHT_RATIO, range_text

#: Clean recordings stay below 15, with every effect undeclared below 40
LARGEST_AXIS_ERROR_PERCENT = 20.0
LARGEST_CONDITION = 1e6
"""Largest condition number.

An error of one σ along the weakest direction of the parameters is 1/s_min, and it exceeds all
parameters together where the condition exceeds s_max ‖χ‖. That is 1e4 to 2e5 in real and simulated
recordings.
"""
#: Of another estimator's gain from that of ml: relative, and in σ of ml
GAIN_DIFFERENCE, GAIN_SIGMAS = 0.1, 3.0
UNSEEN_SIGMAS = 2.0
"""A gain that is less than this many σ from zero is no result.

One that is less than GAIN_SIGMAS from it is none either where its sign or its size is not that of a
drive.
"""
OR_POSITION = (
    " If not, does the position of this axis, or its <axis> in the URDF? About a vertical axis the "
    "torques do not tell the two apart"
)
"""Added to the advice on a reversed gain of the first axis: the mirror image of an arm has the same
torques, except that of this axis, which has the other sign.
"""
#: Of a gain to its nameplate, or the inverse, that no tolerance of a drive explains
ABSURD_RATIO = 3.0
#: Stretches of a run of which each is left out once, for σ of the scale of a current
SCALE_BLOCKS = 20
CHANNEL_FALL = 0.4
"""Least fall of the logarithm of a motor's error with another current than its own.

With any two currents of two real robots and of the simulated arm exchanged it is 0.8 and more of
both motors, but for one pair of a coupled wrist.
"""
CHANNEL_T = 4.0  #: Least mean of the falls of the blocks, in σ of that mean
CHANNEL_BLOCKS = 8  #: Blocks of moves of which each shows whether an exchange explains it
ALIKE = 0.25  #: Least squared correlation of two torques of which one is the other's, reversed


@takes(found=Identification, axes=Sequence)
def diagnose(
    found: Identification,
    axes: Sequence[str],
    nameplate: ArrayLike | None = None,
    effort_limit: ArrayLike | None = None,
) -> tuple[Diagnosis, ...]:
    """Judge a fit: refuse mistakes that leave no usable number, and name all others.

    A mistake of a recording is the same whatever estimator was asked for, so it is judged by
    `judged_estimate`.

    Args:
        found: with or without effects; of any estimator.
        axes: name of each axis.
        nameplate: gains by the data sheet, shape (m,); without them no gain is compared.
        effort_limit: of the joints, inf where unknown [Nm or N], shape (m,).

    Raises:
        PayloadUnseen, UnitsMistaken, CurrentReversed, ModelContradicted, RolesExchanged: see
            `refuse_mistakes`.
        PayloadDiffers: see `payload_diagnoses`.
        JointStill: a joint never moves in a run, in place of an error that this explains.
    """
    require_names("axes", axes, found.model.robot.axis_count)
    entered_gains: FloatArray | None = None
    if nameplate is not None:
        entered_gains = as_array("nameplate", nameplate, (len(axes),), "one per axis")
    if effort_limit is None:
        limits = None
    else:
        limits = _effort_limits(effort_limit, len(axes))
    with with_channel_causes(found.channels, axes):
        return tuple(_diagnoses(found, axes, entered_gains, limits))


def _effort_limits(effort_limit: ArrayLike, count: int) -> FloatArray:
    """Return the limits of the joints, shape (m,); refuse what is none, as a `ModelError`."""
    require_real("effort_limit", effort_limit, ModelError, "one number an axis")
    limits = np.asarray(effort_limit, dtype=np.float64)
    if limits.shape != (count,):
        raise ModelError(
            f"effort_limit has shape {limits.shape}; expected ({count},), one per axis"
        )
    if not np.all(limits >= 0.0):
        raise ModelError(
            f"effort_limit is {limits.tolist()}; expected no number below zero; give inf "
            "where a limit is not known"
        )
    return limits


TRACES_OF_STILL_JOINTS = {"axis-error", "masses-contradict", "payload-differs"}
"""Diagnoses that an encoder may leave which stood still while its joint moved.

One of a joint at rest leaves none.
"""


LARGEST_SCATTER = 0.03
"""Relative σ of every gain that is no trace.

Recordings that do not contradict each other give 1 % on most axes.
"""


def _diagnoses(
    found: Identification,
    axes: Sequence[str],
    nameplate: FloatArray | None,
    effort_limit: FloatArray | None,
) -> Sequence[Diagnosis]:
    """Refuse mistakes, and name all others; see `diagnose`."""
    system = found.system
    channels = found.channels
    estimate = judged_estimate(system, found.estimate)
    gains_fixed = estimate.gains_fixed
    refuse_mistakes(system, estimate, axes, nameplate)
    diagnoses: list[Diagnosis] = []
    diagnoses += fault_diagnoses(channels, axes)
    diagnoses += held_diagnoses(channels, axes)
    diagnoses += clip_diagnoses(channels, axes)
    diagnoses += limit_diagnoses(channels, axes)
    if nameplate is not None and not gains_fixed:
        diagnoses += gain_diagnoses(estimate, nameplate, axes)
    diagnoses += estimator_diagnoses(found.estimate, estimate, axes)
    likeliest = estimate
    given_gains = 0
    if gains_fixed:
        given_gains = len(estimate.gains)
        with suppress(IdentificationError):
            likeliest = ml(system, estimate.gains)
    gains = likeliest.gains
    parameters = likeliest.parameters
    payloads = list(weight_diagnoses(system, estimate))
    payloads += payload_diagnoses(system, gains, parameters, given_gains)
    # A payload that differs is the cause, an axis error only its trace.
    if payloads:
        diagnoses += payloads
    else:
        diagnoses += error_diagnoses(found.model, system, estimate, axes)
    holdout = found.holdout
    if holdout is not None:
        payloads = list(payload_diagnoses(holdout, gains, parameters))
        if payloads:
            diagnoses += payloads
        else:
            runs = holdout.seen_runs
            diagnoses += error_diagnoses(found.model, holdout, estimate, axes, runs)
    if effort_limit is not None:
        diagnoses += torque_diagnoses(system, estimate, effort_limit)
    if _may_have_still_joints(estimate, diagnoses):
        diagnoses = [*still_diagnoses(channels, axes), *diagnoses]
    diagnoses += condition_diagnoses(found.estimate)
    return diagnoses


def _may_have_still_joints(estimate: Estimate, diagnoses: Sequence[Diagnosis]) -> bool:
    """Whether a fit has traces of an encoder that stood still while its joint moved."""
    if not estimate.gains_fixed:
        scatter = estimate.gains_std / np.abs(estimate.gains)
        if float(np.min(scatter)) > LARGEST_SCATTER:
            return True
    return any(one.name in TRACES_OF_STILL_JOINTS for one in diagnoses)


def judged_estimate(system: System, estimate: Estimate) -> Estimate:
    """Return the estimate that judges recordings: ``ml``, or with fixed gains ``wls``.

    It does not depend on the estimator that was asked for. The deviations of the linear estimates
    are those of independent rows (eqs. 10, 23) and do not see that moves contradict each other;
    those of ``ml`` do. With fixed gains ``wls`` (IDIM-WLS) always has an estimate.

    Args:
        system: the equations.
        estimate: of these equations, by any method; it is judged itself where ``ml`` does not
            converge.
    """
    if estimate.gains_fixed:
        if estimate.method is Method.WLS:
            return estimate
        return wls(system, estimate.gains)
    if not estimate.method.is_of_currents:
        with suppress(IdentificationError):
            return ml(system)
    return estimate


# Gains and units


def weight_diagnoses(system: System, estimate: Estimate) -> Iterator[Diagnosis]:
    """Compare the weight of the payload by fixed gains with the declared one."""
    if not estimate.gains_fixed:
        return
    ratio = weight_off(system, estimate, WEIGHT_RATIO)
    if ratio is None:
        return
    loaded = {run for run, mounting in system.cluster_runs if mounting >= 0}
    runs = tuple(system.runs[run] for run in sorted(loaded))
    evidence = f"{ratio:.2g} times the declared weight of the payload, by these gains"
    expected = f"1, and within a factor of {WEIGHT_RATIO:g}"
    advice = "was it mounted in these runs? are its mass and the fixed gains right?"
    yield Diagnosis("payload-differs", runs, (), evidence, expected, advice)


def gain_diagnoses(
    estimate: Estimate, nameplate: FloatArray, axes: Sequence[str]
) -> Iterator[Diagnosis]:
    """Compare free gains with the nameplate, shape (m,): signs, and sizes outside GAIN_RANGE.

    A size is outside by more than GAIN_SIGMAS σ. A gain that the moves hardly show is named as well
    where it may be zero, or where its number is absurd.
    """
    gains = estimate.gains
    std = estimate.gains_std
    size = np.abs(gains)
    ratio = gains / nameplate
    ratio_size = np.abs(ratio)
    ratio_margin = GAIN_SIGMAS * np.abs(std / nameplate)
    has_other_sign = ratio < 0.0
    is_known = std < size / GAIN_SIGMAS
    is_off = outside(ratio_size, ratio_margin, GAIN_RANGE)
    may_be_zero = size < UNSEEN_SIGMAS * std
    absurd_range = (1.0 / ABSURD_RATIO, ABSURD_RATIO)
    is_absurd = has_other_sign | outside(ratio_size, 0.0, absurd_range)
    is_unseen = ~is_known & ~is_off & (is_absurd | may_be_zero)
    for axis in np.flatnonzero(is_known & has_other_sign).tolist():
        alternative = ""
        if axis == 0:
            alternative = OR_POSITION
        gain_text = _gain_text(estimate, axis)
        yield _reversed_current(axes[axis], gain_text, nameplate[axis], alternative)
    for axis in np.flatnonzero(is_unseen).tolist():
        yield _unseen_gain(axes[axis], _gain_text(estimate, axis), nameplate[axis])
    for axis in np.flatnonzero(is_off).tolist():
        evidence = f"{_gain_text(estimate, axis)}, {ratio[axis]:.3g} times the nameplate"
        yield _gain_off_nameplate(axes[axis], evidence, nameplate[axis])


def _gain_text(estimate: Estimate, axis: int) -> str:
    """A gain with its σ, for a message."""
    gain = estimate.gains[axis]
    std = estimate.gains_std[axis]
    return f"a gain of {gain:.4g} ± {std:.2g}"


def _reversed_current(axis: str, gain_text: str, nameplate: float, alternative: str) -> Diagnosis:
    """A gain whose sign is not that of the nameplate."""
    expected = f"the sign of the nameplate, {nameplate:.4g}"
    advice = f"does the drive, or the import, count this current the other way?{alternative}"
    return Diagnosis("current-reversed", (), (axis,), gain_text, expected, advice)


def _unseen_gain(axis: str, gain_text: str, nameplate: float) -> Diagnosis:
    """A gain that is no result."""
    evidence = f"{gain_text}, nameplate {nameplate:.4g}"
    expected = f"a gain that is more than {GAIN_SIGMAS:g} σ from zero"
    advice = (
        "these moves hardly show this gain: record faster and wider moves of this axis, loaded "
        "too, and fit them together with these; do not use this gain"
    )
    return Diagnosis(GAIN_UNSEEN, (), (axis,), evidence, expected, advice)


def _gain_off_nameplate(axis: str, evidence: str, nameplate: float) -> Diagnosis:
    """A gain whose size is outside GAIN_RANGE of the nameplate."""
    expected = f"{range_text(GAIN_RANGE)} of {nameplate:.4g}, within {GAIN_SIGMAS:g} σ"
    advice = (
        "is the nameplate of this axis, its gear ratio, the scale of its current, the "
        "payload's mass, or a length of the URDF wrong? measure the lengths: on a serial arm "
        "no data show them"
    )
    return Diagnosis("gain-off-nameplate", (), (axis,), evidence, expected, advice)


def outside(
    values: FloatArray, margin: FloatArray | float, bounds: tuple[float, float]
) -> BoolArray:
    """Whether each number is outside a range by more than a margin; NaN is not. The result and an
    array of margins have the shape of the numbers.
    """
    lowest, highest = bounds
    is_below = values + margin < lowest
    is_above = values - margin > highest
    return np.asarray(is_below | is_above)


def scale_diagnoses(
    measured_nm: FloatArray,
    predicted_nm: FloatArray,
    use: BoolArray,
    axes: Sequence[str],
    runs: tuple[str, ...],
) -> Iterator[Diagnosis]:
    """Compare the torque of a run, by the gains of a calibration, with what that predicts.

    A scale is named where it is outside CURRENT_RANGE by more than GAIN_SIGMAS σ and explains the
    axis: another payload changes the torque of an axis, too, but leaves 28 % and more of it beside
    any scale.

    Args:
        measured_nm, predicted_nm: joint torque, shape (m, r).
        use: rows of each joint that count, shape (m, r).
        axes: name of each axis.
        runs: name of the run.
    """
    for axis, name in enumerate(axes):
        used = use[axis]
        scale = current_scale(measured_nm[axis, used], predicted_nm[axis, used])
        evidence = f"{scale.ratio:.3g} times the predicted torque"
        if scale.ratio < 0.0 and scale.left**2 < 1.0 - ALIKE:
            advice = "does the drive, or the import, count this current the other way?"
            yield Diagnosis("current-reversed", runs, (name,), evidence, "1", advice)
        is_off = outside(np.abs(scale.ratio), GAIN_SIGMAS * scale.std, CURRENT_RANGE)
        if is_off and 100.0 * scale.left < LARGEST_AXIS_ERROR_PERCENT:
            expected = f"1, and {range_text(CURRENT_RANGE)} after years"
            advice = "is the current in another unit (mA) than in the fit, or of another drive?"
            yield Diagnosis("current-off-scale", runs, (name,), evidence, expected, advice)


@dataclass(frozen=True, slots=True)
class TorqueScale:
    """Scale of the torque of an axis, from its current, beside the predicted one."""

    ratio: float  #: by least squares; NaN without torque
    std: float  #: σ of the ratio, from leaving out one of SCALE_BLOCKS stretches of time in turn
    left: float  #: what no scale explains, relative to the measured torque (root mean squares)


def current_scale(measured_nm: FloatArray, predicted_nm: FloatArray) -> TorqueScale:
    """Fit measured = ratio · predicted over the rows of one axis, shape (r,) each."""
    products = measured_nm * predicted_nm
    squares = predicted_nm**2
    product = float(products.sum())
    square = float(squares.sum())
    size = float(np.sum(measured_nm**2))
    if product == 0.0 or len(products) < SCALE_BLOCKS:
        return TorqueScale(np.nan, np.nan, 1.0)
    # The ratio without each stretch of time in turn, and σ by the jackknife
    starts = np.arange(SCALE_BLOCKS) * len(products) // SCALE_BLOCKS
    other_products = product - np.add.reduceat(products, starts)
    other_squares = square - np.add.reduceat(squares, starts)
    variance = (SCALE_BLOCKS - 1) * np.var(other_products / other_squares)
    # min over the ratio of ‖measured - ratio · predicted‖² / ‖measured‖²
    left_share = 1.0 - product**2 / (square * size)
    return TorqueScale(
        ratio=product / square,
        std=float(np.sqrt(variance)),
        left=float(np.sqrt(max(0.0, left_share))),
    )


_OF_LEAST_SQUARES = (
    'use `method="ml"`: noise in the currents makes the gains of least squares too small'
)
REMEDIES_OF_DISAGREEMENT = {
    Method.LS: _OF_LEAST_SQUARES,
    Method.WLS: _OF_LEAST_SQUARES,
    Method.TLS: 'use `method="ml"`: an effect that the model lacks, or a parameter that these '
    "moves hardly show, bends "
    "tls more; `find_effects` looks for effects",
}
"""What to do where an estimator's gain is far from ml's; iv need not agree with it (`diagnose`)."""


def estimator_diagnoses(
    estimate: Estimate, likeliest: Estimate, axes: Sequence[str]
) -> Iterator[Diagnosis]:
    """Compare the gains of another estimator with those of ml on the same equations."""
    if estimate.gains_fixed or estimate is likeliest:
        return
    likely_gains = likeliest.gains
    likely_std = likeliest.gains_std
    change = np.abs(estimate.gains - likely_gains)
    is_large = change > GAIN_DIFFERENCE * np.abs(likely_gains)
    is_significant = change > GAIN_SIGMAS * likely_std
    expected = f"at most {100.0 * GAIN_DIFFERENCE:.0f} %, or {GAIN_SIGMAS:g} σ"
    for axis in np.flatnonzero(is_large & is_significant).tolist():
        gain = estimate.gains[axis]
        likely_gain = likely_gains[axis]
        percent = 100.0 * change[axis] / abs(likely_gain)
        evidence = (
            f"a gain of {gain:.4g} by {estimate.method.value}, {percent:.0f} % "
            f"from {likely_gain:.4g} ± {likely_std[axis]:.2g} by ml on the same rows"
        )
        advice = REMEDIES_OF_DISAGREEMENT[estimate.method]
        yield Diagnosis("estimators-disagree", (), (axes[axis],), evidence, expected, advice)


# Errors, torques and condition


def error_diagnoses(
    model: Model,
    system: System,
    estimate: Estimate,
    axes: Sequence[str],
    runs: tuple[str, ...] = (),
) -> Iterator[Diagnosis]:
    """Name axes whose error is large; arguments as for `axis_error_diagnoses`."""
    size, left = joint_torques(system, estimate)
    idle = idle_joints(model, size, left)
    yield from axis_error_diagnoses(size, left, idle, axes, runs)


def axis_error_diagnoses(
    size: FloatArray, left: FloatArray, idle: BoolArray, axes: Sequence[str], runs: tuple[str, ...]
) -> Iterator[Diagnosis]:
    """Name axes whose error is above LARGEST_AXIS_ERROR_PERCENT.

    Args:
        size, left: torque of each joint and what the model leaves of it, root mean squares [Nm or
            N], shape (m,).
        idle: joints whose error is nothing beside the torques of the others, shape (m,).
        axes: their names.
        runs: that the fit has not seen, empty for its own.
    """
    is_large = 100.0 * left > LARGEST_AXIS_ERROR_PERCENT * size
    for axis in np.flatnonzero(is_large).tolist():
        name = axes[axis]
        percent = 100.0 * left[axis] / size[axis]
        error = f"an error of {left[axis]:.2g} in {size[axis]:.2g} Nm (or N), {percent:.3g} %"
        if idle[axis]:
            evidence = f"{error}, nothing beside the torques of the other axes"
            expected = "a torque above the noise"
            advice = "this axis carries too little here to judge it: load it, or move it faster"
            yield Diagnosis("axis-idle", runs, (name,), evidence, expected, advice)
        else:
            expected = f"some 3 to 15 %, below {LARGEST_AXIS_ERROR_PERCENT:g} %"
            advice = (
                "look for what contradicts the model on this axis: its current channel and sign, "
                "gear ratio, payload, friction or an effect that is not declared (`find_effects`)"
            )
            yield Diagnosis("axis-error", runs, (name,), error, expected, advice)


def torque_diagnoses(
    system: System, estimate: Estimate, effort_limit: FloatArray
) -> Iterator[Diagnosis]:
    """Compare the torques with the effort limits of the URDF, shape (m,): a wrong unit puts all of
    them above.
    """
    torque, _ = joint_torques(system, estimate)
    has_limit = np.isfinite(effort_limit)
    if not np.any(has_limit):
        return
    if np.all(torque[has_limit] > TORQUE_RATIO * effort_limit[has_limit]):
        evidence = f"torques of {numbers_text(torque)} Nm (or N; root mean square)"
        expected = f"less than the effort limits of the URDF, {numbers_text(effort_limit)}"
        advice = (
            "are the currents in mA and read as A, is the payload's mass in g and read as kg, or "
            "the URDF wrong?"
        )
        yield Diagnosis("torque-above-limit", (), (), evidence, expected, advice)


def condition_diagnoses(estimate: Estimate) -> Iterator[Diagnosis]:
    """Name equations whose parameters mean nothing outside these moves."""
    if estimate.condition <= LARGEST_CONDITION:
        return
    evidence = f"a condition number of {estimate.condition:.2g}"
    expected = f"100 to 1e5, below {LARGEST_CONDITION:.0e}"
    advice = (
        "single parameters mean nothing here, and another motion is not predicted: move all "
        "axes together, through more of their range, and see whether the URDF rounds its "
        "angles (1.57 in place of pi/2)"
    )
    yield Diagnosis("ill-conditioned", (), (), evidence, expected, advice)


# Channels


@takes(model=Model, runs=Iterable, conditioning=Conditioning, axes=Sequence)
def exchanged_channels(
    model: Model, runs: Iterable[Run], conditioning: Conditioning, axes: Sequence[str]
) -> Diagnosis | None:
    """Name an order of the channels that explains each motor that it moves clearly better.

    All runs are judged together.

    Args:
        model, conditioning: of the fit.
        runs: read one after the other.
        axes: name of each axis.

    Raises:
        DataUnfit: as of `ident.equations.reduction.reduce_runs`.
    """
    require_names("axes", axes, model.robot.axis_count)
    require_entries("runs", runs, Run, "give a list of runs: [bare, loaded]")
    # Internal preload is in every current: no motor has an equation without those of the others
    if model.is_redundant:
        return None
    return exchange_shown_by(channel_evidence(model, runs, conditioning), axes)


def exchange_shown_by(evidence: ChannelEvidence, axes: Sequence[str]) -> Diagnosis | None:
    """The same from what the equations of the motors explain.

    Args:
        evidence: of some runs.
        axes: name of each axis.
    """
    errors = evidence.errors
    if not np.all((errors > 0.0) & np.isfinite(errors)):
        return None
    # The order with the smallest product of errors
    _, best_channels = scipy.optimize.linear_sum_assignment(np.log(errors))
    moved: list[str] = []
    reasons: list[str] = []
    for motor, channel in enumerate(best_channels.tolist()):
        if motor == channel:
            continue
        if not evidence.is_clearly_better(motor, channel):
            return None
        name = axes[motor]
        error_percent = 100.0 * errors[motor, channel]
        own_error_percent = 100.0 * errors[motor, motor]
        moved.append(name)
        reasons.append(
            f"the motion of {name} explains the current of {axes[channel]} (error "
            f"{error_percent:.2g} %) rather than its own ({own_error_percent:.2g} %)"
        )
    if not moved:
        return None
    expected = "each current to follow from the motion of its own axis"
    advice = (
        "exchange these currents: the drives' node numbers in the cell, and record again, because "
        "a log keeps those that it was recorded with; or the columns of the import, and import "
        "again"
    )
    evidence_text = "; ".join(reasons)
    return Diagnosis("channels-exchanged", (), tuple(moved), evidence_text, expected, advice)


def require_explained_currents(
    run: Run, model: Model, conditioning: Conditioning, axes: Sequence[str]
) -> None:
    """Refuse a recording with currents that look like sizes and that no motor's equation explains.

    A load that is always carried may come down to zero again and again, with little friction to
    take its current below. Its motor's equation explains it then, and does not explain a size.

    Args:
        run: a recording.
        model, conditioning: of the fit.
        axes: name of each axis.

    Raises:
        CurrentUnsigned: drives report the size of the current only.
    """
    unsigned = unsigned_currents(run, model.drive_train.ratio)
    if not unsigned.any():
        return
    # A redundant robot has no equation for one motor, and a run that is too short has too few: the
    # shape decides.
    if not model.is_redundant:
        with suppress(DataUnfit):
            own_errors = np.diag(channel_errors(model, (run,), conditioning))
            unsigned &= ~(100.0 * own_errors <= LARGEST_AXIS_ERROR_PERCENT)
    refuse_unsigned(run, unsigned, axes)


def unsigned_channels(
    model: Model, runs: Sequence[Run], conditioning: Conditioning, axes: Sequence[str]
) -> CurrentUnsigned | None:
    """Name currents that have one sign in all runs and that nothing explains: sizes.

    Their motors turn both ways. A load that is always carried has one sign, too, but the equation
    of its motor explains it. This finds a size that `ident.data.unsigned_current` does not, because
    friction takes its current through zero between two samples.

    Arguments as for `exchanged_channels`.

    Raises:
        DataUnfit: as of `ident.equations.reduction.reduce_runs`.
    """
    if model.is_redundant:
        return None
    gear_ratio = model.drive_train.ratio
    by_run = [one_sided_currents(run, gear_ratio) for run in runs]
    one_sided = np.all(by_run, axis=0)
    if not one_sided.any():
        return None
    own_errors = np.diag(channel_errors(model, runs, conditioning))
    is_unexplained = 100.0 * own_errors > LARGEST_AXIS_ERROR_PERCENT
    unsigned = np.flatnonzero(one_sided & is_unexplained).tolist()
    if not unsigned:
        return None
    run_names = ", ".join(run.name for run in runs)
    axis_names = tuple(axes[axis] for axis in unsigned)
    return CurrentUnsigned(run_names, axis_names, missing_signs(runs[0], unsigned))


def channel_errors(model: Model, runs: Iterable[Run], conditioning: Conditioning) -> FloatArray:
    """Share of the current k that the equation of motor i leaves, shape (m, m).

    Each pair has gains and parameters of its own.

    Raises:
        DataUnfit: as of `ident.equations.reduction.reduce_runs`.
    """
    return channel_evidence(model, runs, conditioning).errors


@dataclass(frozen=True, slots=True, eq=False)
class ChannelEvidence:
    """How well the equation of each motor explains each current."""

    #: share of the current k that the equation of motor i leaves, shape (m, m); NaN where unknown
    errors: FloatArray
    #: Square of that share, of which each block of moves has a part, shape (CHANNEL_BLOCKS, m, m).
    block_shares: FloatArray

    def is_clearly_better(self, motor: int, channel: int) -> bool:
        """Whether a motor explains another current clearly better, and in most blocks of moves."""
        error_ratio = self.errors[motor, motor] / self.errors[motor, channel]
        if not np.log(error_ratio) >= CHANNEL_FALL:
            return False
        own = self.block_shares[:, motor, motor]
        other = self.block_shares[:, motor, channel]
        # The mean of a block is added on both sides, so that a block of few rows does not decide.
        usual = float(np.mean(other))
        share_ratio = (own + usual) / (other + usual)
        falls = 0.5 * np.log(share_ratio)
        std_of_mean = float(np.std(falls, ddof=1)) / np.sqrt(len(falls))
        return bool(np.mean(falls) > CHANNEL_T * std_of_mean)


@dataclass(frozen=True, slots=True, eq=False)
class ChannelTriangles:
    """Triangles of one run: each motor's equation beside all currents, in blocks of moves."""

    #: R of each motor's columns and of all currents, by block; None of a block without rows.
    factors: tuple[tuple[FloatArray | None, ...], ...]
    row_counts: IntArray  #: rows of each motor, shape (m,)


def channel_triangles(model: Model, run: Run, conditioning: Conditioning) -> ChannelTriangles:
    """Reduce one run to what explains the current of each channel by the equation of each motor.

    Raises:
        DataUnfit: as of `ident.equations.reduction.reduce_runs`.
    """
    count = model.robot.axis_count
    train = model.drive_train
    support = motor_support(train, model.support)
    factors: list[list[FloatArray | None]] = [[None] * CHANNEL_BLOCKS for _ in range(count)]
    row_counts = np.zeros(count, dtype=np.int64)
    data = differentiate(run, train, conditioning)
    for rows in rows_of(model, data, conditioning):
        block_of_row = rows.move % CHANNEL_BLOCKS
        for motor, used in enumerate(rows.motor_use):
            own_factors = factors[motor]
            mixed = motor_columns(train.to_motor[motor], rows.standard.__getitem__)
            own_columns = mixed[support[motor]]
            # One body for all mountings will do
            payload = mixed[model.flange] * (run.payload is not None)
            columns = np.concatenate((own_columns, payload, rows.current))
            for block in np.unique(block_of_row[used]).tolist():
                in_block = used & (block_of_row == block)
                own_factors[block] = qr_update(own_factors[block], columns[:, in_block])
            row_counts[motor] += np.count_nonzero(used)
    return ChannelTriangles(tuple(map(tuple, factors)), row_counts)


def channel_evidence(
    model: Model, runs: Iterable[Run], conditioning: Conditioning
) -> ChannelEvidence:
    """Explain the current of each channel by the equation of each motor.

    Raises:
        DataUnfit: as of `ident.equations.reduction.reduce_runs`.
    """
    triangles = [channel_triangles(model, run, conditioning) for run in runs]
    return explain_channels(triangles)


def explain_channels(runs: Sequence[ChannelTriangles]) -> ChannelEvidence:
    """The same from runs that are reduced already.

    Args:
        runs: of one robot, at least one.
    """
    count = len(runs[0].row_counts)
    row_counts = np.sum([run.row_counts for run in runs], axis=0)
    errors = np.full((count, count), np.nan)
    shares = np.zeros((CHANNEL_BLOCKS, count, count))
    for motor in range(count):
        blocks = _joined_blocks([run.factors[motor] for run in runs])
        if not blocks:
            continue
        first_block = next(iter(blocks.values()))
        width = first_block.shape[1]
        rows = row_counts[motor]
        if rows <= width:
            continue
        # R = [[R_w, R_i], [0, R_left]]: the motor's own columns, then the currents of all
        own_width = width - count
        own = slice(None, own_width)
        currents = slice(own_width, None)
        whole = triangle(blocks.values(), width)
        size = np.linalg.norm(whole[:, currents], axis=0)
        left_size = np.linalg.norm(whole[currents, currents], axis=0)
        freedom = np.sqrt(rows / (rows - own_width))
        errors[motor] = left_size / size
        errors[motor] *= freedom
        solution = scipy.linalg.lstsq(whole[own, own], whole[own, currents])[0]
        for number, factor in blocks.items():
            left = factor[:, currents] - factor[:, own] @ solution
            shares[number, motor] = np.sum(left**2, axis=0) / size**2
    return ChannelEvidence(errors, shares)


def _joined_blocks(factors: Sequence[Sequence[FloatArray | None]]) -> dict[int, FloatArray]:
    """Triangle of each block of one motor, from its triangles in each run.

    The runs of a session begin alike: the first block of the next run is the second one of all.
    """
    parts: dict[int, list[FloatArray]] = {}
    for run_number, of_run in enumerate(factors):
        for block, factor in enumerate(of_run):
            if factor is not None:
                shifted_block = (block + run_number) % CHANNEL_BLOCKS
                parts.setdefault(shifted_block, []).append(factor)
    joined: dict[int, FloatArray] = {}
    for block in sorted(parts):
        own = parts[block]
        if len(own) == 1:
            joined[block] = own[0]
        else:
            joined[block] = triangle(own, own[0].shape[1])
    return joined
