"""Physical parameters: the same torque where that is possible,
the nearest possible one where it is not.
"""

from __future__ import annotations

import re

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ident.errors import ModelError
from ident.model.base import BaseParameters, base_parameters
from ident.model.bodies import body_of, link_parameters, pseudo_inertia
from ident.model.model import DriveTrain, Model
from ident.model.robot import Motion
from ident.model.urdf import robot_from_urdf
from ident.physical.consistency import MARGIN, NotPhysical
from ident.physical.physical import (
    DEFAULT_MASS_KG,
    SLACK,
    PhysicalParameters,
    inertia_prior,
    physical_parameters,
    random_motion,
    regroup,
)
from tests.ident.arms import ARMS, GANTRY, GRAVITIES, TX40, Arm
from tests.ident.recordings import RATIO

FloatArray = NDArray[np.float64]


def _model(
    arm: Arm, gravity: tuple[float, float, float] = GRAVITIES[0], *, coupled: bool = True
) -> Model:
    robot = robot_from_urdf(arm.urdf, gravity)
    ratio = np.eye(robot.joint_count)
    if coupled:
        ratio[-1, -2] = 0.7
    drive_train = DriveTrain(RATIO if arm is TX40 else ratio)
    return Model(robot, drive_train)


def _motion(model: Model, seed: int, samples: int = 200) -> Motion:
    count = model.robot.joint_count
    limits = np.repeat([[0.1], [1.5], [2.0], [6.0]], count, axis=1)
    return random_motion(limits, samples, seed)


def _link(rng: np.random.Generator, size_m: float = 0.1) -> FloatArray:
    """Twelve points of mass."""
    masses = rng.uniform(0.05, 0.4, 12)
    points = rng.uniform(-size_m, size_m, (12, 3))
    inertia = sum(
        m * (p @ p * np.eye(3) - np.outer(p, p)) for m, p in zip(masses, points, strict=True)
    )
    return np.concatenate(
        (np.asarray(inertia)[np.triu_indices(3)], masses @ points, [masses.sum()])
    )


def _truth(model: Model, seed: int) -> FloatArray:
    """A robot that can exist: bodies, rotors, friction that loses power."""
    rng = np.random.default_rng(seed)
    values = dict.fromkeys((column.name for column in model.columns), 0.0)
    count = model.robot.joint_count
    out = np.zeros(len(values))
    for joint in range(count):
        out[14 * joint : 14 * joint + 10] = _link(rng)
        out[14 * joint + 10 : 14 * joint + 14] = (
            *rng.uniform(0.01, 0.3, 3),
            rng.uniform(-0.3, 0.3),
        )
    for index, motor in enumerate(model.drive_train.coupled):
        own = rng.uniform(0.01, 0.2, 3)
        out[14 * count + 3 * index :][:3] = own
        # Seen at the joints that it turns, a rotor is on the diagonal too (paper eq. 25).
        for joint, r in enumerate(model.drive_train.direction[motor]):
            out[14 * joint + 10 : 14 * joint + 12] += r**2 * own[:2]
    return out


def _rows(columns: FloatArray) -> FloatArray:
    return columns.transpose(0, 2, 1).reshape(-1, columns.shape[1])


def _base(model: Model, columns: FloatArray) -> BaseParameters:
    triangle = np.asarray(np.linalg.qr(_rows(columns), mode="r"))
    names = tuple(column.name for column in model.columns)
    rounded = base_parameters(triangle, names)
    return regroup(model, rounded.names, _rows(columns))


def _check_possible(found: PhysicalParameters) -> None:
    """Said in another way than by the matrix inequality of the programme."""
    for link in found.links:
        assert link[9] > 0.0
        moments = np.linalg.eigvalsh(body_of(link).inertia_kg_m2)
        assert moments[0] > 0.0
        assert moments[0] + moments[1] > moments[2]
    model = found.model
    values = dict(zip((column.name for column in model.columns), found.standard, strict=True))
    assert all(
        value >= 0.0 for name, value in values.items() if name.startswith(("fs", "Iam", "fvm"))
    )
    rng = np.random.default_rng(0)
    for velocity in rng.normal(size=(50, model.robot.joint_count)):
        for single, shared in (("Ia", "Iam"), ("fv", "fvm")):
            power = sum(values[f"{single}{j + 1}"] * v**2 for j, v in enumerate(velocity))
            for motor in model.drive_train.coupled:
                r = model.drive_train.direction[motor]
                power += values[f"{shared}{motor + 1}"] * ((r @ velocity) ** 2 - r**2 @ velocity**2)
            assert power >= -1e-9


@pytest.mark.slow
@settings(deadline=None, max_examples=4, derandomize=True)
@given(seed=st.integers(0, 10**6), gravity=st.sampled_from(GRAVITIES))
@pytest.mark.parametrize("arm", ARMS, ids=[arm.name for arm in ARMS])
def test_a_possible_robot_keeps_its_torque(
    arm: Arm, seed: int, gravity: tuple[float, float, float]
) -> None:
    model = _model(arm, gravity)
    truth = _truth(model, seed)
    motion = _motion(model, 1)
    columns = model.regressor(motion)
    base = _base(model, columns)
    prior = inertia_prior(arm.urdf)
    found = physical_parameters(model, base, base.grouping @ truth, columns, prior)
    assert found.exact
    _check_possible(found)
    assert np.all(found.eigenvalues >= 0.5 * MARGIN)
    other = model.regressor(_motion(model, 2))
    expected = np.einsum("jck,c->jk", other, truth)
    torque = np.einsum("jck,c->jk", other, found.standard)
    torque_difference_norm = np.linalg.norm(torque - expected)
    expected_norm = np.linalg.norm(expected)
    assert torque_difference_norm <= 1e-6 * expected_norm


@pytest.mark.slow
@settings(deadline=None, max_examples=4, derandomize=True)
@given(seed=st.integers(0, 10**6))
@pytest.mark.parametrize("arm", ARMS, ids=[arm.name for arm in ARMS])
def test_noise_is_projected_and_the_distance_reported(arm: Arm, seed: int) -> None:
    model = _model(arm)
    truth = _truth(model, seed)
    motion = _motion(model, 1)
    columns = model.regressor(motion)
    base = _base(model, columns)
    true_values = base.grouping @ truth
    rng = np.random.default_rng(seed)
    noise = 0.1 * rng.normal(size=len(true_values)) * np.abs(true_values).mean()
    noisy = true_values + noise
    prior = inertia_prior(arm.urdf)
    found = physical_parameters(model, base, noisy, columns, prior)
    _check_possible(found)
    given_torque, found_torque, true_torque = (
        np.einsum("jck,c->jk", columns[:, list(base.independent)], values)
        for values in (noisy, found.realised, true_values)
    )
    assert np.allclose(found_torque, np.einsum("jck,c->jk", columns, found.standard))
    size = np.linalg.norm(given_torque, axis=1)
    found_torque_difference_norm = np.linalg.norm(found_torque - given_torque, axis=1)
    change = found_torque_difference_norm / size
    assert found.torque_change_percent.axes == pytest.approx(100.0 * change, abs=1e-9)
    expected = bool(np.max(change) <= 1e-6)
    assert found.exact == expected
    # The robot without the noise is possible: nothing that is farther away than it may be called
    # the nearest.
    true_torque_difference_norm = np.linalg.norm(true_torque - given_torque, axis=1)
    true_change = true_torque_difference_norm / size
    change_norm = np.linalg.norm(change)
    true_change_norm = np.linalg.norm(true_change)
    assert change_norm <= (1.0 + SLACK) * true_change_norm + 1e-6


def test_a_robot_that_is_as_its_urdf_says_is_found_as_such() -> None:
    model = _model(TX40)
    motion = _motion(model, 1)
    columns = model.regressor(motion)
    base = _base(model, columns)
    prior = inertia_prior(TX40.urdf)
    truth = _truth(model, 5)
    for joint, link in enumerate(prior.links):
        truth[14 * joint : 14 * joint + 10] = link
    found = physical_parameters(model, base, base.grouping @ truth, columns, prior)
    assert found.exact
    assert found.links == pytest.approx(prior.links, abs=1e-3)


def test_no_other_body_of_the_same_torque_is_nearer_to_the_prior() -> None:
    model = _model(TX40)
    motion = _motion(model, 1)
    columns = model.regressor(motion)
    base = _base(model, columns)
    prior = inertia_prior(TX40.urdf)
    found = physical_parameters(model, base, base.grouping @ _truth(model, 5), columns, prior)

    def distance(standard: FloatArray) -> float:
        total = 0.0
        for joint, link in enumerate(prior.links):
            seen = np.linalg.solve(
                pseudo_inertia(link), pseudo_inertia(standard[14 * joint : 14 * joint + 10])
            )
            difference = np.trace(seen) - np.linalg.slogdet(seen)[1]
            total += difference - 4.0
        return total

    _, _, right = np.linalg.svd(base.grouping)
    scalars = [84, 85, 86]
    for joint in range(6):
        scalars.extend(range(14 * joint + 10, 14 * joint + 14))
    rows = [row for row in right[len(base.names) :] if np.all(np.abs(row[scalars]) < 1e-9)]
    inertial = np.array(rows)
    least = distance(found.standard)
    rng = np.random.default_rng(0)
    for direction in rng.normal(size=(100, len(inertial))) @ inertial:
        assert distance(found.standard + 1e-3 * direction) >= least - 1e-7


@pytest.mark.slow
def test_friction_that_would_push_is_taken_to_zero_unless_it_is_only_a_part() -> None:
    model = _model(TX40)
    motion = _motion(model, 1)
    columns = model.regressor(motion)
    base = _base(model, columns)
    index = {column.name: number for number, column in enumerate(model.columns)}
    truth = _truth(model, 6)
    truth[index["fs3"]] = -0.05
    values = base.grouping @ truth
    prior = inertia_prior(TX40.urdf)
    found = physical_parameters(model, base, values, columns, prior)
    assert 0.0 <= found.standard[index["fs3"]] < 0.01
    assert not found.exact
    other_friction = frozenset({2})
    partly = physical_parameters(model, base, values, columns, prior, other_friction)
    assert partly.exact
    assert partly.standard[index["fs3"]] == pytest.approx(-0.05)


def test_a_coupled_rotor_cannot_give_energy() -> None:
    model = _model(TX40)
    motion = _motion(model, 1)
    columns = model.regressor(motion)
    base = _base(model, columns)
    index = {column.name: number for number, column in enumerate(model.columns)}
    truth = _truth(model, 7)
    truth[index["Iam6"]] = 3.0 * np.sqrt(truth[index["Ia5"]] * truth[index["Ia6"]])
    prior = inertia_prior(TX40.urdf)
    found = physical_parameters(model, base, base.grouping @ truth, columns, prior)
    assert not found.exact
    _check_possible(found)


def test_numbers_that_are_none_are_refused() -> None:
    model = _model(GANTRY)
    motion = _motion(model, 1)
    columns = model.regressor(motion)
    base = _base(model, columns)
    values = base.grouping @ _truth(model, 8)
    values[3] = np.nan
    prior = inertia_prior(GANTRY.urdf)
    with pytest.raises(NotPhysical, match="finite"):
        physical_parameters(model, base, values, columns, prior)


@pytest.mark.slow
@given(seed=st.integers(0, 10**6))
def test_the_pseudo_inertia_knows_a_body(seed: int) -> None:
    rng = np.random.default_rng(seed)
    link = _link(rng)
    matrix = pseudo_inertia(link)
    matrix_eigenvalues = np.linalg.eigvalsh(matrix)
    assert matrix_eigenvalues[0] > 0.0
    assert link_parameters(matrix) == pytest.approx(link)
    body = body_of(link)
    assert body.parameters == pytest.approx(link)
    moments, axes = np.linalg.eigh(body.inertia_kg_m2)
    moments[2] = 1.01 * (moments[0] + moments[1])
    broken = type(body)(body.mass_kg, body.centre_m, axes @ np.diag(moments) @ axes.T)
    assert np.linalg.eigvalsh(pseudo_inertia(broken.parameters))[0] < 0.0


def test_the_prior_is_the_urdf_or_a_ball() -> None:
    prior = inertia_prior(TX40.urdf)
    assert prior.assumed == ()
    assert prior.links[:, 9] == pytest.approx([10.0, 3.5, 4.0, 3.5, 1.0, 0.2])
    bare = re.sub(r"(?s)<inertial>.*?</inertial>", "", TX40.urdf)
    ball = inertia_prior(bare)
    expected = (0, 1, 2, 3, 4, 5)
    assert ball.assumed == expected
    assert np.all(ball.links[:, 9] == DEFAULT_MASS_KG)
    urdf = TX40.urdf.replace('izz="0.04"', 'izz="0.4"', 1)
    broken = inertia_prior(urdf)
    assert broken.assumed == (0,)
    assert broken.links[0, 6:] == pytest.approx(prior.links[0, 6:])


@pytest.mark.parametrize(
    ("written", "absurd"),
    [
        ('mass value="10.0"', 'mass value="1e308"'),
        ('mass value="10.0"', 'mass value="1e20"'),
        ('mass value="10.0"', 'mass value="-1e20"'),
        ('mass value="10.0"', 'mass value="1e-320"'),
        ('mass value="10.0"', 'mass value="-1"'),
        ('mass value="10.0"', 'mass value="nan"'),
        ('ixx="0.05"', 'ixx="1e308"'),
        ('xyz="0 0.02 -0.04"', 'xyz="0 1e200 -0.04"'),
    ],
)
def test_a_number_that_no_link_has_counts_as_none(written: str, absurd: str) -> None:
    urdf = TX40.urdf.replace(written, absurd, 1)
    assert urdf != TX40.urdf
    prior = inertia_prior(urdf)
    assert prior.assumed == (0,)
    assert np.all(np.isfinite(prior.factors))


@pytest.mark.parametrize("arm", ARMS, ids=[arm.name for arm in ARMS])
def test_the_grouping_comes_back_from_the_names(arm: Arm) -> None:
    model = _model(arm)
    motion = _motion(model, 1)
    columns = model.regressor(motion)
    triangle = np.asarray(np.linalg.qr(_rows(columns), mode="r"))
    base = base_parameters(triangle, tuple(c.name for c in model.columns))
    rng = np.random.default_rng(0)
    shuffled = rng.permutation(base.names)
    names = tuple(map(str, shuffled))
    found = regroup(model, names, _rows(model.regressor(_motion(model, 2))))
    assert found.independent == base.independent
    assert found.names == base.names
    assert found.grouping == pytest.approx(base.grouping, abs=2e-6)


def test_names_of_another_robot_are_refused() -> None:
    model = _model(TX40)
    motion = _motion(model, 1)
    rows = _rows(model.regressor(motion))
    columns = model.regressor(_motion(model, 1))
    names = _base(model, columns).names
    with pytest.raises(ModelError, match="does not have: Izz9"):
        regroup(model, (*names, "Izz9"), rows)
    with pytest.raises(ModelError, match="lacks fv2"):
        regroup(model, tuple(name for name in names if name != "fv2"), rows)
    with pytest.raises(ModelError, match=f"this robot only {len(names)}"):
        regroup(model, (*names, "Iyy3"), rows)
    urdf = TX40.urdf.replace("0.225 0 0.035", "0.250 0 0.035")
    longer = Model(robot_from_urdf(urdf), model.drive_train)
    with pytest.raises(ModelError, match="geometry"):
        regroup(longer, names, _rows(longer.regressor(_motion(longer, 1))))


def test_links_of_the_prior_are_those_that_pinocchio_moves() -> None:
    """Pinocchio's own inverse dynamics with the URDF's inertias against the regressor with the
    prior's.
    """
    model = _model(GANTRY, coupled=False)
    motion = _motion(model, 3, samples=20)
    standard = np.zeros(len(model.columns))
    links = inertia_prior(GANTRY.urdf).links
    for joint, link in enumerate(links):
        standard[14 * joint : 14 * joint + 10] = link
    torque = np.einsum("jck,c->jk", model.regressor(motion), standard)
    robot = pin.buildModelFromXML(GANTRY.urdf)
    data = robot.createData()
    for k in range(20):
        expected = pin.rnea(
            robot,
            data,
            motion.position_rad[k],
            motion.velocity_rad_s[k],
            motion.acceleration_rad_s2[k],
        )
        assert torque[:, k] == pytest.approx(expected, abs=1e-9)
