"""Plans of the studies, made once and kept beside the runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.workflow.plan import Plan, load_plan, plan, save_plan
from tests.studies.fingerprint import digest, digest_of_source, finish, is_finished

CELL = shipped_configurations() / "cells" / "demo.yaml"
"""The cell of the studies, as declared."""
PLANNING = ("daq.workflow", "ident.planning")
"""What makes a plan: kept plans outlive a change of anything else."""


@dataclass(frozen=True, slots=True)
class PlanTask:
    """A plan to make.

    Attributes:
        out: folder of the study; the plan goes into its folder `plans`.
        seed: of the plan.
        duration_s: of its moves [s].
    """

    out: Path
    seed: int
    duration_s: float

    @property
    def path(self) -> Path:
        """File of the plan."""
        plans_folder = self.out / "plans"
        return plans_folder / f"{self.seed}-{self.duration_s:g}s.yaml"


def make_plan(task: PlanTask) -> str:
    """Make a plan unless the same one is there; return what was done."""
    cell = load_cell(CELL)
    path = task.path
    fingerprint = digest(
        digest_of_source("daq.workflow.plan", PLANNING), cell.digest, task.seed, task.duration_s
    )
    if is_finished(path, fingerprint):
        return f"plan {path.stem}: kept"
    path.parent.mkdir(parents=True, exist_ok=True)
    save_plan(plan(cell, seed=task.seed, duration_s=task.duration_s), path)
    finish(path, fingerprint)
    return f"plan {path.stem}: made"


def kept_plan(task: PlanTask, cell: Cell) -> Plan:
    """Read a plan that `make_plan` made."""
    return load_plan(task.path, cell)
