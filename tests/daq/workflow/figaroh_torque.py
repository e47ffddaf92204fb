"""Torque of a URDF by figaroh's regressor, in an environment of its own: run there as a script.

python figaroh_torque.py ROBOT.urdf STATES.npz TORQUE.npy

STATES has q, v, a of shape (k, n), and Ia, fv, fs, off of each joint; TORQUE is W φ, shape (n, k).
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from figaroh.identification.parameter import (  # type: ignore[import-not-found]
    add_standard_additional_parameters,
    get_standard_parameters,
)
from figaroh.tools.regressor import build_regressor_basic  # type: ignore[import-not-found]
from figaroh.tools.robot import Robot  # type: ignore[import-not-found]


def main(urdf: str, states_path: str, torque_path: str) -> None:
    """Multiply regressor and standard parameters."""
    states = np.load(states_path)
    robot = Robot(urdf, str(Path(urdf).parent))
    joints = states["q"].shape[1]
    config: dict[str, Any] = {
        "has_friction": True,
        "has_actuator_inertia": True,
        "has_joint_offset": True,
        "is_joint_torques": True,
        "is_external_wrench": False,
        "act_idxv": list(range(joints)),
    }
    for name in ("Ia", "fv", "fs", "off"):
        config[name] = states[name].tolist()
    parameters = get_standard_parameters(robot.model, config)
    parameters.update(add_standard_additional_parameters(robot.model, config))
    columns = build_regressor_basic(robot, states["q"], states["v"], states["a"], config)
    values = np.array(list(parameters.values()), dtype=np.float64)
    np.save(torque_path, (columns @ values).reshape(joints, -1))


if __name__ == "__main__":
    main(*sys.argv[1:])
