"""Two finished logs of 60 s at 1 kHz, without load and with the weighed payload,
from the simulated cell.

Recorded over the real driver path once, and kept: a log has its final name only when it is whole.

python -m tests.bench.finished_logs FOLDER     records what is missing
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

from daq.config.cell_buses import bus_address
from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.simulation.simulation_file import load_simulation, shipped_simulation
from daq.workflow.plan import load_plan, plan, save_plan
from daq.workflow.record import RecordingRequest, record
from drivers.canopen.bus import open_bus
from drivers.simulation.cell import SimulatedCell

DURATION_S = 60.0
SEED = 20
RUNS = (("bare", None), ("loaded", "disc"))


def main(path: str) -> None:
    """Record what is missing."""
    folder = Path(path)
    cell_file = shipped_configurations() / "cells" / "demo.yaml"
    cell = load_cell(cell_file)
    plan_path = folder / "plan.yaml"
    if not plan_path.exists():
        sys.stdout.write(f"planning a run of {DURATION_S:g} s\n")
        save_plan(plan(cell, seed=SEED, duration_s=DURATION_S), plan_path)
    moves = load_plan(plan_path, cell)
    payloads = {declared.name: declared.payload for declared in cell.payloads}
    for index, (name, payload) in enumerate(RUNS):
        log = folder / f"{name}.mcap"
        if log.exists():
            continue
        log.with_name(log.name + ".part").unlink(missing_ok=True)
        sys.stdout.write(f"recording {name} for {DURATION_S:g} s\n")
        sys.stdout.flush()
        spec = load_simulation(shipped_simulation("clean"), payload)
        bus = open_bus(bus_address(cell))
        try:
            with SimulatedCell(replace(spec, seed=SEED + index), bus):
                record(
                    RecordingRequest(
                        cell_file,
                        cell,
                        moves,
                        log,
                        payload=None if payload is None else payloads[payload],
                        operator="bench",
                        granted_by="the benchmark: a simulated cell",
                        run_id=f"bench-{name}",
                    )
                )
        finally:
            bus.shutdown()


if __name__ == "__main__":
    main(*sys.argv[1:])
