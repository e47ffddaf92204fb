"""Physically consistent standard parameters: bodies, rotors and friction that could exist and have the same torque."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ident.arrays import FloatArray, IntArray
from ident.estimators.estimate import RelativeError, relative_error
from ident.model.base import BaseParameters
from ident.model.bodies import pseudo_inertia
from ident.model.model import Model
from ident.physical.programme import MARGIN, InertiaPrior, NotPhysical, Programme, relative_to_prior

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
        return self.standard[_link_columns(self.model)]


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
    directions = _null_space(base) if exact else np.eye(len(nearest))
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
            np.linalg.eigvalsh(relative_to_prior(programme.factors, standard[_link_columns(model)]))[:, 0],
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
    link_columns = _link_columns(model)
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
                dissipative.append((tuple(index[name] for name in names), _shares(model, joints, motors)))
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


def _shares(model: Model, joints: tuple[int, ...], motors: list[int]) -> FloatArray:
    """Contribution of each joint's, then each motor's parameter to the matrix over these joints, shape (p, k, k)."""
    shares = [np.diag(unit) for unit in np.eye(len(joints))]
    for motor in motors:
        r = model.drive_train.direction[motor, list(joints)]
        shares.append(np.outer(r, r) - np.diag(r**2))
    return np.array(shares)


def _link_columns(model: Model) -> IntArray:
    return 14 * np.arange(model.robot.joint_count)[:, None] + np.arange(10)


def _null_space(base: BaseParameters) -> FloatArray:
    """Changes of the standard parameters that keep all base parameters, shape (c, c − b)."""
    count = base.grouping.shape[1]
    rest = np.setdiff1d(np.arange(count), base.independent)
    out = np.zeros((count, len(rest)))
    out[rest, np.arange(len(rest))] = 1.0
    out[list(base.independent)] = -base.grouping[:, rest]
    return out
