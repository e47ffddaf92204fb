"""The whole way for robots that are not the paper's:
seven axes on a wall with a differential, and a gantry.
"""

from __future__ import annotations

import pytest
import yaml

from daq.cli.app import main
from daq.errors import ExitCode
from daq.log.conversion import load_run
from tests.pipeline.cells import Job, fit_job, record_job

pytestmark = pytest.mark.slow

ROBOTS = ("seven-axis", "gantry")


@pytest.fixture(scope="module", params=ROBOTS)
def job(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Job:
    """One run of 12 s without load and one with; longer ones are in tests/studies/any_robot.py."""
    name: str = request.param
    made, logs = record_job(name, tmp_path_factory.mktemp(name), seconds=12.0, pairs=1, seed=1)
    fit_job(made, logs)
    return made


def test_every_gain_is_found_within_what_it_claims(job: Job) -> None:
    assert len(job.gains) == len(job.cell.axes)
    for axis, (error, std) in job.gains.items():
        assert abs(error) < 4.0 * std, axis
        assert std < 2.0, axis
        assert abs(error) < 4.0, axis


def test_gains_and_parameters_have_the_units_of_their_joints(job: Job) -> None:
    calibration = job.calibration
    assert [gain["unit"] for gain in calibration["gains"]] == [
        f"{axis.unit.force}/A" for axis in job.cell.axes
    ]
    units = {parameter["name"]: parameter["unit"] for parameter in calibration["parameters"]}
    for number, axis in enumerate(job.cell.axes, start=1):
        assert units[f"fs{number}"] == axis.unit.force


def test_the_log_has_the_joints_where_the_plan_sent_them(job: Job) -> None:
    run, cell = load_run(job.folder / "bare-0.mcap")
    assert cell.digest == job.cell.digest
    for column, axis in zip(run.position_rad.T, cell.axes, strict=True):
        lower, upper = axis.limits.position
        assert lower < column.min() < column.max() < upper
        assert column.max() - column.min() > 0.3 * (upper - lower), axis.name


def test_apply_writes_each_gain_under_its_key(job: Job) -> None:
    controller = job.cell.controller_path
    assert controller is not None
    arguments = ["apply", str(job.folder / "calibration.yaml"), "--cell", str(job.cell_file)]
    assert main([*arguments, "--yes"]) == ExitCode.OK
    drives = yaml.safe_load(controller.read_text(encoding="utf-8"))["drives"]
    for gain in job.calibration["gains"]:
        assert drives[gain["axis"]]["gain"] == pytest.approx(gain["value"], rel=1e-4)
