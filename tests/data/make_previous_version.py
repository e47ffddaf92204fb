"""Make `tests/data/previous_version`: cell, log, calibrations,
audit and history as an earlier version wrote them.

    git worktree add --detach ../previous ad5bfbc
    cd ../previous && PYTHONPATH=$PWD python .../tests/data/make_previous_version.py OUT

`tests/pipeline/test_previous_version.py` opens these files with the present version. Run this with
the version whose files are wanted, never with the present one: its modules are looked up by the
names that they had there.
"""

from __future__ import annotations

import importlib
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

DURATION_S = 12.0
VALIDATION_MOVES = 3
"""Of the log that is kept: it must be small."""
CONFIGS = Path("configs")
POLICY = (
    "policy: {apply: {max_age_days: null, max_error_percent: 60.0, max_axis_error_percent: "
    "100.0}}\n"
)
CELL = "press.yaml"


def drivegain(folder: Path, *arguments: str) -> None:
    """Run a command of that version in a folder.

    Raises:
        subprocess.CalledProcessError: it failed.
    """
    subprocess.run([sys.executable, "-m", "daq", *arguments], cwd=folder, check=True)


def make_cell_files(out: Path) -> None:
    """Copy the demonstration's cell under another name, with its robot and its controller file."""
    for folder in ("cells", "robots", "controllers"):
        (out / folder).mkdir(parents=True)
    text = (CONFIGS / "cells" / "demo.yaml").read_text()
    for old, new in (
        ("name: demo", "name: press"),
        ("controllers/demo", "controllers/press"),
        ("us: 1000", "us: 2000"),
    ):
        text = text.replace(old, new, 1)
    (out / "cells" / CELL).write_text(text + POLICY)
    shutil.copy(CONFIGS / "robots" / "tx40.urdf", out / "robots")
    shutil.copy(CONFIGS / "controllers" / "demo.yaml", out / "controllers" / "press.yaml")


def simulate_logs(out: Path, logs: Path, moves: int | None = None) -> None:
    """Write bare.mcap, loaded.mcap and unused.mcap into `logs`,
    each with so many moves or all of them.
    """
    fleet: Any = importlib.import_module("tests.bench.fleet_cells")
    fleet.CELL = out / "cells" / CELL
    spec_of = fleet.spec_of
    fleet.spec_of = lambda *arguments: replace(spec_of(*arguments), sync_period_us=2000)
    fleet._own_file = lambda text, _made, _mass_kg: text
    fleet._of_mass = lambda body, _mass_kg: replace(body)
    fleet.Payload = lambda name, mounting, _known: importlib.import_module("ident.payload").Payload(
        name, mounting, {"m": 4.59}
    )
    plans = tuple(
        replace(plan, moves=plan.moves[:moves]) for plan in fleet.plans_of(1, 300, DURATION_S)[0]
    )
    made = logs / fleet.make_cell(fleet.FleetCell(logs, 0, plans))
    for log in made.iterdir():
        log.rename(logs / log.name)


def main(out: Path) -> int:
    """Make all of it."""
    make_cell_files(out)
    long = out / "long"
    short = out / "short"
    simulate_logs(out, long)
    simulate_logs(out, short, VALIDATION_MOVES)
    (short / "unused.mcap").rename(out / "held-out.mcap")
    runs = ("long/bare.mcap", "long/loaded.mcap")
    for method in ("ml", "wls", "tls"):
        drivegain(
            out,
            "fit",
            *runs,
            "--holdout",
            "long/unused.mcap",
            "--method",
            method,
            "--out",
            f"{method}.yaml",
        )
    cell = f"cells/{CELL}"
    for calibration, who in (("wls.yaml", "Ada"), ("ml.yaml", "Bert")):
        drivegain(
            out,
            "apply",
            calibration,
            "--cell",
            cell,
            "--yes",
            "--by",
            who,
            "--payload-mass",
            "disc=4.59",
        )
    drivegain(out, "rollback", "--cell", cell, "--by", "Cleo")
    drivegain(out, "history", cell, "--add", "tls.yaml")
    drivegain(
        out, "history", cell, "--acknowledge", "J4", "--by", "Dora", "--why", "gearbox exchanged"
    )
    drivegain(out, "history", cell, "--verify")
    for folder in (long, short):
        shutil.rmtree(folder)
    return 0


if __name__ == "__main__":
    raise SystemExit(main(Path(sys.argv[1]).resolve()))
