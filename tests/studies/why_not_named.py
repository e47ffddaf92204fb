"""Why a search does not write the effect of a cell of the effects study: what each gate says.

    python -m tests.studies.why_not_named --world loop3 single-13-backlash-J2
    python -m tests.studies.why_not_named --blind 61129 blind-61129-11

The runs are those of `tests.studies.effects_study`, which simulates what is missing. Prints, for
each turn of the search, what a later gate set aside, and the candidates on the axes of the true
effects with what refuses them.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

from daq.config.cell_file import load_cell
from ident.discovery.loop import Step
from ident.discovery.search import Finding
from tests.studies.blind_cells import blind_cases
from tests.studies.effect_cells import SINGLES
from tests.studies.effect_runs import CaseTask, load_runs, make_case
from tests.studies.effects_study import OUT, search_runs
from tests.studies.study_cells import WORLDS
from tests.studies.study_plans import CELL

SHOWN = 6  #: Candidates of a turn on an axis


def turn_text(step: Step, axes: frozenset[int], names: tuple[str, ...]) -> Iterator[str]:
    """What one turn of the search says of some axes."""
    accepted = "nothing"
    if step.accepted is not None:
        accepted = step.accepted.placed.name_among(names)
    yield f"joined: {accepted}"
    for rejected in step.set_aside:
        yield f"set aside: {rejected.finding.placed.name_among(names)}: {rejected.reason(names)}"
    for axis in sorted(axes):
        of_axis = [finding for finding in step.findings if finding.axis == axis]
        for finding in of_axis[:SHOWN]:
            yield _candidate_text(finding, names)


def _candidate_text(finding: Finding, names: tuple[str, ...]) -> str:
    probability = "too few moves to test"
    if finding.probability is not None:
        probability = f"p = {finding.probability:.3f}"
    refusals = "; ".join(finding.refusals) or "passes"
    return (
        f"{finding.placed.name_among(names)}: explains {100.0 * finding.explained:.1f} %, left-out "
        f"error {finding.error_before_percent:.2f} to {finding.error_after_percent:.2f} %, "
        f"{probability}: {refusals}"
    )


def main(arguments: list[str] | None = None) -> int:
    """Search one case and print what the gates say."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.why_not_named", description=__doc__
    )
    parser.add_argument("case")
    parser.add_argument("--world", choices=WORLDS, default="measurement")
    parser.add_argument("--blind", type=int, metavar="SEED", help="a cell drawn from this seed")
    parser.add_argument("--count", type=int, default=20, help="of the cells drawn")
    parser.add_argument("--out", type=Path, default=OUT)
    chosen = parser.parse_args(arguments)
    drawn = SINGLES
    if chosen.blind is not None:
        drawn = blind_cases(chosen.blind, chosen.count)
    cases = {case.name: case for case in drawn}
    if chosen.case not in cases:
        parser.error(f"{chosen.case} is no case; expected one of {', '.join(cases)}")
    case = cases[chosen.case]
    axes = frozenset(effect.axis for effect in case.effects)
    task = CaseTask(chosen.out, chosen.world, case)
    make_case(task)
    cell = load_cell(CELL)
    _, steps = search_runs(cell, load_runs(task, imported=False))
    for number, step in enumerate(steps, start=1):
        for line in turn_text(step, axes, cell.axis_names):
            sys.stdout.write(f"turn {number}: {line}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
