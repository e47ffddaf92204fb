"""Refusals of a fit: mistakes of recordings and declarations that leave no number that can be used.

`refuse_mistakes` is the list of all, in their order. The limits were set by `make diagnosis-study`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from ident.arrays import BoolArray, FloatArray
from ident.data.run_channels import RunChannels, missing_joint, still_joint
from ident.equations.system import System
from ident.equations.triangles import solve
from ident.errors import (
    CurrentReversed,
    MassesContradict,
    ModelContradicted,
    NotConverged,
    PayloadDiffers,
    PayloadUnseen,
    RankDeficient,
    RolesExchanged,
    UnitsMistaken,
)
from ident.estimators.estimate import Estimate, RelativeError
from ident.estimators.least_squares import wls
from ident.estimators.payload_diagnosis import likeliest_masses, payload_differences
from ident.model.model import Model
from ident.model.robot import JointKind
from ident.plausible import GAIN_RANGE, LARGEST_GAIN_STD, UNIT_RATIO, range_text

LEAST_WEIGHT = 1e-3
"""Share of the known payload's torque in a joint's, where it is largest.

In a recording it is 0.1 and more.
"""
LARGEST_TOTAL_PERCENT = 50.0
LARGEST_AXIS_PERCENT = 100.0
LARGEST_UNKNOWN_PERCENT = 25.0
"""Largest relative errors of a fit.

A robot with every effect undeclared stays below 15 in total and 40 on an axis; a model that
explains nothing leaves 100. The last is of an axis whose gain is smaller than its own σ.
"""
#: Share of the largest gain: no two drives differ as much, and the error of nothing is small
COLLAPSED_GAIN = 1e-6
IDLE_TORQUE = 1e-3
IDLE_ERROR = 1e-2
"""Torque and error of an idle axis, relative to the largest torque of any: 0.01 Nm of a wrist
beside the 30 Nm of a shoulder is below every friction. The wrist of a real robot carries 0.02 of it
and more.
"""
EXCHANGE = 0.4
"""Least fall of Σ log of the motors' errors, of a fixed gain with the other sign."""
#: Largest rise of the same, where it decides nothing and the sign of the friction must
LEVEL = 0.05
SMALL_ERROR = 0.02  #: Relative error of a motor below which its current needs no other explanation
#: Names of the friction of a joint or of its coupled motor
FRICTION = re.compile(r"f[vs](m?)([0-9]+)\b")
WIDEST_RANGE_RAD = 8.0 * np.pi  #: No arm's joint turns four times: cables go through it
#: Times the travel of a joint that positions in its unit are never: limits of a URDF may be narrow
TRAVEL_EXCESS = 3.0
TRAVEL_TOLERANCE = 1.1  #: Likewise, of positions in the other unit
LARGEST_CURRENT_A = 1000.0  #: A servo amplifier of a robot gives a tenth of it
FRICTION_SIGMAS = 15.0  #: In the σ of independent rows, which is some three times too small
WEIGHT_SIGMAS = 30.0  #: Likewise, for the weight of a payload


def refuse_mistakes(
    system: System, estimate: Estimate, axes: Sequence[str], nameplate: FloatArray | None = None
) -> None:
    """Refuse a fit in which a mistake leaves no number that can be used.

    Args:
        system: of the fit.
        estimate: of these equations, by `judged_estimate`.
        axes: name of each axis.
        nameplate: gains by the data sheet, shape (m,); None where they are not known.

    Raises:
        PayloadUnseen, UnitsMistaken, CurrentReversed, ModelContradicted, RolesExchanged: the first
            that applies.
    """
    if estimate.gains_fixed:
        require_weight(system, estimate)
        require_signs(system, estimate, axes)
    else:
        require_seen_payload(estimate, system)
    size, left = joint_torques(system, estimate)
    idle = idle_joints(system.model, size, left)
    error = estimate.relative_error(system)
    require_plausible(estimate, error, axes, idle)
    if nameplate is not None and not estimate.gains_fixed:
        require_roles(estimate.gains, nameplate)
        require_units(estimate.gains, nameplate)


# Causes in single channels


@contextmanager
def with_channel_causes(runs: Sequence[RunChannels], axes: Sequence[str]) -> Iterator[None]:
    """Name a joint that never moves where a fit is refused for what that leaves.

    Args:
        runs: of the fit.
        axes: name of each axis.

    Raises:
        JointStill: in place of the error that it explains.
    """
    try:
        yield
    except RankDeficient as error:
        still = missing_joint(runs, axes)
        if still is None:
            raise
        raise still from error
    except (ModelContradicted, NotConverged, PayloadUnseen) as error:
        # The other contradictions have a cause of their own: signs, units or roles.
        is_unexplained = type(error) in {
            ModelContradicted,
            NotConverged,
            PayloadDiffers,
            PayloadUnseen,
        }
        if is_unexplained:
            still = still_joint(runs, axes)
        else:
            still = None
        if still is None:
            raise
        raise still from error


@contextmanager
def with_unit_causes(
    runs: Sequence[RunChannels], model: Model, axes: Sequence[str]
) -> Iterator[None]:
    """Name other units of the recordings where a fit does not settle, or sees no payload.

    Args:
        runs: of the fit.
        model: of the robot, for the kinds of its joints.
        axes: name of each axis.

    Raises:
        NotConverged, PayloadUnseen: with the likely cause.
    """
    try:
        yield
    except NotConverged as error:
        cause = unlikely_units(runs, model, axes)
        if not cause:
            raise
        raise NotConverged(error.method, error.iterations, error.cost, error.step, cause) from error
    except PayloadUnseen as error:
        cause = unlikely_units(runs, model, axes)
        if not cause:
            raise
        raise PayloadUnseen(error.std_percent, error.runs, cause) from error


def require_travel(run: RunChannels, model: Model, axes: Sequence[str]) -> None:
    """Refuse positions far beyond what a joint allows, that fit in it as degrees or millimetres.

    A joint without limits in its description is not judged.

    Raises:
        UnitsMistaken: for these axes.
    """
    for axis, joint in enumerate(model.robot.axes):
        moved = float(run.range[axis])
        if joint.travel is None or moved <= TRAVEL_EXCESS * joint.travel:
            continue
        if joint.kind is JointKind.REVOLUTE:
            unit = "rad"
            converted = float(np.radians(moved))
            remedy = (
                "are these degrees (give `numpy.radians` of this column), or the motor's angle "
                "before the gear (divide it by the ratio)?"
            )
        else:
            unit = "m"
            converted = 1e-3 * moved
            remedy = "are these millimetres (divide this column by 1000)?"
        if converted > TRAVEL_TOLERANCE * joint.travel:
            continue
        place = f"run {run.run!r}, axis {axes[axis]}"
        found = f"positions that move by {moved:.4g} {unit}"
        expected = f"at most {joint.travel:.4g} {unit}, the travel of this joint in the URDF"
        raise UnitsMistaken(
            place,
            found=found,
            expected=expected,
            remedy=f"{remedy} if neither, correct the limits in the URDF",
        )


def unlikely_units(runs: Sequence[RunChannels], model: Model, axes: Sequence[str]) -> str:
    """Say that angles or currents are larger than those of robots; empty where none is."""
    kinds = [joint.kind for joint in model.robot.axes]
    is_revolute = np.array([kind is JointKind.REVOLUTE for kind in kinds])
    for run in runs:
        turned_rad = np.where(is_revolute, run.range, 0.0)
        widest = int(np.argmax(turned_rad))
        widest_rad = turned_rad[widest]
        if widest_rad > WIDEST_RANGE_RAD:
            return (
                f"found {axes[widest]} turning by {widest_rad:.4g} rad in run {run.run!r}; "
                "expected a joint's angle in rad: are these degrees, counts, or the motor's angle "
                "before the gear?"
            )
        largest = int(np.argmax(run.limits))
        largest_a = run.limits[largest]
        if largest_a > LARGEST_CURRENT_A:
            return (
                f"found a current of {largest_a:.4g} A of {axes[largest]} in run {run.run!r}; "
                "expected amperes: are these milliamperes, or thousandths of the rated current?"
            )
    return ""


# The payload and the roles of the runs


def require_seen_payload(estimate: Estimate, system: System) -> None:
    """Refuse gains if the data do not fix their common scale.

    The weight of the payload fixes it. If a run is declared loaded but was not, or the other way
    round, its moves disagree with the others about the scale, and σ of all gains grows together.
    Gains beside which that weight is nothing have no scale, however small their σ.

    Raises:
        PayloadUnseen: every gain is uncertain by more than LARGEST_GAIN_STD, or the weight is below
            LEAST_WEIGHT.
        MassesContradict: the first, because the masses of several payloads contradict each other.
    """
    relative_std = estimate.gains_std / np.abs(estimate.gains)
    is_scale_known = float(np.min(relative_std)) <= LARGEST_GAIN_STD
    if is_scale_known and _has_weight(system, estimate.gains):
        return
    require_agreeing_masses(system, estimate)
    std_percent = tuple(float(100.0 * value) for value in relative_std)
    raise PayloadUnseen(std_percent, system.runs)


def _has_weight(system: System, gains: FloatArray) -> bool:
    """Whether the known payload has LEAST_WEIGHT of the torque of a joint."""
    for factor in system.joints.factors:
        # ‖W_kL χ_kL‖ beside ‖V g‖ of the joint
        payload = np.linalg.norm(factor[:, -1])
        torque = np.linalg.norm(factor[:, : len(gains)] @ gains)
        if not payload < LEAST_WEIGHT * torque:
            return True
    return False


def require_agreeing_masses(system: System, estimate: Estimate) -> None:
    """Refuse masses of several payloads that contradict each other.

    Raises:
        MassesContradict: they do, and that explains more than another payload in a single run.
    """
    gains = estimate.gains
    parameters = estimate.parameters
    differences = payload_differences(system, gains, parameters, 0)
    masses = likeliest_masses(system, gains, parameters, differences)
    if masses is None:
        return
    diagnosis = masses.diagnosis
    raise MassesContradict(
        "the payloads",
        found=diagnosis.found,
        expected=diagnosis.expected,
        remedy=diagnosis.remedy,
    )


def require_roles(gains: FloatArray, nameplate: FloatArray) -> None:
    """Refuse gains, shape (m,), that all have the sign opposite to the nameplate, (m,): the payload
    was taken from the wrong runs.

    Raises:
        RolesExchanged: every sign is opposite to that of the nameplate.
    """
    is_reversed = np.sign(gains) == -np.sign(nameplate)
    if not np.all(is_reversed):
        return
    expected = f"the signs of the nameplate: {numbers_text(nameplate)}"
    remedy = (
        "were the payload's run and the run without load exchanged (look at "
        "`Run.payload` of each run), or do all currents count the other way?"
    )
    raise RolesExchanged(
        "all drive gains", found=numbers_text(gains), expected=expected, remedy=remedy
    )


def require_plausible(
    estimate: Estimate, error: RelativeError, axes: Sequence[str], idle: BoolArray | None = None
) -> None:
    """Refuse a fit whose model contradicts its data.

    No number of it can be believed, however small its σ.

    The payload's weight sets the sign of all gains. Taken from the wrong runs it reverses them, and
    all torques with them: the residual stays the same, but the dry friction of every joint then
    drives the robot.

    Args:
        estimate: with σ of its gains.
        error: of the fit.
        axes: name of each axis.
        idle: of `idle_joints`: a relative error of nothing is nothing, where the gain is known;
            none when None.

    Raises:
        ModelContradicted: the relative error is above one of the LARGEST_..._PERCENT, or a gain has
            collapsed.
        RolesExchanged: dry friction is negative on every joint, on most of them by more than five
            σ.
    """
    _require_small_error(estimate, error, axes, idle)
    _require_braking_friction(estimate)


def _require_small_error(
    estimate: Estimate, error: RelativeError, axes: Sequence[str], idle: BoolArray | None
) -> None:
    """Refuse relative errors above their limits, and a gain that has collapsed."""
    std = estimate.gains_std
    size = np.abs(estimate.gains)
    is_unknown = std > size
    largest_percent = np.where(is_unknown, LARGEST_UNKNOWN_PERCENT, LARGEST_AXIS_PERCENT)
    excess = np.array(error.axes) / largest_percent
    if idle is not None:
        excess[idle & ~is_unknown] = 0.0
    excess[size < COLLAPSED_GAIN * size.max()] = np.inf
    worst = 0
    if not np.isnan(excess).all():
        worst = int(np.nanargmax(excess))
    # NaN is no small error
    if error.total <= LARGEST_TOTAL_PERCENT and excess[worst] <= 1.0:
        return
    gain = estimate.gains[worst]
    found = (
        f"a relative error of {error.total:.3g} % in total, {error.axes[worst]:.3g} % on "
        f"axis {axes[worst]}, with a gain of {gain:.3g} ± {std[worst]:.2g}"
    )
    expected = (
        f"some 3 to 15 %, below {LARGEST_TOTAL_PERCENT:g} % and on every axis "
        f"{LARGEST_AXIS_PERCENT:g} %, {LARGEST_UNKNOWN_PERCENT:g} % where a gain is smaller "
        "than its σ"
    )
    remedy = (
        "look for what contradicts the model: two channels exchanged"
        " (`exchanged_channels` tests it)"
        " or one reversed, a wrong drive train, gravity or URDF, positions not in rad, a "
        "payload or drawing that is not of the body that was mounted"
    )
    raise ModelContradicted("the fit", found=found, expected=expected, remedy=remedy)


def _require_braking_friction(estimate: Estimate) -> None:
    """Refuse dry friction that drives every joint, on most of them by more than five σ."""
    names: list[str] = []
    frictions: list[float] = []
    upper_bounds: list[float] = []
    parameters = zip(estimate.unknowns, estimate.parameters, estimate.parameters_std, strict=True)
    for unknown, value, std in parameters:
        if unknown.name.startswith("fs") and unknown.name[2:].isdigit():
            names.append(f"{unknown.name} = {value:.3g} ± {std:.2g}")
            frictions.append(value)
            upper_bounds.append(value + 5.0 * std)
    if not frictions or not max(frictions) < 0.0:
        return
    if not np.median(upper_bounds) < 0.0:
        return
    remedy = (
        "were the payload's run and the run without load exchanged? do fixed gains have "
        "the right sign?"
    )
    raise RolesExchanged(
        "the dry friction of all joints",
        found=", ".join(names),
        expected="above 0, because friction takes energy",
        remedy=remedy,
    )


# Units and signs


def require_units(gains: FloatArray, nameplate: FloatArray) -> None:
    """Refuse gains, shape (m,), that are all off the nameplate, (m,), by a factor that only a unit
    has.

    Raises:
        UnitsMistaken: each is more than UNIT_RATIO times, or less than 1/UNIT_RATIO of, its
            nameplate.
    """
    ratio = np.abs(gains / nameplate)
    if np.all(ratio < 1.0 / UNIT_RATIO):
        cause = "are the currents in mA and read as A, or is the payload's mass in t?"
    elif np.all(ratio > UNIT_RATIO):
        cause = "is the payload's mass in g and read as kg, or are the currents in kA?"
    else:
        return
    found = f"{numbers_text(ratio)} times the nameplate"
    usual = range_text(GAIN_RANGE)
    expected = f"{usual}, and within a factor of {UNIT_RATIO:g} on one axis at least"
    raise UnitsMistaken("all drive gains", found=found, expected=expected, remedy=cause)


def require_weight(system: System, estimate: Estimate) -> None:
    """Refuse fixed gains by which a payload's weight is off by a factor that only a unit has.

    Raises:
        UnitsMistaken: more than UNIT_RATIO times, or less than 1/UNIT_RATIO of what was declared.
    """
    ratio = weight_off(system, estimate, UNIT_RATIO)
    if ratio is None:
        return
    remedy = (
        "are the currents in mA and read as A, is its mass in g and read as kg, or was "
        "it not mounted?"
    )
    raise UnitsMistaken(
        "the weight of the payload",
        found=f"{ratio:.3g} times the declared one, by these gains",
        expected=f"1, and within a factor of {UNIT_RATIO:g} at least",
        remedy=remedy,
    )


def weight_off(system: System, estimate: Estimate, largest: float) -> float | None:
    """Weight of the payload by given gains, relative to the declared one.

    None where it is within the largest ratio, or not known.
    """
    if not system.knows_payload:
        return None
    ratio, std = _weight_ratio(system, estimate)
    if ratio - std > largest or ratio + std < 1.0 / largest:
        return ratio
    return None


def _weight_ratio(system: System, estimate: Estimate) -> tuple[float, float]:
    """Size of W_kL χ_kL that the currents ask for with given gains, and WEIGHT_SIGMAS of its σ."""
    gains = estimate.gains
    row_count = int(system.motors.rows.sum())
    if system.model.is_redundant:  # no motor has an equation of its own
        unit_noise = np.ones(len(gains))
        whitened = system.currents.whitened(gains, unit_noise)
        torque = np.column_stack((whitened.linear, whitened.known))
        right = whitened.drive @ gains
        return _last_unknown(torque, right, row_count)
    # I = (1/g) (W χ + W_kL χ_kL) of each motor. Weighted by the size of each current: the residuals
    # of a fit with a wrong weight say nothing about noise.
    columns: list[FloatArray] = []
    currents: list[FloatArray] = []
    for factor, gain in zip(system.motors.factors, gains, strict=True):
        current_size = float(np.linalg.norm(factor[:, 0]))
        weighted = factor / max(current_size, 1e-300)
        inverse_gain = 1.0 / gain
        columns.append(weighted[:, 1:] * inverse_gain)
        currents.append(weighted[:, 0])
    return _last_unknown(np.concatenate(columns), np.concatenate(currents), row_count)


def _last_unknown(columns: FloatArray, right: FloatArray, rows: int) -> tuple[float, float]:
    """Size of the last unknown by least squares, and WEIGHT_SIGMAS of its σ."""
    solution, inverse = solve(columns, right)
    residual = right - columns @ solution
    noise_variance = float(np.sum(residual**2)) / rows
    std = float(np.sqrt(noise_variance * inverse[-1, -1]))
    return abs(float(solution[-1])), WEIGHT_SIGMAS * std


def require_signs(system: System, estimate: Estimate, axes: Sequence[str]) -> None:
    """Refuse fixed gains of which some explain the data with the other sign.

    Raises:
        CurrentReversed: with the other sign the errors fall by EXCHANGE, or they stay and the
            friction, which drove the axis, brakes it.
    """
    least_errors = _least_current_errors(system)
    best = _try_signs(system, estimate.gains, np.ones(len(axes)), least_errors)
    for _ in axes:
        better: list[_SignTrial] = []
        for axis in range(len(axes)):
            signs = best.signs.copy()
            signs[axis] = -signs[axis]
            trial = _try_signs(system, estimate.gains, signs, least_errors)
            is_driven = best.friction[axis] < -FRICTION_SIGMAS
            is_braked_after = trial.friction[axis] > FRICTION_SIGMAS
            largest_rise = -EXCHANGE
            if is_driven and is_braked_after:
                largest_rise = LEVEL
            if trial.log_error - best.log_error < largest_rise:
                better.append(trial)
        if not better:
            break
        best = min(better, key=lambda trial: trial.log_error)
    signs = best.signs
    # Without a payload the data fix the signs up to a common one, which friction shows
    if np.median(best.friction) < 0.0:
        signs = -signs
    turned = [axis for axis, sign in zip(axes, signs, strict=True) if sign < 0.0]
    if 0 < len(turned) < len(axes):
        raise CurrentReversed(
            f"axis {', '.join(turned)}",
            found="a current that explains the motion with the other sign of its gain",
            expected="the sign of the fixed gain",
            remedy="does the drive, or the import, count this current the other way? "
            "correct its sign",
        )


@dataclass(frozen=True, slots=True, eq=False)
class _SignTrial:
    """A fit with some of the fixed gains reversed."""

    signs: FloatArray  #: of the gains, 1 or -1, shape (m,)
    log_error: float  #: Σ log of the motors' errors
    friction: FloatArray  #: of each axis, in σ; negative where it drives, shape (m,)


def _try_signs(
    system: System, gains: FloatArray, signs: FloatArray, least_errors: FloatArray
) -> _SignTrial:
    """Fit with gains of other signs; errors of motors count as `least_errors` at least."""
    joints = system.model.robot.axis_joints
    estimate = wls(system, gains * signs)
    friction = np.zeros(len(gains))
    parameters = zip(estimate.unknowns, estimate.parameters, estimate.parameters_std, strict=True)
    for unknown, value, std in parameters:
        match = FRICTION.match(unknown.name)
        if match is None:
            continue
        axis = int(match[2]) - 1
        is_of_motor = bool(match[1])
        if not is_of_motor:
            axis = joints.index(axis)
        friction[axis] += value / std
    noise = system.currents.noise(estimate.gains, estimate.parameters)
    errors = np.maximum(noise, least_errors)
    log_error = float(np.sum(np.log(errors)))
    return _SignTrial(signs, log_error, friction)


def _least_current_errors(system: System) -> FloatArray:
    """SMALL_ERROR of each motor's current, root mean square [A], shape (m,)."""
    sizes: list[float] = []
    for motor, factor in enumerate(system.motors.factors):
        own = 0
        if system.model.is_redundant:  # its rows have the currents of all motors
            own = motor
        sizes.append(float(np.linalg.norm(factor[:, own])))
    row_counts = np.maximum(system.motors.rows, 1)
    least = SMALL_ERROR * np.array(sizes) / np.sqrt(row_counts)
    least[least == 0.0] = 1.0  # a motor without current
    return least


# Torques


def joint_torques(system: System, estimate: Estimate) -> tuple[FloatArray, FloatArray]:
    """Torque of each joint and what the model leaves of it, rms [Nm or N], shape (m,) each."""
    joints = system.joints
    no_parameters = np.zeros(len(estimate.parameters) + 1)
    gains_alone = np.concatenate((estimate.gains, no_parameters))
    solution = np.concatenate((estimate.gains, estimate.parameters, [1.0]))
    row_counts = np.maximum(joints.rows, 1)
    size = np.sqrt(joints.square_sum(gains_alone) / row_counts)
    left = np.sqrt(joints.square_sum(solution) / row_counts)
    return size, left


def idle_joints(model: Model, size: FloatArray, left: FloatArray) -> BoolArray:
    """Joints with next to no torque and error beside another joint of the kind, shape (m,).

    Args:
        model: of the fit.
        size, left: of `joint_torques`.
    """
    kinds = np.array([joint.kind.value for joint in model.robot.axes])
    largest = np.array([size[kinds == kind].max() for kind in kinds])
    has_no_torque = size < IDLE_TORQUE * largest
    has_no_error = left < IDLE_ERROR * largest
    return has_no_torque & has_no_error


def numbers_text(values: FloatArray) -> str:
    """Write numbers, shape (k,), for a message, with three digits."""
    return ", ".join(f"{value:.3g}" for value in values)
