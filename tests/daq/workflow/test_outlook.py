"""The next block: for the gain that is worst,
inside the room and the speed of what was accepted.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import chain, pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from daq.config.cell import DEGREE
from daq.config.cell_file import load_cell
from daq.config.workspace import Clearance
from daq.report.plan_preview import preview_page
from daq.workflow.accepted_room import SLACK_M, AcceptedRoom, accepted_room, extent, placed
from daq.workflow.experiment import Experiment, experiment_of, limits_of, paths_of
from daq.workflow.outlook import ADVICE_OF_CAUSE, Outlook, help_with
from daq.workflow.plan import Plan, TargetBox, load_plan, plan, save_plan
from ident.planning.clearance import Box
from ident.planning.target import SlowCause

FloatArray = NDArray[np.float64]
CELLS = Path(__file__).parents[3] / "configs" / "cells"
DURATION_S = 12.0
EXCHANGES = 120
POOR = 3  #: Axis J4, which hardly moved so far
SEEDS = (1, 2, 3, 4)
ROUNDING = 10.0**-3 * DEGREE.si  #: Of a plan file


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    """The demonstration's cell with its payload."""
    path = CELLS / "demo.yaml"
    return experiment_of(load_cell(path))


def _narrow(experiment: Experiment) -> TargetBox:
    """Two thirds of each range, and less of J4."""
    lower, upper = limits_of(experiment.cell).targets()
    middle = 0.5 * (lower + upper)
    half = np.full(len(middle), 1.0 / 3.0)
    half[POOR] = 0.1
    middle_lower = middle - half * (upper - lower)
    middle_upper = middle + half * (upper - lower)
    return TargetBox(middle_lower, middle_upper)


@pytest.fixture(scope="module")
def accepted(experiment: Experiment) -> tuple[Plan, ...]:
    """Slow random moves in a part of the room, that an operator has looked at."""
    return tuple(
        plan(
            experiment.cell,
            seed=seed,
            duration_s=DURATION_S,
            exchanges=0,
            speed=0.8,
            largest_condition=np.inf,
            largest_std_percent=np.inf,
            box=_narrow(experiment),
        )
        for seed in (7, 8, 9)
    )


@pytest.fixture(scope="module")
def room(experiment: Experiment, accepted: tuple[Plan, ...]) -> AcceptedRoom:
    """The room of the accepted moves."""
    return accepted_room(experiment.cell, experiment.scene, accepted)


@pytest.fixture(scope="module")
def outlook(experiment: Experiment, accepted: tuple[Plan, ...]) -> Outlook:
    """After these moves, made without load and loaded;
    the estimate has other σ than the design predicts.
    """
    information = np.sum([_information(experiment, one, (None, 0)) for one in accepted], axis=0)
    scale = np.ones(len(experiment.cell.axes))
    scale[POOR] = 3.0
    causes = (SlowCause.TIME,) * len(scale)
    return Outlook(experiment.design, information, causes, scale)


def _information(experiment: Experiment, made: Plan, mounted: tuple[int | None, ...]) -> FloatArray:
    paths = paths_of(experiment.cell, made.moves)
    excitation, _ = experiment.excitation(paths)
    return experiment.design.information(excitation, mounted)


def _next(
    experiment: Experiment, outlook: Outlook, room: AcceptedRoom, seed: int, *, is_aimed: bool
) -> Plan:
    """The next block, loaded, in the same room."""
    return plan(
        experiment.cell,
        seed=seed,
        duration_s=DURATION_S,
        exchanges=EXCHANGES,
        speed=room.speed,
        largest_condition=np.inf,
        largest_std_percent=np.inf,
        experiment=outlook.experiment(experiment, is_loaded=True, room=room),
        goal=outlook.goal(0.5) if is_aimed else None,
        box=room.box,
    )


@pytest.fixture(scope="module")
def aimed(experiment: Experiment, outlook: Outlook, room: AcceptedRoom) -> tuple[Plan, ...]:
    """Next blocks for the worst gain."""
    return tuple(_next(experiment, outlook, room, seed, is_aimed=True) for seed in SEEDS)


@pytest.mark.slow
def test_the_worst_gain_of_the_estimate_falls_faster_than_with_moves_for_all_gains(
    experiment: Experiment, outlook: Outlook, room: AcceptedRoom, aimed: tuple[Plan, ...]
) -> None:
    before = outlook.scale * experiment.design.std_percent(outlook.information)
    assert int(np.argmax(before)) == POOR
    ratios = []
    for seed, one in zip(SEEDS, aimed, strict=True):
        other = _next(experiment, outlook, room, seed, is_aimed=False)
        with_aim = experiment.design.std_percent(
            outlook.information + _information(experiment, one, (0,))
        )
        without = experiment.design.std_percent(
            outlook.information + _information(experiment, other, (0,))
        )
        assert one.predicted_std_percent == pytest.approx(with_aim.tolist())
        ratios.append(with_aim[POOR] / without[POOR])
    assert np.mean(ratios) < 0.95
    assert max(ratios) < 1.03


@pytest.mark.slow
def test_the_next_moves_stay_inside_what_was_accepted(
    experiment: Experiment, accepted: tuple[Plan, ...], room: AcceptedRoom, aimed: tuple[Plan, ...]
) -> None:
    accepted_moves = list(chain.from_iterable(plan.moves for plan in accepted))
    target_rad = [move.target_rad for move in accepted_moves]
    lower = np.min(target_rad, axis=0)
    upper = np.max(target_rad, axis=0)
    largest_velocity = max(move.velocity for move in accepted_moves)
    largest_acceleration = max(move.acceleration for move in accepted_moves)
    assert room.reach is not None
    checker = experiment.scene.checker
    for one in aimed:
        paths = paths_of(experiment.cell, one.moves)
        position = np.concatenate(
            [path.at(np.linspace(0.0, path.duration_s, 80))[0] for path in paths]
        )
        assert (position >= lower - ROUNDING).all()
        assert (position <= upper + ROUNDING).all()
        ends_m = placed(checker, position)
        reached = extent(checker, ends_m)
        lower_difference_m = room.reach.lower_m - SLACK_M
        assert (reached.lower_m >= lower_difference_m).all()
        assert (reached.upper_m <= room.reach.upper_m + SLACK_M).all()
        for move in one.moves:
            assert move.velocity <= largest_velocity
            assert move.acceleration <= largest_acceleration


def test_a_part_that_only_turns_at_one_height_leaves_room_for_later_moves() -> None:
    """The second link of this arm touches the lower end of its reach in all postures."""
    path = CELLS / "seven-axis.yaml"
    experiment = experiment_of(load_cell(path))
    accepted = plan(
        experiment.cell,
        seed=100,
        duration_s=10.0,
        exchanges=0,
        largest_condition=np.inf,
        largest_std_percent=np.inf,
        experiment=experiment,
    )
    room = accepted_room(experiment.cell, experiment.scene, (accepted,))
    inside = room.scene(experiment.scene).checker
    target_rad = [move.target_rad for move in accepted.moves]
    targets = np.array(target_rad)
    assert (inside.margins(targets) > 0.0).all()
    assert all(inside.obstruction(start, end) is None for start, end in pairwise(targets))
    scene = room.scene(experiment.scene)
    changed_experiment = replace(experiment, scene=scene)
    later = plan(
        experiment.cell,
        seed=103,
        duration_s=10.0,
        exchanges=0,
        largest_condition=np.inf,
        largest_std_percent=np.inf,
        experiment=changed_experiment,
        box=room.box,
    )
    assert len(later.moves) >= 5


@pytest.mark.slow
def test_a_declared_workspace_is_the_room_without_a_second_one(
    experiment: Experiment, accepted: tuple[Plan, ...]
) -> None:
    lower_m = (-2.0, -2.0, -2.0)
    upper_m = (2.0, 2.0, 2.0)
    declared = Box("cell", lower_m, upper_m)
    clearance = experiment.cell.clearance or Clearance(None, 0.02, (), ())
    changed_clearance = replace(clearance, workspace=declared)
    cell = replace(experiment.cell, clearance=changed_clearance)
    scene = experiment_of(cell).scene
    found = accepted_room(cell, scene, accepted)
    assert found.reach is None
    assert found.scene(scene) is scene


@pytest.mark.slow
def test_the_plan_and_its_page_say_what_they_were_planned_for(
    experiment: Experiment, aimed: tuple[Plan, ...], tmp_path: Path
) -> None:
    purpose = 'J4: ± 1.2 % (target 0.5 %) "so far" <b>'
    path = tmp_path / "plan.yaml"
    changed_aimed = replace(aimed[0], purpose=purpose)
    save_plan(changed_aimed, path)
    loaded = load_plan(path, experiment.cell)
    assert loaded.purpose == purpose
    page = preview_page(
        experiment.cell, loaded.moves, experiment.scene.checker, path.read_bytes(), loaded.purpose
    )
    assert "Planned for J4: ± 1.2 % (target 0.5 %)" in page
    assert "<b>" not in page
    save_plan(aimed[0], path)
    assert "purpose" not in path.read_text()
    assert "Planned for" not in preview_page(
        experiment.cell, loaded.moves, experiment.scene.checker, b""
    )


@pytest.mark.parametrize("cause", SlowCause)
def test_every_cause_but_time_has_a_remedy(cause: SlowCause) -> None:
    assert set(ADVICE_OF_CAUSE) == set(SlowCause)
    assert bool(help_with(cause, "J6")) is (cause is not SlowCause.TIME)
    assert "{" not in help_with(cause, "J6")
