"""From numpy arrays to drive gains with their uncertainty:
two runs, one of them with a weighed payload.

python examples/gains_from_arrays.py
"""

from __future__ import annotations

import numpy as np

import ident

URDF = """
<robot name="three axes">
  <link name="base"/> <link name="column"/> <link name="upper arm"/> <link name="forearm"/>
  <joint name="J1" type="revolute"> <parent link="base"/> <child link="column"/> <origin xyz="0 0 0.2"/>
    <axis xyz="0 0 1"/> <limit lower="-3" upper="3" velocity="5" effort="99"/> </joint>
  <joint name="J2" type="revolute"> <parent link="column"/> <child link="upper arm"/> <origin xyz="0.05 0 0.2"/>
    <axis xyz="0 1 0"/> <limit lower="-3" upper="3" velocity="5" effort="99"/> </joint>
  <joint name="J3" type="revolute"> <parent link="upper arm"/> <child link="forearm"/> <origin xyz="0 0 0.35"/>
    <axis xyz="0 1 0"/> <limit lower="-3" upper="3" velocity="5" effort="99"/> </joint>
</robot>"""  # noqa: E501
GEAR_RATIOS = (40.0, 50.0, -45.0)
NAMEPLATE_NM_A = (32.0, 34.0, -23.0)
TRUE_GAINS_NM_A = np.array([33.9, 32.4, -24.2])
# Weighed; its inertia is identified along
DISC = ident.Payload("disc", mounting="flange", known={"m": 4.59})


def record(model: ident.Model, name: str, payload: ident.Payload | None, seed: int) -> ident.Run:
    """Simulate a recording of yours: positions [rad] and current references [A], shape (n_samples,
    n_axes), 500 Hz.
    """
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, 40.0, 0.002)
    speed, phase = rng.uniform(0.5, 4.0, (3, 5)), rng.uniform(0.0, 6.3, (3, 5))
    angle = time_s[:, None, None] * speed + phase
    motion = ident.Motion(
        (0.3 * np.sin(angle)).sum(axis=2),
        (0.3 * speed * np.cos(angle)).sum(axis=2),
        (-0.3 * speed**2 * np.sin(angle)).sum(axis=2),
    )
    # Links of 10, 5 and 3 kg; each drive has rotor inertia, viscous and dry friction, and an
    # offset.
    truth = []
    for mass in (10.0, 5.0, 3.0):
        link = [
            0.02 * mass,
            0.0,
            0.0,
            0.02 * mass,
            0.0,
            0.01 * mass,
            0.05 * mass,
            0.0,
            0.12 * mass,
            mass,
        ]
        truth += [*link, 0.03, 5.0, 6.0, 0.1]
    parameters = np.array(truth)
    if payload is not None:
        parameters[model.flange] += [0.08, 0.0, 0.02, 0.08, 0.03, 0.05, -0.24, -0.25, 0.39, 4.59]
    torque_nm = np.einsum("jck,c->kj", model.regressor(motion), parameters)
    current_a = torque_nm / TRUE_GAINS_NM_A + 0.05 * rng.standard_normal(torque_nm.shape)
    return ident.Run(name, time_s, motion.position_rad, current_a, payload)


def main() -> ident.Identification:
    """Identify and print."""
    model = ident.Model(ident.robot_from_urdf(URDF), ident.DriveTrain(np.diag(GEAR_RATIOS)))
    runs = [record(model, "bare", None, 1), record(model, "loaded", DISC, 2)]
    found = ident.identify(model, runs)
    for axis, (gain, std) in enumerate(
        zip(found.estimate.gains, found.estimate.gains_std, strict=True), start=1
    ):
        print(f"J{axis}: {gain:7.2f} ± {std:.2f} Nm/A (true {TRUE_GAINS_NM_A[axis - 1]:.2f})")
    print(f"relative error of the torque: {found.training_error.total:.1f} %")
    return found


if __name__ == "__main__":
    main()
