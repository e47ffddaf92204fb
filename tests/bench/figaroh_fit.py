"""The same job by figaroh, in an environment of its own:
run there as a script, it imports nothing of ours.

The calls are those of figaroh's own BaseIdentification (1.0.2): calculate_full_regressor, then
solve(decimate=False), without its reports, plots and files: build_regressor_basic,
get_index_eliminate, build_regressor_reduced, QRDecomposer.double_decomposition (which solves the
least squares too) with the tolerances that BaseIdentification gives them.

    python figaroh_fit.py DATA.npz ROBOT.urdf PREDICTED.npy REPEATS     prints one JSON object
"""

from __future__ import annotations

import json
import resource
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from figaroh.identification.parameter import (  # type: ignore[import-not-found]
    add_standard_additional_parameters,
    get_standard_parameters,
)
from figaroh.tools.qrdecomposition import QRDecomposer  # type: ignore[import-not-found]
from figaroh.tools.regressor import (  # type: ignore[import-not-found]
    build_regressor_basic,
    build_regressor_reduced,
    get_index_eliminate,
)
from figaroh.tools.robot import Robot  # type: ignore[import-not-found]


def main(data_path: str, urdf: str, predicted_path: str, repeats: str) -> None:
    """Time it, and keep what it predicts."""
    data = np.load(data_path)
    position, velocity, acceleration = (
        np.ascontiguousarray(data[name].T) for name in ("q", "v", "a")
    )
    torque = data["torque"].reshape(-1)
    robot = Robot(urdf, str(Path(urdf).parent))
    joints = position.shape[1]
    config: dict[str, Any] = {
        "has_friction": True, "has_actuator_inertia": True, "has_joint_offset": True,
        "is_joint_torques": True, "is_external_wrench": False, "act_idxv": list(range(joints)),
        "fv": [0.0] * joints, "fs": [0.0] * joints, "Ia": [0.0] * joints, "off": [0.0] * joints,
    }  # fmt: skip
    standard = get_standard_parameters(robot.model, config)
    standard.update(add_standard_additional_parameters(robot.model, config))
    seconds = []
    for _ in range(int(repeats)):
        begin = time.process_time()
        whole = build_regressor_basic(robot, position, velocity, acceleration, config)
        built = time.process_time()
        eliminated, names = get_index_eliminate(whole, standard, tol_e=0.001)
        reduced = build_regressor_reduced(whole, eliminated)
        base_rows, _, _, values, _ = QRDecomposer(tolerance=1e-6).double_decomposition(
            torque, reduced, names, standard
        )
        end = time.process_time()
        seconds.append({"total": end - begin, "build": built - begin, "base_and_ls": end - built})
    predicted = base_rows @ values
    np.save(predicted_path, predicted.reshape(joints, -1))
    found = {
        "seconds": seconds,
        "base_parameters": len(values),
        "residual_norm_nm": float(np.linalg.norm(torque - predicted)),
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
    }
    sys.stdout.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
