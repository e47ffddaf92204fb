"""Logs of many simulated cells, no two of them alike:
gains, friction, links and the weighed mass are each cell's own.

    python -m tests.bench.fleet_cells FOLDER CELLS     makes what is missing

Motion and currents are the simulated cell's without a bus (tests/studies/direct_cell.py), the logs
are written by the recorder's own writer. FOLDER/<cell>/{bare,loaded,held-out}.mcap.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from daq.config.cell import Cell
from daq.config.cell_file import bundle, cell_from_bundle, load_cell
from daq.log.conversion import scaling
from daq.log.metadata import AxisReadback, Readback, RunInfo
from daq.log.writer import LogContent, LogWriter
from daq.workflow.plan import Plan, plan
from drivers.messages import CellEvent, EventKind, Sample
from drivers.simulation.spec import Body
from ident.model.bodies import Payload
from tests.studies.direct_cell import RawRun, simulate_run
from tests.studies.side_by_side import side_by_side
from tests.studies.study_cells import spec_of, study_cell
from tests.studies.study_plans import CELL

CELLS = 200
DURATION_S = 12.0
FIRST_SEED = 7001
PLAN_SETS = 4
RUNS = (("bare", False), ("loaded", True), ("held-out", True))
"""Runs of a session, in the order in which they are made."""
START_NS = 1_750_000_000_000_000_000
PERIOD_US = 1000  #: Of the demonstration's cell
BETWEEN_NS = 120_000_000_000
ENABLED = 0x1237
"""Statusword of an axis that moves, CiA 402."""


@dataclass(frozen=True, slots=True)
class FleetCell:
    """One cell to make.

    Attributes:
        folder: for its logs; made when they are whole.
        number: from 0; it decides all that is the cell's own.
        plans: of its runs.
        runs: how many of RUNS it has.
        period_us: between two samples.
    """

    folder: Path
    number: int
    plans: tuple[Plan, ...]
    runs: int = len(RUNS)
    period_us: int = PERIOD_US

    @property
    def name(self) -> str:
        """As its cell file says."""
        return f"cell-{self.number:03d}"


def plans_of(
    sets: int, exchanges: int, duration_s: float = DURATION_S
) -> tuple[tuple[Plan, ...], ...]:
    """Plans for the three runs of a cell, some sets of them.

    Args:
        sets: how many.
        exchanges: of the search for each.
        duration_s: of each run [s].
    """
    cell = load_cell(CELL)

    def one(seed: int) -> Plan:
        return plan(
            cell, seed=seed, duration_s=duration_s, exchanges=exchanges, largest_condition=1e6
        )

    return tuple(
        (one(FIRST_SEED + 3 * s), one(FIRST_SEED + 3 * s + 1), one(FIRST_SEED + 3 * s + 2))
        for s in range(sets)
    )


def make_cell(made: FleetCell) -> str:
    """Make one, or keep it; its name."""
    target = made.folder / made.name
    if target.exists():
        return made.name
    rng = np.random.default_rng(np.random.SeedSequence(FIRST_SEED + made.number, spawn_key=(9,)))
    truth = study_cell(FIRST_SEED + made.number)
    mass_kg = round(float(rng.uniform(3.5, 5.5)), 3)
    truth = replace(truth, bodies={"disc": _of_mass(truth.bodies["disc"], mass_kg)})
    files = bundle(CELL)
    files["cell.yaml"] = _own_file(files["cell.yaml"].decode(), made, mass_kg).encode()
    cell = cell_from_bundle(files)
    part = target.with_name(target.name + ".part")
    part.mkdir(parents=True, exist_ok=True)
    for number, (name, loaded) in enumerate(RUNS[: made.runs]):
        log = part / f"{name}.mcap"
        log.unlink(missing_ok=True)
        log.with_name(log.name + ".part").unlink(missing_ok=True)
        if loaded:
            payload = Payload("disc", "flange-a", {"m": mass_kg})
        else:
            payload = None
        spec = spec_of(truth, "disc" if loaded else None, number)
        steps = spec.substeps * made.period_us // spec.sync_period_us
        spec = replace(spec, sync_period_us=made.period_us, substeps=steps)
        raw = simulate_run(cell, spec, made.plans[number], name, payload)
        write_log(log, raw, cell, files, START_NS + number * BETWEEN_NS)
    part.rename(target)
    return made.name


def _own_file(text: str, made: FleetCell, mass_kg: float) -> str:
    """The demonstration's cell file with a name, serial numbers and a payload of its own."""
    text = re.sub(r"^name: demo$", f"name: {made.name}", text, flags=re.MULTILINE)
    text = re.sub(
        r"^  period_us: "
        rf"{PERIOD_US}$",
        f"  period_us: {made.period_us}",
        text,
        flags=re.MULTILINE,
    )
    text = re.sub(r"serial: 100(\d)", rf"serial: {10 + made.number}0\1", text)
    return re.sub(r"mass_kg: 4\.59$", f"mass_kg: {mass_kg}", text, flags=re.MULTILINE)


def _of_mass(body: Body, mass_kg: float) -> Body:
    """Return a body of the same shape and another density."""
    scale = mass_kg / body.mass_kg
    xx, xy, xz, yy, yz, zz = (scale * value for value in body.inertia_kg_m2)
    return replace(body, mass_kg=mass_kg, inertia_kg_m2=(xx, xy, xz, yy, yz, zz))


def write_log(path: Path, raw: RawRun, cell: Cell, files: dict[str, bytes], start_ns: int) -> None:
    """Write a run to a log as a recorder does."""
    answers = (
        AxisReadback(
            axis.name,
            float(unit),
            drive={"serial": None if axis.identity is None else axis.identity.serial},
        )
        for axis, unit in zip(cell.axes, raw.ampere_per_unit, strict=True)
    )
    readback = Readback(tuple(answers))
    if cell.sync is None:
        raise ValueError(f"cell {cell.name}: no sync period")
    period_ns = cell.sync.period_us * 1000
    run = RunInfo(
        f"{cell.name}-{raw.name}", 1e9 / period_ns, raw.payload, "bench", "bench 1", start_ns, 0
    )
    scale = scaling(cell, readback)
    bits = np.array(
        [0 if axis.profile is None or axis.profile.saturation_bit is None else 1 << axis.profile.saturation_bit  # noqa: E501
         for axis in cell.axes]
    )  # fmt: skip
    status = (ENABLED | raw.limited * bits).tolist()
    positions = raw.position_counts.tolist()
    currents = raw.current_raw.tolist()
    changes = np.flatnonzero(np.diff(raw.move, prepend=raw.move[0] - 1)).tolist()
    with LogWriter(
        path, LogContent.of(cell, run, files, readback), scale.joint_position_of, lambda: 0
    ) as log:
        for cycle, (position, current, word) in enumerate(
            zip(positions, currents, status, strict=True)
        ):
            time_ns = start_ns + cycle * period_ns
            if cycle in changes:
                log.event(
                    CellEvent(time_ns, None, EventKind.MOVE_START, int(raw.move[cycle]), "move")
                )
            log.write(Sample(cycle, time_ns, tuple(position), tuple(current), tuple(word)))
        log.conclude(True)


def make_fleet(folder: Path, cells: int, print_line: Callable[[str], None]) -> None:
    """Make the cells that are missing, on two processes."""
    if all((folder / FleetCell(folder, number, ()).name).is_dir() for number in range(cells)):
        return
    print_line(f"planning {3 * PLAN_SETS} runs of {DURATION_S:g} s")
    plans = plans_of(PLAN_SETS, exchanges=300)
    tasks = [FleetCell(folder, number, plans[number % PLAN_SETS]) for number in range(cells)]
    for done, name in enumerate(side_by_side(make_cell, tasks, 2), start=1):
        print_line(f"{name}: {done} of {cells} cells simulated")


def print_line(line: str) -> None:
    """A line at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main(folder: str, cells: str) -> int:
    """Make them."""
    make_fleet(Path(folder), int(cells), print_line)
    return 0


if __name__ == "__main__":
    raise SystemExit(main(*sys.argv[1:]))
