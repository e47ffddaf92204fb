"""The regressor against Pinocchio's inverse dynamics, for arms of all kinds."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from ident.regressor import rigid_regressor
from ident.robot import robot_from_urdf
from tests.ident.arms import ARMS, GRAVITIES, Arm


def _pinocchio_parameters(model: pin.Model) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    parameters: list[float] = []
    for inertia in list(model.inertias)[1:]:
        mass, mx, my, mz, ixx, ixy, iyy, ixz, iyz, izz = inertia.toDynamicParameters()
        parameters.extend((ixx, ixy, ixz, iyy, iyz, izz, mx, my, mz, mass))
    return np.array(parameters)


@pytest.mark.parametrize("gravity", GRAVITIES)
@pytest.mark.parametrize("arm", ARMS, ids=lambda arm: arm.name)
def test_agrees_with_inverse_dynamics_to_1e9(arm: Arm, gravity: tuple[float, float, float]) -> None:
    model = pin.buildModelFromXML(arm.urdf)
    model.gravity.linear = np.array(gravity)
    data = model.createData()
    rng = np.random.default_rng(7)
    q, v, a = rng.uniform(-3, 3, (3, model.nv, 40))
    torque = np.einsum(
        "jck,c->jk", rigid_regressor(robot_from_urdf(arm.urdf, gravity), q, v, a), _pinocchio_parameters(model)
    )
    expected = np.stack([pin.rnea(model, data, q[:, k], v[:, k], a[:, k]) for k in range(40)], axis=1)
    assert np.max(np.abs(torque - expected)) < 1e-9 * max(1.0, np.max(np.abs(expected)))
