"""Refusals of a fit: mistakes of recordings and declarations that leave no number that can be used.

`refuse_mistakes` is the list of all, in their order. The limits were set by `make diagnosis-study`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

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
"""Least fall of the logarithm of the motors' errors, in sum,
of a fixed gain with the other sign.
"""
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
    idle = idle_joints(system.model, *joint_torques(system, estimate))
    require_plausible(estimate, estimate.relative_error(system), axes, idle)
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
            still = still_joint(runs, axes, "a fit that contradicts itself")
        else:
            still = None
        if still is None:
            raise
        raise still from error


@contextmanager
def with_unit_causes(
    runs: Sequence[RunChannels], model: Model, axes: Sequence[str]
) -> Iterator[None]:
    """Say where a fit does not settle, or sees no payload,
    that the recordings seem to be in other units.

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
    """Refuse positions of an axis that go far beyond what its joint allows,
    and fit in it as degrees or millimetres.

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
        if converted <= TRAVEL_TOLERANCE * joint.travel:
            raise UnitsMistaken(
                f"run {run.run!r}, axis {axes[axis]}",
                found=f"positions that move by {moved:.4g} {unit}",
                expected=f"at most {joint.travel:.4g} {unit}, the travel of this joint in the URDF",
                remedy=f"{remedy} if neither, correct the limits in the URDF",
            )


def unlikely_units(runs: Sequence[RunChannels], model: Model, axes: Sequence[str]) -> str:
    """Say that angles or currents are larger than those of robots; empty where none is."""
    is_revolute = np.array([joint.kind is JointKind.REVOLUTE for joint in model.robot.axes])
    for run in runs:
        turned_rad = np.where(is_revolute, run.range, 0.0)
        widest = int(np.argmax(turned_rad))
        if turned_rad[widest] > WIDEST_RANGE_RAD:
            return (
                f"found {axes[widest]} turning by {turned_rad[widest]:.4g} rad in run {run.run!r}; "
                "expected a joint's angle in rad: are these degrees, counts, or the motor's angle "
                "before the gear?"
            )
        largest = int(np.argmax(run.limits))
        if run.limits[largest] > LARGEST_CURRENT_A:
            return (
                f"found a current of {run.limits[largest]:.4g} A of {axes[largest]} in run "
                f"{run.run!r}; expected amperes: are these milliamperes, or thousandths of the "
                "rated current?"
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
    relative = estimate.gains_std / np.abs(estimate.gains)
    rows = system.joints.factors
    torque = [
        LEAST_WEIGHT * np.linalg.norm(factor[:, : len(relative)] @ estimate.gains)
        for factor in rows
    ]
    weightless = all(
        np.linalg.norm(factor[:, -1]) < least for factor, least in zip(rows, torque, strict=True)
    )
    if weightless or not float(np.min(relative)) <= LARGEST_GAIN_STD:
        require_agreeing_masses(system, estimate)
        raise PayloadUnseen(tuple(float(100.0 * value) for value in relative), system.runs)


def require_agreeing_masses(system: System, estimate: Estimate) -> None:
    """Refuse masses of several payloads that contradict each other.

    Raises:
        MassesContradict: they do, and that explains more than another payload in a single run.
    """
    found = payload_differences(system, estimate.gains, estimate.parameters, 0)
    masses = likeliest_masses(system, estimate.gains, estimate.parameters, found)
    if masses is not None:
        one = masses.diagnosis
        raise MassesContradict(
            "the payloads", found=one.found, expected=one.expected, remedy=one.remedy
        )


def require_roles(gains: FloatArray, nameplate: FloatArray) -> None:
    """Refuse gains that all have the wrong sign: the payload was taken from the wrong runs.

    Raises:
        RolesExchanged: every sign is opposite to that of the nameplate.
    """
    if np.all(np.sign(gains) == -np.sign(nameplate)):
        raise RolesExchanged(
            "all drive gains",
            found=numbers_text(gains),
            expected=f"the signs of the nameplate: {numbers_text(nameplate)}",
            remedy="were the payload's run and the run without load exchanged (look at "
            "`Run.payload` of each run), or do all currents count the other way?",
        )


def require_plausible(
    estimate: Estimate, error: RelativeError, axes: Sequence[str], idle: BoolArray | None = None
) -> None:
    """Refuse a fit whose model contradicts its data:
    no number of it can be believed, however small its σ.

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
    unknown = estimate.gains_std > np.abs(estimate.gains)
    excess = np.array(error.axes) / np.where(unknown, LARGEST_UNKNOWN_PERCENT, LARGEST_AXIS_PERCENT)
    if idle is not None:
        excess[idle & ~unknown] = 0.0
    size = np.abs(estimate.gains)
    excess[size < COLLAPSED_GAIN * size.max()] = np.inf
    worst = 0 if np.isnan(excess).all() else int(np.nanargmax(excess))
    if not (error.total <= LARGEST_TOTAL_PERCENT and excess[worst] <= 1.0):
        raise ModelContradicted(
            "the fit",
            found=f"a relative error of {error.total:.3g} % in total, {error.axes[worst]:.3g} % on "
            f"axis {axes[worst]}, with a gain of {estimate.gains[worst]:.3g} ± "
            f"{estimate.gains_std[worst]:.2g}",
            expected=f"some 3 to 15 %, below {LARGEST_TOTAL_PERCENT:g} % and on every axis "
            f"{LARGEST_AXIS_PERCENT:g} %, {LARGEST_UNKNOWN_PERCENT:g} % where a gain is smaller "
            "than its σ",
            remedy="look for what contradicts the model: two channels exchanged"
            " (`exchanged_channels` tests it)"
            " or one reversed, a wrong drive train, gravity or URDF, positions not in rad, a "
            "payload or drawing that is not of the body that was mounted",
        )
    parameters = zip(estimate.unknowns, estimate.parameters, estimate.parameters_std, strict=True)
    dry = [
        (one.name, v, std)
        for one, v, std in parameters
        if one.name.startswith("fs") and one.name[2:].isdigit()
    ]
    if (
        dry
        and all(v < 0.0 for _, v, _ in dry)
        and np.median([v + 5.0 * std for _, v, std in dry]) < 0.0
    ):
        raise RolesExchanged(
            "the dry friction of all joints",
            found=", ".join(f"{name} = {v:.3g} ± {std:.2g}" for name, v, std in dry),
            expected="above 0, because friction takes energy",
            remedy="were the payload's run and the run without load exchanged? do fixed gains have "
            "the right sign?",
        )


# Units and signs


def require_units(gains: FloatArray, nameplate: FloatArray) -> None:
    """Refuse gains that are all off the nameplate by a factor that only a unit has.

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
    raise UnitsMistaken(
        "all drive gains",
        found=f"{numbers_text(ratio)} times the nameplate",
        expected=f"{range_text(GAIN_RANGE)}, and within a factor of {UNIT_RATIO:g} on one "
        "axis at least",
        remedy=cause,
    )


def require_weight(system: System, estimate: Estimate) -> None:
    """Refuse fixed gains with which a weighed payload has another weight,
    by a factor that only a unit has.

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
            expected=f"1, and within a factor of {UNIT_RATIO:g} at least",
            remedy="are the currents in mA and read as A, is its mass in g and read as kg, or was "
            "it not mounted?",
        )


def weight_ratio(system: System, estimate: Estimate) -> tuple[float, float]:
    """Size of W_kL χ_kL that the currents ask for with given gains, and WEIGHT_SIGMAS of its σ."""
    if system.model.is_redundant:  # no motor has an equation of its own
        whitened = system.currents.whitened(estimate.gains, np.ones(len(estimate.gains)))
        torque = np.column_stack((whitened.linear, whitened.known))
        right = whitened.drive @ estimate.gains
        return _last(torque, right, int(system.motors.rows.sum()))
    # Weighted by the size of each current: the residuals of a fit with a wrong weight say nothing
    # about noise.
    factors = [
        factor / max(float(np.linalg.norm(factor[:, 0])), 1e-300)
        for factor in system.motors.factors
    ]
    rows = np.concatenate(factors)
    scale = np.concatenate(
        [np.full(len(f), 1.0 / g) for f, g in zip(factors, estimate.gains, strict=True)]
    )
    return _last(rows[:, 1:] * scale[:, None], rows[:, 0], int(system.motors.rows.sum()))


def _last(columns: FloatArray, right: FloatArray, rows: int) -> tuple[float, float]:
    """Size of the last unknown by least squares, and WEIGHT_SIGMAS of its σ."""
    solution, inverse = solve(columns, right)
    left = float(np.sum((right - columns @ solution) ** 2)) / rows
    return abs(float(solution[-1])), WEIGHT_SIGMAS * float(np.sqrt(left * inverse[-1, -1]))


def require_signs(system: System, estimate: Estimate, axes: Sequence[str]) -> None:
    """Refuse fixed gains of which some explain the data with the other sign.

    Raises:
        CurrentReversed: with the other sign the errors fall by EXCHANGE, or they stay and the
            friction, which drove the axis, brakes it.
    """

    def tried(signs: FloatArray) -> tuple[float, FloatArray]:
        """Σ log of the motors' errors, and the friction of each axis in σ."""
        one = wls(system, estimate.gains * signs)
        friction = np.zeros(len(axes))
        for column, value, std in zip(
            one.unknowns, one.parameters, one.parameters_std, strict=True
        ):
            if (of_friction := FRICTION.match(column.name)) is not None:
                number = int(of_friction[2]) - 1
                friction[number if of_friction[1] else joints.index(number)] += value / std
        errors = np.maximum(system.currents.noise(one.gains, one.parameters), smallest)
        return float(np.sum(np.log(errors))), friction

    joints = system.model.robot.axis_joints
    redundant = system.model.is_redundant
    # Where a motor's rows have its current
    own = range(len(axes)) if redundant else [0] * len(axes)
    size = np.array(
        [np.linalg.norm(f[:, column]) for f, column in zip(system.motors.factors, own, strict=True)]
    )
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
    # Without a payload the data fix the signs up to a common one, which friction shows
    if np.median(friction) < 0.0:
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


# Torques


def joint_torques(system: System, estimate: Estimate) -> tuple[FloatArray, FloatArray]:
    """Torque of each joint, and what the model leaves of it:
    root mean squares [Nm or N], both of shape (m,).
    """
    gains = np.concatenate((estimate.gains, np.zeros(len(estimate.parameters) + 1)))
    whole = np.concatenate((estimate.gains, estimate.parameters, [1.0]))
    rows = np.maximum(system.joints.rows, 1)
    size, left = (np.sqrt(system.joints.square_sum(vector) / rows) for vector in (gains, whole))
    return size, left


def idle_joints(model: Model, size: FloatArray, left: FloatArray) -> BoolArray:
    """Joints whose torque and error are nothing beside the torque of another joint of the kind,
    shape (m,).

    Args:
        model: of the fit.
        size, left: of `joint_torques`.
    """
    kinds = np.array([joint.kind.value for joint in model.robot.axes])
    largest = np.array([size[kinds == kind].max() for kind in kinds])
    return (size < IDLE_TORQUE * largest) & (left < IDLE_ERROR * largest)


def numbers_text(values: FloatArray) -> str:
    """Write numbers for a message, with three digits."""
    return ", ".join(f"{value:.3g}" for value in values)
