"""Recordings that obey the declared model exactly, made by its own regressor: what an estimator must give back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from ident.conditioning import Conditioning
from ident.dataset import differentiate
from ident.drive_train import DriveTrain
from ident.identify import identify
from ident.link import LINK_PARAMETERS
from ident.loop import Evidence, gather
from ident.model import Model
from ident.payload import Payload
from ident.robot import robot_from_urdf
from ident.run import Run
from tests.ident.arms import TX40

FloatArray = NDArray[np.float64]

RATIO = np.diag([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])
RATIO[5, 4] = 32.0
GAINS = np.array([33.9, 32.4, 24.2, -9.21, 16.3, 6.79])
PAYLOAD_TRUTH = dict(
    zip(LINK_PARAMETERS, (0.08, -0.012, 0.022, 0.082, 0.032, 0.052, -0.24, -0.25, 0.39, 4.59), strict=True)
)
MOUNTED = Payload("disc", "a", {"m": 4.59})
CONDITIONING = Conditioning(standstill_rad_s=(0.03,) * 6)


@dataclass(frozen=True)
class Truth:
    """A robot whose every parameter is known to the test."""

    model: Model
    parameters: FloatArray
    gains: FloatArray


def tx40_truth(seed: int = 0) -> Truth:
    """The TX-40-like arm with friction of the paper's size."""
    model = Model(robot_from_urdf(TX40.urdf), DriveTrain(RATIO))
    rng = np.random.default_rng(seed)
    masses = (10.0, 3.7, 4.1, 3.4, 1.0, 0.2)
    parameters = np.zeros(len(model.columns))
    friction = (
        (0.35, 7.0, 5.5),
        (0.35, 4.4, 7.7),
        (0.08, 1.6, 6.3),
        (0.027, 0.7, 1.9),
        (0.05, 1.1, 2.6),
        (0.01, 0.25, 0.6),
    )
    for joint, (mass, drive) in enumerate(zip(masses, friction, strict=True)):
        centre = rng.uniform(-0.1, 0.1, 3)
        inertia = mass * (np.eye(3) * (0.05**2 + centre @ centre) - np.outer(centre, centre))
        parameters[14 * joint : 14 * joint + 6] = inertia[np.triu_indices(3)]
        parameters[14 * joint + 6 : 14 * joint + 9] = mass * centre
        parameters[14 * joint + 9] = mass
        parameters[14 * joint + 10 : 14 * joint + 13] = drive
        parameters[14 * joint + 13] = rng.uniform(-0.3, 0.3)
    parameters[-3:] = (0.0104, 0.47, 1.7)
    return Truth(model, parameters, GAINS)


def positions(rng: np.random.Generator, seconds: float, rate_hz: float, limits: FloatArray) -> FloatArray:
    """Point-to-point moves with smooth ramps and no dwell, shape (k, n)."""
    count = round(seconds * rate_hz)
    knots = rng.uniform(-1.0, 1.0, (round(seconds / 1.1) + 2, len(limits))) * limits
    stairs = np.repeat(knots, round(1.1 * rate_hz), axis=0)[:count]
    window = np.hanning(round(0.9 * rate_hz))
    padded = np.concatenate(
        (np.repeat(stairs[:1], len(window), axis=0), stairs, np.repeat(stairs[-1:], len(window), axis=0))
    )
    return np.asarray(signal.fftconvolve(padded, (window / window.sum())[:, None], mode="same", axes=0))[
        len(window) : len(window) + count
    ]


def record(
    truth: Truth,
    name: str,
    rng: np.random.Generator,
    payload: Payload | None = None,
    *,
    seconds: float = 20.0,
    noise_a: float = 0.0,
    rate_hz: float = 1000.0,
) -> Run:
    """One run: the current is what the model needs for the motion, plus noise on the current alone."""
    count = len(truth.gains)
    limits = np.array([2.5, 1.8, 2.2, 3.0, 1.8, 3.0, 2.0][:count])
    q = positions(rng, seconds, rate_hz, limits)
    time = np.arange(len(q)) / rate_hz
    bare = Run(name, time, q, np.zeros_like(q))
    # The recorded positions are band-limited far below this cut-off, so these derivatives are the motion's own.
    data = differentiate(bare, truth.model.drive_train, Conditioning(position_cutoff_hz=0.3 * rate_hz))
    columns = truth.model.regressor(data.motion())
    parameters = truth.parameters.copy()
    if payload is not None:
        parameters[truth.model.flange] += [PAYLOAD_TRUTH[p] for p in LINK_PARAMETERS]
    torque = np.einsum("jck,c->jk", columns, parameters)
    current = np.zeros_like(q)
    current[1:-1] = ((truth.model.drive_train.to_motor @ torque) / truth.gains[:, None]).T
    current += noise_a * rng.standard_normal(current.shape)
    return Run(name, time, q, current, payload)


def gathered(truth: Truth, runs: tuple[Run, ...], holdout: tuple[Run, ...] = ()) -> Evidence:
    """Identified by ``ml``, with its rows."""
    return gather(identify(truth.model, runs, CONDITIONING, holdout=holdout), runs, holdout)
