"""External torque: a push is found, quiet motion raises no alarm,
and the band is as wide as the residual.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal, stats

from ident.calibration import Calibration, Parameter
from ident.contact import (
    PREDICTED_SHARE,
    SCALE_MARGIN,
    alarm_level,
    external_torque,
    prediction_band,
)
from ident.data.conditioning import Conditioning
from ident.data.run import Run
from ident.errors import DataUnfit
from tests.ident.recordings import FloatArray, Truth, a_calibration, record
from tests.ident.weighed import RATE_HZ, coloured

PUSHED = 1
START_S = 12.0
END_S = 12.6
CONDITIONING = Conditioning(standstill_rad_s=(0.03,) * 3)


@pytest.fixture(scope="module")
def calibration(small_truth: Truth) -> Calibration:
    """Exact: what is left is the noise alone."""
    columns = zip(small_truth.model.columns, small_truth.parameters, strict=True)
    parameters = tuple(Parameter(one.name, float(v), 0.0, one.unit) for one, v in columns)
    return a_calibration(small_truth.gains, parameters)


@pytest.fixture(scope="module")
def runs(small_truth: Truth) -> tuple[Run, ...]:
    """Three quiet runs; the noise of J1 grows with its speed, that of the others is even."""
    rng = np.random.default_rng(8)
    out = []
    for name in ("first", "second", "watched"):
        run = record(small_truth, name, rng, seconds=40.0, rate_hz=RATE_HZ)
        position_rad_gradient = np.gradient(run.position_rad[:, 0])
        speed = np.abs(position_rad_gradient) * RATE_HZ
        noise = 0.1 * coloured(rng, run.current_a.shape)
        noise[:, 0] *= 0.2 + speed
        current_a = run.current_a + noise
        out.append(replace(run, current_a=current_a))
    return tuple(out)


def _pushed(truth: Truth, run: Run, torque_nm: float) -> Run:
    hit = (run.time_s >= START_S) & (run.time_s < END_S)
    current = run.current_a.copy()
    current[hit] += torque_nm * truth.model.drive_train.to_motor[:, PUSHED] / truth.gains
    return replace(run, current_a=current)


@pytest.mark.parametrize("learned_elsewhere", [True, False])
def test_a_push_is_found_where_and_when_it_was(
    small_truth: Truth, calibration: Calibration, runs: tuple[Run, ...], learned_elsewhere: bool
) -> None:
    model = small_truth.model
    if learned_elsewhere:
        band = prediction_band(calibration, model, runs[:2], CONDITIONING)
    else:
        band = None
    quiet = external_torque(calibration, model, runs[2], CONDITIONING, band)
    assert quiet.contacts == ()
    median_threshold_nm = np.median(quiet.threshold_nm[PUSHED])
    torque_nm = -3.0 * float(median_threshold_nm)
    run = _pushed(small_truth, runs[2], torque_nm)
    found = external_torque(calibration, model, run, CONDITIONING, band)
    (contact,) = found.contacts
    assert contact.axis == PUSHED
    assert contact.start_s == pytest.approx(START_S, abs=0.1)
    assert START_S + 0.3 < contact.end_s < END_S + 0.1  # the joint rests before the push ends
    assert contact.peak_nm == pytest.approx(torque_nm, rel=0.35)
    assert found.from_itself is not learned_elsewhere
    assert (found.left_out > 0) is not learned_elsewhere


def test_the_band_holds_its_share_and_follows_what_drives_the_residual(
    small_truth: Truth, calibration: Calibration, runs: tuple[Run, ...]
) -> None:
    band = prediction_band(calibration, small_truth.model, runs[:2], CONDITIONING)
    watched = external_torque(calibration, small_truth.model, runs[2], CONDITIONING, band)
    absolute_torque_nm = np.abs(watched.torque_nm)
    inside = absolute_torque_nm <= watched.band_nm
    for joint, use in enumerate(watched.use):
        mean_inside = inside[joint, use].mean()
        assert mean_inside == pytest.approx(PREDICTED_SHARE, abs=0.03)
    constant, _, speed, _ = band.scale[0]
    assert constant == pytest.approx(0.2 * speed, rel=0.6)  # as 0.2 + |q̇| was planted
    assert band.correlation_s == pytest.approx(np.full(3, 0.05), abs=0.03)


@pytest.mark.parametrize("kind", ["normal", "laplace"])
def test_the_level_is_crossed_less_often_than_allowed(kind: str) -> None:
    """Two minutes foretell five hours; and the level is no higher than three times what those hours
    hold.
    """
    rng = np.random.default_rng(4)

    def drawn(count: int) -> FloatArray:
        white = getattr(rng, kind)(size=count)
        return np.abs(signal.lfilter([1.0], [1.0, -0.67], white))

    seen = drawn(6000)
    later = drawn(900_000)
    time_s: FloatArray = np.arange(len(seen)) * np.float64(0.02)
    level = alarm_level(seen, time_s, 0.1, 1.0, 120.0)
    assert level is not None
    beyond = np.flatnonzero(later > level)
    beyond_steps = np.diff(beyond, prepend=-100)
    assert np.count_nonzero(beyond_steps > 5) <= 5
    assert level < 3.0 * np.sort(later)[-20]
    often = alarm_level(seen, time_s, 0.1, 60.0, 120.0)
    assert often is not None
    assert often < level


def test_a_heavy_tail_has_fewer_alarms_than_allowed_on_average() -> None:
    """Student's t with five degrees of freedom, later 15 % larger;
    independent rows have an exact rate.
    """
    rng = np.random.default_rng(2001)
    seconds = 300.0
    rows_an_hour = 72_000
    time_s: FloatArray = np.arange(round(seconds / 0.05)) * np.float64(0.05)
    rates = []
    for _ in range(30):
        seen = np.abs(rng.standard_t(5.0, size=len(time_s)))
        level = alarm_level(seen, time_s, 0.04, 1.0, seconds)
        assert level is not None
        rates.append(rows_an_hour * 2.0 * float(stats.t.sf(level / SCALE_MARGIN, 5.0)))
    assert np.mean(rates) < 1.0
    assert np.mean(rates) > 0.01  # a level that nothing reaches would find nothing


def test_too_little_quiet_motion_gives_no_threshold(
    small_truth: Truth, calibration: Calibration, runs: tuple[Run, ...]
) -> None:
    ratio = np.ones(50)
    time_s = np.arange(50.0)
    assert alarm_level(ratio, time_s, 1.0, 1.0, 50.0) is None
    end = round(2.5 * RATE_HZ)
    arrays = ("time_s", "position_rad", "current_a")
    short = replace(runs[0], **{name: getattr(runs[0], name)[:end] for name in arrays})
    found = external_torque(calibration, small_truth.model, short, CONDITIONING)
    assert np.isnan(found.band.threshold).all()
    assert found.contacts == ()
    with pytest.raises(DataUnfit, match="no quiet run"):
        prediction_band(calibration, small_truth.model, [], CONDITIONING)
    position_rad = np.zeros_like(short.position_rad)
    still = replace(short, position_rad=position_rad)
    with pytest.raises(DataUnfit, match="did the robot move"):
        external_torque(calibration, small_truth.model, still, CONDITIONING)
