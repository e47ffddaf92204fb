"""Predict torques and currents of a motion with a calibration, without the rows of its fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike

from ident.arrays import (
    LARGEST_NUMBER,
    SMALLEST_NUMBER,
    FloatArray,
    as_array,
    as_float,
    require_entries,
    require_kind,
    require_size,
    takes,
)
from ident.calibration import EXTRAPOLATED, AcceptedEffect, Calibration, Gain, Parameter
from ident.data.dataset import Dataset
from ident.effects.effect import (
    ALL_AXES,
    Effect,
    EffectKey,
    PlacedEffect,
    at_joints,
    check_settings,
    columns_at,
    effect_key,
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

#: What to do about a calibration whose parts are none
FROM_CALIBRATION = "take it from `calibration_of` or `load_calibration`"
SAME_MASS = 0.01  #: Share by which two weighings of one body may differ


@takes(calibration=Calibration, model=Model, data=Dataset)
def predict_torque(calibration: Calibration, model: Model, data: Dataset) -> FloatArray:
    """Predict the joint torque of a motion: W χ + W_uL χ_uL + W_kL χ_kL (eq. 17) and the effects.

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
    _require_motion(data)
    gains = _gains(calibration, model)
    corrections = corrections_of(calibration)
    model = fitted_model(calibration, model)
    data = corrected_dataset(data, corrections)
    body = payload_of(calibration, data)
    standard = model.with_payload(standard_parameters(calibration, model), body)
    run = declared_signals(model, data, standard, gains, calibration.session_began_s)
    torque = model.drive_train.direction.T @ run.motor_torque_nm
    effects = placed_effects(calibration)
    run = beside_rotors(run, (placed for placed, _ in effects))
    for accepted, (placed, coefficients) in zip(calibration.effects, effects, strict=True):
        if is_correction(placed):
            continue  # in the model already
        columns = columns_at(placed.effect, run, placed.axis)
        joint_columns = at_joints(placed.effect, placed.axis, columns, model.drive_train)
        # τ_nk = Σ_p c_p φ_npk
        of_effect = np.einsum("p,npk->nk", coefficients, joint_columns)
        torque += _bounded(of_effect, accepted)
    if calibration.effects and model.is_redundant:
        torque = without_preload(model.follow(data.motion()), torque)
    return np.asarray(torque.T)


def _require_motion(data: Dataset) -> None:
    """Refuse data whose motion or payload is of another type, as a `ModelError`."""
    remedy = "make it with `planned` or `differentiate`"
    for name in ("position_rad", "velocity_rad_s", "acceleration_rad_s2", "time_s"):
        require_kind(f"{name} of the data", getattr(data, name), np.ndarray, remedy)
    if data.temperature_c is not None:
        require_kind("temperature_c of the data", data.temperature_c, np.ndarray, remedy)
    if data.payload is not None:
        require_kind("payload of the data", data.payload, Payload, "write Payload(name, mounting)")


def fitted_model(calibration: Calibration, model: Model) -> Model:
    """The declared model with a calibration's corrections, and friction by payload if it has it.

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
    for placed, coefficients in placed_effects(calibration):
        if isinstance(placed.effect, GeometryEffect):
            applied = placed.effect.with_applied(coefficients.tolist())
            found.append(replace(placed, effect=applied))
    return tuple(found)


def left_of(placed: PlacedEffect, coefficients: FloatArray) -> tuple[PlacedEffect, FloatArray]:
    """An effect and its coefficients, (p,), in a corrected model: of a correction only its σ."""
    if not isinstance(placed.effect, GeometryEffect):
        return placed, coefficients
    applied = placed.effect.with_applied(coefficients.tolist())
    return replace(placed, effect=applied), np.zeros_like(coefficients)


def _bounded(torque: FloatArray, accepted: AcceptedEffect) -> FloatArray:
    """Limit an effect's torque, shape (n, k), to EXTRAPOLATED times the largest of the fit."""
    if accepted.largest_torque is None:
        return torque
    largest = np.array(accepted.largest_torque)
    limit = EXTRAPOLATED * largest[:, None]
    return np.clip(torque, -limit, limit)


@takes(calibration=Calibration, model=Model, data=Dataset)
def predict_current(calibration: Calibration, model: Model, data: Dataset) -> FloatArray:
    """Predict the current references of a motion, v = (T τ)/g.

    Arguments and errors are those of `predict_torque`.

    Returns:
        current references [A] at full rate, shape (n_samples, n_axes).
    """
    torque = predict_torque(calibration, model, data)
    return _currents(calibration, model, torque)


def _currents(calibration: Calibration, model: Model, torque: FloatArray) -> FloatArray:
    """Currents (T τ)/g of joint torques, shape (k, m) each."""
    motor_torque = torque @ model.drive_train.to_motor.T
    return np.asarray(motor_torque / _gains(calibration, model))


@takes(calibration=Calibration, model=Model, motion=Motion | None)
def measured_torque(
    calibration: Calibration, model: Model, current_a: ArrayLike, motion: Motion | None = None
) -> FloatArray:
    """Convert current references [A] to joint torque [Nm], Y = V g (eq. 4 through R).

    Both have the shape (n_samples, n_axes).

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
    require_size("current_a", current, ModelError, "give amperes")
    torque = np.asarray((gains * current) @ model.drive_train.direction)
    if motion is None or not model.is_redundant:
        return torque
    return without_preload(model.follow(motion), torque.T).T


def measured_current(
    calibration: Calibration, model: Model, current_a: FloatArray, motion: Motion
) -> FloatArray:
    """Return the part of current references [A], shape (k, m), that is predicted: all but internal
    preload.

    Arguments and errors are those of `measured_torque`.
    """
    if not model.is_redundant:
        return np.asarray(current_a)
    torque = measured_torque(calibration, model, current_a, motion)
    return _currents(calibration, model, torque)


def standard_parameters(calibration: Calibration, model: Model) -> FloatArray:
    """Standard parameters χ_st that move as the identified base parameters do, shape (c,).

    They are those without payload. A base parameter β gathers the columns that depend on its
    leading one (paper §2.1), W_st χ_st = W β for every χ_st with this β; the simplest one holds β
    at the leading columns, which name the base parameters, and zero elsewhere. What a payload adds
    to friction is left out where the model has no friction by payload.

    Raises:
        ModelError: a parameter is none of this robot's, or groups with others as it does in no
            robot like this one.
    """
    _gains(calibration, model)  # as many axes
    index = {column.name: number for number, column in enumerate(model.columns)}
    of_effects: set[str] = set()
    for effect in calibration.effects:
        for coefficient in effect.coefficients:
            of_effects.add(coefficient.name)
    standard = np.zeros(len(index))
    names: list[str] = []
    for parameter in calibration.parameters:
        name = parameter.name
        is_of_payload = ":" in name
        if name in of_effects or is_of_payload:
            continue
        if parameter.is_payload_friction and not model.friction_by_payload:
            continue
        leading = ""
        words = name.split()
        if words:
            leading = words[0]
        if leading not in index:
            existing = ", ".join(index)
            raise ModelError(
                f"the calibration of cell {calibration.cell!r} has a parameter {name!r}; "
                f"the model of {model.robot.joint_count} joints has {existing}"
            )
        standard[index[leading]] = parameter.value
        names.append(name)
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
    """Parameters that a calibration has of a payload, by their names without its mounting."""
    mounted: dict[str, Parameter] = {}
    for parameter in calibration.parameters:
        name, colon, own_mounting = parameter.name.partition(":")
        if colon and own_mounting == mounting:
            mounted[name] = parameter
    return mounted


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
    weighed_kg = payload.known.get("m")
    given_kg: float | None = None
    mass = own.get("m")
    if mass is not None and mass.std == 0.0:
        given_kg = mass.value
    if given_kg is not None and weighed_kg is not None and weighed_kg != given_kg:
        raise DataUnfit(
            run,
            f"carries {weighed_kg:g} kg on mounting {payload.mounting!r}; the calibration has "
            f"{given_kg:g} kg: give each way of mounting a name of its own",
        )
    known = {name: value for name, value in payload.known.items() if name not in own}
    return replace(payload, known=known)


def other_body(calibration: Calibration, payload: Payload) -> str:
    """Say which payload a calibration knows on the mounting of another one.

    It is empty where it knows none there, or the same by name.

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


def placed_effects(calibration: Calibration) -> list[tuple[PlacedEffect, FloatArray]]:
    """Effects of a calibration, in its order, each with its coefficients, shape (p,).

    Raises:
        EffectNotInstalled, EffectRefused: see `placed_effect`; or one is there twice, so that its
            torque would count twice.
    """
    effects: list[tuple[PlacedEffect, FloatArray]] = []
    keys: set[EffectKey] = set()
    for accepted in calibration.effects:
        placed, coefficients = placed_effect(accepted, calibration)
        key = effect_key(placed.effect, placed.axis)
        if key in keys:
            name = placed.name_among(calibration.places)
            raise EffectRefused(
                f"found the effect {name} twice in the calibration of cell {calibration.cell!r}; "
                "expected each effect once on an axis; take one of them out, or fit the logs again"
            )
        keys.add(key)
        effects.append((placed, coefficients))
    return effects


def placed_effect(
    accepted: AcceptedEffect, calibration: Calibration
) -> tuple[PlacedEffect, FloatArray]:
    """The effect that a calibration names, where it acts, and its coefficients, shape (p,).

    Args:
        accepted: of the calibration.
        calibration: whose axes and joints these are.

    Raises:
        EffectNotInstalled: the package that had the effect is not installed.
        EffectRefused: no such effect, setting, axis or coefficient exists.
    """
    known = _known_effect(accepted, calibration)
    axis = _axis_of(accepted, known, calibration.places)
    settings = _settings_of(accepted, known)
    check_settings(known, settings, axis, len(calibration.gains))
    # A file knows one kind of number; an order must be whole.
    typed = {name: setting_kind(known, name)(value) for name, value in settings.items()}
    if typed != settings:
        raise EffectRefused(
            f"effect {accepted.name!r} is given {settings}; these must be whole numbers"
        )
    placed = PlacedEffect(known.with_settings(typed), axis)
    return placed, _coefficients_of(accepted, placed)


def _known_effect(accepted: AcceptedEffect, calibration: Calibration) -> Effect:
    """A member of the family that a calibration names.

    Raises:
        EffectNotInstalled: the package that had the effect is not installed.
        EffectRefused: there is no such effect.
    """
    name = accepted.name
    package = accepted.package
    known = known_effect(name, calibration.own_effects)
    if known is None:
        if package is None:
            existing = ", ".join(sorted(known_names()))
            raise EffectRefused(f"there is no effect {name!r}; there are {existing}")
        installed = installed_version(package)
        raise EffectNotInstalled(name, accepted.axis, package, installed=installed)
    is_given = any(effect.name == name for effect in calibration.own_effects)
    if package is not None and not is_given and not is_of_package(known, package):
        other = package_of(known) or "drivegain"
        raise EffectNotInstalled(name, accepted.axis, package, other=other)
    return known


def _axis_of(accepted: AcceptedEffect, known: Effect, places: Sequence[str]) -> int:
    """Index of the place that an effect acts on; 0 of one that acts on all axes alike.

    Raises:
        EffectRefused: there is no such place, or an effect on all axes is given one of them.
    """
    if not known.has_axis and accepted.axis == ALL_AXES:
        return 0
    found = f"effect {accepted.name!r} acts on axis {accepted.axis!r}"
    if accepted.axis not in places:
        existing = ", ".join(places)
        raise EffectRefused(f"{found}; there are {existing}")
    axis = places.index(accepted.axis)
    if not known.has_axis and axis:
        raise EffectRefused(f"{found}; it acts on {ALL_AXES}")
    return axis


def _settings_of(accepted: AcceptedEffect, known: Effect) -> dict[str, float]:
    """Settings of an effect; those that a later version added are 0.

    Raises:
        EffectRefused: others are missing, or do not exist.
    """
    settings = dict(accepted.settings)
    for name in known.added_settings:
        settings.setdefault(name, 0.0)
    if set(settings) != set(known.settings):
        found = ", ".join(sorted(accepted.settings)) or "none"
        existing = ", ".join(sorted(known.settings)) or "none"
        raise EffectRefused(
            f"effect {accepted.name!r} is given the settings {found}; it has {existing}"
        )
    return settings


def _coefficients_of(accepted: AcceptedEffect, placed: PlacedEffect) -> FloatArray:
    """Coefficients of an effect in the order of its columns, shape (p,).

    Raises:
        EffectRefused: some are missing, or do not exist.
    """
    needed = [column.name for column in placed.columns]
    given = [coefficient.name for coefficient in accepted.coefficients]
    if sorted(given) != sorted(needed):
        found = ", ".join(given) or "none"
        expected = ", ".join(needed)
        raise EffectRefused(
            f"effect {accepted.name!r} has the coefficients {found}; it needs {expected}"
        )
    values = {coefficient.name: coefficient.value for coefficient in accepted.coefficients}
    return np.array([values[name] for name in needed])


def _gains(calibration: Calibration, model: Model) -> FloatArray:
    """Gains of a calibration, shape (m,).

    Raises:
        ModelError: they are not as many as the model has axes, or see `_require_numbers`.
    """
    count = model.robot.axis_count
    _require_numbers(calibration)
    gains = [float(gain.value) for gain in calibration.gains]
    if len(gains) != count:
        raise ModelError(f"the calibration has {len(gains)} gains, the model {count} joints")
    return np.array(gains)


def _require_numbers(calibration: Calibration) -> None:
    """Refuse a calibration made by a program with numbers that predict none; files have none.

    Raises:
        ModelError: a gain is zero, a number is none, or not finite, or too large.
    """
    of_calibration = {
        "gains": (calibration.gains, Gain),
        "parameters": (calibration.parameters, Parameter),
        "effects": (calibration.effects, AcceptedEffect),
    }
    for name, (entries, kind) in of_calibration.items():
        require_entries(f"{name} of the calibration", entries, kind, FROM_CALIBRATION)
    for gain in calibration.gains:
        name = f"gain of {gain.axis}"
        require_kind(f"{name} of the calibration", gain.value, Real, FROM_CALIBRATION)
        if not SMALLEST_NUMBER <= abs(gain.value) <= LARGEST_NUMBER:
            raise _wrong_number(calibration, name, gain.value)
    parameters = list(calibration.parameters)
    for effect in calibration.effects:
        label = f"coefficients of effect {effect.name!r} of the calibration"
        require_entries(label, effect.coefficients, Parameter, FROM_CALIBRATION)
        parameters.extend(effect.coefficients)
    for parameter in parameters:
        require_kind("name of a parameter", parameter.name, str, FROM_CALIBRATION)
        name = f"parameter {parameter.name}"
        require_kind(f"{name} of the calibration", parameter.value, Real, FROM_CALIBRATION)
        if not abs(parameter.value) <= LARGEST_NUMBER:
            raise _wrong_number(calibration, name, parameter.value)


def _wrong_number(calibration: Calibration, name: str, value: float) -> ModelError:
    """Error for a number of a calibration that no fit gives."""
    found = as_float(value)
    return ModelError(
        f"the calibration of cell {calibration.cell!r} has the {name} {found:g}; expected a number "
        f"of a fit, at most {LARGEST_NUMBER:g} in size, and no gain of zero; give the calibration "
        "as it was fitted or read"
    )


def payload_of(calibration: Calibration, data: Dataset) -> FloatArray | None:
    """χ_L of what a run carries, by the run and the calibration, shape (10,).

    The calibration has what it has identified of the payload's mounting. None without load.

    Raises:
        DataUnfit: the calibration does not know the mounting, knows another payload on it, or knows
            the payload with another mass.
    """
    payload = data.payload
    if payload is None:
        return None
    _require_same_body(calibration, payload, data.name)
    mountings: set[str] = set()
    for parameter in calibration.parameters:
        _, colon, mounting = parameter.name.partition(":")
        if colon:
            mountings.add(mounting)
    own = mounted_parameters(calibration, payload.mounting)
    identified = {name: parameter.value for name, parameter in own.items()}
    _check_mounting(payload, identified, mountings, data.name)
    if identified:
        _require_same_mass(calibration, payload, data.name)
    return payload_parameters(payload, identified)


def _require_same_mass(calibration: Calibration, payload: Payload, run: str) -> None:
    """Refuse another mass than that of the fit on the same mounting.

    What was identified with one mass, first moments and inertia, is not that of a body of another
    mass.

    Raises:
        DataUnfit: the payload has another mass.
    """
    mass_kg = payload.known.get("m")
    if mass_kg is None:
        return
    fitted_kg = _fitted_masses_kg(calibration, payload, payload.mounting)
    is_same = all(_is_same_mass(mass_kg, one_kg) for one_kg in fitted_kg)
    if not fitted_kg:
        # Earlier versions did not write the mounting: any of their masses may have been on it.
        fitted_kg = _fitted_masses_kg(calibration, payload, None)
        is_same = not fitted_kg or any(_is_same_mass(mass_kg, one_kg) for one_kg in fitted_kg)
    if not is_same:
        expected = " or ".join(f"{one_kg:g}" for one_kg in fitted_kg)
        raise DataUnfit(
            run,
            f"payload {payload.name!r} weighs {mass_kg:g} kg; expected {expected} kg as in the "
            f"fit: the calibration holds the rest of its inertia on mounting {payload.mounting!r}; "
            "give another body another mounting",
        )


def _fitted_masses_kg(
    calibration: Calibration, payload: Payload, mounting: str | None
) -> tuple[float, ...]:
    """Masses [kg] of a payload in the runs of the fit that name this mounting, the smallest first.

    A held-out run has identified nothing, so its mass is none of them.
    """
    found: set[float] = set()
    for source in calibration.sources:
        is_own = source.payload == payload.name and source.mounting == mounting
        if is_own and source.role == "fit" and source.mass_kg:
            found.add(source.mass_kg)
    return tuple(sorted(found))


def _is_same_mass(mass_kg: float, fitted_kg: float) -> bool:
    """Whether two weighings may be of one body."""
    return abs(mass_kg / fitted_kg - 1.0) <= SAME_MASS


def _check_mounting(
    payload: Payload, identified: dict[str, float], mountings: set[str], run: str
) -> None:
    mounting = f"mounting {payload.mounting!r}"
    if not identified and set(payload.known) != set(LINK_PARAMETERS):
        known = ", ".join(sorted(map(repr, mountings))) or "none"
        raise DataUnfit(
            run, f"carries {mounting}, of which the calibration knows nothing; it knows {known}"
        )
    both = ", ".join(sorted(set(identified) & set(payload.known)))
    if both:
        same = "the calibration identified the same: give each way of mounting a name of its own"
        raise DataUnfit(run, f"declares {both} of {mounting}, and {same}")
    foreign = ", ".join(sorted(set(identified) - set(LINK_PARAMETERS)))
    if foreign:
        raise DataUnfit(run, f"{mounting} has parameters that no payload has: {foreign}")
