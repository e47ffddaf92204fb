"""Effects that no file declares on closed chains, over the whole driver path:
what `residual` names, and where.

Each seed has plans and noise of its own: runs without load and with the weighed payload of a plant
that has the effect, then `residual`. A part of the robot study (any_robot.py).
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from daq.cli.app import main as drivegain
from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.errors import ExitCode
from daq.simulation.simulation_file import load_simulation, shipped_simulation
from drivers.simulation.spec import UndeclaredEffect
from tests.pipeline.cells import as_json, record_job
from tests.studies.fingerprint import digest, made_once


@dataclass(frozen=True, slots=True)
class PlantedEffect:
    """A robot whose plant has an effect, and what `residual` has to find."""

    robot: str  #: in the table
    cell: str  #: shipped cell and simulation
    effect: UndeclaredEffect  #: of the plant
    name: str  #: effect of `ident` that it is
    place: str  #: axis or joint without a motor
    coefficient: str  #: parameter of that effect to compare
    size: float  #: its true value
    seconds: float = 11.0  #: of each run [s]; enough for these sizes
    pairs: int = 1  #: of runs without and with the cell's payload, each with a plan of its own
    exchanges: int = 0  #: tries of the planner; random moves will do

    @property
    def fingerprint(self) -> str:
        """Digest of the row and of the files that it names."""
        cells_folder = shipped_configurations() / "cells"
        cell = cells_folder / f"{self.cell}.yaml"
        simulation = shipped_simulation(self.cell)
        files = (
            cell.read_text(),
            load_cell(cell).urdf,
            simulation.read_text(),
            load_simulation(simulation).urdf,
        )
        return digest(self, files)


PLANTED = (
    PlantedEffect(
        robot="Orthoglide",
        cell="orthoglide",
        effect=UndeclaredEffect("load-friction", 0, {"coefficient": 0.2}),
        name="load-friction",
        place="slide-x",
        coefficient="coefficient",
        size=0.2,
    ),
    PlantedEffect(
        robot="DualV",
        cell="dualv",
        effect=UndeclaredEffect(
            "spring", 0, {"stiffness_nm_per_rad": 0.8, "rest_rad": 0.1}, joint="elbow-2"
        ),
        name="passive-spring",
        place="elbow-2",
        coefficient="stiffness",
        size=0.8,
    ),
)
"""One on a driven joint that gravity loads, one on a joint without a motor beside a redundant
drive. A stiffer spring holds the DualV short of its targets, as its drives have no integral part.
"""


def study_effect(planted: PlantedEffect, seed: int, folder: Path) -> dict[str, Any]:
    """Effects that `residual` names in one seed, and what they change;
    the folder is filled with plans and logs.
    """
    with contextlib.redirect_stdout(io.StringIO()):
        job, logs = record_job(
            planted.cell,
            folder,
            seconds=planted.seconds,
            pairs=planted.pairs,
            seed=seed,
            exchanges=planted.exchanges,
            effects=(planted.effect,),
        )
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        code = drivegain(["residual", *map(str, logs), "--json"])
    assert code == ExitCode.OK, f"drivegain residual ended with {code}"
    found = as_json(printed.getvalue())
    wanted = (planted.name, planted.place)
    kept = {(one["name"], one["axis"]) for one in found["effects"]}
    added = []
    for turn in found["turns"]:
        added.extend(turn["added"])
    added_places = [(one["effect"], one["axis"]) for one in added]
    size = _last_size(planted, added)
    others = sorted(kept - {wanted})
    before = found["before"]["cross_validated_error_percent"]
    after = found["after"]["cross_validated_error_percent"]
    changes: dict[str, float] = {}
    errors_before: dict[str, float] = {}
    errors_after: dict[str, float] = {}
    stds_after: dict[str, float] = {}
    for change in found["gain_changes"]:
        axis = change["axis"]
        truth = job.truth[axis]
        changes[axis] = change["change_percent"]
        errors_before[axis] = 100.0 * (change["before"] / truth - 1.0)
        errors_after[axis] = 100.0 * (change["after"] / truth - 1.0)
        stds_after[axis] = 100.0 * change["after_std"] / abs(truth)
    return {
        "robot": planted.robot,
        "seed": seed,
        "effect": planted.name,
        "place": planted.place,
        "size": planted.size,
        "named": wanted in kept,
        "named_first": added_places[:1] == [wanted],
        "found_size": size["value"],
        "found_size_std": size["std"],
        "others": [f"{name} on {place}" for name, place in others],
        "added": added,
        "error_before_percent": before["total"],
        "error_after_percent": after["total"],
        "gain_change_percent": changes,
        "gain_error_before_percent": errors_before,
        "gain_error_after_percent": errors_after,
        "gain_std_after_percent": stds_after,
        "summary": found["summary"],
    }


def _last_size(planted: PlantedEffect, added: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Value and σ of the planted effect's parameter in the last turn that added the effect."""
    size = {"value": None, "std": None}
    for one in added:
        if (one["effect"], one["axis"]) != (planted.name, planted.place):
            continue
        for coefficient in one["coefficients"]:
            if coefficient["name"] == planted.coefficient:
                size = coefficient
    return size


def kept_effect(planted: PlantedEffect, seed: int, out: Path) -> dict[str, Any]:
    """Return the row of a seed, which is made unless it is there; logs are deleted once it is."""
    name = f"{planted.robot}-{planted.name}-{seed}"
    return made_once(
        out, name, planted.fingerprint, lambda folder: study_effect(planted, seed, folder)
    )


def table_of_effects(rows: Sequence[dict[str, Any]]) -> str:
    """One line a planted effect and seed."""
    lines = [
        "| robot | effect | planted | found ± σ | first | others | error % | gain error %, worst |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        if row["named"]:
            size = f"{row['found_size']:.3g} ± {row['found_size_std']:.2g}"
        else:
            size = "not named"
        effect = f"{row['effect']} on {row['place']}"
        if row["named_first"]:
            first = "yes"
        else:
            first = "no"
        others = ", ".join(row["others"]) or "none"
        errors = f"{row['error_before_percent']:.2f} → {row['error_after_percent']:.2f}"
        worst_before = max(map(abs, row["gain_error_before_percent"].values()))
        worst_after = max(map(abs, row["gain_error_after_percent"].values()))
        gains = f"{worst_before:.2f} → {worst_after:.2f}"
        identity = f"| {row['robot']} | {effect} | {row['size']:g} "
        lines.append(f"{identity}| {size} | {first} | {others} | {errors} | {gains} |")
    return "\n".join(lines)
