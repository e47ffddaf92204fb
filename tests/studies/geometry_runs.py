"""Runs of the geometry study: of each robot and seed two without load and two with the weighed
payload, made once.

Mistakes are planted into their arrays or into the description afterwards (planted_mistakes.py). The
robots, their times and noise are those of the robot study (any_robot.py), so the relative error
without any mistake is the usual 3 to 4 %. Layout: out/geometry-study/runs/<robot>-<seed>.npz.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.simulation.simulation_file import load_simulation, shipped_simulation
from daq.workflow.plan import plan
from ident.arrays import FloatArray
from ident.data.run import Run
from ident.model.bodies import Payload
from tests.studies.any_robot import ROBOTS, StudiedRobot
from tests.studies.direct_cell import MOVING, RawRun, run_of, simulate_run
from tests.studies.fingerprint import digest, digest_of_source, finish, is_finished
from tests.studies.raw_runs import read_runs, write_runs

STUDIED = ("TX-40", "KR270", "seven-axis", "gantry")
PAIRS = 2  #: Of runs without and with the payload, each with a plan of its own
PAUSE_S = 20.0  #: From the end of one run to the beginning of the next
EXCHANGES = 50
"""Tries of the planner: what a plan leaves open makes σ larger, and no gain wrong."""
CONDITION = 1e6  #: The condition number is one of mixed units


@dataclass(frozen=True, slots=True)
class RunsOfRobot:
    """The runs of one robot and seed.

    Attributes:
        out: folder of the study.
        robot: of STUDIED.
        seed: of plans and noise.
    """

    out: Path
    robot: str
    seed: int

    @property
    def studied(self) -> StudiedRobot:
        """Its row of the robot study."""
        return next(robot for robot in ROBOTS if robot.name == self.robot)

    @property
    def path(self) -> Path:
        """File of the runs."""
        runs_folder = self.out / "runs"
        return runs_folder / f"{self.robot}-{self.seed}.npz"

    @property
    def cell(self) -> Cell:
        """The cell as declared."""
        cells_folder = shipped_configurations() / "cells"
        path = cells_folder / f"{self.studied.cell}.yaml"
        return load_cell(path)

    @property
    def true_gains(self) -> FloatArray:
        """Gains of the plant, shape (m,)."""
        path = shipped_simulation(self.studied.simulation)
        spec = load_simulation(path)
        gain_nm_per_a = [axis.gain_nm_per_a for axis in spec.axes]
        return np.array(gain_nm_per_a)


@functools.cache
def fingerprint_of_runs(task: RunsOfRobot) -> str:
    """Digest of what the runs of a robot depend on."""
    moving = digest_of_source("tests.studies.direct_cell", MOVING)
    return digest(moving, task.studied.fingerprint, task.seed, PAIRS, PAUSE_S, EXCHANGES, CONDITION)


def simulate(task: RunsOfRobot) -> tuple[RawRun, ...]:
    """Plan and make the runs of a robot."""
    robot = task.studied
    cell = task.cell
    body = cell.payloads[0]
    runs: list[RawRun] = []
    for pair in range(PAIRS):
        seed = 10 * task.seed + pair
        moves = plan(
            cell,
            seed=seed,
            duration_s=robot.seconds,
            exchanges=EXCHANGES,
            largest_condition=CONDITION,
        )
        for mounted in (None, body.name):
            path = shipped_simulation(robot.simulation)
            spec = load_simulation(path, mounted)
            axes = tuple(
                replace(axis, current_noise_a=robot.noise * axis.current_noise_a)
                for axis in spec.axes
            )
            number = len(runs)
            number_seed = 100 * task.seed + number
            spec = replace(spec, axes=axes, seed=number_seed)
            declared = None if mounted is None else body.payload
            name = f"{mounted or 'bare'}-{pair + 1}"
            began_s = number * (robot.seconds + PAUSE_S)
            run = simulate_run(cell, spec, moves, name, declared, began_s)
            runs.append(run)
    return tuple(runs)


def make_runs(task: RunsOfRobot) -> None:
    """Simulate the runs of a robot unless the same ones are there."""
    fingerprint = fingerprint_of_runs(task)
    if not is_finished(task.path, fingerprint):
        task.path.parent.mkdir(parents=True, exist_ok=True)
        write_runs(task.path, simulate(task))
        finish(task.path, fingerprint)


def load_runs(task: RunsOfRobot) -> tuple[Run, ...]:
    """The runs of a robot that `make_runs` made.

    Raises:
        FileNotFoundError: they have not been made.
    """
    cell = task.cell

    def payload_of(name: str) -> Payload:
        return next(body.payload for body in cell.payloads if body.name == name)

    runs = read_runs(task.path, payload_of)
    return tuple(run_of(raw, cell) for raw in runs)
