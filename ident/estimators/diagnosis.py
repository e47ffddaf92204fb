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
from ident.data.unsigned_current import missing_sign, one_sided_currents, unsigned_currents
from ident.equations.reduction import motor_support
from ident.equations.rows import motor_columns, rows_of
from ident.equations.system import System
from ident.equations.triangles import qr_update, triangle
from ident.errors import GAIN_UNSEEN, CurrentUnsigned, DataUnfit, Diagnosis, IdentificationError
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
    weight_ratio,
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
        limits = np.asarray(effort_limit, dtype=np.float64)
    with with_channel_causes(found.channels, axes):
        return tuple(_diagnoses(found, axes, entered_gains, limits))


TRACES_OF_STILL_JOINTS = {"axis-error", "masses-contradict", "payload-differs"}
"""Diagnoses that an encoder may leave which stood still while its joint moved.

One of a joint at rest leaves none.
"""


LARGEST_SCATTER = 0.03
"""Relative σ of every gain that is no trace:
recordings that do not contradict each other give 1 % on most axes.
"""


def _diagnoses(
    found: Identification,
    axes: Sequence[str],
    nameplate: FloatArray | None,
    effort_limit: FloatArray | None,
) -> Sequence[Diagnosis]:
    """Refuse mistakes, and name all others; see `diagnose`."""
    system = found.system
    estimate = judged_estimate(system, found.estimate)
    refuse_mistakes(system, estimate, axes, nameplate)
    diagnoses = [
        *fault_diagnoses(found.channels, axes),
        *held_diagnoses(found.channels, axes),
        *clip_diagnoses(found.channels, axes),
        *limit_diagnoses(found.channels, axes),
    ]
    if nameplate is not None and not estimate.gains_fixed:
        diagnoses += gain_diagnoses(estimate, nameplate, axes)
    diagnoses += estimator_diagnoses(found.estimate, estimate, axes)
    likeliest = estimate
    if estimate.gains_fixed:
        with suppress(IdentificationError):
            likeliest = ml(system, estimate.gains)
    given = len(estimate.gains) if estimate.gains_fixed else 0
    payloads = list(weight_diagnoses(system, estimate))
    payloads += payload_diagnoses(system, likeliest.gains, likeliest.parameters, given)
    # A payload that differs is the cause, an axis error only its trace.
    diagnoses += payloads or error_diagnoses(found.model, system, estimate, axes)
    unseen = found.holdout
    if unseen is not None:
        payloads = list(payload_diagnoses(unseen, likeliest.gains, likeliest.parameters))
        diagnoses += payloads or error_diagnoses(
            found.model, unseen, estimate, axes, unseen.seen_runs
        )
    if effort_limit is not None:
        diagnoses += torque_diagnoses(system, estimate, effort_limit)
    scatter = estimate.gains_std / np.abs(estimate.gains)
    has_scatter = not estimate.gains_fixed and float(np.min(scatter)) > LARGEST_SCATTER
    if has_scatter or any(one.name in TRACES_OF_STILL_JOINTS for one in diagnoses):
        diagnoses = [*still_diagnoses(found.channels, axes), *diagnoses]
    return (*diagnoses, *condition_diagnoses(found.estimate))


def judged_estimate(system: System, estimate: Estimate) -> Estimate:
    """Return the estimate by which recordings are judged:
    ``ml``, or with fixed gains IDIM-WLS, whatever was asked for.

    The deviations of the linear estimates are those of independent rows (eqs. 10, 23) and do not
    see that moves contradict each other; those of ``ml`` do. With fixed gains IDIM-WLS always has
    an estimate.

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
    if not estimate.gains_fixed or not system.knows_payload:
        return
    ratio, std = weight_ratio(system, estimate)
    if ratio - std > WEIGHT_RATIO or ratio + std < 1.0 / WEIGHT_RATIO:
        loaded = sorted({run for run, mounting in system.cluster_runs if mounting >= 0})
        yield Diagnosis(
            "payload-differs",
            tuple(system.runs[run] for run in loaded),
            (),
            f"{ratio:.2g} times the declared weight of the payload, by these gains",
            f"1, and within a factor of {WEIGHT_RATIO:g}",
            "was it mounted in these runs? are its mass and the fixed gains right?",
        )


def gain_diagnoses(
    estimate: Estimate, nameplate: FloatArray, axes: Sequence[str]
) -> Iterator[Diagnosis]:
    """Compare free gains with the nameplate:
    signs, and sizes outside GAIN_RANGE by more than GAIN_SIGMAS σ.

    A gain that the moves hardly show is named as well where it may be zero, or where its number is
    absurd.
    """
    ratio = estimate.gains / nameplate
    known = estimate.gains_std < np.abs(estimate.gains) / GAIN_SIGMAS
    for axis in np.flatnonzero(known & (ratio < 0.0)).tolist():
        yield Diagnosis(
            "current-reversed",
            (),
            (axes[axis],),
            f"a gain of {estimate.gains[axis]:.4g} ± {estimate.gains_std[axis]:.2g}",
            f"the sign of the nameplate, {nameplate[axis]:.4g}",
            "does the drive, or the import, count this current the other way?",
        )
    margin = GAIN_SIGMAS * np.abs(estimate.gains_std / nameplate)
    is_off = outside(np.abs(ratio), margin, GAIN_RANGE)
    is_absurd = (ratio < 0.0) | outside(np.abs(ratio), 0.0, (1.0 / ABSURD_RATIO, ABSURD_RATIO))
    is_absurd |= np.abs(estimate.gains) < UNSEEN_SIGMAS * estimate.gains_std
    for axis in np.flatnonzero(~known & ~is_off & is_absurd).tolist():
        yield Diagnosis(
            GAIN_UNSEEN,
            (),
            (axes[axis],),
            f"a gain of {estimate.gains[axis]:.4g} ± {estimate.gains_std[axis]:.2g}, nameplate "
            f"{nameplate[axis]:.4g}",
            f"a gain that is more than {GAIN_SIGMAS:g} σ from zero",
            "these moves hardly show this gain: record faster and wider moves of this axis, loaded "
            "too, and fit them together with these; do not use this gain",
        )
    for axis in np.flatnonzero(is_off).tolist():
        gain = f"{estimate.gains[axis]:.4g} ± {estimate.gains_std[axis]:.2g}"
        yield Diagnosis(
            "gain-off-nameplate",
            (),
            (axes[axis],),
            f"a gain of {gain}, {ratio[axis]:.3g} times the nameplate",
            f"{range_text(GAIN_RANGE)} of {nameplate[axis]:.4g}, within {GAIN_SIGMAS:g} σ",
            "is the nameplate of this axis, its gear ratio, the scale of its current, the "
            "payload's mass, or a length of the URDF wrong? measure the lengths: on a serial arm "
            "no data show them",
        )


def outside(
    values: FloatArray, margin: FloatArray | float, bounds: tuple[float, float]
) -> BoolArray:
    """Whether numbers are outside a range by more than a margin; NaN is not."""
    return np.asarray((values + margin < bounds[0]) | (values - margin > bounds[1]))


def scale_diagnoses(
    measured_nm: FloatArray,
    predicted_nm: FloatArray,
    use: BoolArray,
    axes: Sequence[str],
    runs: tuple[str, ...],
) -> Iterator[Diagnosis]:
    """Compare the torque of a run, from its currents and the gains of a calibration,
    with what that predicts.

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
        found = current_scale(measured_nm[axis, use[axis]], predicted_nm[axis, use[axis]])
        evidence = f"{found.ratio:.3g} times the predicted torque"
        if found.ratio < 0.0 and found.left**2 < 1.0 - ALIKE:
            yield Diagnosis(
                "current-reversed",
                runs,
                (name,),
                evidence,
                "1",
                "does the drive, or the import, count this current the other way?",
            )
        is_off = outside(np.abs(found.ratio), GAIN_SIGMAS * found.std, CURRENT_RANGE)
        if is_off and 100.0 * found.left < LARGEST_AXIS_ERROR_PERCENT:
            yield Diagnosis(
                "current-off-scale",
                runs,
                (name,),
                evidence,
                f"1, and {range_text(CURRENT_RANGE)} after years",
                "is the current in another unit (mA) than in the fit, or of another drive?",
            )


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
    starts = np.arange(SCALE_BLOCKS) * len(products) // SCALE_BLOCKS
    others = (product - np.add.reduceat(products, starts)) / (
        square - np.add.reduceat(squares, starts)
    )
    std = float(np.sqrt((SCALE_BLOCKS - 1) * np.var(others)))
    left = float(np.sqrt(max(0.0, 1.0 - product**2 / (square * size))))
    return TorqueScale(product / square, std, left)


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
"""What to do where an estimator's gain is far from that of ml;
iv need not agree with it (`diagnose`).
"""


def estimator_diagnoses(
    estimate: Estimate, likeliest: Estimate, axes: Sequence[str]
) -> Iterator[Diagnosis]:
    """Compare the gains of another estimator with those of ml on the same equations."""
    if estimate.gains_fixed or estimate is likeliest:
        return
    change = np.abs(estimate.gains - likeliest.gains)
    far = (change > GAIN_DIFFERENCE * np.abs(likeliest.gains)) & (
        change > GAIN_SIGMAS * likeliest.gains_std
    )
    for axis in np.flatnonzero(far).tolist():
        percent = 100.0 * change[axis] / abs(likeliest.gains[axis])
        yield Diagnosis(
            "estimators-disagree",
            (),
            (axes[axis],),
            f"a gain of {estimate.gains[axis]:.4g} by {estimate.method.value}, {percent:.0f} % "
            f"from {likeliest.gains[axis]:.4g} ± {likeliest.gains_std[axis]:.2g} by ml on the same "
            "rows",
            f"at most {100.0 * GAIN_DIFFERENCE:.0f} %, or {GAIN_SIGMAS:g} σ",
            REMEDIES_OF_DISAGREEMENT[estimate.method],
        )


# Errors, torques and condition


def error_diagnoses(
    model: Model,
    system: System,
    estimate: Estimate,
    axes: Sequence[str],
    runs: tuple[str, ...] = (),
) -> Iterator[Diagnosis]:
    """Name axes whose error is above LARGEST_AXIS_ERROR_PERCENT;
    arguments as for `axis_error_diagnoses`.
    """
    size, left = joint_torques(system, estimate)
    yield from axis_error_diagnoses(size, left, idle_joints(model, size, left), axes, runs)


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
    for axis in np.flatnonzero(100.0 * left > LARGEST_AXIS_ERROR_PERCENT * size).tolist():
        found = (
            f"an error of {left[axis]:.2g} in {size[axis]:.2g} Nm (or N), "
            f"{100.0 * left[axis] / size[axis]:.3g} %"
        )
        if idle[axis]:
            yield Diagnosis(
                "axis-idle",
                runs,
                (axes[axis],),
                f"{found}, nothing beside the torques of the other axes",
                "a torque above the noise",
                "this axis carries too little here to judge it: load it, or move it faster",
            )
        else:
            yield Diagnosis(
                "axis-error",
                runs,
                (axes[axis],),
                found,
                f"some 3 to 15 %, below {LARGEST_AXIS_ERROR_PERCENT:g} %",
                "look for what contradicts the model on this axis: its current channel and sign, "
                "gear ratio, payload, friction or an effect that is not declared (`find_effects`)",
            )


def torque_diagnoses(
    system: System, estimate: Estimate, effort_limit: FloatArray
) -> Iterator[Diagnosis]:
    """Compare the torques with the effort limits of the URDF: a unit puts all of them above."""
    torque, _ = joint_torques(system, estimate)
    if np.any(np.isfinite(effort_limit)) and np.all(
        torque[np.isfinite(effort_limit)] > TORQUE_RATIO * effort_limit[np.isfinite(effort_limit)]
    ):
        yield Diagnosis(
            "torque-above-limit",
            (),
            (),
            f"torques of {numbers_text(torque)} Nm (or N; root mean square)",
            f"less than the effort limits of the URDF, {numbers_text(effort_limit)}",
            "are the currents in mA and read as A, is the payload's mass in g and read as kg, or "
            "the URDF wrong?",
        )


def condition_diagnoses(estimate: Estimate) -> Iterator[Diagnosis]:
    """Name equations whose parameters mean nothing outside these moves."""
    if not estimate.condition <= LARGEST_CONDITION:
        yield Diagnosis(
            "ill-conditioned",
            (),
            (),
            f"a condition number of {estimate.condition:.2g}",
            f"100 to 1e5, below {LARGEST_CONDITION:.0e}",
            "single parameters mean nothing here, and another motion is not predicted: move all "
            "axes together, through more of their range, and see whether the URDF rounds its "
            "angles (1.57 in place of pi/2)",
        )


# Channels


@takes(model=Model, runs=Iterable, conditioning=Conditioning, axes=Sequence)
def exchanged_channels(
    model: Model, runs: Iterable[Run], conditioning: Conditioning, axes: Sequence[str]
) -> Diagnosis | None:
    """Whether another order of the channels explains each motor that it moves clearly better,
    in all runs together.

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
    best = scipy.optimize.linear_sum_assignment(np.log(errors))[1].tolist()
    moved = [motor for motor, channel in enumerate(best) if motor != channel]
    if not moved or not all(evidence.is_clearly_better(motor, best[motor]) for motor in moved):
        return None
    return Diagnosis(
        "channels-exchanged",
        (),
        tuple(axes[motor] for motor in moved),
        "; ".join(
            f"the motion of {axes[motor]} explains the current of {axes[best[motor]]} (error "
            f"{100.0 * errors[motor, best[motor]]:.2g} %) rather than its own "
            f"({100.0 * errors[motor, motor]:.2g} %)"
            for motor in moved
        ),
        "each current to follow from the motion of its own axis",
        "exchange these currents: the drives' node numbers in the cell, and record again, because "
        "a log keeps those that it was recorded with; or the columns of the import, and import "
        "again",
    )


def require_explained_currents(
    run: Run, model: Model, conditioning: Conditioning, axes: Sequence[str]
) -> None:
    """Refuse a recording with currents that look like sizes,
    unless the equations of their motors explain them.

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
    if unsigned.any():
        names = tuple(axis for axis, found in zip(axes, unsigned, strict=True) if found)
        raise CurrentUnsigned(run.name, names, missing_sign(run.current_a[:, unsigned]))


def unsigned_channels(
    model: Model, runs: Sequence[Run], conditioning: Conditioning, axes: Sequence[str]
) -> CurrentUnsigned | None:
    """Whether a current that has one sign in all runs is a size:
    while its motor turns both ways nothing explains it.

    A load that is always carried has one sign, too, but the equation of its motor explains it. This
    finds a size that `ident.data.unsigned_current` does not, because friction takes its current
    through zero between two samples.

    Arguments as for `exchanged_channels`.

    Raises:
        DataUnfit: as of `ident.equations.reduction.reduce_runs`.
    """
    if model.is_redundant:
        return None
    one_sided = np.all([one_sided_currents(run, model.drive_train.ratio) for run in runs], axis=0)
    if not one_sided.any():
        return None
    own_errors = np.diag(channel_errors(model, runs, conditioning))
    unsigned = np.flatnonzero(one_sided & (100.0 * own_errors > LARGEST_AXIS_ERROR_PERCENT))
    if not len(unsigned):
        return None
    names = tuple(axes[axis] for axis in unsigned.tolist())
    return CurrentUnsigned(
        ", ".join(run.name for run in runs), names, missing_sign(runs[0].current_a[:, unsigned])
    )


def channel_errors(model: Model, runs: Iterable[Run], conditioning: Conditioning) -> FloatArray:
    """Share of the current k that the equation of motor i leaves,
    every gain and parameter of its own, shape (m, m).

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
        """Whether a motor explains another current better than its own,
        by CHANNEL_FALL and in the blocks alike.
        """
        fall = float(np.log(self.errors[motor, motor] / self.errors[motor, channel]))
        if not fall >= CHANNEL_FALL:
            return False
        own = self.block_shares[:, motor, motor]
        other = self.block_shares[:, motor, channel]
        # The mean of a block is added on both sides, so that a block of few rows does not decide.
        usual = float(np.mean(other))
        falls = 0.5 * np.log((own + usual) / (other + usual))
        std = float(np.std(falls, ddof=1)) / np.sqrt(len(falls))
        return bool(np.mean(falls) > CHANNEL_T * std)


@dataclass(frozen=True, slots=True, eq=False)
class ChannelTriangles:
    """Rows of one run as triangles: the equation of each motor beside the currents of all,
    in blocks of moves.
    """

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
            mixed = motor_columns(train.to_motor[motor], rows.standard.__getitem__)
            # One body for all mountings will do
            payload = mixed[model.flange] * (run.payload is not None)
            columns = np.concatenate((mixed[support[motor]], payload, rows.current))
            for block in np.unique(block_of_row[used]).tolist():
                chosen = columns[:, used & (block_of_row == block)]
                factors[motor][block] = qr_update(factors[motor][block], chosen)
            row_counts[motor] += np.count_nonzero(used)
    return ChannelTriangles(tuple(map(tuple, factors)), row_counts)


def channel_evidence(
    model: Model, runs: Iterable[Run], conditioning: Conditioning
) -> ChannelEvidence:
    """Explain the current of each channel by the equation of each motor.

    Raises:
        DataUnfit: as of `ident.equations.reduction.reduce_runs`.
    """
    return explain_channels([channel_triangles(model, run, conditioning) for run in runs])


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
        whole = triangle(blocks.values(), next(iter(blocks.values())).shape[1])
        if row_counts[motor] <= whole.shape[1]:
            continue
        first = whole.shape[1] - count
        size = np.linalg.norm(whole[:, first:], axis=0)
        errors[motor] = np.linalg.norm(whole[first:, first:], axis=0) / size
        errors[motor] *= np.sqrt(row_counts[motor] / (row_counts[motor] - first))
        explained = scipy.linalg.lstsq(whole[:first, :first], whole[:first, first:])[0]
        for number, factor in blocks.items():
            left = factor[:, first:] - factor[:, :first] @ explained
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
                parts.setdefault((block + run_number) % CHANNEL_BLOCKS, []).append(factor)
    joined: dict[int, FloatArray] = {}
    for block in sorted(parts):
        own = parts[block]
        if len(own) == 1:
            joined[block] = own[0]
        else:
            joined[block] = triangle(own, own[0].shape[1])
    return joined
