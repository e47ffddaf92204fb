"""Recordings of closed chains that obey the declared model exactly:
what an estimator must give back.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ident.data.conditioning import Conditioning
from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.model.bodies import Payload
from ident.model.model import Model
from tests.ident.mechanisms import FIVE_BAR, PLANAR, Mechanism, leg_angles
from tests.ident.recordings import positions

FloatArray = NDArray[np.float64]
RATE_HZ = 250.0  #: At which moves and noise are drawn
AVERAGED = 2  #: Drawn samples that become one of a run
MOUNTED = Payload("body", "a", {"m": 2.0})


@dataclass(frozen=True)
class Made:
    """Runs without and with the payload, and what they were made of."""

    model: Model
    conditioning: Conditioning
    runs: tuple[Run, Run]
    standard: FloatArray
    payload: FloatArray


def _body(rng: np.random.Generator, mass: float) -> FloatArray:
    centre = rng.uniform(-0.05, 0.05, 3)
    centre_outer = np.outer(centre, centre)
    inertia = mass * (np.eye(3) * (0.06**2 + centre @ centre) - centre_outer)
    return np.concatenate((inertia[np.triu_indices(3)], mass * centre, [mass]))


def axis_positions(
    mechanism: Mechanism, rng: np.random.Generator, seconds: float, share: float = 1.0
) -> FloatArray:
    """Positions of the motors that the closures allow, around the assembly pose, shape (k, m),
    in a share of all.
    """
    robot = mechanism.robot
    position_rad = mechanism.model.assembly.position_rad
    home = position_rad[list(robot.axis_joints)]
    if mechanism is not PLANAR:
        reach = np.full(robot.axis_count, 0.6 if mechanism is FIVE_BAR else 0.06)
        return home + share * positions(rng, seconds, RATE_HZ, reach)
    limits = np.array([0.08, 0.08, 0.4])
    pose = share * positions(rng, seconds, RATE_HZ, limits)
    motors = np.stack([leg_angles(pose, leg)[0] for leg in range(4)], axis=1)
    home_difference = home - motors[0]
    return np.asarray(motors + 2.0 * np.pi * np.round(home_difference / (2.0 * np.pi)))


def preload_of(
    model: Model, to_motors: FloatArray, time_s: FloatArray, size_nm: float
) -> FloatArray:
    """Torques of the motors that work against each other, shape (k, m):
    zero of a robot that is not redundant.
    """
    samples, count, free = to_motors.shape
    out = np.zeros((samples, count))
    whole, _ = np.linalg.qr(to_motors, mode="complete")
    for number in range(count - free):
        way = whole[:, :, free + number]
        way = way * np.sign(np.einsum("km,m->k", way, way[0]))[:, None]
        out += size_nm * (0.5 + np.sin((1.7 + number) * time_s))[:, None] * way
    assert model.is_redundant == (count > free)
    return out


@cache
def recorded(
    mechanism: Mechanism,
    seed: int = 4,
    *,
    seconds: float = 10.0,
    noise_a: float = 0.0,
    preload_nm: float = 0.3,
    share: float = 1.0,
) -> Made:
    """A run without load and one with 2 kg on the platform,
    in a share of the workspace around its middle.
    """
    model = mechanism.model
    rng = np.random.default_rng(0)
    standard = np.zeros(len(model.columns))
    for columns in model.link_columns:
        mass = rng.uniform(0.3, 1.5)
        standard[columns] = _body(rng, mass)
    for joint in model.robot.axis_joints:
        standard[14 * joint + 10 : 14 * joint + 14] = 0.02, 0.3, 0.4, 0.05
    payload = _body(rng, 2.0)
    standstill_rad_s = (0.02,) * model.robot.axis_count
    conditioning = Conditioning(standstill_rad_s=standstill_rad_s)
    rng = np.random.default_rng(seed)
    runs = []
    for mounted in (None, MOUNTED):
        drawn = axis_positions(mechanism, rng, seconds, share)
        q = drawn[::AVERAGED]
        time_s = np.asarray(np.arange(len(q)) * (AVERAGED / RATE_HZ), dtype=np.float64)
        current_a = np.zeros_like(q)
        run = Run("loaded" if mounted else "bare", time_s, q, current_a, mounted)
        data = differentiate(run, model.drive_train, conditioning)
        whole = standard.copy()
        if mounted is not None:
            whole[model.flange] += payload
        torque = np.einsum("mck,c->km", model.regressor(data.motion()), whole)
        to_motors = model.follow(data.motion()).to_motors
        preload = preload_of(model, to_motors, data.time_s, preload_nm)
        torque = torque + preload
        noise = noise_a * rng.standard_normal(drawn.shape)
        current = np.add.reduceat(noise, np.arange(0, len(noise), AVERAGED)) / AVERAGED
        current[1:-1] += torque / mechanism.gains
        runs.append(replace(run, current_a=current))
    return Made(model, conditioning, (runs[0], runs[1]), standard, payload)
