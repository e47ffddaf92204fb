"""Cables and hoses over two joints: where they begin to pull and how they are led,
and what is no such cable.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.data.dataset import Dataset
from ident.discovery.cables import propose_cables
from ident.discovery.evidence import Evidence
from ident.discovery.gates import Gates
from ident.discovery.loop import find_effects
from ident.discovery.search import rank_effects
from ident.effects.dictionary import EFFECTS
from ident.effects.effect import PlacedEffect, is_placeable
from ident.effects.position import Cable, Compensator, Hinge, SlackCable, Spring
from tests.ident.recordings import (
    MOUNTED,
    Truth,
    bent,
    gathered,
    record,
    search_problem_of,
    three_axes_truth,
)

pytestmark = pytest.mark.slow

FloatArray = NDArray[np.float64]
GATES = Gates(draws=199)
OF_POSITION = tuple(
    family
    for family in EFFECTS
    if isinstance(family[0], Spring | Hinge | Compensator | Cable | SlackCable)
)
STIFFNESS = 30.0
RADII = (0.8, -0.6)
"""At which a cable is led around the second and the third joint; together a unit vector."""


def _cabled(
    small: Evidence, truth: Truth, *, radii: tuple[float, float], start_rad: float
) -> Evidence:
    """The arm with a cable along the second and the third joint,
    as a force that a cable has along its way.
    """

    def torque(data: Dataset) -> FloatArray:
        way = data.position_rad[:, 1:] @ np.array(radii)
        slack_taken_rad = np.clip(way - start_rad, 0.0, None)
        force = STIFFNESS * slack_taken_rad
        return np.stack((np.zeros_like(force), radii[0] * force, radii[1] * force))

    return bent(small, truth, torque)


def _found(start: Evidence) -> tuple[tuple[PlacedEffect, ...], Evidence]:
    rng = np.random.default_rng(0)
    effects = find_effects(start, rng, GATES, OF_POSITION, geometry=())
    last = effects[-1].after
    return last.effects, last


def _coefficients(found: Evidence) -> FloatArray:
    first = len(found.rows_without_effects.columns)
    (placed,) = found.effects
    return found.estimate.parameters[first : first + len(placed.columns)]


@pytest.mark.parametrize(("radii", "start_rad"), [(RADII, 0.3), ((-0.28, 0.96), 0.1)])
def test_a_slack_cable_is_named_with_its_start_and_its_radii(
    small: Evidence, small_truth: Truth, radii: tuple[float, float], start_rad: float
) -> None:
    (placed,), after = _found(_cabled(small, small_truth, radii=radii, start_rad=start_rad))
    effect = placed.effect
    assert isinstance(effect, SlackCable)
    assert placed.axis == 1
    assert effect.other_axis == 3
    direction_rad = np.arctan2(radii[1], radii[0])
    direction_difference_rad = effect.direction_rad - direction_rad
    turn_rad = np.angle(np.exp(1j * direction_difference_rad))
    assert abs(turn_rad) < 0.1
    assert effect.start_rad == pytest.approx(start_rad, abs=0.1)
    assert _coefficients(after) == pytest.approx(STIFFNESS, rel=0.15)
    gain_difference = after.estimate.gains - small_truth.gains
    z = gain_difference / after.estimate.gains_std
    assert np.abs(z).max() < 3.0


def test_a_hose_that_pushes_too_is_a_cable_with_one_potential(
    small: Evidence, small_truth: Truth
) -> None:
    (placed,), after = _found(_cabled(small, small_truth, radii=RADII, start_rad=-100.0))
    expected = PlacedEffect(Cable(3), 1)
    assert placed == expected
    stiffness = STIFFNESS * np.outer(RADII, RADII)
    assert _coefficients(after) == pytest.approx(stiffness[np.triu_indices(2)], rel=0.15, abs=1.0)


def test_a_spring_of_one_joint_stays_one(small: Evidence, small_truth: Truth) -> None:
    effects, _ = _found(_cabled(small, small_truth, radii=(1.0, 0.0), start_rad=-100.0))
    expected = (PlacedEffect(Spring(), 1),)
    assert effects == expected


def test_a_hinge_of_one_joint_stays_one(small: Evidence, small_truth: Truth) -> None:
    (placed,), _ = _found(_cabled(small, small_truth, radii=(1.0, 0.0), start_rad=0.2))
    assert isinstance(placed.effect, Hinge)
    assert placed.axis == 1
    assert placed.effect.start_rad == pytest.approx(0.2, abs=0.1)


def test_nothing_is_proposed_where_no_cable_is(small: Evidence) -> None:
    assert propose_cables(search_problem_of(small), GATES, EFFECTS) == {}
    assert _found(small)[0] == ()


def test_no_cable_is_tried_in_few_moves(small_truth: Truth) -> None:
    """A shape with many settings fits the few moves."""
    rng = np.random.default_rng(4)
    runs = tuple(
        record(small_truth, f"run{index}", rng, MOUNTED if index % 2 else None, seconds=8.0)
        for index in range(4)
    )
    start = _cabled(gathered(small_truth, runs), small_truth, radii=RADII, start_rad=0.3)
    problem = search_problem_of(start)
    least_moves = SlackCable(3, 0.5).least_moves
    assert problem.folds.moves < least_moves
    assert propose_cables(problem, GATES, OF_POSITION) == {}
    names = {
        finding.effect.name
        for finding in rank_effects(problem, np.random.default_rng(0), GATES, OF_POSITION)
    }
    assert names == {"spring", "hinge", "gravity-compensator"}


def test_a_cable_is_led_along_neighbouring_joints() -> None:
    robot = three_axes_truth().model.robot
    joints = robot.joints * 2
    six = replace(robot, joints=joints)
    reached = [other for other in range(2, 7) if is_placeable(Cable(other), 0, six)]
    assert reached == [2, 3]
