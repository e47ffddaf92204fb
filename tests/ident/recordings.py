"""Recordings that obey the declared model exactly, made by its own regressor:
what an estimator must give back.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from ident.calibration import AcceptedEffect, Calibration, Gain, Parameter, PayloadMass, factor_of
from ident.data.conditioning import Conditioning
from ident.data.dataset import Dataset, differentiate
from ident.data.run import Run
from ident.discovery.candidates import ColumnCache, SearchProblem, prepare_search
from ident.discovery.evidence import Evidence, gather
from ident.effects.effect import PlacedEffect
from ident.effects.signals import session_began_s
from ident.equations.linearisation import Jacobian
from ident.equations.rows import decimate_rows
from ident.estimators.estimate import Estimate, RelativeError, relative_error
from ident.estimators.identify import identify
from ident.estimators.maximum_likelihood import ml
from ident.estimators.payload_mass import mass_responses
from ident.model.bodies import LINK_PARAMETERS, Payload
from ident.model.model import DriveTrain, Model
from ident.model.urdf import robot_from_urdf
from tests.ident.arms import GANTRY, POLAR, THREE_AXES, TX40, Arm

FloatArray = NDArray[np.float64]

RATIO = np.diag([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])
RATIO[5, 4] = 32.0
GAINS = np.array([33.9, 32.4, 24.2, -9.21, 16.3, 6.79])
_PAYLOAD_INERTIA = (0.08, -0.012, 0.022, 0.082, 0.032, 0.052)
_PAYLOAD_MOMENT = (-0.24, -0.25, 0.39)
_PAYLOAD_VALUES = (*_PAYLOAD_INERTIA, *_PAYLOAD_MOMENT, 4.59)
PAYLOAD_TRUTH = dict(zip(LINK_PARAMETERS, _PAYLOAD_VALUES, strict=True))
MOUNTED = Payload("disc", "a", {"m": 4.59})
STANDSTILL_RAD_S = (0.03,) * 6
CONDITIONING = Conditioning(standstill_rad_s=STANDSTILL_RAD_S)
MOVE_S = 1.1
RAMP_S = 0.9
LIMITS_RAD = (2.5, 1.8, 2.2, 3.0, 1.8, 3.0, 2.0)


@dataclass(frozen=True)
class Truth:
    """A robot whose every parameter is known to the test."""

    model: Model
    parameters: FloatArray
    gains: FloatArray


def _model_of(arm: Arm, ratio: FloatArray) -> Model:
    """An arm with the gears of its motors."""
    robot = robot_from_urdf(arm.urdf)
    drive_train = DriveTrain(ratio)
    return Model(robot, drive_train)


def tx40_truth(seed: int = 0) -> Truth:
    """The TX-40-like arm with friction of the paper's size."""
    model = _model_of(TX40, RATIO)
    masses = (10.0, 3.7, 4.1, 3.4, 1.0, 0.2)
    friction = (
        (0.35, 7.0, 5.5),
        (0.35, 4.4, 7.7),
        (0.08, 1.6, 6.3),
        (0.027, 0.7, 1.9),
        (0.05, 1.1, 2.6),
        (0.01, 0.25, 0.6),
    )
    rng = np.random.default_rng(seed)
    parameters = _parameters(model, masses, friction, rng)
    parameters[-3:] = (0.0104, 0.47, 1.7)
    return Truth(model, parameters, GAINS)


def three_axes_truth() -> Truth:
    """An arm of three axes without coupling.

    Its rotors are light: what is seen of Ia2 is regrouped with the inertia of the links, which
    elasticity and backlash speak of, and would make them look smaller than they are.
    """
    ratio = np.diag([40.0, 50.0, -45.0])
    model = _model_of(THREE_AXES, ratio)
    friction = (
        (0.03, 7.0, 5.5),
        (0.03, 4.4, 7.7),
        (0.02, 1.6, 6.3),
    )
    rng = np.random.default_rng(2)
    masses = (10.0, 5.0, 3.0)
    parameters = _parameters(model, masses, friction, rng)
    gains = np.array([33.9, 32.4, -24.2])
    return Truth(model, parameters, gains)


def gantry_truth() -> Truth:
    """Three linear axes with a wrist of two, the arm in an upright gravity."""
    ratio = np.diag([120.0, 120.0, 150.0, 40.0, 50.0])
    model = _model_of(GANTRY, ratio)
    friction = (
        (8.0, 20.0, 15.0),
        (6.0, 15.0, 12.0),
        (3.0, 10.0, 9.0),
        (0.03, 1.0, 2.0),
        (0.02, 0.8, 1.5),
    )
    masses = (15.0, 12.0, 8.0, 4.0, 2.0)
    rng = np.random.default_rng(3)
    parameters = _parameters(model, masses, friction, rng)
    offset_n = [20.0, -15.0, 10.0]
    parameters[[13, 27, 41]] = offset_n
    gains = np.array([60.0, 55.0, 70.0, 8.0, 6.0])
    return Truth(model, parameters, gains)


def polar_truth() -> Truth:
    """A turntable, a joint that lifts the arm, a slide along it, and a wrist."""
    ratio = np.diag([40.0, 50.0, 120.0, 40.0])
    model = _model_of(POLAR, ratio)
    friction = (
        (0.03, 7.0, 5.5),
        (0.03, 4.4, 7.7),
        (3.0, 20.0, 15.0),
        (0.02, 1.6, 4.0),
    )
    masses = (12.0, 8.0, 5.0, 3.0)
    rng = np.random.default_rng(2)
    parameters = _parameters(model, masses, friction, rng)
    gains = np.array([33.0, 32.0, 60.0, 15.0])
    return Truth(model, parameters, gains)


def _parameters(
    model: Model,
    masses: tuple[float, ...],
    friction: tuple[tuple[float, float, float], ...],
    rng: np.random.Generator,
) -> FloatArray:
    """Links of these masses around random centres; Ia, fv and fs of each joint."""
    parameters = np.zeros(len(model.columns))
    upper = np.triu_indices(3)
    for joint, mass in enumerate(masses):
        drive = friction[joint]
        centre = rng.uniform(-0.1, 0.1, 3)
        centre_outer = np.outer(centre, centre)
        square = 0.05**2 + centre @ centre
        isotropic = np.eye(3) * square
        inertia = mass * (isotropic - centre_outer)
        first = 14 * joint
        of_joint = parameters[first : first + 14]
        of_joint[:6] = inertia[upper]
        moment = mass * centre
        of_joint[6:9] = moment
        of_joint[9] = mass
        of_joint[10:13] = drive
        offset = rng.uniform(-0.3, 0.3)
        of_joint[13] = offset
    return parameters


def positions(
    rng: np.random.Generator, seconds: float, rate_hz: float, limits: FloatArray
) -> FloatArray:
    """Point-to-point moves with smooth ramps and no dwell, shape (k, n)."""
    count = round(seconds * rate_hz)
    move_count = round(seconds / MOVE_S) + 2
    samples_a_move = round(MOVE_S * rate_hz)
    shape = (move_count, len(limits))
    shares = rng.uniform(-1.0, 1.0, shape)
    knots = shares * limits
    repeated_knots = np.repeat(knots, samples_a_move, axis=0)
    stairs = repeated_knots[:count]
    margin = round(RAMP_S * rate_hz)
    window = np.hanning(margin)
    first = stairs[:1]
    last = stairs[-1:]
    before = np.repeat(first, margin, axis=0)
    after = np.repeat(last, margin, axis=0)
    padded = np.concatenate((before, stairs, after))
    weights = window / window.sum()
    column = weights[:, None]
    smooth = signal.fftconvolve(padded, column, mode="same", axes=0)
    end = margin + count
    return np.asarray(smooth)[margin:end]


def record(
    truth: Truth,
    name: str,
    rng: np.random.Generator,
    payload: Payload | None = None,
    *,
    seconds: float = 20.0,
    noise_a: float = 0.0,
    rate_hz: float = 1000.0,
    averaged: int | None = None,
    bend: Callable[[FloatArray], FloatArray] = lambda q: q,
) -> Run:
    """One run: the current is what the model needs for the (bent) motion,
    plus noise on the current alone.

    Args:
        truth: the robot.
        name: of the run.
        rng: of moves and noise.
        payload: that it carries.
        seconds: duration.
        noise_a: σ of each sample that is drawn [A].
        rate_hz: of the samples that are drawn.
        averaged: how many of them become one sample of the run; where None, 4 of 1 kHz, else 1.
            Fewer tell the filters of a fit, which end at some 10 Hz, the same, and are worked on in
            a quarter of the time.
        bend: the motion that is made, of the positions that are drawn.
    """
    drawn_hz = rate_hz
    if not averaged:
        averaged = 4 if drawn_hz == 1000.0 else 1
    rate_hz = drawn_hz / averaged
    count = len(truth.gains)
    limits = np.array(LIMITS_RAD[:count])
    straight = positions(rng, seconds, drawn_hz, limits)
    drawn = bend(straight)
    q = drawn[::averaged]
    samples = np.arange(len(q))
    time = samples / rate_hz
    current_a = np.zeros_like(q)
    bare = Run(name, time, q, current_a)
    # The recorded positions are band-limited far below this cut-off, so these derivatives are the
    # motion's own.
    position_cutoff_hz = 0.3 * rate_hz
    conditioning = Conditioning(position_cutoff_hz=position_cutoff_hz)
    data = differentiate(bare, truth.model.drive_train, conditioning)
    columns = truth.model.regressor(data.motion())
    parameters = truth.parameters.copy()
    if payload is not None:
        flange = truth.model.flange
        carried = list(PAYLOAD_TRUTH.values())
        parameters[flange] += carried
    torque = np.einsum("jck,c->jk", columns, parameters)
    motor_torque = truth.model.drive_train.to_motor @ torque
    gains = truth.gains[:, None]
    needed = motor_torque / gains
    current = np.zeros_like(q)
    current[1:-1] = needed.T
    noise = noise_a * rng.standard_normal(drawn.shape)
    starts = np.arange(0, len(noise), averaged)
    sums = np.add.reduceat(noise, starts)
    current += sums / averaged
    return Run(name, time, q, current, payload)


def gathered(truth: Truth, runs: tuple[Run, ...], holdout: tuple[Run, ...] = ()) -> Evidence:
    """Identified by ``ml``, with its rows."""
    standstill_rad_s = (0.03,) * len(truth.gains)
    conditioning = replace(CONDITIONING, standstill_rad_s=standstill_rad_s)
    identified = identify(truth.model, runs, conditioning, holdout=holdout)
    return gather(identified, runs, holdout)


def bent(clean: Evidence, truth: Truth, torque_nm: Callable[[Dataset], FloatArray]) -> Evidence:
    """Recordings in which the joints need more torque than the declared model says,
    fitted again without holding it.

    Args:
        clean: without hold-out runs.
        truth: of whom the torque asks its current.
        torque_nm: of all joints along a run, shape (n, k).
    """
    rows = []
    for data in clean.datasets:
        torque = torque_nm(data)
        of_run = decimate_rows(data, clean.conditioning, torque)
        rows.append(of_run)
    stacked_rows = np.concatenate(rows, axis=1)
    to_motor = truth.model.drive_train.to_motor
    gains = truth.gains[:, None]
    added_a = to_motor @ stacked_rows / gains
    return with_current(clean, added_a)


def with_current(clean: Evidence, added_a: FloatArray) -> Evidence:
    """The same with more current on the decimated rows, shape (n, r), fitted again."""
    current = clean.rows_without_effects.current + added_a
    training = replace(clean.rows_without_effects, current=current)
    estimate = ml(training.system())
    return replace(clean, rows_without_effects=training, training=training, estimate=estimate)


def acting_on(axis: int, count: int, torque_nm: FloatArray) -> FloatArray:
    """Torque of one joint, shape (k,), as that of all, shape (n, k)."""
    unit_vector = np.eye(count)[axis]
    column = unit_vector[:, None]
    return np.asarray(column * torque_nm)


def search_problem_of(evidence: Evidence, cache: ColumnCache | None = None) -> SearchProblem:
    """The residual of the runs of the fit."""
    return prepare_search(
        evidence.model, evidence.fit_runs, evidence.training, evidence.estimate, cache
    )


def whole(jacobian: Jacobian) -> FloatArray:
    """Write a Jacobian out with its zeros, shape (rows, f)."""
    return jacobian.columns(np.arange(jacobian.width))


def training_error(evidence: Evidence) -> RelativeError:
    """Error on the rows of the fit [%]."""
    estimate = evidence.estimate
    rows = evidence.training
    measured_nm = rows.torque(estimate.gains)
    predicted_nm = estimate.predicted_torque(rows)
    return relative_error(measured_nm, predicted_nm, rows.use)


def calibrated(evidence: Evidence) -> Calibration:
    """The calibration that an estimate with its effects amounts to."""
    estimate = evidence.estimate
    parameters = _parameters_of(estimate)
    effects = tuple(_accepted(placed, parameters) for placed in evidence.effects)
    calibration = a_calibration(estimate.gains, parameters, estimate.gains_std)
    references = []
    for response in mass_responses(evidence.identification.system, estimate):
        reference = PayloadMass.of(
            response.payload,
            response.mass_kg,
            response.gain_per_kg.tolist(),
            calibration.gains,
            response.parameters_per_kg.tolist(),
        )
        references.append(reference)
    covariance_factor = factor_of(estimate.covariance)
    return replace(
        calibration,
        payload_mass=tuple(references),
        effects=effects,
        session_began_s=session_began_s(evidence.fit_runs),
        covariance_factor=covariance_factor,
    )


def _parameters_of(estimate: Estimate) -> tuple[Parameter, ...]:
    """Unknowns of an estimate with their deviations."""
    values = estimate.parameters.tolist()
    deviations = estimate.parameters_std.tolist()
    parameters = []
    for column, value, std in zip(estimate.unknowns, values, deviations, strict=True):
        parameter = Parameter(column.name, value, std, column.unit)
        parameters.append(parameter)
    return tuple(parameters)


def _accepted(placed: PlacedEffect, parameters: tuple[Parameter, ...]) -> AcceptedEffect:
    """An effect as a calibration has it."""
    effect = placed.effect
    names = {column.name for column in placed.columns}
    coefficients = tuple(parameter for parameter in parameters if parameter.name in names)
    setting = {name: float(value) for name, value in effect.settings.items()}
    axis = f"J{placed.axis + 1}"
    return AcceptedEffect(effect.name, axis, setting, coefficients, 1.0, 1.0)


def a_calibration(
    gains: FloatArray, parameters: tuple[Parameter, ...], gains_std: FloatArray | None = None
) -> Calibration:
    """A calibration of these gains and parameters, exact unless deviations are given."""
    if gains_std is None:
        gains_std = np.zeros(len(gains))
    named_gains = []
    for index, gain in enumerate(gains.tolist()):
        name = f"J{index + 1}"
        std = float(gains_std[index])
        named_gain = Gain(name, gain, std, "Nm/A", 1.0)
        named_gains.append(named_gain)
    axes = (0.0,) * len(gains)
    relative_error_percent = RelativeError(axes, 0.0)
    return Calibration(
        cell="test",
        method="ml",
        gains=tuple(named_gains),
        parameters=parameters,
        effects=(),
        relative_error_percent=relative_error_percent,
        holdout_error_percent=None,
        condition=1.0,
        rows=1,
        filter={},
        sources=(),
        configuration_sha256="",
        created="",
        software="",
    )
