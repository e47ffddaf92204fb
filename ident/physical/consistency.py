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
from ident.model.model import JOINT_COLUMNS, Model

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
    friction fs and fsm, and the own parameters of motors that turn with several joints (Iam, fvm),
    are not negative; the kinetic energy of the rotors and the power lost to viscous friction are
    not negative in any motion, that is

        diag(Ia) + Σ_m Iam_m (r_m r_mᵀ − diag(r_m²)) ⪰ 0

    and the same with fv and fvm (paper eq. 25), which without coupled motors is Ia ≥ 0 and fv ≥ 0.
    Offsets are free.
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

    def is_met(self, factors: FloatArray, standard: FloatArray, margin: float) -> bool:
        """Whether standard parameters meet the conditions.

        Args:
            factors: L of each link's prior, shape (n, 4, 4).
            standard: parameters, shape (c,).
            margin: least eigenvalue of each link relative to its prior.
        """
        links = relative_to_prior(factors, standard[self.link_columns])
        if float(np.linalg.eigvalsh(links).min()) < margin:
            return False
        if any(standard[column] < 0.0 for column in self.positive):
            return False
        for columns, parts in self.dissipative:
            matrix = np.einsum("p,pij->ij", standard[list(columns)], parts)
            if float(np.linalg.eigvalsh(matrix)[0]) < 0.0:
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
    link_columns = model.link_columns
    scalars = driven_scalars(model)
    coupled = model.drive_train.coupled
    number_of = [joint + 1 for joint in model.robot.axis_joints]
    own_friction = [axis for axis in range(model.robot.axis_count) if axis not in other_friction]
    positive = [index[f"fs{number_of[axis]}"] for axis in own_friction]
    positive += [index[f"Iam{motor + 1}"] for motor in coupled]
    positive += [
        index[f"{name}{motor + 1}"]
        for motor in coupled
        if motor in own_friction
        for name in ("fvm", "fsm")
    ]
    dissipative = []
    for axes in _turned_together(model):
        motors = [
            motor for motor in coupled if np.any(model.drive_train.direction[motor, list(axes)])
        ]
        for single, shared in (("Ia", "Iam"), ("fv", "fvm")):
            if single == "fv" and other_friction.intersection(axes):
                continue
            names = [f"{single}{number_of[axis]}" for axis in axes] + [
                f"{shared}{motor + 1}" for motor in motors
            ]
            if len(axes) == 1:
                positive.append(index[names[0]])
            else:
                # Contribution of each axis', then each motor's parameter to the matrix over these
                # axes, (p, k, k).
                turned = [model.drive_train.direction[motor, list(axes)] for motor in motors]
                shares = [np.diag(unit) for unit in np.eye(len(axes))]
                shares += [np.outer(r, r) - np.diag(r**2) for r in turned]
                dissipative.append((tuple(index[name] for name in names), np.array(shares)))
    return Consistency(link_columns, scalars, scales, tuple(positive), tuple(dissipative))


def driven_scalars(model: Model) -> IntArray:
    """Columns of rotors, friction and offsets, without those of joints that have no motor,
    shape (s,).
    """
    of_links = model.link_columns.ravel()
    undriven = [
        JOINT_COLUMNS * joint + np.arange(10, JOINT_COLUMNS) for joint in model.robot.passive_joints
    ]
    return np.setdiff1d(np.arange(len(model.columns)), np.concatenate((of_links, *undriven)))


def relative_to_prior(factors: FloatArray, links: FloatArray) -> FloatArray:
    """Q = L⁻¹ P L⁻ᵀ of links, shapes (n, 4, 4) and (n, 10) → (n, 4, 4)."""
    inverse = np.linalg.inv(factors)
    return np.array(
        [inv @ pseudo_inertia(link) @ inv.T for inv, link in zip(inverse, links, strict=True)]
    )


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
        if problem.status in {cp.OPTIMAL, cp.OPTIMAL_INACCURATE} and all(
            one.value is not None for one in unknowns
        ):
            return
    raise NotPhysical(
        "the semidefinite programme has no solution",
        f"{problem.status or 'failed'} {message}".strip(),
    )


def _turned_together(model: Model) -> tuple[tuple[int, ...], ...]:
    """Group axes that share motors."""
    groups: list[set[int]] = [{axis} for axis in range(model.robot.axis_count)]
    for motor in model.drive_train.coupled:
        turned = set(np.flatnonzero(model.drive_train.direction[motor]).tolist())
        touched = [group for group in groups if group & turned]
        groups = [group for group in groups if not group & turned] + [set().union(*touched)]
    return tuple(tuple(sorted(group)) for group in groups)
