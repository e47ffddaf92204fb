"""Does it bias the gains, or make their σ too small,
to stop recording when every σ is at its target?

    python -m tests.studies.stopping_study --arm three --minutes 30

Each cell has noise and moves of its own (stopping_cells.py). σ is judged after each move or block,
and the first look at which every σ is at the target ends the recording. A σ that happens to be
small ends it too early. What is finished is not done again; `--shard 2/4` takes every fourth cell
from the second on.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from pathlib import Path

import numpy as np

from daq.files import replace_file
from tests.studies.fingerprint import digest, digest_of_source
from tests.studies.loop_noise import NORMAL_95
from tests.studies.output import as_csv, print_line
from tests.studies.side_by_side import Shard, shard
from tests.studies.stopping_cells import ARMS, ML, QUICK, CellUnit, Look, looks_of
from tests.studies.study_rows import finished_rows, rows_of_unit, work_off

OUT = Path("out/stopping-study")
TABLE = Path(__file__).parents[2] / "docs" / "evidence" / "data" / "stopping.csv"
TARGETS_PERCENT = (5.0, 2.5, 1.25)

Stop = Callable[[Sequence[Look], float], Look | None]
"""The look at which a cell's recording ends, for its looks in order and the target [%];
None where it goes on.
"""


def at_target(look: Look, target_percent: float) -> bool:
    """Whether every σ is at the target."""
    return max(look.std_percent) <= target_percent


def quick_after_each_move(looks: Sequence[Look], target_percent: float) -> Look | None:
    """Stop at the first look of the quick estimate at which every σ is at the target."""
    quick = [look for look in looks if look.estimator == QUICK]
    return next((look for look in quick if at_target(look, target_percent)), None)


def ml_after_each_block(looks: Sequence[Look], target_percent: float) -> Look | None:
    """Stop at the first end of a block at which every σ of `ml` is at the target."""
    return next((look for look in ends(looks) if at_target(look, target_percent)), None)


def ml_twice(looks: Sequence[Look], target_percent: float) -> Look | None:
    """Stop at the second of two ends of blocks in a row at which every σ of `ml` is at the
    target.
    """
    pairs = pairwise(ends(looks))
    return next(
        (b for a, b in pairs if at_target(a, target_percent) and at_target(b, target_percent)), None
    )


def ends(looks: Sequence[Look]) -> list[Look]:
    """Looks with `ml`, at the end of each block."""
    return [look for look in looks if look.estimator == ML]


RULES: dict[str, Stop] = {
    "quick, each move": quick_after_each_move,
    "ml, each block": ml_after_each_block,
    "ml, two blocks in a row": ml_twice,
}
FIXED = {
    "quick, each move": (QUICK, "quick, length fixed before"),
    "ml, each block": (ML, "ml, length fixed before"),
}
"""For a rule its estimator, and the name of recordings that all last as long as the median one by
this rule.
"""


@dataclass(frozen=True, slots=True)
class Figures:
    """Quality of the gains where the recordings of an arm end."""

    cells: int  #: that reached the target
    recorded_s: tuple[float, float, float]  #: 5, 50 and 95 % of the cells need at most so long
    error_percent: float  #: mean over all gains
    error_se: float  #: its standard error: gains of one cell share their noise, cells do not
    z_rms: float  #: error / σ, root mean square over all gains
    z_rms_se: float  #: its standard error
    coverage_percent: float  #: of intervals of ± 1.96 σ


def figures(stops: Sequence[Look]) -> Figures:
    """Pool the gains of all cells."""
    error_percent = [look.error_percent for look in stops]
    error = np.array(error_percent)
    z = np.array([look.z for look in stops])
    recorded_s = np.quantile([look.recorded_s for look in stops], (0.05, 0.5, 0.95))
    root = np.sqrt(len(stops))
    square = np.mean(z**2, axis=1)
    z_rms = float(np.sqrt(square.mean()))
    square_std = square.std(ddof=1)
    z_rms_se = float(square_std / root / (2.0 * z_rms))
    coverage_percent = float(100.0 * np.mean(np.abs(z) <= NORMAL_95))
    mean_error = error.mean(axis=1)
    error_se = float(mean_error.std(ddof=1) / root)
    mean_error_percent = float(error.mean())
    return Figures(
        cells=len(stops),
        recorded_s=(float(recorded_s[0]), float(recorded_s[1]), float(recorded_s[2])),
        error_percent=mean_error_percent,
        error_se=error_se,
        z_rms=z_rms,
        z_rms_se=z_rms_se,
        coverage_percent=coverage_percent,
    )


def by_cell(looks: Iterable[Look]) -> list[list[Look]]:
    """Looks of each cell, which follow each other."""
    return [list(own) for _, own in groupby(looks, key=lambda look: look.seed)]


def stops_of(cells: Sequence[Sequence[Look]], target_percent: float) -> dict[str, list[Look]]:
    """Where the recordings end, by rule; cells that do not reach the target are left out."""
    found: dict[str, list[Look]] = {}
    for name, rule in RULES.items():
        stops = [rule(looks, target_percent) for looks in cells]
        reached = [look for look in stops if look is not None]
        found[name] = reached
        if name in FIXED and reached:
            estimator, fixed = FIXED[name]
            found[fixed] = at_median(cells, reached, estimator)
    return found


def at_median(cells: Sequence[Sequence[Look]], stops: Sequence[Look], estimator: str) -> list[Look]:
    """Look at each cell where the median one of some recordings ends;
    cells without gains there are left out.
    """
    in_order = sorted(look.recorded_s for look in stops)
    median_s = in_order[(len(in_order) - 1) // 2]
    looks = []
    for own in cells:
        looks += [
            look for look in own if look.estimator == estimator and look.recorded_s == median_s
        ]
    return looks


def table(looks_of_arm: dict[str, list[list[Look]]]) -> str:
    """A line for each arm, target and rule."""
    lines = [
        "| arm | target σ % | stopped by | cells | recorded, s (5, 50, 95 %) | mean error % | "
        "error / σ, rms | 95 % intervals that hold the truth, % |",
        "|" + "---|" * 8,
    ]
    for arm, cells in looks_of_arm.items():
        for target in TARGETS_PERCENT:
            for rule, stops in stops_of(cells, target).items():
                if len(stops) < 2:
                    continue
                found = figures(stops)
                recorded = ", ".join(f"{value:.0f}" for value in found.recorded_s)
                error = f"{found.error_percent:+.2f} ± {found.error_se:.2f}"
                z = f"{found.z_rms:.2f} ± {found.z_rms_se:.2f}"
                head = f"| {arm} | {target:g} | {rule} | {found.cells} of {len(cells)} | {recorded}"
                lines.append(f"{head} | {error} | {z} | {found.coverage_percent:.0f} |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Record the cells that are missing, and print the table of all that are there."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.stopping_study", description=__doc__
    )
    parser.add_argument("--arm", nargs="+", choices=ARMS, default=list(ARMS))
    parser.add_argument("--cells", type=int, help="of each arm; 100 of three axes, 50 of six")
    parser.add_argument(
        "--shard", type=shard, default=Shard(), help="i/n: every n-th cell from the i-th on"
    )
    parser.add_argument("--minutes", type=float, default=60.0, help="after which no cell is begun")
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args(arguments)
    source = digest_of_source("tests.studies.stopping_cells", ("ident", "tests.ident"))

    def fingerprint_of(unit: CellUnit) -> str:
        return digest(source, unit)

    def done(unit: CellUnit) -> str:
        begun_s = time.process_time()
        rows = rows_of_unit(options.out, unit, Look, fingerprint_of(unit), looks_of)
        worst = max(rows[-1].std_percent)
        return (
            f"{unit.name}: worst sigma {worst:.2f} % at the end, "
            f"{time.process_time() - begun_s:.0f} s"
        )

    looks_of_arm = {}
    is_all = set(options.arm) == set(ARMS)
    for name in options.arm:
        cells = options.cells or ARMS[name].cells
        units = [CellUnit(name, number) for number in range(cells)]
        left = work_off(options.shard.of(units), done, options.minutes, time.monotonic, print_line)
        looks = finished_rows(options.out, units, Look, fingerprint_of)
        found = by_cell(looks)
        looks_of_arm[name] = found
        is_all &= len(found) >= ARMS[name].cells
        line = f"{name}: {left} cells of this piece were not begun"
        print_line(line)
    text = table(looks_of_arm)
    if is_all:
        content = as_csv(text).encode()
        replace_file(TABLE, content)
    print_line(f"\n{text}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
