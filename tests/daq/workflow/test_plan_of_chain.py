"""Plans of a redundant drive: the planner's own show every gain, and a small workspace is refused with the reason."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.errors import UsageError
from daq.report.plan import plan_document, plan_text
from daq.workflow.experiment import RUNS, Experiment, experiment_of, paths_of
from daq.workflow.plan import Plan, plan
from ident.planning.verdict import Hidden, verdicts

SECONDS = 12.0


@pytest.fixture(scope="module")
def cell() -> Cell:
    """Four motors, three degrees of freedom."""
    return load_cell(shipped_configurations() / "cells" / "dualv.yaml")


@pytest.fixture(scope="module")
def experiment(cell: Cell) -> Experiment:
    """With its payload."""
    return experiment_of(cell)


def test_the_payload_is_expected_at_the_platform() -> None:
    five_bar = load_cell(shipped_configurations() / "cells" / "five-bar.yaml")
    expected = experiment_of(five_bar)
    (payload,) = expected.design.expectation.payloads
    centre = payload.parameters[6:9] / payload.parameters[9]
    # The plate is at the end of the rod, 0.45 m from the joint that moves it.
    assert centre == pytest.approx([0.45, 0.0, 0.0], abs=0.15)
    (body,) = (capsule for capsule in expected.scene.checker.scene.capsules if capsule.name == "payload")
    assert body.start_m == pytest.approx((0.45, 0.0, 0.0), abs=0.15)


@pytest.fixture(scope="module")
def made(cell: Cell, experiment: Experiment) -> Plan:
    """The planner's own plan."""
    return plan(cell, seed=4, duration_s=SECONDS, exchanges=16, experiment=experiment)


def test_the_planners_own_plan_shows_every_gain(cell: Cell, experiment: Experiment, made: Plan) -> None:
    judged = verdicts(experiment.design, [(experiment.excitation(paths_of(cell, made.moves))[0], RUNS)])
    assert judged.rank == judged.known_preload_rank == 4
    assert not judged.sentences(cell.axis_names)
    lower, upper = np.array([axis.limits.position for axis in cell.axes]).T
    targets = np.array([move.target_rad for move in made.moves])
    assert ((targets >= lower) & (targets <= upper)).all()
    text = plan_text(Path("plan.yaml"), None, cell, experiment, made, judged)
    assert "Internal preload obscures no gain: these moves determine 4 of 4 independent directions" in text


def test_the_same_moves_around_one_pose_hide_gains(cell: Cell, experiment: Experiment, made: Plan) -> None:
    checker = experiment.scene.checker
    near = [checker.fitting(checker.home + 0.3 * (np.array(m.target_rad) - checker.home)) for m in made.moves]
    moves = tuple(replace(m, target_rad=tuple(t.tolist())) for m, t in zip(made.moves, near, strict=True))
    judged = verdicts(experiment.design, [(experiment.excitation(paths_of(cell, moves))[0], RUNS)])
    hidden = judged.hidden(Hidden.PRELOAD)
    assert hidden
    assert judged.known_preload_rank is not None
    assert judged.rank < judged.known_preload_rank
    named = [cell.axis_names[axis] for axis in hidden]
    text = plan_text(Path("plan.yaml"), None, cell, experiment, replace(made, moves=moves), judged)
    (line,) = (line for line in text.splitlines() if line.startswith("Internal preload obscures"))
    assert [name for name in cell.axis_names if name in line] == named
    document = plan_document(Path("plan.yaml"), cell, experiment, made, judged)
    gains = document["gains"]
    assert isinstance(gains, list)
    assert [gain["axis"] for gain in gains if gain["hidden_by"] == "preload"] == named
    assert all(gain["known_preload_std_percent"] < gain["predicted_std_percent"] for gain in gains)


def test_a_workspace_too_small_for_the_gains_is_refused_with_the_reason(cell: Cell, experiment: Experiment) -> None:
    low, high = np.radians(-2.0), np.radians(2.0)
    axes = tuple(replace(axis, limits=replace(axis.limits, position=(low, high))) for axis in cell.axes)
    tight = replace(cell, axes=axes)
    with pytest.raises(UsageError, match="Internal preload obscures the gains of"):
        plan(tight, seed=1, duration_s=SECONDS, exchanges=0, experiment=replace(experiment, cell=tight))
