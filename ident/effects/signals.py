"""Signals that an effect may depend on: motion, predicted load and current, at full rate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import Enum
from itertools import pairwise

import numpy as np

from ident.arrays import FloatArray, IntArray
from ident.data.dataset import Dataset
from ident.equations.observation import Observation
from ident.estimators.estimate import Estimate
from ident.model.bodies import LINK_PARAMETERS, Payload
from ident.model.model import Model
from ident.model.robot import Motion, at_rest, each_state

STICKING_RAD_S = 0.005  #: Below this speed the noise of the filtered encoder decides the sign
UNIX_S = 1e9  #: Times from here on, September 2001, are since 1970; earlier ones since some start
REFERENCE_C = 40.0
"""Temperature at which the declared friction holds beside a friction that depends on it; motors are
rated at this ambient temperature (IEC 60034-1). The fit is the same for any; a fixed one keeps
calibrations comparable.
"""
TWIST_RAD = 1e-4  #: Step of the derivative to the position of a joint
TWIST_RAD_S = 1e-3  #: Step of the derivative to its velocity
POSTURE_SAMPLES = 20  #: Samples between two postures in which the mass matrix is computed


class Abscissa(Enum):
    """Variable of one axis that a residual is plotted against and tested for: label with unit."""

    VELOCITY = "joint velocity [rad/s]"
    POSITION = "joint position [rad]"
    LOAD = "load torque [Nm]"
    TIME = "time in the run [s]"
    SESSION = "time in the session [s]"
    MOTOR_ANGLE = "motor angle, one revolution [rad]"
    CURRENT = "predicted current [A]"
    TORQUE_RATE = "rate of the motor torque [Nm/s]"
    LOAD_CURVATURE = "second derivative of the load torque [Nm/s²]"
    DISTANCE = "way since the last reversal [rad]"
    OTHER_VELOCITY = "velocity of the other joint [rad/s]"
    OTHER_ACCELERATION = "acceleration of the other joint [rad/s²]"
    TEMPERATURE = "temperature of the motor or its drive [°C]"

    @property
    def is_of_other_joint(self) -> bool:
        """Whether the variable is that of a second joint."""
        return self in {Abscissa.OTHER_VELOCITY, Abscissa.OTHER_ACCELERATION}

    @property
    def is_independent_of_model(self) -> bool:
        """Whether the variable does not depend on the model's predictions."""
        return self not in {
            Abscissa.LOAD,
            Abscissa.CURRENT,
            Abscissa.TORQUE_RATE,
            Abscissa.LOAD_CURVATURE,
        }


@dataclass(frozen=True, slots=True, eq=False)
class Arm:
    """The arm behind a run's signals, for the torques of a changed geometry."""

    model: Model  #: the model, with the corrections that were applied to it
    #: standard parameters, those of the mounted payload on the flange, shape (c,)
    standard: FloatArray
    motion: Motion  #: of the axes over k samples
    #: Torques of `motion` itself, from which the derivative to every zero, or every delay, begins.
    _kept: dict[str, FloatArray] = field(default_factory=dict, init=False, repr=False)

    def load_change(self, motion: Motion) -> FloatArray:
        """Change of the torque for links and payload with another motion [Nm or N], (m, k)."""
        if "load" not in self._kept:
            self._kept["load"] = self._load(self.motion)
        return self._load(motion) - self._kept["load"]

    def load_derivatives(self, axis: int, samples: IntArray) -> tuple[FloatArray, FloatArray]:
        """∂τ/∂q_j and ∂τ/∂q̇_j of the torque for links and payload, shape (m, s) each.

        Args:
            axis: joint j.
            samples: at which they are computed, the same at every call.
        """
        by_position = f"position {axis}"
        by_velocity = f"velocity {axis}"
        if by_position not in self._kept:
            motion = each_state(self.motion, lambda states: states[samples])
            position = motion.position_rad.copy()
            position[:, axis] += TWIST_RAD
            velocity = motion.velocity_rad_s.copy()
            velocity[:, axis] += TWIST_RAD_S
            load = self._load(motion)
            load_turned = self._load(replace(motion, position_rad=position))
            load_faster = self._load(replace(motion, velocity_rad_s=velocity))
            self._kept[by_position] = (load_turned - load) / TWIST_RAD
            self._kept[by_velocity] = (load_faster - load) / TWIST_RAD_S
        return self._kept[by_position], self._kept[by_velocity]

    def smooth_torque_change(self, motion: Motion) -> FloatArray:
        """Change of the torque without dry friction with another motion [Nm or N], (m, k)."""
        if "smooth" not in self._kept:
            self._kept["smooth"] = self._smooth_torque(self.motion)
        return self._smooth_torque(motion) - self._kept["smooth"]

    def _load(self, motion: Motion) -> FloatArray:
        load, _, _ = self.model.torques(motion, self.standard)
        return load

    def _smooth_torque(self, motion: Motion) -> FloatArray:
        smooth = self.standard.copy()
        smooth[self.model.dry_friction_columns] = 0.0
        smooth[self.model.coupled_dry_friction_columns] = 0.0
        _, _, total = self.model.torques(motion, smooth)
        return total

    def weight(self, gravity_m_s2: FloatArray) -> FloatArray:
        """Torque that carries links and payload in some gravity, at rest [Nm or N], (m, k)."""
        robot = replace(self.model.robot, gravity_m_s2=gravity_m_s2)
        model = replace(self.model, robot=robot)
        load, _, _ = model.torques(at_rest(self.motion.position_rad), self.standard)
        return load


@dataclass(frozen=True, slots=True)
class Signals:
    """One run as an effect sees it; arrays are axis-first, shape (n, k), and cannot be changed.

    Torques and currents are the model's predictions, never measurements: a measured current in a
    regressor would put its noise on both sides of the equation.
    """

    rate_hz: float  #: sampling rate
    time_s: FloatArray  #: since the start of the run, shape (k,)
    #: Since the first run of the session began, shape (k,); equal to time_s without a common clock.
    session_s: FloatArray
    #: position of the joints; in a closed chain those without a motor follow the driven ones
    position_rad: FloatArray
    velocity_rad_s: FloatArray  #: velocity of the same joints
    acceleration_rad_s2: FloatArray  #: acceleration of the same joints
    motor_position_rad: FloatArray  #: of the motors, R q
    #: Mass matrix of links and payload: torque at joint i per unit of acceleration of joint j, with
    #: a rotor's inertia where it is regrouped with theirs, in postures spread evenly over the run,
    #: shape (n, n, postures); none where it was not asked for. See `inertia`.
    inertia_kg_m2: FloatArray
    #: torque at each joint for links and payload, without friction and drive chain
    load_torque_nm: FloatArray
    geared_torque_nm: FloatArray  #: torque through the gear of each joint: load and friction
    #: torque of each motor in joint units (g v), friction included, effects left out
    motor_torque_nm: FloatArray
    current_a: FloatArray  #: the same in the unit of the current reference
    #: Of each motor or its drive [°C], NaN for one without; None where none was recorded.
    temperature_c: FloatArray | None = None
    #: Torque at each axis per unit of torque on each joint without a motor, then on each pivot that
    #: a loop is cut at, shape (u, m, k); empty without any.
    leverage: FloatArray = field(default_factory=lambda: np.empty((0, 0, 0)))
    #: What made the torques; None where they were not made of a model. Effects that change the
    #: geometry need it.
    arm: Arm | None = None
    #: Inertia of each axis' rotor that load and mass matrix contain, as far as it is known; empty
    #: without any.
    rotor_inertia_kg_m2: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        # Every effect of a search reads the same arrays: one that changed them would change the
        # columns of all others.
        for one in fields(self):
            value = getattr(self, one.name)
            if isinstance(value, np.ndarray):
                read_only = value.view()
                read_only.flags.writeable = False
                object.__setattr__(self, one.name, read_only)

    def temperature(self, axis: int) -> FloatArray:
        """Temperature of an axis [°C], shape (k,); REFERENCE_C where it was not recorded."""
        if self.temperature_c is None:
            return np.full(len(self.time_s), REFERENCE_C)
        recorded = self.temperature_c[axis]
        return np.asarray(np.where(np.isnan(recorded), REFERENCE_C, recorded))

    def rotor_inertia(self, axis: int) -> float:
        """Inertia of an axis' rotor that its load contains [kg m²]; 0 where none is known."""
        if axis < len(self.rotor_inertia_kg_m2):
            return self.rotor_inertia_kg_m2[axis]
        return 0.0

    def link_torque(self, axis: int) -> FloatArray:
        """Torque of an axis for links and payload, less that of a known rotor [Nm], shape (k,)."""
        return self._without_rotor(self.load_torque_nm, axis)

    def gear_torque(self, axis: int) -> FloatArray:
        """Load and friction through the gear of an axis, less a known rotor's [Nm], (k,)."""
        return self._without_rotor(self.geared_torque_nm, axis)

    def _without_rotor(self, torque_nm: FloatArray, axis: int) -> FloatArray:
        inertia_kg_m2 = self.rotor_inertia(axis)
        if not inertia_kg_m2:
            return np.asarray(torque_nm[axis])
        rotor_nm = inertia_kg_m2 * self.acceleration_rad_s2[axis]
        return np.asarray(torque_nm[axis] - rotor_nm)

    def inertia(self, joints: int | slice, axis: int) -> FloatArray:
        """Torque at joints per unit of acceleration of the joint `axis`, shape (…, k).

        It is interpolated between postures, because it changes slowly. A known rotor is left out.
        """
        of_axis = self.inertia_kg_m2[:, axis].copy()
        of_axis[axis] -= self.rotor_inertia(axis)
        in_postures = of_axis[joints]
        sample_count = len(self.time_s)
        postures = _postures(sample_count, in_postures.shape[-1])
        step = np.diff(postures)
        # Samples from each posture on; the last sample is a posture, too
        samples = step.copy()
        samples[-1:] += 1
        slope = np.diff(in_postures, axis=-1) / step
        since_posture = np.arange(sample_count) - np.repeat(postures[:-1], samples)
        out = np.repeat(slope, samples, axis=-1)
        out *= since_posture
        out += np.repeat(in_postures[..., :-1], samples, axis=-1)
        return np.asarray(out)

    def variable(self, abscissa: Abscissa, axis: int, other: int | None = None) -> FloatArray:
        """Return a variable of an axis along the run, shape (k,).

        Args:
            abscissa: the variable.
            axis: the axis.
            other: second axis, of a variable of another joint; the same one when None.
        """
        if abscissa.is_of_other_joint and other is not None:
            axis = other
        return np.asarray(self._variable(abscissa, axis), dtype=np.float64)

    def _variable(self, abscissa: Abscissa, axis: int) -> FloatArray:
        variable: FloatArray
        match abscissa:
            case Abscissa.VELOCITY | Abscissa.OTHER_VELOCITY:
                variable = self.velocity_rad_s[axis]
            case Abscissa.OTHER_ACCELERATION:
                variable = self.acceleration_rad_s2[axis]
            case Abscissa.POSITION:
                variable = self.position_rad[axis]
            case Abscissa.LOAD:
                variable = self.link_torque(axis)
            case Abscissa.TIME:
                variable = self.time_s
            case Abscissa.SESSION:
                variable = self.session_s
            case Abscissa.MOTOR_ANGLE:
                variable = np.mod(self.motor_position_rad[axis], 2.0 * np.pi)
            case Abscissa.CURRENT:
                variable = self.current_a[axis]
            case Abscissa.TORQUE_RATE:
                variable = np.gradient(self.motor_torque_nm[axis]) * self.rate_hz
            case Abscissa.LOAD_CURVATURE:
                variable = curvature(self.link_torque(axis), self.rate_hz)
            case Abscissa.DISTANCE:
                _, variable = distance_since_reversal(self.velocity_rad_s[axis], self.rate_hz)
            case Abscissa.TEMPERATURE:
                variable = self.temperature(axis)
        return variable


def fitted_signals(
    model: Model,
    data: Dataset,
    observation: Observation,
    estimate: Estimate,
    session_began_s: float | None = None,
    *,
    inertia: bool = True,
) -> Signals:
    """Predict a run's torques with the declared part of an estimate, without its effects.

    The observation, rows of the fit, names the base parameters; for the last two see
    `declared_signals`.
    """
    standard = np.zeros(len(model.columns))
    independent = list(observation.base.independent)
    standard[independent] = estimate.parameters[: len(independent)]
    body: FloatArray | None = None
    if data.payload is not None:
        identified = _identified_parameters(data.payload, observation, estimate)
        body = payload_parameters(data.payload, identified)
    standard = model.with_payload(standard, body)
    return declared_signals(model, data, standard, estimate.gains, session_began_s, inertia=inertia)


def _identified_parameters(
    payload: Payload, observation: Observation, estimate: Estimate
) -> dict[str, float]:
    """Parameters of a payload that an estimate has in its mounting, by their names."""
    identified: dict[str, float] = {}
    first = len(observation.columns)
    for other, indices in zip(observation.payloads, observation.payload_columns, strict=True):
        last = first + len(indices)
        if other.mounting == payload.mounting:
            values = estimate.parameters[first:last]
            names = [LINK_PARAMETERS[index] for index in indices]
            identified = dict(zip(names, values.tolist(), strict=True))
        first = last
    return identified


def declared_signals(
    model: Model,
    data: Dataset,
    standard: FloatArray,
    gains: FloatArray,
    session_began_s: float | None = None,
    *,
    inertia: bool = True,
) -> Signals:
    """Predict a run's torques with standard parameters.

    Args:
        model: the declared model.
        data: the run.
        standard: χ_st with the payload on the flange; base parameters at their leading columns,
            zero elsewhere, are as good as the true standard ones (paper §2.1). Shape (c,).
        gains: g of each motor [Nm at the joint per A], shape (n,).
        session_began_s: start of the first run by the clock of `Dataset.started_s`; None if
            unknown.
        inertia: whether the mass matrix is needed, by effects through the links.
    """
    # A base parameter is named after its leading standard one; Ia of J1, regrouped into Izz1, thus
    # counts as load until a loss shows how much it is (`ident.effects.rotor`).
    motion = data.motion()
    leverage = np.empty((0, 0, 0))
    load, geared, total = model.torques(motion, standard)
    position = motion.position_rad
    velocity = motion.velocity_rad_s
    acceleration = motion.acceleration_rad_s2
    if model.robot.undriven_names:
        followed = model.follow(motion)
        placed = model.at_places(followed)
        position = placed.position_rad
        velocity = placed.velocity_rad_s
        acceleration = placed.acceleration_rad_s2
        leverage = model.leverage(followed)
    motor_torque = model.drive_train.to_motor @ total
    motor_position = model.drive_train.ratio @ data.position_rad.T
    time_s = data.time_s - data.time_s[0]
    began_s = 0.0
    if data.started_s is not None and session_began_s is not None:
        began_s = max(0.0, data.started_s - session_began_s)
    joint_count = len(load)
    mass_matrix = np.empty((joint_count, joint_count, 0))
    if inertia:
        mass_matrix = _inertia_of_joints(model, data, standard)
    temperature_c = data.temperature_c
    if temperature_c is not None:
        temperature_c = temperature_c.T
    return Signals(
        rate_hz=data.rate_hz,
        time_s=time_s,
        session_s=time_s + began_s,
        position_rad=position.T,
        velocity_rad_s=velocity.T,
        acceleration_rad_s2=acceleration.T,
        motor_position_rad=motor_position,
        inertia_kg_m2=mass_matrix,
        load_torque_nm=load,
        geared_torque_nm=geared,
        motor_torque_nm=motor_torque,
        current_a=motor_torque / gains[:, None],
        temperature_c=temperature_c,
        leverage=leverage,
        arm=Arm(model, standard, motion),
    )


def session_began_s(datasets: Sequence[Dataset]) -> float | None:
    """Return the start of the earliest run; None if the runs have no common clock.

    Clocks that start with a run, or with a controller, show it: by them two runs of the robot
    overlap, or one is since 1970 and another is not.
    """
    spans_s: list[tuple[float, float]] = []
    for data in datasets:
        if data.started_s is None:
            return None
        length_s = data.time_s[-1] - data.time_s[0]
        spans_s.append((data.started_s, length_s))
    if not spans_s:
        return None
    spans_s.sort()
    first_s, _ = spans_s[0]
    last_s, _ = spans_s[-1]
    if last_s >= UNIX_S:
        # By the time of day, runs of a simulated cell may overlap: it moves faster than time.
        has_common_clock = first_s >= UNIX_S
    else:
        has_common_clock = not _overlap(spans_s)
    if not has_common_clock:
        return None
    return first_s


def _overlap(spans_s: Sequence[tuple[float, float]]) -> bool:
    """Whether one of some spans, (start, length) in order, goes on when the next begins."""
    for (start_s, length_s), (next_s, _) in pairwise(spans_s):
        if start_s + length_s > next_s:
            return True
    return False


def watched_s(runs: Sequence[Signals], *, whole_session: bool) -> float:
    """How long an effect that fades was watched: over the session, or the longest run [s]."""
    if not whole_session:
        return float(max(run.time_s[-1] for run in runs))
    began_s = min(run.session_s[0] for run in runs)
    ended_s = max(run.session_s[-1] for run in runs)
    return float(ended_s - began_s)


def _inertia_of_joints(model: Model, data: Dataset, standard: FloatArray) -> FloatArray:
    """Mass matrix of links and payload in some postures, shape (m, m, postures)."""
    samples = len(data.position_rad)
    count = max(2, samples // POSTURE_SAMPLES)
    postures = _postures(samples, count)
    return model.inertia(data.position_rad[postures], standard)


def _postures(samples: int, count: int) -> IntArray:
    """Index of so many samples spread evenly over a run."""
    places = np.linspace(0, samples - 1, count)
    return places.round().astype(np.int64)


def payload_parameters(payload: Payload | None, identified: Mapping[str, float]) -> FloatArray:
    """Return χ_kL and χ_uL of a payload in the order of LINK_PARAMETERS, shape (10,).

    They are zero without payload. Unknown parameters that are not identifiable in the data are
    missing in `identified`, and zero.
    """
    values: dict[str, float] = {}
    if payload is not None:
        values = {**payload.known, **identified}
    return np.array([values.get(name, 0.0) for name in LINK_PARAMETERS])


def curvature(value: FloatArray, rate_hz: float) -> FloatArray:
    """Second derivative in time by central differences, shape (k,)."""
    rate = np.gradient(value)
    return np.asarray(np.gradient(rate) * rate_hz**2)


def distance_since_reversal(
    velocity_rad_s: FloatArray, rate_hz: float
) -> tuple[FloatArray, FloatArray]:
    """Direction of the last motion and the distance moved in it [rad], shape (k,) each.

    The direction is 1 or −1, and 0 before any motion.
    """
    samples = np.arange(len(velocity_rad_s))
    speed = np.abs(velocity_rad_s)
    is_moving = speed > STICKING_RAD_S
    way_rad = np.cumsum(speed * is_moving) / rate_hz
    last_moving = np.maximum.accumulate(np.where(is_moving, samples, -1))
    last_direction = np.sign(velocity_rad_s[last_moving])
    direction = np.where(last_moving >= 0, last_direction, 0.0)
    has_turned = np.diff(direction, prepend=direction[:1]) != 0
    last_turn = np.maximum.accumulate(np.where(has_turned, samples, 0))
    return direction, way_rad - way_rad[last_turn]
