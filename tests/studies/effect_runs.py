"""Runs of the effects study: two without load and two with the disc to fit,
and two that no fit may see.

Loaded and unloaded runs alternate in one session, so that the load cannot be taken for the time.
Layout: out/effects-study/<world>/<case>.npz, counts as the amplifiers report them. What is there is
kept.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.log.conversion import load_run
from daq.log.importing import import_recording
from drivers.simulation.spec import CellSpec
from ident.data.run import Run
from tests.studies.direct_cell import MOVING, RawRun, run_of, simulate_run
from tests.studies.effect_cells import EffectCase
from tests.studies.fingerprint import digest, digest_of_source, finish, is_finished
from tests.studies.raw_runs import read_runs, write_runs
from tests.studies.study_cells import declared_payload
from tests.studies.study_plans import CELL, PlanTask, kept_plan

DURATION_S = 40.0
PAUSE_S = 20.0  #: From the end of one run to the beginning of the next
PLAN_SETS = 6
PLANS_A_SET = 3
FIRST_PLAN = 3001
RUNS = (
    ("bare-1", None, 0),
    ("disc-1", "disc", 0),
    ("bare-2", None, 1),
    ("disc-2", "disc", 1),
    ("held-out-bare", None, 2),
    ("held-out-disc", "disc", 2),
)
"""Name, payload and plan (of the case's set) of each run, in the order of the session."""
HELD_OUT = 2
SESSION = datetime(2026, 3, 2, 7, 0, tzinfo=UTC)
"""When the session of imported runs began."""
IMPORT = """\
name: {name}
cell: {cell}
position: {{file: {name}.csv, columns: [{positions}], unit: rad, side: joint}}
current: {{file: {name}.csv, columns: [{currents}], unit: A}}
time: {{file: {name}.csv, column: stamp, unit: us}}
payload: {payload}
"""


@dataclass(frozen=True, slots=True)
class CaseRuns:
    """The runs of one case: of the fit, and those that it may not see."""

    fit: tuple[Run, ...]
    held_out: tuple[Run, ...]


@dataclass(frozen=True, slots=True)
class CaseTask:
    """A case whose runs are to be there.

    Attributes:
        out: folder of the study.
        world: of WORLDS.
        case: the cell and its effects.
    """

    out: Path
    world: str
    case: EffectCase
    duration_s: float = DURATION_S  #: of each run

    @property
    def path(self) -> Path:
        """File of the runs."""
        if self.duration_s == DURATION_S:
            folder = self.world
        else:
            folder = f"{self.world}-{self.duration_s:g}s"
        return self.out / folder / f"{self.case.name}.npz"

    @property
    def plans(self) -> tuple[PlanTask, ...]:
        """Plans of the case's set."""
        first = FIRST_PLAN + self.case.seed % PLAN_SETS * PLANS_A_SET
        return tuple(
            PlanTask(self.out, first + letter, self.duration_s) for letter in range(PLANS_A_SET)
        )


def specs_of(task: CaseTask) -> list[CellSpec]:
    """The plant of each run."""
    return [
        task.case.spec(task.world, payload, number) for number, (_, payload, _) in enumerate(RUNS)
    ]


def fingerprint_of_runs(task: CaseTask) -> str:
    """What the runs of a case depend on; its plans were made."""
    cell = load_cell(CELL)
    plans = [kept_plan(made, cell) for made in task.plans]
    return digest(
        digest_of_source("tests.studies.direct_cell", MOVING),
        cell.digest,
        task.case,
        [made.moves for made in plans],
        [(spec.urdf, spec.axes, spec.payload) for spec in specs_of(task)],
    )


def make_case(task: CaseTask) -> float:
    """Simulate the runs of a case unless the same ones are there;
    return the processor time that it took [s].
    """
    begun_s = time.process_time()
    fingerprint = fingerprint_of_runs(task)
    if is_finished(task.path, fingerprint):
        return 0.0
    cell = load_cell(CELL)
    plans = [kept_plan(made, cell) for made in task.plans]
    raw = [
        simulate_run(
            cell,
            spec,
            plans[letter],
            name,
            None if payload is None else declared_payload(payload),
            number * (task.duration_s + PAUSE_S),
        )
        for number, (spec, (name, payload, letter)) in enumerate(
            zip(specs_of(task), RUNS, strict=True)
        )
    ]
    task.path.parent.mkdir(parents=True, exist_ok=True)
    write_runs(task.path, raw)
    finish(task.path, fingerprint)
    return time.process_time() - begun_s


def load_runs(task: CaseTask, *, imported: bool) -> CaseRuns:
    """The runs of a case.

    Args:
        task: its runs were simulated.
        imported: take the way of another controller's recordings, through CSV files with absolute
            stamps.

    Raises:
        FileNotFoundError: they have not been simulated.
        DaqError: from the import.
    """
    cell = load_cell(CELL)
    raw = read_runs(task.path)
    if imported:
        runs = imported_runs(raw, cell)
    else:
        runs = tuple(run_of(one, cell) for one in raw)
    return CaseRuns(runs[:-HELD_OUT], runs[-HELD_OUT:])


def imported_runs(raw: tuple[RawRun, ...], cell: Cell) -> tuple[Run, ...]:
    """Write runs to CSV files, import them and read the logs."""
    axes = range(1, len(cell.axes) + 1)
    positions = [f"q{axis}" for axis in axes]
    currents = [f"i{axis}" for axis in axes]
    runs = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for one in raw:
            run = run_of(one, cell)
            stamp_us = np.rint(1e6 * (SESSION.timestamp() + one.began_s + run.time_s))
            with (folder / f"{one.name}.csv").open("w", encoding="utf-8") as file:
                file.write(",".join(["stamp", *positions, *currents]) + "\n")
                rows = np.column_stack((stamp_us, run.position_rad, run.current_a))
                fmt = ["%d"] + ["%.9f"] * (rows.shape[1] - 1)
                np.savetxt(file, rows, fmt=fmt, delimiter=",")
            description = folder / f"{one.name}.yaml"
            text = IMPORT.format(
                name=one.name,
                cell=CELL.name,
                positions=", ".join(positions),
                currents=", ".join(currents),
                payload="null" if one.payload is None else one.payload.name,
            )
            description.write_text(text, encoding="utf-8")
            log = folder / f"{one.name}.mcap"
            import_recording(description, folder, log, software="effects study", cell_path=CELL)
            runs.append(load_run(log)[0])
    return tuple(runs)
