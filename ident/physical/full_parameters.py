"""Full standard parameters from an estimate and a prior on the links,
with what each of them rests on.

An estimate knows gains, base parameters and payload alone. The bodies of the links are many more
numbers; a CAD model knows them roughly. Both together give every standard parameter.

**Prior.** With L Lᵀ the pseudo-inertia of a link by the URDF (`ident.model.bodies`), the link is

    P = L (1 + t E) Lᵀ,    E symmetric, E_ii ~ N(0, 1), E_ij ~ N(0, ½) for i ≠ j.

The tolerance t is one relative standard deviation of the mass and of each second moment ∫x² dm, in
whatever frame they are taken: rotations leave the distribution of E as it is, so L may be any root
of P by the URDF. The centre of mass is known to t/√2 of √(∫x² dm / m) along each axis. −log of the
density is, to second order in t, the divergence (tr Q − log det Q − 4)/t² by which
`ident.physical.physical` measures distances (Lee, Wensing, Park: Geometric Robot Dynamic
Identification, 2020). Rotors, friction and offsets have no prior.

**Weights.** With θ = (g, β, u) of the estimate (gains, base parameters, coefficients of effects and
payload), x = (g, χ_st, u), and T x the θ that x amounts to, the Gaussian posterior is where

    ‖R (T x − θ̂)‖² + Σ_links ‖E‖²_F

is least, R the triangle of the motors' equations around the estimate (`ident.equations.currents`).
The covariance C of the estimate comes from leaving out moves; its rank is their number at most, so
its inverse is no weight. RᵀR is divided by the mean ratio of the variances in C to those in (RᵀR)⁻¹
instead, which makes data and prior comparable.

**Gains.** The gains stay those of the estimate, and the parameters are those that belong to them:
g = ĝ in x. What the prior would make of the gains, with g free, is a second solution of the same
equations (`FullParameters.gains`).

**σ and flags.** A solution is linear, x̂ = A θ̂ + B ε with ε the prior's deviations of one. Its
errors are those of the data and those of the prior, each with its own covariance:

    cov x̂ = A C Aᵀ + B Bᵀ.

A parameter is *data* where the first part is the larger one, else *prior*. The ratio of posterior
to prior σ says less: of a known sum Izz1 + Ia1, Ia1 has no prior, and still the prior of Izz1
decides on it.

**Consistency.** Where x̂ is no possible robot, the nearest one in the metric of the posterior takes
its place (`ident.physical.consistency`). σ remains that of the unbounded solution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from scipy import linalg

from ident.arrays import FloatArray
from ident.equations.system import System
from ident.errors import ModelError
from ident.estimators.estimate import Estimate
from ident.model.bodies import link_parameters, pseudo_factors, pseudo_inertia
from ident.model.closed_chain import null_space
from ident.model.model import Model
from ident.physical.consistency import (
    MARGIN,
    NotPhysical,
    consistency_of,
    relative_to_prior,
    solve_programme,
)
from ident.physical.full_set import LARGEST_TOLERANCE, LEAST_TOLERANCE
from ident.physical.prior_check import PriorCheck, check_prior

#: Diagonal of R, of columns of norm one, below which an unknown is not determined
_DEPENDENT = 1e-10
_LOOSE = 1e-9  #: Singular value, of columns of norm one, relative to the largest, that is none
#: Least value of what may not be negative, in units of its scale: above the solver's tolerance
_ROOM = 1e-6
LARGER_PART = 0.5  #: Share of a variance above which it is the larger part


class RestsOn(Enum):
    """What a parameter's value rests on."""

    DATA = "data"
    PRIOR = "prior"


@dataclass(frozen=True, slots=True, eq=False)
class LinkPrior:
    """Pseudo-inertias of n links, and how far they may be off."""

    links: FloatArray  #: parameters by the URDF in the order of LINK_PARAMETERS, shape (n, 10)
    tolerance: float  #: t, one standard deviation

    def __post_init__(self) -> None:
        if not LEAST_TOLERANCE <= self.tolerance <= LARGEST_TOLERANCE:
            raise ModelError(
                f"the tolerance of the prior is {self.tolerance:g}; expected {LEAST_TOLERANCE:g} "
                f"to {LARGEST_TOLERANCE:g}, one relative standard deviation of masses and second "
                "moments"
            )
        for number, link in enumerate(self.links, start=1):
            eigenvalues = np.linalg.eigvalsh(pseudo_inertia(link))
            if eigenvalues.min() <= 0.0:
                raise ModelError(
                    f"link {number} of the prior is no possible body: its pseudo-inertia has a "
                    "negative eigenvalue; expected a mass and an inertia for each moving link; "
                    "correct the URDF"
                )

    @property
    def factors(self) -> FloatArray:
        """L of each link, shape (n, 4, 4)."""
        return pseudo_factors(self.links)

    def directions(self) -> FloatArray:
        """Change of each link's ten parameters for one σ of ten independent numbers.

        Returns:
            a column for each number, shape (n, 10, 10).
        """
        basis = _symmetric_basis()
        directions: list[FloatArray] = []
        for factor in self.factors:
            changes = [factor @ unit @ factor.T for unit in basis]
            columns = [link_parameters(change) for change in changes]
            directions.append(self.tolerance * np.column_stack(columns))
        return np.array(directions)


@dataclass(frozen=True, slots=True, eq=False)
class FullParameters:
    """All standard parameters of a robot, each with its σ and its basis."""

    names: tuple[str, ...]  #: of the c standard parameters
    units: tuple[str, ...]
    standard: FloatArray  #: χ_st, of a robot that can exist, shape (c,)
    standard_std: FloatArray  #: shape (c,)
    prior_std: FloatArray  #: before the data; infinite for rotors, friction and offsets, shape (c,)
    prior_share: FloatArray  #: share of the prior in each variance, 0 to 1, shape (c,)
    #: what the prior would make of the gains; not those that the parameters belong to, shape (m,)
    gains: FloatArray
    gains_std: FloatArray  #: of these, shape (m,)
    base: FloatArray  #: base parameters of `standard`, shape (b,)
    base_std: FloatArray  #: shape (b,)
    #: smallest one of each link's pseudo-inertia, as a share of its prior's, shape (n,)
    eigenvalues: FloatArray
    bounded: bool  #: the unbounded solution was no possible robot
    check: PriorCheck  #: whether data and prior agree

    @property
    def basis(self) -> tuple[RestsOn, ...]:
        """What each standard parameter rests on."""
        basis: list[RestsOn] = []
        for share in self.prior_share:
            if share > LARGER_PART:
                basis.append(RestsOn.PRIOR)
            else:
                basis.append(RestsOn.DATA)
        return tuple(basis)


@dataclass(frozen=True, slots=True, eq=False)
class _Equations:
    """Rows of data and prior for the unknowns x = (g, χ_st, u), whitened:
    M x = y + e, cov e = 1.
    """

    model: Model
    data: FloatArray  #: R T, scaled by the ratio of variances, shape (r, x)
    #: Rows of the prior, those of the links last, shape (p, x).
    prior: FloatArray
    weight: FloatArray  #: R, scaled likewise, shape (r, θ)
    theta: FloatArray  #: θ̂, shape (θ,)
    prior_right: FloatArray  #: shape (p,)
    covariance: FloatArray  #: C of θ̂, shape (θ, θ)
    gains: int  #: how many of x and θ are gains

    @property
    def matrix(self) -> FloatArray:
        """M, shape (r + p, x)."""
        return np.concatenate((self.data, self.prior))

    @property
    def right(self) -> FloatArray:
        """y, shape (r + p,)."""
        data_right = self.weight @ self.theta
        return np.concatenate((data_right, self.prior_right))

    @property
    def standard(self) -> slice:
        """The standard parameters among x."""
        return slice(self.gains, self.gains + len(self.model.columns))


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """Least-squares solution of the equations."""

    values: FloatArray  #: x̂, shape (x,)
    #: F: ‖F (x − x̂)‖² is what x costs more than x̂, for the unknowns that are free
    factor: FloatArray
    free: int  #: first unknown that is free
    from_data: FloatArray  #: A C Aᵀ, shape (x, x)
    from_prior: FloatArray  #: B Bᵀ, shape (x, x)

    @property
    def covariance(self) -> FloatArray:
        """Covariance of x̂, shape (x, x)."""
        return self.from_data + self.from_prior

    @property
    def std(self) -> FloatArray:
        """σ of x̂, shape (x,)."""
        return np.sqrt(np.diag(self.covariance))


def full_parameters(
    system: System,
    estimate: Estimate,
    prior: LinkPrior,
    other_friction: frozenset[int] = frozenset(),
) -> FullParameters:
    """Find all standard parameters of a robot, and what the prior would make of its gains.

    Args:
        system: of the fit.
        estimate: from it.
        prior: of each link, in the order of the robot's joints.
        other_friction: axes (from 0) with friction terms outside of this model, so that fs and fv
            alone may have any sign.

    Raises:
        ModelError: the prior is of another number of links, the robot has a closed chain, or the
            fit has left base parameters out.
        NotPhysical: no possible robot was found, or it does not pass its own test.
        ModuleNotFoundError: the solution has to be bounded, and cvxpy or Clarabel is not installed.
    """
    _require_full(system, prior)
    model = system.model
    equations = _equations(system, estimate, prior)
    gains = equations.gains
    own = equations.standard
    links = model.link_columns
    # With the gains of the estimate
    given = _solved(equations, gains)
    values, is_bounded = _possible(equations, prior, given, other_friction)
    standard = values[own]
    standard_std = given.std[own]
    gains_with_prior = estimate.gains
    gains_with_prior_std = estimate.gains_std
    if gains:
        free = _solved(equations, 0)
        free_values, _ = _possible(equations, prior, free, other_friction)
        gains_with_prior = free_values[:gains]
        gains_with_prior_std = free.std[:gains]
    grouping = system.base.grouping
    base_covariance = grouping @ given.covariance[own, own] @ grouping.T
    prior_std = np.full(len(standard), np.inf)
    prior_std[links] = np.linalg.norm(prior.directions(), axis=2)
    prior_variance = np.diag(given.from_prior)[own]
    relative_links = relative_to_prior(prior.factors, standard[links])
    eigenvalues = np.linalg.eigvalsh(relative_links)
    data_covariance = equations.weight @ equations.covariance @ equations.weight.T
    check = check_prior(
        matrix=equations.matrix,
        right=equations.right,
        data_covariance=data_covariance,
        links=len(prior.links),
        tolerance=prior.tolerance,
    )
    return FullParameters(
        names=tuple(column.name for column in model.columns),
        units=tuple(column.unit for column in model.columns),
        standard=standard,
        standard_std=standard_std,
        prior_std=prior_std,
        prior_share=prior_variance / standard_std**2,
        gains=gains_with_prior,
        gains_std=gains_with_prior_std,
        base=grouping @ standard,
        base_std=np.sqrt(np.diag(base_covariance)),
        eigenvalues=np.asarray(eigenvalues[:, 0]),
        bounded=is_bounded,
        check=check,
    )


def _solved(equations: _Equations, first: int) -> _Solution:
    """Solve for all unknowns from ``first`` on; those before keep the values of the estimate.

    Raises:
        NotPhysical: data and prior do not determine every unknown.
    """
    matrix = equations.matrix
    free = matrix[:, first:]
    scale = np.linalg.norm(free, axis=0)
    unseen = np.flatnonzero(scale == 0.0)
    if len(unseen):
        columns = equations.model.columns
        places = unseen + first - equations.gains
        names = ", ".join(columns[place].name for place in places)
        raise NotPhysical("neither data nor prior say anything of some parameters", names)
    q, upper = np.linalg.qr(free / scale)
    smallest = float(np.abs(np.diag(upper)).min())
    if smallest < _DEPENDENT:
        raise NotPhysical(
            "data and prior together do not determine every parameter",
            f"smallest share {smallest:.1e}",
        )
    inverse = linalg.solve_triangular(upper, q.T) / scale[:, None]  # M⁺ of the free unknowns
    rows = len(equations.data)
    prior_rows = len(matrix) - rows
    # x = (ĝ, M⁺ (y − M_g ĝ)): A is the derivative to θ̂, B that to the prior's rows.
    from_theta = inverse[:, :rows] @ equations.weight
    from_theta[:, :first] -= inverse @ matrix[:, :first]
    gains_themselves = np.eye(first, from_theta.shape[1])
    gains_by_prior = np.zeros((first, prior_rows))
    by_data = np.concatenate((gains_themselves, from_theta))
    by_prior = np.concatenate((gains_by_prior, inverse[:, rows:]))
    values = by_data @ equations.theta + by_prior @ equations.prior_right
    return _Solution(
        values=values,
        factor=upper * scale,
        free=first,
        from_data=by_data @ equations.covariance @ by_data.T,
        from_prior=by_prior @ by_prior.T,
    )


def _require_full(system: System, prior: LinkPrior) -> None:
    """Refuse robots and fits whose standard parameters cannot be found.

    Raises:
        ModelError: as of `full_parameters`.
    """
    robot = system.model.robot
    if robot.is_constrained:
        raise ModelError(
            "the robot has a closed chain, or joints that follow others; expected a serial robot, "
            "each joint with a motor: for links that move together no masses are computed"
        )
    if len(prior.links) != robot.joint_count:
        raise ModelError(
            f"the prior has {len(prior.links)} moving links, the robot {robot.joint_count}; give "
            "the URDF of this robot"
        )
    names = tuple(column.name for column in system.columns[: len(system.base.names)])
    if names != system.base.names:
        missing = sorted(set(system.base.names) - set(names))
        raise ModelError(
            f"the fit has left out {', '.join(missing)}; expected all base parameters: fit without "
            "leaving any out"
        )


def _triangle(system: System, estimate: Estimate) -> FloatArray:
    """R of the whitened equations around an estimate, shape (θ, θ)."""
    currents = system.currents
    gains = estimate.gains
    parameters = estimate.parameters
    free = len(parameters)
    if not estimate.gains_fixed:
        free += len(gains)
    noise = currents.noise(gains, parameters, free)
    whitened = currents.whitened(gains, noise)
    columns = -whitened.linear
    if not estimate.gains_fixed:
        residual = whitened.residual(gains, parameters)
        drive = currents.corrected(gains, noise, whitened, residual)
        columns = np.concatenate((drive, columns), axis=1)
    return np.asarray(np.linalg.qr(columns, mode="r"))


def _variance_ratio(triangle: FloatArray, covariance: FloatArray) -> float:
    """Mean ratio of the variances of an estimate to those of independent rows;
    one where the estimate has none.
    """
    scale = np.linalg.norm(triangle, axis=0)
    inverse = linalg.solve_triangular(triangle / scale, np.eye(len(triangle)))
    independent = np.sum(inverse**2, axis=1) / scale**2
    ratio = float(np.mean(np.diag(covariance) / independent))
    if not ratio > 0.0:
        return 1.0
    return ratio


def _equations(system: System, estimate: Estimate, prior: LinkPrior) -> _Equations:
    """Rows of data and prior."""
    fixed = 0
    if estimate.gains_fixed:
        fixed = len(estimate.gains)
    gains = len(estimate.gains) - fixed
    covariance = estimate.covariance[fixed:, fixed:]
    triangle = _triangle(system, estimate)
    ratio = _variance_ratio(triangle, covariance)
    weight = triangle / np.sqrt(ratio)
    grouping = system.base.grouping
    base_count, standard_count = grouping.shape
    other_count = len(estimate.parameters) - base_count
    to_theta = linalg.block_diag(np.eye(gains), grouping, np.eye(other_count))
    data = weight @ to_theta
    unknown_count = data.shape[1]
    standard = slice(gains, gains + standard_count)
    base = slice(gains, gains + base_count)
    torque = data[:, standard] @ _any_standard(system, estimate)
    loose = _loose_drives(system, weight[:, base] @ grouping, float(np.linalg.norm(torque)))
    of_drives = np.zeros((len(loose), unknown_count))
    of_drives[:, standard] = loose
    of_links = np.zeros((prior.links.size, unknown_count))
    right = [np.zeros(len(loose))]
    first = 0
    for link, directions, columns in zip(
        prior.links, prior.directions(), system.model.link_columns, strict=True
    ):
        end = first + len(link)
        whitening = np.linalg.inv(directions)
        of_links[first:end, gains + columns] = whitening
        right.append(whitening @ link)
        first = end
    return _Equations(
        model=system.model,
        data=data,
        prior=np.concatenate((of_drives, of_links)),
        weight=weight,
        theta=np.concatenate((estimate.gains[:gains], estimate.parameters)),
        prior_right=np.concatenate(right),
        covariance=covariance,
        gains=gains,
    )


def _any_standard(system: System, estimate: Estimate) -> FloatArray:
    """Standard parameters with the base parameters of an estimate:
    those that lead them, shape (c,).
    """
    leading = list(system.base.independent)
    standard = np.zeros(system.base.grouping.shape[1])
    standard[leading] = estimate.parameters[: len(leading)]
    return standard


def _loose_drives(system: System, columns: FloatArray, size: float) -> FloatArray:
    """Rows for combinations of rotors and friction that no torque shows and no link's prior bounds,
    shape (k, c).

    Two motors that both turn two joints, one of them against the other, have rotors whose
    difference alone is seen. Such a combination is zero, give or take what would make the total
    torque if it were seen.

    Args:
        system: of the fit.
        columns: of each standard parameter in the whitened equations, shape (r, c).
        size: of the modelled torque in these equations.
    """
    count = columns.shape[1]
    scalars = np.setdiff1d(np.arange(count), system.model.link_columns)
    of_scalars = columns[:, scalars]
    norms = np.linalg.norm(of_scalars, axis=0)
    if not np.all(norms > 0.0):
        return np.zeros((0, count))
    unseen = null_space(of_scalars / norms, _LOOSE).T
    rows = np.zeros((len(unseen), count))
    rows[:, scalars] = unseen * (norms / size)
    return rows


def _possible(
    equations: _Equations, prior: LinkPrior, solution: _Solution, other_friction: frozenset[int]
) -> tuple[FloatArray, bool]:
    """Return x̂, or the x nearest to it that is a possible robot, ‖F (x − x̂)‖ least;
    and whether that was needed.
    """
    model = equations.model
    own = equations.standard
    standard = solution.values[own]
    scalars = np.setdiff1d(np.arange(len(standard)), model.link_columns)
    data_std = np.sqrt(np.diag(solution.from_data)[own])
    scales = np.maximum(np.abs(standard), data_std)[scalars]
    consistency = consistency_of(model, scales, other_friction)
    factors = prior.factors
    if consistency.is_met(factors, standard, MARGIN):
        return solution.values, False
    import cvxpy as cp  # noqa: PLC0415 - an optional extra, and a second of start-up

    # x = x̂ + F⁻¹ w: the solver gets a distance of one in all directions.
    factor = solution.factor
    column_scale = np.linalg.norm(factor, axis=0)
    inverse_factor = linalg.solve_triangular(factor / column_scale, np.eye(len(factor)))
    steps = np.zeros((len(solution.values), len(factor)))
    steps[solution.free :] = inverse_factor / column_scale[:, None]
    moved = steps[own]
    step = cp.Variable(len(factor))
    links: list[Any] = []
    for inverse, columns in zip(np.linalg.inv(factors), model.link_columns, strict=True):
        at_solution = inverse @ pseudo_inertia(standard[columns]) @ inverse.T
        changes: list[FloatArray] = []
        for change in moved[columns].T:
            relative = inverse @ pseudo_inertia(change) @ inverse.T
            changes.append(relative.ravel())
        per_step = np.stack(changes, axis=1)
        link = at_solution + cp.reshape(per_step @ step, (4, 4), order="C")
        links.append(0.5 * (link + link.T))
    drive = standard[scalars] / scales + (moved[scalars] / scales[:, None]) @ step
    constraints = consistency.constraints(cp, links, drive, 2.0 * MARGIN, _ROOM)
    objective = cp.Minimize(cp.sum_squares(step))
    solve_programme(cp, objective, constraints, (step,))
    found = solution.values + steps @ step.value
    if not consistency.is_met(factors, found[own], 0.5 * MARGIN):
        raise NotPhysical(
            "the solution has an impossible link or drive", "outside of its own constraints"
        )
    return found, True


def _symmetric_basis() -> Sequence[FloatArray]:
    """Ten symmetric matrices, orthonormal under tr(A B)."""
    basis: list[FloatArray] = []
    for row in range(4):
        for column in range(row, 4):
            value = np.sqrt(0.5)
            if row == column:
                value = 1.0
            unit = np.zeros((4, 4))
            unit[row, column] = value
            unit[column, row] = value
            basis.append(unit)
    return basis
