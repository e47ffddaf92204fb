"""Changes of errors: what is more than noise, on which motor, and how many blocks show it."""

from __future__ import annotations

from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from ident.discovery.effect_verdict import Judgement, judge_change
from ident.discovery.error_change import (
    CONFIDENCE,
    FEWEST_BLOCKS,
    ErrorChange,
    PairedChange,
    change_of_blocks,
    change_of_errors,
    compare_by_block,
)

FloatArray = NDArray[np.float64]
ROWS = 20  #: Of a move
MOTORS = 3


def _change(by_move: FloatArray, level: float = 1.0) -> ErrorChange:
    """Two models whose squared errors differ by so much in each move and motor, shape (moves,
    motors).
    """
    moves, motors = by_move.shape
    move = np.tile(np.repeat(np.arange(moves), ROWS), motors)
    motor = np.repeat(np.arange(motors), moves * ROWS)
    before = np.full(len(move), level)
    after = before + by_move[move, motor] / ROWS
    run = np.zeros(len(move), dtype=np.int64)
    return change_of_errors(
        before=before, after=after, motor=motor, move=move, run=run, motors=motors
    )


def test_a_fall_that_is_more_than_noise_is_confirmed() -> None:
    rng = np.random.default_rng(0)
    by_move = rng.normal(-5.0, 3.0, (20, MOTORS))
    change = _change(by_move)
    assert judge_change(change)[0] is Judgement.CONFIRMED


def test_a_fall_of_the_motor_that_the_effect_names_is_a_fall() -> None:
    """The noise of the other motors hides it in the total;
    a motor that was not named proves nothing by itself.
    """
    rng = np.random.default_rng(7)
    by_move = rng.normal(0.0, 5.0, (20, MOTORS))
    by_move[:, 1:] -= by_move[:, 1:].mean(axis=0) - 0.01
    by_move[:, 0] = np.random.default_rng(8).normal(-0.5, 0.5, 20)
    change = _change(by_move)
    assert judge_change(change)[0] is Judgement.UNDECIDED
    assert judge_change(change, 0)[0] is Judgement.CONFIRMED
    assert judge_change(change, 1)[0] is Judgement.UNDECIDED


@pytest.mark.parametrize(("shift", "verb"), [(-0.5, "falls"), (0.5, "rises")])
def test_a_change_that_may_be_noise_is_stated_with_its_direction(shift: float, verb: str) -> None:
    rng = np.random.default_rng(11)
    by_move = rng.normal(0.0, 5.0, (20, MOTORS))
    by_move += shift - by_move.mean()
    judgement, reason = judge_change(_change(by_move))
    assert judgement is Judgement.UNDECIDED
    assert reason.startswith(f"the squared error on held-out runs {verb} by 30 ± ")
    assert reason.endswith(" noise variances, which may be noise")


def test_a_fall_in_all_blocks_but_one_is_a_fall() -> None:
    """One move that is predicted worse makes the scatter of all so large that the mean shows
    nothing.
    """
    falls = np.array([-30.0, -27.0, -25.0, -24.0, -22.0, -20.0, -19.0, -15.0, -14.0, -3.0])
    one_rise = change_of_blocks(np.append(falls, 76.0))
    assert one_rise.rise < 0.0
    assert abs(one_rise.sigmas) < 1.7  # t(10) at 95 % is 1.8
    assert one_rise.falls(0.95)
    assert not one_rise.rises(0.95)


def test_a_fall_that_two_blocks_make_alone_is_none() -> None:
    rest = np.array([-13.0, -9.0, -2.0, -3.0, -1.0, 10.0, -4.0])
    two_falls = change_of_blocks(np.append(rest, [-2747.0, -1627.0]))
    assert two_falls.rise < -4000.0
    assert not two_falls.falls(0.95)


def test_a_rise_in_total_is_no_fall_of_most_blocks() -> None:
    """Nine moves better and one much worse: the error rises, whatever the trimmed mean says."""
    change = change_of_blocks(np.append(np.full(9, -10.0) + np.arange(9), 200.0))
    assert change.rise > 0.0
    assert not change.falls(0.95)


@given(st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=30))
def test_a_fall_is_a_rise_of_the_opposite(changes: list[float]) -> None:
    found = change_of_blocks(np.array(changes))
    opposite = change_of_blocks(-np.array(changes))
    assert found.falls(0.95) == opposite.rises(0.95)
    assert not (found.falls(0.95) and found.rises(0.95))


@given(
    st.lists(st.tuples(st.floats(-1e3, 1e3), st.integers(0, 6)), min_size=2, max_size=30),
    st.randoms(use_true_random=False),
)
def test_a_change_is_summed_by_move(rows: list[tuple[float, int]], random: Random) -> None:
    """So few moves stay blocks of their own, in whatever order their rows come."""
    change = np.array([row[0] for row in rows])
    move = np.array([row[1] for row in rows])
    run = np.zeros_like(move)
    found = compare_by_block(change, move, run)
    by_move = [change[move == number].sum() for number in np.unique(move)]
    assert found.rise == pytest.approx(change.sum(), abs=1e-6)
    assert found.blocks == len(by_move)
    expected = 0.0
    if len(by_move) > 1:
        expected = np.std(by_move, ddof=1) * np.sqrt(len(by_move))
    assert found.std == pytest.approx(expected, abs=1e-6)
    order = random.sample(range(len(rows)), len(rows))
    shuffled = compare_by_block(change[order], move[order], run)
    assert shuffled.rise == pytest.approx(found.rise, abs=1e-6)


@pytest.mark.parametrize("freedom", [3, 30])
def test_noise_falls_six_times_in_a_hundred_also_with_heavy_tails(freedom: int) -> None:
    """Two tests are made, which nearly always agree: 5 % of each become some 6 % of both."""
    rng = np.random.default_rng(11)
    draws = rng.standard_t(freedom, size=(2000, 12))
    share = np.mean([change_of_blocks(draw).falls(0.95) for draw in draws])
    assert 0.035 <= share <= 0.075


@pytest.mark.parametrize(("confidence", "expected"), [(0.95, 0.0845), (0.975, 0.0457)])
def test_noise_falls_most_often_with_five_blocks(confidence: float, expected: float) -> None:
    """The level that the documentation gives:
    two tests, each at the level that the confidence says.
    """
    rng = np.random.default_rng(13)
    draws = rng.standard_normal((3000, FEWEST_BLOCKS))
    share = np.mean([change_of_blocks(draw).falls(confidence) for draw in draws])
    assert share == pytest.approx(expected, abs=0.015)  # three deviations of 3000 draws


def test_noise_is_confirmed_once_in_ten_at_most() -> None:
    """The total and the motor that an effect names are judged at half the level each,
    by means that mostly agree.
    """
    rng = np.random.default_rng(12)
    found = [judge_change(_change(rng.normal(0.0, 0.05, (8, MOTORS))), 0)[0] for _ in range(600)]
    assert 0.02 <= np.mean([judgement is Judgement.CONFIRMED for judgement in found]) <= 0.10


def test_joined_blocks_are_enough_to_judge_by() -> None:
    """However strongly neighbours follow each other:
    of four blocks nothing is judged, and a gate would be open.
    """
    change = np.array([2.0, 2.0, 2.0, 0.5, -0.5, -2.0, -2.0, -2.0])
    run = np.zeros(8, dtype=np.int64)
    assert compare_by_block(change, np.arange(8), run).blocks == 8
    twice = np.repeat(change, 2)
    move = np.arange(16)
    assert compare_by_block(twice, move, np.zeros(16, dtype=np.int64)).blocks == 8


def test_a_rise_that_is_more_than_noise_is_refuted() -> None:
    rng = np.random.default_rng(0)
    by_move = rng.normal(5.0, 3.0, (20, MOTORS))
    change = _change(by_move)
    judgement, reason = judge_change(change)
    assert judgement is Judgement.REFUTED
    assert "rises by" in reason


def test_harm_on_another_motor_refutes_what_helps_in_total() -> None:
    rng = np.random.default_rng(1)
    by_move = rng.normal(0.0, 1.0, (20, MOTORS))
    by_move[:, 0] -= 10.0
    assert judge_change(_change(by_move))[0] is Judgement.CONFIRMED
    by_move[:, 2] += 3.0
    change = _change(by_move)
    assert change.total.rise < 0.0
    assert change.worse_motors == (2,)
    judgement, reason = judge_change(change)
    assert judgement is Judgement.REFUTED
    assert "motor 3" in reason


def test_a_rise_below_a_hundredth_of_the_error_refutes_nothing() -> None:
    """5.76 % against 5.76 %, however certain the difference is."""
    rng = np.random.default_rng(2)
    sure = np.full((20, MOTORS), 0.001) + rng.normal(0.0, 1e-5, (20, MOTORS))
    change = _change(sure)
    assert change.total.rises(CONFIDENCE)
    assert not change.is_rise
    assert change.worse_motors == ()
    assert judge_change(change)[0] is Judgement.UNDECIDED


@pytest.mark.parametrize("rise", [-8.0, 60.0])
def test_two_moves_confirm_nothing_and_let_no_doubled_error_pass(rise: float) -> None:
    by_move = np.full((2, MOTORS), rise) + np.array([[0.0], [0.1]])
    judgement, reason = judge_change(_change(by_move))
    assert judgement is Judgement.UNDECIDED
    assert "2 independent blocks" in reason


def test_a_motor_that_may_be_much_worse_is_not_confirmed() -> None:
    """Two of a dozen moves are five times as bad on one motor: noise, perhaps."""
    rng = np.random.default_rng(3)
    by_move = rng.normal(-8.0, 2.0, (12, MOTORS))
    by_move[:, 1] = 0.0
    by_move[:2, 1] = 80.0, 30.0
    change = _change(by_move)
    assert change.worse_motors == ()
    judgement, reason = judge_change(change, 0)
    assert judgement is Judgement.UNDECIDED
    assert "motor 2" in reason


def test_moves_whose_changes_follow_each_other_count_as_one_block() -> None:
    rng = np.random.default_rng(4)
    slow = np.repeat(rng.normal(size=10), 16)
    move = np.arange(160)
    run = np.repeat((0, 1), 80)
    joined = compare_by_block(slow, move, run)
    assert joined.blocks <= 20
    assert joined.std > 2.0 * change_of_blocks(slow).std
    assert joined.rise == pytest.approx(slow.sum())
    independent = compare_by_block(rng.normal(size=160), move, run)
    assert independent.blocks == 160


def test_independent_blocks_keep_the_false_alarm_where_moves_follow_each_other() -> None:
    """A change that wanders over sixteen moves seems certain by moves;
    by blocks, it is a rise about once in twenty.
    """
    rng = np.random.default_rng(5)
    move = np.arange(320)
    run = np.zeros(320, dtype=np.int64)
    by_move = 0
    by_block = 0
    for _ in range(200):
        slow = np.repeat(rng.normal(size=20), 16)
        by_move += change_of_blocks(slow).rises(CONFIDENCE)
        by_block += compare_by_block(slow, move, run).rises(CONFIDENCE)
    assert by_move > 50
    assert by_block < 26  # 10 expected, 3.1 its deviation; blocks are found by a test, too


@given(st.floats(0.1, 1e3), st.floats(0.1, 1e3), st.integers(2, 40))
def test_a_change_is_no_rise_and_fall_at_once(rise: float, std: float, blocks: int) -> None:
    change = PairedChange(rise, std, blocks)
    mirrored = PairedChange(-rise, std, blocks)
    assert change.rises(0.95) == mirrored.falls(0.95)
    assert not (change.rises(0.95) and change.falls(0.95))


def test_one_block_that_outweighs_the_others_is_no_proof() -> None:
    by_move = np.zeros((FEWEST_BLOCKS * 4, MOTORS))
    by_move[3] = -100.0
    assert judge_change(_change(by_move, 100.0))[0] is Judgement.UNDECIDED
