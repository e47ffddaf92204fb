"""How far friction that falls while the arm warms up bends the gains,
by the order of blocks and by the model.

    python -m tests.studies.warm_up_study --seeds 1 2 3
    python -m tests.studies.warm_up_study --shard 1/2 --minutes 30      goes on where it ended

Each cell is simulated twice with the same noise, moves and times: with friction that falls on all
axes, and with friction that stays. The difference of the gains is what the warm-up does. *Bare,
then loaded* is how it is done step by step. *Guided* is the order that cancels drift
(`daq.jobs.block_order`), up to the seventh block. Both have three bare and three loaded blocks in
the fit. Each is fitted with one friction for all blocks, and with `friction_by_payload`. Layout:
out/warm-up-study/<cell>.csv.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from daq.config.cell import Cell, model_of
from daq.config.cell_file import load_cell
from daq.files import replace_file
from daq.jobs.block_order import FIRST_BLOCKS, NEXT_BLOCKS, BlockRole
from drivers.simulation.spec import UndeclaredEffect
from ident.arrays import FloatArray
from ident.data.run import Run
from ident.discovery.evidence import gather
from ident.discovery.loop import find_effects
from ident.estimators.estimate import Estimate
from ident.estimators.identify import identify
from tests.studies.direct_cell import MOVING, run_of, simulate_run
from tests.studies.fingerprint import digest, digest_of_source
from tests.studies.output import print_line
from tests.studies.side_by_side import Shard, shard
from tests.studies.study_cells import StudyCell, declared_payload, spec_of, world_cell
from tests.studies.study_plans import CELL, PlanTask, kept_plan, make_plan
from tests.studies.study_rows import finished_rows, rows_of_unit, to_csv, work_off

OUT = Path("out/warm-up-study")
WORLD = "measurement"
PAYLOAD = "disc"
SEEDS = (1, 2, 3)
TIME_CONSTANTS_MIN = (2.0, 5.0, 10.0, 30.0)
COLD_FRACTION = 0.3  #: Friction of the cold arm over that of the warm one
BLOCK_S = 20.0
PAUSE_S = 15.0  #: Between two blocks
CHANGE_S = 180.0  #: Where the payload is changed between them
FIRST_PLAN = 5001
"""Moves of this study are none of another study's."""
BARE_THEN_LOADED = (BlockRole.BARE,) * 3 + (BlockRole.LOADED,) * 3 + (BlockRole.HELD_OUT,)
GUIDED = (*FIRST_BLOCKS, *NEXT_BLOCKS)
ORDERS = {"bare, then loaded": BARE_THEN_LOADED, "guided": GUIDED}
FRICTIONS = {"one": False, "by payload": True}


@dataclass(frozen=True, slots=True)
class Row:
    """What a warm-up does to the gains of one cell in one order."""

    seed: int
    time_constant_min: float
    order: str
    friction: str  #: of the model: one for all blocks, or by payload
    bent_percent: float  #: largest change of a gain by the warm-up, of the fit without a search
    searched_bent_percent: float  #: the same after the search, whose dictionary has such a friction
    named: tuple[str, ...]  #: what the search found in the cell that warms up
    std_percent: float  #: σ of the worst gain after the search
    steady_std_percent: float  #: σ of the worst gain of the fit where friction stays
    #: largest error of a gain where the friction falls, of the fit without a search
    error_percent: float


@dataclass(frozen=True, slots=True)
class WarmingCell:
    """A cell, and how fast its friction falls."""

    seed: int
    time_constant_min: float

    @property
    def name(self) -> str:
        """Name of its file."""
        return f"{self.seed}-{self.time_constant_min:g}min"


def start_times_s(roles: Sequence[BlockRole]) -> tuple[float, ...]:
    """When each block begins [s], from the start of the session with an empty flange."""
    times: list[float] = []
    now_s = 0.0
    carried = False
    for role in roles:
        is_loaded = role is not BlockRole.BARE
        if is_loaded != carried:
            now_s += CHANGE_S
        carried = is_loaded
        times.append(now_s)
        now_s += BLOCK_S + PAUSE_S
    return tuple(times)


def simulated(
    drawn: StudyCell, cell: Cell, roles: Sequence[BlockRole], minutes: float | None
) -> list[Run]:
    """The blocks of a session; friction falls with a time constant of so many minutes,
    or stays for None.
    """
    runs = []
    for number, (role, began_s) in enumerate(zip(roles, start_times_s(roles), strict=True)):
        is_loaded = role is not BlockRole.BARE
        spec = spec_of(drawn, PAYLOAD if is_loaded else None, number)
        if minutes is not None:
            effects = tuple(warm_up(axis, minutes) for axis in range(len(spec.axes)))
            spec = replace(spec, effects=effects)
        plan = kept_plan(_plan_task(number), cell)
        payload = declared_payload(PAYLOAD) if is_loaded else None
        raw = simulate_run(cell, spec, plan, f"block-{number + 1}", payload, began_s)
        runs.append(run_of(raw, cell))
    return runs


def warm_up(axis: int, minutes: float) -> UndeclaredEffect:
    """Friction of an axis that falls with a time constant of so many minutes."""
    parameters = {"cold_fraction": COLD_FRACTION, "time_constant_s": 60.0 * minutes}
    return UndeclaredEffect("warm-up", axis, parameters)


def study(unit: WarmingCell) -> tuple[Row, ...]:
    """Both orders of one cell, each by both models of friction."""
    declared = load_cell(CELL)
    drawn = world_cell(unit.seed, WORLD)
    gain_nm_per_a = [axis.gain_nm_per_a for axis in drawn.bare.axes]
    truth = np.array(gain_nm_per_a)
    rows = []
    for order, roles in ORDERS.items():
        steady_runs = simulated(drawn, declared, roles, None)
        warming_runs = simulated(drawn, declared, roles, unit.time_constant_min)
        for friction, by_payload in FRICTIONS.items():
            cell = replace(declared, friction_by_payload=by_payload)
            steady = _gains(cell, steady_runs, roles)
            warming = _gains(cell, warming_runs, roles)
            bent_percent = _largest_change(steady.fitted, warming.fitted)
            searched_bent_percent = _largest_change(steady.searched, warming.searched)
            error_percent = _largest_change(truth, warming.fitted)
            row = Row(
                seed=unit.seed,
                time_constant_min=unit.time_constant_min,
                order=order,
                friction=friction,
                bent_percent=bent_percent,
                searched_bent_percent=searched_bent_percent,
                named=warming.named,
                std_percent=warming.std_percent,
                steady_std_percent=steady.fitted_std_percent,
                error_percent=error_percent,
            )
            rows.append(row)
    return tuple(rows)


@dataclass(frozen=True, slots=True, eq=False)
class _Gains:
    fitted: FloatArray  #: without a search, shape (n,)
    searched: FloatArray  #: after it, shape (n,)
    named: tuple[str, ...]
    std_percent: float
    fitted_std_percent: float  #: of the worst gain, without a search


def _gains(cell: Cell, runs: Sequence[Run], roles: Sequence[BlockRole]) -> _Gains:
    fit_runs = [
        run for run, role in zip(runs, roles, strict=True) if role is not BlockRole.HELD_OUT
    ]
    unseen = [run for run, role in zip(runs, roles, strict=True) if role is BlockRole.HELD_OUT]
    found = identify(model_of(cell), fit_runs, cell.conditioning)
    rng = np.random.default_rng(0)
    effects = find_effects(gather(found, fit_runs, unseen), rng)
    end = effects[-1].after
    estimate = end.estimate
    named = tuple(f"{placed.effect.name} on J{placed.axis + 1}" for placed in end.effects)
    return _Gains(
        fitted=found.estimate.gains,
        searched=estimate.gains,
        named=named,
        std_percent=_worst_std_percent(estimate),
        fitted_std_percent=_worst_std_percent(found.estimate),
    )


def _worst_std_percent(estimate: Estimate) -> float:
    absolute_gain = np.abs(estimate.gains)
    return float(100.0 * np.max(estimate.gains_std / absolute_gain))


def _largest_change(steady: FloatArray, warming: FloatArray) -> float:
    return float(100.0 * np.max(np.abs(warming / steady - 1.0)))


def _plan_task(number: int) -> PlanTask:
    seed = FIRST_PLAN + number
    return PlanTask(OUT, seed, BLOCK_S)


def fingerprint_of(unit: WarmingCell) -> str:
    """What the rows of a cell depend on."""
    return digest(
        digest_of_source("tests.studies.direct_cell", MOVING),
        digest_of_source("ident.discovery.loop"),
        ORDERS,
        (COLD_FRACTION, BLOCK_S, PAUSE_S, CHANGE_S),
        unit,
    )


def summary(rows: Sequence[Row]) -> str:
    """A line for each time constant, order and friction: the means over the cells."""
    lines = [
        "| time constant, min | order | friction | cells | bent by % | after the search: bent by % "
        "| largest error % | σ where friction stays % |",
        "|" + "---|" * 8,
    ]
    constants_min = sorted({row.time_constant_min for row in rows})
    for order in ORDERS:
        for friction in FRICTIONS:
            own = [row for row in rows if (row.order, row.friction) == (order, friction)]
            for constant_min in constants_min:
                of_one = [row for row in own if row.time_constant_min == constant_min]
                if of_one:
                    lines.append(_line(f"{of_one[0].time_constant_min:g}", of_one))
            if own:
                lines.append(_line("all", own))
    return "\n".join(lines)


def _line(name: str, rows: Sequence[Row]) -> str:
    first = rows[0]
    bent_percent = [row.bent_percent for row in rows]
    bent = np.mean(bent_percent)
    searched_bent_percent = [row.searched_bent_percent for row in rows]
    searched = np.mean(searched_bent_percent)
    error_percent = [row.error_percent for row in rows]
    error = np.mean(error_percent)
    steady_std_percent = [row.steady_std_percent for row in rows]
    std = np.mean(steady_std_percent)
    figures = f"{bent:.2f} | {searched:.2f} | {error:.2f} | {std:.2f}"
    return f"| {name} | {first.order} | {first.friction} | {len(rows)} | {figures} |"


def main(arguments: list[str] | None = None) -> int:
    """Make what is missing, and print the table of what is there."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.warm_up_study", description=__doc__
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS))
    parser.add_argument(
        "--shard", type=shard, default=Shard(), help="i/n: every n-th cell from the i-th on"
    )
    parser.add_argument("--minutes", type=float, default=60.0, help="after which no cell is begun")
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args(arguments)
    units = []
    for seed in options.seeds:
        for minutes in TIME_CONSTANTS_MIN:
            units.append(WarmingCell(seed, minutes))
    for number in range(len(GUIDED)):
        print_line(make_plan(_plan_task(number)))

    def done(unit: WarmingCell) -> str:
        rows = rows_of_unit(options.out, unit, Row, fingerprint_of(unit), study)
        return "; ".join(
            f"{unit.name}, {row.order}: bent by {row.bent_percent:.2f} %" for row in rows
        )

    left = work_off(options.shard.of(units), done, options.minutes, time.monotonic, print_line)
    rows = finished_rows(options.out, units, Row, fingerprint_of)
    content = to_csv(Row, rows).encode()
    path = options.out / "warm-up.csv"
    replace_file(path, content)
    line = f"\n{left} cells of this piece were not begun\n\n{summary(rows)}"
    print_line(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
