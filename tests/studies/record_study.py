"""Recordings for the study of the estimators, over the real driver path:
virtual bus, CANopen, MCAP.

`python -m tests.studies.record_study --seeds 1 2 --floors 3.5` records what is missing and keeps
what was recorded of the same cell, plan and software. Scoring code calls `record_study` for the
same, or `study_logs` for what is there:

    for logs in study_logs(SEEDS, ("3.5",)):
        fitted = fit(logs.fit, holdout=logs.validation)
        error = fitted.estimate.gains / logs.truth.gains_nm_per_a - 1

Layout: out/ident-study/<floor>/<seed>/<run>.mcap with truth.json beside,
out/ident-study/plans/<seed>-<plan>.yaml.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from enum import Enum
from itertools import product
from pathlib import Path

from daq.config.cell import Cell
from daq.config.cell_buses import bus_address
from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations, software
from daq.files import replace_file
from daq.log.metadata import VERSION
from daq.workflow.plan import Plan, load_plan, plan, save_plan
from daq.workflow.record import RecordingRequest, record
from drivers.canopen.bus import open_bus
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.spec import CellSpec
from tests.studies.direct_cell import simulate_run
from tests.studies.fingerprint import digest, digest_of_source, finish, is_finished
from tests.studies.side_by_side import side_by_side
from tests.studies.study_cells import (
    Truth,
    declared_payload,
    spec_of,
    study_cell,
    truth_from,
    truth_of,
)

OUT = Path("out/ident-study")
SEEDS = tuple(range(1, 13))
FLOORS = {"3.5": 1.59, "10": 4.55}
"""Relative error of the fit [%] and the factor of the clean cell's current noise that gives it on
the study's plans.

The error falls as plans ask for more torque: measure the factors again (noise_floor.py) when the
planner changes.
"""
DURATION_S = 40.0
PROCESSES = 2
CELL = shipped_configurations() / "cells" / "demo.yaml"


@dataclass(frozen=True, slots=True)
class StudyRun:
    """One run of each cell of the study.

    Attributes:
        name: stem of its log.
        payload: mounted body, None without load.
        plan: letter of its plan; each seed has its own.
    """

    name: str
    payload: str | None
    plan: str


FIT = (
    StudyRun("bare-1", None, "a"),
    StudyRun("disc-1", "disc", "a"),
    StudyRun("bare-2", None, "b"),
    StudyRun("disc-2", "disc", "b"),
)
VALIDATION = (StudyRun("unused-bare", None, "c"), StudyRun("unused-disc", "disc", "c"))
SECOND_PAYLOAD = (
    StudyRun("plate-1", "plate", "d"),
    StudyRun("plate-2", "plate", "e"),
    StudyRun("plate-3", "plate", "f"),
)
RUNS = FIT + VALIDATION + SECOND_PAYLOAD


@dataclass(frozen=True, slots=True)
class StudyLogs:
    """The logs of one cell of the study.

    Attributes:
        seed, floor: which cell.
        truth: for scoring alone.
        fit: two runs without load and two with the disc, of the weighed mass alone.
        validation: one without load and one with the disc, that no fit may use.
        second_payload: three runs with the plate, of which the logs say nothing but that it is
            mounted.
    """

    seed: int
    floor: str
    truth: Truth
    fit: tuple[Path, ...]
    validation: tuple[Path, ...]
    second_payload: tuple[Path, ...]


@dataclass(frozen=True, slots=True)
class _PlanTask:
    out: Path
    seed: int
    plan: str
    duration_s: float


@dataclass(frozen=True, slots=True)
class _RunTask:
    out: Path
    seed: int
    floor: str
    run: StudyRun


def record_study(
    seeds: Sequence[int],
    floors: Sequence[str],
    *,
    out: Path = OUT,
    duration_s: float = DURATION_S,
    processes: int = PROCESSES,
    report_line: Callable[[str], None] = lambda _: None,
) -> tuple[StudyLogs, ...]:
    """Record what is missing of some cells of the study.

    Args:
        seeds, floors: which cells; floors by their names in FLOORS.
        out: folder of the study.
        duration_s: of each run [s].
        processes: side by side.
        report_line: what was done, a line a plan or run.

    Raises:
        TaskFailed: planning or recording failed; what was finished before is kept.
    """
    letters = sorted({run.plan for run in RUNS})
    plans = [_PlanTask(out, seed, letter, duration_s) for seed, letter in product(seeds, letters)]
    runs = [_RunTask(out, seed, floor, run) for floor, seed, run in product(floors, seeds, RUNS)]
    for floor in floors:
        for seed in seeds:
            cell = study_cell(seed, FLOORS[floor])
            truth = truth_of(cell)
            path = _folder(out, floor, seed) / "truth.json"
            path.parent.mkdir(parents=True, exist_ok=True)
            text = json.dumps(asdict(truth), indent=1, default=_plain)
            content = (text + "\n").encode()
            replace_file(path, content)
    (out / "plans").mkdir(parents=True, exist_ok=True)
    for line in side_by_side(_plan, plans, processes):
        report_line(line)
    for line in side_by_side(_record, runs, processes):
        report_line(line)
    return study_logs(seeds, floors, out=out)


def _plain(value: object) -> object:
    """An enum of the simulator's as JSON has it."""
    if isinstance(value, Enum):
        return value.value
    raise TypeError(f"{value!r} is nothing that JSON can say")


def study_logs(
    seeds: Sequence[int], floors: Sequence[str], *, out: Path = OUT
) -> tuple[StudyLogs, ...]:
    """The recorded logs of some cells of the study, floor by floor.

    Raises:
        FileNotFoundError: one of them has not been recorded.
        ValueError: it was recorded with another noise than its floor has now.
    """
    return tuple(_logs(out, floor, seed) for floor, seed in product(floors, seeds))


def _logs(out: Path, floor: str, seed: int) -> StudyLogs:
    folder = _folder(out, floor, seed)
    fit = tuple(folder / f"{run.name}.mcap" for run in FIT)
    validation = tuple(folder / f"{run.name}.mcap" for run in VALIDATION)
    second = tuple(folder / f"{run.name}.mcap" for run in SECOND_PAYLOAD)
    missing = [str(path) for path in (*fit, *validation, *second) if not path.is_file()]
    if missing:
        raise FileNotFoundError(
            f"found no {', '.join(missing)}; record with `python -m tests.studies.record_study "
            f"--seeds {seed} --floors {floor}`"
        )
    text = (folder / "truth.json").read_text()
    document = json.loads(text)
    truth = truth_from(document)
    if truth.noise_factor != FLOORS[floor]:
        raise ValueError(
            f"{folder}: found noise factor {truth.noise_factor:g}, expected {FLOORS[floor]:g}; "
            "record again"
        )
    return StudyLogs(seed, floor, truth, fit, validation, second)


def _plan(task: _PlanTask) -> str:
    """One plan, unless it is there and was made by the same planner."""
    cell = load_cell(CELL)
    plans_folder = task.out / "plans"
    path = plans_folder / f"{task.seed}-{task.plan}.yaml"
    number = 10 * task.seed + ord(task.plan) - ord("a")
    fingerprint = digest(
        digest_of_source("daq.workflow.plan"), cell.digest, number, task.duration_s
    )
    if is_finished(path, fingerprint):
        return f"plan {path.stem}: kept"
    begun_s = time.perf_counter()
    made = plan(cell, seed=number, duration_s=task.duration_s)
    save_plan(made, path)
    finish(path, fingerprint)
    return (
        f"plan {path.stem}: {len(made.moves)} moves, condition {made.condition:.0f}, "
        f"{_since(begun_s)}"
    )


def _record(task: _RunTask) -> str:
    """One run, unless its log is there and was recorded of the same cell, plan and software."""
    cell = load_cell(CELL)
    # From the file, as a technician's recording would be: the log then belongs to the plan that can
    # be read.
    plans_folder = task.out / "plans"
    moves = load_plan(plans_folder / f"{task.seed}-{task.run.plan}.yaml", cell)
    noise_factor = FLOORS[task.floor]
    spec = spec_of(study_cell(task.seed, noise_factor), task.run.payload, RUNS.index(task.run))
    path = _folder(task.out, task.floor, task.seed) / f"{task.run.name}.mcap"
    fingerprint = _fingerprint(cell, spec, moves, task.run)
    title = f"{task.floor} %, seed {task.seed}, {task.run.name}"
    if is_finished(path, fingerprint):
        return f"{title}: kept"
    for leftover in (path, path.with_name(path.name + ".part")):
        leftover.unlink(missing_ok=True)
    begun_s = time.perf_counter()
    bus = open_bus(bus_address(cell))
    try:
        with SimulatedCell(spec, bus):
            request = RecordingRequest(
                CELL,
                cell,
                moves,
                path,
                payload=None if task.run.payload is None else declared_payload(task.run.payload),
                operator="study",
                granted_by="the study of the estimators: a simulated cell",
                run_id=f"study-{task.floor}-{task.seed}-{task.run.name}",
            )
            recorded = record(request)
    finally:
        bus.shutdown()
    if not recorded.log.valid:
        raise RuntimeError(
            f"{path}: {recorded.log.reason}; record again on a machine with less to do"
        )
    finish(path, fingerprint)
    return (
        f"{title}: {recorded.log.samples} samples, {path.stat().st_size / 1e6:.1f} MB, "
        f"{_since(begun_s)}"
    )


def _folder(out: Path, floor: str, seed: int) -> Path:
    return out / floor / str(seed)


def _fingerprint(cell: Cell, spec: CellSpec, moves: Plan, run: StudyRun) -> str:
    """Digest of everything that decides what is in a log, but the time of day.

    Of the simulator and the walk of the moves it takes what they do, not how they are written: the
    samples of the first move, which the direct path gives as they would be in the log.
    """
    if run.payload is None:
        declared = None
    else:
        declared = declared_payload(run.payload)
    truth = (
        spec.urdf,
        spec.gravity_m_s2,
        spec.ratio.tolist(),
        spec.axes,
        spec.start_rad.tolist(),
        spec.payload,
    )
    assembly = sorted(spec.assembly_rad.items())
    passive = sorted(spec.passive.items())
    chain = (spec.closures, spec.motors, spec.platform, assembly, passive) if spec.closures else ()
    simulation = (*truth, *chain, spec.effects, spec.sync_period_us, spec.substeps, spec.seed)
    changed_move = replace(moves, moves=moves.moves[:1])
    probe = simulate_run(cell, spec, changed_move, run.name, declared)
    samples = (probe.position_counts.tobytes(), probe.current_raw.tobytes(), probe.move.tobytes())
    return digest(software(), VERSION, cell.digest, simulation, moves.moves, declared, samples)


def _since(begun_s: float) -> str:
    return f"{time.perf_counter() - begun_s:.1f} s"


def _print_line(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main(arguments: list[str] | None = None) -> int:
    """Record what is missing."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.record_study", description=__doc__
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    parser.add_argument("--floors", choices=tuple(FLOORS), nargs="+", default=list(FLOORS))
    parser.add_argument("--duration", type=float, default=DURATION_S, help="of each run [s]")
    parser.add_argument("--processes", type=int, default=PROCESSES)
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args(arguments)
    record_study(
        options.seeds,
        options.floors,
        out=options.out,
        duration_s=options.duration,
        processes=options.processes,
        report_line=_print_line,
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
