"""Gains of every shipped robot and the mass of a second payload, over the whole driver path;
effects of closed chains.

    python -m tests.studies.any_robot --only KR270 --seeds 1 2
    python -m tests.studies.any_robot --part effects --seeds 1

Each seed has plans and noise of its own: runs in turn without load and with the weighed payload, a
fit, then recordings with that payload and with a second body, which `weigh` finds with the
calibration alone. A finished seed is kept in out/robot-study/ and not made again while the robot's
row of ROBOTS and its files are the same. Writes out/robot-study.json and, if all robots and seeds
are there, the tables of docs/evidence/robots.md. The effects that a plant has beside the declared
ones, and what `residual` names, are in chain_effects.py.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from daq.config.cell_file import load_cell
from daq.documents.calibration_file import load_calibration
from daq.environment import shipped_configurations
from daq.files import replace_file
from daq.simulation.simulation_file import load_simulation, shipped_simulation
from daq.workflow.weigh import weigh_logs
from ident.arrays import BoolArray, FloatArray
from tests.pipeline.cells import fit_job, make_plan, record_job, record_run
from tests.studies.chain_effects import PLANTED, kept_effect, table_of_effects
from tests.studies.fingerprint import digest, made_once
from tests.studies.robot_tables import write_tables

OUT = Path("out/robot-study")
TABLES = Path("docs/evidence/data")
SEEDS = (1, 2, 3, 4)
LAST_PLAN = 9
LAST_NOISE = 99
"""Numbers of a seed's plans and noise for weighing, from which it counts down;
those of the fit count up.
"""
WITHIN = 1.96  #: σ of a 95 % interval


@dataclass(frozen=True, slots=True)
class StudiedRobot:
    """A robot, its experiment, and the body that is weighed afterwards."""

    name: str  #: in the table
    cell: str  #: shipped cell file
    simulation: str  #: shipped simulation file
    seconds: float  #: of each run [s]
    pairs: int  #: of runs without and with the cell's payload, each with a plan of its own
    second: str  #: second body in the simulation file
    weighed: int = 2  #: recordings with it, each with a plan of its own
    exchanges: int = 200  #: tries of the planner
    #: factor of the simulation's current noise, for a relative error of 3 to 4 %
    noise: float = 1.0

    @property
    def fingerprint(self) -> str:
        """Digest of the row and of the files that it names."""
        cells_folder = shipped_configurations() / "cells"
        cell = cells_folder / f"{self.cell}.yaml"
        simulation = shipped_simulation(self.simulation)
        files = (
            cell.read_text(),
            load_cell(cell).urdf,
            simulation.read_text(),
            load_simulation(simulation).urdf,
        )
        return digest(self, files)


ROBOTS = (
    StudiedRobot("TX-40", "demo", "clean", 40.0, 3, "plate", weighed=3, noise=1.3),
    StudiedRobot("RX-90", "rx90", "rx90", 40.0, 2, "plate", weighed=3),
    StudiedRobot("KR270", "kr270", "kr270", 60.0, 3, "tool"),
    StudiedRobot("seven-axis", "seven-axis", "seven-axis", 40.0, 2, "bar", noise=1.3),
    StudiedRobot("gantry", "gantry", "gantry", 60.0, 2, "box"),
    StudiedRobot("five-bar", "five-bar", "five-bar", 60.0, 3, "block"),
    StudiedRobot("Orthoglide", "orthoglide", "orthoglide", 40.0, 3, "spindle", noise=0.85),
    StudiedRobot("DualV", "dualv", "dualv", 40.0, 2, "plate", noise=0.8),
)
"""To study another robot, ship its cell and simulation, with two bodies, and add a row."""


def study(robot: StudiedRobot, seed: int, folder: Path) -> dict[str, Any]:
    """Gains and second payload of one seed;
    the folder is filled with its plans, logs and calibration.
    """
    with contextlib.redirect_stdout(io.StringIO()):
        job, fitted = record_job(
            robot.cell,
            folder,
            seconds=robot.seconds,
            pairs=robot.pairs,
            seed=seed,
            simulation=robot.simulation,
            exchanges=robot.exchanges,
            noise=robot.noise,
        )
        fit_job(job, fitted)
        first = job.cell.payloads[0].name
        plans = [
            make_plan(
                job,
                f"weighed-{number}.yaml",
                seed=10 * seed + LAST_PLAN - number,
                seconds=robot.seconds,
                exchanges=0,
            )
            for number in range(robot.weighed)
        ]
        # The weighed payload of the fit once more, in one run that no fit has seen (on moves that
        # it can carry), then the second body in each.
        mounted = [(first, folder / "plan-0.yaml"), *((robot.second, plan) for plan in plans)]
        weighings: dict[str, list[Path]] = {first: [], robot.second: []}
        for number, (body, plan) in enumerate(mounted):
            weighings[body].append(folder / f"{body}-{number}.mcap")
            last_noise_seed = 100 * seed + LAST_NOISE - number
            log = weighings[body][-1]
            record_run(
                job,
                plan,
                log,
                mounted=body,
                declared=False,
                seed=last_noise_seed,
            )
        calibration = load_calibration(folder / "calibration.yaml")
        weighed = {body: weigh_logs(calibration, mine).body for body, mine in weighings.items()}
    payloads: dict[str, float] = {}
    for role, name in (("payload", robot.second), ("first_payload", first)):
        path = shipped_simulation(robot.simulation)
        true = load_simulation(path, name).payload
        assert true is not None
        mass_std_kg = weighed[name].mass_std_kg
        payloads |= {
            f"{role}_kg": true.mass_kg,
            f"{role}_error_percent": 100.0 * (weighed[name].mass_kg / true.mass_kg - 1.0),
            f"{role}_std_percent": 100.0 * mass_std_kg / true.mass_kg,
        }
    total = job.calibration["relative_error_percent"]["total"]
    return {
        "robot": robot.name,
        "seed": seed,
        "gain_unit": {axis.name: axis.gain_unit for axis in job.cell.axes},
        "nameplate_gain": {axis.name: axis.nameplate_gain for axis in job.cell.axes},
        "true_gain": job.truth,
        "gain_error_percent": {axis: error for axis, (error, _) in job.gains.items()},
        "gain_std_percent": {axis: std for axis, (_, std) in job.gains.items()},
        "floor_percent": total,
    } | payloads


def kept(robot: StudiedRobot, seed: int, out: Path = OUT) -> dict[str, Any]:
    """Return the row of a seed, which is made unless it is there; logs are deleted once it is."""
    return made_once(
        out, f"{robot.name}-{seed}", robot.fingerprint, lambda folder: study(robot, seed, folder)
    )


def figures(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Figures of one robot over its seeds [%]:
    magnitudes of errors, and the share of 95 % intervals that hold.
    """
    errors, inside = gain_errors(rows)
    payload_error_percent = [row["payload_error_percent"] for row in rows]
    payload = np.abs(payload_error_percent)
    floor_percent = [row["floor_percent"] for row in rows]
    mean_floor_percent = float(np.mean(floor_percent))
    seeds = [row["seed"] for row in rows]
    mean_payload = float(np.mean(payload))
    largest_payload = float(np.max(payload))
    mean_inside = float(np.mean(inside))
    robot = rows[0]["robot"]
    gain_error_percent = rows[0]["gain_error_percent"]
    return {
        "robot": robot,
        "seeds": seeds,
        "gains": len(gain_error_percent),
        "floor_percent": mean_floor_percent,
        "mean_gain_error_percent": float(np.mean(errors)),
        "worst_gain_error_percent": float(np.max(errors)),
        "mean_payload_error_percent": mean_payload,
        "worst_payload_error_percent": largest_payload,
        "coverage_percent": 100.0 * mean_inside,
    }


def gain_errors(rows: Iterable[dict[str, Any]]) -> tuple[FloatArray, BoolArray]:
    """Magnitude of each gain's error [%] and whether it is inside its 95 % interval,
    all axes and seeds in a row.
    """
    pairs = []
    for row in rows:
        for axis, error in row["gain_error_percent"].items():
            pairs.append((abs(error), row["gain_std_percent"][axis]))
    errors, std = np.array(pairs).T
    return errors, errors < WITHIN * std


def pooled(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Coverage of the 95 % intervals over all robots, of gains and of weighed masses [%]."""
    inside = gain_errors(rows)[1]
    masses = [
        abs(row["payload_error_percent"]) < WITHIN * row["payload_std_percent"] for row in rows
    ]
    mean_inside = float(np.mean(inside))
    mean_mass = float(np.mean(masses))
    return {
        "gains": len(inside),
        "gain_coverage_percent": 100.0 * mean_inside,
        "masses": len(masses),
        "mass_coverage_percent": 100.0 * mean_mass,
    }


def table(robots: list[dict[str, Any]]) -> str:
    """One line a robot."""
    lines = [
        "| robot | gains | relative error % | gain error mean % | worst % | second payload mean % "
        "| coverage % |",
        "|---|---|---|---|---|---|---|",
    ]
    for one in robots:
        shown = (
            "floor_percent",
            "mean_gain_error_percent",
            "worst_gain_error_percent",
            "mean_payload_error_percent",
        )
        numbers = " | ".join(f"{one[key]:.2f}" for key in shown)
        lines.append(
            f"| {one['robot']} | {one['gains']} | {numbers} | {one['coverage_percent']:.0f} |"
        )
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Make the seeds that are missing, one after the other, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.any_robot", description=__doc__)
    choices = [robot.name for robot in ROBOTS]
    parser.add_argument("--only", nargs="+", choices=choices, metavar="ROBOT")
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS))
    parser.add_argument(
        "--part", nargs="+", choices=["gains", "effects"], default=["gains", "effects"]
    )
    options = parser.parse_args(arguments)
    OUT.mkdir(parents=True, exist_ok=True)
    chosen = {robot.name for robot in ROBOTS if options.only is None or robot.name in options.only}
    path = OUT.with_suffix(".json")
    document: dict[str, Any]
    if path.is_file():
        document = json.loads(path.read_text(encoding="utf-8"))
    else:
        document = {}
    if "gains" in options.part:
        document |= _gains(chosen, options.seeds)
    if "effects" in options.part:
        effects = []
        for one in PLANTED:
            if one.robot in chosen:
                for seed in options.seeds:
                    effects.append(kept_effect(one, seed, OUT))
        document["effects"] = effects
        sys.stdout.write(
            f"\nUndeclared effects:\n\n{table_of_effects(effects)}\n" if effects else ""
        )
    content = f"{json.dumps(document, indent=2)}\n".encode()
    replace_file(path, content)
    return 0


def _gains(chosen: set[str], seeds: list[int]) -> dict[str, Any]:
    """Figures of the chosen robots, printed as a table;
    of all of them also the tables of the documentation.
    """
    mine = []
    for robot in ROBOTS:
        if robot.name in chosen:
            mine.append([kept(robot, seed) for seed in seeds])
    everything = []
    for rows in mine:
        everything.extend(rows)
    robots = [figures(rows) for rows in mine]
    over_all = pooled(everything)
    if len(robots) == len(ROBOTS) and set(seeds) >= set(SEEDS):
        write_tables(TABLES, robots, everything)
    sys.stdout.write(
        f"{table(robots)}\n\n95 % intervals that hold: "
        f"{over_all['gain_coverage_percent']:.0f} % of "
        f"{over_all['gains']} gains, {over_all['mass_coverage_percent']:.0f} % of "
        f"{over_all['masses']} masses\n"
    )
    return {"robots": robots, "pooled": over_all, "rows": everything}


if __name__ == "__main__":
    raise SystemExit(main())
