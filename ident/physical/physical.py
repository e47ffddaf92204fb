"""Physically consistent standard parameters:
bodies, rotors and friction that could exist and have the same torque.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import linalg

from ident.arrays import FloatArray
from ident.errors import ModelError
from ident.estimators.estimate import RelativeError, relative_error
from ident.model.base import BaseParameters
from ident.model.bodies import Body, link_parameters, pseudo_factors, pseudo_inertia
from ident.model.model import Model
from ident.model.robot import Motion
from ident.model.same_robot import TERM
from ident.model.urdf import read_urdf
from ident.physical.consistency import (
    MARGIN,
    Consistency,
    NotPhysical,
    consistency_of,
    driven_scalars,
    relative_to_prior,
    solve_programme,
)

#: The first programme has this multiple of the margin, so that the second has room to search
_ROOM = 2.0
_SCALAR_ROOM = 2e-7
"""Lower bound of drive-chain parameters that may not be negative [share of the total torque]: above
the solver's tolerance, and too small to count as a change; the second programme has half of it.
"""
_TRACE = 1e-8
"""Weight that bounds the links in the first programme where the torque does not;
the norm it is added to is exact.
"""
_RIDGE = 1e-6
"""Weight of the drive-chain parameters in the second:
decides between those that the torque cannot distinguish.
"""
#: Change of the relative torque below which a unit step leaves the torque unchanged
_INVISIBLE = 1e-9
_ENTRIES = 16  #: Of the matrix Q of a link


@dataclass(frozen=True, slots=True)
class Programme:
    """Data of both programmes for c standard parameters, n links and b base parameters."""

    factors: FloatArray  #: L of each link's prior, shape (n, 4, 4)
    consistency: Consistency  #: conditions on them and on the other parameters
    grouping: FloatArray  #: base parameters = grouping @ standard parameters, shape (b, c)
    triangle: FloatArray  #: a torque of relative size ‖triangle @ base‖, shape (b, b)

    def nearest(self, base: FloatArray) -> FloatArray:
        """Find consistent standard parameters with the torque nearest to ``base``, (b,) → (c,).

        Raises:
            NotPhysical: the solver found none.
        """
        import cvxpy as cp  # noqa: PLC0415 - an optional extra, and a second of start-up

        conditions = self.consistency
        count = len(conditions.scalars)
        links = [cp.Variable((4, 4), symmetric=True) for _ in self.factors]
        scalars = cp.Variable(count)
        constraints = conditions.constraints(cp, links, scalars, _ROOM * MARGIN, _SCALAR_ROOM)
        per_scalar = np.zeros((self.grouping.shape[1], count))
        per_scalar[conditions.scalars, np.arange(count)] = conditions.scales
        per_parameter = self.triangle @ self.grouping
        torque = (per_parameter @ per_scalar) @ scalars
        of_links = zip(links, self.factors, conditions.link_columns, strict=True)
        for link, factor, columns in of_links:
            per_entry = per_parameter[:, columns] @ _parameters_per_entry(factor)
            entries = cp.vec(link, order="C")
            torque = torque + per_entry @ entries
        wanted_torque = self.triangle @ base
        distance = cp.norm2(torque - wanted_torque)
        size = sum(cp.trace(link) for link in links)
        objective = cp.Minimize(distance + _TRACE * size)
        solve_programme(cp, objective, constraints, (*links, scalars))
        link_values = np.array([link.value for link in links])
        return self._standard(link_values, scalars.value)

    def with_base(self, standard: FloatArray, base: FloatArray) -> FloatArray:
        """Change standard parameters, shape (c,), so that they have given base parameters.

        The change is the least one, each parameter measured by the prior of its link or its scale.
        All of it in the leading parameters would be more than a light link has, where the torque
        hardly shows a base parameter.
        """
        count = len(standard)
        scaled_units = [self._scaled(unit) for unit in np.eye(count)]
        sizes = np.array([np.linalg.norm(scaled) for scaled in scaled_units])
        unit_change = np.zeros(count)
        np.divide(1.0, sizes, where=sizes > 0.0, out=unit_change)
        missing = base - self.grouping @ standard
        scaled_grouping = self.grouping * unit_change
        change, *_ = np.linalg.lstsq(scaled_grouping, missing, rcond=None)
        return np.asarray(standard + unit_change * change)

    def closest_to_prior(
        self, start: FloatArray, directions: FloatArray, base: FloatArray, farthest: float
    ) -> FloatArray:
        """Find the standard parameters nearest to the prior with almost the same torque, (c,).

        The distance of a link is the divergence tr Q − log det Q − 4 (Lee, Wensing, Park: Geometric
        Robot Dynamic Identification, 2020): it does not depend on frames and units, and grows
        without limit towards an impossible body.

        Args:
            start: consistent standard parameters, shape (c,).
            directions: independent changes of them that are allowed, shape (c, d).
            base: base parameters with the identified torque, shape (b,).
            farthest: largest ‖triangle @ (base parameters − base)‖.

        Raises:
            NotPhysical: the solver found none.
        """
        import cvxpy as cp  # noqa: PLC0415 - as above

        # Orthonormal steps: the solver gets neither kg with kg m² nor two directions that are
        # almost one.
        scaled_directions = [self._scaled(change) for change in directions.T]
        steps, upper = np.linalg.qr(np.column_stack(scaled_directions))
        rotation = np.linalg.inv(upper)
        step = cp.Variable(steps.shape[1])
        moved = self._scaled(start) + steps @ step
        links: list[Any] = []
        first = 0
        for _ in self.factors:
            last = first + _ENTRIES
            link = cp.reshape(moved[first:last], (4, 4), order="C")
            links.append(0.5 * (link + link.T))
            first = last
        link_entries = first
        drive = moved[link_entries:]
        divergence = sum(cp.trace(link) - cp.log_det(link) for link in links)
        drive_size = cp.sum_squares(drive)
        objective = cp.Minimize(divergence + _RIDGE * drive_size)
        room = 0.5 * _SCALAR_ROOM
        constraints = self.consistency.constraints(cp, links, drive, MARGIN, room)
        per_step = self.triangle @ self.grouping @ directions @ rotation
        if np.linalg.norm(per_step) > _INVISIBLE:
            base_difference = self.grouping @ start - base
            torque_difference = self.triangle @ base_difference
            distance = cp.norm2(torque_difference + per_step @ step)
            constraints.append(distance <= farthest)
        solve_programme(cp, objective, constraints, (step,))
        change = steps @ step.value
        of_links = change[:link_entries].reshape(-1, 4, 4)
        of_drives = change[link_entries:]
        return start + self._standard(of_links, of_drives)

    def _scaled(self, standard: FloatArray) -> FloatArray:
        """Q of every link, row by row, and the scaled other parameters, shape (16 n + s,)."""
        conditions = self.consistency
        links = relative_to_prior(self.factors, standard[conditions.link_columns])
        scalars = standard[conditions.scalars] / conditions.scales
        return np.concatenate((links.ravel(), scalars))

    def _standard(self, links: FloatArray, scalars: FloatArray) -> FloatArray:
        """Standard parameters of links Q, (n, 4, 4), and scaled other parameters, shape (c,)."""
        conditions = self.consistency
        standard = np.zeros(self.grouping.shape[1])
        standard[conditions.scalars] = conditions.scales * scalars
        of_links = zip(links, self.factors, conditions.link_columns, strict=True)
        for link, factor, columns in of_links:
            pseudo = factor @ link @ factor.T
            standard[columns] = link_parameters(pseudo)
        return standard


def _parameters_per_entry(factor: FloatArray) -> FloatArray:
    """Standard parameters of a link per entry of Q, row by row, shape (10, 16).

    Args:
        factor: L of the link's prior, shape (4, 4).
    """
    columns: list[FloatArray] = []
    for unit in np.eye(_ENTRIES):
        entry = unit.reshape(4, 4)
        pseudo = factor @ entry @ factor.T
        columns.append(link_parameters(pseudo))
    return np.column_stack(columns)


DEFAULT_MASS_KG = 1.0  #: Mass of a link without one in the URDF
#: Radius of the solid ball assumed for a link whose inertia the URDF lacks or that cannot exist
DEFAULT_RADIUS_M = 0.1
_THINNEST = 1e-6
"""Smallest share of a ball's second moment that a link of the URDF may have in any direction:
rods and plates pass, rounding errors around zero do not.
"""


@dataclass(frozen=True, slots=True)
class InertiaPrior:
    """One body a joint, in the order of the robot's joints."""

    links: FloatArray  #: parameters in the order of LINK_PARAMETERS, shape (n, 10)
    assumed: tuple[int, ...]  #: numbers (from 0) of the links for which a ball was taken

    @property
    def factors(self) -> FloatArray:
        """Cholesky factor L of each link's pseudo-inertia, shape (n, 4, 4)."""
        return pseudo_factors(self.links)


def urdf_links(urdf: str) -> FloatArray:
    """Return inertial parameters of a URDF's moving links, shape (n, 10).

    They contain the bodies behind fixed joints.

    Raises:
        ModelError: the text is no URDF.
    """
    bodies = read_urdf(urdf).bodies
    return np.array([body.parameters for body in bodies])


def inertia_prior(urdf: str) -> InertiaPrior:
    """Take the URDF's inertias where a body can have them, else those of a solid ball.

    The ball has DEFAULT_RADIUS_M, and the URDF's mass and centre of mass; without a mass,
    DEFAULT_MASS_KG at the origin of the link frame.

    Raises:
        ModelError: the text is no URDF.
    """
    links = urdf_links(urdf)
    assumed: list[int] = []
    for index, link in enumerate(links):
        ball = _ball_of(link)
        factor = np.linalg.cholesky(pseudo_inertia(ball))
        inverse = np.linalg.inv(factor)
        relative = inverse @ pseudo_inertia(link) @ inverse.T
        smallest = np.linalg.eigvalsh(relative)[0]
        if smallest < _THINNEST:
            links[index] = ball
            assumed.append(index)
    return InertiaPrior(links, tuple(assumed))


def _ball_of(link: FloatArray) -> FloatArray:
    """Parameters of a solid ball with the mass and the centre of mass of a link, shape (10,)."""
    mass = float(link[9])
    if mass > 0.0:
        centre = link[6:9] / mass
    else:
        mass = DEFAULT_MASS_KG
        centre = np.zeros(3)
    # (2/5) m r² about every axis
    inertia_per_kg = 0.4 * DEFAULT_RADIUS_M**2 * np.eye(3)
    inertia = mass * inertia_per_kg
    return Body(mass, centre, inertia).parameters


#: Tolerance of a weight: names carry six decimals, and filtered data determine a few digits less
_SAME = 1e-4
_ROUNDING = 1e-9  #: Share of the largest column, and of a singular value, that is rounding error
_LARGEST_REST = 1e-6  #: Of a column of norm one that is a combination of the leading ones


def random_motion(limits: FloatArray, samples: int, seed: int) -> Motion:
    """Draw independent states within limits, to test statements about every motion.

    Args:
        limits: middle of the range, half the range, speed and acceleration of each joint, in four
            rows [rad or m, and their derivatives], shape (4, n).
        samples: k.
        seed: the same seed gives the same states.
    """
    random = np.random.default_rng(seed)
    middle, half_range, speed, acceleration = limits
    drawn = random.uniform(-1.0, 1.0, (3, len(middle), samples))
    position, velocity, change = drawn.transpose(0, 2, 1)
    return Motion(
        position_rad=middle + half_range * position,
        velocity_rad_s=speed * velocity,
        acceleration_rad_s2=acceleration * change,
    )


def regroup(model: Model, names: Sequence[str], columns: FloatArray) -> BaseParameters:
    """Compute the weights of standard parameters in each base parameter to full precision.

    A calibration has the weights of the grouping as text of six decimals; its leading names are
    exact. Every column is a combination of the leading ones (paper §2.1), so the weights follow
    from any motion that is rich enough.

    Args:
        model: the declared model of the robot.
        names: of base parameters, in any order: a leading name and what is regrouped with it.
        columns: the model's regressor of such a motion, rows of all joints, shape (m, c).

    Raises:
        ModelError: the names are not those of this robot: unknown, or with other weights (another
            geometry, other gravity), or too few (not everything was identifiable in the fit) or too
            many.
    """
    index = {column.name: number for number, column in enumerate(model.columns)}
    leading = [name.split(" ", 1)[0] for name in names]
    foreign = ", ".join(name for name in leading if name not in index)
    if foreign:
        raise ModelError(
            f"the calibration has parameters that this robot does not have: {foreign}; "
            "use the cell of the fit, with its drive train"
        )
    order = np.argsort([index[name] for name in leading])
    independent = [index[leading[i]] for i in order]
    ordered = tuple(names[i] for i in order)
    norms = np.linalg.norm(columns, axis=0)
    is_seen = norms > _ROUNDING * float(norms.max())
    scale = np.where(is_seen, norms, 1.0)
    unit = columns / scale
    chosen = unit[:, independent]
    weights, _, rank, _ = linalg.lstsq(chosen, unit, cond=_ROUNDING)
    count = len(independent)
    if rank < count:
        raise ModelError(
            f"the calibration has {count} base parameters, this robot only {rank}: "
            "another geometry, gravity or drive train"
        )
    left = unit - chosen @ weights
    left_size = np.linalg.norm(left, axis=0)
    is_missing = left_size > _LARGEST_REST
    missing = [model.columns[column].name for column in np.flatnonzero(is_missing)]
    if missing:
        names_text = ", ".join(missing)
        raise ModelError(
            f"the calibration lacks {names_text}, which this robot's torque depends on: "
            "its data did not determine them, or it is of another robot"
        )
    grouping = weights * scale / scale[independent, None]
    grouping[:, independent] = np.eye(count)
    for row, name in zip(grouping, ordered, strict=True):
        _require_same_weights(name, row, index)
    return BaseParameters(tuple(independent), grouping, ordered)


def _require_same_weights(name: str, row: FloatArray, index: Mapping[str, int]) -> None:
    """Refuse a base parameter that gathers others with other weights than this robot's.

    Args:
        name: of the base parameter, with the weights of the calibration.
        row: its weights by this robot, shape (c,).
        index: column of each standard parameter, by name.

    Raises:
        ModelError: a weight differs.
    """
    for sign, size, other in TERM.findall(name):
        declared = float(sign + size)
        found = float("nan")
        if other in index:
            found = float(row[index[other]])
        tolerance = _SAME * max(1.0, abs(declared))
        if not abs(found - declared) <= tolerance:
            raise ModelError(
                f"the base parameter {name!r} of the calibration gathers {declared:g}*{other}; "
                f"this robot's geometry gives {found:.6g}: it is not the robot, the gravity or the "
                "drive train of the fit"
            )


#: Share of the torque below which a consistent set counts as predicting the identified torque
EXACT = 1e-6
SLACK = 0.1
"""If the nearest torque is not the identified one, bodies are sought among all that are at most
this share farther from it: right at the nearest there is no choice left, and the errors of the data
decide on the bodies.
"""


@dataclass(frozen=True, slots=True, eq=False)
class PhysicalParameters:
    """Physically consistent standard parameters with their certificate."""

    model: Model  #: the declared model
    standard: FloatArray  #: χ_st, shape (c,)
    base: BaseParameters  #: grouping of the base parameters
    #: base parameters of `standard`, shape (b,); those identified where a consistent set exists
    realised: FloatArray
    #: ‖Δτ‖/‖τ‖ of the realised against the identified torque on the given motion [%].
    torque_change_percent: RelativeError
    #: Smallest one of each link's pseudo-inertia, as a share of its prior's; at least about MARGIN.
    eigenvalues: FloatArray

    @classmethod
    def of(
        cls,
        standard: FloatArray,
        model: Model,
        base: BaseParameters,
        values: FloatArray,
        columns: FloatArray,
        prior: InertiaPrior,
    ) -> PhysicalParameters:
        """Compare standard parameters, shape (c,), with base parameters and with a prior.

        Args:
            standard: χ_st.
            model, base, values, columns, prior: as of `physical_parameters`.
        """
        identified = _torque(columns[:, list(base.independent)], values)
        realised = _torque(columns, standard)
        every_sample = np.ones(identified.shape, dtype=np.bool_)
        change_percent = relative_error(identified, realised, every_sample)
        links = relative_to_prior(prior.factors, standard[model.link_columns])
        eigenvalues = np.linalg.eigvalsh(links)
        return cls(
            model=model,
            standard=standard,
            base=base,
            realised=base.grouping @ standard,
            torque_change_percent=change_percent,
            eigenvalues=np.asarray(eigenvalues[:, 0], dtype=np.float64),
        )

    @property
    def exact(self) -> bool:
        """Whether the identified base parameters are those of a robot that can exist."""
        return max(self.torque_change_percent.axes) <= 100.0 * EXACT

    @property
    def links(self) -> FloatArray:
        """Inertial parameters of each link in the order of LINK_PARAMETERS, shape (n, 10)."""
        return self.standard[self.model.link_columns]


def _torque(columns: FloatArray, values: FloatArray) -> FloatArray:
    """τ_jk = Σ_c W_jck χ_c, shape (n, k)."""
    return np.asarray(np.einsum("jck,c->jk", columns, values))


def physical_parameters(
    model: Model,
    base: BaseParameters,
    values: FloatArray,
    columns: FloatArray,
    prior: InertiaPrior,
    other_friction: frozenset[int] = frozenset(),
) -> PhysicalParameters:
    """Find physically consistent standard parameters that predict the torque of base parameters.

    Consistent is what `ident.physical.consistency` says. The first programme finds the torque
    nearest to the identified one (‖Δτ_j‖/‖τ_j‖ over all joints, on the given motion); the second
    finds, of all sets with this torque, the one nearest to the prior.

    Args:
        model: the declared model.
        base: the grouping of its base parameters.
        values: identified values, shape (b,).
        columns: the model's regressor of a rich motion, shape (n, c, k), whose torque measures the
            distance.
        prior: expected links.
        other_friction: axes (from 0) with friction terms outside of this model, so that fs and fv
            alone may have any sign.

    Raises:
        NotPhysical: no set was found, or it does not pass its own test.
        ModuleNotFoundError: cvxpy or Clarabel is not installed.
    """
    if not np.all(np.isfinite(values)):
        found_values = np.array2string(values, precision=3)
        raise NotPhysical("base parameters must be finite", found_values)
    leading = list(base.independent)
    identified = _torque(columns[:, leading], values)
    size = np.linalg.norm(identified, axis=1)
    size = np.where(size > 0.0, size, 1.0)
    weight = np.sqrt(model.robot.axis_count) * size
    weighted = columns / weight[:, None, None]
    by_row = weighted.transpose(0, 2, 1)
    rows = by_row.reshape(-1, columns.shape[1])
    triangle = np.asarray(np.linalg.qr(rows[:, leading], mode="r"))
    programme = _programme(model, base, triangle, rows, prior, other_friction)
    nearest = programme.nearest(values)
    difference = base.grouping @ nearest - values
    distance = float(np.linalg.norm(triangle @ difference))
    exact = distance <= EXACT
    free = np.union1d(model.link_columns.ravel(), programme.consistency.scalars)
    every_change = np.eye(len(nearest))
    directions = every_change[:, free]
    if exact:  # only the changes that leave all base parameters as they are
        others = np.setdiff1d(free, leading)
        directions = every_change[:, others]
        directions[leading] = -base.grouping[:, others]
        nearest = programme.with_base(nearest, values)
    farthest = (1.0 + SLACK) * distance
    standard = programme.closest_to_prior(nearest, directions, values, farthest)
    if exact:
        # The leading parameters take what rounding has left.
        rounding = values - base.grouping @ standard
        standard[leading] += rounding
    for column in programme.consistency.positive:
        standard[column] = max(standard[column], 0.0)
    found = PhysicalParameters.of(standard, model, base, values, columns, prior)
    if not np.all(found.eigenvalues >= 0.5 * MARGIN):
        eigenvalues = np.array2string(found.eigenvalues, precision=3)
        raise NotPhysical("the solution has an impossible link", f"eigenvalues {eigenvalues}")
    return found


def _programme(
    model: Model,
    base: BaseParameters,
    triangle: FloatArray,
    rows: FloatArray,
    prior: InertiaPrior,
    other_friction: frozenset[int],
) -> Programme:
    """Data of both programmes."""
    scalars = driven_scalars(model)
    norms = np.linalg.norm(rows[:, scalars], axis=0)
    norms = np.where(norms > 0.0, norms, 1.0)
    scales = 1.0 / norms  # value of each that makes the total torque
    consistency = consistency_of(model, scales, other_friction)
    return Programme(
        factors=prior.factors,
        consistency=consistency,
        grouping=base.grouping,
        triangle=triangle,
    )
