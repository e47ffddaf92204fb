"""Which effects held-out runs confirm: the others leave, and the rest is fitted again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.data.dataset import Dataset
from ident.discovery import acceptance
from ident.discovery.acceptance import accept_on_holdout
from ident.discovery.before_after import compare_on_holdout
from ident.discovery.effect_verdict import EffectVerdict, Judgement
from ident.discovery.evidence import Evidence, with_effects
from ident.discovery.gates import Gates, own_unknowns
from ident.discovery.joining import linearised
from ident.discovery.loop import Step, end_search, find_effects
from ident.discovery.search import Finding
from ident.effects.dictionary import EFFECTS
from ident.effects.effect import PlacedEffect
from ident.effects.friction import AsymmetricViscous, Stribeck
from ident.effects.position import Spring
from ident.model.model import DriveTrain
from tests.ident.recordings import (
    MOUNTED,
    RATIO,
    Truth,
    acting_on,
    bent,
    gathered,
    record,
    with_current,
)

pytestmark = pytest.mark.slow

FloatArray = NDArray[np.float64]

STICKING = PlacedEffect(Stribeck(0.3), 1)
SPRING = PlacedEffect(Spring(), 2)
ASYMMETRIC = PlacedEffect(AsymmetricViscous(), 0)
NAMES = ("J1", "J2", "J3")


def _held_out(small: Evidence, count: int) -> Evidence:
    """The same recordings with the last ones held out."""
    rows = small.rows_without_effects
    first = len(small.datasets) - count
    training = rows.only(rows.run < first)
    holdout = rows.only(rows.run >= first)
    return replace(small, held_out=count, training=training, holdout=holdout)


def _planted(
    small: Evidence, truth: Truth, torque: Callable[[Dataset], FloatArray], held_out: int = 1
) -> Evidence:
    """Recordings with a torque, and the last one held out."""
    made = bent(small, truth, torque)
    cut = _held_out(made, held_out)
    return with_effects(cut, ())


def _sticks(data: Dataset) -> FloatArray:
    v = data.velocity_rad_s[:, 1]
    torque_nm = 6.0 * np.sign(v) * np.exp(-np.abs(v) / 0.3)
    return acting_on(1, 3, torque_nm)


def _only_in(
    names: tuple[str, ...], torque: Callable[[Dataset], FloatArray]
) -> Callable[[Dataset], FloatArray]:
    """A torque that the recordings of some names have, and the others do not."""
    return lambda data: torque(data) * (data.name in names)


def _asymmetric(data: Dataset) -> FloatArray:
    absolute_velocity_rad_s = np.abs(data.velocity_rad_s[:, 0])
    torque_nm = 4.0 * absolute_velocity_rad_s
    return acting_on(0, 3, torque_nm)


def _steps(start: Evidence, effects: tuple[PlacedEffect, ...]) -> tuple[Step, ...]:
    """What a search that has found these effects returns."""
    after = with_effects(start, effects)
    found = [
        Finding(
            one.effect,
            one.axis,
            np.ones(1),
            np.ones(1),
            0.0,
            1.0,
            0.1,
            5.0,
            4.0,
            0.2,
            9.0,
            True,
            np.ones(8),
        )
        for one in effects
    ]
    turns = [Step((), (), np.zeros(3), one, after) for one in found]
    limits_nm = np.zeros(3)
    step = Step((), (), limits_nm, None, after)
    return (*turns, step)


def _by_place(step: Step) -> dict[PlacedEffect, EffectVerdict]:
    return {verdict.placed: verdict for verdict in step.verdicts}


@pytest.fixture(scope="module")
def sticking(small: Evidence, small_truth: Truth) -> Evidence:
    return _planted(small, small_truth, _sticks)


def test_a_true_effect_is_confirmed_and_stays(sticking: Evidence) -> None:
    steps = _steps(sticking, (STICKING,))
    (*_, last) = accept_on_holdout(sticking, steps, axes=NAMES)
    assert last.after.effects == (STICKING,)
    (verdict,) = last.verdicts
    assert verdict.judgement is Judgement.CONFIRMED
    assert verdict.written
    assert verdict.after.axes[1] < 0.9 * verdict.before.axes[1]


def test_a_refuted_effect_leaves_and_the_rest_is_fitted_again(
    small: Evidence, small_truth: Truth
) -> None:
    """Runs of the fit have a torque that the held-out one lacks: no law of the arm."""
    names = ("run0", "run1", "run2")
    fitted = _only_in(names, _asymmetric)
    start = _planted(small, small_truth, lambda data: _sticks(data) + fitted(data))
    said: list[str] = []
    steps = _steps(start, (STICKING, ASYMMETRIC))
    (*_, last) = accept_on_holdout(start, steps, axes=NAMES, progress=said.append)
    assert last.after.effects == (STICKING,)
    verdicts = _by_place(last)
    assert verdicts[ASYMMETRIC].judgement is Judgement.REFUTED
    assert not verdicts[ASYMMETRIC].written
    assert verdicts[STICKING].judgement is Judgement.CONFIRMED
    assert any("asymmetric-viscous on J1 leaves" in one for one in said)
    again = with_effects(start, (STICKING,))
    assert last.after.estimate.parameters == pytest.approx(again.estimate.parameters)


def test_an_undecided_effect_is_reported_and_not_written_unless_asked_for(
    sticking: Evidence,
) -> None:
    steps = _steps(sticking, (STICKING, SPRING))  # there is no spring
    (*_, last) = accept_on_holdout(sticking, steps, axes=NAMES)
    assert last.after.effects == (STICKING,)
    verdict = _by_place(last)[SPRING]
    assert verdict.judgement is not Judgement.CONFIRMED
    assert not verdict.written
    (*_, kept) = accept_on_holdout(sticking, steps, write_undecided=True, axes=NAMES)
    asked = _by_place(kept)
    assert asked[STICKING].written
    in_model = SPRING in kept.after.effects
    assert asked[SPRING].written == in_model


def test_sigma_contains_what_an_undecided_effect_would_move(small_truth: Truth) -> None:
    """A motor saturates, and a held-out run of four moves decides nothing:
    without the effect, its gain is 7 % off.
    """
    rng = np.random.default_rng(3)
    runs = [
        record(
            small_truth,
            f"run{index}",
            rng,
            MOUNTED if index % 2 else None,
            noise_a=0.3,
            seconds=seconds,
        )
        for index, seconds in enumerate((22.0, 22.0, 22.0, 22.0, 5.0))
    ]
    linear = gathered(small_truth, tuple(runs))
    current_a = (
        linear.estimate.predicted_torque(linear.rows_without_effects) / small_truth.gains[:, None]
    )
    added_a = np.zeros_like(current_a)
    absolute_current_a = np.abs(current_a[1])
    largest_absolute_current_a = np.max(absolute_current_a)
    added_a[1] = 0.3 * current_a[1] ** 3 / largest_absolute_current_a**2
    start = with_effects(_held_out(with_current(linear, added_a), 1), ())
    families = tuple(family for family in EFFECTS if family[0].name == "saturation")
    steps = find_effects(start, np.random.default_rng(0), Gates(draws=199), families)
    (saturation,) = steps[-1].after.effects
    (*_, last) = accept_on_holdout(start, steps, axes=NAMES)
    assert last.after.effects == ()
    assert last.left_open == (saturation,)
    (verdict,) = last.verdicts
    assert verdict.judgement is Judgement.UNDECIDED
    errors = last.after.estimate.gains - small_truth.gains
    assert abs(errors[1]) > 3.0 * start.estimate.gains_std[1]
    gains_std = last.after.estimate.gains_std
    assert np.all(np.abs(errors) < 3.0 * gains_std)
    assert last.choice_std is not None
    assert last.after.estimate.gains_std == pytest.approx(
        np.hypot(start.estimate.gains_std, last.choice_std), rel=1e-6
    )


def test_a_refuted_effect_adds_nothing_to_sigma(small: Evidence, small_truth: Truth) -> None:
    names = ("run0", "run1", "run2")
    fitted = _only_in(names, _asymmetric)
    start = _planted(small, small_truth, fitted)
    steps = _steps(start, (ASYMMETRIC,))
    (*_, last) = accept_on_holdout(start, steps, axes=NAMES)
    (verdict,) = last.verdicts
    assert verdict.judgement is Judgement.REFUTED
    assert last.left_open == ()
    assert last.after.estimate.gains_std == pytest.approx(start.estimate.gains_std)


def test_what_is_left_passes_every_gate_again(sticking: Evidence) -> None:
    """A spring that is not there, with a σ that shows it:
    the folds and the random signs of the moves do not.
    """
    steps = _steps(sticking, (STICKING, SPRING))
    joined = with_effects(sticking, (SPRING,))
    own = len(joined.estimate.gains) + own_unknowns(joined.estimate, joined.effects)
    covariance = joined.estimate.covariance.copy()
    covariance[own, :] = 0.0
    covariance[:, own] = 0.0
    covariance[own, own] = 1e-12
    estimate = replace(joined.estimate, covariance=covariance)
    certain = replace(joined, estimate=estimate)
    model = linearised(certain, {})
    rng = np.random.default_rng(0)
    last = end_search(steps, model, Gates(draws=199), rng=rng)
    assert last.after.effects == ()
    assert last.left_open == (SPRING,)
    words = last.set_aside[-1].words
    assert words.startswith("without what has left, ")
    # Where nothing has left, the search itself has just asked.
    last_step = steps[-1]
    changed_step = replace(last_step, after=certain)
    unchanged = (*steps[:-1], changed_step)
    gates = Gates(draws=199)
    after = end_search(unchanged, model, gates, rng=np.random.default_rng(0)).after
    assert after.effects == (SPRING,)


def test_few_held_out_moves_decide_nothing(small: Evidence, small_truth: Truth) -> None:
    start = _planted(small, small_truth, _sticks)
    assert start.holdout is not None
    unique_moves = np.unique(start.holdout.move)
    moves = unique_moves[:2]
    holdout = start.holdout.only(np.isin(start.holdout.move, moves))
    short = replace(start, holdout=holdout)
    found = with_effects(start, (STICKING,))
    assert found.holdout is not None
    few = replace(found, holdout=found.holdout.only(np.isin(found.holdout.move, moves)))
    (verdict,) = [acceptance._verdict(short, few, STICKING)]
    assert verdict.judgement is Judgement.UNDECIDED


def test_effects_that_are_no_better_together_than_none_are_not_written(
    small: Evidence, small_truth: Truth, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even where no single one was refuted: here because the judge was bribed."""
    names = ("run0", "run1", "run2")
    torque = _only_in(names, _asymmetric)
    start = _planted(small, small_truth, torque)
    monkeypatch.setattr(acceptance, "judge_change", lambda *_: (Judgement.CONFIRMED, "bribed"))
    steps = _steps(start, (ASYMMETRIC,))
    (*_, last) = accept_on_holdout(start, steps, axes=NAMES)
    assert last.after.effects == ()
    (verdict,) = last.verdicts
    assert not verdict.written
    assert verdict.judgement is Judgement.REFUTED
    assert verdict.reason.startswith("together with the other effects")
    assert last.after.estimate.gains == pytest.approx(start.estimate.gains)


def test_declared_effects_are_not_judged(sticking: Evidence) -> None:
    after = replace(with_effects(sticking, (SPRING, STICKING)), declared=1)
    declared = replace(with_effects(sticking, (SPRING,)), declared=1)
    limits_nm = np.zeros(3)
    steps = (Step((), (), limits_nm, None, after),)
    (last,) = accept_on_holdout(declared, steps, axes=NAMES)
    assert SPRING in last.after.effects
    assert last.after.declared == 1
    assert [one.placed for one in last.verdicts] == [STICKING]


def test_without_held_out_runs_nothing_changes(small: Evidence) -> None:
    steps = _steps(small, (SPRING,))
    assert accept_on_holdout(small, steps) == steps


def test_the_change_is_zero_for_the_same_model(sticking: Evidence) -> None:
    change = compare_on_holdout(sticking, sticking, sticking)
    assert change.total.rise == 0.0
    assert len(change.motors) == 3
    assert np.all(change.before > 0.0)


def test_the_motor_that_must_confirm_an_effect_is_that_of_its_joint() -> None:
    """Motors may be numbered in another order than joints; coupled ones keep their own joint."""
    permuted = np.zeros((3, 3))
    permuted[0, 1] = 40.0  # motor 1 turns joint 2
    permuted[1, 2] = 50.0
    permuted[2, 0] = 45.0
    motors = [acceptance._own_motor(one, DriveTrain(permuted)) for one in (STICKING, SPRING)]
    assert motors == [0, 1]
    sixth = PlacedEffect(Spring(), 5)
    assert acceptance._own_motor(sixth, DriveTrain(RATIO)) == 5
    passive = PlacedEffect(Spring(), 6)
    assert acceptance._own_motor(passive, DriveTrain(RATIO)) is None
