"""A cell of one's own for each test: its files, its clock, its commands,
and the simulated cell on a virtual bus.
"""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import cache, partial
from pathlib import Path
from typing import Any

import yaml

from daq.cli.simulate import MountedFile
from daq.config.cell import Cell
from daq.config.cell_buses import bus_address
from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.jobs.context import Tools
from daq.jobs.job import recalibrate
from daq.jobs.journal import Form, Journal
from daq.jobs.reporting import Conclusion
from daq.jobs.session import Session, sessions
from daq.ledger.audit import AuditEntry, read, verify
from daq.report.residual_page import save_report
from daq.simulation.simulation_file import load_simulation
from daq.workflow.plan import Plan, plan, save_plan
from daq.workflow.record import Clocks, record
from drivers.canopen.bus import open_bus
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.drive import PowerState
from drivers.simulation.faults import FaultSpec
from drivers.simulation.spec import CellSpec, ToggleBit

BEGAN = datetime(2026, 1, 5, 2, 0, tzinfo=UTC)
PERIOD_US = 2000
"""Period of the cells here.

A millisecond would be twice as many frames, and tests of a job need no more.
"""
WHO = "the test's job"
RUNS: tuple[dict[str, Any], ...] = (
    {"name": "bare-1"},
    {"name": "loaded-1", "payload": "disc", "mass_kg": 4.59},
    {"name": "held-out", "payload": "disc", "mass_kg": 4.59, "holdout": True},
)


@cache
def _cell(path: Path, _content: bytes) -> Cell:
    return load_cell(path)


@cache
def _truth(payload: str | None) -> CellSpec:
    path = shipped_configurations() / "simulation" / "demo.yaml"
    return _with_period(load_simulation(path, payload))


def _with_period(truth: CellSpec) -> CellSpec:
    """The same at PERIOD_US, in steps of the same time,
    and with noise that filters leave as much of.
    """
    slower = PERIOD_US / truth.sync_period_us
    axes = (
        replace(axis, current_noise_a=axis.current_noise_a / slower**0.5) for axis in truth.axes
    )
    substeps = round(slower * truth.substeps)
    return replace(truth, sync_period_us=PERIOD_US, substeps=substeps, axes=tuple(axes))


class TestClock:
    """A wall clock that advances by a second at each reading, and further with `go_on`."""

    __test__ = False

    def __init__(self, at: datetime = BEGAN) -> None:
        self.at = at

    def __call__(self) -> datetime:
        self.at += timedelta(seconds=1)
        return self.at

    def go_on(self, **by: float) -> None:
        self.at += timedelta(**by)


@dataclass
class Rig:
    """One cell.

    Attributes:
        folder: with `cells`, `controllers` and `robots`.
        clock: of the job.
        tools: that the job gets.
        said: the journal's lines.
        kind: of its sessions, which names their folder: recalibration, or sessions of `calibrate`.
    """

    folder: Path
    clock: TestClock
    tools: Tools
    said: io.StringIO = field(default_factory=io.StringIO)
    kind: str = "recalibration"

    @property
    def cells(self) -> Path:
        return self.folder / "cells"

    @property
    def cell_file(self) -> Path:
        return self.cells / "demo.yaml"

    @property
    def cell(self) -> Cell:
        content = self.cell_file.read_bytes()
        return _cell(self.cell_file, content)

    @property
    def controller(self) -> Path:
        return self.folder / "controllers" / "demo.yaml"

    @property
    def closed(self) -> Path:
        """The interlock's command looks for it."""
        return self.cells / "closed"

    @property
    def sessions(self) -> tuple[Session, ...]:
        folder = self.cells / f"demo.{self.kind}"
        return sessions(folder, "demo")

    @property
    def session(self) -> Session:
        """The only one."""
        (only,) = self.sessions
        return only

    @property
    def audit(self) -> tuple[AuditEntry, ...]:
        path = self.cells / "demo.audit.jsonl"
        assert verify(path).holds
        return read(path)

    @property
    def events(self) -> list[dict[str, Any]]:
        """The journal."""
        lines = self.said.getvalue().splitlines()
        return [json.loads(line) for line in lines]

    @property
    def backups(self) -> list[Path]:
        return sorted(self.controller.parent.glob("*.bak"))

    def job(self, **further: Any) -> Conclusion:
        journal = Journal(self.said, Form.JSON, lambda: self.clock.at)
        return recalibrate(
            self.cell_file,
            self.cell,
            self.tools,
            journal,
            who=WHO,
            lock_folder=self.folder,
            **further,
        )


def make_rig(
    folder: Path, plan_file: Path, *, policy: dict[str, Any] | None = None, **section: Any
) -> Rig:
    """A cell's files, and tools with a clock of their own.

    Args:
        folder: empty; its name makes the bus's.
        plan_file: of all runs.
        policy: instead of one in which the job applies.
        section: of `recalibration`, instead of what is here.
    """
    shipped = shipped_configurations()
    for part in ("controllers", "robots"):
        shutil.copytree(shipped / part, folder / part)
    (folder / "cells").mkdir()
    demo_path = shipped / "cells" / "demo.yaml"
    document = yaml.safe_load(demo_path.read_text(encoding="utf-8"))
    document["bus"]["channel"] = f"recalibration {folder.parent.name} {folder.name}"
    document["sync"]["period_us"] = PERIOD_US
    document["policy"] = policy or {
        "motion": "allowed",
        "apply": {"by": "job", "max_std_percent": 8},
    }
    document["recalibration"] = {
        "runs": [{"plan_file": str(plan_file), **run} for run in RUNS],
        "interlock": {"command": ["test", "-e", "closed"]},
        "mount": {"command": ["sh", "-c", 'echo "$1" > mounted', "mount"]},
        "warm_up_min": 0,
        "min_free_mb": 100,
        "metrics": ".",
        **section,
    }
    # As JSON, which is YAML without aliases.
    text = json.dumps(document, indent=1)
    (folder / "cells" / "demo.yaml").write_text(text, encoding="utf-8")
    (folder / "cells" / "closed").touch()
    clock = TestClock()
    clocks = Clocks(wall_ns=lambda: int(clock.at.timestamp()) * 10**9)
    tools = Tools(
        save_report=save_report,
        record=partial(record, clocks=clocks),
        free=lambda _: 10**12,
        now=clock,
        monotonic_s=lambda: clock().timestamp(),
    )
    return Rig(folder, clock, tools)


@contextmanager
def serving(
    rig: Rig,
    *faults: FaultSpec,
    toggle_bit: ToggleBit | None = None,
    seed: int = 1,
    spec: CellSpec | None = None,
) -> Iterator[SimulatedCell]:
    """The simulated cell of a rig, powered on, with what its mount command has mounted."""
    path = rig.cells / "mounted"
    mounted = MountedFile(path, _truth, lambda error: None)
    truth = replace(
        mounted.at_power_on() if spec is None else _with_period(spec), faults=faults, seed=seed
    )
    axes = tuple(replace(axis, toggle_bit=toggle_bit) for axis in truth.axes)
    truth = replace(truth, axes=axes)
    bus = open_bus(bus_address(rig.cell))
    try:
        with SimulatedCell(truth, bus, mounted=mounted) as cell:
            yield cell
    finally:
        bus.shutdown()


def powerless(cell: SimulatedCell) -> bool:
    """Whether no axis has power, as the simulator knows it."""
    powered = (PowerState.OPERATION_ENABLED, PowerState.QUICK_STOP_ACTIVE, PowerState.SWITCHED_ON)
    return not any(node.drive.state in powered for node in cell.nodes)


def make_plan(
    cell: Cell, path: Path, *, seed: int, duration_s: float, moves: int | None = None
) -> Path:
    """A plan for tests: not the best one."""
    made: Plan = plan(
        cell,
        seed=seed,
        duration_s=duration_s,
        exchanges=100,
        largest_condition=1e6,
        largest_std_percent=100.0,
    )
    changed_made = replace(made, moves=made.moves[:moves])
    save_plan(changed_made, path)
    return path
