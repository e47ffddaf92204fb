"""The plant of a robot with prismatic joints: it falls, holds and is tuned in N, m and kg."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.simulation.amplifier import tuned_inertia_a_s2
from drivers.simulation.plant import Plant
from drivers.simulation.spec import AxisSpec, Body, CellSpec

FloatArray = NDArray[np.float64]

LEAD_M = 0.02
SCREW = 2.0 * np.pi / LEAD_M
MASS_KG = 7.0
BEHIND_KG = 2.0

URDF = f"""<robot name="lift"><link name="base"/>
<joint name="R" type="revolute"><origin xyz="0 0 0.5"/><parent link="base"/><child link="turn"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" velocity="3" effort="99"/></joint>
<link name="turn"><inertial><mass value="3"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
<joint name="Z" type="prismatic"><origin xyz="0 0 0"/><parent link="turn"/><child link="lift"/><axis xyz="0 0 1"/>
<limit lower="0" upper="0.8" velocity="1" effort="99"/></joint>
<link name="lift"><inertial><mass value="{MASS_KG}"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
<joint name="X" type="prismatic"><origin xyz="0 0 0"/><parent link="lift"/><child link="reach"/><axis xyz="1 0 0"/>
<limit lower="0.1" upper="1.1" velocity="1" effort="99"/></joint>
<link name="reach"><inertial><mass value="{BEHIND_KG}"/>
<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>
</robot>"""  # noqa: E501
"""A cylindrical robot: the reach changes the inertia that the turn meets."""


def _axis(node_id: int, gain: float, inertia: float) -> AxisSpec:
    return AxisSpec(
        node_id=node_id,
        vendor_id=1,
        product_code=1,
        revision=1,
        serial=node_id,
        counts_per_revolution=65536,
        rated_current_a=2.0,
        peak_current_a=8.0,
        gain_nm_per_a=gain,
        motor_inertia_kg_m2=inertia,
        viscous_nm_s_rad=0.0,
        coulomb_nm=0.0,
        motor_viscous_nm_s_rad=0.0,
        motor_coulomb_nm=0.0,
        offset_nm=0.0,
        current_noise_a=0.0,
        noise_correlation_s=0.0,
    )


def _spec(payload: Body | None = None) -> CellSpec:
    axes = (_axis(1, 40.0, 0.5), _axis(2, 150.0, 9.0), _axis(3, 150.0, 9.0))
    ratio = np.diag([100.0, SCREW, SCREW])
    start_rad = np.array([0.0, 0.4, 0.5])
    gravity_m_s2 = (0.0, 0.0, -9.81)
    return CellSpec(
        urdf=URDF,
        gravity_m_s2=gravity_m_s2,
        ratio=ratio,
        axes=axes,
        start_rad=start_rad,
        payload=payload,
        effects=(),
        sync_period_us=1000,
        substeps=4,
        seed=1,
    )


def _run(spec: CellSpec, current_a: FloatArray, seconds: float) -> Plant:
    plant = Plant(spec)
    closed = np.zeros(3, dtype=np.bool_)
    plant.set_brakes(closed)
    for _ in range(round(seconds * 4000)):
        plant.step(current_a)
    return plant


def test_a_lift_falls_with_the_mass_of_its_rotor_in_tow() -> None:
    plant = _run(_spec(), np.zeros(3), 0.1)
    moving = MASS_KG + BEHIND_KG
    expected = -9.81 * moving / (moving + 9.0) * 0.1
    assert plant.velocity_rad_s[1] == pytest.approx(expected, rel=1e-3)
    assert plant.velocity_rad_s[[0, 2]] == pytest.approx(0.0, abs=1e-9)
    assert plant.motor_rad == pytest.approx(np.diag([100.0, SCREW, SCREW]) @ plant.position_rad)


@pytest.mark.parametrize(
    "payload", [None, Body(5.0, (0.1, 0.0, 0.0), (0.01, 0.0, 0.0, 0.01, 0.0, 0.01))]
)
def test_the_current_that_holds_it_is_its_weight_over_the_gain(payload: Body | None) -> None:
    """Newton per ampere: what the identification must find again."""
    weight = 9.81 * (MASS_KG + BEHIND_KG + (0.0 if payload is None else payload.mass_kg))
    plant = _run(_spec(payload), np.array([0.0, weight / 150.0, 0.0]), 0.2)
    assert plant.velocity_rad_s == pytest.approx(np.zeros(3), abs=1e-9)
    assert plant.load_torque_nm[1] == pytest.approx(weight)


def test_the_loops_are_tuned_over_the_travel_of_a_prismatic_joint() -> None:
    """The turn meets the inertia of the reach at its two ends:
    their geometric mean, not one of places it cannot be.
    """
    spec = _spec()
    plant = Plant(spec)
    seen = []
    for reach in (0.1, 1.1):
        seen.append(1.0 + 1.0 + 0.1 + BEHIND_KG * reach**2 + 0.5)
    position_rad = np.array([0.3, 0.2, 1.1])
    assert plant.motor_inertia_at(position_rad)[0] == pytest.approx(seen[1])
    counts_per_rad = 65536 / (2 * np.pi)
    expected = np.sqrt(seen[0] * seen[1]) / (40.0 * 100.0 * counts_per_rad)
    assert tuned_inertia_a_s2(spec, plant)[0] == pytest.approx(expected)
    # Where it starts is of no account.
    start_rad = np.array([0.0, 0.1, 1.0])
    elsewhere = replace(spec, start_rad=start_rad)
    assert tuned_inertia_a_s2(elsewhere, plant) == pytest.approx(tuned_inertia_a_s2(spec, plant))


def test_the_loops_are_tuned_for_a_body_and_for_none() -> None:
    """A lift meets one inertia in all postures: without the body, and with it."""
    inertia_kg_m2 = (0.01, 0.0, 0.0, 0.01, 0.0, 0.01)
    centre_m = (0.1, 0.0, 0.0)
    body = Body(5.0, centre_m, inertia_kg_m2)
    bare = _spec()
    tuned = replace(bare, tuned_with=body)
    plant = Plant(tuned)
    found = tuned_inertia_a_s2(tuned, plant)
    without = tuned_inertia_a_s2(bare, Plant(bare))
    loaded = replace(bare, payload=body)
    with_body = tuned_inertia_a_s2(loaded, Plant(loaded))
    expected = np.sqrt(without[1] * with_body[1])
    assert found[1] == pytest.approx(expected)
    # Whatever is mounted at power-on.
    carrying = replace(tuned, payload=body)
    assert tuned_inertia_a_s2(carrying, Plant(carrying)) == pytest.approx(found)
