"""Faults of a recording, by run, channel or axis, before any of its numbers is believed.

A fit may end with small deviations and be wrong: a payload turned between two runs, two currents exchanged, mA read as
A. Each mistake leaves a trace of its own. `diagnose` looks for them in the equations of a fit; `exchanged_channels`
reads the runs again, because the equations of a motor hold its own current alone.

A mistake that leaves no usable number is an error (kinds of `ident.errors.ModelContradicted`), any other a `Diagnosis`.
The limits were set by `make diagnosis-study`; those of a single number are in `ident.plausible`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np
import scipy  # loads its modules when they are first used: a clean fit needs none of them

from ident.arrays import BoolArray, FloatArray
from ident.data.conditioning import Conditioning
from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.equations.reduction import layout
from ident.equations.rows import rows_of
from ident.equations.system import System
from ident.equations.triangles import qr_update, solve
from ident.errors import CurrentReversed, Diagnosis, IdentificationError, UnitsMistaken
from ident.estimators.estimate import Estimate
from ident.estimators.least_squares import wls
from ident.estimators.maximum_likelihood import ml
from ident.estimators.payload_diagnosis import payload_diagnoses
from ident.model.model import Model
from ident.plausible import GAIN_RATIO, TORQUE_RATIO, UNIT_RATIO

if TYPE_CHECKING:  # which refuses a fit by the checks below
    from ident.estimators.identify import Identification

LARGEST_AXIS_ERROR_PERCENT = 20.0  #: Clean recordings stay below 15, with every effect undeclared below 40
IDLE_TORQUE, IDLE_ERROR = 1e-3, 1e-2
"""Torque and error of an idle axis, relative to the largest torque of any: 0.01 Nm of a wrist beside the 30 Nm of a
shoulder is below every friction. The wrist of a real robot carries 0.02 of it and more."""
LARGEST_CONDITION = 1e6
"""Largest condition number. An error of one σ along the weakest direction of the parameters is 1/s_min, and it exceeds
all parameters together where the condition exceeds s_max ‖χ‖. That is 1e4 to 2e5 in real and simulated recordings."""
GAIN_DIFFERENCE, GAIN_SIGMAS = 0.1, 3.0  #: Of another estimator's gain from that of ml: relative, and in σ of ml
ALIKE = 0.25  #: Least squared correlation of two torques of which one is the other's, reversed
EXCHANGE = 0.4
"""Least fall of the logarithm of the motors' errors, in sum, of exchanged channels; with the right ones it is zero. Of
all pairs of channels of two real robots and of five simulated arms the smallest is 0.6."""
LEVEL = 0.05  #: Largest rise of the same, where it decides nothing and the sign of the friction must
SMALL_ERROR = 0.02  #: Relative error of a motor below which its current needs no other explanation
FRICTION = re.compile(r"f[vs](m?)([0-9]+)\b")  #: Names of the friction of a joint or of its coupled motor
FRICTION_SIGMAS = 15.0  #: In the σ of independent rows, which is some three times too small
WEIGHT_SIGMAS = 30.0  #: Likewise, for the weight of a payload


def diagnose(
    found: Identification,
    axes: Sequence[str],
    nameplate: FloatArray | None = None,
    effort_limit: FloatArray | None = None,
) -> tuple[Diagnosis, ...]:
    """Test a fit for mistakes in its recordings and declarations.

    Args:
        found: with or without effects; of any estimator.
        axes: name of each axis.
        nameplate: the manufacturer's gains, shape (m,); without them no gain is compared.
        effort_limit: of the joints, inf where unknown [Nm or N], shape (m,).

    Raises:
        UnitsMistaken: see `require_units`.
        PayloadDiffers: see `payload_diagnoses`.
    """
    system, estimate, diagnoses = found.system, found.estimate, list[Diagnosis]()
    if nameplate is not None and not estimate.gains_fixed:
        require_units(estimate.gains, nameplate)
        diagnoses += gain_diagnoses(estimate, nameplate, axes)
    likeliest = estimate
    if not estimate.method.is_of_currents:
        with suppress(IdentificationError):
            likeliest = ml(system, estimate.gains if estimate.gains_fixed else None)
        diagnoses += estimator_diagnoses(estimate, likeliest, axes)
    held = len(estimate.gains) if estimate.gains_fixed else 0
    for rows, runs in ((system, ()), (found.holdout, () if found.holdout is None else found.holdout.seen_runs)):
        if rows is not None:
            of_fit = held if rows is system else None
            payloads = [] if of_fit is None else list(weight_diagnoses(rows, estimate))
            payloads += list(payload_diagnoses(rows, likeliest.gains, likeliest.parameters, of_fit))
            # A payload that differs is the cause, an axis error only its trace.
            diagnoses += payloads or error_diagnoses(found.model, rows, estimate, axes, runs)
    if effort_limit is not None:
        diagnoses += torque_diagnoses(system, estimate, effort_limit)
    return (*diagnoses, *condition_diagnoses(estimate))


# Gains and units


def require_units(gains: FloatArray, nameplate: FloatArray) -> None:
    """Refuse gains that are all off the nameplate by a factor that only a unit has.

    Raises:
        UnitsMistaken: each is more than UNIT_RATIO times, or less than 1/UNIT_RATIO of, its nameplate.
    """
    ratio = np.abs(gains / nameplate)
    if np.all(ratio < 1.0 / UNIT_RATIO):
        cause = "are the currents in mA and read as A, or is the payload's mass in t?"
    elif np.all(ratio > UNIT_RATIO):
        cause = "is the payload's mass in g and read as kg, or are the currents in kA?"
    else:
        return
    raise UnitsMistaken(
        "all drive gains",
        found=f"{_numbers(ratio)} times the nameplate",
        expected=f"0.7 to 1.3, and within a factor of {UNIT_RATIO:g} at least on one axis",
        remedy=cause,
    )


def require_weight(system: System, estimate: Estimate) -> None:
    """Refuse fixed gains with which a weighed payload has another weight, by a factor that only a unit has.

    Raises:
        UnitsMistaken: more than UNIT_RATIO times, or less than 1/UNIT_RATIO of what was declared.
    """
    if not system.knows_payload:
        return
    ratio, std = weight_ratio(system, estimate)
    if ratio - std > UNIT_RATIO or ratio + std < 1.0 / UNIT_RATIO:
        raise UnitsMistaken(
            "the weight of the payload",
            found=f"{ratio:.3g} times the declared one, by these gains",
            expected=f"0.7 to 1.3 times, and within a factor of {UNIT_RATIO:g} at least",
            remedy="are the currents in mA and read as A, is its mass in g and read as kg, or was it not mounted?",
        )


def weight_ratio(system: System, estimate: Estimate) -> tuple[float, float]:
    """Size of W_kL χ_kL that the currents ask for with given gains, and WEIGHT_SIGMAS of its σ."""
    if system.model.is_redundant:  # no motor has an equation of its own
        whitened = system.currents.whitened(estimate.gains, np.ones(len(estimate.gains)))
        torque, right = np.column_stack((whitened.linear, whitened.known)), whitened.drive @ estimate.gains
        return _last(torque, right, int(system.motors.rows.sum()))
    # Weighted by the size of each current: the residuals of a fit with a wrong weight say nothing about noise.
    factors = [factor / max(float(np.linalg.norm(factor[:, 0])), 1e-300) for factor in system.motors.factors]
    rows = np.concatenate(factors)
    scale = np.concatenate([np.full(len(f), 1.0 / g) for f, g in zip(factors, estimate.gains, strict=True)])
    return _last(rows[:, 1:] * scale[:, None], rows[:, 0], int(system.motors.rows.sum()))


def _last(columns: FloatArray, right: FloatArray, rows: int) -> tuple[float, float]:
    """Size of the last unknown by least squares, and WEIGHT_SIGMAS of its σ."""
    solution, inverse = solve(columns, right)
    left = float(np.sum((right - columns @ solution) ** 2)) / rows
    return abs(float(solution[-1])), WEIGHT_SIGMAS * float(np.sqrt(left * inverse[-1, -1]))


def weight_diagnoses(system: System, estimate: Estimate) -> Iterator[Diagnosis]:
    """Compare the weight of the payload by fixed gains with the declared one."""
    if not estimate.gains_fixed or not system.knows_payload:
        return
    ratio, std = weight_ratio(system, estimate)
    if ratio - std > GAIN_RATIO or ratio + std < 1.0 / GAIN_RATIO:
        loaded = sorted({run for run, mounting in system.cluster_runs if mounting >= 0})
        yield Diagnosis(
            "payload-differs",
            tuple(system.runs[run] for run in loaded),
            (),
            f"{ratio:.2g} times the declared weight of the payload, by these gains",
            "0.7 to 1.3 times",
            "was it mounted in these runs? are its mass and the fixed gains right?",
        )


def require_signs(system: System, estimate: Estimate, axes: Sequence[str]) -> None:
    """Refuse fixed gains of which some explain the data with the other sign.

    Raises:
        CurrentReversed: with the other sign the errors fall by EXCHANGE, or they stay and the friction, which drove the
            axis, brakes it.
    """

    def tried(signs: FloatArray) -> tuple[float, FloatArray]:
        """Σ log of the motors' errors, and the friction of each axis in σ."""
        one = wls(system, estimate.gains * signs)
        friction = np.zeros(len(axes))
        for column, value, std in zip(one.unknowns, one.parameters, one.parameters_std, strict=True):
            if (of_friction := FRICTION.match(column.name)) is not None:
                number = int(of_friction[2]) - 1
                friction[number if of_friction[1] else joints.index(number)] += value / std
        errors = np.maximum(system.currents.noise(one.gains, one.parameters), smallest)
        return float(np.sum(np.log(errors))), friction

    joints, redundant = system.model.robot.axis_joints, system.model.is_redundant
    own = range(len(axes)) if redundant else [0] * len(axes)  # where a motor's rows have its current
    size = np.array([np.linalg.norm(f[:, column]) for f, column in zip(system.motors.factors, own, strict=True)])
    smallest = SMALL_ERROR * size / np.sqrt(np.maximum(system.motors.rows, 1))
    smallest[smallest == 0.0] = 1.0  # a motor without current
    signs = np.ones(len(axes))
    before, friction = tried(signs)
    for _ in axes:
        better = []
        for axis in range(len(axes)):
            trial = signs * np.where(np.arange(len(axes)) == axis, -1.0, 1.0)
            after, braking = tried(trial)
            driven = friction[axis] < -FRICTION_SIGMAS < FRICTION_SIGMAS < braking[axis]
            if after - before < (LEVEL if driven else -EXCHANGE):
                better.append((after, axis, trial, braking))
        if not better:
            break
        before, _, signs, friction = min(better, key=lambda one: one[:2])
    if np.median(friction) < 0.0:  # without a payload the data fix the signs up to a common one, which friction shows
        signs = -signs
    turned = [axis for axis, sign in zip(axes, signs, strict=True) if sign < 0.0]
    if 0 < len(turned) < len(axes):
        raise CurrentReversed(
            f"axis {', '.join(turned)}",
            found="a current that explains the motion with the other sign of its gain",
            expected="the sign of the fixed gain",
            remedy="does the drive, or the import, count this current the other way? correct its sign",
        )


def gain_diagnoses(estimate: Estimate, nameplate: FloatArray, axes: Sequence[str]) -> Iterator[Diagnosis]:
    """Compare free gains with the nameplate: signs, and sizes beyond GAIN_RATIO."""
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
    for axis in np.flatnonzero((np.abs(ratio) > GAIN_RATIO) | (np.abs(ratio) < 1.0 / GAIN_RATIO)).tolist():
        yield Diagnosis(
            "gain-off-nameplate",
            (),
            (axes[axis],),
            f"a gain of {estimate.gains[axis]:.4g} ± {estimate.gains_std[axis]:.2g}, {ratio[axis]:.3g} nameplates",
            f"0.7 to 1.3 of {nameplate[axis]:.4g}",
            "is the nameplate of this axis, its gear ratio, the scale of its current or the payload's mass wrong?",
        )


def scale_diagnoses(
    measured_nm: FloatArray, predicted_nm: FloatArray, use: BoolArray, axes: Sequence[str], runs: tuple[str, ...]
) -> Iterator[Diagnosis]:
    """Compare the torque of a run, from its currents and the gains of a calibration, with what that predicts.

    Args:
        measured_nm, predicted_nm: joint torque, shape (m, r).
        use: rows of each joint that count, shape (m, r).
        axes: name of each axis.
        runs: name of the run.
    """
    product = np.sum(measured_nm * predicted_nm, axis=1, where=use)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = product / np.sum(predicted_nm**2, axis=1, where=use)
        inverse = product / np.sum(measured_nm**2, axis=1, where=use)
    for axis in np.flatnonzero((ratio < 0.0) & (ratio * inverse > ALIKE)).tolist():
        yield Diagnosis(
            "current-reversed",
            runs,
            (axes[axis],),
            f"{ratio[axis]:.3g} times the predicted torque",
            "1",
            "does the drive, or the import, count this current the other way?",
        )
    for axis in np.flatnonzero((np.abs(ratio) > GAIN_RATIO) | (np.abs(inverse) > GAIN_RATIO)).tolist():
        yield Diagnosis(
            "current-off-scale",
            runs,
            (axes[axis],),
            f"{ratio[axis]:.3g} times the predicted torque",
            "1, and 0.7 to 1.3 after years",
            "is the current in another unit (mA) than in the fit, or of another drive?",
        )


def estimator_diagnoses(estimate: Estimate, likeliest: Estimate, axes: Sequence[str]) -> Iterator[Diagnosis]:
    """Compare the gains of another estimator with those of ml on the same equations."""
    if estimate.gains_fixed or estimate is likeliest:
        return
    change = np.abs(estimate.gains - likeliest.gains)
    far = (change > GAIN_DIFFERENCE * np.abs(likeliest.gains)) & (change > GAIN_SIGMAS * likeliest.gains_std)
    for axis in np.flatnonzero(far).tolist():
        percent = 100.0 * change[axis] / abs(likeliest.gains[axis])
        yield Diagnosis(
            "estimators-disagree",
            (),
            (axes[axis],),
            f"a gain of {estimate.gains[axis]:.4g} by {estimate.method.value}, {percent:.0f} % from "
            f"{likeliest.gains[axis]:.4g} ± {likeliest.gains_std[axis]:.2g} by ml on the same rows",
            f"at most {100.0 * GAIN_DIFFERENCE:.0f} %, or {GAIN_SIGMAS:g} σ",
            "use --method ml: noise in the currents biases this estimator",
        )


# Errors, torques and condition


def joint_torques(system: System, estimate: Estimate) -> tuple[FloatArray, FloatArray]:
    """Torque of each joint, and what the model leaves of it: root mean squares [Nm or N], both of shape (m,)."""
    gains = np.concatenate((estimate.gains, np.zeros(len(estimate.parameters) + 1)))
    whole = np.concatenate((estimate.gains, estimate.parameters, [1.0]))
    rows = np.maximum(system.joints.rows, 1)
    size, left = (np.sqrt(system.joints.square_sum(vector) / rows) for vector in (gains, whole))
    return size, left


def idle_joints(model: Model, size: FloatArray, left: FloatArray) -> BoolArray:
    """Joints whose torque and error are nothing beside the torque of another joint of the kind, shape (m,).

    Args:
        model: of the fit.
        size, left: of `joint_torques`.
    """
    kinds = np.array([joint.kind.value for joint in model.robot.axes])
    largest = np.array([size[kinds == kind].max() for kind in kinds])
    return (size < IDLE_TORQUE * largest) & (left < IDLE_ERROR * largest)


def error_diagnoses(
    model: Model, system: System, estimate: Estimate, axes: Sequence[str], runs: tuple[str, ...] = ()
) -> Iterator[Diagnosis]:
    """Name axes whose error is above LARGEST_AXIS_ERROR_PERCENT; arguments as for `axis_error_diagnoses`."""
    size, left = joint_torques(system, estimate)
    yield from axis_error_diagnoses(size, left, idle_joints(model, size, left), axes, runs)


def axis_error_diagnoses(
    size: FloatArray, left: FloatArray, idle: BoolArray, axes: Sequence[str], runs: tuple[str, ...]
) -> Iterator[Diagnosis]:
    """Name axes whose error is above LARGEST_AXIS_ERROR_PERCENT.

    Args:
        size, left: torque of each joint and what the model leaves of it, root mean squares [Nm or N], shape (m,).
        idle: joints whose error is nothing beside the torques of the others, shape (m,).
        axes: their names.
        runs: that the fit has not seen, empty for its own.
    """
    for axis in np.flatnonzero(100.0 * left > LARGEST_AXIS_ERROR_PERCENT * size).tolist():
        found = f"an error of {left[axis]:.2g} in {size[axis]:.2g} Nm (or N), {100.0 * left[axis] / size[axis]:.3g} %"
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
                "look for what contradicts the model on this axis: its current channel and sign, gear ratio, payload, "
                "friction or an effect that is not declared (`drivegain residual`)",
            )


def torque_diagnoses(system: System, estimate: Estimate, effort_limit: FloatArray) -> Iterator[Diagnosis]:
    """Compare the torques with the effort limits of the URDF: a unit puts all of them above."""
    torque, _ = joint_torques(system, estimate)
    if np.any(np.isfinite(effort_limit)) and np.all(
        torque[np.isfinite(effort_limit)] > TORQUE_RATIO * effort_limit[np.isfinite(effort_limit)]
    ):
        yield Diagnosis(
            "torque-above-limit",
            (),
            (),
            f"torques of {_numbers(torque)} Nm (or N; root mean square)",
            f"less than the effort limits of the URDF, {_numbers(effort_limit)}",
            "are the currents in mA and read as A, is the payload's mass in g and read as kg, or the URDF wrong?",
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
            "single parameters mean nothing here, and another motion is not predicted: move all axes together, through "
            "more of their range, and see whether the URDF rounds its angles (1.57 in place of pi/2)",
        )


# Channels


def exchanged_channels(
    model: Model, runs: Iterable[Run], conditioning: Conditioning, axes: Sequence[str]
) -> Diagnosis | None:
    """Whether another order of the channels explains all motors clearly better, in all runs together.

    Args:
        model, conditioning: of the fit.
        runs: read one after the other.
        axes: name of each axis.

    Raises:
        DataUnfit: as of `ident.equations.reduction.reduce_runs`.
    """
    if model.is_redundant:  # internal preload is in every current: no motor has an equation without those of the others
        return None
    errors = channel_errors(model, runs, conditioning)
    if not np.all((errors > 0.0) & np.isfinite(errors)):
        return None
    level = np.log(errors)
    best = scipy.optimize.linear_sum_assignment(level)[1].tolist()
    moved = [motor for motor, channel in enumerate(best) if motor != channel]
    if sum(level[motor, motor] - level[motor, best[motor]] for motor in moved) < EXCHANGE:
        return None
    return Diagnosis(
        "channels-exchanged",
        (),
        tuple(axes[motor] for motor in moved),
        "; ".join(
            f"the motion of {axes[motor]} explains the current of {axes[best[motor]]} (error "
            f"{100.0 * errors[motor, best[motor]]:.2g} %) rather than its own ({100.0 * errors[motor, motor]:.2g} %)"
            for motor in moved
        ),
        "each current to follow from the motion of its own axis",
        "exchange these currents: the drives' node numbers in the cell, or the columns of the import",
    )


def channel_errors(model: Model, runs: Iterable[Run], conditioning: Conditioning) -> FloatArray:
    """Share of the current k that the equation of motor i leaves, every gain and parameter of its own, shape (m, m).

    Raises:
        DataUnfit: as of `ident.equations.reduction.reduce_runs`.
    """
    count, plan, to_motor = model.robot.axis_count, layout(model), model.drive_train.to_motor
    factors: list[FloatArray | None] = [None] * count
    seen = np.zeros(count)
    for run in runs:
        data = differentiate(run, model.drive_train, conditioning)
        for rows in rows_of(model, data, conditioning):
            for motor, used in enumerate(rows.motor_use):
                joints = np.flatnonzero(to_motor[motor])
                mixed = np.sum([to_motor[motor, joint] * rows.standard[joint][:, used] for joint in joints], axis=0)
                payload = mixed[model.flange] * (run.payload is not None)  # one body for all mountings will do
                columns = np.concatenate((mixed[plan.motor[motor]], payload, rows.current[:, used]))
                factors[motor] = qr_update(factors[motor], columns)
                seen[motor] += np.count_nonzero(used)
    errors = np.full((count, count), np.nan)
    for motor, factor in enumerate(factors):
        if factor is not None and seen[motor] > len(factor):
            first = len(factor) - count
            left = np.linalg.norm(factor[first:, first:], axis=0) / np.linalg.norm(factor[:, first:], axis=0)
            errors[motor] = left * np.sqrt(seen[motor] / (seen[motor] - first))
    return errors


def _numbers(values: FloatArray) -> str:
    return ", ".join(f"{value:.3g}" for value in values)
