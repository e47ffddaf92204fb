"""Small recordings of an arm of three axes, right and with one mistake each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ident.data.run import Run
from ident.errors import Diagnosis
from ident.estimators.diagnosis import diagnose
from ident.estimators.identify import identify
from ident.estimators.method import Method
from ident.model.bodies import LINK_PARAMETERS, link_parameters, pseudo_inertia
from tests.ident.recordings import CONDITIONING, MOUNTED, PAYLOAD_TRUTH, FloatArray, Truth, record

AXES = ("J1", "J2", "J3")
SMALL = replace(CONDITIONING, standstill_rad_s=(0.03,) * 3)
BODY = np.array([PAYLOAD_TRUTH[name] for name in LINK_PARAMETERS])


def turned(angle_rad: float) -> FloatArray:
    """The payload after a turn about the flange's axis, shape (10,)."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec((0.0, 0.0, angle_rad)).as_matrix()
    pseudo = turn @ pseudo_inertia(BODY) @ turn.T
    return link_parameters(pseudo)


def small_recordings(
    truth: Truth,
    seed: int,
    *,
    count: int = 4,
    bodies: dict[int, FloatArray] | None = None,
    seconds: float = 16.0,
    noise_a: float = 0.1,
) -> list[Run]:
    """Runs r0, r1 …, every other one loaded.

    Args:
        truth: of three axes.
        seed: of the moves and the noise.
        count: of runs.
        bodies: what a run carries in place of what it says, shape (10,); zero for nothing.
        seconds, noise_a: of each run.
    """
    rng = np.random.default_rng(seed)
    runs = list[Run]()
    carried = bodies or {}
    for index in range(count):
        parameters = truth.parameters.copy()
        if index in carried:
            parameters[truth.model.flange] += carried[index] - (BODY if index % 2 else 0.0)
        payload = MOUNTED if index % 2 else None
        planted = replace(truth, parameters=parameters)
        runs.append(
            record(
                planted, f"r{index}", rng, payload, seconds=seconds, noise_a=noise_a, rate_hz=200.0
            )
        )
    return runs


def with_currents(
    runs: Sequence[Run], factor: FloatArray | float, order: Sequence[int] = (0, 1, 2)
) -> list[Run]:
    """The same with each current multiplied, and the channels in another order."""
    return [replace(run, current_a=(run.current_a * factor)[:, list(order)]) for run in runs]


def diagnosed(
    truth: Truth,
    runs: Sequence[Run],
    holdout: Sequence[Run] = (),
    *,
    method: Method = Method.ML,
    fixed: bool = False,
    effort_limit: FloatArray | None = None,
) -> tuple[Diagnosis, ...]:
    """Identify and diagnose, with the true gains as the nameplate."""
    gains = truth.gains if fixed else None
    found = identify(truth.model, runs, SMALL, holdout=holdout, method=method, fixed_gains=gains)
    return diagnose(found, AXES, truth.gains, effort_limit)
