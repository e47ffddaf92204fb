"""The whole way of a shipped simulated cell through the command line:
plan, record, fit, and what came of it.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from daq.cli.app import main
from daq.config.cell import Cell
from daq.config.cell_buses import bus_address
from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.errors import ExitCode
from daq.simulation.simulation_file import load_simulation, shipped_simulation
from drivers.canopen.bus import open_bus
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.spec import CellSpec, UndeclaredEffect


@dataclass(frozen=True)
class Job:
    """A finished job.

    Attributes:
        cell_file, cell: a copy of the shipped one.
        folder: with plans, logs and calibration.yaml.
        truth: true gain by axis.
        simulation: name of the shipped simulation.
        noise: factor of its current noise.
    """

    cell_file: Path
    cell: Cell
    folder: Path
    truth: dict[str, float]
    simulation: str
    noise: float = 1.0

    @property
    def calibration(self) -> dict[str, Any]:
        """As written."""
        document: dict[str, Any] = yaml.safe_load(
            (self.folder / "calibration.yaml").read_text(encoding="utf-8")
        )
        return document

    @property
    def gains(self) -> dict[str, tuple[float, float]]:
        """Error and σ of each axis, both in percent of the truth."""
        return {
            gain["axis"]: (
                100.0 * (gain["value"] / self.truth[gain["axis"]] - 1.0),
                100.0 * gain["std"] / abs(self.truth[gain["axis"]]),
            )
            for gain in self.calibration["gains"]
        }


def record_job(
    name: str,
    folder: Path,
    *,
    seconds: float,
    pairs: int,
    seed: int,
    simulation: str | None = None,
    exchanges: int = 100,
    effects: tuple[UndeclaredEffect, ...] = (),
    noise: float = 1.0,
    changed: Callable[[CellSpec], CellSpec] = lambda spec: spec,
) -> tuple[Job, list[Path]]:
    """Plan, and record in turn without and with the cell's first payload;
    return the job and its logs.

    Args:
        name: of a shipped cell.
        folder: to fill.
        seconds: of each run [s].
        pairs: of runs, each with a plan of its own.
        seed: of plans and noise.
        simulation: name of the shipped simulation; that of the cell when None.
        exchanges: of moves in planning.
        effects: of the plant, beside those of the simulation file.
        noise: factor of the current noise of the simulation file.
        changed: makes another plant of the simulation's.
    """
    # A copy: what is written to a controller leaves an audit and a history beside the cell file.
    shutil.copytree(shipped_configurations(), folder / "configs")
    cell_file = folder / "configs" / "cells" / f"{name}.yaml"
    cell = load_cell(cell_file)
    plant = load_simulation(shipped_simulation(simulation or name))
    truth = {
        axis.name: true.gain_nm_per_a for axis, true in zip(cell.axes, plant.axes, strict=True)
    }
    job = Job(cell_file, cell, folder, truth, simulation or name, noise)
    logs = []
    for pair in range(pairs):
        plan = make_plan(
            job, f"plan-{pair}.yaml", seed=10 * seed + pair, seconds=seconds, exchanges=exchanges
        )
        for mounted in (None, cell.payloads[0].name):
            logs.append(folder / f"{'bare' if mounted is None else 'loaded'}-{pair}.mcap")
            record_run(
                job,
                plan,
                logs[-1],
                mounted=mounted,
                declared=mounted is not None,
                seed=100 * seed + len(logs),
                effects=effects,
                changed=changed,
            )
    return job, logs


def fit_job(job: Job, logs: Sequence[Path]) -> None:
    """Fit logs into the calibration of the job's folder."""
    _do(["fit", *map(str, logs), "--out", str(job.folder / "calibration.yaml")])


def make_plan(job: Job, name: str, *, seed: int, seconds: float, exchanges: int = 100) -> Path:
    """Plan a run of a job's cell; return the plan's file in its folder."""
    path = job.folder / name
    arguments = ["--seed", str(seed), "--duration", str(seconds), "--exchanges", str(exchanges)]
    # The condition number is one of mixed units; how well the gains are seen is judged by their σ.
    _do(["plan", str(job.cell_file), "--out", str(path), *arguments, "--condition", "1e6"])
    return path


def record_run(
    job: Job,
    plan: Path,
    log: Path,
    *,
    mounted: str | None,
    declared: bool,
    seed: int,
    effects: tuple[UndeclaredEffect, ...] = (),
    changed: Callable[[CellSpec], CellSpec] = lambda spec: spec,
) -> None:
    """Record a plan over the driver.

    Args:
        job: whose cell is simulated.
        plan: its file.
        log: to write.
        mounted: body of the simulation, or None.
        declared: whether the recording names it as a weighed payload of the cell.
        seed: of the noise.
        effects: of the plant, beside those of the simulation file.
        changed: makes another plant of the simulation's.
    """
    spec = changed(load_simulation(shipped_simulation(job.simulation), mounted))
    axes = tuple(
        replace(axis, current_noise_a=job.noise * axis.current_noise_a) for axis in spec.axes
    )
    chosen = []
    if declared:
        mass_kg = next(payload.mass_kg for payload in job.cell.payloads if payload.name == mounted)
        chosen = ["--payload", str(mounted), "--mass", str(mass_kg)]
    bus = open_bus(bus_address(job.cell))
    try:
        with SimulatedCell(
            replace(spec, axes=axes, seed=seed, effects=spec.effects + effects), bus
        ):
            moving = ["--enable-motion", "--operator", "test"]
            _do(["record", str(job.cell_file), str(plan), "--out", str(log), *moving, *chosen])
    finally:
        bus.shutdown()


def _do(arguments: list[str]) -> None:
    code = main(arguments)
    assert code == ExitCode.OK, f"drivegain {' '.join(arguments)} ended with {code}"


def as_json(text: str) -> dict[str, Any]:
    """Parse the output of a verb with --json."""
    document: dict[str, Any] = json.loads(text)
    return document
