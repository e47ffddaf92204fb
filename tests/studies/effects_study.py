"""Which effects are named, how far the error falls, and what happens to the gains:
cells with undeclared effects.

Run by `make effects-study`; simulates what is missing (effect_runs.py), searches, and prints the
tables of docs/evidence/effects-study.md. Runs and rows are kept in out/effects-study/<world>, so
that a study that was interrupted goes on where it ended:

    python -m tests.studies.effects_study --world loop3 --shard 2/4     every fourth case; the tables show all there is
    python -m tests.studies.effects_study --only single clean --kept    nothing is simulated or searched
    python -m tests.studies.effects_study --blind 4711 --count 20       cells that nobody has chosen (blind_cells.py)

A row is scored with what no search has seen: the two runs that were held out, and the truth of the
cell.
"""  # noqa: E501

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from daq.config.cell import Cell, model_of
from daq.config.cell_file import load_cell
from daq.files import replace_file
from drivers.simulation.spec import UndeclaredEffect
from ident.arrays import FloatArray
from ident.discovery.evidence import Evidence, by_instruments, gather
from ident.discovery.loop import Step, find_effects
from ident.effects.dictionary import EFFECTS
from ident.effects.effect import Effect, GearSide, PlacedEffect
from ident.estimators.estimate import Estimate
from ident.estimators.identify import identify
from tests.studies.blind_cells import blind_cases, confusion
from tests.studies.effect_cells import APART, CLEAN, FURTHER, SINGLES, SMALLS, TOGETHER, EffectCase
from tests.studies.effect_runs import (
    DURATION_S,
    CaseRuns,
    CaseTask,
    fingerprint_of_runs,
    load_runs,
    make_case,
)
from tests.studies.fingerprint import digest, digest_of_source, finish, is_finished
from tests.studies.output import as_csv
from tests.studies.side_by_side import Shard, shard, side_by_side
from tests.studies.study_cells import WORLDS, world_cell
from tests.studies.study_plans import CELL, make_plan
from tests.studies.study_rows import with_tuples

OUT = Path("out/effects-study")
VARIABLES = {
    "asymmetric-viscous": ("smooth-velocity",),
    "load-friction": ("smooth-load",),
    "warm-up": ("smooth-time", "smooth-session"),
    "spring": ("smooth-position",),
    "position-friction": ("smooth-position",),
    "cogging": ("periodic-motor-angle",),
}
"""Families that the dictionary is made to lack, and what their residual is a function of.

Stribeck and non-linear viscous friction are not among them: each explains the other (their
ambiguity says so).
"""
REMOVED = tuple(case for case in SINGLES if case.effects[0].name in VARIABLES)
IMPORTED = tuple(case for case in SINGLES if case.effects[0].name == "warm-up")
"""Cases whose runs are imported from CSV files as well:
what depends on the time needs the order of the files.
"""
SAME = {
    "spring": ("hinge", "gravity-compensator"),
    "cogging": ("ripple",),
    "load-friction": ("efficiency",),
}
"""Families that say the same as another one, and are removed with it."""
FRICTION = frozenset(
    {
        "stribeck",
        "nonlinear-viscous",
        "asymmetric-viscous",
        "load-friction",
        "warm-up",
        "presliding",
        "position-friction",
    }
)
LARGEST_RISE_PERCENT = 0.2
"""By which an accepted set of effects may raise the worst gain error [points],
or by the σ of that gain.
"""
GAIN_PERCENT = 1.5  #: Largest gain error of a cell with one effect that counts as small
WITHIN_95 = 1.96  #: Half-width of a 95 % interval in σ
PARTS: tuple[tuple[str, tuple[EffectCase, ...]], ...] = (
    ("single", SINGLES),
    ("clean", CLEAN),
    ("small", SMALLS),
    ("apart", APART),
    ("together", TOGETHER),
    ("further", FURTHER),
    ("removed", REMOVED),
    ("imported", IMPORTED),
)
Cases = tuple[tuple[str, EffectCase], ...]
"""Part of the study and case."""


@dataclass(frozen=True, slots=True)
class Row:
    """One cell.

    Attributes:
        part: of the study.
        case: its name.
        world: of WORLDS.
        seed: of its truth.
        true: effects of the plant, as `family on J3`.
        named: effects that the search accepted, in its order.
        ambiguity: of the first one.
        error_before_percent, error_after_percent: on the held-out runs, of the first true effect's
            axis; of the whole for a clean cell.
        clean_percent: the error before the search of each axis, of a clean cell alone.
        floor_percent: the same error of the same seed's clean cell, None where that was not
            searched.
        max_gain_error_before_percent, max_gain_error_percent: of the worst gain before and after.
        worst_std_percent: σ of that gain after.
        excess_removed: share of the excess over the floor, squared, that went; None without a
            floor.
        limit_nm: what would have been found on that axis at the end.
        processor_s: of identification and search.
        simulation_s: processor time of the simulation, 0 where the runs were there.
        set_aside: findings that passed the search, but not a gate of the joint fit.
        gain_error_percent, gain_std_percent: of each gain after the search, the error with its
            sign.
        iv_gain_error_percent, iv_gain_std_percent: the same by ``iv``; empty where no demanded
            motion is known.
    """

    part: str
    case: str
    world: str
    seed: int
    true: tuple[str, ...]
    named: tuple[str, ...]
    ambiguity: tuple[str, ...]
    error_before_percent: float
    error_after_percent: float
    clean_percent: tuple[float, ...]
    max_gain_error_before_percent: float
    max_gain_error_percent: float
    worst_std_percent: float
    limit_nm: float
    processor_s: float
    simulation_s: float
    floor_percent: float | None = None
    excess_removed: float | None = None
    set_aside: tuple[str, ...] = ()
    gain_error_percent: tuple[float, ...] = ()
    gain_std_percent: tuple[float, ...] = ()
    iv_gain_error_percent: tuple[float, ...] = ()
    iv_gain_std_percent: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class _Task:
    runs: CaseTask
    parts: tuple[str, ...]

    def path(self, part: str) -> Path:
        """File of the row of a part."""
        return self.runs.path.with_name(f"{part}-{self.runs.case.name}.json")


def study(
    chosen: Cases,
    world: str,
    *,
    out: Path = OUT,
    part: Shard | None = None,
    processes: int = 2,
    kept: bool = False,
    duration_s: float = DURATION_S,
) -> tuple[Row, ...]:
    """Search the cases of a shard, and return the rows of all cases that were searched so far.

    Args:
        chosen: parts and cases.
        world: of WORLDS.
        out: folder of runs and rows.
        part: cases to simulate and search; all by default.
        processes: side by side.
        kept: simulate and search nothing.
        duration_s: of each run.

    Raises:
        TaskFailed: simulating or searching failed; what was finished before is kept.
    """
    cases = {case.name: case for _, case in chosen}
    # A shard has whole cases: two of its parts search the same runs.
    tasks = [
        _Task(
            CaseTask(out, world, case, duration_s),
            tuple(name for name, other in chosen if other is case),
        )
        for case in cases.values()
    ]
    mine = () if kept else (part or Shard()).of(tasks)
    plans = dict.fromkeys(made for task in mine for made in task.runs.plans)
    for line in side_by_side(make_plan, plans, processes) if mine else ():
        _print_line(line)
    for lines in side_by_side(_work, mine, processes) if mine else ():
        for line in lines:
            _print_line(line)
    paths = []
    for task in tasks:
        for name in task.parts:
            paths.append(task.path(name))
    documents = [json.loads(path.read_text()) for path in paths if path.is_file()]
    rows = [Row(**with_tuples(document)) for document in documents]
    return with_floors(rows)


def with_floors(rows: Sequence[Row]) -> tuple[Row, ...]:
    """Add the errors of the same seed's cells without any effect."""
    clean = {row.seed: row.clean_percent for row in rows if row.part == "clean"}

    def floored(row: Row) -> Row:
        if not row.true or row.seed not in clean:
            return row
        axis = int(row.true[0].split(" on J")[1].split("+")[0]) - 1
        floor = clean[row.seed][axis]
        excess = max(row.error_before_percent**2 - floor**2, 1e-9)
        removed = (row.error_before_percent**2 - row.error_after_percent**2) / excess
        return replace(row, floor_percent=floor, excess_removed=removed)

    return tuple(floored(row) for row in rows)


def _work(task: _Task) -> tuple[str, ...]:
    """Simulate and search one case as far as that was not done."""
    searching = digest_of_source("ident.discovery.loop"), digest_of_source("daq.log.importing")
    fingerprint = digest(*searching, f"{fingerprint_of_runs(task.runs)}\n")
    lacking = [part for part in task.parts if not is_finished(task.path(part), fingerprint)]
    lines = [
        f"{part} {task.runs.case.name}, {task.runs.world}: kept"
        for part in task.parts
        if part not in lacking
    ]
    # A row that was carried here from another machine (kept_rows.py) needs no recordings.
    simulation_s = make_case(task.runs) if lacking else 0.0
    for part in lacking:
        path = task.path(part)
        row = _search(task.runs, part, simulation_s)
        content = json.dumps(asdict(row)).encode()
        replace_file(path, content)
        finish(path, fingerprint)
        lines.append(
            f"{part} {row.case}, {row.world}: {', '.join(row.named) or 'nothing'}; "
            f"{row.error_before_percent:.2f} -> {row.error_after_percent:.2f} %, worst gain "
            f"{row.max_gain_error_percent:.2f} %, {row.processor_s:.0f} s, simulated in "
            f"{row.simulation_s:.0f} s"
        )
        simulation_s = 0.0
    return tuple(lines)


def search_runs(
    cell: Cell, runs: CaseRuns, families: tuple[tuple[Effect, ...], ...] = EFFECTS
) -> tuple[Evidence, tuple[Step, ...]]:
    """Identify the runs of a case and search them: the model without effects, and the turns."""
    found = identify(model_of(cell), runs.fit, cell.conditioning)
    start = gather(found, runs.fit, runs.held_out)
    rng = np.random.default_rng(0)
    return start, find_effects(start, rng, families=families)


def _search(task: CaseTask, part: str, simulation_s: float) -> Row:
    case = task.case
    cell = load_cell(CELL)
    runs = load_runs(task, imported=part == "imported")
    lacking = case.effects[0].name if part == "removed" else ""
    removed = (lacking, *SAME.get(lacking, ()))
    families = tuple(family for family in EFFECTS if family[0].name not in removed)
    begun_s = time.process_time()
    start, steps = search_runs(cell, runs, families)
    spent_s = time.process_time() - begun_s
    axes = world_cell(case.seed, task.world).bare.axes
    gain_nm_per_a = [axis.gain_nm_per_a for axis in axes]
    truth = np.array(gain_nm_per_a)
    end = steps[-1].after
    axis = case.effects[0].axis if case.effects else None
    accepted = tuple(step.accepted for step in steps if step.accepted is not None)
    error_before = _gain_error(start, truth)
    error_after = _gain_error(end, truth)
    worst = int(np.argmax(error_after))
    gains = _gains_of(end.estimate, truth)
    (error, std), refitted = gains, by_instruments(end)
    aside = []
    for step in steps:
        for one in step.set_aside:
            placed_effect = PlacedEffect(one.finding.effect, one.finding.axis)
            aside.append(placed_effect)
    true = tuple(_true(effect) for effect in case.effects)
    named = tuple(_placed(placed) for placed in end.effects)
    return Row(
        part=part,
        case=case.name,
        world=task.world,
        seed=case.seed,
        true=true,
        named=named,
        ambiguity=() if not accepted else tuple(_placed(rival) for rival in accepted[0].ambiguity),
        error_before_percent=_holdout(start, axis),
        error_after_percent=_holdout(end, axis),
        clean_percent=()
        if case.effects
        else tuple(_holdout(start, one) for one in range(len(truth))),
        max_gain_error_before_percent=float(error_before.max()),
        max_gain_error_percent=float(error_after[worst]),
        worst_std_percent=float(
            100.0 * end.estimate.gains_std[worst] / abs(end.estimate.gains[worst])
        ),
        limit_nm=float(steps[-1].limits_nm[axis or 0]),
        processor_s=spent_s,
        simulation_s=simulation_s,
        set_aside=tuple(map(_placed, aside)),
        gain_error_percent=error,
        gain_std_percent=std,
        iv_gain_error_percent=() if refitted is None else _gains_of(refitted, truth)[0],
        iv_gain_std_percent=() if refitted is None else _gains_of(refitted, truth)[1],
    )


def _holdout(evidence: Evidence, axis: int | None) -> float:
    error = evidence.holdout_error
    if error is None:
        raise ValueError("every case of the study holds two runs out")
    return error.total if axis is None else error.axes[axis]


def _gain_error(evidence: Evidence, truth: FloatArray) -> FloatArray:
    """Absolute error of each gain [%], shape (n,)."""
    gains = _gains_of(evidence.estimate, truth)
    return np.abs(gains[0])


def _gains_of(estimate: Estimate, truth: FloatArray) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Error and σ of each gain [% of the truth]."""
    error = 100.0 * (estimate.gains / truth - 1.0)
    std = 100.0 * estimate.gains_std / np.abs(truth)
    return tuple(error.tolist()), tuple(std.tolist())


def _true(effect: UndeclaredEffect) -> str:
    axes = sorted({effect.axis + 1, int(effect.parameters.get("other_axis", effect.axis + 1))})
    return f"{effect.name} on {'+'.join(f'J{axis}' for axis in axes)}"


def _placed(placed: PlacedEffect) -> str:
    axes = sorted(
        {placed.axis + 1, int(placed.effect.settings.get("other_axis", 0)) or placed.axis + 1}
    )
    if placed.effect.side is not GearSide.TWO_JOINTS:
        axes = [placed.axis + 1]
    return f"{placed.effect.name} on {'+'.join(f'J{axis}' for axis in axes)}"


def verdicts(rows: Sequence[Row]) -> tuple[str, ...]:
    """The study's figures, a line each."""
    lines = []
    single = [row for row in rows if row.part == "single"]
    if single:
        first = [row for row in single if row.named[:1] == row.true]
        known = [
            row for row in single if row.true[0] in (*row.named[:1], *row.ambiguity) and row.named
        ]
        friction = [
            row
            for row in single
            if row.true[0].split()[0] in FRICTION and row.floor_percent is not None
        ]
        near = [
            row for row in friction if row.error_after_percent <= (row.floor_percent or 0.0) + 0.3
        ]
        small = [row for row in single if row.max_gain_error_percent <= GAIN_PERCENT]
        lines += [
            f"one effect: {len(first)} of {len(single)} named first, {len(known)} named or in the "
            "ambiguity set",
            f"friction: {len(near)} of {len(friction)} within 0.3 points of their clean floor",
            "processor time with one effect: median "
            f"{np.median([row.processor_s for row in single]):.0f} s, most "
            f"{max(row.processor_s for row in single):.0f} s",
            f"gains: {len(small)} of {len(single)} within {GAIN_PERCENT} %",
        ]
    clean = [row for row in rows if row.part == "clean"]
    if clean:
        error_before_percent = [row.error_before_percent for row in clean]
        error = np.mean(error_before_percent)
        gain = max(row.max_gain_error_percent for row in clean)
        lines.append(
            f"clean: {sum(bool(row.named) for row in clean)} of {len(clean)} with a false effect, "
            f"{sum(bool(row.set_aside) and not row.named for row in clean)} with one that was set "
            f"aside; error {error:.2f} % in the mean, worst gain {gain:.2f} %"
        )
    for name, group in (("clean", clean), ("with one effect", single)):
        for method in ("", "iv_"):
            errors, stds = (
                np.array(
                    [
                        getattr(row, f"{method}gain_{kind}_percent")
                        for row in group
                        if row.iv_gain_error_percent
                    ]
                )
                for kind in ("error", "std")
            )
            if errors.size:
                held = 100.0 * np.mean(np.abs(errors) < WITHIN_95 * stds)
                lines.append(
                    f"gains of cells {name} by {method.strip('_') or 'ml'}: error "
                    f"{np.abs(errors).mean():.2f} % in the mean, {np.abs(errors).max():.2f} % at "
                    f"most; 95 % intervals hold {held:.1f} %"
                )
    if rows:
        bent = [
            row
            for row in rows
            if row.max_gain_error_percent
            > row.max_gain_error_before_percent + max(LARGEST_RISE_PERCENT, row.worst_std_percent)
        ]
        lines.append(
            f"worst gain error raised by more than {LARGEST_RISE_PERCENT} points and its σ: "
            f"{len(bent)} of {len(rows)}" + "".join(f", {row.case}" for row in bent)
        )
    for part in ("apart", "together"):
        both = [row for row in rows if row.part == part]
        if both:
            hit = sum(set(row.true) <= set(row.named) for row in both)
            lines.append(f"two effects {part}: both named in {hit} of {len(both)}")
    further = [row for row in rows if row.part == "further"]
    if further:
        first = [row for row in further if row.named[:1] == row.true]
        small = [row for row in further if row.max_gain_error_percent <= GAIN_PERCENT]
        lines.append(
            f"cables, drifts and play: {len(first)} of {len(further)} named first, gains of "
            f"{len(small)} within {GAIN_PERCENT} %"
        )
    imported = [row for row in rows if row.part == "imported"]
    if imported:
        named = sum(set(row.true) <= set(row.named) for row in imported)
        lines.append(f"warm-up, imported from CSV: {named} of {len(imported)} named")
    removed = [row for row in rows if row.part == "removed"]
    if removed:
        right = [row for row in removed if {*row.named, *row.set_aside} & set(_structures_of(row))]
        most = [row for row in right if (row.excess_removed or 0.0) >= 0.6]
        lines.append(
            f"family removed: structure on the right axis and variable in {len(right)} of "
            f"{len(removed)}, set aside in "
            f"{sum(not set(row.named) & set(_structures_of(row)) for row in right)} of these; "
            f"60 % of the excess removed in {len(most)}"
        )
    smalls = [row for row in rows if row.part == "small"]
    if smalls:
        named = sum(
            bool(row.named) and row.true[0] in (*row.named[:1], *row.ambiguity) for row in smalls
        )
        silent = sum(not row.named for row in smalls)
        lines.append(
            f"0.4 of the size: {named} of {len(smalls)} named or in the ambiguity set, "
            f"{silent} silent"
        )
    return tuple(lines)


def _structures_of(row: Row) -> tuple[str, ...]:
    """Names that the removed effect may be given."""
    family, axis = row.true[0].split(" on ")
    return tuple(f"{variable} on {axis}" for variable in VARIABLES[family])


def table(rows: Iterable[Row]) -> str:
    """For docs/evidence/effects-study.md."""
    lines = [
        "| part | effects | named | error before % | after % | clean % | worst gain before % | "
        "after % |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        if row.floor_percent is None:
            floor = ""
        else:
            floor = f"{row.floor_percent:.2f}"
        lines.append(
            f"| {row.part} | {', '.join(row.true) or 'clean'} | {', '.join(row.named) or '–'} | "
            f"{row.error_before_percent:.2f} | {row.error_after_percent:.2f} | {floor} | "
            f"{row.max_gain_error_before_percent:.2f} | {row.max_gain_error_percent:.2f} |"
        )
    return "\n".join(lines)


def _print_line(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main(arguments: list[str] | None = None) -> int:
    """Make the study and print its tables."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.effects_study", description=__doc__
    )
    names = [part for part, _ in PARTS]
    parser.add_argument("--world", nargs="+", choices=WORLDS, default=["measurement"])
    parser.add_argument("--only", nargs="+", choices=names, default=names)
    parser.add_argument("--cases", nargs="+", default=[], help="these alone, as clean-03")
    parser.add_argument(
        "--blind", type=int, metavar="SEED", help="draw the cells from a seed instead"
    )
    parser.add_argument("--count", type=int, default=20, help="of the blind cells")
    parser.add_argument(
        "--shard", type=shard, default=Shard(), help="i/n: every n-th case from the i-th on"
    )
    parser.add_argument("--duration", type=float, default=DURATION_S, help="of each run [s]")
    parser.add_argument(
        "--kept", action="store_true", help="simulate and search nothing: report what is there"
    )
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args(arguments)
    blind = options.blind is not None
    for world in options.world:
        chosen: Cases = tuple(
            (part, case) for part, cases in PARTS if part in options.only for case in cases
        )
        if blind:
            chosen = tuple(("blind", case) for case in blind_cases(options.blind, options.count))
        chosen = tuple(
            pair for pair in chosen if not options.cases or pair[1].name in options.cases
        )
        rows = study(
            chosen,
            world,
            out=options.out,
            part=options.shard,
            processes=options.processes,
            kept=options.kept,
            duration_s=options.duration,
        )
        name = f"blind-{options.blind}-{world}" if blind else world
        if options.duration == DURATION_S:
            name += ""
        else:
            name += f"-{options.duration:g}s"
        report = options.out / f"{name}.json"
        text = json.dumps({"rows": [asdict(row) for row in rows]}, indent=1)
        content = text.encode()
        replace_file(report, content)
        if blind:
            cells = [(row.true, row.named) for row in rows]
            shown = confusion(cells)
        else:
            shown = table(rows)
        path = report.with_suffix(".csv")
        replace_file(path, as_csv(shown).encode())
        for line in (
            f"\n{name}: {len(rows)} of {len(chosen)} searched\n",
            table(rows),
            "",
            shown if blind else "",
        ):
            _print_line(line)
        for line in verdicts(rows):
            _print_line(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
