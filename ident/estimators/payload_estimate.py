"""Identify the payload of a run with given gains: a check of the gains with a scale (paper §4.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.arrays import FloatArray
from ident.equations.linearisation import jackknife_covariance
from ident.equations.reduction import Cluster, Reduction, mounting_index
from ident.equations.system import System, require_distinct, solve, triangle
from ident.errors import DataUnfit, RankDeficient
from ident.estimators.least_squares import ls, wls
from ident.estimators.maximum_likelihood import noise_of
from ident.model.base import BaseParameters
from ident.model.bodies import LINK_PARAMETERS, Payload


@dataclass(frozen=True, slots=True, eq=False)
class PayloadEstimate:
    """Inertial parameters of a mounted body by the classical IDIM-WLS."""

    names: tuple[str, ...]  #: those of the ten parameters that the run shows, in the order of LINK_PARAMETERS
    values: FloatArray  #: of these, in the last joint's frame [SI], shape (p,)
    std: FloatArray  #: from the scatter of the moves, the gains taken as exact, shape (p,)
    per_gain: FloatArray  #: ∂values/∂g, shape (p, n): what an error of each gain does to them

    @property
    def mass_kg(self) -> float:
        """m [kg]."""
        return float(self.values[self.names.index("m")])

    @property
    def mass_std_kg(self) -> float:
        """σ of m, the gains taken as exact [kg]."""
        return float(self.std[self.names.index("m")])

    def mass_std_with_gains_kg(self, gains_std: FloatArray) -> float:
        """σ of m when the gains are uncertain too [kg].

        The errors of gains from one fit go together, because one weight sets their common scale: they are added by
        size, not by square.

        Args:
            gains_std: σ of each gain, shape (n,).
        """
        of_gains = float(np.abs(self.per_gain[self.names.index("m")]) @ gains_std)
        return float(np.hypot(self.mass_std_kg, of_gains))


def payload_beside_bare_runs(bare: Reduction, loaded: Reduction, gains: FloatArray) -> PayloadEstimate:
    """Robot and payload together from runs without load and runs with it (§2.4), all ten parameters unknown.

    Args:
        bare: of runs without load.
        loaded: of runs of one mounting.
        gains: Nm at the joint per A, shape (n,).

    Raises:
        DataUnfit, RankDeficient, TooFewMoves: the runs do not show the payload, or not how certain it is.
    """
    both = _unknown(joined((bare, loaded)))
    system = both.system(both.base(), both.payload_columns())
    require_distinct(system, gains=False)
    return _weighed(system, gains)


def payload_on_known_robot(robot: FloatArray, loaded: Reduction, gains: FloatArray) -> PayloadEstimate:
    """The payload alone, on a robot whose parameters are known (ident.prediction.standard_parameters).

    An error of the robot's parameters goes into the payload's, and its σ does not know of it.

    Args:
        robot: χ_st without load, shape (c,).
        loaded: of runs of one mounting.
        gains: Nm at the joint per A, shape (n,).

    Raises:
        DataUnfit, RankDeficient, TooFewMoves: as of `payload_beside_bare_runs`.
    """
    alone = _unknown(loaded)
    every = tuple(range(len(robot)))
    names = tuple(column.name for column in loaded.model.columns)
    system = alone.system(BaseParameters(every, np.eye(len(robot)), names), alone.payload_columns())
    return _weighed(system.holding(dict(enumerate(robot.tolist()))), gains)


def as_one_body(reduction: Reduction) -> Reduction:
    """Take the payload as part of the last link: no unknowns of its own."""
    joints = tuple(triangle(factors, factors[0].shape[1]) for factors in zip(*reduction.joints, strict=True))
    clusters = tuple(replace(cluster, mounting=-1) for cluster in reduction.clusters)
    return replace(reduction, payloads=(), joints=(joints,), clusters=clusters)


def joined(parts: Sequence[Reduction]) -> Reduction:
    """Reductions of different runs as one, of all of them.

    Args:
        parts: of one model and one conditioning.

    Raises:
        DataUnfit: a mounting carries one thing here and another there.
    """
    payloads: list[Payload] = []
    joints = [list(parts[0].joints[0])]
    clusters: list[Cluster] = []
    for number, part in enumerate(parts):
        places = [0, *(1 + mounting_index(payload, payloads, ", ".join(part.runs)) for payload in part.payloads)]
        joints += [
            [np.empty((0, factor.shape[1])) for factor in joints[0]] for _ in range(1 + len(payloads) - len(joints))
        ]
        for factors, place in zip(part.joints, places, strict=True):
            if number or place:
                joints[place] = [triangle(pair, pair[0].shape[1]) for pair in zip(joints[place], factors, strict=True)]
        clusters += [replace(cluster, mounting=places[cluster.mounting + 1] - 1) for cluster in part.clusters]
    return replace(
        parts[0],
        payloads=tuple(payloads),
        runs=tuple(run for part in parts for run in part.runs),
        joints=tuple(tuple(factors) for factors in joints),
        joint_rows=np.sum([part.joint_rows for part in parts], axis=0),
        motor_rows=np.sum([part.motor_rows for part in parts], axis=0),
        clusters=tuple(clusters),
    )


def _unknown(reduction: Reduction) -> Reduction:
    if len(reduction.payloads) != 1:
        mountings = ", ".join(payload.mounting for payload in reduction.payloads) or "none"
        raise DataUnfit(", ".join(reduction.runs), f"mountings {mountings}; one payload is weighed at a time")
    (payload,) = reduction.payloads
    return replace(reduction, payloads=(replace(payload, known={}),))


def _weighed(system: System, gains: FloatArray) -> PayloadEstimate:
    (columns,) = system.payload_columns
    names = tuple(LINK_PARAMETERS[index] for index in columns)
    if "m" not in names:
        raise RankDeficient("these moves do not distinguish the payload's mass from its other parameters", ("m",))
    estimate = wls(system, gains)
    noise = noise_of(system.motors, 1.0 / gains, estimate.parameters, len(estimate.parameters))
    covariance = jackknife_covariance(system, gains, estimate.parameters, noise, gains_fixed=True)
    # With its weights held, WLS is linear in the gains.
    stacked = system.joints.stacked(1.0 / ls(system, gains).axis_noise)
    count = system.joint_count
    per_gain = solve(-stacked[:, count:-1], stacked[:, :count])[0]
    own = slice(len(estimate.parameters) - len(names), None)
    std = np.sqrt(np.diag(covariance)[count:])
    return PayloadEstimate(names, estimate.parameters[own], std[own], per_gain[own])
