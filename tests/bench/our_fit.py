"""The job by drivegain in a fresh process.

python -m tests.bench.our_fit DATA.npz ROBOT.urdf PREDICTED.npy REPEATS     prints one JSON object
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from ident.model.robot import Motion
from ident.model.urdf import robot_from_urdf
from tests.bench.memory import peak_mb
from tests.bench.torque_fit import (
    PIECE_SAMPLES,
    fill_rows,
    fit_torques,
    joint_columns,
    standard_rows,
)

FloatArray = NDArray[np.float64]


def _pieces(data: dict[str, FloatArray]) -> Iterator[tuple[Motion, FloatArray]]:
    for first in range(0, data["q"].shape[1], PIECE_SAMPLES):
        part = slice(first, first + PIECE_SAMPLES)
        yield (
            Motion(data["q"][:, part].T, data["v"][:, part].T, data["a"][:, part].T),
            data["torque"][:, part],
        )


def _bare_qr_s(columns: tuple[FloatArray, ...]) -> float:
    """Processor time of LAPACK's own QR of the columns of each joint, already in its layout;
    copies do not count.
    """
    spent_s = 0.0
    for own in columns:
        rows = own.T.copy(order="F")
        work, _ = lapack.dgeqrf_lwork(*rows.shape)
        begin = time.process_time()
        lapack.dgeqrf(rows, lwork=int(work), overwrite_a=1)
        spent_s += time.process_time() - begin
    return spent_s


def main(data_path: str, urdf: str, predicted_path: str, repeats: str) -> None:
    """Time it, and keep what it predicts."""
    data = dict(np.load(data_path))
    robot = robot_from_urdf(Path(urdf).read_text())
    seconds = []
    for _ in range(int(repeats)):
        begin = time.process_time()
        fit = fit_torques(robot, _pieces(data))
        seconds.append({"total": time.process_time() - begin})
    largest_mb = peak_mb()
    columns = joint_columns(robot, _pieces(data))
    bare_qr = [_bare_qr_s(columns) for _ in range(int(repeats))]
    standard = joint_columns(robot, _pieces(data), all_standard=True)
    standard_qr = [_bare_qr_s(standard) for _ in range(int(repeats))]
    predicted = []
    for motion, torque in _pieces(data):
        room = standard_rows(robot, torque.shape[1])
        fill_rows(robot, motion, room)
        predicted.append(fit.predict(room))
    np.save(predicted_path, np.concatenate(predicted, axis=1))
    found = {
        "seconds": seconds,
        "base_parameters": len(fit.values),
        "residual_norm_nm": fit.residual_norm,
        "peak_mb": largest_mb,
        "bare_qr_seconds": bare_qr,
        "standard_qr_seconds": standard_qr,
    }
    sys.stdout.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
