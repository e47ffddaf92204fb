"""Motors, their joints and the columns of their parameters, by hand and by the regressor."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import ArrayLike

from ident.errors import ModelError
from ident.model.model import Column, DriveTrain, Model
from ident.model.robot import JointKind, Motion
from ident.model.urdf import robot_from_urdf
from tests.ident.arms import GANTRY, THREE_AXES

# The third motor turns with joints 2 and 3, as a belt along the second link lets it.
RATIO = np.array([[-90.0, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 20.0, 40.0]])
AXES = 3
JOINT_COLUMNS = 14  #: 10 of the link, then Ia, fv, fs and off
COUPLED_COLUMNS = 3  #: Iam, fvm and fsm of a motor that turns with several joints
LINK_NAMES = ("Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz", "mx", "my", "mz", "m")


@pytest.fixture(scope="module")
def model() -> Model:
    robot = robot_from_urdf(THREE_AXES.urdf)
    return Model(robot, DriveTrain(RATIO), friction_by_payload=True)


@pytest.fixture(scope="module")
def motion() -> Motion:
    rng = np.random.default_rng(4)
    position, velocity, acceleration = rng.uniform(-1.0, 1.0, size=(3, 25, 3))
    return Motion(position, velocity, acceleration)


def test_a_motor_belongs_to_its_own_joint_or_to_that_of_its_largest_ratio() -> None:
    train = DriveTrain([[0.0, 30.0, -50.0], [10.0, 0.0, 0.0], [0.0, 20.0, 40.0]])
    assert train.joints == (2, 0, 2)
    assert_allclose(train.reduction, [-50.0, 10.0, 40.0])


def test_directions_are_ratios_to_the_own_joint_and_motors_have_their_inverse() -> None:
    train = DriveTrain(RATIO)
    assert_allclose(train.direction, [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.5, 1.0]])
    # g v = T τ and τ = Σ rᵀ g v.
    assert_allclose(train.direction.T @ train.to_motor, np.eye(3), atol=1e-15)
    assert train.coupled == (2,)
    assert DriveTrain(np.diag([1.0, 2.0, 3.0])).coupled == ()


@pytest.mark.parametrize(
    ("ratio", "words"),
    [
        ([10.0, 20.0], r"square matrix, found shape \(2,\); write np.diag\(gear_ratios\)"),
        ([[1.0, 0.0]], r"square matrix, found shape \(1, 2\)$"),
        ([[1.0, 2.0], [2.0, 4.0]], r"not invertible .*: \[\[1.0, 2.0\], \[2.0, 4.0\]\]"),
    ],
)
def test_a_drive_train_that_is_none_is_refused_with_what_was_found(
    ratio: ArrayLike, words: str
) -> None:
    with pytest.raises(ModelError, match=words):
        DriveTrain(ratio)


def test_a_drive_train_of_fewer_motors_than_axes_is_refused() -> None:
    robot = robot_from_urdf(THREE_AXES.urdf)
    with pytest.raises(ModelError, match=r"shape \(2, 2\), expected \(3, 3\): .* 3 driven joints"):
        Model(robot, DriveTrain(np.eye(2)))


def test_a_column_of_a_slide_is_in_newton_and_metres() -> None:
    stiffness = Column("spring", "Nm/rad", least=0.0, largest=5.0, about=1.0)
    assert stiffness.at(JointKind.REVOLUTE) == stiffness
    of_slide = Column("spring", "N/m", least=0.0, largest=5.0, about=1.0)
    assert stiffness.at(JointKind.PRISMATIC) == of_slide


def test_columns_are_named_joint_by_joint_then_by_coupled_motor_then_with_payload(
    model: Model,
) -> None:
    names = [column.name for column in model.columns]
    assert names[9:JOINT_COLUMNS] == ["m1", "Ia1", "fv1", "fs1", "off1"]
    coupled = AXES * JOINT_COLUMNS
    with_payload = coupled + COUPLED_COLUMNS
    assert names[coupled:with_payload] == ["Iam3", "fvm3", "fsm3"]
    friction = [names[column] for column in model.friction_columns]
    assert friction == ["fv1", "fs1", "fv2", "fs2", "fv3", "fs3", "fvm3", "fsm3"]
    for name, own in zip(names[with_payload:], friction, strict=True):
        assert name.startswith(own)
    assert model.loaded_friction_columns.tolist() == list(range(45, 53))
    assert names[model.flange] == [f"{name}3" for name in LINK_NAMES]


def test_units_of_a_slide_and_of_a_turning_joint_differ() -> None:
    robot = robot_from_urdf(GANTRY.urdf)
    model = Model(robot, DriveTrain(np.eye(5)))
    units = {column.name: column.unit for column in model.columns}
    of_slide = (units["Ia1"], units["fv1"], units["fs1"], units["off1"])
    assert of_slide == ("kg", "N/(m/s)", "N", "N")
    of_turning = (units["Ia4"], units["fv4"], units["fs4"], units["off4"])
    assert of_turning == ("kg m²", "Nm/(rad/s)", "Nm", "Nm")


def test_without_payload_friction_there_are_no_columns_of_it() -> None:
    robot = robot_from_urdf(THREE_AXES.urdf)
    model = Model(robot, DriveTrain(np.diag([1.0, 2.0, 3.0])))
    assert len(model.columns) == AXES * JOINT_COLUMNS
    assert model.loaded_friction_columns.size == 0


def test_torques_are_the_regressors_with_friction_and_rotors_of_coupled_motors(
    model: Model, motion: Motion
) -> None:
    rng = np.random.default_rng(6)
    standard = rng.uniform(0.1, 1.0, size=len(model.columns))
    standard[model.loaded_friction_columns] = 0.0
    load, geared, total = model.torques(motion, standard)
    expected = np.einsum("mck,c->mk", model.regressor(motion), standard)
    assert_allclose(total, expected, rtol=1e-9, atol=1e-9)
    velocity = motion.velocity_rad_s.T
    viscous = standard[model.viscous_friction_columns, None] * velocity
    dry = standard[model.dry_friction_columns, None] * np.sign(velocity)
    assert_allclose(geared - load, viscous + dry, rtol=1e-9, atol=1e-9)


def test_a_coupled_rotor_resists_both_of_its_joints(model: Model) -> None:
    """r = (0, 0.5, 1): beside its own inertia, I r rᵀ couples joints 2 and 3, and friction of the
    motor acts against its own speed.
    """
    standard = np.zeros(len(model.columns))
    inertia = 2.0
    viscous = 3.0
    dry = 5.0
    coupled = AXES * JOINT_COLUMNS
    standard[coupled : coupled + COUPLED_COLUMNS] = (inertia, viscous, dry)
    still = np.zeros((1, 3))
    velocity = np.array([[0.0, 1.0, -2.0]])
    acceleration = np.array([[0.0, 4.0, 6.0]])
    _, _, total = model.torques(Motion(still, velocity, acceleration), standard)
    # The motor's speed 0.5·1 − 2 is below 0, so that its dry friction acts backwards.
    on_joint_2 = 0.5 * (inertia * 6.0 + viscous * -2.0) - 0.5 * dry
    on_joint_3 = 0.5 * (inertia * 4.0 + viscous * 1.0) - dry
    assert_allclose(total[:, 0], [0.0, on_joint_2, on_joint_3], atol=1e-12)


def test_columns_that_cannot_load_an_axis_are_zero_in_the_regressor(
    model: Model, motion: Motion
) -> None:
    regressor = model.regressor(motion, loaded=True)
    is_used = np.any(regressor != 0.0, axis=2)
    assert not (is_used & ~model.support).any()
    # A link loads its own joint and those before it, not those behind.
    assert model.support[0, model.link_columns[2]].all()
    assert not model.support[2, model.link_columns[1]].any()
    rotor_of_joint_2 = JOINT_COLUMNS + len(LINK_NAMES)
    assert not model.support[0, rotor_of_joint_2]


def test_what_is_mounted_adds_its_body_and_the_friction_of_its_load(model: Model) -> None:
    standard = np.arange(float(len(model.columns)))
    body = np.full(10, 100.0)
    loaded = model.with_payload(standard, body)
    added = loaded - standard
    assert_allclose(added[model.flange], 100.0)
    assert_allclose(added[model.friction_columns], standard[model.loaded_friction_columns])
    friction_count = 8  # viscous and dry, of three joints and a coupled motor
    assert np.count_nonzero(added) == len(LINK_NAMES) + friction_count
    assert model.with_payload(standard, None) is standard


def test_loaded_rows_have_the_columns_of_payload_friction(model: Model, motion: Motion) -> None:
    loaded = model.regressor(motion, loaded=True)
    bare = model.regressor(motion)
    own = loaded[:, model.friction_columns]
    assert_allclose(loaded[:, model.loaded_friction_columns], own)
    assert not bare[:, model.loaded_friction_columns].any()


def test_the_mass_matrix_is_the_torque_of_a_unit_acceleration(model: Model) -> None:
    rng = np.random.default_rng(9)
    position = rng.uniform(-1.0, 1.0, size=(4, 3))
    standard = np.zeros(len(model.columns))
    standard[model.link_columns] = rng.uniform(0.1, 1.0, size=(3, 10))
    matrix = model.inertia(position, standard)
    still = np.zeros((4, 3))
    weight, _, _ = model.torques(Motion(position, still, still), standard)
    for joint in range(3):
        unit_acceleration = np.zeros((4, 3))
        unit_acceleration[:, joint] = 1.0
        load, _, _ = model.torques(Motion(position, still, unit_acceleration), standard)
        assert_allclose(load - weight, matrix[:, joint], rtol=1e-9, atol=1e-9)


def test_a_motion_of_other_axes_is_refused_with_its_shapes(model: Model) -> None:
    short = np.zeros((5, 2))
    with pytest.raises(ModelError, match=r"shapes \(5, 2\), \(5, 2\), \(5, 2\); .*n_samples, 3"):
        model.regressor(Motion(short, short, short))
