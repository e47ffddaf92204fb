"""Numbers that no robot has, in a planned motion, a run, a payload and a calibration:
each is refused by its name, and none gives a warning of numpy, a NaN or an error of numpy.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import ident
from ident.arrays import FloatArray
from ident.model.bodies import LINK_PARAMETERS
from tests.ident.recordings import MOUNTED, Truth, record

RATE_HZ = 100.0
SAMPLES = 200
PARTS = ("position_rad", "velocity_rad_s", "acceleration_rad_s2")
TOO_LARGE = [1e31, -1e200, 1e308]
BEYOND = [*TOO_LARGE, np.nan, np.inf, 10**400]


@pytest.fixture(scope="module")
def runs(small_truth: Truth) -> tuple[ident.Run, ident.Run]:
    """A run without load and one with, long enough for a fit."""
    rng = np.random.default_rng(7)
    bare = record(small_truth, "bare", rng, None)
    loaded = record(small_truth, "loaded", rng, MOUNTED)
    return bare, loaded


@pytest.fixture(scope="module")
def found(small_truth: Truth, runs: tuple[ident.Run, ident.Run]) -> ident.Identification:
    """Their identification."""
    return ident.identify(small_truth.model, runs)


@pytest.fixture(scope="module")
def calibration(found: ident.Identification) -> ident.Calibration:
    """Their calibration."""
    gains = found.estimate.gains
    return ident.calibration_of(found, ("J1", "J2", "J3"), gains)


def _motion() -> dict[str, FloatArray]:
    """A slow swing of three axes."""
    angle = np.arange(SAMPLES)[:, None] / RATE_HZ + np.arange(3)
    return {
        "position_rad": np.sin(angle),
        "velocity_rad_s": np.cos(angle),
        "acceleration_rad_s2": -np.sin(angle),
    }


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("value", TOO_LARGE)
def test_a_planned_motion_beyond_every_number_is_refused(part: str, value: float) -> None:
    """A velocity of 1e200 rad/s was predicted to need NaN amperes."""
    arrays = _motion()
    arrays[part][7, 1] = value
    with pytest.raises(ident.DataUnfit, match=rf"{part} has .* in sample 7, axis 2; expected at"):
        ident.planned(ident.Motion(**arrays), RATE_HZ)


def test_a_planned_motion_without_a_sample_is_refused() -> None:
    empty = {part: np.zeros((0, 3)) for part in PARTS}
    with pytest.raises(ident.DataUnfit, match=r"found no sample; expected one or more"):
        ident.planned(ident.Motion(**empty), RATE_HZ)


@pytest.mark.parametrize("rate_hz", [5e-324, 1e308, 10**400])
def test_a_rate_beyond_every_number_is_refused(rate_hz: float) -> None:
    with pytest.raises(ident.ModelError, match=r"rate_hz is .*; expected a finite number above 0"):
        ident.planned(ident.Motion(**_motion()), rate_hz)


@pytest.mark.parametrize("value", BEYOND)
def test_a_payload_beyond_every_number_is_refused(value: float) -> None:
    with pytest.raises(ident.ModelError, match=r"payload 'disc' has m = .*; expected .*numbers"):
        ident.Payload("disc", mounting="flange", known={"m": value})
    whole = dict.fromkeys(LINK_PARAMETERS, 0.0) | dict.fromkeys(("Ixx", "Iyy", "Izz", "m"), value)
    with pytest.raises(ident.ModelError, match=r"payload 'disc' has Ixx = .*; expected .*numbers"):
        ident.Payload("disc", mounting="flange", known=whole)
    with pytest.raises(ident.ModelError, match=r"a mass tolerance of .* kg; expected zero or more"):
        ident.Payload("disc", mounting="flange", mass_tolerance_kg=value)


Use = Callable[[ident.Calibration, ident.Model, ident.Run], object]
USES: dict[str, Use] = {
    "predict_torque": lambda known, model, run: ident.predict_torque(
        known, model, ident.planned(ident.Motion(**_motion()), RATE_HZ)
    ),
    "measured_torque": lambda known, model, run: ident.measured_torque(
        known, model, np.ones((5, 3))
    ),
    "external_torque": ident.external_torque,
    "prediction_band": lambda known, model, run: ident.prediction_band(known, model, [run]),
    "weigh": lambda known, model, run: ident.weigh(known, model, [run]),
}


@pytest.mark.parametrize("use", USES.values(), ids=USES)
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e308])
@pytest.mark.parametrize("kind", ["gain", "parameter"])
def test_a_calibration_with_numbers_that_predict_none_is_refused(
    use: Use,
    value: float,
    kind: str,
    calibration: ident.Calibration,
    small_truth: Truth,
    runs: tuple[ident.Run, ident.Run],
) -> None:
    """It was an error of numpy: "SVD did not converge", "must not contain infs or NaNs"."""
    if kind == "gain":
        gain, *other_gains = calibration.gains
        changed = replace(calibration, gains=(replace(gain, value=value), *other_gains))
    else:
        parameter, *others = calibration.parameters
        changed = replace(calibration, parameters=(replace(parameter, value=value), *others))
    words = re.escape(f" {value:g}; expected a number of a fit")
    with pytest.raises(ident.ModelError, match=rf"has the {kind} .*{words}"):
        use(changed, small_truth.model, runs[0])


def test_a_gain_of_zero_is_refused(calibration: ident.Calibration, small_truth: Truth) -> None:
    gain, *others = calibration.gains
    changed = replace(calibration, gains=(replace(gain, value=0.0), *others))
    with pytest.raises(
        ident.ModelError, match=r"has the gain of J1 0; expected .* no gain of zero"
    ):
        ident.measured_torque(changed, small_truth.model, np.ones((5, 3)))


@pytest.mark.parametrize("value", TOO_LARGE)
def test_a_run_beyond_every_number_is_refused(
    value: float,
    calibration: ident.Calibration,
    small_truth: Truth,
    runs: tuple[ident.Run, ident.Run],
) -> None:
    position = runs[0].position_rad.copy()
    position[7, 1] = value
    changed = replace(runs[0], position_rad=position)
    with pytest.raises(ident.DataUnfit, match=r"position_rad has .* in sample 7, axis 2; expected"):
        ident.external_torque(calibration, small_truth.model, changed)
    current = np.ones((5, 3))
    current[2, 1] = value
    with pytest.raises(ident.ModelError, match=r"current_a has .* in sample 2, axis 2; expected"):
        ident.measured_torque(calibration, small_truth.model, current)


@pytest.mark.parametrize("alarms", [5e-324, 1e-200, 1e308, 10**400])
def test_a_rate_of_alarms_beyond_every_number_is_refused(
    alarms: float,
    calibration: ident.Calibration,
    small_truth: Truth,
    runs: tuple[ident.Run, ident.Run],
) -> None:
    with pytest.raises(ident.ModelError, match=r"alarms_per_hour is .*; expected a finite number"):
        ident.prediction_band(calibration, small_truth.model, runs[:1], alarms_per_hour=alarms)
