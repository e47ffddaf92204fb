"""Plans of closed chains: what is reached, and what a motion tells of the gains."""

from __future__ import annotations

import numpy as np
import pytest

from ident.data.dataset import differentiate
from ident.estimators.identify import identify
from ident.model.robot import Motion
from ident.planning.clearance import LARGEST_MISFIT, Capsule, Checker, Scene
from ident.planning.excitation import (
    UNSEEN_PERCENT,
    Design,
    Excitation,
    Expectation,
    ExpectedPayload,
    recorded,
    visible,
)
from tests.ident.closed_recordings import Made, axis_positions
from tests.ident.closed_recordings import recorded as made_of
from tests.ident.mechanisms import BASE_M, CRANK_M, FIVE_BAR, PLANAR, ROD_M, Mechanism

NOTHING = Scene((), (), (), None, (), 0.0)
NOISE_A = 0.02


def _design(mechanism: Mechanism, made: Made, noise_a: np.ndarray[tuple[int], np.dtype[np.float64]]) -> Design:
    parameters = made.standard
    payload = ExpectedPayload(frozenset({"m"}), made.payload)
    expectation = Expectation(made.model, mechanism.gains, parameters, (payload,), noise_a)
    data = differentiate(made.runs[0], made.model.drive_train, made.conditioning)
    every = slice(None, None, 7)
    return Design(expectation, visible(made.model, data.motion(every)))


@pytest.mark.parametrize("mechanism", [FIVE_BAR, PLANAR], ids=lambda one: one.name)
def test_the_predicted_deviation_is_that_of_a_fit(mechanism: Mechanism) -> None:
    made = made_of(mechanism, 3, seconds=18.0, noise_a=NOISE_A, preload_nm=0.0)
    fitted = identify(made.model, made.runs, made.conditioning).estimate
    design = _design(mechanism, made, fitted.axis_noise)
    information = np.zeros((design.size, design.size))
    for run, payload in zip(made.runs, (None, 0), strict=True):
        data = differentiate(run, made.model.drive_train, made.conditioning)
        information += design.information(recorded(made.model.drive_train, data, made.conditioning), (payload,))
    expected = 100.0 * fitted.gains_std / np.abs(fitted.gains)
    ratio = design.std_percent(information) / expected
    assert np.all((ratio > 0.5) & (ratio < 2.0))


def test_moves_show_every_gain_of_a_redundant_drive_and_rest_shows_none() -> None:
    made = made_of(PLANAR, 3, seconds=18.0, preload_nm=0.0)
    design = _design(PLANAR, made, np.full(4, 0.01))
    data = differentiate(made.runs[1], made.model.drive_train, made.conditioning)
    moves = recorded(made.model.drive_train, data, made.conditioning)
    still = np.repeat(data.position_rad[:1], 60, axis=0)
    rest = Excitation(Motion(still, np.zeros_like(still), np.zeros_like(still)), np.ones((4, 60), dtype=np.bool_))
    runs: tuple[int | None, ...] = (None, 0)
    assert np.all(design.std_percent(design.information(moves, runs)) < UNSEEN_PERCENT)
    assert not np.any(design.std_percent(design.information(rest, runs)) < UNSEEN_PERCENT)


def test_a_five_bar_goes_where_its_rods_reach() -> None:
    checker = Checker(FIVE_BAR.robot, NOTHING)
    far = float(np.arccos((2.0 * ROD_M - BASE_M) / (2.0 * CRANK_M)))
    home, stretched = checker.home, np.array([np.pi - far, far])
    assert checker.margins(np.array([home]))[0] == np.inf
    apart = np.array([0.1, -0.1])
    assert (checker.margins(stretched + np.array([[0.0], [1.0]]) * apart) == -np.inf).all()
    found = checker.obstruction(home, stretched)
    assert found is not None
    assert found.first == "the closures"
    assert checker.obstruction(home, home + 0.2) is None
    shares = home + np.array([[1.0], [0.5], [0.1]]) * (stretched - home)
    farthest = checker.farthest(home, shares)
    assert farthest is not None
    assert not np.array_equal(farthest, shares[0])


def test_motors_of_a_redundant_drive_are_made_to_fit() -> None:
    checker = Checker(PLANAR.robot, NOTHING)
    wanted = checker.home + np.array([0.1, -0.05, 0.02, 0.08])
    assert checker.margins(wanted[None])[0] == -np.inf
    fitting = checker.fitting(wanted)
    assert checker.margins(fitting[None])[0] == np.inf
    assert checker.fitting(fitting) == pytest.approx(fitting, abs=1e-9)
    poses = axis_positions(PLANAR, np.random.default_rng(0), 6.0)[::300]
    way = np.linspace(0.0, 1.0, 21)[:, None]
    straight = poses[0] + way * (poses[-1] - poses[0])
    misfit = np.max(np.abs(checker.fitting(straight) - straight))
    assert (checker.obstruction(poses[0], poses[-1]) is None) == (misfit < LARGEST_MISFIT)


def test_bodies_of_a_closed_chain_keep_apart() -> None:
    tip = next(index for index, joint in enumerate(FIVE_BAR.robot.joints) if joint.name == "left-rod")
    post = Capsule("post", -1, (0.0, 0.66, 0.0), (0.0, 0.66, 0.3), 0.02)
    own = Capsule("tip", tip, (ROD_M, 0.0, 0.0), (ROD_M, 0.0, 0.01), 0.02)
    scene = Scene((own, post), ((0, 1),), (), None, (), 0.01)
    checker = Checker(FIVE_BAR.robot, scene)
    found = checker.obstruction(checker.home, np.array([1.7, 1.44]))
    assert found is not None
    assert {found.first, found.second} == {"tip", "post"}
