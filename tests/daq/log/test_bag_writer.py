"""`drivegain export bag`: a folder that other programs read, with the numbers that a fit gets."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rosbags.highlevel import AnyReader

from daq.config.cell_file import load_cell
from daq.errors import ConfigurationInconsistent, ExitCode, UsageError
from daq.log.bag_writer import export_bag, joint_effort, mean_velocity
from daq.log.conversion import load_run
from daq.log.writer import LogWriter
from drivers.messages import CellEvent, EventKind, Quantity, SlowReading
from ident.calibration import Calibration
from tests.daq.calibrations import demo_calibration
from tests.daq.command_line import run_verb
from tests.daq.logs import START_NS, demo_content, joints, samples

AXES = 6
ROWS = 200
GAINS = {f"J{number}": 10.0 * number for number in range(1, AXES + 1)}


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory, checkout: Path) -> Path:
    """Axis k turns at 100 (k + 1) counts a sample; a torque, a temperature and an event."""
    path = tmp_path_factory.mktemp("log") / "bare.mcap"
    with LogWriter(path, demo_content(checkout), joints, clock_ns=lambda: 0) as log:
        event = CellEvent(START_NS, 2, EventKind.EMCY, 0x8611, "J3 (node 3): following error")
        log.event(event)
        time_ns = START_NS + 5_400_000
        slow_reading = SlowReading(time_ns, 1, Quantity.TORQUE, 0.25)
        log.reading(slow_reading)
        start_ns_time_ns = START_NS - 1
        log.reading(SlowReading(start_ns_time_ns, 0, Quantity.TEMPERATURE, 31.5))
        rows = []
        for row in range(ROWS):
            rows.append([100 * (axis + 1) * row for axis in range(AXES)])
        for sample in samples(rows):
            log.write(sample)
        log.conclude(True)
    return path


def _calibration() -> Calibration:
    made = demo_calibration()
    gains = tuple(replace(gain, value=GAINS[gain.axis]) for gain in made.gains)
    return replace(made, gains=gains)


def _read(path: Path) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {}
    with AnyReader([path]) as reader:
        for connection, _, data in reader.messages():
            found.setdefault(connection.topic, []).append(
                reader.deserialize(data, connection.msgtype)
            )
    return found


def test_rosbags_reads_a_bag_with_the_numbers_of_the_fit(
    log: Path, tmp_path: Path, checkout: Path
) -> None:
    done = export_bag(log, tmp_path / "bag", _calibration())
    found = _read(tmp_path / "bag")
    assert {topic: len(messages) for topic, messages in found.items()} == done.messages
    run, cell = load_run(log)
    states = found["/joint_states"]
    assert states[0].name == list(cell.axis_names)  # the URDF's joints have the same names
    positions = [state.position for state in states]
    np.testing.assert_array_equal(positions, run.position_rad)
    current_a = [one.current_a for one in found["/cell/currents"]]
    np.testing.assert_array_equal(current_a, run.current_a)
    position_difference_rad = run.position_rad[-1] - run.position_rad[0]
    speed = position_difference_rad / ((ROWS - 1) * 1e-3)
    expected = np.tile(speed, (ROWS, 1))
    velocities = [state.velocity for state in states]
    np.testing.assert_allclose(velocities, expected, rtol=1e-9)
    # Motor 6 turns with joints 5 and 6, so joint 5 carries the torque of both.
    torque = np.array(list(GAINS.values())) * run.current_a
    torque[:, 4] += torque[:, 5]
    efforts = [state.effort for state in states]
    np.testing.assert_allclose(efforts, torque, rtol=1e-12)
    sec = states[0].header.stamp.sec
    nanosec = states[0].header.stamp.nanosec
    assert sec * 10**9 + nanosec == START_NS
    assert "<robot" in found["/robot_description"][0].data
    cell_torque = found["/cell/torque"][0].value
    assert found["/cell/torque"][0].axis == 1
    assert cell_torque == 0.25
    assert found["/cell/temperature"][0].value == 31.5
    assert found["/cell/events"][0].text == "J3 (node 3): following error"


def test_rosbags_reads_the_log_itself(log: Path) -> None:
    found = _read(log)
    expected = [100 * (axis + 1) for axis in range(AXES)]
    position_counts = found["/cell/samples"][1].position_counts
    assert list(position_counts) == expected
    states = found["/joint_states"]
    currents = found["/cell/currents"]
    assert len(states) == len(currents) == ROWS // 20
    velocities = [state.velocity for state in states[1:]]
    np.testing.assert_allclose(velocities, np.tile(100.0 * np.arange(1, 7), (9, 1)))
    velocity = list(states[0].velocity)
    assert velocity == [0.0] * AXES
    assert len(states[0].effort) == 0
    current_a = currents[1].current_a
    np.testing.assert_allclose(current_a, -0.002 * 20 * 100.0 * np.arange(1, 7))
    assert "<robot" in found["/robot_description"][0].data


def test_the_description_is_kept_for_late_subscribers_and_the_rest_is_not(
    log: Path, tmp_path: Path
) -> None:
    export_bag(log, tmp_path / "bag")
    text = (tmp_path / "bag/metadata.yaml").read_text()
    said = yaml.safe_load(text)["rosbag2_bagfile_information"]
    topics = [topic["topic_metadata"] for topic in said["topics_with_message_count"]]
    durability = {}
    for topic in topics:
        durability[topic["name"]] = yaml.safe_load(topic["offered_qos_profiles"])[0]["durability"]
    assert durability.pop("/robot_description") == 1
    assert set(durability.values()) == {2}
    assert said["relative_file_paths"] == ["bag_0.mcap"]
    path = tmp_path / "bag"
    joint_states = _read(path)["/joint_states"]
    for state in joint_states:
        assert len(state.effort) == 0


def test_a_velocity_is_the_mean_over_twenty_milliseconds_and_less_at_the_ends() -> None:
    time_ns = np.arange(100) * 1_000_000 + START_NS
    time_s = 1e-3 * np.arange(100.0)
    position = np.stack((time_s**2, 3.0 * time_s), axis=1)
    found = mean_velocity(position, time_ns)
    expected = 2.0 * time_s[10:-10]
    actual = found[10:-10, 0]
    np.testing.assert_allclose(actual, expected, rtol=1e-6)
    np.testing.assert_allclose(found[:, 1], 3.0, rtol=1e-6)
    assert found[0, 0] == pytest.approx(0.01, rel=1e-6)  # of the first 10 ms
    # At a slow rate the neighbours are farther away than that.
    slow = mean_velocity(np.array([[0.0], [1.0], [3.0]]), np.array([0, 10**9, 2 * 10**9]))
    np.testing.assert_allclose(slow[:, 0], [1.0, 1.5, 2.0])


def test_a_coupled_motor_acts_on_both_joints(checkout: Path) -> None:
    cell = load_cell(checkout / "configs/cells/gantry.yaml")
    # Belt motors with opposite currents and gains of opposite signs push along X; with equal ones
    # along Y.
    gains = [100.0, -100.0, 150.0, 12.0, 7.0]
    current = np.array([[1.0, -1.0, 0.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0, 0.0]])
    effort = joint_effort(cell, current, gains)
    absolute_effort = abs(effort[0, 0])
    expected = 0.0 if effort[0, 1] else 200.0
    assert absolute_effort == pytest.approx(expected)
    orders = np.abs(effort[:, :2]).ravel().tolist()
    sorted_absolute_efforts = sorted(orders)
    assert sorted_absolute_efforts == pytest.approx([0.0, 0.0, 200.0, 200.0])


def test_the_verb_says_what_it_wrote_and_refuses_what_is_there(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "bag"
    assert run_verb("export", "bag", log, "--out", out, "--json") == ExitCode.OK
    said = json.loads(capsys.readouterr().out)
    assert said["messages"]["/joint_states"] == ROWS
    assert said["effort"] is False
    with pytest.raises(UsageError, match="a folder of that name"):
        export_bag(log, out)
    gains = _calibration().gains[::-1]
    for other in (
        replace(_calibration(), cell="other"),
        replace(_calibration(), gains=gains),
    ):
        with pytest.raises(ConfigurationInconsistent, match="as in the calibration"):
            export_bag(log, tmp_path / "other", other)
    names = [path.name for path in tmp_path.iterdir()]
    assert names == ["bag"]
