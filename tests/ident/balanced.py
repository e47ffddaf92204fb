"""Recordings of a heavy arm of six axes, with a balancer on its second joint or without one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml

from ident.arrays import FloatArray
from ident.data.conditioning import Conditioning
from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.model.bodies import Payload
from ident.model.model import DriveTrain, Model
from ident.model.urdf import robot_from_urdf
from ident.planning.excitation import nominal_links
from tests.ident.arms import CONFIGS
from tests.ident.recordings import positions

AXIS = 1
RATE_HZ = 250.0
FOOT_M = 0.69
LEVER_M = 0.185
TOWARDS_RAD = -1.45
STIFFNESS_N_M = 1e5
FREE_M = 0.405
GAINS = np.array([353.2, 344.5, 320.4, 196.1, 195.3, 137.6])
NOISE_A = np.array([0.34, 0.78, 0.58, 0.2, 0.22, 0.25])
FRICTION = np.array(
    [[118, 152, 88, 14, 15, 7.5], [260, 310, 205, 38, 36, 19], [290, 340, 240, 52, 48, 27]]
).T
CONDITIONING = Conditioning(standstill_rad_s=(0.02,) * 6)
MASS_KG = 269.4
CENTRE_M = np.array([0.43, 0.11, -0.12])
REACH_RAD = np.array([2.0, 1.1, 2.2, 3.0, 2.0, 3.0])
MIDDLE_RAD = np.array([0.0, -1.26, 0.3, 0.0, 0.0, 0.0])


def heavy_model() -> Model:
    """Six axes with the geometry and drive train of the shipped cell."""
    text = (CONFIGS / "cells/kr270.yaml").read_text(encoding="utf-8")
    document = yaml.safe_load(text)
    urdf = _urdf(CONFIGS / "robots/kr270.urdf")
    ratio = np.array(document["drive_train"]["ratio"], dtype=np.float64)
    return Model(
        robot_from_urdf(urdf),
        DriveTrain(ratio),
    )


def _urdf(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def _balance(q: FloatArray, free_m: float) -> FloatArray:
    """Slope of the energy k (s − s₀)²/2 of a spring from the foot to the end of the lever,
    by differences.
    """

    def energy(angle: FloatArray) -> FloatArray:
        cosine = np.cos(angle - TOWARDS_RAD)
        sine = np.sin(angle - TOWARDS_RAD)
        lever = np.array([cosine, sine]) * LEVER_M
        lever_difference = lever[0] - FOOT_M
        difference = np.hypot(lever_difference, lever[1]) - free_m
        return np.asarray(0.5 * STIFFNESS_N_M * difference**2)

    return (energy(q + 1e-5) - energy(q - 1e-5)) / 2e-5


def heavy_runs(balanced: bool, free_m: float = FREE_M) -> tuple[Run, ...]:
    """Two runs without load and two with, 12 s each; coloured noise that leaves some 3 %.

    Args:
        balanced: whether the second joint has a balancer.
        free_m: length of its spring without force.
    """
    model = heavy_model()
    rng = np.random.default_rng(1)
    urdf = _urdf(CONFIGS / "simulation/kr270-plant.urdf")
    links, _ = nominal_links(model.robot, urdf)
    parameters = np.zeros(len(model.columns))
    own = parameters[: 14 * 6].reshape(6, 14)
    own[:, :10], own[:, 10:13] = links, FRICTION
    centre_m_outer = np.outer(CENTRE_M, CENTRE_M)
    inertia = np.diag([17.0, 14.0, 15.0]) + MASS_KG * (
        CENTRE_M @ CENTRE_M * np.eye(3) - centre_m_outer
    )
    body = np.concatenate((inertia[np.triu_indices(3)], MASS_KG * CENTRE_M, [MASS_KG]))
    runs = []
    for number in range(4):
        if number % 2:
            payload = Payload("block", "a", {"m": MASS_KG})
        else:
            payload = None
        q = MIDDLE_RAD + positions(rng, 12.0, RATE_HZ, REACH_RAD)
        time_s = np.arange(len(q)) / RATE_HZ
        run = Run(f"run-{number}", time_s, q, np.zeros_like(q), payload)
        data = differentiate(run, model.drive_train, CONDITIONING)
        total = parameters.copy()
        total[model.flange] += body if payload else 0.0
        torque = model.torques(data.motion(), total)[2]
        if balanced:
            torque[AXIS] += _balance(data.position_rad[:, AXIS], free_m)
        else:
            torque[AXIS] += 0.0
        current = np.zeros_like(q)
        current[1:-1] = ((model.drive_train.to_motor @ torque) / GAINS[:, None]).T
        noise = rng.standard_normal(current.shape) * NOISE_A
        stays = np.exp(-1.0 / (RATE_HZ * 0.005))
        for k in range(1, len(noise)):
            noise[k] = stays * noise[k - 1] + np.sqrt(1.0 - stays**2) * noise[k]
        current_a = current + noise
        runs.append(Run(run.name, run.time_s, q, current_a, payload))
    return tuple(runs)
