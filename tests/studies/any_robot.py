"""The seven-axis arm and the gantry, several seeds: how far the gains are off, and whether σ shows it.

    python -m tests.studies.any_robot

writes out/any-robot.json and prints the table of docs/evidence/robots.md; some minutes on one core.
"""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np

from tests.pipeline.cells import run_job

OUT = Path("out/any-robot")
ROBOTS = ("seven-axis", "gantry")
SEEDS = (1, 2, 3, 4)
SECONDS = 30.0
PAIRS = 2


def one(name: str, seed: int) -> dict[str, Any]:
    """Two runs without load and two with, and a fit."""
    folder = OUT / f"{name}-{seed}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    with contextlib.redirect_stdout(io.StringIO()):
        job = run_job(name, folder, seconds=SECONDS, pairs=PAIRS, seed=seed)
    return {
        "robot": name,
        "seed": seed,
        "error_percent": {axis: error for axis, (error, _) in job.gains.items()},
        "std_percent": {axis: std for axis, (_, std) in job.gains.items()},
        "floor_percent": job.calibration["relative_error_percent"]["total"],
    }


def table(rows: list[dict[str, Any]]) -> list[str]:
    """One line an axis: the errors of all seeds, their root mean square, and the mean σ."""
    lines = ["| axis | " + " | ".join(f"seed {row['seed']} %" for row in rows) + " | RMS % | mean σ % |"]
    lines.append("|---" * (len(rows) + 3) + "|")
    for axis in rows[0]["error_percent"]:
        errors = [row["error_percent"][axis] for row in rows]
        rms = float(np.sqrt(np.mean(np.square(errors))))
        std = float(np.mean([row["std_percent"][axis] for row in rows]))
        lines.append(f"| {axis} | " + " | ".join(f"{e:+.2f}" for e in errors) + f" | {rms:.2f} | {std:.2f} |")
    return lines


def main() -> int:
    """All robots and seeds, one after the other."""
    rows = [one(name, seed) for name in ROBOTS for seed in SEEDS]
    OUT.with_suffix(".json").write_text(json.dumps(rows, indent=2) + "\n")
    for name in ROBOTS:
        mine = [row for row in rows if row["robot"] == name]
        floor = ", ".join(f"{row['floor_percent']:.1f}" for row in mine)
        sys.stdout.write("\n".join([f"{name}, relative error {floor} %", "", *table(mine), "", ""]))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
