"""Predict torques and currents of a motion with a calibration,
without the rows that it was fitted to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ident.arrays import FloatArray, as_array, takes
from ident.calibration import EXTRAPOLATED, AcceptedEffect, Calibration, Parameter
from ident.data.dataset import Dataset
from ident.effects.effect import (
    ALL_AXES,
    PlacedEffect,
    at_joints,
    check_settings,
    columns_at,
    setting_kind,
)
from ident.effects.geometry_corrections import (
    GeometryEffect,
    corrected_dataset,
    corrected_model,
    is_correction,
)
from ident.effects.own import (
    installed_version,
    is_of_package,
    known_effect,
    known_names,
    package_of,
)
from ident.effects.rotor import beside_rotors
from ident.effects.signals import declared_signals, payload_parameters
from ident.errors import DataUnfit, EffectNotInstalled, EffectRefused, ModelError
from ident.model.bodies import LINK_PARAMETERS, Payload
from ident.model.model import Model, without_preload
from ident.model.robot import Motion
from ident.model.same_robot import foreign_base_parameter

SAME_MASS = 0.01  #: Share by which two weighings of one body may differ


@takes(calibration=Calibration, model=Model, data=Dataset)
def predict_torque(calibration: Calibration, model: Model, data: Dataset) -> FloatArray:
    """Predict the joint torque of a motion: W χ + W_uL χ_uL + W_kL χ_kL (paper eq.
    17) and the effects.

    Where a motion goes far beyond those of the fit, the torque of an effect is limited
    (`AcceptedEffect.largest_torque`).

    Args:
        calibration: parameters, effects and gains.
        model: the declared model of the same robot.
        data: the motion, and what is mounted.

    Returns:
        joint torque [Nm; N for a prismatic joint] at full rate, shape (n_samples, n_axes).

    Raises:
        ModelError: the calibration is of another robot.
        DataUnfit: it does not know how the run's payload is mounted, knows another payload on this
            mounting, or knows the payload with another mass.
        EffectRefused: it holds an effect that does not exist.
    """
    gains = _gains(calibration, model)
    corrections = corrections_of(calibration)
    model = fitted_model(calibration, model)
    data = corrected_dataset(data, corrections)
    standard = model.with_payload(
        standard_parameters(calibration, model), payload_of(calibration, data)
    )
    run = declared_signals(model, data, standard, gains, calibration.session_began_s)
    torque = model.drive_train.direction.T @ run.motor_torque_nm
    effects = [placed_effect(accepted, calibration) for accepted in calibration.effects]
    run = beside_rotors(run, (placed for placed, _ in effects))
    for accepted, (placed, coefficients) in zip(calibration.effects, effects, strict=True):
        if is_correction(placed):
            continue  # in the model already
        columns = columns_at(placed.effect, run, placed.axis)
        at_all = at_joints(placed.effect, placed.axis, columns, model.drive_train)
        torque += _bounded(np.einsum("p,npk->nk", coefficients, at_all), accepted)
    if calibration.effects and model.is_redundant:
        torque = without_preload(model.follow(data.motion()), torque)
    return np.asarray(torque.T)


def fitted_model(calibration: Calibration, model: Model) -> Model:
    """The declared model with the corrections of a calibration,
    with friction by payload where it has identified that.

    Raises:
        EffectRefused: it holds an effect that does not exist.
    """
    model = corrected_model(model, corrections_of(calibration))
    # A new model would follow the motions of closed chains again.
    is_lacking = calibration.friction_by_payload and not model.friction_by_payload
    if is_lacking:
        return replace(model, friction_by_payload=True)
    return model


def corrections_of(calibration: Calibration) -> tuple[PlacedEffect, ...]:
    """The corrections of the robot's description that a calibration holds, applied as a whole.

    Raises:
        EffectRefused: it holds an effect that does not exist.
    """
    found: list[PlacedEffect] = []
    for accepted in calibration.effects:
        placed, coefficients = placed_effect(accepted, calibration)
        if isinstance(placed.effect, GeometryEffect):
            found.append(replace(placed, effect=placed.effect.with_applied(coefficients.tolist())))
    return tuple(found)


def left_of(placed: PlacedEffect, coefficients: FloatArray) -> tuple[PlacedEffect, FloatArray]:
    """An effect and its coefficients in a corrected model:
    of a correction nothing is left, but its σ.
    """
    if not isinstance(placed.effect, GeometryEffect):
        return placed, coefficients
    applied = replace(placed, effect=placed.effect.with_applied(coefficients.tolist()))
    return applied, np.zeros_like(coefficients)


def _bounded(torque: FloatArray, accepted: AcceptedEffect) -> FloatArray:
    """Limit the torque of an effect, shape (n, k), to EXTRAPOLATED times the largest that the fit
    has seen of it.
    """
    if accepted.largest_torque is None:
        return torque
    limit = EXTRAPOLATED * np.array(accepted.largest_torque)[:, None]
    return np.clip(torque, -limit, limit)


@takes(calibration=Calibration, model=Model, data=Dataset)
def predict_current(calibration: Calibration, model: Model, data: Dataset) -> FloatArray:
    """Predict the current references of a motion, v = (T τ)/g.

    Arguments and errors are those of `predict_torque`.

    Returns:
        current references [A] at full rate, shape (n_samples, n_axes).
    """
    torque = predict_torque(calibration, model, data)
    return np.asarray(torque @ model.drive_train.to_motor.T / _gains(calibration, model))


@takes(calibration=Calibration, model=Model, motion=Motion | None)
def measured_torque(
    calibration: Calibration, model: Model, current_a: ArrayLike, motion: Motion | None = None
) -> FloatArray:
    """Convert current references [A] to joint torque [Nm], Y = V g (eq.
    4 through R), shape (n_samples, n_axes) each.

    Args:
        calibration: with the gains.
        model: the declared model of the same robot.
        current_a: of the motors; lists and data frames will do.
        motion: of the axes. With it, torques of a redundant drive are without internal preload,
            like those that `predict_torque` returns; other robots have none.

    Raises:
        ModelError: the calibration has another number of gains, or the loops cannot be closed.
    """
    gains = _gains(calibration, model)
    current = as_array("current_a", current_a)
    if current.ndim != 2 or current.shape[1] != len(gains):
        expected = f"(n_samples, {len(gains)}), one column per motor"
        raise ModelError(f"current_a has shape {current.shape}; expected {expected}; transpose it?")
    torque = np.asarray((gains * current) @ model.drive_train.direction)
    if motion is None or not model.is_redundant:
        return torque
    return without_preload(model.follow(motion), torque.T).T


def measured_current(
    calibration: Calibration, model: Model, current_a: FloatArray, motion: Motion
) -> FloatArray:
    """Return the part of current references that `predict_current` predicts:
    all, but for internal preload.

    Arguments and errors are those of `measured_torque`.
    """
    if not model.is_redundant:
        return np.asarray(current_a)
    torque = measured_torque(calibration, model, current_a, motion)
    return np.asarray(torque @ model.drive_train.to_motor.T / _gains(calibration, model))


def standard_parameters(calibration: Calibration, model: Model) -> FloatArray:
    """Standard parameters χ_st that move as the identified base parameters do, without payload,
    shape (c,).

    A base parameter β gathers the columns that depend on its leading one (paper §2.1), W_st χ_st =
    W β for every χ_st with this β; the simplest one holds β at the leading columns, which name the
    base parameters, and zero elsewhere. What a payload adds to friction is left out where the model
    has no friction by payload.

    Raises:
        ModelError: a parameter is none of this robot's, or groups with others as it does in no
            robot like this one.
    """
    _gains(calibration, model)  # as many axes
    index = {column.name: number for number, column in enumerate(model.columns)}
    of_effects = set()
    for effect in calibration.effects:
        for coefficient in effect.coefficients:
            of_effects.add(coefficient.name)
    standard = np.zeros(len(index))
    names: list[str] = []
    for parameter in calibration.parameters:
        if parameter.name in of_effects or ":" in parameter.name:
            continue
        if parameter.is_payload_friction and not model.friction_by_payload:
            continue
        if parameter.name.split():
            leading = parameter.name.split()[0]
        else:
            leading = ""
        if leading not in index:
            raise ModelError(
                f"the calibration of cell {calibration.cell!r} has a parameter {parameter.name!r}; "
                f"the model of {model.robot.joint_count} joints has {', '.join(index)}"
            )
        standard[index[leading]] = parameter.value
        names.append(parameter.name)
    _require_same_robot(calibration, model, names)
    return standard


def _require_same_robot(calibration: Calibration, model: Model, names: Sequence[str]) -> None:
    """Refuse base parameters of another geometry (`foreign_base_parameter`).

    Raises:
        ModelError: the two robots are not the same.
    """
    foreign = foreign_base_parameter(model, names)
    if foreign is not None:
        raise ModelError(
            f"the calibration of cell {calibration.cell!r} has the base parameter {foreign!r}, "
            "which another geometry gathers; expected a calibration of the model's robot; give the "
            "model (URDF, gravity, drive train) that it was fitted with"
        )


def mounted_parameters(calibration: Calibration, mounting: str) -> dict[str, Parameter]:
    """Parameters that a calibration holds of the payload on a mounting,
    by their names without the mounting.
    """
    split = ((*parameter.name.partition(":"), parameter) for parameter in calibration.parameters)
    return {name: parameter for name, colon, of, parameter in split if colon and of == mounting}


def as_calibrated(calibration: Calibration, payload: Payload | None, run: str) -> Payload | None:
    """Leave out of a payload what the calibration itself says of its mounting, given or identified.

    Args:
        calibration: that is to predict.
        payload: what a run carries; None without load.
        run: its name, for the error.

    Raises:
        DataUnfit: the calibration knows another payload on this mounting, or was given another
            mass.
    """
    if payload is None:
        return None
    _require_same_body(calibration, payload, run)
    own = mounted_parameters(calibration, payload.mounting)
    mass = own.get("m")
    weighed = payload.known.get("m")
    if mass is not None and mass.std == 0.0 and weighed is not None and weighed != mass.value:
        raise DataUnfit(
            run,
            f"carries {weighed:g} kg on mounting {payload.mounting!r}; the calibration has "
            f"{mass.value:g} kg: give each way of mounting a name of its own",
        )
    return replace(
        payload, known={name: value for name, value in payload.known.items() if name not in own}
    )


def other_body(calibration: Calibration, payload: Payload) -> str:
    """Say which payload a calibration knows on the mounting of another one;
    empty where it knows none there, or the same by name.

    What it identified on a mounting, first moments and inertia, is that of one body.

    Args:
        calibration: that is to predict.
        payload: what a run carries.
    """
    if not mounted_parameters(calibration, payload.mounting):
        return ""
    on_mounting: set[str] = set()
    for source in calibration.sources:
        # Earlier versions did not write the mounting: any of their payloads may have been on it.
        if source.payload is not None and source.mounting in {None, payload.mounting}:
            on_mounting.add(source.payload)
    if not on_mounting or payload.name in on_mounting:
        return ""
    return " or ".join(repr(name) for name in sorted(on_mounting))


def _require_same_body(calibration: Calibration, payload: Payload, run: str) -> None:
    """Refuse a payload on the mounting of another one.

    Raises:
        DataUnfit: the calibration knows another payload there.
    """
    known = other_body(calibration, payload)
    if known:
        raise DataUnfit(
            run,
            f"found payload {payload.name!r} on mounting {payload.mounting!r}; expected payload "
            f"{known}, of which the calibration holds inertia and first moments on this mounting; "
            "if it is the same body, give it the same name; if it is another one, fit a run with "
            f"it on a mounting of its own, or weigh it and give all {len(LINK_PARAMETERS)} of its "
            "parameters on a new mounting",
        )


def placed_effect(
    accepted: AcceptedEffect, calibration: Calibration
) -> tuple[PlacedEffect, FloatArray]:
    """The effect that a calibration names, on its axis or joint without a motor,
    and its coefficients, shape (p,).

    Args:
        accepted: of the calibration.
        calibration: whose axes and joints these are.

    Raises:
        EffectNotInstalled: the package that had the effect is not installed.
        EffectRefused: no such effect, setting, axis or coefficient exists.
    """
    places = calibration.places
    known = known_effect(accepted.name, calibration.own_effects)
    if known is None:
        if accepted.package is not None:
            raise EffectNotInstalled(
                accepted.name,
                accepted.axis,
                accepted.package,
                installed=installed_version(accepted.package),
            )
        raise EffectRefused(
            f"there is no effect {accepted.name!r}; there are {', '.join(sorted(known_names()))}"
        )
    is_given = any(effect.name == accepted.name for effect in calibration.own_effects)
    if accepted.package is not None and not is_given and not is_of_package(known, accepted.package):
        other = package_of(known) or "drivegain"
        raise EffectNotInstalled(accepted.name, accepted.axis, accepted.package, other=other)
    everywhere = not known.has_axis and accepted.axis == ALL_AXES
    if not everywhere and accepted.axis not in places:
        raise EffectRefused(
            f"effect {accepted.name!r} acts on axis {accepted.axis!r}; there are "
            f"{', '.join(places)}"
        )
    axis = 0 if everywhere else places.index(accepted.axis)
    if not known.has_axis and axis:
        raise EffectRefused(
            f"effect {accepted.name!r} acts on axis {accepted.axis!r}; it acts on {ALL_AXES}"
        )
    added = {name: 0.0 for name in known.added_settings if name not in accepted.settings}
    own = accepted.settings
    accepted = replace(accepted, settings={**accepted.settings, **added})
    if set(accepted.settings) != set(known.settings):
        found, exist = (", ".join(sorted(settings)) or "none" for settings in (own, known.settings))
        raise EffectRefused(
            f"effect {accepted.name!r} is given the settings {found}; it has {exist}"
        )
    check_settings(known, accepted.settings, axis, len(calibration.gains))
    # A file knows one kind of number; an order must be whole.
    given = {name: setting_kind(known, name)(value) for name, value in accepted.settings.items()}
    if given != accepted.settings:
        raise EffectRefused(
            f"effect {accepted.name!r} is given {accepted.settings}; these must be whole numbers"
        )
    placed = PlacedEffect(known.with_settings(given), axis)
    values = {coefficient.name: coefficient.value for coefficient in accepted.coefficients}
    expected = tuple(column.name for column in placed.columns)
    if set(values) != set(expected) or len(accepted.coefficients) != len(expected):
        found = ", ".join(coefficient.name for coefficient in accepted.coefficients) or "none"
        raise EffectRefused(
            f"effect {accepted.name!r} has the coefficients {found}; it needs {', '.join(expected)}"
        )
    return placed, np.array([values[name] for name in expected])


def _gains(calibration: Calibration, model: Model) -> FloatArray:
    count = model.robot.axis_count
    if len(calibration.gains) != count:
        raise ModelError(
            f"the calibration has {len(calibration.gains)} gains, the model {count} joints"
        )
    return np.array([gain.value for gain in calibration.gains])


def payload_of(calibration: Calibration, data: Dataset) -> FloatArray | None:
    """χ_L of what a run carries: from the run, and what the calibration has identified of its
    mounting, shape (10,).

    None without load.

    Raises:
        DataUnfit: the calibration does not know the mounting, knows another payload on it, or knows
            the payload with another mass.
    """
    payload = data.payload
    if payload is None:
        return None
    _require_same_body(calibration, payload, data.name)
    mountings = {
        name.partition(":")[2]
        for name in (one.name for one in calibration.parameters)
        if ":" in name
    }
    own = mounted_parameters(calibration, payload.mounting)
    identified = {name: parameter.value for name, parameter in own.items()}
    _check_mounting(payload, identified, mountings, data.name)
    masses_kg = {source.mass_kg for source in calibration.sources if source.payload == payload.name}
    mass_kg = payload.known.get("m")
    fitted_kg = next(iter(masses_kg - {None}), None)
    # What was identified with one mass, first moments and inertia, is not that of a body of
    # another mass.
    if (
        identified
        and mass_kg is not None
        and fitted_kg
        and not abs(mass_kg / fitted_kg - 1.0) <= SAME_MASS
    ):
        raise DataUnfit(
            data.name,
            f"payload {payload.name!r} weighs {mass_kg:g} kg; expected {fitted_kg:g} kg as in the "
            f"fit: the calibration holds the rest of its inertia on mounting {payload.mounting!r}; "
            "give another body another mounting",
        )
    return payload_parameters(payload, identified)


def _check_mounting(
    payload: Payload, identified: dict[str, float], mountings: set[str], run: str
) -> None:
    mounting = f"mounting {payload.mounting!r}"
    if not identified and set(payload.known) != set(LINK_PARAMETERS):
        known = ", ".join(sorted(map(repr, mountings))) or "none"
        raise DataUnfit(
            run, f"carries {mounting}, of which the calibration knows nothing; it knows {known}"
        )
    both = sorted(set(identified) & set(payload.known))
    if both:
        same = "the calibration identified the same: give each way of mounting a name of its own"
        raise DataUnfit(run, f"declares {', '.join(both)} of {mounting}, and {same}")
    foreign = sorted(set(identified) - set(LINK_PARAMETERS))
    if foreign:
        raise DataUnfit(run, f"{mounting} has parameters that no payload has: {', '.join(foreign)}")
