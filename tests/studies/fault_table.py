"""Tables of the damage study: each planted fault by each way,
and the judgement of recordings without any.

The simulated cell has its fault in one of four runs, on J2; an outcome is its largest gain error,
the error of the fit, and what is said of that axis. The TX-40 has it on J3, and its gains are held.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.simulation.simulation_file import load_simulation, shipped_simulation
from daq.workflow.plan import plan
from ident.arrays import FloatArray
from ident.data.channel_faults import find_faults
from ident.data.fault_text import found
from ident.data.run import Run
from tests.studies.direct_cell import RawRun, run_of, simulate_run
from tests.studies.effect_cells import EffectCase
from tests.studies.effect_runs import HELD_OUT, CaseTask, make_case
from tests.studies.fault_ways import WAYS, simulated_outcome, tx40_outcome
from tests.studies.output import print_line
from tests.studies.planted_faults import FAULTS, PlantedFault
from tests.studies.raw_runs import read_runs
from tests.studies.real_runs import RECORDINGS
from tests.studies.study_cells import world_cell
from tests.studies.study_plans import make_plan

CLEAN = EffectCase("clean", 2322, ())
SIMULATED_AXIS = 1
TX40_AXIS = 2
TX40_WAYS = ("arrays", "import")
ROBOTS = {
    "demo": "demo",
    "clean": "demo",
    "gantry": "gantry",
    "seven-axis": "seven-axis",
    "rx90": "rx90",
    "kr270": "kr270",
    "five-bar": "five-bar",
    "dualv": "dualv",
    "orthoglide": "orthoglide",
}
"""Cell of each shipped simulation."""
SOUND_S = 20.0
SOUND_SEED = 7


def write_fault_table(out: Path, world: str, data: Path) -> None:
    """Plant each fault, fit by each way, and write what became of it.

    Args:
        out: folder of the study.
        world: of the simulated cell.
        data: folder of the real recordings; without the TX-40's its columns are left out.
    """
    task = CaseTask(out, world, CLEAN)
    for wanted in task.plans:
        make_plan(wanted)
    make_case(task)
    raw = read_runs(task.path)[:-HELD_OUT]
    axes = world_cell(CLEAN.seed, world).bare.axes
    gain_nm_per_a = [axis.gain_nm_per_a for axis in axes]
    true_gains = np.array(gain_nm_per_a)
    tx40 = data / "tx40"
    heads = ["fault", *(f"simulated, {way}" for way in WAYS)]
    if tx40.is_dir():
        heads += [f"TX-40, {way}" for way in TX40_WAYS]
    file = out / "channel-faults.csv"
    with file.open("w", encoding="utf-8", newline="") as table:
        writer = csv.writer(table, lineterminator="\n")
        writer.writerow(heads)
        for fault in (None, *FAULTS):
            label = "none" if fault is None else fault.label
            row = [label, *_simulated(raw, true_gains, fault)]
            if tx40.is_dir():
                row += [tx40_outcome(tx40, fault, TX40_AXIS, way).row() for way in TX40_WAYS]
            writer.writerow(row)
            print_line(" | ".join(row))
    print_line(f"written: {file}")


def _simulated(
    raw: tuple[RawRun, ...], true_gains: FloatArray, fault: PlantedFault | None
) -> list[str]:
    """Outcomes of the simulated cell by each way; a log cannot hold what is not a number."""
    rows = []
    for way in WAYS:
        if way == "log" and fault is not None and fault.is_not_a_number:
            rows.append("cannot be recorded")
        else:
            row = simulated_outcome(raw, true_gains, fault, SIMULATED_AXIS, way).row()
            rows.append(row)
    return rows


def judge_sound_recordings(data: Path) -> None:
    """Print what is found in recordings without a planted fault:
    a simulated run of each robot, and the real ones.

    Args:
        data: folder of the real recordings; those that are not there are left out.
    """
    runs = [_simulated_run(simulation, cell) for simulation, cell in ROBOTS.items()]
    if data.is_dir():
        for name in ("tx40", "kr300-A", "ur10"):
            recording = RECORDINGS[name](data)
            runs += [(run, recording.cell.ratio) for run in recording.runs]
    alarms = 0
    for run, ratio in runs:
        # As the joints were recorded, too: an import judges the columns of its file.
        faults = (
            *find_faults(run.position_rad, run.current_a, run.rate_hz, ratio, run.valid),
            *find_faults(run.position_rad, run.current_a, run.rate_hz),
        )
        alarms += len(faults)
        said = "; ".join(found(one) for one in faults) or "nothing"
        line = f"{run.name}, {len(run.time_s)} samples of {len(ratio)} axes: {said}"
        print_line(line)
    print_line(f"{alarms} false alarms in {len(runs)} runs")


def _simulated_run(simulation: str, cell_name: str) -> tuple[Run, FloatArray]:
    """A run of a shipped robot without load, and the ratio of its drive train."""
    cells_folder = shipped_configurations() / "cells"
    path = cells_folder / f"{cell_name}.yaml"
    cell = load_cell(path)
    spec = load_simulation(shipped_simulation(simulation))
    moves = plan(cell, seed=SOUND_SEED, duration_s=SOUND_S)
    run = simulate_run(cell, spec, moves, simulation, None)
    return run_of(run, cell), cell.ratio
