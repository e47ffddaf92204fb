"""Simulated cells with closed chains on the bus: each amplifier follows its own trapezoid."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.simulation.amplifier import AmplifierSet
from drivers.simulation.plant import Plant
from drivers.simulation.spec import CellSpec
from tests.drivers.simulation.cells import FloatArray, running
from tests.drivers.simulation.test_closures import ROBOTS, cell

REACHED = 1 << 10
FOLLOWING_ERROR = 1 << 13


def counts(spec: CellSpec, joint: FloatArray) -> list[int]:
    """Motor counts of positions or rates of the motors' joints."""
    per_rad = np.array([axis.counts_per_revolution for axis in spec.axes]) / (2 * np.pi)
    return [int(value) for value in np.rint(spec.ratio @ joint * per_rad)]


def pose(plant: Plant, along: FloatArray, size: float) -> FloatArray:
    """Positions of the motors in a pose apart from the start."""
    assert plant.mechanism is not None
    n = len(plant._gain)
    moved = plant._basis @ along
    absolute_moved = np.abs(moved[:n])
    largest_absolute_moved = absolute_moved.max()
    return plant.mechanism.closed(
        plant.mechanism.start_rad + size * moved / largest_absolute_moved
    )[:n]


@pytest.mark.slow
@pytest.mark.parametrize("payload", [False, True])
@pytest.mark.parametrize("name", ROBOTS)
def test_moves_are_reached_and_the_loops_stay_closed(
    name: str, payload: bool, request: pytest.FixtureRequest
) -> None:
    bodies = {"five-bar": "disc", "orthoglide": "block", "dualv": "disc"}
    spec = cell(name, bodies[name] if payload else None)
    nodes = range(1, len(spec.axes) + 1)
    along = np.array([1.0, -0.6, 0.5][: 3 if name != "five-bar" else 2])
    goal = pose(
        Plant(spec),
        along,
        0.04 if name[0] == "o" else 0.3,
    )
    duration_s = 0.4
    ramp_s = 0.15
    with running(spec, request.node.name) as (there, master):
        master.set_up(nodes)
        master.enable(nodes)
        speed = goal / (duration_s - ramp_s)
        rows = zip(
            counts(spec, goal), counts(spec, speed), counts(spec, speed / ramp_s), strict=True
        )
        for node, (place, velocity, acceleration) in zip(nodes, rows, strict=True):
            settings = [(0x607A, "i", place), (0x6081, "I", abs(velocity))]
            settings += [(index, "I", abs(acceleration)) for index in (0x6083, 0x6084)]
            for index, kind, value in settings:
                assert master.write(node, index, 0, kind, value) == 0
        master.control(nodes, 0x1F)
        answers = [master.sync(len(spec.axes)) for _ in range(450)]
        words = np.array(answers)[:, :, 2]
        last_word = words[-1]
        assert (last_word & REACHED).all()
        assert not (words & FOLLOWING_ERROR).any()
        last_answer = answers[-1]
        positions = [position for position, _, _ in last_answer]
        found = np.array(positions)
        difference = found - counts(spec, goal)
        assert (np.abs(difference) <= 655).all()
        plant = there.plant
        assert plant.mechanism is not None
        largest_error = np.abs(plant.mechanism.at(plant.position_rad)[0]).max()
        assert largest_error < 1e-11


@pytest.mark.slow
def test_redundant_drives_preload_the_platform_while_their_trapezoids_disagree() -> None:
    """The currents have a part that moves nothing; it passes when the drives agree again."""
    spec = cell("dualv")
    plant = Plant(spec)
    amplifiers = AmplifierSet(spec, plant)
    assert plant.mechanism is not None
    assert (amplifiers.loops["integral_1_s"] == 0.0).all()
    closed = np.zeros(4, dtype=np.bool_)
    plant.set_brakes(closed)
    amplifiers.loops["enabled"] = 1
    along = np.array([1.0, -0.6, 0.5])
    goal = pose(plant, along, 0.4)
    start = np.zeros(4)
    inner = []
    for k in range(4000):
        share = min(1.0, k / 2000)
        blend = share * share * (3.0 - 2.0 * share)
        joint = start + blend * (goal - start)
        amplifiers.loops["demand"] = amplifiers.loops["target"] = np.rint(counts(spec, joint))
        amplifiers.control(plant.motor_rad)
        plant.step(amplifiers.loops["current_a"])
        current_a = amplifiers.loops["current_a"]
        torque = plant._rows.T @ (plant._gain * current_a)
        hidden = np.linalg.svd(plant._basis[:4].T)[2][3]  # the null space of Aᵀ
        inner.append(abs(hidden @ torque))
    assert max(inner[:2000]) > 1.0  # [Nm]; friction of a motor is 0.3
    largest_inner = max(inner[:2000])
    assert inner[-1] < 0.5 * largest_inner
