"""Derivatives of known motions, and recordings that must be refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ident.data.conditioning import Conditioning
from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.errors import DataUnfit, ModelError
from ident.model.model import DriveTrain

TRAIN = DriveTrain(np.array([[10.0, 0.0], [10.0, 10.0]]))


def _run(seconds: float = 4.0, rate_hz: float = 1000.0) -> Run:
    time = np.arange(round(seconds * rate_hz)) / rate_hz
    position = np.stack((np.sin(2 * np.pi * time), np.cos(2 * np.pi * 0.5 * time)), axis=1)
    current_a = np.zeros_like(position)
    return Run("sines", time, position, current_a)


def test_derivatives_of_slow_sines_are_the_sines_own() -> None:
    data = differentiate(_run(), TRAIN, Conditioning(standstill_rad_s=(0.1, 0.1)))
    middle = slice(500, -500)
    w = 2 * np.pi
    assert data.velocity_rad_s[middle, 0] == pytest.approx(
        w * np.cos(w * data.time_s[middle]), abs=2e-3 * w
    )
    assert data.acceleration_rad_s2[middle, 0] == pytest.approx(
        -(w**2) * np.sin(w * data.time_s[middle]), abs=2e-3 * w**2
    )
    absolute_velocity_rad_s = np.abs(data.velocity_rad_s)
    assert np.array_equal(data.moving, absolute_velocity_rad_s >= 0.1)
    assert np.array_equal(data.motor_moving[:, 1], np.abs(data.velocity_rad_s.sum(axis=1)) >= 0.1)


def test_moves_part_where_all_joints_rest() -> None:
    run = _run()
    still = np.repeat(run.position_rad[-1:], 500, axis=0)
    position = np.concatenate((run.position_rad, still, run.position_rad[::-1]))
    time_s = np.arange(len(position)) / 1000.0
    current_a = np.zeros_like(position)
    longer = Run("twice", time_s, position, current_a)
    conditioning = Conditioning(standstill_rad_s=(0.05, 0.05))
    data = differentiate(longer, TRAIN, conditioning)
    assert data.move[0] != data.move[-1]
    move_steps = np.diff(data.move)
    assert np.all(move_steps >= 0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda run: replace(run, current_a=run.current_a[:, :1]), "one column per axis"),
        (
            lambda run: replace(
                run, position_rad=np.where(run.time_s[:, None] == 1.0, np.nan, run.position_rad)
            ),
            "sample 1000",
        ),
        (
            lambda run: replace(run, time_s=np.delete(np.arange(len(run.time_s) + 1) / 1000.0, 9)),
            r"not uniform: a step of 0\.002 s after sample 8 \(0\.008 s\), where the usual one is "
            r"0\.001 s; expected steps of one length, .*; resample .* or cut the run at the gap",
        ),
        (
            lambda run: replace(run, time_s=np.where(run.time_s > 1.0, -1.0, 1.0) * run.time_s),
            r"does not rise from sample 1000 \(1 s\) to the next one \(-1\.001 s\); expected",
        ),
        (
            lambda run: replace(
                run,
                time_s=run.time_s[:2],
                position_rad=run.position_rad[:2],
                current_a=run.current_a[:2],
            ),
            "found 2 samples; expected at least 2 s of motion; record longer",
        ),
        (
            lambda run: replace(run, temperature_c=np.full(run.position_rad.shape, 300.0)),
            "found a temperature_c of 300 in sample 0, motor 1; expected -60 to 250 °C, .*kelvin",
        ),
        (lambda _: _run(seconds=1.0), "at least 2 s"),
        (lambda _: _run(seconds=9.0, rate_hz=80.0), "needs more than 100 Hz"),
    ],
)
def test_bad_recordings_are_named(change: object, message: str) -> None:
    assert callable(change)
    with pytest.raises(DataUnfit, match=message) as caught:
        differentiate(change(_run()), TRAIN, Conditioning())
    assert caught.value.run == "sines"


def test_a_drive_train_must_be_invertible() -> None:
    ratio = np.array([[1.0, 1.0], [1.0, 1.0]])
    with pytest.raises(ModelError, match="invertible"):
        DriveTrain(ratio)
