"""figaroh reads the exported URDF: its regressor times the parameters that it finds is the
predicted torque.
"""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from daq.cli.app import main
from tests.bench.figaroh_environment import FIGAROH, FIGAROH_VENV, has_figaroh
from tests.conftest import CHECKOUT
from tests.daq.robot_calibrations import apart, robot_of


@pytest.mark.parametrize("name", ["tx40", "kr270"])
def test_the_torque_of_the_urdf_and_of_the_list_is_the_predicted_one(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """figaroh takes rotors, friction and offsets as numbers beside the URDF;
    gravity is downwards for it.
    """
    environment = CHECKOUT / FIGAROH_VENV
    if not has_figaroh(environment):
        pytest.skip(
            f"no {FIGAROH} in {FIGAROH_VENV}, an environment of its own, because it brings another "
            "Pinocchio than ours: `make figaroh` makes it, 1 GB"
        )
    python = environment / "bin/python"
    robot = robot_of(name)
    out = tmp_path / "robot.urdf"
    assert (
        main(
            [
                "export",
                "urdf",
                str(robot.cell_file),
                str(robot.saved(tmp_path)),
                "--out",
                str(out),
                "--json",
            ]
        )
        == 0
    )
    report = json.loads(capsys.readouterr().out)
    value_of = {entry["name"]: entry["value"] for entry in report["not_in_urdf"]}
    count = robot.model.robot.joint_count
    own = {}
    for key in ("Ia", "off"):
        own[key] = np.array([value_of[f"{key}{number}"] for number in range(1, count + 1)])
    states = robot.states
    np.savez(
        tmp_path / "states.npz",
        q=states.position_rad,
        v=states.velocity_rad_s,
        a=states.acceleration_rad_s2,
        fv=np.array([joint["damping"] for joint in report["joints"]]),
        fs=np.array([joint["friction"] for joint in report["joints"]]),
        Ia=own["Ia"],
        off=own["off"],
    )
    script = Path(__file__).with_name("figaroh_torque.py")
    command = [python, script, out, tmp_path / "states.npz", tmp_path / "torque.npy"]
    done = subprocess.run(
        [str(word) for word in command], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    # What motors that turn with several joints have along their direction, figaroh does not know.
    along = np.zeros(len(robot.model.columns))
    for place, column in enumerate(robot.model.columns):
        if column.name.startswith(("Iam", "fvm", "fsm")):
            along[place] = value_of.get(column.name, 0.0)
    found = np.load(tmp_path / "torque.npy") + np.einsum(
        "jck,c->jk", robot.model.regressor(states), along
    )
    assert apart(found, robot.predicted_nm()) <= 1e-6
