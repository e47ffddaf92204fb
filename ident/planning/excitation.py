"""Predicted information of an experiment about the drive gains (paper §2.3; optimal design).

With T from the drive train the fit's model is v_i = γ_i (T W χ + T W_uL χ_uL + T W_kL χ_kL)_i +
e_i, e_i of standard deviation σ_i, γ_i = 1/g_i (see ident/estimators/maximum_likelihood.py). Its
rows, differentiated by the unknowns and divided by σ_i, are

    ∂/∂χ = γ_i (T W)_i / σ_i,    ∂/∂χ_uL = γ_i (T W_uL)_i / σ_i,    ∂/∂ ln g_i = −γ_i (T τ)_i / σ_i,

with τ the total expected torque. The information about all unknowns is the sum of JᵀJ over the
rows, and the covariance of ln g the inverse of its Schur complement: the part of the gains' columns
that is independent of all others. The expectation before a fit is a nominal robot, made from the
URDF: good enough to choose moves, never to fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident.arrays import BoolArray, FloatArray
from ident.data.conditioning import Conditioning, current_rows
from ident.data.dataset import Dataset
from ident.equations.currents import whitening_transform
from ident.equations.rows import row_filter, row_masks
from ident.model.base import BaseParameters, base_parameters
from ident.model.bodies import LINK_PARAMETERS, Body, Payload, steiner
from ident.model.model import COUPLED_COLUMNS, JOINT_COLUMNS, Model, preload_directions
from ident.model.robot import Motion, Robot, each_state
from ident.model.urdf import read_urdf
from ident.planning.limits import JointLimits

IntArray = NDArray[np.intp]

UNSEEN_PERCENT = 10.0  #: Standard deviation above which the nameplate is the better source
UNSEEN = 1e-9  #: Share of a column that counts as nothing when the others are projected out of it
#: Of a gain in directions that nothing shows, up to which it is still identifiable
LARGEST_UNSEEN_SHARE = 1e-6
SMALLEST_PIVOT = 1e-5  #: Of a Cholesky factor whose digits are not rounding errors
#: Mass of each link where the URDF has no inertias, as a slender rod to the next joint
LINK_MASS_KG = 5.0
ROD_RADIUS_M = 0.05
STEEL_KG_M3 = 7850.0
DRY_FRICTION = 0.05
VISCOUS_FRICTION = 0.10
ROTOR = 0.03
"""Shares of a joint's torque limit: dry friction, viscous friction at its speed limit,
rotor at its acceleration limit; typical of geared arms (paper, Table 3).
"""
#: [Nm or N]; some exporters write 0, others 1e9 for an effort that is not known
LARGEST_EFFORT = 1e6
NOISE_SHARE = 0.006
"""Standard deviation of a row's residual, as a share of the motor's current at its torque limit:
some 4 % of the rms current of a lively plan, which is what a good fit leaves
(docs/evidence/estimators.md).
"""
LAG_ONE = 0.67  #: Correlation of the residual from row to row, as measured on real recordings
RATE_HZ = 1000.0  #: Sampling rate that the rows are predicted for
TORQUE_RESERVE = 3.0  #: Torque limit over the largest rigid-body torque, where the URDF gives none


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedPayload:
    """Expected payload on one mounting."""

    known: frozenset[str]  #: names of its known LINK_PARAMETERS; the others are unknowns of the fit
    parameters: FloatArray  #: all ten, guessed or estimated where they are not known, shape (10,)

    @property
    def unknown(self) -> tuple[int, ...]:
        """Indices of unknown parameters in LINK_PARAMETERS."""
        return tuple(index for index, name in enumerate(LINK_PARAMETERS) if name not in self.known)


@dataclass(frozen=True, slots=True, eq=False)
class Expectation:
    """Expected robot: nominal before a fit, estimated after it."""

    model: Model  #: the declared model
    #: joint drive gains [Nm or N per unit of the current reference], signed, shape (n,)
    gains: FloatArray
    #: Of the model's standard columns, shape (c,); an estimate of base parameters is placed at its
    #: leading columns, with zeros elsewhere.
    parameters: FloatArray
    payloads: tuple[ExpectedPayload, ...]  #: the mountings
    #: Standard deviation of one row of each motor in the unit of its current reference, with
    #: correlation (``effective_noise``), shape (n,).
    noise_a: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Excitation:
    """Rows of a motion, for any payload."""

    motion: Motion  #: of the n joints at the centres of k rows
    #: rows of each motor that count, shape (n, k); standstill does not (see
    #: ident/equations/rows.py)
    use: BoolArray


def recorded(model: Model, data: Dataset, conditioning: Conditioning) -> Excitation:
    """Return the rows of a recorded run:
    its motion at their centres, and which of them the fit uses.
    """
    filter_ = row_filter(data, conditioning)
    centres = filter_.centres(len(data.time_s))
    motion = each_state(data.motion(), lambda states: states[centres])
    _, motor_use = row_masks(model, data, conditioning)
    return Excitation(motion, motor_use)


def effective_noise(noise_a: FloatArray, lag_one: float) -> FloatArray:
    """Standard deviation of independent rows with as much information as these correlated ones.

    Slow signals lose most: their mean over a stretch has (1 + ρ)/(1 − ρ) times the variance of
    independent rows (first-order autoregression). Faster motion loses less, so this is on the safe
    side.

    Args:
        noise_a: standard deviation of one row.
        lag_one: correlation ρ of a row's residual with the next, from 0 up to below 1.
    """
    variance_factor = (1.0 + lag_one) / (1.0 - lag_one)
    return np.asarray(noise_a * np.sqrt(variance_factor))


def visible_base(model: Model, motion: Motion) -> BaseParameters:
    """Return the base parameters that are identifiable from a motion."""
    # The dry friction of a joint at rest is undetermined (see the standstill mask).
    is_moving = motion.velocity_rad_s.T != 0.0
    columns = model.regressor(motion) * is_moving[:, None, :]
    rows = columns.transpose(0, 2, 1).reshape(-1, columns.shape[1])
    triangle = np.asarray(np.linalg.qr(rows, mode="r"))
    names = tuple(column.name for column in model.columns)
    return base_parameters(triangle, names)


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """The unknowns of an experiment, and the information that excitations give about them.

    The unknowns are, in this order, base parameters, unknown parameters of each mounting, ln of the
    gains.
    """

    expectation: Expectation  #: the expected robot
    base: BaseParameters  #: its base parameters

    @property
    def others(self) -> int:
        """Number of unknowns that are not gains."""
        of_payloads = sum(len(payload.unknown) for payload in self.expectation.payloads)
        return len(self.base.independent) + of_payloads

    @property
    def width(self) -> int:
        """Number of columns of base parameters and of a payload."""
        return len(self.base.independent) + len(LINK_PARAMETERS)

    @property
    def size(self) -> int:
        """Number of all unknowns."""
        return self.others + len(self.expectation.gains)

    def whitened(self, excitation: Excitation) -> FloatArray:
        """γ_i (T W)_i / σ_i of base columns and the ten of a payload, shape (n, b + 10, k);
        masked rows are zero.

        Of a redundant drive more columns, for `information_of`.
        """
        expected = self.expectation
        model = expected.model
        flange = np.arange(model.flange.start, model.flange.stop)
        chosen = np.concatenate((self.base.independent, flange)).astype(np.intp)
        # What a payload adds to friction has columns here, and none in the runs without one
        # (`columns`).
        columns = model.regressor(excitation.motion, loaded=True)[:, chosen]
        motors = np.tensordot(model.drive_train.to_motor, columns, axes=1)
        if model.is_redundant:
            return self._without_preload(excitation, motors)
        unit = expected.gains * expected.noise_a
        weight = excitation.use[:, None, :] / unit[:, None, None]
        motors *= weight
        return np.asarray(motors)

    def _without_preload(self, excitation: Excitation, torque: FloatArray) -> FloatArray:
        """Whitened columns of a redundant drive, its torques and gains, (n, 2 (b + 10) + n, k).

        The currents that are expected are those without preload: with it, gains become better
        known, not worse.
        """
        expected = self.expectation
        _, to_motors = expected.model.balance(excitation.motion)
        preload = preload_directions(to_motors)
        transform = whitening_transform(preload, expected.gains, expected.noise_a)
        all_move = np.all(excitation.use, axis=0).astype(np.float64)
        transform *= all_move[:, None, None]
        # Σ_j (T_D)_kij τ_jak of motor i, column a and row k
        columns = np.einsum("kij,jak->iak", transform, torque, optimize=True)
        of_gains = transform.transpose(1, 2, 0)
        return np.concatenate((columns, torque, of_gains), axis=1)

    def with_known_preload(self, whitened: FloatArray, use: BoolArray) -> FloatArray:
        """``whitened`` of a redundant drive with known preload, (n, b + 10, k).

        It has an equation for each motor.
        """
        expected = self.expectation
        all_move = np.all(use, axis=0)
        of_torque = slice(self.width, 2 * self.width)
        torque = whitened[:, of_torque] * all_move
        unit = expected.gains * expected.noise_a
        return np.asarray(torque / unit[:, None, None])

    def information(self, excitation: Excitation, payloads: Sequence[int | None]) -> FloatArray:
        """Information of one motion, repeated once with each of these payloads, shape (p, p)."""
        return self.information_of(self.whitened(excitation), payloads)

    def information_of(
        self, whitened: FloatArray, payloads: Sequence[int | None], blind: int | None = None
    ) -> FloatArray:
        """Information from ``whitened`` columns, shape (p, p).

        Args:
            whitened: shape (n, b + 10, k).
            payloads: the mounted payload of each repetition.
            blind: motor whose own gain column omits the known part of the payload's torque, so that
                only coupling with the other axes identifies it.
        """
        if whitened.shape[1] > self.width:
            return self._information_without_preload(whitened, payloads, blind)
        grams = whitened @ whitened.transpose(0, 2, 1)
        summed = grams.sum(axis=0)
        others = self.others
        out = np.zeros((self.size, self.size))
        gains = np.arange(others, self.size)
        for payload in payloads:
            unknowns, source = self.columns(payload)
            of_unknowns = np.ix_(unknowns, unknowns)
            with_gains = np.ix_(unknowns, gains)
            out[of_unknowns] += summed[np.ix_(source, source)]
            parameters = np.tile(self.expected(payload), (len(grams), 1))
            if blind is not None and payload is not None:
                parameters[blind] -= self.known(payload)
            products = np.einsum("nab,nb->na", grams, parameters)  # Wᵀ τ of each motor
            out[with_gains] -= products[:, source].T
            out[gains, gains] += np.einsum("na,na->n", products, parameters)  # τᵀ τ
        out[others:, :others] = out[:others, others:].T
        return out

    def _information_without_preload(
        self, whitened: FloatArray, payloads: Sequence[int | None], blind: int | None
    ) -> FloatArray:
        """The same of a redundant drive, where a gain shows in the rows of all motors."""
        columns, torques, gains = np.split(whitened, [self.width, 2 * self.width], axis=1)
        # JᵀJ: sums over motors n and rows k
        summed = np.einsum("nak,nbk->ab", columns, columns, optimize=True)
        others = self.others
        out = np.zeros((self.size, self.size))
        of_gains = slice(others, None)
        for payload in payloads:
            unknowns, source = self.columns(payload)
            of_unknowns = np.ix_(unknowns, unknowns)
            out[of_unknowns] += summed[np.ix_(source, source)]
            torque = np.einsum("nck,c->nk", torques, self.expected(payload))
            if blind is not None and payload is not None:
                torque[blind] -= self.known(payload) @ torques[blind]
            gain_columns = gains * torque
            own_columns = columns[:, source]
            # Sums over motors n and rows k, as above
            mixed = np.einsum("nak,njk->aj", own_columns, gain_columns, optimize=True)
            squares = np.einsum("nik,njk->ij", gain_columns, gain_columns, optimize=True)
            out[unknowns, of_gains] -= mixed
            out[of_gains, of_gains] += squares
        out[others:, :others] = out[:others, others:].T
        return out

    def expected(self, payload: int | None) -> FloatArray:
        """Parameters with which the columns of ``whitened`` give the total torque, (b + 10,)."""
        base = self.base.grouping @ self.expectation.parameters
        mounted = np.zeros(len(LINK_PARAMETERS))
        if payload is not None:
            mounted = self.expectation.payloads[payload].parameters
        return np.concatenate((base, mounted))

    def known(self, payload: int) -> FloatArray:
        """Known part of ``expected`` for a payload, shape (b + 10,)."""
        expected = self.expectation.payloads[payload]
        mounted = expected.parameters.copy()
        mounted[list(expected.unknown)] = 0.0
        base = np.zeros(len(self.base.independent))
        return np.concatenate((base, mounted))

    def columns(self, payload: int | None) -> tuple[IntArray, IntArray]:
        """Unknowns of a run, and the columns of ``whitened`` that they belong to."""
        base = self.base.independent
        if payload is None:
            is_payload_friction = self._is_payload_friction()
            bare = np.flatnonzero(~is_payload_friction)
            return bare, bare
        payloads = self.expectation.payloads
        unknown = payloads[payload].unknown
        first = len(base)
        for other in payloads[:payload]:
            first += len(other.unknown)
        of_base = np.arange(len(base))
        payload_unknowns = np.arange(first, first + len(unknown))
        payload_columns = len(base) + np.array(unknown, dtype=np.intp)
        unknowns = np.concatenate((of_base, payload_unknowns))
        columns = np.concatenate((of_base, payload_columns))
        return unknowns, columns

    def _is_payload_friction(self) -> BoolArray:
        """Whether a base parameter is what a payload adds to friction, shape (b,)."""
        payload_friction = self.expectation.model.loaded_friction_columns
        return np.isin(self.base.independent, payload_friction)

    def condition(self, information: FloatArray) -> float:
        """Condition number of W, rows weighted by their noise, from the information, shape (u, u).

        It is inf for a column without rows.

        What a payload adds to friction is left out: in bare or in loaded runs alone it is no
        separate unknown.
        """
        chosen = np.flatnonzero(~self._is_payload_friction())
        values = np.linalg.eigvalsh(information[np.ix_(chosen, chosen)])
        smallest = values[0]
        largest = values[-1]
        if smallest > 0.0:
            return float(np.sqrt(largest / smallest))
        return float("inf")

    def std_percent(self, information: FloatArray) -> FloatArray:
        """Predicted standard deviation of each gain, shape (n,) [% of it];
        inf where it is not identifiable.
        """
        scaled, scale = self._scaled(information)
        factor = self._factor_of_gains(scaled)
        if factor is None:
            return self._std_of_singular(scaled) / scale
        inverse = np.linalg.inv(factor)
        variance = np.einsum("ij,ij->j", inverse, inverse)  # diagonal of L⁻ᵀ L⁻¹
        return np.asarray(100.0 * np.sqrt(variance) / scale)

    def rank(self, information: FloatArray) -> int:
        """How many of the n independent directions of ln g are known to UNSEEN_PERCENT by the
        information, shape (u, u).

        They are the eigenvectors of its covariance, of unit length: their errors are independent of
            each other.
        """
        scaled, scale = self._scaled(information)
        factor = self._factor_of_gains(scaled)
        if factor is None:
            of_gains = self._gains_alone(scaled)
        else:
            of_gains = factor @ factor.T
        values = np.linalg.eigvalsh(of_gains * np.outer(scale, scale))
        least = (100.0 / UNSEEN_PERCENT) ** 2
        return int(np.sum(values >= least))

    def _scaled(self, information: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Information with ones on its diagonal, and the scale of the gains."""
        scale = np.sqrt(np.diag(information))
        scale[scale == 0.0] = 1.0
        return information / np.outer(scale, scale), scale[self.others :]

    def _factor_of_gains(self, scaled: FloatArray) -> FloatArray | None:
        """Cholesky factor of the information about the gains alone;
        None where rounding would decide.
        """
        try:
            factor = np.linalg.cholesky(scaled)
        except np.linalg.LinAlgError:
            return None
        if float(np.diag(factor).min()) < SMALLEST_PIVOT:
            return None
        gains = slice(self.others, self.size)
        return np.asarray(factor[gains, gains])

    def _gains_alone(self, scaled: FloatArray) -> FloatArray:
        """Information about the gains alone, (n, n); other unknowns that are not seen drop out."""
        others = slice(None, self.others)
        gains = slice(self.others, None)
        values, vectors = np.linalg.eigh(scaled[others, others])
        is_seen = values > UNSEEN * values[-1]
        seen = vectors[:, is_seen]
        projected = seen.T @ scaled[others, gains]
        explained = projected.T @ (projected / values[is_seen, None])
        return np.asarray(scaled[gains, gains] - explained)

    def _std_of_singular(self, scaled: FloatArray) -> FloatArray:
        """Predict without unknowns that are not seen; gains that depend on them are inf."""
        values, directions = np.linalg.eigh(self._gains_alone(scaled))
        squares = directions**2
        is_seen = values > UNSEEN
        variance = squares[:, is_seen] @ (1.0 / values[is_seen])
        unseen_share = squares[:, ~is_seen].sum(axis=1)
        variance[unseen_share > LARGEST_UNSEEN_SHARE] = np.inf
        return np.asarray(100.0 * np.sqrt(variance))


def rows_between_rests(conditioning: Conditioning) -> tuple[float, float]:
    """Return the time between two rows of a fit, and how long after a rest rows begin to count [s].

    A row counts when its filter window is so far from a standstill that enough of its weight is
    outside.
    """
    filter_ = current_rows(RATE_HZ, conditioning)
    weights = np.abs(filter_.taps)
    share = np.cumsum(weights) / weights.sum()
    at_rest = int(np.searchsorted(share, conditioning.standstill_share))
    edge = max(filter_.half - at_rest, 0)
    return filter_.factor / RATE_HZ, edge / RATE_HZ


def nominal_expectation(
    model: Model,
    urdf: str | None,
    gains: FloatArray,
    payload: ExpectedPayload,
    limits: JointLimits,
    fast_motion: Motion,
) -> tuple[Expectation, bool]:
    """Return the robot expected before a fit, and whether the URDF has the masses of its links.

    Args:
        model: the declared model.
        urdf: text of the URDF; None where there is none.
        gains: by the data sheet, shape (n,).
        payload: that will be mounted.
        limits: of the joints.
        fast_motion: motion as fast as the limits allow.
    """
    links, from_urdf = nominal_links(model.robot, urdf)
    loaded = links.copy()
    loaded[model.robot.carrier] += payload.parameters
    torque = nominal_torque_limits(model, urdf, loaded, fast_motion)
    parameters = nominal_parameters(model, links, torque, limits.velocity, limits.acceleration)
    at_motors = np.abs(model.drive_train.to_motor) * torque
    motor_torque = at_motors.max(axis=1)
    noise = NOISE_SHARE * motor_torque / np.abs(gains)
    expectation = Expectation(
        model=model,
        gains=gains,
        parameters=parameters,
        payloads=(payload,),
        noise_a=effective_noise(noise, LAG_ONE),
    )
    return expectation, from_urdf


def nominal_links(robot: Robot, urdf: str | None) -> tuple[FloatArray, bool]:
    """Return inertial parameters of links, (n, 10), and whether the URDF has them; else rods."""
    if urdf is not None:
        bodies = read_urdf(urdf).bodies
        if any(body.mass_kg > 0.0 for body in bodies):
            return np.array([body.parameters for body in bodies]), True
    links: list[FloatArray] = []
    for index, own in enumerate(robot.joints):
        offsets = [joint.translation_m for joint in robot.joints if joint.parent == index]
        rod_m = 0.1 * own.axis
        if offsets:
            rod_m = offsets[0]
        links.append(_rod(rod_m).parameters)
    return np.array(links), False


def _rod(rod_m: FloatArray) -> Body:
    """A rod of LINK_MASS_KG from the origin to a point."""
    # m/12 (‖r‖² 1 − r rᵀ), and m R²/2 for its radius R
    slender = LINK_MASS_KG / 12.0 * steiner(rod_m)
    thick = 0.5 * LINK_MASS_KG * ROD_RADIUS_M**2 * np.eye(3)
    return Body(LINK_MASS_KG, 0.5 * rod_m, slender + thick)


def side_of_cube(mass_kg: float) -> float:
    """Side of a cube of steel [m]."""
    return float((mass_kg / STEEL_KG_M3) ** (1.0 / 3.0))


def nominal_payload(robot: Robot, payload: Payload) -> ExpectedPayload:
    """Return a steel cube of the weighed mass, one side away from its mounting.

    Known parameters stay. It is off the axis of the joint that carries it, as the technician is
    asked to mount it: on the axis, gravity would have no lever.
    """
    mass = payload.known.get("m", LINK_MASS_KG)
    side = side_of_cube(mass)
    axis = robot.joints[robot.carrier].axis
    most_across = np.eye(3)[np.argmin(np.abs(axis))]
    across = np.cross(axis, most_across)
    across /= np.linalg.norm(across)
    third = np.cross(axis, across)
    direction = axis + 0.7 * across + 0.7 * third
    centre = robot.mounting_m + side * direction
    inertia = mass * side**2 / 6.0 * np.eye(3)
    cube = Body(mass, centre, inertia)
    parameters: list[float] = []
    for name, guess in zip(LINK_PARAMETERS, cube.parameters, strict=True):
        parameters.append(payload.known.get(name, guess))
    return ExpectedPayload(frozenset(payload.known), np.array(parameters))


def declared_efforts(model: Model, urdf: str | None) -> FloatArray:
    """Return the effort limit of each axis in the URDF [Nm or N], (n,); inf where unknown."""
    if urdf is None:
        return np.full(model.robot.axis_count, np.inf)
    declared = read_urdf(urdf).effort_limit[list(model.robot.axis_joints)]
    is_known = (declared > 0.0) & (declared < LARGEST_EFFORT)
    return np.where(is_known, declared, np.inf)


def nominal_torque_limits(
    model: Model, urdf: str | None, links: FloatArray, fast_motion: Motion
) -> FloatArray:
    """Return the URDF's effort limits, else TORQUE_RESERVE times the rigid-body torque, (n,).

    In Nm or N.

    Args:
        model, urdf: the declared model and the text of the URDF.
        links: inertial parameters with the payload on the last one, shape (n, 10).
        fast_motion: motion as fast as the limits allow.
    """
    columns = model.regressor(fast_motion)
    rigid = columns[:, model.link_columns.ravel()]
    torque = np.einsum("jck,c->jk", rigid, links.reshape(-1))
    largest = np.abs(torque).max(axis=1)
    declared = declared_efforts(model, urdf)
    with_reserve = TORQUE_RESERVE * np.maximum(largest, 1e-3)
    return np.where(np.isfinite(declared), declared, with_reserve)


def nominal_parameters(
    model: Model,
    links: FloatArray,
    torque_limit: FloatArray,
    velocity_limit: FloatArray,
    acceleration_limit: FloatArray,
) -> FloatArray:
    """Return standard parameters of links, (n, 10), and of drives with these limits, (c,)."""
    parameters = np.zeros(len(model.columns))
    parameters[model.link_columns] = links
    parameters[model.rotor_columns] = ROTOR * torque_limit / acceleration_limit
    parameters[model.viscous_friction_columns] = VISCOUS_FRICTION * torque_limit / velocity_limit
    parameters[model.dry_friction_columns] = DRY_FRICTION * torque_limit
    for number, motor in enumerate(model.drive_train.coupled):
        # Ia, fv and fs of the motor's joint stand for Iam, fvm and fsm.
        first = JOINT_COLUMNS * len(links) + COUPLED_COLUMNS * number
        rotor = model.rotor_columns[motor]
        of_joint = parameters[rotor : rotor + COUPLED_COLUMNS]
        parameters[first : first + COUPLED_COLUMNS] = of_joint
    return parameters
