"""Are mistakes of geometry and time named on the right joint, and what are the gains worth then:
four robots.

Run by `make geometry-study`. The runs of each robot and seed are simulated once (geometry_runs.py);
each mistake is planted into their arrays or into the description (planted_mistakes.py), everything
is fitted, and the search looks for what the model lacks. A zero offset is planted on every joint on
which these runs would show it.

    python -m tests.studies.geometry_study --shard 1/2 --minutes 60  every second unit
    python -m tests.studies.geometry_study --only TX-40 --mistakes clean zero-offset --seeds 1
    python -m tests.studies.geometry_study --minutes 0               nothing is searched: the tables of what is there

Layout: out/geometry-study/<unit>.csv, the row of one unit; out/geometry-study.csv has all. Where
all units of the seeds are there, docs/evidence/data gets them with the summary. Real recordings
whose gravity is turned by 90 and by 180 degrees are units of the study, too: their rows say what
direction `fit` names, and what error it has as declared.
"""  # noqa: E501

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from daq.files import replace_file
from tests.studies.fingerprint import digest, digest_of_source
from tests.studies.geometry_runs import STUDIED, RunsOfRobot, fingerprint_of_runs
from tests.studies.geometry_units import (
    NAN,
    OBSERVABLE,
    OFFSETS_DEG,
    REAL,
    SIGMAS,
    TURNED,
    TURNS_DEG,
    MistakeRow,
    MistakeUnit,
    OffsetRow,
    observe_offsets,
    search_unit,
    turned_unit,
)
from tests.studies.output import as_csv, print_line
from tests.studies.planted_mistakes import Mistake
from tests.studies.real_runs import data_folder
from tests.studies.side_by_side import Shard, shard
from tests.studies.study_rows import finished_rows, rows_of_unit, to_csv, work_off

OUT = Path("out/geometry-study")
TABLE = Path("docs") / "evidence" / "data" / "geometry.csv"
SUMMARY = TABLE.with_name("geometry-summary.csv")
SEEDS = (1, 2, 3, 4)
WORSE_PERCENT = 0.2  #: By which a worst gain may be worse than in the clean cell


def units_of(
    out: Path, robots: Sequence[str], seeds: Sequence[int], mistakes: Sequence[str]
) -> list[MistakeUnit]:
    """Units of the study, by seed; delays go round the axes, one axis a size and seed."""
    units: list[MistakeUnit] = []
    for seed in seeds:
        for robot in robots:
            runs_of_robot = RunsOfRobot(out, robot, seed)
            axes = len(runs_of_robot.cell.axes)
            mistake_unit = MistakeUnit(out, robot, seed, Mistake.CLEAN.value, -1, 0)
            own = [mistake_unit]
            for level in range(len(OFFSETS_DEG)):
                own += [
                    MistakeUnit(out, robot, seed, Mistake.ZERO.value, axis, level)
                    for axis in range(axes)
                ]
                own.append(MistakeUnit(out, robot, seed, Mistake.GRAVITY.value, -1, level))
                late = (3 * seed + level) % axes
                own.append(MistakeUnit(out, robot, seed, Mistake.ENCODER.value, late, level))
                own.append(
                    MistakeUnit(out, robot, seed, Mistake.CURRENT.value, (late + 1) % axes, level)
                )
            units += [unit for unit in own if unit.mistake in mistakes]
    if TURNED in mistakes:
        for robot in REAL:
            units += [
                MistakeUnit(out, robot, 0, TURNED, -1, level) for level in range(len(TURNS_DEG))
            ]
    return units


def summary(rows: Sequence[MistakeRow]) -> str:
    """A line for each robot, mistake and size."""
    lines = [
        "| robot | mistake | size | planted | refused | named | within 3 σ | sense +/− | with "
        "others | error % | worst gain % |",
        "|" + "---|" * 11,
    ]
    kinds = dict.fromkeys((row.robot, row.mistake, row.size) for row in rows)
    sorted_kinds = sorted(kinds, key=lambda kind: (kind[0], kind[1], kind[2]))
    for robot, mistake, size in sorted_kinds:
        own = [
            row
            for row in rows
            if (row.robot, row.mistake, row.size) == (robot, mistake, size) and row.planted
        ]
        if own:
            lines.append(f"| {robot} | {mistake} | {size:.4g} | {_figures(own)} |")
    return "\n".join(lines)


def totals(rows: Sequence[MistakeRow]) -> str:
    """How many mistakes are named, how many clean cells have an effect,
    and which worst gains stay worse.
    """
    simulated = [row for row in rows if row.planted and row.mistake != TURNED]
    mistaken = [row for row in simulated if row.mistake != Mistake.CLEAN.value]
    smallest: dict[str, float] = {}
    for row in mistaken:
        smallest[row.mistake] = min(row.size, smallest.get(row.mistake, row.size))
    larger = [row for row in mistaken if row.size > smallest[row.mistake]]
    clean = [row for row in simulated if row.mistake == Mistake.CLEAN.value]
    bent = [row for row in clean if row.others or row.named]
    worst = {(row.robot, row.seed): row.gain_error_after_percent for row in clean}
    lines = [
        f"two larger sizes: {sum(row.named for row in larger)} of {len(larger)} named",
        f"all sizes: {sum(row.named for row in mistaken)} of {len(mistaken)} named",
        f"clean: {len(bent)} of {len(clean)} with an effect",
    ]
    lines += [_place(row) for row in larger if not row.named]
    for row in mistaken:
        raised = row.gain_error_after_percent - worst.get((row.robot, row.seed), NAN)
        if raised > WORSE_PERCENT:
            lines.append(
                f"worst gain {raised:.2f} points worse than the clean cell's: {_place(row)}"
            )
    return "\n".join(lines)


def _place(row: MistakeRow) -> str:
    found = "" if row.named else ", not named"
    others = f", but {', '.join(row.others)}" if row.others else ""
    return f"{row.robot}, seed {row.seed}, {row.mistake} {row.axis} {row.size:.4g}{found}{others}"


def _figures(rows: Sequence[MistakeRow]) -> str:
    named = [row for row in rows if row.named]
    within = sum(abs(row.z) <= SIGMAS for row in named)
    positive = sum(row.value > 0.0 for row in named)
    counts = f"{len(rows)} | {sum(bool(row.refused) for row in rows)} | {len(named)} | {within}"
    senses = f"{positive}/{len(named) - positive}"
    fits = [row for row in rows if not row.refused]
    if not fits:
        return f"{counts} | {senses} | 0 | | "
    others = sum(bool(row.others) for row in fits)
    errors = f"{_mean(fits, 'error_before_percent')} → {_mean(fits, 'error_after_percent')}"
    gains = []
    for when in ("before", "after"):
        gains.append([getattr(row, f"gain_error_{when}_percent") for row in fits])
    worst = " → ".join(f"{max(column):.2f}" for column in gains)
    return f"{counts} | {senses} | {others} | {errors} | {worst}"


def _mean(rows: Sequence[MistakeRow], field: str) -> str:
    return f"{np.mean([getattr(row, field) for row in rows]):.2f}"


def main(arguments: list[str] | None = None) -> int:
    """Simulate and search what is missing, write the table of all rows, and print the summary."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.geometry_study", description=__doc__
    )
    kinds = [*(mistake.value for mistake in Mistake), TURNED]
    parser.add_argument(
        "--only", nargs="+", choices=STUDIED, default=list(STUDIED), metavar="ROBOT"
    )
    parser.add_argument("--mistakes", nargs="+", choices=kinds, default=kinds)
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS))
    parser.add_argument(
        "--shard",
        type=shard,
        default=Shard(),
        help="i/n: every n-th robot and seed from the i-th on",
    )
    parser.add_argument("--minutes", type=float, default=60.0, help="after which no unit is begun")
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args(arguments)
    units = units_of(options.out, options.only, options.seeds, options.mistakes)
    if not (data_folder() / "tx40").is_dir():
        units = [unit for unit in units if unit.mistake != TURNED]
    # A shard has whole robots and seeds: their runs are simulated once.
    places = list(dict.fromkeys((unit.robot, unit.seed) for unit in units))
    mine = set(options.shard.of(places))
    followed = (
        "daq.config",
        "daq.workflow",
        "ident",
        "tests.studies.planted",
        "tests.studies.geometry_runs",
    )
    source = digest_of_source("tests.studies.geometry_units", followed)

    def fingerprint_of(unit: MistakeUnit) -> str:
        return digest(
            source, unit.name, "" if unit.mistake == TURNED else fingerprint_of_runs(unit.runs)
        )

    def offsets_of(unit: MistakeUnit) -> OffsetRow:
        shown = replace(unit, mistake=OBSERVABLE, axis=-1, level=0)
        (row,) = rows_of_unit(
            options.out / OBSERVABLE, shown, OffsetRow, fingerprint_of(shown), observe_offsets
        )
        return row

    def made(unit: MistakeUnit) -> tuple[MistakeRow, ...]:
        if unit.mistake == TURNED:
            return turned_unit(unit)
        return search_unit(unit, offsets_of(unit))

    def done(unit: MistakeUnit) -> str:
        (row,) = rows_of_unit(options.out, unit, MistakeRow, fingerprint_of(unit), made)
        return line_of(unit, row)

    own = [unit for unit in units if (unit.robot, unit.seed) in mine]
    left = work_off(own, done, options.minutes, time.monotonic, print_line)
    rows = finished_rows(options.out, units, MistakeRow, fingerprint_of)
    table = to_csv(MistakeRow, rows).encode()
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out.with_suffix(".csv")
    replace_file(path, table)
    every = units_of(options.out, STUDIED, options.seeds, kinds)
    if len(rows) == len(every) and {unit.name for unit in every} == {unit.name for unit in units}:
        replace_file(TABLE, table)
        content = as_csv(summary(rows)).encode()
        replace_file(SUMMARY, content)
    line = f"\n{left} units of this piece were not begun\n\n{summary(rows)}\n\n{totals(rows)}"
    print_line(line)
    return 0


def line_of(unit: MistakeUnit, row: MistakeRow) -> str:
    """A line about a unit that is done."""
    if not row.planted:
        return f"{unit.name}: not planted, its σ would be {row.predicted_std:.2g}"
    if row.refused:
        return f"{unit.name}: refused: {row.refused[:100]}"
    if unit.mistake == TURNED:
        if row.named:
            found = f"{math.degrees(row.value):.1f} ± {math.degrees(row.std):.1f}°"
        else:
            found = "not named"
        return (
            f"{unit.name}: fitted with {row.error_before_percent:.2f} %, gravity turned by {found}"
        )
    if row.named:
        found = f"{row.value:.4g} ± {row.std:.2g}"
    else:
        found = "not named"
    gains = (
        f"worst gain {row.gain_error_before_percent:.2f} -> {row.gain_error_after_percent:.2f} %"
    )
    return (
        f"{unit.name}: {row.size:.4g}: {found}; {', '.join(row.others) or 'no other'}; {gains}, "
        f"{row.processor_s:.0f} s"
    )


if __name__ == "__main__":
    sys.exit(main())
