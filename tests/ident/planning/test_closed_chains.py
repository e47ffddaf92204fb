"""Plans of closed chains: what is reached, which gains a motion shows,
and which of them internal preload hides.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.data.dataset import differentiate
from ident.equations.observation import Observation
from ident.estimators.identify import identify
from ident.model.robot import Motion
from ident.planning.clearance import LARGEST_PLANNED_MISFIT, Capsule, Checker, Scene
from ident.planning.excitation import (
    UNSEEN_PERCENT,
    Design,
    Excitation,
    Expectation,
    ExpectedPayload,
    recorded,
    visible_base,
)
from ident.planning.gain_verdict import Hidden, Identifiability, verdicts
from tests.ident.closed_recordings import Made, axis_positions
from tests.ident.closed_recordings import recorded as made_of
from tests.ident.mechanisms import BASE_M, CRANK_M, FIVE_BAR, PLANAR, ROD_M, Mechanism

NOTHING = Scene((), (), (), None, (), 0.0)
NOISE_A = 0.02


FloatArray = NDArray[np.float64]


def _design(mechanism: Mechanism, made: Made, noise_a: FloatArray) -> Design:
    parameters = made.standard
    known = frozenset({"m"})
    payload = ExpectedPayload(known, made.payload)
    expectation = Expectation(made.model, mechanism.gains, parameters, (payload,), noise_a)
    run = made.runs[0]
    data = differentiate(run, made.model.drive_train, made.conditioning)
    every = slice(None, None, 7)
    motion = data.motion(every)
    base = visible_base(made.model, motion)
    return Design(expectation, base)


@pytest.mark.slow
@pytest.mark.parametrize("mechanism", [FIVE_BAR, PLANAR], ids=lambda one: one.name)
def test_the_predicted_deviation_is_that_of_a_fit(mechanism: Mechanism) -> None:
    made = made_of(mechanism, 3, seconds=18.0, noise_a=NOISE_A, preload_nm=0.0)
    fitted = identify(made.model, made.runs, made.conditioning).estimate
    design = _design(mechanism, made, fitted.axis_noise)
    information = np.zeros((design.size, design.size))
    for run, payload in zip(made.runs, (None, 0), strict=True):
        data = differentiate(run, made.model.drive_train, made.conditioning)
        information += design.information(recorded(made.model, data, made.conditioning), (payload,))
    absolute_gain = np.abs(fitted.gains)
    expected = 100.0 * fitted.gains_std / absolute_gain
    ratio = design.std_percent(information) / expected
    assert np.all((ratio > 0.5) & (ratio < 2.0))


@pytest.mark.slow
def test_moves_show_every_gain_of_a_redundant_drive_and_rest_shows_none() -> None:
    made = made_of(PLANAR, 3, seconds=18.0, preload_nm=0.0)
    noise_a = np.full(4, 0.01)
    design = _design(PLANAR, made, noise_a)
    run = made.runs[1]
    data = differentiate(run, made.model.drive_train, made.conditioning)
    moves = recorded(made.model, data, made.conditioning)
    still = np.repeat(data.position_rad[:1], 60, axis=0)
    velocity_rad_s = np.zeros_like(still)
    acceleration_rad_s2 = np.zeros_like(still)
    motion = Motion(still, velocity_rad_s, acceleration_rad_s2)
    use = np.ones((4, 60), dtype=np.bool_)
    rest = Excitation(motion, use)
    runs: tuple[int | None, ...] = (None, 0)
    assert np.all(design.std_percent(design.information(moves, runs)) < UNSEEN_PERCENT)
    assert not np.any(design.std_percent(design.information(rest, runs)) < UNSEEN_PERCENT)
    shown = verdicts(design, [(moves, runs)])
    unmoved = verdicts(design, [(rest, runs)])
    assert not shown.sentences("ABCD")
    assert shown.rank == shown.known_preload_rank == 4
    assert unmoved.hidden(Hidden.MOTION) == (0, 1, 2, 3)
    # At rest, currents whose preload is known still give one ratio of the gains: in the null space
    # of Aᵀ they are zero.
    assert (unmoved.rank, unmoved.known_preload_rank) == (0, 1)
    assert "nor would they if internal preload were known" in unmoved.sentences("ABCD")[0]


def _judged(made: Made, design: Design) -> Identifiability:
    runs = []
    for run, payload in zip(made.runs, (None, 0), strict=True):
        data = differentiate(run, made.model.drive_train, made.conditioning)
        runs.append((recorded(made.model, data, made.conditioning), (payload,)))
    return verdicts(design, runs)


def _spread_with_known_preload(rows: Observation, noise_a: FloatArray) -> FloatArray:
    """Scatter of the gains [%] of least squares in which each motor's own current drives its axis:
    V g = τ.

    The preload of these rows is zero, and the equations know it. The unknowns are those of the fit.
    """
    rng = np.random.default_rng(0)
    count = len(noise_a)
    use = rows.use[0]
    known = rows.known()
    found = []
    weight = 1.0 / (PLANAR.gains * noise_a)
    linear = [-rows.of_joint(axis, use).T * weight[axis] for axis in range(count)]
    for _ in range(40):
        drive = []
        for axis in range(count):
            columns = np.zeros((int(use.sum()), count))
            columns[:, axis] = weight[axis] * (
                rows.current[axis, use] + noise_a[axis] * rng.standard_normal(use.sum())
            )
            drive.append(columns)
        matrix = np.hstack((np.concatenate(drive), np.concatenate(linear)))
        scale = np.linalg.norm(matrix, axis=0)
        right = np.concatenate([weight[axis] * known[axis, use] for axis in range(count)])
        found.append((np.linalg.lstsq(matrix / scale, right)[0] / scale)[:count])
    absolute_gain = np.abs(PLANAR.gains)
    return np.asarray(100.0 * np.std(found, axis=0) / absolute_gain)


@pytest.mark.slow
def test_preload_hides_gains_while_the_pose_hardly_changes() -> None:
    """A tenth of the workspace: fits with and without knowledge of the preload differ as the
    verdict says.
    """
    noise_a = 0.002
    made = made_of(PLANAR, 3, seconds=18.0, noise_a=noise_a, preload_nm=0.0, share=0.1)
    identified = identify(made.model, made.runs, made.conditioning, keep_rows=True)
    fitted = identified.estimate
    assert identified.gathered is not None
    design = _design(PLANAR, made, fitted.axis_noise)
    judged = _judged(made, design)
    predicted = np.array([(gain.std_percent, gain.known_preload_percent) for gain in judged.gains])
    rows = identified.gathered[1]
    absolute_gain = np.abs(fitted.gains)
    fits = (
        100.0 * fitted.gains_std / absolute_gain,
        _spread_with_known_preload(rows, fitted.axis_noise),
    )
    stacked_fits = np.stack(fits, axis=1)
    ratio = stacked_fits / predicted
    assert np.all((ratio > 0.5) & (ratio < 2.0))
    assert np.all(predicted[:, 0] > 2.5 * predicted[:, 1])
    louder = _judged(made, _design(PLANAR, made, 12.0 * fitted.axis_noise))
    assert louder.hidden(Hidden.PRELOAD) == (0, 1, 2, 3)
    assert louder.rank < 4 == louder.known_preload_rank
    (sentence,) = louder.sentences(["A", "B", "C", "D"])
    assert sentence.startswith("Internal preload obscures the gains of A, B, C and D")


def test_a_five_bar_goes_where_its_rods_reach() -> None:
    checker = Checker(FIVE_BAR.robot, NOTHING)
    far = float(np.arccos((2.0 * ROD_M - BASE_M) / (2.0 * CRANK_M)))
    home = checker.home
    difference = np.pi - far
    stretched = np.array([difference, far])
    position = np.array([home])
    assert checker.margins(position)[0] == np.inf
    apart = np.array([0.1, -0.1])
    stretched_position = stretched + np.array([[0.0], [1.0]]) * apart
    assert (checker.margins(stretched_position) == -np.inf).all()
    found = checker.obstruction(home, stretched)
    assert found is not None
    assert found.first == "the closures"
    assert checker.obstruction(home, home + 0.2) is None
    shares = home + np.array([[1.0], [0.5], [0.1]]) * (stretched - home)
    lower = home - 1.0
    upper = home + 1.0
    farthest = checker.farthest(home, shares, lower, upper)
    assert farthest is not None
    assert not np.array_equal(farthest, shares[0])


def test_motors_of_a_redundant_drive_are_made_to_fit() -> None:
    checker = Checker(PLANAR.robot, NOTHING)
    wanted = checker.home + np.array([0.1, -0.05, 0.02, 0.08])
    assert checker.margins(wanted[None])[0] == -np.inf
    fitting = checker.fitting(wanted)
    assert checker.margins(fitting[None])[0] == np.inf
    assert checker.fitting(fitting) == pytest.approx(fitting, abs=1e-9)
    # Where that is beyond a limit, it is no place to go to.
    difference = wanted - checker.home
    near = checker.home + 0.05 * difference
    there = checker.fitting(near)
    lower = there - 1e-6
    upper = there + 1e-6
    everywhere = checker.farthest(checker.home, near[None], lower, upper)
    assert everywhere == pytest.approx(there)
    there_lower = there - 1.0
    there_upper = there - 1e-6
    assert checker.farthest(checker.home, near[None], there_lower, there_upper) is None
    rng = np.random.default_rng(0)
    poses = axis_positions(PLANAR, rng, 6.0)[::300]
    grid = np.linspace(0.0, 1.0, 21)
    way = grid[:, None]
    pose_difference = poses[-1] - poses[0]
    straight = poses[0] + way * pose_difference
    misfit = np.max(np.abs(checker.fitting(straight) - straight))
    last_pose = poses[-1]
    assert (checker.obstruction(poses[0], last_pose) is None) == (misfit < LARGEST_PLANNED_MISFIT)


def test_bodies_of_a_closed_chain_keep_apart() -> None:
    tip = next(
        index for index, joint in enumerate(FIVE_BAR.robot.joints) if joint.name == "left-rod"
    )
    start_m = (0.0, 0.66, 0.0)
    post = Capsule("post", -1, start_m, (0.0, 0.66, 0.3), 0.02)
    end_m = (ROD_M, 0.0, 0.01)
    own = Capsule("tip", tip, (ROD_M, 0.0, 0.0), end_m, 0.02)
    pairs = ((0, 1),)
    scene = Scene((own, post), pairs, (), None, (), 0.01)
    checker = Checker(FIVE_BAR.robot, scene)
    found = checker.obstruction(checker.home, np.array([1.7, 1.44]))
    assert found is not None
    assert {found.first, found.second} == {"tip", "post"}
