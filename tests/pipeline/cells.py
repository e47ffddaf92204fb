"""The whole way of a shipped simulated cell through the command line: plan, record, fit, and what came of it."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from daq.cli.app import main
from daq.config.bus import bus_address
from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.errors import ExitCode
from daq.simulation.simulation_file import load_simulation, shipped_simulation
from drivers.canopen.bus import open_bus
from drivers.simulation.cell import SimulatedCell


@dataclass(frozen=True)
class Job:
    """A finished job.

    Attributes:
        cell_file, cell: a copy of the shipped one.
        folder: with plans, logs and calibration.yaml.
        truth: true gain by axis.
    """

    cell_file: Path
    cell: Cell
    folder: Path
    truth: dict[str, float]

    @property
    def calibration(self) -> dict[str, Any]:
        """As written."""
        document: dict[str, Any] = yaml.safe_load((self.folder / "calibration.yaml").read_text(encoding="utf-8"))
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


def run_job(name: str, folder: Path, *, seconds: float, pairs: int, seed: int) -> Job:
    """Plan, record in turn without and with the cell's first payload, and fit.

    Args:
        name: of a shipped cell and of the simulation of the same name.
        folder: to fill.
        seconds: of each run [s].
        pairs: of runs, each with a plan of its own.
        seed: of plans and noise.
    """
    # A copy: what is written to a controller leaves an audit and a history beside the cell file.
    shutil.copytree(shipped_configurations(), folder / "configs")
    cell_file = folder / "configs" / "cells" / f"{name}.yaml"
    cell = load_cell(cell_file)
    payload, mass = cell.payloads[0].name, str(cell.payloads[0].mass_kg)
    logs = []
    for pair in range(pairs):
        plan = folder / f"plan-{pair}.yaml"
        arguments = ["--seed", str(10 * seed + pair), "--duration", str(seconds), "--exchanges", "100"]
        # The condition number is one of mixed units; how well the gains are seen is judged by their σ.
        _do(["plan", str(cell_file), "--out", str(plan), *arguments, "--condition", "1e6"])
        for mounted in (None, payload):
            logs.append(folder / f"{'bare' if mounted is None else 'loaded'}-{pair}.mcap")
            spec = load_simulation(shipped_simulation(name), mounted)
            bus = open_bus(bus_address(cell))
            try:
                with SimulatedCell(replace(spec, seed=100 * seed + len(logs)), bus):
                    chosen = [] if mounted is None else ["--payload", mounted, "--mass", mass]
                    moving = ["--enable-motion", "--operator", "test"]
                    _do(["record", str(cell_file), str(plan), "--out", str(logs[-1]), *moving, *chosen])
            finally:
                bus.shutdown()
    _do(["fit", *map(str, logs), "--out", str(folder / "calibration.yaml")])
    spec = load_simulation(shipped_simulation(name))
    truth = {axis.name: true.gain_nm_per_a for axis, true in zip(cell.axes, spec.axes, strict=True)}
    return Job(cell_file, cell, folder, truth)


def _do(arguments: list[str]) -> None:
    code = main(arguments)
    assert code == ExitCode.OK, f"drivegain {' '.join(arguments)} ended with {code}"


def as_json(text: str) -> dict[str, Any]:
    """Parse the output of a verb with --json."""
    document: dict[str, Any] = json.loads(text)
    return document
