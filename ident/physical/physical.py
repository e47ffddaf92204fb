"""Physically consistent standard parameters: bodies, rotors and friction that could exist and have the same torque."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import linalg

from ident.arrays import FloatArray, IntArray
from ident.errors import IdentificationError, ModelError
from ident.estimators.estimate import RelativeError, relative_error
from ident.model.base import BaseParameters
from ident.model.bodies import Body, link_parameters, pseudo_inertia
from ident.model.model import Model
from ident.model.robot import Motion
from ident.model.urdf import read_urdf

MARGIN = 1e-4  #: Every pseudo-inertia is at least this share of its prior's, in every direction (Q ⪰ MARGIN·1)
_ROOM = 2.0  #: The first programme keeps this multiple of the margin, so that the second has room to search
_SCALAR_ROOM = 2e-7
"""Lower bound of drive-chain parameters that may not be negative [share of the whole torque]: above the solver's
tolerance, and too small to count as a change; the second programme keeps half of it."""
_TRACE = 1e-8
"""Weight that bounds the links in the first programme where the torque does not; the norm beside it is exact."""
_RIDGE = 1e-6
"""Weight of the drive-chain parameters in the second: decides between those that the torque cannot distinguish."""
_INVISIBLE = 1e-9  #: Change of the relative torque below which a unit step leaves the torque unchanged
_ATTEMPTS: tuple[dict[str, bool | float], ...] = ({}, {"equilibrate_enable": False}, {"max_step_fraction": 0.9})
"""Settings of Clarabel, tried in turn: some programmes end in a numerical error with the first."""


class NotPhysical(IdentificationError):
    """No consistent set of parameters was found, or it does not pass its own test."""

    def __init__(self, reason: str, evidence: str) -> None:
        super().__init__(f"{reason}: {evidence}")
        self.reason = reason
        self.evidence = evidence


@dataclass(frozen=True, slots=True)
class Programme:
    """Data of both programmes for c standard parameters, n links and b base parameters."""

    factors: FloatArray  #: L of each link's prior, shape (n, 4, 4)
    link_columns: IntArray  #: indices of each link's ten parameters, shape (n, 10)
    scalars: IntArray  #: indices of the other parameters, shape (s,)
    scales: FloatArray  #: value of each of these that makes the whole torque, shape (s,)
    grouping: FloatArray  #: base parameters = grouping @ standard parameters, shape (b, c)
    triangle: FloatArray  #: a torque of relative size ‖triangle @ base‖, shape (b, b)
    positive: tuple[int, ...]  #: parameters that may not be negative
    #: For each set of motors that turn with the same joints: parameters, and the contribution of each to the symmetric
    #: matrix that must be positive semidefinite, shape (p, k, k).
    dissipative: tuple[tuple[tuple[int, ...], FloatArray], ...]

    def nearest(self, base: FloatArray) -> FloatArray:
        """Find the consistent standard parameters whose torque is nearest to that of ``base``, shape (b,) → (c,).

        Raises:
            NotPhysical: the solver found none.
        """
        import cvxpy as cp  # noqa: PLC0415 - an optional extra, and a second of start-up

        links = [cp.Variable((4, 4), symmetric=True) for _ in self.factors]
        scalars = cp.Variable(len(self.scalars))
        constraints = self._consistent(cp, links, scalars, _ROOM * MARGIN, _SCALAR_ROOM)
        place = np.zeros((self.grouping.shape[1], len(self.scalars)))
        place[self.scalars, np.arange(len(self.scalars))] = self.scales
        torque_of = self.triangle @ self.grouping
        torque = (torque_of @ place) @ scalars
        for link, factor, columns in zip(links, self.factors, self.link_columns, strict=True):
            # Standard parameters of the link per entry of Q, row by row.
            units = [link_parameters(factor @ unit.reshape(4, 4) @ factor.T) for unit in np.eye(16)]
            torque = torque + (torque_of[:, columns] @ np.column_stack(units)) @ cp.vec(link, order="C")
        distance = cp.norm2(torque - self.triangle @ base)
        size = sum(cp.trace(link) for link in links)
        _solve(cp, cp.Minimize(distance + _TRACE * size), constraints, (*links, scalars))
        return self._standard(np.array([link.value for link in links]), scalars.value)

    def closest_to_prior(
        self, start: FloatArray, directions: FloatArray, base: FloatArray, farthest: float
    ) -> FloatArray:
        """Find the standard parameters nearest to the prior with almost the same torque, shape (c,).

        The distance of a link is the divergence tr Q − log det Q − 4 (Lee, Wensing, Park: Geometric Robot Dynamic
        Identification, 2020): it does not depend on frames and units, and grows without limit towards an
        impossible body.

        Args:
            start: consistent standard parameters, shape (c,).
            directions: independent changes of them that are allowed, shape (c, d).
            base: base parameters with the identified torque, shape (b,).
            farthest: largest ‖triangle @ (base parameters − base)‖.

        Raises:
            NotPhysical: the solver found none.
        """
        import cvxpy as cp  # noqa: PLC0415 - as above

        # Orthonormal steps: the solver gets neither kg beside kg m² nor two directions that are almost one.
        steps, upper = np.linalg.qr(np.column_stack([self._scaled(change) for change in directions.T]))
        rotation = np.linalg.inv(upper)
        step = cp.Variable(steps.shape[1])
        moved = self._scaled(start) + steps @ step
        count = len(self.factors)
        found = [cp.reshape(moved[16 * i : 16 * i + 16], (4, 4), order="C") for i in range(count)]
        found = [0.5 * (link + link.T) for link in found]
        drive = moved[16 * count :]
        divergence = sum(cp.trace(link) - cp.log_det(link) for link in found)
        objective = cp.Minimize(divergence + _RIDGE * cp.sum_squares(drive))
        constraints = self._consistent(cp, found, drive, MARGIN, 0.5 * _SCALAR_ROOM)
        effect = self.triangle @ self.grouping @ directions @ rotation
        if np.linalg.norm(effect) > _INVISIBLE:
            apart = self.triangle @ (self.grouping @ start - base)
            constraints.append(cp.norm2(apart + effect @ step) <= farthest)
        _solve(cp, objective, constraints, (step,))
        change = steps @ step.value
        return start + self._standard(change[: 16 * count].reshape(-1, 4, 4), change[16 * count :])

    def _consistent(self, cp: Any, links: list[Any], scalars: Any, margin: float, room: float) -> list[Any]:
        """Constraints on the links relative to their priors, and on the scaled other parameters."""
        constraints = [link >> margin * np.eye(4) for link in links]
        where = {int(column): number for number, column in enumerate(self.scalars)}
        if self.positive:
            constraints.append(scalars[[where[column] for column in self.positive]] >= room)
        for columns, parts in self.dissipative:
            size = np.array([self.scales[where[column]] for column in columns])
            # In the scales of its diagonal, like everything else.
            unit = np.sqrt([size[np.argmax(parts[:, k, k])] for k in range(parts.shape[1])])
            matrix = sum(
                scalars[where[column]] * (part * scale / np.outer(unit, unit))
                for column, part, scale in zip(columns, parts, size, strict=True)
            )
            constraints.append(matrix >> room * np.eye(len(unit)))
        return constraints

    def _scaled(self, standard: FloatArray) -> FloatArray:
        """Q of every link, row by row, and the scaled other parameters, shape (16 n + s,)."""
        links = relative_to_prior(self.factors, standard[self.link_columns])
        return np.concatenate((links.ravel(), standard[self.scalars] / self.scales))

    def _standard(self, links: FloatArray, scalars: FloatArray) -> FloatArray:
        """Standard parameters of links Q, shape (n, 4, 4), and scaled other parameters, shape (c,)."""
        standard = np.zeros(self.grouping.shape[1])
        standard[self.scalars] = self.scales * scalars
        for link, factor, columns in zip(links, self.factors, self.link_columns, strict=True):
            standard[columns] = link_parameters(factor @ link @ factor.T)
        return standard


def relative_to_prior(factors: FloatArray, links: FloatArray) -> FloatArray:
    """Q = L⁻¹ P L⁻ᵀ of links, shapes (n, 4, 4) and (n, 10) → (n, 4, 4)."""
    inverse = np.linalg.inv(factors)
    return np.array([inv @ pseudo_inertia(link) @ inv.T for inv, link in zip(inverse, links, strict=True)])


def _solve(cp: Any, objective: Any, constraints: list[Any], unknowns: Sequence[Any]) -> None:
    problem = cp.Problem(objective, constraints)
    message = ""
    for settings in _ATTEMPTS:
        with warnings.catch_warnings():
            # The accuracy that the solver warns about is checked on its result by ident.physical.
            warnings.simplefilter("ignore")
            try:
                problem.solve(solver=cp.CLARABEL, **settings)
            except cp.SolverError as error:
                message = str(error)
        if problem.status in {cp.OPTIMAL, cp.OPTIMAL_INACCURATE} and all(one.value is not None for one in unknowns):
            return
    raise NotPhysical("the semidefinite programme has no solution", f"{problem.status or 'failed'} {message}".strip())


DEFAULT_MASS_KG = 1.0  #: Mass of a link without one in the URDF
DEFAULT_RADIUS_M = 0.1  #: Radius of the solid ball assumed for a link whose inertia the URDF lacks or that cannot exist
_THINNEST = 1e-6
"""Smallest share of a ball's second moment that a link of the URDF may have in any direction: rods and plates pass,
rounding errors around zero do not."""


@dataclass(frozen=True, slots=True)
class InertiaPrior:
    """One body a joint, in the order of the robot's joints."""

    links: FloatArray  #: parameters in the order of LINK_PARAMETERS, shape (n, 10)
    assumed: tuple[int, ...]  #: numbers (from 0) of the links for which a ball was taken


def urdf_links(urdf: str) -> FloatArray:
    """Return inertial parameters of the moving links of a URDF with bodies behind fixed joints, shape (n, 10).

    Raises:
        ModelError: the text is no URDF.
    """
    return np.array([body.parameters for body in read_urdf(urdf).bodies])


def inertia_prior(urdf: str) -> InertiaPrior:
    """Take the URDF's inertias where a body can have them, else those of a solid ball about the centre of mass.

    The ball has DEFAULT_RADIUS_M, and the URDF's mass and centre of mass; without a mass, DEFAULT_MASS_KG at the
    origin of the link frame.

    Raises:
        ModelError: the text is no URDF.
    """
    links = urdf_links(urdf)
    assumed = []
    for index, link in enumerate(links):
        has_mass = float(link[9]) > 0.0
        mass = float(link[9]) if has_mass else DEFAULT_MASS_KG
        centre = link[6:9] / mass if has_mass else np.zeros(3)
        ball = Body(mass, centre, mass * (0.4 * DEFAULT_RADIUS_M**2 * np.eye(3)))
        inside = np.linalg.inv(np.linalg.cholesky(pseudo_inertia(ball.parameters)))
        if np.linalg.eigvalsh(inside @ pseudo_inertia(link) @ inside.T)[0] < _THINNEST:
            links[index] = ball.parameters
            assumed.append(index)
    return InertiaPrior(links, tuple(assumed))


_SAME = 1e-4  #: Tolerance of a weight: names carry six decimals, and filtered data determine a few digits less
_TERM = re.compile(r" ([+-]) ([0-9.e+-]+)\*(\S+)")


def random_motion(limits: FloatArray, samples: int, seed: int) -> Motion:
    """Draw independent states within limits, to test statements about every motion.

    Args:
        limits: middle of the range, half the range, speed and acceleration of each joint, in four rows [rad or m, and
            their derivatives], shape (4, n).
        samples: k.
        seed: the same seed gives the same states.
    """
    draw = np.random.default_rng(seed).uniform(-1.0, 1.0, (3, limits.shape[1], samples)).transpose(0, 2, 1)
    middle, *sizes = limits
    position, velocity, acceleration = (size * part for size, part in zip(sizes, draw, strict=True))
    return Motion(middle + position, velocity, acceleration)


def regroup(model: Model, names: Sequence[str], columns: FloatArray) -> BaseParameters:
    """Compute the weights of standard parameters in each base parameter to full precision.

    A calibration keeps the weights of the grouping as text of six decimals; its leading names are exact. Every column
    is a combination of the leading ones (paper §2.1), so the weights follow from any motion that is rich enough.

    Args:
        model: the declared model of the robot.
        names: of base parameters, in any order: a leading name and what is regrouped with it.
        columns: the model's regressor of such a motion, rows of all joints, shape (m, c).

    Raises:
        ModelError: the names are not those of this robot: unknown, or with other weights (another geometry, other
            gravity), or too few (not everything was identifiable in the fit) or too many.
    """
    index = {column.name: number for number, column in enumerate(model.columns)}
    leading = [name.split(" ", 1)[0] for name in names]
    foreign = [name for name in leading if name not in index]
    if foreign:
        raise ModelError(
            f"the calibration has parameters that this robot does not have: {', '.join(foreign)}; use the cell of the "
            "fit, with its drive train"
        )
    order = np.argsort([index[name] for name in leading])
    independent = tuple(index[leading[i]] for i in order)
    ordered = tuple(names[i] for i in order)
    norms = np.linalg.norm(columns, axis=0)
    scale = np.where(norms > 1e-9 * float(norms.max()), norms, 1.0)
    unit = columns / scale
    chosen = unit[:, list(independent)]
    weights, _, rank, _ = linalg.lstsq(chosen, unit, cond=1e-9)
    if rank < len(independent):
        raise ModelError(
            f"the calibration has {len(independent)} base parameters, this robot only {rank}: another geometry, "
            "gravity or drive train"
        )
    left = np.linalg.norm(unit - chosen @ weights, axis=0)
    unseen = [column.name for column, rest in zip(model.columns, left, strict=True) if rest > 1e-6]
    if unseen:
        raise ModelError(
            f"the calibration lacks {', '.join(unseen)}, which this robot's torque depends on: its data did not "
            "determine them, or it is of another robot"
        )
    grouping = weights * scale / scale[list(independent), None]
    grouping[:, list(independent)] = np.eye(len(independent))
    for row, name in zip(grouping, ordered, strict=True):
        for sign, size, other in _TERM.findall(name):
            declared = float(sign + size)
            found = float(row[index[other]]) if other in index else float("nan")
            if not abs(found - declared) <= _SAME * max(1.0, abs(declared)):
                raise ModelError(
                    f"the base parameter {name!r} of the calibration gathers {declared:g}*{other}; this robot's "
                    f"geometry gives {found:.6g}: it is not the robot, the gravity or the drive train of the fit"
                )
    return BaseParameters(independent, grouping, ordered)


EXACT = 1e-6  #: Share of the torque below which a consistent set counts as predicting the identified torque
SLACK = 0.1
"""If the nearest torque is not the identified one, bodies are sought among all that are at most this share farther from
it: right at the nearest there is no choice left, and the errors of the data decide on the bodies."""


@dataclass(frozen=True, slots=True, eq=False)
class PhysicalParameters:
    """Physically consistent standard parameters with their certificate."""

    model: Model  #: the declared model
    standard: FloatArray  #: χ_st, shape (c,)
    base: BaseParameters  #: grouping of the base parameters
    identified: FloatArray  #: given values of the base parameters, shape (b,)
    realised: FloatArray  #: base parameters of `standard`, shape (b,); those identified where a consistent set exists
    #: ‖Δτ‖/‖τ‖ of the realised against the identified torque on the given motion [%].
    torque_change_percent: RelativeError
    #: Smallest one of each link's pseudo-inertia, as a share of its prior's; at least about MARGIN.
    eigenvalues: FloatArray

    @property
    def exact(self) -> bool:
        """Whether the identified base parameters are those of a robot that can exist."""
        return max(self.torque_change_percent.axes) <= 100.0 * EXACT

    @property
    def links(self) -> FloatArray:
        """Inertial parameters of each link in the order of LINK_PARAMETERS, shape (n, 10)."""
        return self.standard[self.model.link_columns]


def physical_parameters(
    model: Model,
    base: BaseParameters,
    values: FloatArray,
    columns: FloatArray,
    prior: InertiaPrior,
    other_friction: frozenset[int] = frozenset(),
) -> PhysicalParameters:
    """Find physically consistent standard parameters that predict the torque of base parameters.

    Consistent means: every link's pseudo-inertia is positive definite (`ident.model.bodies`); dry friction fs and fsm,
    and the own parameters of motors that turn with several joints (Iam, fvm), are not negative; the kinetic energy of
    the rotors and the power lost to viscous friction are not negative in any motion, that is

        diag(Ia) + Σ_m Iam_m (r_m r_mᵀ − diag(r_m²)) ⪰ 0, and the same with fv and fvm (paper eq. 25),

    which without coupled motors is Ia ≥ 0 and fv ≥ 0. Offsets are free. The first programme finds
    the torque nearest to the identified one (‖Δτ_j‖/‖τ_j‖ over all joints, on the given motion); the second finds, of
    all sets with this torque, the one nearest to the prior.

    Args:
        model: the declared model.
        base: the grouping of its base parameters.
        values: identified values, shape (b,).
        columns: the model's regressor of a rich motion, shape (n, c, k), whose torque measures the distance.
        prior: expected links.
        other_friction: axes (from 0) with friction terms outside of this model, so that fs and fv alone may have any
            sign.

    Raises:
        NotPhysical: no set was found, or it does not pass its own test.
        ModuleNotFoundError: cvxpy or Clarabel is not installed.
    """
    if not np.all(np.isfinite(values)):
        raise NotPhysical("base parameters must be finite", np.array2string(values, precision=3))
    count = model.robot.joint_count
    leading = list(base.independent)
    identified = np.einsum("jck,c->jk", columns[:, leading], values)
    size = np.linalg.norm(identified, axis=1)
    weight = np.sqrt(count) * np.where(size > 0.0, size, 1.0)
    weighted = columns / weight[:, None, None]
    rows = weighted.transpose(0, 2, 1).reshape(-1, columns.shape[1])
    triangle = np.asarray(np.linalg.qr(rows[:, leading], mode="r"))
    programme = _programme(model, base, triangle, rows, prior, other_friction)
    nearest = programme.nearest(values)
    apart = float(np.linalg.norm(triangle @ (base.grouping @ nearest - values)))
    exact = apart <= EXACT
    directions = np.eye(len(nearest))
    if exact:  # only the changes that keep all base parameters
        rest = np.setdiff1d(np.arange(len(nearest)), leading)
        directions = directions[:, rest]
        directions[leading] = -base.grouping[:, rest]
    standard = programme.closest_to_prior(nearest, directions, values, (1.0 + SLACK) * apart)
    if exact:
        # The leading parameters take the rest of the solver's tolerance.
        standard[leading] += values - base.grouping @ standard
    for column in programme.positive:
        standard[column] = max(standard[column], 0.0)
    found = PhysicalParameters(
        model=model,
        standard=standard,
        base=base,
        identified=values,
        realised=base.grouping @ standard,
        torque_change_percent=relative_error(
            identified, np.einsum("jck,c->jk", columns, standard), np.ones(identified.shape, dtype=np.bool_)
        ),
        eigenvalues=np.asarray(
            np.linalg.eigvalsh(relative_to_prior(programme.factors, standard[model.link_columns]))[:, 0],
            dtype=np.float64,
        ),
    )
    if not np.all(found.eigenvalues >= 0.5 * MARGIN):
        raise NotPhysical(
            "the solution has an impossible link", f"eigenvalues {np.array2string(found.eigenvalues, precision=3)}"
        )
    return found


def _programme(
    model: Model,
    base: BaseParameters,
    triangle: FloatArray,
    rows: FloatArray,
    prior: InertiaPrior,
    other_friction: frozenset[int],
) -> Programme:
    index = {column.name: number for number, column in enumerate(model.columns)}
    link_columns = model.link_columns
    scalars = np.setdiff1d(np.arange(len(index)), link_columns)
    norms = np.linalg.norm(rows[:, scalars], axis=0)
    coupled = model.drive_train.coupled
    own_friction = [axis for axis in range(model.robot.joint_count) if axis not in other_friction]
    positive = [index[f"fs{axis + 1}"] for axis in own_friction]
    positive += [index[f"Iam{motor + 1}"] for motor in coupled]
    positive += [index[f"{name}{motor + 1}"] for motor in coupled if motor in own_friction for name in ("fvm", "fsm")]
    dissipative = []
    for joints in _turned_together(model):
        motors = [motor for motor in coupled if np.any(model.drive_train.direction[motor, list(joints)])]
        for single, shared in (("Ia", "Iam"), ("fv", "fvm")):
            if single == "fv" and other_friction.intersection(joints):
                continue
            names = [f"{single}{joint + 1}" for joint in joints] + [f"{shared}{motor + 1}" for motor in motors]
            if len(joints) == 1:
                positive.append(index[names[0]])
            else:
                # Contribution of each joint's, then each motor's parameter to the matrix over these joints, (p, k, k).
                turned = [model.drive_train.direction[motor, list(joints)] for motor in motors]
                shares = [np.diag(unit) for unit in np.eye(len(joints))]
                shares += [np.outer(r, r) - np.diag(r**2) for r in turned]
                dissipative.append((tuple(index[name] for name in names), np.array(shares)))
    return Programme(
        factors=np.array([np.linalg.cholesky(pseudo_inertia(link)) for link in prior.links]),
        link_columns=link_columns,
        scalars=scalars,
        scales=1.0 / np.where(norms > 0.0, norms, 1.0),
        grouping=base.grouping,
        triangle=triangle,
        positive=tuple(positive),
        dissipative=tuple(dissipative),
    )


def _turned_together(model: Model) -> tuple[tuple[int, ...], ...]:
    """Group joints that share motors."""
    groups: list[set[int]] = [{joint} for joint in range(model.robot.joint_count)]
    for motor in model.drive_train.coupled:
        turned = set(np.flatnonzero(model.drive_train.direction[motor]).tolist())
        touched = [group for group in groups if group & turned]
        groups = [group for group in groups if not group & turned] + [set().union(*touched)]
    return tuple(tuple(sorted(group)) for group in groups)
