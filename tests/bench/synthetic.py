"""Measurements of an arm whose every parameter is known, in pieces of any number."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ident.motion import Motion
from ident.robot import Robot
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
        rows = standard_rows(robot, motion.position_rad.shape[1])
        fill_rows(robot, motion, rows)
        torque = np.einsum("jck,c->jk", rows, parameters)
        yield motion, torque + NOISE_NM * rng.standard_normal(torque.shape)
