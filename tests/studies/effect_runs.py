"""Runs of the effects study: two without load and two with the disc to fit, and two that no fit may see.

    python -m tests.studies.effect_runs           simulate what is missing
    python -m tests.studies.effect_runs clean-03  these cases alone

Loaded and unloaded runs alternate in one session, so that the load cannot be taken for the time. Layout:
out/effects-study/<case>.npz, counts as the amplifiers report them.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from daq.config.cell_file import load_cell
from daq.workflow.plan import plan
from daq.workflow.plan_file import load_plan, save_plan
from ident.data.run import Run
from tests.studies.coverage_runs import CELL
from tests.studies.direct_cell import run_of, simulate_run
from tests.studies.effect_cells import ALL, EffectCase
from tests.studies.fingerprint import digest, digest_of_source, finish, is_finished
from tests.studies.raw_runs import read_runs, write_runs
from tests.studies.side_by_side import side_by_side
from tests.studies.study_cells import declared_payload

OUT = Path("out/effects-study")
DURATION_S = 40.0
BETWEEN_S = 60.0
"""From the beginning of one run to that of the next."""
PLAN_SETS = 6
PLANS_A_SET = 3
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


@dataclass(frozen=True, slots=True)
class CaseRuns:
    """The runs of one case: of the fit, and those that it may not see."""

    fit: tuple[Run, ...]
    held_out: tuple[Run, ...]


@dataclass(frozen=True, slots=True)
class _PlanTask:
    out: Path
    number: int


@dataclass(frozen=True, slots=True)
class _Task:
    out: Path
    case: EffectCase


def make_runs(
    cases: Iterable[EffectCase],
    *,
    out: Path = OUT,
    processes: int = 2,
    report_line: Callable[[str], None] = lambda _: None,
) -> None:
    """Simulate and save what is missing.

    Raises:
        TaskFailed: planning or simulating failed; what was finished before is kept.
    """
    (out / "plans").mkdir(parents=True, exist_ok=True)
    plans = [_PlanTask(out, number) for number in range(PLAN_SETS * PLANS_A_SET)]
    for line in side_by_side(_plan, plans, processes):
        report_line(line)
    for line in side_by_side(_simulate, [_Task(out, case) for case in cases], processes):
        report_line(line)


def load_runs(case: EffectCase, out: Path = OUT) -> CaseRuns:
    """The runs of a case.

    Raises:
        FileNotFoundError: they have not been simulated.
    """
    path = out / f"{case.name}.npz"
    if not path.is_file():
        raise FileNotFoundError(f"found no {path}; run `python -m tests.studies.effect_runs {case.name}` first")
    cell = load_cell(CELL)
    runs = tuple(run_of(raw, cell) for raw in read_runs(path))
    return CaseRuns(runs[:-HELD_OUT], runs[-HELD_OUT:])


def _plan_path(out: Path, number: int) -> Path:
    return out / "plans" / f"{number}.yaml"


def _plan(task: _PlanTask) -> str:
    cell = load_cell(CELL)
    path = _plan_path(task.out, task.number)
    fingerprint = digest(digest_of_source("daq.workflow.plan"), cell.digest, task.number, DURATION_S)
    if is_finished(path, fingerprint):
        return f"plan {task.number}: kept"
    save_plan(plan(cell, seed=3001 + task.number, duration_s=DURATION_S), path)
    finish(path, fingerprint)
    return f"plan {task.number}: made"


def _simulate(task: _Task) -> str:
    begun_s = time.process_time()
    case, cell = task.case, load_cell(CELL)
    path = task.out / f"{case.name}.npz"
    first = case.seed % PLAN_SETS * PLANS_A_SET
    plans = [load_plan(_plan_path(task.out, first + letter), cell) for letter in range(PLANS_A_SET)]
    specs = [case.spec(payload, number) for number, (_, payload, _) in enumerate(RUNS)]
    fingerprint = digest(
        digest_of_source("tests.studies.direct_cell"),
        cell.digest,
        case,
        [made.moves for made in plans],
        [(spec.urdf, spec.axes, spec.payload) for spec in specs],
    )
    if is_finished(path, fingerprint):
        return f"{case.name}: kept"
    raw = [
        simulate_run(
            cell, spec, plans[letter], name, None if payload is None else declared_payload(payload), BETWEEN_S * number
        )
        for number, (spec, (name, payload, letter)) in enumerate(zip(specs, RUNS, strict=True))
    ]
    write_runs(path, raw)
    finish(path, fingerprint)
    return f"{case.name}: {time.process_time() - begun_s:.1f} s"


def _print_line(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main(arguments: list[str] | None = None) -> int:
    """Simulate what is missing."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.effect_runs", description=__doc__)
    parser.add_argument("cases", nargs="*", help="names; all where none is given")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args(arguments)
    chosen = [case for case in ALL if not options.cases or case.name in options.cases]
    make_runs(chosen, out=options.out, processes=options.processes, report_line=_print_line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
