"""Friction in the pivot that a closed chain is cut at:
named, kept in a calibration, and used by what reads it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from daq.documents.calibration_file import load_calibration, save_calibration
from ident.arrays import FloatArray
from ident.calibration import Calibration, calibration_of
from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.discovery.evidence import gather
from ident.discovery.gates import Gates
from ident.discovery.loop import find_effects
from ident.estimators.identify import identify
from ident.model.robot import Motion
from ident.prediction import placed_effect, predict_torque
from ident.weighing import weigh
from tests.ident.closed_recordings import MOUNTED, Made, recorded
from tests.ident.mechanisms import FIVE_BAR

AXES = ("J1", "J2")
DRY_NM = 0.25
VISCOUS_NM_S_RAD = 0.1
PIVOT = "pivot tip"


def _with_friction(made: Made, run: Run) -> Run:
    """The run with friction between the two rods, on top of its currents.

    The rods point where their cranks and their own joints have turned them. The motors supply the
    power of the friction: each its torque times how the angle between the rods turns with its
    crank, by differences of the poses.
    """
    data = differentiate(run, made.model.drive_train, made.conditioning)
    motion = data.motion()
    turned = _between_rods(made, motion.position_rad)
    rate = np.gradient(turned) * data.rate_hz
    friction = DRY_NM * np.sign(rate) + VISCOUS_NM_S_RAD * rate
    step = 1e-6
    torque = np.zeros_like(motion.position_rad)
    for axis in range(2):
        moved = motion.position_rad.copy()
        moved[:, axis] += step
        torque[:, axis] = (_between_rods(made, moved) - turned) / step * friction
    current = run.current_a.copy()
    current[1:-1] += torque / FIVE_BAR.gains
    return replace(run, current_a=current)


def _between_rods(made: Made, cranks_rad: FloatArray) -> FloatArray:
    """Angle from the left rod to the right one, shape (k,)."""
    still = np.zeros_like(cranks_rad)
    joints = made.model.follow(Motion(cranks_rad, still, still)).joints
    names = [joint.name for joint in made.model.robot.joints]
    angle = dict(zip(names, joints.position_rad.T, strict=True))
    return np.asarray(
        angle["right-crank"] + angle["right-rod"] - angle["left-crank"] - angle["left-rod"]
    )


@pytest.fixture(scope="module")
def made() -> Made:
    return recorded(FIVE_BAR, 7, seconds=18.0, noise_a=0.01)


@pytest.fixture(scope="module")
def rubbing(made: Made) -> tuple[Run, Run]:
    bare, loaded = made.runs
    return _with_friction(made, bare), _with_friction(made, loaded)


@pytest.fixture(scope="module")
def calibration(made: Made, rubbing: tuple[Run, Run]) -> Calibration:
    identified = identify(made.model, rubbing, made.conditioning, keep_rows=True)
    steps = find_effects(gather(identified), np.random.default_rng(0), Gates(draws=199))
    return calibration_of(identified, AXES, FIVE_BAR.gains, steps=steps)


@pytest.mark.slow
def test_friction_of_a_cut_pivot_is_named_with_its_size(calibration: Calibration) -> None:
    (accepted,) = calibration.effects
    assert (accepted.name, accepted.axis) == ("passive-friction", PIVOT)
    dry, viscous = accepted.coefficients
    assert dry.value == pytest.approx(DRY_NM, abs=4.0 * dry.std)
    assert viscous.value == pytest.approx(VISCOUS_NM_S_RAD, abs=4.0 * viscous.std)


def test_a_calibration_with_a_pivot_is_the_same_from_its_file(
    made: Made, rubbing: tuple[Run, Run], calibration: Calibration, tmp_path: Path
) -> None:
    save_calibration(calibration, tmp_path / "calibration.yaml")
    loaded = load_calibration(tmp_path / "calibration.yaml")
    assert loaded.passive_joints == ("left-rod", "right-rod", PIVOT)
    assert (
        placed_effect(loaded.effects[0], loaded)[0]
        == placed_effect(calibration.effects[0], calibration)[0]
    )
    data = differentiate(rubbing[0], made.model.drive_train, made.conditioning)
    predicted = predict_torque(calibration, made.model, data)
    assert_allclose(predict_torque(loaded, made.model, data), predicted, rtol=1e-9)
    declared = tuple(one for one in loaded.parameters if "friction" not in one.name)
    without = replace(loaded, effects=(), parameters=declared, covariance_factor=None)
    assert np.abs(predict_torque(without, made.model, data) - predicted).max() > 0.5 * DRY_NM


def test_a_body_is_weighed_beside_the_friction_of_a_pivot(
    made: Made, rubbing: tuple[Run, Run], calibration: Calibration
) -> None:
    mass_kg = MOUNTED.known["m"]
    found = weigh(calibration, made.model, [rubbing[1]], made.conditioning)
    assert found.mass_kg == pytest.approx(mass_kg, rel=0.02)
