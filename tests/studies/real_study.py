"""Do effects that are found on real robots hold where the arm was elsewhere:
TX-40, KR300 and UR10, split by region.

Run by `make real-study`; needs the recordings (real_runs.py). A recording is split into four parts
by region of the workspace, several times (regions.py). Each part is left out in turn: the search
runs on the rest alone, and only then the part is predicted, without and with the effects that are
written. Each written effect is judged on its own, too, against a model of the others that is
refitted without it. It must raise the error of no axis by more than noise. The same is done for the
one split of each recording that was made before: `today`.

    python -m tests.studies.real_study --shard 1/2 --minutes 60      every second unit; goes on where it ended
    python -m tests.studies.real_study --only ur10 --splits today
    python -m tests.studies.real_study --minutes 0                   nothing is searched: the tables of what is there

Layout: out/real-study/<unit>.csv, rows of one unit; out/real-study.csv has all. Where all units are
there, it is written to docs/evidence/data, with the summary.
"""  # noqa: E501

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from daq.files import replace_file
from ident.errors import IdentificationError
from ident.estimators.estimate import of_squares
from tests.studies.fingerprint import digest, digest_of_source
from tests.studies.output import as_csv, print_line
from tests.studies.real_runs import RECORDINGS, data_folder
from tests.studies.real_splits import EVERYTHING, REGION, TODAY, JudgedEffect, SplitUnit, judge_unit
from tests.studies.regions import PARTS
from tests.studies.side_by_side import Shard, shard
from tests.studies.study_rows import finished_rows, rows_of_unit, to_csv, work_off

OUT = Path("out/real-study")
TABLE = Path("docs/evidence/data/real.csv")
SUMMARY = Path("docs/evidence/data/real-summary.csv")
SEEDS = (1, 2, 3)
ROUNDED_POINTS = 0.005  #: Rise of a total that two decimals show [points]
SEEN_POINTS = 0.1  #: Rise of an axis's error that a report shows [points]
CLEAR_POINTS = 1.0  #: Rise that is large, noise or not [points]


def units_of(
    recordings: Sequence[str], splits: Sequence[str], seeds: Sequence[int]
) -> tuple[SplitUnit, ...]:
    """Units of the study, the split of today and the first seed first."""
    parts_today = {name: 4 if name == "tx40" else 1 for name in RECORDINGS}
    units: list[SplitUnit] = []
    if TODAY in splits:
        for name in recordings:
            units += [SplitUnit(name, TODAY, 0, part) for part in range(parts_today[name])]
    if REGION in splits:
        for seed in seeds:
            for name in recordings:
                units += [SplitUnit(name, REGION, seed, part) for part in range(PARTS)]
    return tuple(units)


def summary(rows: Sequence[JudgedEffect]) -> str:
    """A line for each recording and split, and one for all splits by region."""
    lines = [
        "| recording | split | parts | effects written | raise an axis beyond noise | these by "
        f"{SEEN_POINTS:g} points | raise an axis by {CLEAR_POINTS:g} point at all | totals that "
        "rise | beyond noise | mean error % | total error % |",
        "|" + "---|" * 11,
    ]
    for name in RECORDINGS:
        for split in (TODAY, REGION):
            own = [row for row in rows if (row.recording, row.split) == (name, split)]
            if own:
                lines.append(f"| {name} | {split} | {_figures(own)}")
    regions = [row for row in rows if row.split == REGION]
    if regions:
        lines.append(f"| all | {REGION} | {_figures(regions, errors=False)}")
    return "\n".join(lines)


def _figures(rows: Sequence[JudgedEffect], *, errors: bool = True) -> str:
    """Counts and errors over some parts, as the end of a line of the table."""
    wholes = [row for row in rows if row.effect == EVERYTHING]
    effects = [row for row in rows if row.effect != EVERYTHING]
    raising = [row for row in effects if row.raises]
    seen = sum(row.raised_points >= SEEN_POINTS for row in raising)
    clearly = sum(row.largest_rise_points >= CLEAR_POINTS for row in effects)
    rising = sum(row.total_rise_points >= ROUNDED_POINTS for row in wholes)
    shown = sum(row.total_raises for row in wholes)
    counts = (
        f"{len(wholes)} | {len(effects)} | {len(raising)} | {seen} | {clearly} | {rising} | {shown}"
    )
    if not errors:  # torques of different robots are not added
        return f"{counts} | | |"
    size = np.sum([row.size_nm2 for row in wholes], axis=0)
    before = of_squares(size, np.sum([row.before_nm2 for row in wholes], axis=0))
    after = of_squares(size, np.sum([row.after_nm2 for row in wholes], axis=0))
    means = f"{np.mean(before.axes):.2f} → {np.mean(after.axes):.2f}"
    return f"{counts} | {means} | {before.total:.2f} → {after.total:.2f} |"


def raising_effects(rows: Sequence[JudgedEffect]) -> str:
    """A line for each written effect that raises the error of an axis by more than noise."""
    lines = [
        "| recording | split | part | effect | axis | t | limit | blocks | rise, points |",
        "|" + "---|" * 9,
    ]
    for row in rows:
        if row.effect != EVERYTHING and row.raises:
            where = f"{row.split} {row.seed} | {row.part}"
            judged = f"{row.raised_axis} | {row.t:.1f} | {row.t_limit:.1f} | {row.blocks}"
            lines.append(
                f"| {row.recording} | {where} | {row.effect} | {judged} | "
                f"{row.raised_points:+.2f} |"
            )
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Search what is missing, write the table of all rows, and print the summary."""
    parser = argparse.ArgumentParser(prog="python -m tests.studies.real_study", description=__doc__)
    parser.add_argument(
        "--only", nargs="+", choices=RECORDINGS, default=list(RECORDINGS), metavar="RECORDING"
    )
    parser.add_argument("--splits", nargs="+", choices=(TODAY, REGION), default=[TODAY, REGION])
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS))
    parser.add_argument(
        "--shard", type=shard, default=Shard(), help="i/n: every n-th unit from the i-th on"
    )
    parser.add_argument("--minutes", type=float, default=60.0, help="after which no unit is begun")
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args(arguments)
    if not (data_folder() / "tx40").is_dir():
        line = (
            f"found no {data_folder() / 'tx40'}; expected the recordings there, or "
            "DRIVEGAIN_DATA to name it"
        )
        print_line(line)
        return 2
    units = units_of(options.only, options.splits, options.seeds)
    rooms = ("daq.log", "ident", "tests.studies.re")
    source = digest_of_source("tests.studies.real_splits", rooms)

    def fingerprint_of(unit: SplitUnit) -> str:
        return digest(source, unit)

    def done(unit: SplitUnit) -> str:
        try:
            rows = rows_of_unit(options.out, unit, JudgedEffect, fingerprint_of(unit), judge_unit)
        except IdentificationError as error:
            return f"{unit.name}: the rest is refused: {error}"
        whole = rows[0]
        change = f"{whole.error_before.total:.2f} -> {whole.error_after.total:.2f} %"
        return (
            f"{unit.name}: {change}, {', '.join(whole.written) or 'nothing'}, "
            f"{whole.processor_s:.0f} s"
        )

    left = work_off(options.shard.of(units), done, options.minutes, time.monotonic, print_line)
    rows = finished_rows(options.out, units, JudgedEffect, fingerprint_of)
    table = to_csv(JudgedEffect, rows).encode()
    path = options.out.with_suffix(".csv")
    replace_file(path, table)
    is_all = {unit.name for unit in units_of(list(RECORDINGS), (TODAY, REGION), SEEDS)} <= {
        unit.name for unit in units
    }
    complete = sum(row.effect == EVERYTHING for row in rows) == len(units)
    if is_all and complete:
        replace_file(TABLE, table)
        content = as_csv(summary(rows)).encode()
        replace_file(SUMMARY, content)
    print_line(
        f"\n{left} units of this piece were not begun\n\n{summary(rows)}\n\n{raising_effects(rows)}"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
