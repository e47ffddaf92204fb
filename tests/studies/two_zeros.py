"""Two zeros that are wrong at once: what `fit` names, and with which sizes.

    python -m tests.studies.two_zeros                                 two robots, seeds 1 to 4
    python -m tests.studies.two_zeros --only KR270 --seeds 1          some of them

The runs are those of the geometry study (`make geometry-study`), made if they are not there. Each
unit is one line: what was planted, what the check beside the fit has named, and how far each value
is from the truth, in σ.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ident.data.run import Run
from ident.discovery.geometry_check import check_geometry
from ident.effects.geometry_corrections import ZeroOffset
from tests.studies.geometry_runs import STUDIED, RunsOfRobot, load_runs, make_runs
from tests.studies.geometry_study import OUT
from tests.studies.geometry_units import fitted
from tests.studies.output import print_line

ROBOTS = ("TX-40", "KR270")
PLANTED_DEG: tuple[dict[int, float], ...] = (
    {},
    {1: 2.0, 2: -3.0},
    {1: 2.0, 2: 2.0},
    {1: 1.0, 2: -1.0},
    {1: 5.0, 2: -5.0},
    {2: 2.0, 4: 2.0},
)
"""Zeros that are off, by index of the joint: J2 with J3, and J3 with J5."""


def with_zeros(run: Run, off_deg: dict[int, float]) -> Run:
    """A run whose positions are read from other zeros."""
    position = run.position_rad.copy()
    for axis, angle_deg in off_deg.items():
        position[:, axis] += np.radians(angle_deg)
    return replace(run, position_rad=position)


def planted_text(off_deg: dict[int, float]) -> str:
    """What was planted: `J2 +2, J3 -3`."""
    return (
        ", ".join(f"J{axis + 1} {angle_deg:+g}" for axis, angle_deg in off_deg.items()) or "nothing"
    )


def study(task: RunsOfRobot, off_deg: dict[int, float]) -> str:
    """Plant zeros, fit, and say in a line what is named."""
    runs = tuple(with_zeros(run, off_deg) for run in load_runs(task))
    evidence = fitted(task.cell, runs)
    named: list[str] = []
    right: set[int] = set()
    rng = np.random.default_rng(0)
    for found in check_geometry(evidence, rng).mistakes:
        coefficient_deg = np.degrees(found.coefficients[0])
        value_deg = float(coefficient_deg)
        deviation_deg = np.degrees(found.deviations[0])
        std_deg = float(deviation_deg)
        if isinstance(found.effect, ZeroOffset) and found.axis in off_deg:
            z = (value_deg + off_deg[found.axis]) / std_deg
            right.add(found.axis)
            named.append(f"J{found.axis + 1} {value_deg:+.2f} ± {std_deg:.2f}° (z {z:+.1f})")
        else:
            named.append(f"{found.effect.name} on J{found.axis + 1}, which is right")
    if right == set(off_deg) and len(named) == len(right):
        verdict = "all"
    else:
        verdict = "NOT ALL"
    return (
        f"{task.robot}-{task.seed}, {planted_text(off_deg)}: {verdict} named: "
        f"{', '.join(named) or 'nothing'}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study; return 0."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", choices=STUDIED, default=list(ROBOTS), metavar="ROBOT")
    default = [1, 2, 3, 4]
    parser.add_argument("--seeds", nargs="+", type=int, default=default)
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args(arguments)
    for robot in options.only:
        for seed in options.seeds:
            task = RunsOfRobot(options.out, robot, seed)
            make_runs(task)
            for off_deg in PLANTED_DEG:
                print_line(study(task, off_deg))
    return 0


if __name__ == "__main__":
    sys.exit(main())
