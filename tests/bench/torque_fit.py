"""The job that is timed: rows of the standard parameters, base parameters, ordinary least squares;
from measured joint torques, sample by sample, as the classical tools do it. `fit_torques` never
holds more than a piece of rows.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from ident.equations.triangles import qr_update
from ident.model.base import BaseParameters, base_parameters
from ident.model.bodies import LINK_PARAMETERS
from ident.model.regressor import fill_rigid
from ident.model.robot import Motion, Robot

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]

PIECE_SAMPLES = 8192
DRIVE_PARAMETERS = ("Ia", "fv", "fs", "off")
WIDTH = len(LINK_PARAMETERS) + len(DRIVE_PARAMETERS)


@dataclass(frozen=True, slots=True, eq=False)
class TorqueFit:
    """Base parameters and their values.

    Attributes:
        base: the regrouping.
        values: of the base parameters, shape (b,).
        residual_norm: ‖τ − W χ‖ over all rows [Nm].
    """

    base: BaseParameters
    values: FloatArray
    residual_norm: float

    def predict(self, standard: FloatArray) -> FloatArray:
        """Joint torques of rows of the standard parameters, shape (n, c, k) → (n, k)."""
        return np.asarray(
            np.einsum("jck,c->jk", standard[:, list(self.base.independent)], self.values)
        )


def names(joints: int) -> tuple[str, ...]:
    """Names of the standard parameters, joint by joint."""
    found: list[str] = []
    for number in range(1, joints + 1):
        found += [f"{name}{number}" for name in LINK_PARAMETERS + DRIVE_PARAMETERS]
    return tuple(found)


def standard_rows(robot: Robot, samples: int) -> FloatArray:
    """Room for the rows of so many samples, shape (n, 14 n, k):
    the offsets' ones, and zeros that stay zeros.
    """
    count = robot.joint_count
    room = np.zeros((count, WIDTH * count, samples))
    for joint in range(count):
        room[joint, WIDTH * joint + WIDTH - 1] = 1.0
    return room


def fill_rows(
    robot: Robot, motion: Motion, out: FloatArray, wanted: BoolArray | None = None
) -> None:
    """Write the rows of a piece of motion into ``standard_rows`` of its length;
    ``wanted`` as in `fill_rigid`.
    """
    samples, count = motion.position_rad.shape
    position, velocity, acceleration = (
        np.ascontiguousarray(states.T)
        for states in (motion.position_rad, motion.velocity_rad_s, motion.acceleration_rad_s2)
    )
    by_link = out.reshape(count, count, WIDTH, samples)
    fill_rigid(
        robot, position, velocity, acceleration, by_link[:, :, : len(LINK_PARAMETERS)], wanted
    )
    for joint in range(count):
        own = by_link[joint, joint, len(LINK_PARAMETERS) :]
        own[0], own[1] = acceleration[joint], velocity[joint]
        np.sign(velocity[joint], out=own[2])


def structure(robot: Robot) -> BaseParameters:
    """The regrouping that holds in every motion of a robot: that of a random one.

    Columns that depend on others whatever the motion need not be computed sample by sample. The
    tolerance is close to the rounding errors: a column too many costs time, one too few would cost
    a parameter.
    """
    count = robot.joint_count
    rng = np.random.default_rng(0)
    motion = Motion(*(rng.uniform(-np.pi, np.pi, (4 * WIDTH, count)) for _ in range(3)))
    rows = standard_rows(robot, 4 * WIDTH)
    fill_rows(robot, motion, rows)
    return base_parameters(
        qr_update(None, np.concatenate(list(rows), axis=1)), names(count), tolerance=1e-11
    )


def fit_torques(robot: Robot, pieces: Iterable[tuple[Motion, FloatArray]]) -> TorqueFit:
    """Identify from motions and the joint torques [Nm] measured in them, shape (n, k)."""
    count = robot.joint_count
    general = structure(robot)
    needed = _needed(robot, general)
    place = np.cumsum(needed).reshape(needed.shape) - 1  # of each column among the needed ones
    held = _held(robot, needed)
    triangles: list[FloatArray | None] = [None] * count
    room = standard_rows(robot, 0)
    own = np.zeros((WIDTH * count + 1, 0))
    for motion, torque in pieces:
        samples = torque.shape[1]
        if room.shape[2] != samples:
            room = standard_rows(robot, samples)
            own = np.zeros((WIDTH * count + 1, samples))
        fill_rows(robot, motion, room, needed[:, : len(LINK_PARAMETERS)])
        for joint, columns in enumerate(held):
            rows = own[: len(columns) + 1]
            # "raise" would go through a copy
            np.take(room[joint], columns, axis=0, out=rows[:-1], mode="clip")
            rows[-1] = torque[joint]
            triangles[joint] = qr_update(triangles[joint], rows)
    last = len(general.independent)
    whole = qr_merge(
        (
            (triangle, (*place.flat[columns], last))
            for triangle, columns in zip(triangles, held, strict=True)
            if triangle is not None
        ),
        last + 1,
    )
    base = base_parameters(whole[:, :last] @ general.grouping, names(count))
    # R of [W_b | τ]: the least-squares solution is above, the residual's norm in the corner.
    small = qr_update(None, whole[:, [*place.flat[list(base.independent)], last]].T)
    values = solve_triangular(small[:-1, :-1], small[:-1, -1])
    return TorqueFit(base, np.asarray(values), float(abs(small[-1, -1])))


def joint_columns(
    robot: Robot, pieces: Iterable[tuple[Motion, FloatArray]], *, all_standard: bool = False
) -> tuple[FloatArray, ...]:
    """What `fit_torques` reduces, held whole:
    for each joint its columns and its torque, shape (c_j + 1, k).

    `all_standard` takes the columns too that others reproduce in every motion.
    """
    if all_standard:
        needed = np.ones((robot.joint_count, WIDTH), dtype=np.bool_)
    else:
        needed = _needed(robot, structure(robot))
    held = _held(robot, needed)
    parts = []
    for motion, torque in pieces:
        room = standard_rows(robot, torque.shape[1])
        fill_rows(robot, motion, room, needed[:, : len(LINK_PARAMETERS)])
        parts.append(
            [np.vstack((room[joint, columns], torque[joint])) for joint, columns in enumerate(held)]
        )
    return tuple(np.concatenate(own, axis=1) for own in zip(*parts, strict=True))


def _needed(robot: Robot, general: BaseParameters) -> BoolArray:
    """Columns that depend on no others whatever the motion, shape (n, 14)."""
    needed = np.zeros((robot.joint_count, WIDTH), dtype=np.bool_)
    needed.flat[list(general.independent)] = True
    return needed


def _held(robot: Robot, needed: BoolArray) -> tuple[IntArray, ...]:
    """The needed columns that a joint's torque depends on:
    of the links behind it, and of its own drive.
    """
    drive = np.arange(WIDTH) >= len(LINK_PARAMETERS)
    links = np.arange(robot.joint_count)
    return tuple(
        np.flatnonzero(
            needed & (np.isin(links, moved)[:, None] & ~drive | (links == joint)[:, None] & drive)
        )
        for joint, moved in enumerate(moved_links(robot))
    )


def qr_merge(parts: Iterable[tuple[FloatArray, Sequence[int]]], width: int) -> FloatArray:
    """R of several sets of rows, each known by its own triangle over a subset of the columns.

    A joint's torque depends on the links behind it and on its own drive alone: its triangle is that
    narrow, and only here the joints meet.

    Args:
        parts: triangle of shape (c_i, c_i), and which of the ``width`` columns these c_i are.
        width: number of columns.

    Returns:
        upper triangular, shape (width, width).
    """
    out: FloatArray | None = None
    for triangle, places in parts:
        rows = np.zeros((width, triangle.shape[0]))
        rows[list(places)] = triangle.T
        out = qr_update(out, rows)
    return np.zeros((width, width)) if out is None else out


def moved_links(robot: Robot) -> tuple[tuple[int, ...], ...]:
    """For each joint the links behind it, ascending, its own first:
    in other columns its row is zero.
    """
    behind: list[list[int]] = [[] for _ in robot.joints]
    for link in range(robot.joint_count):
        joint = link
        while joint >= 0:
            behind[joint].append(link)
            joint = robot.joints[joint].parent
    return tuple(map(tuple, behind))
