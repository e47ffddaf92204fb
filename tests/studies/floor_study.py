"""Noise floors beside the error of a fit on the same rows:
which part of it they are, and whether they bound it.

`python -m tests.studies.floor_study --seeds 1 2` prints a line a recording and source: the noise of
each axis by that source relative to what the fit leaves, ± σ, or "-" where there is none. Then, for
each noise world and source, how many lower limits are above the error of the fit, which is of the
right model: one in twenty, if the limit is a bound. Simulated cells repeat one plan, twice without
and twice with load, or with `--apart` have a plan for each run, so that standstill is the only
source; `--worlds clean --apart --duration 40` is like the demonstration. The real KR300 and TX-40,
from ../shared/data or $DRIVEGAIN_DATA, repeat nothing.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from itertools import chain
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
from tests.studies.study_cells import WORLDS, declared_payload, spec_of, study_cell, world_cell

SHARED = Path(__file__).parents[3] / "shared" / "data"


UNCHANGED = "clean"  #: World of the clean cell itself, with its own noise in the currents alone


@dataclass(frozen=True, slots=True)
class FloorScore:
    """Noise of each axis relative to what the fit leaves."""

    lines: tuple[str, ...]  #: of the table
    #: lower limits by each source, of the axes where it is known
    least: dict[FloorSource, list[float]]


def measure(name: str, cell: Cell, runs: Sequence[Run], *, fixed: bool) -> FloorScore:
    """Compare the noise by each source with the error of a fit."""
    if fixed:
        nameplate_gains = [axis.nameplate_gain for axis in cell.axes]
        gains = np.array(nameplate_gains)
    else:
        gains = None
    found = identify(model_of(cell), runs, cell.conditioning, method=Method.ML, fixed_gains=gains)
    start = gather(found, runs)
    left_a = left_on(start.training, start.estimate)
    lines: list[str] = []
    least: dict[FloorSource, list[float]] = {}
    for source in FloorSource:
        floors = noise_floors(start.fit_runs, start.conditioning, (source,))
        ratios = [
            "-"
            if floor is None
            else f"{floor.noise_a / left:.2f} ± "
            f"{floor.noise_a / left * floor.std_percent / 100:.2f}"
            for floor, left in zip(floors, left_a, strict=True)
        ]
        lines.append(f"| {name} | {source.value} | {' | '.join(ratios)} |")
        known = zip(floors, left_a, strict=True)
        least[source] = [floor.least_a / float(left) for floor, left in known if floor is not None]
    return FloorScore(tuple(lines), least)


def simulated(world: str, seed: int, duration_s: float, *, apart: bool) -> tuple[Cell, list[Run]]:
    """Four runs of one plan, or of one plan each."""
    path = shipped_configurations() / "cells" / "demo.yaml"
    cell = load_cell(path)
    if world == UNCHANGED:
        truth = study_cell(seed)
    else:
        truth = world_cell(seed, world)
    plans = [
        plan(cell, seed=10 * seed + number, duration_s=duration_s)
        for number in range(4 if apart else 1)
    ]
    runs: list[Run] = []
    for number, payload in enumerate((None, "disc", None, "disc")):
        if payload is None:
            declared = None
        else:
            declared = declared_payload(payload)
        moves = plans[number % len(plans)]
        spec = spec_of(truth, payload, number)
        raw = simulate_run(cell, spec, moves, f"run-{number}", declared)
        runs.append(run_of(raw, cell))
    return cell, runs


def kr300(folder: Path) -> tuple[Cell, list[Run]]:
    """Three runs without load."""
    tables = {name: np.loadtxt(folder / f"kr300_{name}.csv", delimiter=",") for name in "ABC"}
    runs = [
        Run(name, table[:, 0], np.deg2rad(table[:, 1:7]), table[:, 7:13])
        for name, table in tables.items()
    ]
    path = folder / "kr300-cell.yaml"
    return load_cell(path), runs


def tx40(folder: Path) -> tuple[Cell, list[Run]]:
    """One run without load."""
    with tempfile.TemporaryDirectory() as made, redirect_stdout(sys.stderr):
        log = Path(made) / "tx40.mcap"
        description = shipped_configurations() / "imports" / "tx40.yaml"
        drivegain(["import", str(description), "--data", str(folder), "--out", str(log)])
        run, cell = load_run(log)
    return cell, [run]


def main(arguments: list[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.floor_study", description=__doc__
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    choices = (*WORLDS, UNCHANGED)
    parser.add_argument("--worlds", choices=choices, nargs="+", default=list(WORLDS))
    parser.add_argument("--duration", type=float, default=20.0, help="of each simulated run [s]")
    parser.add_argument(
        "--apart", action="store_true", help="a plan for each run: no move is repeated"
    )
    options = parser.parse_args(arguments)
    print_line(
        "| recording | source | J1 | J2 | J3 | J4 | J5 | J6 |\n|---|---|---|---|---|---|---|---|"
    )
    data = Path(os.environ.get("DRIVEGAIN_DATA", SHARED))
    for name, read in (("kr300", kr300), ("tx40", tx40)):
        if (data / name).is_dir():
            for line in measure(name, *read(data / name), fixed=True).lines:
                print_line(line)
    for world in options.worlds:
        scores: list[FloorScore] = []
        for seed in options.seeds:
            recordings = simulated(world, seed, options.duration, apart=options.apart)
            scores.append(measure(f"{world}, {seed}", *recordings, fixed=False))
            for line in scores[-1].lines:
                print_line(line)
        for source in FloorSource:
            ratios = np.array(list(chain.from_iterable(score.least[source] for score in scores)))
            if len(ratios):
                print_line(
                    f"{world}, {source.value}: {np.sum(ratios > 1.0)} of {len(ratios)} lower "
                    f"limits above the error of the fit; they are {ratios.min():.2f} to "
                    f"{ratios.max():.2f} of it, median {np.median(ratios):.2f}"
                )
    return 0


if __name__ == "__main__":
    sys.exit(main())
