"""The semidefinite programmes behind `ident.physical.physical`, and the prior for links that the data do not show."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ident.arrays import FloatArray, IntArray
from ident.errors import IdentificationError
from ident.model.bodies import Body, link_parameters, pseudo_inertia
from ident.model.robot import read_urdf

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
            torque = torque + (torque_of @ _linear_map(factor, columns, len(place))) @ cp.vec(link, order="C")
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


def _linear_map(factor: FloatArray, columns: IntArray, count: int) -> FloatArray:
    """Standard parameters per entry of Q (row by row), shape (c, 16)."""
    out = np.zeros((count, 16))
    for entry in range(16):
        unit = np.zeros(16)
        unit[entry] = 1.0
        out[columns, entry] = link_parameters(factor @ unit.reshape(4, 4) @ factor.T)
    return out


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
