"""Every family, planted with the true load and current: named on its axis, with the right size and sign."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.dataset import Dataset
from ident.drive_train import DriveTrain
from ident.effects import EFFECTS
from ident.effects.effect import Effect, Side
from ident.effects.placed import PlacedEffect
from ident.errors import RankDeficient, TooFewMoves
from ident.estimators.maximum_likelihood import ml
from ident.identify import identify
from ident.loop import Evidence, close_the_loop, with_effects
from ident.model import Model
from ident.rows import decimate_rows
from ident.run import Run
from ident.search import find
from tests.ident.recordings import CONDITIONING, GAINS, PAYLOAD_TRUTH, RATIO, Truth, gathered

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class True1:
    """What really acts on one axis of a run, from the truth alone."""

    position: FloatArray
    velocity: FloatArray
    motor_angle: FloatArray
    load: FloatArray
    motor_torque: FloatArray
    rate_hz: float


@dataclass(frozen=True)
class Planted:
    """An effect in a formula of the test's own, with the coefficients that must come back."""

    family: str
    axis: int
    torque: Callable[[True1], FloatArray]
    expected: tuple[float, ...]


CASES = (
    Planted("stribeck", 1, lambda t: 6.0 * np.sign(t.velocity) / np.exp(np.abs(t.velocity) / 0.2), (6.0,)),
    Planted("nonlinear-viscous", 2, lambda t: 1.5 * t.velocity * np.abs(t.velocity), (1.5,)),
    Planted("asymmetric-viscous", 3, lambda t: 0.9 * np.maximum(t.velocity, -t.velocity), (0.9,)),
    Planted("load-friction", 2, lambda t: 0.15 * np.abs(t.load) * np.sign(t.velocity), (0.15,)),
    Planted("spring", 1, lambda t: 9.0 * t.position, (9.0,)),
    Planted("position-friction", 3, lambda t: np.sign(t.velocity) * 1.5 * np.cos(t.position + 0.7), (1.147, -0.966)),
    Planted("cogging", 0, lambda t: 4.0 * np.cos(t.motor_angle) + 3.0 * np.sin(t.motor_angle), (4.0, 3.0)),
    # g v (1 − c v²) = τ with v = τ/g to first order: the current must be larger by c v³.
    Planted("saturation", 1, lambda t: 0.02 * t.motor_torque * (t.motor_torque / GAINS[1]) ** 2, (0.02,)),
    Planted("lag", 0, lambda t: -0.01 * np.gradient(t.motor_torque) * t.rate_hz, (0.01,)),
)  # fmt: skip


@pytest.fixture(scope="module")
def clean(truth: Truth, noisy_runs: tuple[Run, ...]) -> Evidence:
    return gathered(truth, noisy_runs)


def _true(truth: Truth, data: Dataset, axis: int) -> True1:
    names = [column.name for column in truth.model.columns]
    parameters = truth.parameters.copy()
    if data.payload is not None:
        parameters[truth.model.flange] += list(PAYLOAD_TRUTH.values())
    rigid = np.array([name[:2] not in ("Ia", "fv", "fs", "of") for name in names])
    columns = truth.model.regressor(data.motion())
    return True1(
        position=data.position_rad[axis],
        velocity=data.velocity_rad_s[axis],
        motor_angle=(RATIO @ data.position_rad)[axis],
        load=np.einsum("ck,c->k", columns[axis], parameters * rigid),
        motor_torque=(truth.model.drive_train.to_motor @ np.einsum("jck,c->jk", columns, parameters))[axis],
        rate_hz=data.rate_hz,
    )


def _with(clean: Evidence, truth: Truth, planted: Planted, side: Side) -> Evidence:
    rows = [
        decimate_rows(data, CONDITIONING, planted.torque(_true(truth, data, planted.axis))) for data in clean.datasets
    ]
    added = np.zeros_like(clean.bare.current)
    added[planted.axis] = np.concatenate(rows)
    at_motors = added if side is Side.MOTOR else truth.model.drive_train.to_motor @ added
    bent = replace(clean.bare, current=clean.bare.current + at_motors / GAINS[:, None])
    return replace(clean, bare=bent, training=bent, estimate=ml(bent.system()))


def _family(name: str) -> tuple[Effect, ...]:
    return next(family for family in EFFECTS if family[0].name == name)


def test_every_family_is_planted() -> None:
    assert {case.family for case in CASES} == {family[0].name for family in EFFECTS}


@pytest.mark.parametrize("planted", CASES, ids=lambda planted: planted.family)
def test_it_is_named_with_its_size_and_sign(clean: Evidence, truth: Truth, planted: Planted) -> None:
    start = _with(clean, truth, planted, _family(planted.family)[0].side)
    findings = find(start.model, start.datasets, start.training, start.estimate, np.random.default_rng(0))
    best = findings[0]
    assert best.passed
    names = {
        (best.effect.name, best.axis),
        *((text.split(" on axis ")[0], int(text[-1]) - 1) for text in best.ambiguity),
    }
    assert (planted.family, planted.axis) in names
    own = next(f for f in findings if (f.effect.name, f.axis) == (planted.family, planted.axis))
    after = with_effects(start, (PlacedEffect(own.effect, own.axis),))
    count = len(planted.expected)
    found = after.estimate.parameters[len(after.bare.columns) :][:count]
    assert found == pytest.approx(np.array(planted.expected), rel=0.2, abs=0.1 * max(np.abs(planted.expected)))
    assert after.training_error.axes[planted.axis] < start.training_error.axes[planted.axis]


def test_motors_in_another_order_change_no_verdict(clean: Evidence, truth: Truth) -> None:
    """A spring on joint 2 must pass its gates on whichever motor gives the torque."""
    order = np.array([2, 0, 1, 3, 5, 4])
    start = _with(clean, truth, CASES[4], Side.JOINT)
    train = DriveTrain(RATIO[order])
    training = replace(
        start.training,
        drive_train=train,
        current=start.training.current[order],
        motor_use=start.training.motor_use[order],
    )
    model = Model(truth.model.robot, train)
    findings = find(model, start.datasets, training, ml(training.system()), np.random.default_rng(0))
    assert (findings[0].effect.name, findings[0].axis, findings[0].passed) == ("spring", 1, True)
    same = find(start.model, start.datasets, start.training, start.estimate, np.random.default_rng(0))
    assert findings[0].explained == pytest.approx(same[0].explained, rel=1e-3)


def test_a_dead_current_channel_is_named(truth: Truth, noisy_runs: tuple[Run, ...]) -> None:
    dead = tuple(replace(run, current_a=run.current_a * np.array([1, 1, 1, 0, 1, 1])) for run in noisy_runs)
    with pytest.raises(RankDeficient, match="motor 4 is zero") as caught:
        identify(truth.model, dead, CONDITIONING)
    assert caught.value.unknowns == ("gain 4",)


def test_too_few_moves_are_refused_and_continuous_motion_counts_by_time(
    truth: Truth, clean_runs: tuple[Run, ...], noisy_runs: tuple[Run, ...]
) -> None:
    never_still = replace(CONDITIONING, standstill_rad_s=())
    whole = identify(truth.model, noisy_runs, never_still)
    assert len(whole.system.moves) >= 4 * 11
    assert np.all(whole.estimate.gains_std > 1e-4 * np.abs(GAINS))
    short = tuple(
        replace(run, time_s=run.time_s[:5000], position_rad=run.position_rad[:5000], current_a=run.current_a[:5000])
        for run in clean_runs
    )
    with pytest.raises(TooFewMoves, match="record longer"):
        identify(truth.model, short, never_still)


def test_sigma_is_true_for_correlated_noise(clean: Evidence, truth: Truth) -> None:
    """Lag-one correlation 0.67 in every current: the spread over 24 draws against the σ that each of them claims."""
    rng = np.random.default_rng(5)
    bare, estimate = clean.bare, clean.estimate
    exact = truth.model.drive_train.to_motor @ estimate.predicted_torque(bare) / estimate.gains[:, None]
    gains, claimed = [], []
    for _ in range(24):
        noise = np.empty_like(exact)
        noise[:, 0] = rng.normal(size=6)
        drawn = rng.normal(size=exact.shape)
        for row in range(1, exact.shape[1]):
            noise[:, row] = 0.67 * noise[:, row - 1] + np.sqrt(1 - 0.67**2) * drawn[:, row]
        found = ml(replace(bare, current=exact + 0.05 * noise).system())
        gains.append(found.gains)
        claimed.append(found.gains_std)
    ratio = np.mean(claimed, axis=0) / np.std(gains, axis=0, ddof=1)
    # 24 draws know a deviation to 15 % (1/√46); three of those on either side.
    assert np.all(ratio > 0.6)
    assert np.all(ratio < 1.6)


def test_the_loop_ends_where_nothing_is_left(clean: Evidence, truth: Truth) -> None:
    start = _with(clean, truth, CASES[3], Side.JOINT)
    steps = close_the_loop(start, np.random.default_rng(1))
    assert [step.accepted is not None for step in steps] == [True, False]
