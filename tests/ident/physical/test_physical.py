"""Physical parameters: the same torque where that is possible,
the nearest possible one where it is not.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

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
    InertiaPrior,
    PhysicalParameters,
    inertia_prior,
    physical_parameters,
    random_motion,
    regroup,
)
from tests.ident.arms import ARMS, GANTRY, GRAVITIES, TX40, Arm
from tests.ident.recordings import RATIO

FloatArray = NDArray[np.float64]


LIMITS = [[0.1], [1.5], [2.0], [6.0]]
"""Largest position and derivatives of the random motions, a row each."""


def _model(
    arm: Arm, gravity: tuple[float, float, float] = GRAVITIES[0], *, coupled: bool = True
) -> Model:
    robot = robot_from_urdf(arm.urdf, gravity)
    ratio = np.eye(robot.joint_count)
    if coupled:
        ratio[-1, -2] = 0.7
    if arm is TX40:
        ratio = RATIO
    return Model(robot, DriveTrain(ratio))


def _motion(model: Model, seed: int, samples: int = 200) -> Motion:
    count = model.robot.joint_count
    limits = np.repeat(LIMITS, count, axis=1)
    return random_motion(limits, samples, seed)


def _link_slice(joint: int) -> slice:
    """Place of a link's ten parameters among the standard ones."""
    first = 14 * joint
    return slice(first, first + 10)


def _drive_slice(joint: int) -> slice:
    """Place of a joint's rotor and friction among the standard ones."""
    first = 14 * joint + 10
    return slice(first, first + 4)


def _link(rng: np.random.Generator, size_m: float = 0.1) -> FloatArray:
    """Twelve points of mass."""
    masses = rng.uniform(0.05, 0.4, 12)
    points = rng.uniform(-size_m, size_m, (12, 3))
    inertia = np.zeros((3, 3))
    for mass, point in zip(masses, points, strict=True):
        square = point @ point
        inertia += mass * (square * np.eye(3) - np.outer(point, point))
    upper = inertia[np.triu_indices(3)]
    moment = masses @ points
    return np.concatenate((upper, moment, [masses.sum()]))


def _truth(model: Model, seed: int) -> FloatArray:
    """A robot that can exist: bodies, rotors, friction that loses power."""
    rng = np.random.default_rng(seed)
    count = model.robot.joint_count
    out = np.zeros(len(_names(model)))
    for joint in range(count):
        out[_link_slice(joint)] = _link(rng)
        rotor_and_friction = rng.uniform(0.01, 0.3, 3)
        offset = rng.uniform(-0.3, 0.3)
        out[_drive_slice(joint)] = (*rotor_and_friction, offset)
    for index, motor in enumerate(model.drive_train.coupled):
        own = rng.uniform(0.01, 0.2, 3)
        place = 14 * count + 3 * index
        out[place : place + 3] = own
        # Seen at the joints that it turns, a rotor is on the diagonal too (paper eq. 25).
        for joint, r in enumerate(model.drive_train.direction[motor]):
            place = 14 * joint + 10
            out[place : place + 2] += r**2 * own[:2]
    return out


def _names(model: Model) -> tuple[str, ...]:
    """Names of the standard parameters."""
    return tuple(column.name for column in model.columns)


def _rows(columns: FloatArray) -> FloatArray:
    parameter_count = columns.shape[1]
    by_row = columns.transpose(0, 2, 1)
    return by_row.reshape(-1, parameter_count)


def _pivoted(model: Model, columns: FloatArray) -> BaseParameters:
    triangle = np.linalg.qr(_rows(columns), mode="r")
    return base_parameters(np.asarray(triangle), _names(model))


def _base(model: Model, columns: FloatArray) -> BaseParameters:
    names = _pivoted(model, columns).names
    return regroup(model, names, _rows(columns))


@dataclass(frozen=True)
class _Problem:
    """A model with a motion that excites it, and what the physical parameters are found from."""

    model: Model
    columns: FloatArray  #: regressor of the motion
    base: BaseParameters
    prior: InertiaPrior

    @classmethod
    def of(cls, arm: Arm, gravity: tuple[float, float, float] = GRAVITIES[0]) -> _Problem:
        model = _model(arm, gravity)
        columns = model.regressor(_motion(model, 1))
        base = _base(model, columns)
        return cls(model, columns, base, inertia_prior(arm.urdf))

    def base_values(self, standard: FloatArray) -> FloatArray:
        """Base parameters of standard ones."""
        return self.base.grouping @ standard

    def solve(
        self, values: FloatArray, other_friction: frozenset[int] = frozenset()
    ) -> PhysicalParameters:
        """Physical parameters of base parameters."""
        return physical_parameters(
            self.model, self.base, values, self.columns, self.prior, other_friction
        )


def _torque(columns: FloatArray, parameters: FloatArray) -> FloatArray:
    """Torque τ = Y(q, q̇, q̈) φ at each joint."""
    return np.asarray(np.einsum("jck,c->jk", columns, parameters))


def _index(model: Model) -> dict[str, int]:
    """Place of each standard parameter by its name."""
    return {name: place for place, name in enumerate(_names(model))}


def _friction_power(
    model: Model, values: dict[str, float], velocity: FloatArray, single: str, shared: str
) -> float:
    """Power of coefficients at joints and of those that two joints share."""
    power = 0.0
    for joint, v in enumerate(velocity, 1):
        power += values[f"{single}{joint}"] * v**2
    for motor in model.drive_train.coupled:
        r = model.drive_train.direction[motor]
        motor_velocity = r @ velocity
        coupling = motor_velocity**2 - r**2 @ velocity**2
        power += values[f"{shared}{motor + 1}"] * coupling
    return power


def _check_possible(found: PhysicalParameters) -> None:
    """Said in another way than by the matrix inequality of the programme."""
    for link in found.links:
        assert link[9] > 0.0
        smallest, middle, largest = np.linalg.eigvalsh(body_of(link).inertia_kg_m2)
        assert smallest > 0.0
        assert smallest + middle > largest
    model = found.model
    values = dict(zip(_names(model), found.standard, strict=True))
    for name, value in values.items():
        if name.startswith(("fs", "Iam", "fvm")):
            assert value >= 0.0
    rng = np.random.default_rng(0)
    velocities = rng.normal(size=(50, model.robot.joint_count))
    for velocity in velocities:
        assert _friction_power(model, values, velocity, "Ia", "Iam") >= -1e-9
        assert _friction_power(model, values, velocity, "fv", "fvm") >= -1e-9


@pytest.mark.slow
@settings(deadline=None, max_examples=4, derandomize=True)
@given(seed=st.integers(0, 10**6), gravity=st.sampled_from(GRAVITIES))
@pytest.mark.parametrize("arm", ARMS, ids=[arm.name for arm in ARMS])
def test_a_possible_robot_keeps_its_torque(
    arm: Arm, seed: int, gravity: tuple[float, float, float]
) -> None:
    problem = _Problem.of(arm, gravity)
    truth = _truth(problem.model, seed)
    found = problem.solve(problem.base_values(truth))
    assert found.exact
    _check_possible(found)
    assert np.all(found.eigenvalues >= 0.5 * MARGIN)

    other = problem.model.regressor(_motion(problem.model, 2))
    true_torque = _torque(other, truth)
    torque = _torque(other, found.standard)
    torque_difference_norm = np.linalg.norm(torque - true_torque)
    true_norm = np.linalg.norm(true_torque)
    assert torque_difference_norm <= 1e-6 * true_norm


@pytest.mark.slow
@settings(deadline=None, max_examples=4, derandomize=True)
@given(seed=st.integers(0, 10**6))
@pytest.mark.parametrize("arm", ARMS, ids=[arm.name for arm in ARMS])
def test_noise_is_projected_and_the_distance_reported(arm: Arm, seed: int) -> None:
    problem = _Problem.of(arm)
    true_values = problem.base_values(_truth(problem.model, seed))
    rng = np.random.default_rng(seed)
    noise = 0.1 * rng.normal(size=len(true_values))
    mean_magnitude = np.abs(true_values).mean()
    noisy = true_values + noise * mean_magnitude

    found = problem.solve(noisy)

    _check_possible(found)
    base_columns = problem.columns[:, list(problem.base.independent)]
    given_torque = _torque(base_columns, noisy)
    found_torque = _torque(base_columns, found.realised)
    true_torque = _torque(base_columns, true_values)
    assert np.allclose(found_torque, _torque(problem.columns, found.standard))
    size = np.linalg.norm(given_torque, axis=1)
    found_difference_norm = np.linalg.norm(found_torque - given_torque, axis=1)
    change = found_difference_norm / size
    change_percent = found.torque_change_percent.axes
    assert change_percent == pytest.approx(100.0 * change, abs=1e-9)
    is_same = bool(np.max(change) <= 1e-6)
    assert found.exact == is_same

    # The robot without the noise is possible: nothing that is farther away than it may be called
    # the nearest.
    true_difference_norm = np.linalg.norm(true_torque - given_torque, axis=1)
    true_change = true_difference_norm / size
    change_norm = np.linalg.norm(change)
    true_change_norm = np.linalg.norm(true_change)
    largest = (1.0 + SLACK) * true_change_norm
    assert change_norm <= largest + 1e-6


def test_a_robot_that_is_as_its_urdf_says_is_found_as_such() -> None:
    problem = _Problem.of(TX40)
    truth = _truth(problem.model, 5)
    links = problem.prior.links
    for joint, link in enumerate(links):
        truth[_link_slice(joint)] = link
    found = problem.solve(problem.base_values(truth))
    assert found.exact
    assert found.links == pytest.approx(links, abs=1e-3)


def _distance(standard: FloatArray, prior: InertiaPrior) -> float:
    """Bregman divergence of the pseudo-inertias from those of the prior."""
    total = 0.0
    for joint, link in enumerate(prior.links):
        of_prior = pseudo_inertia(link)
        of_link = pseudo_inertia(standard[_link_slice(joint)])
        ratio = np.linalg.solve(of_prior, of_link)
        _, log_determinant = np.linalg.slogdet(ratio)
        total += np.trace(ratio) - log_determinant - 4.0
    return total


def test_no_other_body_of_the_same_torque_is_nearer_to_the_prior() -> None:
    problem = _Problem.of(TX40)
    truth = _truth(problem.model, 5)
    found = problem.solve(problem.base_values(truth))

    _, _, right = np.linalg.svd(problem.base.grouping)
    without_torque = right[len(problem.base.names) :]
    scalars = [84, 85, 86]
    places = range(84)
    for joint in range(6):
        scalars.extend(places[_drive_slice(joint)])
    of_scalars = np.abs(without_torque[:, scalars])
    is_inertial = np.all(of_scalars < 1e-9, axis=1)
    inertial = without_torque[is_inertial]
    least = _distance(found.standard, problem.prior)
    rng = np.random.default_rng(0)
    shares = rng.normal(size=(100, len(inertial)))
    for direction in shares @ inertial:
        nearby = found.standard + 1e-3 * direction
        assert _distance(nearby, problem.prior) >= least - 1e-7


@pytest.mark.slow
def test_friction_that_would_push_is_taken_to_zero_unless_it_is_only_a_part() -> None:
    problem = _Problem.of(TX40)
    fs3 = _index(problem.model)["fs3"]
    truth = _truth(problem.model, 6)
    truth[fs3] = -0.05
    values = problem.base_values(truth)
    found = problem.solve(values)
    assert 0.0 <= found.standard[fs3] < 0.01
    assert not found.exact
    partly = problem.solve(values, other_friction=frozenset({2}))
    assert partly.exact
    assert partly.standard[fs3] == pytest.approx(-0.05)


def test_a_coupled_rotor_cannot_give_energy() -> None:
    problem = _Problem.of(TX40)
    index = _index(problem.model)
    truth = _truth(problem.model, 7)
    product = truth[index["Ia5"]] * truth[index["Ia6"]]
    truth[index["Iam6"]] = 3.0 * np.sqrt(product)
    found = problem.solve(problem.base_values(truth))
    assert not found.exact
    _check_possible(found)


def test_numbers_that_are_none_are_refused() -> None:
    problem = _Problem.of(GANTRY)
    values = problem.base_values(_truth(problem.model, 8))
    values[3] = np.nan
    with pytest.raises(NotPhysical, match="finite"):
        problem.solve(values)


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
    smaller = moments[0] + moments[1]
    moments[2] = 1.01 * smaller
    inertia_kg_m2 = axes @ np.diag(moments) @ axes.T
    broken = replace(body, inertia_kg_m2=inertia_kg_m2)
    broken_matrix = pseudo_inertia(broken.parameters)
    broken_eigenvalues = np.linalg.eigvalsh(broken_matrix)
    assert broken_eigenvalues[0] < 0.0


def test_the_prior_is_the_urdf_or_a_ball() -> None:
    prior = inertia_prior(TX40.urdf)
    assert prior.assumed == ()
    masses_kg = [10.0, 3.5, 4.0, 3.5, 1.0, 0.2]
    assert prior.links[:, 9] == pytest.approx(masses_kg)
    bare = re.sub(r"(?s)<inertial>.*?</inertial>", "", TX40.urdf)
    ball = inertia_prior(bare)
    assert ball.assumed == (0, 1, 2, 3, 4, 5)
    ball_masses_kg = ball.links[:, 9]
    assert np.all(ball_masses_kg == DEFAULT_MASS_KG)
    urdf = TX40.urdf.replace('izz="0.04"', 'izz="0.4"', 1)
    broken = inertia_prior(urdf)
    assert broken.assumed == (0,)
    first_link = prior.links[0]
    assert broken.links[0, 6:] == pytest.approx(first_link[6:])


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
    columns = model.regressor(_motion(model, 1))
    base = _pivoted(model, columns)
    rng = np.random.default_rng(0)
    shuffled = rng.permutation(base.names)
    names = tuple(map(str, shuffled))
    other_columns = model.regressor(_motion(model, 2))
    found = regroup(model, names, _rows(other_columns))
    assert found.independent == base.independent
    assert found.names == base.names
    assert found.grouping == pytest.approx(base.grouping, abs=2e-6)


def test_names_of_another_robot_are_refused() -> None:
    model = _model(TX40)
    columns = model.regressor(_motion(model, 1))
    rows = _rows(columns)
    names = _base(model, columns).names
    with pytest.raises(ModelError, match="does not have: Izz9"):
        regroup(model, (*names, "Izz9"), rows)
    without_fv2 = tuple(name for name in names if name != "fv2")
    with pytest.raises(ModelError, match="lacks fv2"):
        regroup(model, without_fv2, rows)
    with pytest.raises(ModelError, match=f"this robot only {len(names)}"):
        regroup(model, (*names, "Iyy3"), rows)
    urdf = TX40.urdf.replace("0.225 0 0.035", "0.250 0 0.035")
    longer = Model(robot_from_urdf(urdf), model.drive_train)
    longer_columns = longer.regressor(_motion(longer, 1))
    with pytest.raises(ModelError, match="geometry"):
        regroup(longer, names, _rows(longer_columns))


def test_links_of_the_prior_are_those_that_pinocchio_moves() -> None:
    """Pinocchio's own inverse dynamics with the URDF's inertias against the regressor with the
    prior's.
    """
    model = _model(GANTRY, coupled=False)
    motion = _motion(model, 3, samples=20)
    standard = np.zeros(len(model.columns))
    links = inertia_prior(GANTRY.urdf).links
    for joint, link in enumerate(links):
        standard[_link_slice(joint)] = link
    torque = _torque(model.regressor(motion), standard)
    robot = pin.buildModelFromXML(GANTRY.urdf)
    data = robot.createData()
    for k in range(20):
        q = motion.position_rad[k]
        v = motion.velocity_rad_s[k]
        a = motion.acceleration_rad_s2[k]
        expected = pin.rnea(robot, data, q, v, a)
        assert torque[:, k] == pytest.approx(expected, abs=1e-9)
