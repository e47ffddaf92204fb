"""How long a guided session takes, beside the way step by step,
and whether stopping when it is precise bends a gain.

    python -m tests.studies.session_study --only TX-40 --seeds 1 2
    python -m tests.studies.session_study --shard 1/4 --minutes 60      goes on where it ended

A unit that ends with an error is a row with its reason: a missed target, and no ratio. `--tables
docs/evidence/data` writes the tables of docs/evidence/session.md.

Each shipped robot is calibrated over the driver by `daq.jobs.calibrate.calibrate`, until σ of every
gain is 0.5 %. The time is that of the motion, and three minutes for each change of the payload. Its
cell file has `friction_by_payload`, as those that `drivegain init` writes. Step by step it is the
shortest of five durations of a plan whose three runs (bare, loaded, held out) give every gain
within 1 % of the truth. Both ways have the same plant, noise of their own, and plans of their own.
Layout: out/session-study/<robot>-<seed>.json.
"""

from __future__ import annotations

import argparse
import io
import json
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from daq.config.cell import Cell
from daq.config.cell_buses import bus_address
from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.errors import DaqError, PlanTooShort
from daq.jobs.calibrate import calibrate
from daq.jobs.context import Tools
from daq.jobs.guided import GuidedSettings, guided, motion_s
from daq.jobs.journal import Form, Journal
from daq.jobs.operator import GivenAnswers
from daq.jobs.recording import calibration_of_session
from daq.report.residual_page import save_report
from daq.simulation.simulation_file import load_simulation, shipped_simulation
from daq.workflow.fit import close_loop, fit
from daq.workflow.plan import plan
from daq.workflow.record import Recorded, RecordingRequest, record
from drivers.canopen.bus import open_bus
from drivers.errors import DriverError
from drivers.simulation.cell import SimulatedCell
from ident.errors import IdentificationError
from tests.studies.any_robot import ROBOTS, StudiedRobot
from tests.studies.fingerprint import digest, digest_of_source, is_finished, made_once
from tests.studies.output import print_line
from tests.studies.session_tables import summary, write_tables
from tests.studies.side_by_side import Shard, shard
from tests.studies.study_rows import work_off

OUT = Path("out/session-study")
SEEDS = tuple(range(1, 21))
TARGET_PERCENT = 0.5
TRUE_ERROR_PERCENT = 1.0
DURATIONS_S = (10.0, 20.0, 40.0, 80.0, 160.0)
BLOCK_S = 10.0
EXCHANGES = 200
NO_CONDITION = 1e6  #: Of mixed units; how well the gains are seen is judged by their σ
NO_STD_PERCENT = 100.0  #: A short block need not show every gain: blocks are fitted together


@dataclass(frozen=True, slots=True)
class Plant:
    """A simulated robot that is there while it is recorded, with the payload that a run names."""

    robot: StudiedRobot
    seed: int

    def record(self, request: RecordingRequest, number: int, **further: Any) -> Recorded:
        """Record a run over the driver; its number makes the noise."""
        if request.payload is None:
            mounted = None
        else:
            mounted = request.payload.name
        path = shipped_simulation(self.robot.simulation)
        spec = load_simulation(path, mounted)
        axes = tuple(
            replace(axis, current_noise_a=self.robot.noise * axis.current_noise_a)
            for axis in spec.axes
        )
        bus = open_bus(bus_address(request.cell))
        try:
            seed = 1000 * self.seed + number
            changed_spec = replace(spec, axes=axes, seed=seed)
            with SimulatedCell(changed_spec, bus):
                return record(request, **further)
        finally:
            bus.shutdown()

    def truth(self, cell: Cell) -> dict[str, float]:
        """True gain by axis."""
        path = shipped_simulation(self.robot.simulation)
        spec = load_simulation(path)
        return {
            axis.name: true.gain_nm_per_a for axis, true in zip(cell.axes, spec.axes, strict=True)
        }


def study(robot: StudiedRobot, seed: int, folder: Path) -> dict[str, Any]:
    """Both ways for one seed; of a way that ends with an error, its reason."""
    shutil.copytree(shipped_configurations(), folder / "configs")
    cells_folder = folder / "configs" / "cells"
    cell_file = cells_folder / f"{robot.cell}.yaml"
    cell = load_cell(cell_file)
    by_payload_file = cell_file.with_name(f"{robot.cell}-by-payload.yaml")
    shipped = cell_file.read_text(encoding="utf-8")
    by_payload_file.write_text(f"{shipped}friction_by_payload: true\n", encoding="utf-8")
    plant = Plant(robot, seed)
    return {
        "robot": robot.name,
        "seed": seed,
        "guided": way_or_reason(
            lambda: guided_way(plant, by_payload_file, load_cell(by_payload_file), folder)
        ),
        "step_by_step": way_or_reason(lambda: step_by_step(plant, cell_file, cell, folder)),
    }


def way_or_reason(make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What a way found; the class and the text of the error that ended it under `failed`."""
    try:
        return make()
    except (DaqError, DriverError, IdentificationError) as error:
        return {"failed": f"{type(error).__name__}: {error}"}


def guided_way(plant: Plant, cell_file: Path, cell: Cell, folder: Path) -> dict[str, Any]:
    """A guided session: its time, and the errors of its gains with their σ."""
    numbers = iter(range(1, 1000))
    begun_s = time.process_time()

    def recorded(request: RecordingRequest, **further: Any) -> Recorded:
        return plant.record(request, next(numbers), **further)

    tools = Tools(
        save_report=save_report,
        # No cell is on the bus between two recordings
        drives=lambda _cell, _block, _take_over: None,
        plan=partial(
            plan,
            exchanges=EXCHANGES,
            largest_condition=NO_CONDITION,
            largest_std_percent=NO_STD_PERCENT,
        ),
        record=recorded,
        free=lambda _: 10**12,
    )
    payload = cell.payloads[0]
    masses_kg = {payload.name: payload.mass_kg}
    operator = GivenAnswers(
        "the study",
        masses_kg,
        lambda _: None,
        "the study: a simulated cell",
        writes=False,
    )
    seed = 100 * plant.seed
    sessions_folder = folder / "sessions"
    settings = GuidedSettings(
        sessions_folder,
        payload.name,
        target_percent=TARGET_PERCENT,
        block_s=BLOCK_S,
        seed=seed,
        min_free_mb=1.0,
    )
    journal = Journal(io.StringIO(), Form.TEXT, lambda: datetime.now(UTC))
    ended = calibrate(cell_file, cell, settings, operator, tools, journal, lock_folder=folder)
    assert ended.session is not None
    calibration = calibration_of_session(ended.session)
    if calibration is None:
        return {"failed": f"no calibration: {ended.session.state.problem}"}
    state = guided(ended.session)
    mounted = [block.payload for block in state.blocks]
    truth = plant.truth(cell)
    errors = {
        gain.axis: 100.0 * (gain.value / truth[gain.axis] - 1.0) for gain in calibration.gains
    }
    return {
        "motion_s": motion_s(state.blocks, BLOCK_S),
        "changes": changes(mounted),
        "blocks": len(state.blocks),
        "missing": state.missing,
        "error_percent": errors,
        "std_percent": {gain.axis: gain.std_percent for gain in calibration.gains},
        "effects": [effect.name for effect in calibration.effects],
        "processor_s": time.process_time() - begun_s,
    }


def step_by_step(plant: Plant, cell_file: Path, cell: Cell, folder: Path) -> dict[str, Any]:
    """The shortest plan whose three runs give every gain within TRUE_ERROR_PERCENT of the truth."""
    worst: dict[str, float] = {}
    for duration_s in DURATIONS_S:
        try:
            error = _worst_error(
                plant, cell_file, cell, folder / f"steps-{duration_s:g}", duration_s
            )
        except PlanTooShort:  # a person would take the next duration
            error = float("inf")
        worst[f"{duration_s:g}"] = error
        if error <= TRUE_ERROR_PERCENT:
            return {"duration_s": duration_s, "worst_error_percent": worst}
    return {"duration_s": None, "worst_error_percent": worst}


def _worst_error(
    plant: Plant, cell_file: Path, cell: Cell, folder: Path, duration_s: float
) -> float:
    """The largest true error of a gain of three runs [%];
    infinite where they do not give the gains.
    """
    folder.mkdir()
    first, second = (
        plan(
            cell,
            seed=100 * plant.seed + 50 + number,
            duration_s=duration_s,
            exchanges=EXCHANGES,
            largest_condition=NO_CONDITION,
            largest_std_percent=NO_STD_PERCENT,
        )
        for number in (0, 1)
    )
    payload = cell.payloads[0]
    logs = []
    for name, mounted, moves in (
        ("bare", None, first),
        ("loaded", payload, first),
        ("held-out", payload, second),
    ):
        logs.append(folder / f"{name}.mcap")
        last_log = logs[-1]
        request = RecordingRequest(
            cell_file,
            cell,
            moves,
            last_log,
            payload=None if mounted is None else mounted.payload,
            operator="the study",
            granted_by="the study: a simulated cell",
            run_id=name,
            entered_kg=None if mounted is None else mounted.mass_kg,
        )
        plant.record(request, 500 + round(duration_s) + len(logs))
    try:
        found = close_loop(fit(logs[:2], holdout=logs[2:]), 0, lambda _: None)
    except IdentificationError:
        return float("inf")
    truth = np.array(list(plant.truth(cell).values()))
    return float(np.max(np.abs(100.0 * (found.estimate.gains / truth - 1.0))))


def changes(mounted: Sequence[str | None]) -> int:
    """Number of changes of the payload; the session begins with an empty flange."""
    before = [None, *mounted[:-1]]
    return sum(one != other for one, other in zip(before, mounted, strict=True))


def main(arguments: list[str] | None = None) -> int:
    """Make what is missing, and print the table of what is there."""
    names = [robot.name for robot in ROBOTS]
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.session_study", description=__doc__
    )
    parser.add_argument("--only", nargs="+", choices=names, default=names, metavar="ROBOT")
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS))
    parser.add_argument(
        "--shard", type=shard, default=Shard(), help="i/n: every n-th unit from the i-th on"
    )
    parser.add_argument("--minutes", type=float, default=60.0, help="after which no unit is begun")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument(
        "--tables",
        type=Path,
        help="folder of the tables of docs/evidence/session.md, to write them",
    )
    options = parser.parse_args(arguments)
    source = digest_of_source("tests.studies.session_study")
    wanted = [robot for robot in ROBOTS if robot.name in options.only]
    units = []
    for seed in options.seeds:
        units += [(robot, seed) for robot in wanted]

    def fingerprint(robot: StudiedRobot, seed: int) -> str:
        return digest(source, robot.fingerprint, seed)

    def done(unit: tuple[StudiedRobot, int]) -> str:
        robot, seed = unit

        def make(folder: Path) -> dict[str, Any]:
            with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
                return study(robot, seed, folder)

        row = made_once(options.out, f"{robot.name}-{seed}", fingerprint(robot, seed), make)
        way = row["guided"]
        found = way.get("failed") or f"{way['motion_s']:.0f} s and {way['changes']} changes"
        steps = row["step_by_step"]
        return (
            f"{robot.name}-{seed}: guided {found}, step by step "
            f"{steps.get('failed') or steps['duration_s']}"
        )

    left = work_off(options.shard.of(units), done, options.minutes, time.monotonic, print_line)
    rows: list[dict[str, Any]] = []
    for robot, seed in units:
        path = options.out / f"{robot.name}-{seed}.json"
        if is_finished(path, fingerprint(robot, seed)):
            text = path.read_text(encoding="utf-8")
            rows.append(json.loads(text))
    line = f"\n{left} units of this piece were not begun\n\n{summary(rows)}"
    print_line(line)
    if options.tables is not None:
        write_tables(options.tables, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
