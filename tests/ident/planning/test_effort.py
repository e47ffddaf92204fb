"""Expected torque of a motion, beside a pendulum that is computed by hand,
and efforts that cannot be true.
"""

from __future__ import annotations

import numpy as np
import pytest

from ident.model.bodies import LINK_PARAMETERS, Body
from ident.model.model import DriveTrain, Model
from ident.model.robot import Motion
from ident.model.urdf import robot_from_urdf
from ident.planning.effort import axis_torques, believable_efforts, effort_shares
from ident.planning.excitation import (
    Expectation,
    ExpectedPayload,
    declared_efforts,
    nominal_parameters,
)

MASS_KG = 3.0
LEVER_M = 0.4
INERTIA_KG_M2 = 0.1
PAYLOAD_KG = 2.0
PAYLOAD_LEVER_M = 0.5
EFFORT_NM = 40.0
GRAVITY_M_S2 = 9.81
URDF = f"""
<robot name="pendulum">
  <link name="base"/>
  <link name="rod"/>
  <joint name="J1" type="revolute">
    <parent link="base"/><child link="rod"/>
    <origin xyz="0 0 0" rpy="0 0 0"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="3" velocity="2" effort="{EFFORT_NM}"/>
  </joint>
</robot>
"""


@pytest.fixture(scope="module")
def expectation() -> Expectation:
    """A pendulum about the y axis, its rod along x, with dry and viscous friction and a rotor."""
    gravity_m_s2 = (0.0, 0.0, -GRAVITY_M_S2)
    robot = robot_from_urdf(URDF, gravity_m_s2)
    drive_train = DriveTrain(np.eye(1))
    model = Model(robot, drive_train)
    centre_m = np.array([LEVER_M, 0.0, 0.0])
    rod = Body(MASS_KG, centre_m, INERTIA_KG_M2 * np.eye(3))
    inertia_kg_m2 = np.zeros((3, 3))
    body = Body(PAYLOAD_KG, np.array([PAYLOAD_LEVER_M, 0.0, 0.0]), inertia_kg_m2)
    links = np.array([rod.parameters])
    torque_limit = np.array([EFFORT_NM])
    velocity_limit = np.array([2.0])
    acceleration_limit = np.array([10.0])
    parameters = nominal_parameters(model, links, torque_limit, velocity_limit, acceleration_limit)
    mounted = ExpectedPayload(frozenset(LINK_PARAMETERS), body.parameters)
    gains = np.ones(1)
    noise_a = np.ones(1)
    return Expectation(model, gains, parameters, (mounted,), noise_a)


def _motion(position: float, velocity: float, acceleration: float) -> Motion:
    position_rad = np.array([[position]])
    velocity_rad_s = np.array([[velocity]])
    acceleration_rad_s2 = np.array([[acceleration]])
    return Motion(position_rad, velocity_rad_s, acceleration_rad_s2)


@pytest.mark.parametrize(
    ("position", "velocity", "acceleration"), [(0.3, 1.5, 4.0), (-1.2, -0.7, 2.0), (2.0, 0.0, 0.0)]
)
def test_torque_of_a_pendulum_is_that_by_hand(
    expectation: Expectation, position: float, velocity: float, acceleration: float
) -> None:
    motion = _motion(position, velocity, acceleration)
    # A turn about y lowers a rod along x.
    gravity_nm = -MASS_KG * GRAVITY_M_S2 * LEVER_M * np.cos(position)
    inertia_kg_m2 = INERTIA_KG_M2 + MASS_KG * LEVER_M**2 + 0.03 * EFFORT_NM / 10.0
    friction_nm = 0.05 * EFFORT_NM * np.sign(velocity) + 0.10 * EFFORT_NM / 2.0 * velocity
    bare_nm = inertia_kg_m2 * acceleration + gravity_nm + friction_nm
    assert axis_torques(expectation, motion, None)[0, 0] == pytest.approx(bare_nm)
    added_nm = (
        PAYLOAD_KG
        * PAYLOAD_LEVER_M
        * (PAYLOAD_LEVER_M * acceleration - GRAVITY_M_S2 * np.cos(position))
    )
    assert axis_torques(expectation, motion, 0)[0, 0] == pytest.approx(bare_nm + added_nm)
    effort = declared_efforts(expectation.model, URDF)
    share = effort_shares(expectation, effort, motion, (None, 0))[0, 0]
    absolute_bare_nm = abs(bare_nm + added_nm)
    largest_bare_nm = max(abs(bare_nm), absolute_bare_nm)
    assert share == pytest.approx(largest_bare_nm / EFFORT_NM)


def test_an_effort_that_gravity_exceeds_is_no_limit(expectation: Expectation) -> None:
    grid = np.linspace(-3.0, 3.0, 101)
    position = grid[:, None]
    bare_nm = MASS_KG * GRAVITY_M_S2 * LEVER_M
    loaded_nm = bare_nm + PAYLOAD_KG * GRAVITY_M_S2 * PAYLOAD_LEVER_M
    enough = np.array([loaded_nm + 0.1])
    between = np.array([0.5 * (bare_nm + loaded_nm)])
    assert believable_efforts(expectation, enough, position, (None, 0)) == enough
    assert believable_efforts(expectation, between, position, (None,)) == between
    assert believable_efforts(expectation, between, position, (None, 0)) == np.inf


@pytest.mark.parametrize("effort", ["0", "1e9"])
def test_an_effort_that_exporters_write_for_nothing_is_not_known(
    expectation: Expectation, effort: str
) -> None:
    urdf = URDF.replace(f'effort="{EFFORT_NM}"', f'effort="{effort}"')
    assert declared_efforts(expectation.model, urdf) == np.inf
