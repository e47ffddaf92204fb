"""Friction of the pivots that closed chains are cut at, over the whole driver path:
what `residual` names.

    python -m tests.studies.pivot_friction
    python -m tests.studies.pivot_friction --only five-bar-tip-0.3 five-bar-clean-31

Twelve cells have such friction, in each pivot of the shipped planar robots at three sizes. Beside
them are the plants as they are shipped, with small friction in the joints of the tree that have no
motor, and clean plants without that. A finished cell is kept in out/pivot-study/ while its row and
its files are the same. Prints a line for each, and writes docs/evidence/data/pivots.csv once all
are there.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from daq.cli.app import main as drivegain
from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.errors import ExitCode
from daq.files import replace_file
from daq.simulation.simulation_file import load_simulation, shipped_simulation
from drivers.simulation.spec import CellSpec, UndeclaredEffect
from tests.pipeline.cells import as_json, record_job
from tests.studies.fingerprint import digest, made_once

OUT = Path("out/pivot-study")
TABLE = Path("docs/evidence/data/pivots.csv")
SECONDS = 20.0  #: Of each of the two runs
VISCOUS_S_RAD = 0.2  #: Viscous friction per unit of dry friction
FAMILY = "passive-friction"


@dataclass(frozen=True, slots=True)
class PivotCell:
    """A shipped cell, and the friction of one of its pivots."""

    robot: str  #: shipped cell and simulation
    closure: str | None  #: whose pivot has friction; None of a cell without any
    dry_nm: float  #: dry friction
    seed: int  #: of plan and noise

    @property
    def name(self) -> str:
        """Name for files and options."""
        if self.closure is None:
            return f"{self.robot}-shipped-{self.seed}"
        return f"{self.robot}-{self.closure}-{self.dry_nm:g}"

    def plant(self, spec: CellSpec) -> CellSpec:
        """Return the plant without the friction of its pivot, from the shipped one."""
        return spec

    @property
    def effects(self) -> tuple[UndeclaredEffect, ...]:
        """Effects of the plant."""
        if self.closure is None:
            return ()
        parameters = {"coulomb_nm": self.dry_nm, "viscous_nm_s_rad": VISCOUS_S_RAD * self.dry_nm}
        return (UndeclaredEffect("pivot-friction", -1, parameters, closure=self.closure),)

    @property
    def fingerprint(self) -> str:
        """Digest of the row and of the files that it names."""
        cells_folder = shipped_configurations() / "cells"
        cell = cells_folder / f"{self.robot}.yaml"
        simulation = shipped_simulation(self.robot)
        files = (
            cell.read_text(),
            load_cell(cell).urdf,
            simulation.read_text(),
            load_simulation(simulation).urdf,
        )
        return digest(self, files)


class CleanCell(PivotCell):
    """A plant without friction in any joint that has no motor."""

    @property
    def name(self) -> str:
        """Name for files and options."""
        return f"{self.robot}-clean-{self.seed}"

    def plant(self, spec: CellSpec) -> CellSpec:
        """Return the shipped plant without friction of its passive joints."""
        return replace(spec, passive={})


PIVOTS = (("five-bar", "tip"), ("dualv", "arm-2"), ("dualv", "arm-3"), ("dualv", "arm-4"))
SIZES_NM = {"five-bar": (0.3, 0.6, 1.2), "dualv": (0.1, 0.2, 0.3)}
"""A half, one and two times the dry friction of a drive of the five-bar; a third to one of a
DualV's. With 0.6 Nm in one pivot, the DualV's recording is refused: a move does not end within its
time.
"""

SHIPPED_SEEDS = {"five-bar": (21, 22, 23), "dualv": (21,)}
CLEAN_SEEDS = {"five-bar": (31, 32, 33), "dualv": (31, 32)}


def cells() -> tuple[PivotCell, ...]:
    """Every cell of the study: with friction of a pivot, as shipped, clean."""
    found = []
    for number, (robot, closure) in enumerate(PIVOTS):
        for place, size_nm in enumerate(SIZES_NM[robot]):
            place_seed = 1 + 3 * number + place
            pivot_cell = PivotCell(robot, closure, size_nm, seed=place_seed)
            found.append(pivot_cell)
    for robot, seeds in SHIPPED_SEEDS.items():
        found += [PivotCell(robot, None, 0.0, seed) for seed in seeds]
    for robot, seeds in CLEAN_SEEDS.items():
        found += [CleanCell(robot, None, 0.0, seed) for seed in seeds]
    return tuple(found)


def study_cell(cell: PivotCell, folder: Path) -> dict[str, Any]:
    """Record a run without load and one with the weighed payload, and search:
    what is named, and the gains' errors.
    """
    with contextlib.redirect_stdout(io.StringIO()):
        job, logs = record_job(
            cell.robot,
            folder,
            seconds=SECONDS,
            pairs=1,
            seed=cell.seed,
            exchanges=0,
            effects=cell.effects,
            changed=cell.plant,
        )
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        code = drivegain(["residual", *map(str, logs), "--json"])
    assert code == ExitCode.OK, f"drivegain residual ended with {code}"
    found = as_json(printed.getvalue())
    changes = found["gain_changes"]
    before = [100.0 * (one["before"] / job.truth[one["axis"]] - 1.0) for one in changes]
    after = [100.0 * (one["after"] / job.truth[one["axis"]] - 1.0) for one in changes]
    added = []
    for turn in found["turns"]:
        added.extend(turn["added"])
    place = None if cell.closure is None else f"pivot {cell.closure}"
    sizes = []
    for one in added:
        if (one["effect"], one["axis"]) == (FAMILY, place):
            for coefficient in one["coefficients"]:
                if coefficient["name"] == "dry":
                    sizes.append(coefficient)
    total = found["before"]["cross_validated_error_percent"]["total"]
    return {
        "cell": cell.name,
        "planted": place or "none",
        "dry_nm": cell.dry_nm,
        "named": [f"{one['name']} on {one['axis']}" for one in found["effects"]],
        "found_nm": sizes[-1]["value"] if sizes else None,
        "found_std_nm": sizes[-1]["std"] if sizes else None,
        "error_before_percent": total,
        "error_after_percent": found["after"]["cross_validated_error_percent"]["total"],
        "worst_gain_error_before_percent": max(map(abs, before), default=None),
        "worst_gain_error_after_percent": max(map(abs, after), default=None),
    }


def line_of(row: dict[str, Any]) -> list[str]:
    """One line of the table."""
    if row["found_nm"] is None:
        found = "–"
    else:
        found = f"{row['found_nm']:.3f} ± {row['found_std_nm']:.3f}"
    gains = [row["worst_gain_error_before_percent"], row["worst_gain_error_after_percent"]]
    if None in gains:
        shown_gains = "–"
    else:
        shown_gains = f"{gains[0]:.2f} → {gains[1]:.2f}"
    return [
        row["cell"],
        f"{row['dry_nm']:g}",
        ", ".join(row["named"]) or "none",
        found,
        f"{row['error_before_percent']:.2f} → {row['error_after_percent']:.2f}",
        shown_gains,
    ]


def verdict(rows: Sequence[dict[str, Any]]) -> str:
    """Count cells by what is named: the pivot, another name, a pivot without friction, nothing."""
    planted = [row for row in rows if row["planted"] != "none"]
    shipped = [row for row in rows if "-shipped-" in row["cell"]]
    clean = [row for row in rows if "-clean-" in row["cell"]]
    named = [row for row in planted if f"{FAMILY} on {row['planted']}" in row["named"]]
    others = [row for row in planted if set(row["named"]) - {f"{FAMILY} on {row['planted']}"}]
    on_pivots = []
    for row in shipped:
        if any(" on pivot " in name for name in row["named"]):
            on_pivots.append(row)
    silent = [row for row in clean if not row["named"]]
    return (
        f"named as what it is in {len(named)} of {len(planted)}, another name in {len(others)}; "
        f"friction of the tree named on a pivot in {len(on_pivots)} of {len(shipped)} shipped "
        f"plants; {len(silent)} of {len(clean)} clean plants silent"
    )


def main(arguments: list[str] | None = None) -> int:
    """Study the chosen cells."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.pivot_friction", description=__doc__
    )
    names = [cell.name for cell in cells()]
    parser.add_argument("--only", nargs="+", choices=names, default=names)
    chosen = parser.parse_args(arguments).only
    rows = []
    for cell in cells():
        if cell.name not in chosen:
            continue
        make = partial(study_cell, cell)
        row = made_once(OUT, cell.name, cell.fingerprint, make)
        rows.append(row | {"cell": cell.name})
        sys.stdout.write(f"{'; '.join(line_of(rows[-1]))}\n")
        sys.stdout.flush()
    sys.stdout.write(f"{verdict(rows)}\n")
    if len(rows) == len(names):
        table = io.StringIO()
        writer = csv.writer(table, lineterminator="\n")
        writer.writerow(
            [
                "cell",
                "dry friction [Nm]",
                "named",
                "found ± σ [Nm]",
                "left-out error",
                "worst gain error",
            ]
        )
        writer.writerows(map(line_of, rows))
        content = table.getvalue().encode()
        replace_file(TABLE, content)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
