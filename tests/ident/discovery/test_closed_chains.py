"""Undeclared effects of closed chains: named on the right joint, and the gains stay."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.discovery.evidence import gather
from ident.discovery.loop import find_effects
from ident.estimators.identify import identify
from ident.model.closed_chain import TreeMotion
from tests.ident.closed_recordings import Made, recorded
from tests.ident.mechanisms import FIVE_BAR, PLANAR, THREE_LEGS, Mechanism

FloatArray = NDArray[np.float64]
Torque = Callable[[FloatArray, FloatArray], FloatArray]


def _friction(q: FloatArray, v: FloatArray) -> FloatArray:
    del q
    return 0.25 * np.sign(v) + 0.1 * v


def _spring(q: FloatArray, v: FloatArray) -> FloatArray:
    del v
    return 3.0 * (q - 0.2)


CASES = (
    (FIVE_BAR, "right-rod", _friction, "passive-friction"),
    (PLANAR, "elbow-2", _friction, "passive-friction"),
    (THREE_LEGS, "slide-1", _spring, "spring"),
    (FIVE_BAR, "left-rod", _spring, "passive-spring"),
)


def _planted(mechanism: Mechanism, joint: str, torque: Torque, size: float) -> tuple[Made, tuple[Run, ...]]:
    """Recordings in which a joint needs more torque than the model says: on top of the currents, by virtual power."""
    made = recorded(mechanism, 7, seconds=18.0 if mechanism is THREE_LEGS else 25.0, noise_a=0.01)
    runs = []
    index = [one.name for one in made.model.robot.joints].index(joint)
    for run in made.runs:
        data = differentiate(run, made.model.drive_train, made.conditioning)
        followed: TreeMotion = made.model.follow(data.motion())
        q, v = followed.joints.position_rad[:, index], followed.joints.velocity_rad_s[:, index]
        needed = followed.to_joints[:, index] * (size * torque(q, v))[:, None]
        a = followed.to_motors
        motors = np.einsum("kmd,kd->km", a @ np.linalg.inv(np.swapaxes(a, 1, 2) @ a), needed)
        current = run.current_a.copy()
        current[1:-1] += motors / mechanism.gains
        runs.append(replace(run, current_a=current))
    return made, tuple(runs)


@pytest.mark.parametrize(("mechanism", "joint", "torque", "family"), CASES, ids=lambda one: getattr(one, "name", None))
def test_an_effect_is_named_on_its_joint(mechanism: Mechanism, joint: str, torque: Torque, family: str) -> None:
    size = {"five-bar": 1.0, "planar": 0.06, "three-legs": 30.0}[mechanism.name]
    made, runs = _planted(mechanism, joint, torque, size)
    start = gather(identify(made.model, runs, made.conditioning, keep_rows=True))
    steps = find_effects(start, np.random.default_rng(0))
    places = [one.name for one in made.model.robot.places]
    found = [(placed.effect.name, places[placed.axis]) for placed in steps[-1].after.effects]
    assert found == [(family, joint)]
    gains = steps[-1].after.estimate
    assert np.all(np.abs(gains.gains / mechanism.gains - 1.0) < 4.0 * gains.gains_std / np.abs(gains.gains))


def test_a_clean_closed_chain_has_no_effect() -> None:
    for mechanism in (FIVE_BAR, PLANAR):
        made = recorded(mechanism, 8, seconds=25.0, noise_a=0.01)
        steps = find_effects(
            gather(identify(made.model, made.runs, made.conditioning, keep_rows=True)), np.random.default_rng(0)
        )
        assert not steps[-1].after.effects
