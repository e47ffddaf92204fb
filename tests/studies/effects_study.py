"""Which effects are named, how far the error falls, and what happens to the gains: cells with undeclared effects.

Run by `make effects-study`; simulates what is missing (effect_runs.py), writes out/effects-study.json, and prints the
tables of docs/evidence/effects-study.md. `--only single clean` takes these parts alone, from what was simulated before.

A row is scored with what no search has seen: the two runs that were held out, and the truth of the cell.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.config.cell import model_of
from daq.config.cell_file import load_cell
from drivers.simulation.spec import UndeclaredEffect
from ident.discovery.loop import Evidence, find_effects, gather
from ident.effects.dictionary import EFFECTS
from ident.effects.effect import PlacedEffect, Side
from ident.estimators.identify import identify
from tests.studies.coverage_runs import CELL
from tests.studies.data_file import as_csv
from tests.studies.effect_cells import APART, CLEAN, SINGLES, SMALLS, TOGETHER, EffectCase
from tests.studies.effect_runs import OUT, load_runs, make_runs
from tests.studies.side_by_side import side_by_side
from tests.studies.study_cells import study_cell

FloatArray = NDArray[np.float64]

REPORT = Path("out/effects-study.json")
VARIABLES = {
    "asymmetric-viscous": ("smooth-velocity",),
    "load-friction": ("smooth-load",),
    "warm-up": ("smooth-time", "smooth-session"),
    "spring": ("smooth-position",),
    "position-friction": ("smooth-position",),
    "cogging": ("periodic-motor-angle",),
}
"""Families that the dictionary is made to lack, and what their residual is a function of.

Stribeck and non-linear viscous friction are not among them: each explains the other (their ambiguity says so)."""
REMOVED = tuple(case for case in SINGLES if case.effects[0].name in VARIABLES)
SAME = {"spring": ("hinge", "gravity-compensator")}
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
PARTS: tuple[tuple[str, tuple[EffectCase, ...]], ...] = (
    ("single", SINGLES),
    ("clean", CLEAN),
    ("small", SMALLS),
    ("apart", APART),
    ("together", TOGETHER),
    ("removed", REMOVED),
)


@dataclass(frozen=True, slots=True)
class Row:
    """One cell.

    Attributes:
        part: of the study.
        case: its name.
        true: effects of the plant, as `family on J3`.
        named: effects that the search accepted, in its order.
        ambiguity: of the first one.
        error_before_percent, error_after_percent: on the held-out runs, of the first true effect's axis; of the whole
            for a clean cell.
        floor_percent: the same error of the same seed's clean cell, None where that was not simulated.
        max_gain_error_percent: after, of the worst gain.
        excess_removed: share of the excess over the floor, squared, that went; None without a floor.
        limit_nm: what would have been found on that axis at the end.
        processor_s: of identification and search.
    """

    part: str
    case: str
    true: tuple[str, ...]
    named: tuple[str, ...]
    ambiguity: tuple[str, ...]
    error_before_percent: float
    error_after_percent: float
    floor_percent: float | None
    max_gain_error_before_percent: float
    max_gain_error_percent: float
    excess_removed: float | None
    limit_nm: float
    processor_s: float


@dataclass(frozen=True, slots=True)
class _Task:
    part: str
    case: EffectCase
    out: Path


def study(parts: Iterable[str], out: Path, processes: int, *, simulate: bool) -> tuple[Row, ...]:
    """Search the cells of some parts.

    Raises:
        TaskFailed: simulating or searching failed.
    """
    chosen = [(part, case) for part, cases in PARTS if part in parts for case in cases]
    if simulate:
        make_runs(
            {case.name: case for _, case in chosen}.values(), out=out, processes=processes, report_line=_print_line
        )
    rows = []
    for row in side_by_side(_search, [_Task(part, case, out) for part, case in chosen], processes):
        rows.append(row)
        named = ", ".join(row.named) or "nothing"
        _print_line(
            f"{row.part} {row.case}: {named}; {row.error_before_percent:.2f} -> {row.error_after_percent:.2f} %, "
            f"worst gain {row.max_gain_error_percent:.2f} %, {row.processor_s:.0f} s"
        )
    return tuple(rows)


def _search(task: _Task) -> Row:
    case = task.case
    cell = load_cell(CELL)
    runs = load_runs(case, task.out)
    lacking = case.effects[0].name if task.part == "removed" else ""
    removed = (lacking, *SAME.get(lacking, ()))
    families = tuple(family for family in EFFECTS if family[0].name not in removed)
    begun_s = time.process_time()
    found = identify(model_of(cell), runs.fit, cell.conditioning)
    start = gather(found, runs.fit, runs.held_out)
    steps = find_effects(start, np.random.default_rng(0), families=families)
    spent_s = time.process_time() - begun_s
    truth = np.array([axis.gain_nm_per_a for axis in study_cell(case.seed).bare.axes])
    end = steps[-1].after
    axis = case.effects[0].axis if case.effects else None
    before, after = (_holdout(evidence, axis) for evidence in (start, end))
    floor = _floor(case, task.out, axis)
    accepted = tuple(step.accepted for step in steps if step.accepted is not None)
    excess = None if floor is None else max(before**2 - floor**2, 1e-9)
    return Row(
        part=task.part,
        case=case.name,
        true=tuple(_true(effect) for effect in case.effects),
        named=tuple(_placed(placed) for placed in end.effects),
        ambiguity=() if not accepted else tuple(_placed(rival) for rival in accepted[0].ambiguity),
        error_before_percent=before,
        error_after_percent=after,
        floor_percent=floor,
        max_gain_error_before_percent=_worst(start, truth),
        max_gain_error_percent=_worst(end, truth),
        excess_removed=None if excess is None else (before**2 - after**2) / excess,
        limit_nm=float(steps[-1].limits_nm[axis or 0]),
        processor_s=spent_s,
    )


def _holdout(evidence: Evidence, axis: int | None) -> float:
    error = evidence.holdout_error
    if error is None:
        raise ValueError("every case of the study holds two runs out")
    return error.total if axis is None else error.axes[axis]


def _floor(case: EffectCase, out: Path, axis: int | None) -> float | None:
    """The error of the same seed's cell without any effect."""
    clean = next((other for other in CLEAN if other.seed == case.seed), None)
    if axis is None or clean is None or not (out / f"{clean.name}.npz").is_file():
        return None
    cell, runs = load_cell(CELL), load_runs(clean, out)
    return _holdout(gather(identify(model_of(cell), runs.fit, cell.conditioning), runs.fit, runs.held_out), axis)


def _worst(evidence: Evidence, truth: FloatArray) -> float:
    return float(100.0 * np.max(np.abs(evidence.estimate.gains / truth - 1.0)))


def _true(effect: UndeclaredEffect) -> str:
    axes = sorted({effect.axis + 1, int(effect.parameters.get("other_axis", effect.axis + 1))})
    return f"{effect.name} on {'+'.join(f'J{axis}' for axis in axes)}"


def _placed(placed: PlacedEffect) -> str:
    axes = sorted({placed.axis + 1, int(placed.effect.settings.get("other_axis", 0)) or placed.axis + 1})
    axes = axes if placed.effect.side is Side.TWO_JOINTS else [placed.axis + 1]
    return f"{placed.effect.name} on {'+'.join(f'J{axis}' for axis in axes)}"


def verdicts(rows: Sequence[Row]) -> tuple[str, ...]:
    """The study's figures, a line each."""
    lines = []
    single = [row for row in rows if row.part == "single"]
    if single:
        first = [row for row in single if row.named[:1] == row.true]
        known = [row for row in single if row.true[0] in (*row.named[:1], *row.ambiguity) and row.named]
        friction = [row for row in single if row.true[0].split()[0] in FRICTION and row.floor_percent is not None]
        near = [row for row in friction if row.error_after_percent <= (row.floor_percent or 0.0) + 0.3]
        small = [row for row in single if row.max_gain_error_percent <= (4.0 if "saturation" in row.case else 1.5)]
        lines += [
            f"one effect: {len(first)} of {len(single)} named first, {len(known)} named or in the ambiguity set",
            f"friction: {len(near)} of {len(friction)} within 0.3 points of their clean floor",
            f"processor time with one effect: median {np.median([row.processor_s for row in single]):.0f} s, "
            f"most {max(row.processor_s for row in single):.0f} s",
            f"gains: {len(small)} of {len(single)} within 1.5 % (saturation 4 %)",
        ]
    clean = [row for row in rows if row.part == "clean"]
    if clean:
        error, gain = (
            np.mean([row.error_before_percent for row in clean]),
            max(row.max_gain_error_percent for row in clean),
        )
        lines.append(
            f"clean: {sum(bool(row.named) for row in clean)} of {len(clean)} with a false effect; "
            f"error {error:.2f} % in the mean, worst gain {gain:.2f} %"
        )
    for part in ("apart", "together"):
        both = [row for row in rows if row.part == part]
        if both:
            hit = sum(set(row.true) <= set(row.named) for row in both)
            lines.append(f"two effects {part}: both named in {hit} of {len(both)}")
    removed = [row for row in rows if row.part == "removed"]
    if removed:
        right = [row for row in removed if _is_structure_of(row)]
        most = [row for row in right if (row.excess_removed or 0.0) >= 0.6]
        lines.append(
            f"family removed: structure on the right axis and variable in {len(right)} of {len(removed)}, "
            f"60 % of the excess removed in {len(most)}"
        )
    smalls = [row for row in rows if row.part == "small"]
    if smalls:
        named = sum(bool(row.named) and row.true[0] in (*row.named[:1], *row.ambiguity) for row in smalls)
        silent = sum(not row.named for row in smalls)
        lines.append(f"0.4 of the size: {named} of {len(smalls)} named or in the ambiguity set, {silent} silent")
    return tuple(lines)


def _is_structure_of(row: Row) -> bool:
    family, axis = row.true[0].split(" on ")
    return any(f"{variable} on {axis}" in row.named for variable in VARIABLES[family])


def table(rows: Iterable[Row]) -> str:
    """For docs/evidence/effects-study.md."""
    lines = [
        "| part | effects | named | error before % | after % | clean % | worst gain before % | after % |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        floor = "" if row.floor_percent is None else f"{row.floor_percent:.2f}"
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
    parser = argparse.ArgumentParser(prog="python -m tests.studies.effects_study", description=__doc__)
    names = [part for part, _ in PARTS]
    parser.add_argument("--only", nargs="+", choices=names, default=names)
    parser.add_argument("--kept", action="store_true", help="simulate nothing: take what is there")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args(arguments)
    rows = study(options.only, options.out, options.processes, simulate=not options.kept)
    REPORT.parent.mkdir(parents=True, exist_ok=True)
    kept = (
        []
        if not REPORT.is_file()
        else [row for row in json.loads(REPORT.read_text())["rows"] if row["part"] not in options.only]
    )
    REPORT.write_text(json.dumps({"rows": [*kept, *(asdict(row) for row in rows)]}, indent=1) + "\n")
    _print_line(table(rows))
    REPORT.with_suffix(".csv").write_text(as_csv(table(rows)), encoding="utf-8")
    for line in verdicts(rows):
        _print_line(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
