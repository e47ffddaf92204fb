"""The same job as a loop over Pinocchio's regressor in Python,
and LAPACK's QR of each joint's own columns.

    python -m tests.bench.pinocchio_fit DATA.npz ROBOT.urdf REPEATS     prints one JSON object

It does what a careful engineer would: pieces that stay in the cache, a joint's row without the
links that do not move it, triangles instead of a matrix of all samples. `pinocchio_fit.cpp` is the
same in C++.
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np
import pinocchio
from numpy.typing import NDArray
from scipy.linalg import lapack

from tests.bench.memory import peak_mb
from tests.bench.torque_fit import DRIVE_PARAMETERS, WIDTH

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]

PIECE_SAMPLES = 2048
LINK_PARAMETERS = WIDTH - len(DRIVE_PARAMETERS)
DEPENDENT = 1e-8  #: Of the largest singular value, columns scaled: what is left of a dependent one


def regressors(model: pinocchio.Model, data: dict[str, FloatArray], samples: slice) -> FloatArray:
    """Rows of the standard parameters of the links, shape (k, n, 10 n)."""
    room = model.createData()
    states = (data[name][:, samples].T for name in ("q", "v", "a"))
    each = zip(*(np.ascontiguousarray(state) for state in states), strict=True)
    return np.array(
        [pinocchio.computeJointTorqueRegressor(model, room, *state).copy() for state in each]
    )


def link_columns(model: pinocchio.Model) -> list[IntArray]:
    """For each joint the columns of the links behind it, among those of all links."""
    found: list[IntArray] = []
    for joint in range(1, model.njoints):
        links = np.array(sorted(model.subtrees[joint])) - 1
        columns = LINK_PARAMETERS * links[:, None] + np.arange(LINK_PARAMETERS)
        found.append(columns.ravel())
    return found


def triangle(rows: FloatArray) -> FloatArray:
    """R of rows, shape (k, c) in LAPACK's layout, which is overwritten."""
    work, _ = lapack.dgeqrf_lwork(*rows.shape)
    reduced, _, _, _ = lapack.dgeqrf(rows, lwork=int(work), overwrite_a=1)
    return np.asarray(np.triu(reduced[: rows.shape[1]]))


def fit(model: pinocchio.Model, data: dict[str, FloatArray]) -> tuple[int, float]:
    """Number of base parameters, and the norm of the residual [Nm]."""
    samples = data["q"].shape[1]
    behind = link_columns(model)
    triangles = [np.zeros((0, len(columns) + len(DRIVE_PARAMETERS) + 1)) for columns in behind]
    for first in range(0, samples, PIECE_SAMPLES):
        piece = slice(first, min(first + PIECE_SAMPLES, samples))
        links = regressors(model, data, piece)
        for joint, columns in enumerate(behind):
            velocity = data["v"][joint, piece]
            own = (data["a"][joint, piece], velocity, np.sign(velocity), np.ones_like(velocity))
            drive_and_torque = np.column_stack((*own, data["torque"][joint, piece]))
            piece_rows = np.hstack((links[:, joint, columns], drive_and_torque))
            stacked = np.asfortranarray(np.vstack((triangles[joint], piece_rows)))
            triangles[joint] = triangle(stacked)
    return solved(triangles, behind)


def solved(triangles: list[FloatArray], behind: list[IntArray]) -> tuple[int, float]:
    """Put the joints' triangles together, and solve."""
    joints = len(behind)
    links = LINK_PARAMETERS * joints
    drives = len(DRIVE_PARAMETERS)
    rows: list[FloatArray] = []
    for joint, (own, columns) in enumerate(zip(triangles, behind, strict=True)):
        spread = np.zeros((len(own), links + drives * joints + 1))
        spread[:, columns] = own[:, : len(columns)]
        first = links + drives * joint
        spread[:, first : first + drives] = own[:, len(columns) : -1]
        spread[:, -1] = own[:, -1]
        rows.append(spread)
    whole = np.concatenate(rows)
    standard = whole[:, :-1]
    torque = whole[:, -1]
    norm = np.linalg.norm(standard, axis=0)
    # A column that is zero but for rounding errors must not be scaled up to one that counts.
    shown = norm > DEPENDENT * norm.max()
    scaled = standard[:, shown] / norm[shown]
    values, _, rank, _ = np.linalg.lstsq(scaled, torque, rcond=DEPENDENT)
    return int(rank), float(np.linalg.norm(torque - scaled @ values))


def main(data_path: str, urdf: str, repeats: str) -> None:
    """Time it."""
    data = dict(np.load(data_path))
    model = pinocchio.buildModelFromUrdf(urdf)
    seconds: list[dict[str, float]] = []
    for _ in range(int(repeats)):
        begin = time.process_time()
        parameters, residual_norm_nm = fit(model, data)
        seconds.append({"total": time.process_time() - begin})
    found = {
        "seconds": seconds,
        "base_parameters": parameters,
        "residual_norm_nm": residual_norm_nm,
        "peak_mb": peak_mb(),
    }
    sys.stdout.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
