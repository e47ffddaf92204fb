"""What the compiled program reads: measurements without a format,
and the joints of the robot as text.

python -m tests.bench.compiled_inputs DATA.npz ROBOT.urdf MEASUREMENTS JOINTS     writes them
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pinocchio


def main(data_path: str, urdf: str, measurements_path: str, joints_path: str) -> None:
    """Write the measurements of `tests.bench.synthetic`, and the tree of the joints."""
    data = np.load(data_path)
    with Path(measurements_path).open("wb") as measurements:
        np.array(data["q"].shape, dtype=np.int64).tofile(measurements)
        for name in ("q", "v", "a", "torque"):
            np.ascontiguousarray(data[name]).tofile(measurements)
    model = pinocchio.buildModelFromUrdf(urdf)
    lines: list[str] = []
    for number in range(1, model.njoints):
        placement = model.jointPlacements[number]
        numbers = [*placement.rotation.ravel(), *placement.translation]
        text = " ".join(repr(float(value)) for value in numbers)
        lines.append(f"{model.parents[number]} {model.joints[number].shortname()} {text}\n")
    Path(joints_path).write_text("".join(lines))


if __name__ == "__main__":
    main(*sys.argv[1:])
