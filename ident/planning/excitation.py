"""Predicted information of an experiment about the drive gains (paper §2.3; optimal design).

With T from the drive train the fit's model is v_i = γ_i (T W χ + T W_uL χ_uL + T W_kL χ_kL)_i +
e_i, e_i of standard deviation σ_i, γ_i = 1/g_i (see ident/estimators/maximum_likelihood.py). Its
rows, differentiated by the unknowns and divided by σ_i, are

    ∂/∂χ = γ_i (T W)_i / σ_i,      ∂/∂χ_uL = γ_i (T W_uL)_i / σ_i,      ∂/∂ ln g_i = −γ_i (T τ)_i / σ_i,

with τ the whole expected torque. The information about all unknowns is the sum of JᵀJ over the
rows, and the covariance of ln g the inverse of its Schur complement: the part of the gains' columns
that is independent of all others. The expectation before a fit is a nominal robot, made from the
URDF: good enough to choose moves, never to fit.
"""  # noqa: E501

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ident.arrays import BoolArray, FloatArray
from ident.data.conditioning import Conditioning, decimator
from ident.data.dataset import Dataset
from ident.equations.currents import whitening_transform
from ident.equations.rows import row_filter, row_masks
from ident.model.base import BaseParameters, base_parameters
from ident.model.bodies import LINK_PARAMETERS, Body, Payload
from ident.model.model import Model, preload_directions
from ident.model.robot import Motion, Robot
from ident.model.urdf import read_urdf
from ident.planning.limits import JointLimits

IntArray = NDArray[np.intp]

UNSEEN_PERCENT = 10.0  #: Standard deviation above which the nameplate is the better source
UNSEEN = 1e-9  #: Share of a column that counts as nothing when the others are projected out of it
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
    centres = row_filter(data, conditioning).centres(len(data.time_s))
    motion = Motion(
        data.position_rad[centres], data.velocity_rad_s[centres], data.acceleration_rad_s2[centres]
    )
    return Excitation(motion, row_masks(model, data, conditioning)[1])


def effective_noise(noise_a: FloatArray, lag_one: float) -> FloatArray:
    """Standard deviation of independent rows with as much information as these correlated ones.

    Slow signals lose most: their mean over a stretch has (1 + ρ)/(1 − ρ) times the variance of
    independent rows (first-order autoregression). Faster motion loses less, so this is on the safe
    side.

    Args:
        noise_a: standard deviation of one row.
        lag_one: correlation ρ of a row's residual with the next, from 0 up to below 1.
    """
    return np.asarray(noise_a * np.sqrt((1.0 + lag_one) / (1.0 - lag_one)))


def visible_base(model: Model, motion: Motion) -> BaseParameters:
    """Return the base parameters that are identifiable from a motion."""
    # The dry friction of a joint at rest is undetermined (see the standstill mask).
    columns = model.regressor(motion) * (motion.velocity_rad_s.T != 0.0)[:, None, :]
    rows = columns.transpose(0, 2, 1).reshape(-1, columns.shape[1])
    triangle = np.asarray(np.linalg.qr(rows, mode="r"))
    return base_parameters(triangle, tuple(column.name for column in model.columns))


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
        return len(self.base.independent) + sum(
            len(payload.unknown) for payload in self.expectation.payloads
        )

    @property
    def width(self) -> int:
        """Number of columns of base parameters and of a payload."""
        return len(self.base.independent) + 10

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
        flange = np.arange(expected.model.flange.start, expected.model.flange.stop)
        # What a payload adds to friction has columns here, and none in the runs without one
        # (`columns`).
        columns = expected.model.regressor(excitation.motion, loaded=True)[
            :, np.concatenate((self.base.independent, flange)).astype(np.intp)
        ]
        motors = np.tensordot(expected.model.drive_train.to_motor, columns, axes=1)
        if expected.model.is_redundant:
            return self._without_preload(excitation, motors)
        motors *= excitation.use[:, None, :] / (expected.gains * expected.noise_a)[:, None, None]
        return np.asarray(motors)

    def _without_preload(self, excitation: Excitation, torque: FloatArray) -> FloatArray:
        """Whitened columns of a redundant drive, its torques, and its gains, shape (n, 2 (b + 10)
        + n, k).

        The currents that are expected are those without preload: with it, gains become better
        known, not worse.
        """
        expected = self.expectation
        _, to_motors = expected.model.balance(excitation.motion)
        transform = whitening_transform(
            preload_directions(to_motors), expected.gains, expected.noise_a
        )
        transform *= np.all(excitation.use, axis=0).astype(np.float64)[:, None, None]
        columns = np.einsum("kij,jak->iak", transform, torque, optimize=True)
        return np.concatenate((columns, torque, transform.transpose(1, 2, 0)), axis=1)

    def with_known_preload(self, whitened: FloatArray, use: BoolArray) -> FloatArray:
        """``whitened`` of a redundant drive if its preload were known:
        an equation for each motor, (n, b + 10, k).
        """
        expected = self.expectation
        torque = whitened[:, self.width : 2 * self.width] * np.all(use, axis=0)
        return np.asarray(torque / (expected.gains * expected.noise_a)[:, None, None])

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
        out = np.zeros((self.size, self.size))
        gains = np.arange(self.others, self.size)
        for payload in payloads:
            place, source = self.columns(payload)
            out[np.ix_(place, place)] += summed[np.ix_(source, source)]
            torque = np.tile(self.expected(payload), (len(grams), 1))
            if blind is not None and payload is not None:
                torque[blind] -= self.known(payload)
            seen = np.einsum("nab,nb->na", grams, torque)
            out[np.ix_(place, gains)] -= seen[:, source].T
            out[gains, gains] += np.einsum("na,na->n", seen, torque)
        out[self.others :, : self.others] = out[: self.others, self.others :].T
        return out

    def _information_without_preload(
        self, whitened: FloatArray, payloads: Sequence[int | None], blind: int | None
    ) -> FloatArray:
        """The same of a redundant drive, where a gain shows in the rows of all motors."""
        columns, torques, gains = np.split(whitened, [self.width, 2 * self.width], axis=1)
        summed = np.einsum("nak,nbk->ab", columns, columns, optimize=True)
        out = np.zeros((self.size, self.size))
        own = slice(self.others, None)
        for payload in payloads:
            place, source = self.columns(payload)
            out[np.ix_(place, place)] += summed[np.ix_(source, source)]
            torque = np.einsum("nck,c->nk", torques, self.expected(payload))
            if blind is not None and payload is not None:
                torque[blind] -= self.known(payload) @ torques[blind]
            shown = gains * torque
            out[place, own] -= np.einsum("nak,njk->aj", columns[:, source], shown, optimize=True)
            out[own, own] += np.einsum("nik,njk->ij", shown, shown, optimize=True)
        out[self.others :, : self.others] = out[: self.others, self.others :].T
        return out

    def expected(self, payload: int | None) -> FloatArray:
        """Parameters for which the columns of ``whitened`` give the whole torque,
        shape (b + 10,).
        """
        base = self.base.grouping @ self.expectation.parameters
        if payload is None:
            mounted = np.zeros(10)
        else:
            mounted = self.expectation.payloads[payload].parameters
        return np.concatenate((base, mounted))

    def known(self, payload: int) -> FloatArray:
        """Known part of ``expected`` for a payload, shape (b + 10,)."""
        mounted = self.expectation.payloads[payload].parameters.copy()
        mounted[list(self.expectation.payloads[payload].unknown)] = 0.0
        return np.concatenate((np.zeros(len(self.base.independent)), mounted))

    def columns(self, payload: int | None) -> tuple[IntArray, IntArray]:
        """Unknowns of a run, and the columns of ``whitened`` that they belong to."""
        base = len(self.base.independent)
        place = list(range(base))
        if payload is None:
            payload_friction = set(self.expectation.model.loaded_friction_columns.tolist())
            place = [
                index for index in place if self.base.independent[index] not in payload_friction
            ]
        source = list(place)
        if payload is not None:
            unknown = self.expectation.payloads[payload].unknown
            before = sum(len(other.unknown) for other in self.expectation.payloads[:payload])
            place += range(base + before, base + before + len(unknown))
            source += [base + index for index in unknown]
        return np.array(place, dtype=np.intp), np.array(source, dtype=np.intp)

    def condition(self, information: FloatArray) -> float:
        """Condition number of the observation matrix W, rows weighted by their noise;
        inf for a column without rows.

        What a payload adds to friction is left out: in bare or in loaded runs alone it is no
        unknown of its own.
        """
        payload_friction = self.expectation.model.loaded_friction_columns
        asked = np.flatnonzero(~np.isin(self.base.independent, payload_friction))
        values = np.linalg.eigvalsh(information[np.ix_(asked, asked)])
        if values[0] > 0.0:
            return float(np.sqrt(values[-1] / values[0]))
        return float("inf")

    def std_percent(self, information: FloatArray) -> FloatArray:
        """Predicted standard deviation of each gain, shape (n,) [% of it];
        inf where it is not identifiable.
        """
        scaled, scale = self._scaled(information)
        last = self._factor_of_gains(scaled)
        if last is None:
            return self._std_of_singular(scaled) / scale
        inverse = np.linalg.inv(last)
        return np.asarray(100.0 * np.sqrt(np.einsum("ij,ij->j", inverse, inverse)) / scale)

    def rank(self, information: FloatArray) -> int:
        """How many of the n independent directions of ln g are known to UNSEEN_PERCENT.

        They are the eigenvectors of its covariance, of unit length: their errors are independent of
        each other.
        """
        scaled, scale = self._scaled(information)
        last = self._factor_of_gains(scaled)
        if last is None:
            alone = self._gains_alone(scaled)
        else:
            alone = last @ last.T
        return int(
            np.sum(
                np.linalg.eigvalsh(alone * np.outer(scale, scale)) >= (100.0 / UNSEEN_PERCENT) ** 2
            )
        )

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
        gains = slice(self.others, self.size)
        if float(np.diag(factor).min()) < 1e-5:
            return None
        return np.asarray(factor[gains, gains])

    def _gains_alone(self, scaled: FloatArray) -> FloatArray:
        """Information about the gains alone, shape (n, n);
        other unknowns that are not identifiable drop out.
        """
        others = slice(None, self.others)
        gains = slice(self.others, None)
        values, vectors = np.linalg.eigh(scaled[others, others])
        kept = values > UNSEEN * values[-1]
        onto = vectors[:, kept].T @ scaled[others, gains]
        return np.asarray(scaled[gains, gains] - onto.T @ (onto / values[kept, None]))

    def _std_of_singular(self, scaled: FloatArray) -> FloatArray:
        """Predict with unknowns that are not identifiable:
        they drop out, and gains that depend on them are inf.
        """
        left, directions = np.linalg.eigh(self._gains_alone(scaled))
        seen = left > UNSEEN
        variance = (directions[:, seen] ** 2) @ (1.0 / left[seen])
        variance[(directions[:, ~seen] ** 2).sum(axis=1) > 1e-6] = np.inf
        return np.asarray(100.0 * np.sqrt(variance))


def rows_between_rests(conditioning: Conditioning) -> tuple[float, float]:
    """Return the time between two rows of a fit, and how long after a rest rows begin to count [s].

    A row counts when its filter window is so far from a standstill that enough of its weight is
    outside.
    """
    filter_ = decimator(RATE_HZ, conditioning.decimation_cutoff_hz)
    weight = np.cumsum(np.abs(filter_.taps)) / np.abs(filter_.taps).sum()
    inside = int(np.searchsorted(weight, conditioning.standstill_share))
    return filter_.factor / RATE_HZ, max(filter_.half - inside, 0) / RATE_HZ


def nominal_expectation(
    model: Model,
    urdf: str | None,
    gains: FloatArray,
    payload: ExpectedPayload,
    limits: JointLimits,
    fast_motion: Motion,
) -> tuple[Expectation, bool]:
    """Return the robot that is expected before a fit,
    and whether the URDF contains the masses of its links.

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
    noise = NOISE_SHARE * (np.abs(model.drive_train.to_motor) * torque).max(axis=1) / np.abs(gains)
    expectation = Expectation(
        model=model,
        gains=gains,
        parameters=nominal_parameters(model, links, torque, limits.velocity, limits.acceleration),
        payloads=(payload,),
        noise_a=effective_noise(noise, LAG_ONE),
    )
    return expectation, from_urdf


def nominal_links(robot: Robot, urdf: str | None) -> tuple[FloatArray, bool]:
    """Return inertial parameters of the links, shape (n, 10), and whether the URDF contains them;
    else rods.
    """
    bodies = () if urdf is None else read_urdf(urdf).bodies
    if any(body.mass_kg > 0.0 for body in bodies):
        return np.array([body.parameters for body in bodies]), True
    links = []
    for index in range(robot.joint_count):
        offsets = [joint.translation_m for joint in robot.joints if joint.parent == index]
        rod = offsets[0] if offsets else 0.1 * robot.joints[index].axis
        slender = LINK_MASS_KG / 12.0 * (rod @ rod * np.eye(3) - np.outer(rod, rod))
        thick = 0.5 * LINK_MASS_KG * ROD_RADIUS_M**2 * np.eye(3)
        links.append(Body(LINK_MASS_KG, 0.5 * rod, slender + thick).parameters)
    return np.array(links), False


def side_of_cube(mass_kg: float) -> float:
    """Side of a cube of steel [m]."""
    return float((mass_kg / STEEL_KG_M3) ** (1.0 / 3.0))


def nominal_payload(robot: Robot, payload: Payload) -> ExpectedPayload:
    """Return a steel cube of the weighed mass, one side away from where it is mounted;
    known parameters are kept.

    It is off the axis of the joint that carries it, as the technician is asked to mount it: on the
    axis, gravity would have no lever.
    """
    mass = payload.known.get("m", LINK_MASS_KG)
    side = side_of_cube(mass)
    axis = robot.joints[robot.carrier].axis
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    across /= np.linalg.norm(across)
    centre = robot.mounting_m + side * (axis + 0.7 * across + 0.7 * np.cross(axis, across))
    cube = Body(mass, centre, mass * side**2 / 6.0 * np.eye(3))
    guess = dict(zip(LINK_PARAMETERS, cube.parameters, strict=True))
    parameters = np.array([payload.known.get(name, guess[name]) for name in LINK_PARAMETERS])
    return ExpectedPayload(frozenset(payload.known), parameters)


def declared_efforts(model: Model, urdf: str | None) -> FloatArray:
    """Return the effort limit of each axis in the URDF [Nm or N], shape (n,);
    inf where it is not known.
    """
    if urdf is None:
        return np.full(model.robot.axis_count, np.inf)
    declared = read_urdf(urdf).effort_limit[list(model.robot.axis_joints)]
    is_known = (declared > 0.0) & (declared < LARGEST_EFFORT)
    return np.where(is_known, declared, np.inf)


def nominal_torque_limits(
    model: Model, urdf: str | None, links: FloatArray, fast_motion: Motion
) -> FloatArray:
    """Return the URDF's effort limits [Nm or N], else TORQUE_RESERVE times the rigid-body torque,
    shape (n,).

    Args:
        model, urdf: the declared model and the text of the URDF.
        links: inertial parameters with the payload on the last one, shape (n, 10).
        fast_motion: motion as fast as the limits allow.
    """
    columns = model.regressor(fast_motion)
    rigid = np.concatenate(
        [columns[:, 14 * index : 14 * index + 10] for index in range(len(links))], axis=1
    )
    largest = np.abs(np.einsum("jck,c->jk", rigid, links.reshape(-1))).max(axis=1)
    declared = declared_efforts(model, urdf)
    return np.where(np.isfinite(declared), declared, TORQUE_RESERVE * np.maximum(largest, 1e-3))


def nominal_parameters(
    model: Model,
    links: FloatArray,
    torque_limit: FloatArray,
    velocity_limit: FloatArray,
    acceleration_limit: FloatArray,
) -> FloatArray:
    """Return standard parameters of links, shape (n, 10),
    and of drives with these limits of the joints, shape (c,).
    """
    parameters = np.zeros(len(model.columns))
    joints = model.robot.axis_joints
    for index, link in enumerate(links):
        parameters[14 * index : 14 * index + 10] = link
    for index, joint in enumerate(joints):
        first = 14 * joint
        parameters[first + 10] = ROTOR * torque_limit[index] / acceleration_limit[index]
        parameters[first + 11] = VISCOUS_FRICTION * torque_limit[index] / velocity_limit[index]
        parameters[first + 12] = DRY_FRICTION * torque_limit[index]
    for number, motor in enumerate(model.drive_train.coupled):
        first = 14 * len(links) + 3 * number
        own = 14 * joints[motor]
        parameters[first : first + 3] = parameters[own + 10 : own + 13]
    return parameters
