"""Plans of a redundant drive: the planner's own show every gain,
and a small workspace is refused with the reason.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.errors import UsageError
from daq.report.plan import plan_report, plan_text
from daq.report.plan_preview import preview_page
from daq.workflow.experiment import RUNS, Experiment, experiment_of, paths_of
from daq.workflow.plan import Plan, plan
from ident.planning.gain_verdict import Hidden, verdicts

pytestmark = pytest.mark.slow

SECONDS = 9.0


@pytest.fixture(scope="module")
def dualv_cell() -> Cell:
    """Four motors, three degrees of freedom."""
    path = shipped_configurations() / "cells" / "dualv.yaml"
    return load_cell(path)


@pytest.fixture(scope="module")
def experiment(dualv_cell: Cell) -> Experiment:
    """With its payload."""
    return experiment_of(dualv_cell)


def test_the_payload_is_expected_at_the_platform() -> None:
    path = shipped_configurations() / "cells" / "five-bar.yaml"
    five_bar = load_cell(path)
    expected = experiment_of(five_bar)
    (payload,) = expected.design.expectation.payloads
    centre = payload.parameters[6:9] / payload.parameters[9]
    # The plate is at the end of the rod, 0.45 m from the joint that moves it.
    assert centre == pytest.approx([0.45, 0.0, 0.0], abs=0.15)
    capsules = expected.scene.checker.scene.capsules
    (body,) = (capsule for capsule in capsules if capsule.name == "payload")
    assert body.start_m == pytest.approx((0.45, 0.0, 0.0), abs=0.15)


@pytest.fixture(scope="module")
def searched(dualv_cell: Cell, experiment: Experiment) -> tuple[Plan, list[tuple[int, float]]]:
    """The planner's own plan, and what it reported: exchanges so far and σ of the worst gain."""
    return _searched(dualv_cell, experiment, 16)


@pytest.fixture(scope="module")
def made(searched: tuple[Plan, list[tuple[int, float]]]) -> Plan:
    """The planner's own plan."""
    return searched[0]


def _searched(
    cell: Cell, experiment: Experiment, exchanges: int
) -> tuple[Plan, list[tuple[int, float]]]:
    reports = list[tuple[int, float]]()

    def note(done: int, worst: float) -> None:
        reports.append((done, worst))

    made = plan(
        cell, seed=4, duration_s=SECONDS, exchanges=exchanges, experiment=experiment, progress=note
    )
    return made, reports


def test_the_planners_own_plan_shows_every_gain(
    dualv_cell: Cell, experiment: Experiment, made: Plan
) -> None:
    paths = paths_of(dualv_cell, made.moves)
    runs = [(experiment.excitation(paths)[0], RUNS)]
    judged = verdicts(experiment.design, runs)
    assert judged.rank == judged.known_preload_rank == 4
    assert not judged.sentences(dualv_cell.axis_names)
    positions = [axis.limits.position for axis in dualv_cell.axes]
    lower, upper = np.array(positions).T
    target_rad = [move.target_rad for move in made.moves]
    targets = np.array(target_rad)
    assert ((targets >= lower) & (targets <= upper)).all()
    text = plan_text(Path("plan.yaml"), None, dualv_cell, experiment, made, judged, SECONDS)
    assert (
        "Internal preload obscures no gain: these moves determine 4 of 4 independent directions"
    ) in text
    assert "\nAssumed:\n  payload: disc, 8.2 kg\n" in text
    lines = text.partition("Assumed:")[2].splitlines()
    largest_line_count = max(len(line) for line in lines[:7])
    assert largest_line_count < 110
    page = preview_page(dualv_cell, made.moves, experiment.scene.checker, b"plan")
    assert "The shape of the arm is unknown: links of a closed chain are not guessed" in page


def test_a_weak_gain_is_told_how_to_become_good(
    dualv_cell: Cell, experiment: Experiment, made: Plan
) -> None:
    """σ falls with the square root of the time: the same moves made so many times over are good."""
    paths = paths_of(dualv_cell, made.moves)
    excitation = experiment.excitation(paths)[0]
    runs = [(excitation, RUNS)]
    judged = verdicts(experiment.design, runs)
    worst = max(gain.std_percent for gain in judged.gains)
    assert worst > 1.0
    text = plan_text(Path("plan.yaml"), None, dualv_cell, experiment, made, judged, SECONDS)
    (line,) = (line for line in text.splitlines() if line.startswith("For good gains (1 %)"))
    seconds = float(line.partition("--duration ")[2].partition(")")[0])
    assert "a heavier payload" in line
    repeated = verdicts(
        experiment.design, [(excitation, RUNS)] * int(np.ceil(seconds / made.duration_s))
    )
    largest_std_percent = max(gain.std_percent for gain in repeated.gains)
    assert largest_std_percent <= 1.0
    good = replace(judged, gains=repeated.gains)
    assert "For good gains" not in plan_text(
        Path("plan.yaml"), None, dualv_cell, experiment, made, good, SECONDS
    )


def test_the_assembly_pose_that_was_found_is_shown(tmp_path: Path) -> None:
    """Bent elbows, declared roughly: the pose shown is the one that closes the loop."""
    five_bar_path = shipped_configurations() / "cells" / "five-bar.yaml"
    text = five_bar_path.read_text(encoding="utf-8")
    text = text.replace("../", f"{shipped_configurations()}/")
    text = text.replace("crank-1: 0, elbow-1: 0, crank-2: 0, elbow-2: 0", "elbow-1: 3, elbow-2: 4")
    (tmp_path / "cell.yaml").write_text(text, encoding="utf-8")
    five_bar = load_cell(tmp_path / "cell.yaml")
    experiment = experiment_of(five_bar)
    made = plan(five_bar, seed=1, duration_s=SECONDS, exchanges=0, experiment=experiment)
    paths = paths_of(five_bar, made.moves)
    runs = [(experiment.excitation(paths)[0], RUNS)]
    judged = verdicts(experiment.design, runs)
    text = plan_text(Path("plan.yaml"), None, five_bar, experiment, made, judged, SECONDS)
    (line,) = (line for line in text.splitlines() if line.startswith("Assembly pose"))
    assert line == (
        "Assembly pose, to compare with the robot: elbow-1 0 deg, elbow-2 0 deg while the motors' "
        "joints are at crank-1 0 deg, crank-2 0 deg."
    )


def test_an_interrupted_search_is_repeated_by_its_number_of_exchanges(
    dualv_cell: Cell, experiment: Experiment, searched: tuple[Plan, list[tuple[int, float]]]
) -> None:
    """What `plan` says when it is interrupted:
    the first exchanges do not depend on how many are to come.
    """
    longer = searched[1]
    assert [done for done, _ in longer] == [8, 16]
    expected = _searched(dualv_cell, experiment, 8)[1]
    assert longer[:1] == expected


def test_the_same_moves_around_one_pose_hide_gains(
    dualv_cell: Cell, experiment: Experiment, made: Plan
) -> None:
    checker = experiment.scene.checker
    near = [
        checker.fitting(checker.home + 0.3 * (np.array(m.target_rad) - checker.home))
        for m in made.moves
    ]
    moves = tuple(
        replace(m, target_rad=tuple(t.tolist())) for m, t in zip(made.moves, near, strict=True)
    )
    paths = paths_of(dualv_cell, moves)
    runs = [(experiment.excitation(paths)[0], RUNS)]
    judged = verdicts(experiment.design, runs)
    hidden = judged.hidden(Hidden.PRELOAD)
    assert hidden
    assert judged.known_preload_rank is not None
    assert judged.rank < judged.known_preload_rank
    named = [dualv_cell.axis_names[axis] for axis in hidden]
    changed_made = replace(made, moves=moves)
    text = plan_text(Path("plan.yaml"), None, dualv_cell, experiment, changed_made, judged, SECONDS)
    (line,) = (line for line in text.splitlines() if line.startswith("Internal preload obscures"))
    assert [name for name in dualv_cell.axis_names if name in line] == named
    report = plan_report(Path("plan.yaml"), dualv_cell, experiment, made, judged)
    gains = report.gains
    assert [gain.axis for gain in gains if gain.hidden_by == "preload"] == named
    for gain in gains:
        assert gain.known_preload_std_percent is not None and gain.predicted_std_percent is not None
        assert gain.known_preload_std_percent < gain.predicted_std_percent


def test_a_workspace_too_small_for_the_gains_is_refused_with_the_reason(
    dualv_cell: Cell, experiment: Experiment
) -> None:
    low = np.radians(-2.0)
    high = np.radians(2.0)
    axes = tuple(
        replace(axis, limits=replace(axis.limits, position=(low, high))) for axis in dualv_cell.axes
    )
    tight = replace(dualv_cell, axes=axes)
    changed_experiment = replace(experiment, cell=tight)
    with pytest.raises(UsageError, match="Internal preload obscures the gains of"):
        plan(
            tight,
            seed=1,
            duration_s=SECONDS,
            exchanges=0,
            experiment=changed_experiment,
        )
