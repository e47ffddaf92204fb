"""Measurements of an arm whose every parameter is known, in pieces of any number.

python -m tests.bench.synthetic ROBOT.urdf SAMPLES DATA.npz     writes them for programs that want them whole
"""  # noqa: E501

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ident.model.robot import Motion, Robot
from ident.model.urdf import robot_from_urdf
from tests.bench.motion import sinusoids
from tests.bench.torque_fit import PIECE_SAMPLES, WIDTH, fill_rows, standard_rows

FloatArray = NDArray[np.float64]

NOISE_NM = 1.0
SEED = 20


def measurements(robot: Robot, samples: int) -> Iterator[tuple[Motion, FloatArray]]:
    """Motions, and the joint torques measured in them [Nm] with white noise of NOISE_NM."""
    rng = np.random.default_rng(SEED)
    parameters = rng.uniform(0.1, 1.0, WIDTH * robot.joint_count)
    for motion in sinusoids(robot.joint_count, SEED).pieces(samples, PIECE_SAMPLES):
        rows = standard_rows(robot, len(motion.position_rad))
        fill_rows(robot, motion, rows)
        torque = np.einsum("jck,c->jk", rows, parameters)
        yield motion, torque + NOISE_NM * rng.standard_normal(torque.shape)


def main(urdf: str, samples: str, path: str) -> None:
    """Write them: q, v, a and torque, each of shape (n, k)."""
    pieces = [
        (motion.position_rad.T, motion.velocity_rad_s.T, motion.acceleration_rad_s2.T, torque)
        for motion, torque in measurements(robot_from_urdf(Path(urdf).read_text()), int(samples))
    ]
    whole = [np.concatenate(parts, axis=1) for parts in zip(*pieces, strict=True)]
    np.savez(path, q=whole[0], v=whole[1], a=whole[2], torque=whole[3])


if __name__ == "__main__":
    main(*sys.argv[1:])
