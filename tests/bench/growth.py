"""How time and memory of the job grow with the number of samples: one size in a fresh process.

python -m tests.bench.growth ROBOT.urdf SAMPLES     prints one JSON object
"""

from __future__ import annotations

import json
import resource
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ident.model.robot import Motion, Robot
from ident.model.urdf import robot_from_urdf
from tests.bench.synthetic import measurements
from tests.bench.torque_fit import fit_torques

FloatArray = NDArray[np.float64]


class _Measured:
    """Measurements as they stream in, and the processor time that making them took,
    which is not the job's.
    """

    def __init__(self, robot: Robot, samples: int) -> None:
        self._pieces = measurements(robot, samples)
        self.seconds = 0.0

    def __iter__(self) -> Iterator[tuple[Motion, FloatArray]]:
        return self

    def __next__(self) -> tuple[Motion, FloatArray]:
        begin = time.process_time()
        try:
            return next(self._pieces)
        finally:
            self.seconds += time.process_time() - begin


def main(urdf: str, samples: str) -> None:
    """Fit so many samples, and report what it took."""
    robot = robot_from_urdf(Path(urdf).read_text())
    begin = time.process_time()
    measured = _Measured(robot, int(samples))
    fit = fit_torques(robot, measured)
    seconds = time.process_time() - begin - measured.seconds
    found = {
        "samples": int(samples),
        "seconds": seconds,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        "base_parameters": len(fit.values),
        "residual_std_nm": fit.residual_norm / np.sqrt(robot.joint_count * int(samples)),
    }
    sys.stdout.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
