"""Torque that a motion needs of the joints, compared with what their drives can give.

A drive whose current is at its limit falls behind its set-point, and trips with a following error.
So a plan must know the torque of its moves before they are made: it comes from the expected robot,
as the information of a plan does, and the limits are the efforts of the URDF. Both are known
roughly: expected inertias and friction are guesses, and a gain may differ from its nameplate by 30
%. Planned moves therefore stay below the limit by `EFFORT_MARGIN`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ident.arrays import FloatArray
from ident.model.robot import Motion, at_rest
from ident.planning.excitation import Expectation

EFFORT_MARGIN = 1.3  #: Effort limit over the largest torque that is expected on a planned move


def axis_torques(expectation: Expectation, motion: Motion, payload: int | None) -> FloatArray:
    """Return the expected torque of each axis [Nm or N], shape (n, k).

    Args:
        expectation: the expected robot.
        motion: of its axes over k samples.
        payload: number of the mounting, None without load.
    """
    model = expectation.model
    parameters = expectation.parameters.copy()
    if payload is None:
        parameters[model.loaded_friction_columns] = 0.0
    else:
        parameters[model.flange] += expectation.payloads[payload].parameters
    columns = model.regressor(motion, loaded=True)
    torque = np.einsum("jck,c->jk", columns, parameters)
    return np.asarray(torque)


def effort_shares(
    expectation: Expectation, effort: FloatArray, motion: Motion, payloads: Sequence[int | None]
) -> FloatArray:
    """Return the largest expected torque of each axis over its effort limit, shape (n, k).

    Args:
        expectation: the expected robot.
        effort: limit of each axis [Nm or N], inf where it is not known, shape (n,).
        motion: of the axes over k samples.
        payloads: mounted in turn, None without load.
    """
    largest = np.zeros(motion.position_rad.T.shape)
    for payload in dict.fromkeys(payloads):
        torque = axis_torques(expectation, motion, payload)
        largest = np.maximum(largest, np.abs(torque))
    return np.asarray(largest / effort[:, None])


def believable_efforts(
    expectation: Expectation,
    effort: FloatArray,
    position: FloatArray,
    payloads: Sequence[int | None],
) -> FloatArray:
    """Return effort limits with inf for those that gravity alone exceeds, shape (n,):
    such an arm could not stand.

    Exporters write one effort for all joints of all robots, which is no limit of a drive.

    Args:
        expectation: the expected robot.
        effort: limit of each axis [Nm or N], inf where it is not known, shape (n,).
        position: postures within the limits of the axes, shape (k, n).
        payloads: mounted in turn, None without load.
    """
    shares = effort_shares(expectation, effort, at_rest(position), payloads)
    is_believable = shares.max(axis=1) < 1.0
    return np.where(is_believable, effort, np.inf)
