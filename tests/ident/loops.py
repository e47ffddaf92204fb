"""Recordings of a cell whose disturbance goes round its position loop:
it moves the arm and returns in the current.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from ident.data.conditioning import Conditioning
from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.model.bodies import LINK_PARAMETERS, Payload
from tests.ident.recordings import PAYLOAD_TRUTH, Truth, record

FloatArray = NDArray[np.float64]
LOOP_HZ, DAMPING = 4.0, 0.7  #: of each joint's closed position loop
CORRELATION_S = 0.02  #: of the disturbance
AVERAGED = 4  #: Samples of 1 kHz that become one
INERTIA_KG_M2 = 0.5  #: that the disturbance moves, the same at every joint


def record_in_loop(
    truth: Truth,
    name: str,
    rng: np.random.Generator,
    payload: Payload | None = None,
    *,
    disturbance_nm: float,
    seconds: float = 20.0,
) -> Run:
    """One run: I δq̈ + 2 D ω I δq̇ + ω² I δq = −d moves every joint off its demand,
    and g v = τ(q + δq) + d.

    The currents obey the declared model for the recorded motion, with the error d; but that motion
    has seen d. It is made at 1 kHz, and each sample of the run is the mean of four.
    """
    asked = record(truth, name, rng, payload, seconds=seconds, averaged=1)
    rate_hz = asked.rate_hz
    count = len(truth.gains)
    memory = np.exp(-1.0 / (rate_hz * CORRELATION_S))
    white = (
        rng.standard_normal((len(asked.time_s), count)) * disturbance_nm * np.sqrt(1.0 - memory**2)
    )
    disturbance = signal.lfilter([1.0], [1.0, -memory], white, axis=0)
    omega = 2.0 * np.pi * LOOP_HZ
    moved = signal.cont2discrete(
        (np.array([-1.0 / INERTIA_KG_M2]), np.array([1.0, 2.0 * DAMPING * omega, omega**2])),
        1.0 / rate_hz,
    )
    off = signal.lfilter(moved[0].ravel(), moved[1], disturbance, axis=0)
    q = asked.position_rad + off
    position_cutoff_hz = 0.3 * rate_hz
    conditioning = Conditioning(position_cutoff_hz=position_cutoff_hz)
    run = replace(asked, position_rad=q)
    data = differentiate(
        run,
        truth.model.drive_train,
        conditioning,
    )
    parameters = truth.parameters.copy()
    if payload is not None:
        parameters[truth.model.flange] += [PAYLOAD_TRUTH[p] for p in LINK_PARAMETERS]
    torque = (
        np.einsum("jck,c->jk", truth.model.regressor(data.motion()), parameters)
        + disturbance[1:-1].T
    )
    current = np.zeros_like(q)
    to_motor = truth.model.drive_train.to_motor
    current[1:-1] = ((to_motor @ torque) / truth.gains[:, None]).T
    samples = len(q) // AVERAGED * AVERAGED
    q, current = (one[:samples].reshape(-1, AVERAGED, count).mean(axis=1) for one in (q, current))
    return replace(asked, time_s=asked.time_s[:samples:AVERAGED], position_rad=q, current_a=current)
