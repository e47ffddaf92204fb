"""Noise floors beside the error of a fit on the same rows: a lower bound is at most 1, within its own deviation.

`python -m tests.studies.floor_study --seeds 1 2` prints a line a recording and source: each axis's floor relative to
what the fit leaves, ± σ, or "-" where there is none. Simulated cells repeat one plan, twice without and twice with
load, in every noise world; the real KR300 and TX-40, from ../shared/data or $DRIVEGAIN_DATA, repeat nothing.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np

from daq.cli.app import main as drivegain
from daq.config.cell import Cell, model_of
from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.log.conversion import load_run
from daq.workflow.plan import plan
from ident.data.run import Run
from ident.discovery.before_after import left_on
from ident.discovery.evidence import gather
from ident.discovery.noise_floor import FloorSource, noise_floors
from ident.estimators.identify import identify
from ident.estimators.method import Method
from tests.studies.direct_cell import run_of, simulate_run
from tests.studies.output import print_line
from tests.studies.study_cells import WORLDS, declared_payload, spec_of, world_cell

SHARED = Path(__file__).parents[3] / "shared" / "data"


def lines(name: str, cell: Cell, runs: Sequence[Run], *, fixed: bool) -> Iterator[str]:
    """One line of the table for each source."""
    gains = np.array([axis.nameplate_gain for axis in cell.axes]) if fixed else None
    found = identify(model_of(cell), runs, cell.conditioning, method=Method.ML, fixed_gains=gains)
    start = gather(found, runs)
    left_a = left_on(start.training, start.estimate)
    for source in FloorSource:
        floors = noise_floors(start.fit_runs, start.conditioning, (source,))
        ratios = [
            "-"
            if floor is None
            else f"{floor.noise_a / left:.2f} ± {floor.noise_a / left * floor.std_percent / 100:.2f}"
            for floor, left in zip(floors, left_a, strict=True)
        ]
        yield f"| {name} | {source.value} | {' | '.join(ratios)} |"


def simulated(world: str, seed: int, duration_s: float) -> tuple[Cell, list[Run]]:
    """Four runs of one plan."""
    cell, truth = load_cell(shipped_configurations() / "cells" / "demo.yaml"), world_cell(seed, world)
    moves, runs = plan(cell, seed=10 * seed, duration_s=duration_s), []
    for number, payload in enumerate((None, "disc", None, "disc")):
        declared = None if payload is None else declared_payload(payload)
        raw = simulate_run(cell, spec_of(truth, payload, number), moves, f"run-{number}", declared)
        runs.append(run_of(raw, cell))
    return cell, runs


def kr300(folder: Path) -> tuple[Cell, list[Run]]:
    """Three runs without load."""
    tables = {name: np.loadtxt(folder / f"kr300_{name}.csv", delimiter=",") for name in "ABC"}
    runs = [Run(name, table[:, 0], np.deg2rad(table[:, 1:7]), table[:, 7:13]) for name, table in tables.items()]
    return load_cell(folder / "kr300-cell.yaml"), runs


def tx40(folder: Path) -> tuple[Cell, list[Run]]:
    """One run without load."""
    with tempfile.TemporaryDirectory() as made, redirect_stdout(sys.stderr):
        log, description = Path(made) / "tx40.mcap", shipped_configurations() / "imports" / "tx40.yaml"
        drivegain(["import", str(description), "--data", str(folder), "--out", str(log)])
        run, cell = load_run(log)
    return cell, [run]


def main(arguments: list[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.floor_study", description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--worlds", choices=tuple(WORLDS), nargs="+", default=list(WORLDS))
    parser.add_argument("--duration", type=float, default=20.0, help="of each simulated run [s]")
    options = parser.parse_args(arguments)
    print_line("| recording | source | J1 | J2 | J3 | J4 | J5 | J6 |\n|---|---|---|---|---|---|---|---|")
    data = Path(os.environ.get("DRIVEGAIN_DATA", SHARED))
    for name, read in (("kr300", kr300), ("tx40", tx40)):
        if (data / name).is_dir():
            for line in lines(name, *read(data / name), fixed=True):
                print_line(line)
    for world in options.worlds:
        for seed in options.seeds:
            for line in lines(f"{world}, {seed}", *simulated(world, seed, options.duration), fixed=False):
                print_line(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
