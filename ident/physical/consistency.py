"""What makes standard parameters those of a robot that can exist,
as constraints of a semidefinite programme.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ident.arrays import FloatArray, IntArray
from ident.errors import IdentificationError
from ident.model.bodies import pseudo_inertia
from ident.model.model import JOINT_COLUMNS, ROTOR_INERTIA, Model

#: Every pseudo-inertia is at least this share of its prior's, in every direction (Q ⪰ MARGIN·1)
MARGIN = 1e-4
_ATTEMPTS: tuple[dict[str, bool | float], ...] = (
    {},
    {"equilibrate_enable": False},
    {"max_step_fraction": 0.9},
)
"""Settings of Clarabel, tried in turn: some programmes end in a numerical error with the first."""


class NotPhysical(IdentificationError):
    """No consistent set of parameters was found, or it does not pass its own test."""

    def __init__(self, reason: str, evidence: str) -> None:
        super().__init__(f"{reason}: {evidence}")
        self.reason = reason
        self.evidence = evidence


@dataclass(frozen=True, slots=True)
class Consistency:
    """Conditions on n links and on the s parameters that are no link's.

    Consistent means: every link's pseudo-inertia is positive definite (`ident.model.bodies`); dry
    friction fs and fsm, and Iam and fvm of motors that turn with several joints, are not negative;
    the kinetic energy of the rotors and the power lost to viscous friction are not negative in any
    motion, that is

        diag(Ia) + Σ_m Iam_m (r_m r_mᵀ − diag(r_m²)) ⪰ 0, and the same with fv and fvm (paper eq.
        25),

    which without coupled motors is Ia ≥ 0 and fv ≥ 0. Offsets are free.
    """

    link_columns: IntArray  #: indices of each link's ten parameters, shape (n, 10)
    scalars: IntArray  #: indices of the other parameters, shape (s,)
    scales: FloatArray  #: size of each of these, which the programme takes for one, shape (s,)
    positive: tuple[int, ...]  #: parameters that may not be negative
    #: For each set of motors that turn with the same joints: parameters, and the contribution of
    #: each to the symmetric matrix that must be positive semidefinite, shape (p, k, k).
    dissipative: tuple[tuple[tuple[int, ...], FloatArray], ...]

    def constraints(
        self, cp: Any, links: Sequence[Any], scalars: Any, margin: float, room: float
    ) -> list[Any]:
        """Constraints on the links relative to their priors, and on the scaled other parameters.

        Args:
            cp: cvxpy.
            links: Q of each link, 4 × 4.
            scalars: the other parameters, each divided by its scale.
            margin: least eigenvalue of Q.
            room: least value of what may not be negative.
        """
        least_link = margin * np.eye(4)
        constraints = [link >> least_link for link in links]
        number_of = {int(column): number for number, column in enumerate(self.scalars)}
        if self.positive:
            positive = [number_of[column] for column in self.positive]
            constraints.append(scalars[positive] >= room)
        for columns, parts in self.dissipative:
            numbers = [number_of[column] for column in columns]
            sizes = self.scales[numbers]
            # In the scales of its diagonal, like everything else.
            diagonals = np.einsum("pkk->pk", parts)
            largest_on_diagonal = np.argmax(diagonals, axis=0)
            unit = np.sqrt(sizes[largest_on_diagonal])
            unit_square = np.outer(unit, unit)
            matrix: Any = 0
            for number, part, size in zip(numbers, parts, sizes, strict=True):
                scaled_part = part * size / unit_square
                matrix = matrix + scalars[number] * scaled_part
            least_matrix = room * np.eye(len(unit))
            constraints.append(matrix >> least_matrix)
        return constraints

    def is_met(self, factors: FloatArray, standard: FloatArray, margin: float) -> bool:
        """Whether standard parameters meet the conditions.

        Args:
            factors: L of each link's prior, shape (n, 4, 4).
            standard: parameters, shape (c,).
            margin: least eigenvalue of each link relative to its prior.
        """
        links = relative_to_prior(factors, standard[self.link_columns])
        eigenvalues = np.linalg.eigvalsh(links)
        if float(eigenvalues.min()) < margin:
            return False
        if any(standard[column] < 0.0 for column in self.positive):
            return False
        for columns, parts in self.dissipative:
            # Σ_p χ_p (part of p), shape (k, k)
            matrix = np.einsum("p,pij->ij", standard[list(columns)], parts)
            eigenvalues = np.linalg.eigvalsh(matrix)
            if float(eigenvalues.min()) < 0.0:
                return False
        return True


def consistency_of(
    model: Model, scales: FloatArray, other_friction: frozenset[int] = frozenset()
) -> Consistency:
    """Conditions for a model's standard parameters.

    Args:
        model: the declared model.
        scales: size of each parameter that is no link's, in their order, shape (s,).
        other_friction: axes (from 0) with friction terms outside of this model, so that fs and fv
            alone may have any sign.
    """
    index = {column.name: number for number, column in enumerate(model.columns)}
    coupled = model.drive_train.coupled
    numbers = [joint + 1 for joint in model.robot.axis_joints]
    positive: list[int] = []
    for axis, number in enumerate(numbers):
        if axis not in other_friction:
            positive.append(index[f"fs{number}"])
    for motor in coupled:
        positive.append(index[f"Iam{motor + 1}"])
    for motor in coupled:
        if motor not in other_friction:
            positive.append(index[f"fvm{motor + 1}"])
            positive.append(index[f"fsm{motor + 1}"])
    dissipative: list[tuple[tuple[int, ...], FloatArray]] = []
    for axes in _turned_together(model):
        directions = model.drive_train.direction[:, list(axes)]
        motors = [motor for motor in coupled if np.any(directions[motor])]
        for of_axis, of_motor in (("Ia", "Iam"), ("fv", "fvm")):
            if of_axis == "fv" and other_friction.intersection(axes):
                continue
            names = [f"{of_axis}{numbers[axis]}" for axis in axes]
            names += [f"{of_motor}{motor + 1}" for motor in motors]
            columns = tuple(index[name] for name in names)
            if len(axes) == 1:
                positive.append(columns[0])
            else:
                contributions = _contributions(model, axes, motors)
                dissipative.append((columns, contributions))
    return Consistency(
        link_columns=model.link_columns,
        scalars=driven_scalars(model),
        scales=scales,
        positive=tuple(positive),
        dissipative=tuple(dissipative),
    )


def _contributions(model: Model, axes: Sequence[int], motors: Sequence[int]) -> FloatArray:
    """Part of each axis', then each motor's parameter in the matrix over these axes, (p, k, k)."""
    parts = [np.diag(unit) for unit in np.eye(len(axes))]
    for motor in motors:
        # r rᵀ without its diagonal, which the axes have
        r = model.drive_train.direction[motor, list(axes)]
        diagonal = np.diag(r**2)
        parts.append(np.outer(r, r) - diagonal)
    return np.array(parts)


def driven_scalars(model: Model) -> IntArray:
    """Columns of rotors, friction and offsets of joints that have a motor, shape (s,)."""
    every = np.arange(len(model.columns))
    others = [model.link_columns.ravel()]
    drive = np.arange(ROTOR_INERTIA, JOINT_COLUMNS)
    for joint in model.robot.passive_joints:
        others.append(JOINT_COLUMNS * joint + drive)
    return np.setdiff1d(every, np.concatenate(others))


def relative_to_prior(factors: FloatArray, links: FloatArray) -> FloatArray:
    """Q = L⁻¹ P L⁻ᵀ of links, shapes (n, 4, 4) and (n, 10) → (n, 4, 4)."""
    relative: list[FloatArray] = []
    inverses = np.linalg.inv(factors)
    for inverse, link in zip(inverses, links, strict=True):
        pseudo = pseudo_inertia(link)
        relative.append(inverse @ pseudo @ inverse.T)
    return np.array(relative)


def solve_programme(
    cp: Any, objective: Any, constraints: list[Any], unknowns: Sequence[Any]
) -> None:
    """Solve a programme by Clarabel; its unknowns have their values then.

    Raises:
        NotPhysical: the solver found none.
    """
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
        is_solved = problem.status in {cp.OPTIMAL, cp.OPTIMAL_INACCURATE}
        if is_solved and all(one.value is not None for one in unknowns):
            return
    status = problem.status or "failed"
    evidence = f"{status} {message}".strip()
    raise NotPhysical("the semidefinite programme has no solution", evidence)


def _turned_together(model: Model) -> tuple[tuple[int, ...], ...]:
    """Group axes that share motors."""
    groups: list[set[int]] = [{axis} for axis in range(model.robot.axis_count)]
    for motor in model.drive_train.coupled:
        direction = model.drive_train.direction[motor]
        turned = set(np.flatnonzero(direction).tolist())
        joined: set[int] = set()
        others: list[set[int]] = []
        for group in groups:
            if group & turned:
                joined |= group
            else:
                others.append(group)
        groups = [*others, joined]
    return tuple(tuple(sorted(group)) for group in groups)
