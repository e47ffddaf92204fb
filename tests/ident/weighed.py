"""Cells whose flange carries a body of known parameters, for the tests of weighing and its study:
numpy alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import signal

from ident.calibration import Calibration
from ident.data.conditioning import Conditioning
from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.discovery.evidence import gather, with_effects
from ident.effects.effect import PlacedEffect
from ident.effects.friction import LoadFriction
from ident.estimators.identify import identify
from ident.model.bodies import LINK_PARAMETERS, Body
from tests.ident.recordings import MOUNTED, PAYLOAD_TRUTH, FloatArray, Truth, calibrated, record

RATE_HZ = 250.0
AXIS = 1  #: Of the load friction, from 0
COEFFICIENT = 0.12
#: Of a row, as a share of the motor's rms current; lag one is 0.67, as on real recordings
NOISE = 0.04
CORRELATION_S = 0.05
DISC = np.array([PAYLOAD_TRUTH[name] for name in LINK_PARAMETERS])


@dataclass(frozen=True)
class WeighedCell:
    """A calibration, a run with an unknown body, one without, and what the body is."""

    calibration: Calibration
    conditioning: Conditioning
    loaded: Run
    bare: Run
    body: FloatArray  #: its ten parameters


def weighed_cell(
    truth: Truth, seed: int, *, seconds: float = 24.0, mass_factor: float = 1.0
) -> WeighedCell:
    """Calibrate a cell with load friction from four runs,
    then record it with a body that is drawn anew.

    Args:
        truth: of the robot.
        seed: of noise, motions and body.
        seconds: of each run.
        mass_factor: of the mass that the calibration takes as known, against the true one.
    """
    rng = np.random.default_rng(seed)
    standstill_rad_s = (0.03,) * len(truth.gains)
    conditioning = Conditioning(standstill_rad_s=standstill_rad_s)
    known = {"m": mass_factor * MOUNTED.known["m"]}
    entered = replace(MOUNTED, known=known)
    runs = []
    for index in range(4):
        run = noisy_run(truth, f"run{index}", rng, DISC if index % 2 else None, seconds)
        changed_run = replace(run, payload=entered if index % 2 else None)
        runs.append(changed_run)
    evidence = gather(identify(truth.model, runs, conditioning), runs)
    effects = (PlacedEffect(LoadFriction(0), AXIS),)
    calibration = calibrated(with_effects(evidence, effects))
    body = a_body(rng)
    loaded = noisy_run(truth, "unknown", rng, body, seconds)
    bare = noisy_run(truth, "empty", rng, None, seconds)
    return WeighedCell(
        calibration,
        conditioning,
        loaded,
        bare,
        body,
    )


def a_body(rng: np.random.Generator) -> FloatArray:
    """One to six kilograms within a decimetre of the flange."""
    mass = rng.uniform(1.0, 6.0)
    centre_m = rng.uniform(-0.1, 0.1, 3)
    diagonal = np.diag(rng.uniform(0.002, 0.004, 3))
    inertia_kg_m2 = mass * diagonal
    return Body(mass, centre_m, inertia_kg_m2).parameters


def noisy_run(
    truth: Truth, name: str, rng: np.random.Generator, body: FloatArray | None, seconds: float
) -> Run:
    """A run with any body, load friction on AXIS and noise of the current;
    it does not say what it carries.
    """
    mounted = truth.parameters.copy()
    mounted[truth.model.flange] += 0.0 if body is None else body
    changed_truth = replace(truth, parameters=mounted)
    run = record(changed_truth, name, rng, seconds=seconds, rate_hz=RATE_HZ)
    position_cutoff_hz = 0.3 * RATE_HZ
    conditioning = Conditioning(position_cutoff_hz=position_cutoff_hz)
    data = differentiate(run, truth.model.drive_train, conditioning)
    load = truth.model.torques(data.motion(), mounted)[0][AXIS]
    velocity_sign = np.sign(data.velocity_rad_s[:, AXIS])
    torque = COEFFICIENT * np.abs(load) * velocity_sign
    current = run.current_a.copy()
    current[1:-1] += np.outer(torque, truth.model.drive_train.to_motor[:, AXIS] / truth.gains)
    current_a = current + coloured(rng, current.shape) * NOISE * np.sqrt(
        np.mean(current**2, axis=0)
    )
    return replace(
        run,
        current_a=current_a,
    )


def coloured(rng: np.random.Generator, shape: tuple[int, ...]) -> FloatArray:
    """Noise of deviation one with CORRELATION_S, time first."""
    keep = np.exp(-1.0 / (CORRELATION_S * RATE_HZ))
    return np.asarray(
        signal.lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], rng.standard_normal(shape), axis=0)
    )
