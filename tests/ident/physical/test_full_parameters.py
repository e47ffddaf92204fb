"""Full parameters under a prior: unbiased, with true σ and flags, and possible;
a wrong prior is noticed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.discovery.evidence import Evidence
from ident.errors import ModelError
from ident.estimators.estimate import Estimate, Identification
from ident.estimators.identify import identify
from ident.estimators.least_squares import wls
from ident.estimators.method import Method
from ident.model.bodies import LINK_PARAMETERS, Body, body_of, link_parameters, pseudo_inertia
from ident.model.model import DriveTrain, Model
from ident.physical.full_parameters import FullParameters, LinkPrior, RestsOn, full_parameters
from tests.ident.physical.drawn_links import drawn_links
from tests.ident.recordings import CONDITIONING, MOUNTED, Truth, record, three_axes_truth

FloatArray = NDArray[np.float64]
ROD = Body(4.0, np.array([0.2, 0.01, -0.03]), np.diag([0.004, 0.06, 0.062]))
INSIDE = 1.96  #: σ of a 95 % interval


def _links(truth: Truth) -> FloatArray:
    return truth.parameters[truth.model.link_columns]


def _with_truth(found: Identification, truth: Truth) -> Estimate:
    """The estimate that has no error; gains and payload as they were found."""
    base = found.system.base
    parameters = found.estimate.parameters.copy()
    parameters[: len(base.names)] = base.grouping @ truth.parameters
    return replace(found.estimate, parameters=parameters)


def _with_errors(estimate: Estimate, rng: np.random.Generator) -> Estimate:
    """An estimate with errors of its own covariance."""
    sizes, directions = np.linalg.eigh(estimate.covariance)
    errors = directions @ (np.sqrt(np.maximum(sizes, 0.0)) * rng.standard_normal(len(sizes)))
    count = len(estimate.gains)
    gains = estimate.gains + errors[:count]
    parameters = estimate.parameters + errors[count:]
    return replace(estimate, gains=gains, parameters=parameters)


def _index(full: FullParameters, name: str) -> int:
    return full.names.index(name)


def test_the_tolerance_is_the_relative_deviation_of_mass_and_second_moments() -> None:
    tolerance = 0.2
    links = ROD.parameters[None]
    prior = LinkPrior(links, tolerance)
    directions = prior.directions()[0]
    direction_norm = np.linalg.norm(directions, axis=1)
    std = dict(zip(LINK_PARAMETERS, direction_norm, strict=True))
    assert std["m"] == pytest.approx(tolerance * ROD.mass_kg)
    moments = np.array([pseudo_inertia(column)[:3, :3] for column in directions.T])
    second = pseudo_inertia(ROD.parameters)[:3, :3]
    rng = np.random.default_rng(0)
    for direction in rng.normal(size=(20, 3)):
        spread = np.linalg.norm(np.einsum("i,kij,j->k", direction, moments, direction))
        assert spread == pytest.approx(tolerance * direction @ second @ direction)


def test_the_prior_is_the_same_in_another_frame() -> None:
    rng = np.random.default_rng(1)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    change = np.eye(4)
    change[:3, :3] = turn
    change[:3, 3] = (0.3, -0.2, 0.1)

    def moved(link: FloatArray) -> FloatArray:
        pseudo = change @ pseudo_inertia(link) @ change.T
        return link_parameters(pseudo)

    links = ROD.parameters[None]
    here = LinkPrior(links, 0.1).directions()[0]
    link_prior = LinkPrior(moved(ROD.parameters)[None], 0.1)
    there = link_prior.directions()[0]
    expected = np.column_stack([moved(column) for column in here.T])
    assert there @ there.T == pytest.approx(expected @ expected.T, abs=1e-12)


def test_data_and_a_prior_without_errors_give_the_robot(
    small: Evidence, small_truth: Truth
) -> None:
    found = small.identification
    prior = LinkPrior(_links(small_truth), 0.1)
    estimate = _with_truth(found, small_truth)
    full = full_parameters(found.system, estimate, prior)
    assert full.standard == pytest.approx(small_truth.parameters, abs=1e-6)
    assert full.gains == pytest.approx(found.estimate.gains)
    assert full.check.chi_square == pytest.approx(0.0, abs=1e-6)
    assert full.check.mass_ratio == pytest.approx(1.0)
    assert full.check.link_ratios == pytest.approx(np.ones(3))
    assert not full.check.is_wrong
    assert not full.bounded


@pytest.mark.slow
def test_sigma_is_true_and_nothing_is_bent(small: Evidence, small_truth: Truth) -> None:
    found = small.identification
    exact = _with_truth(found, small_truth)
    rng = np.random.default_rng(2)
    gains = []
    standard = []
    base = []
    ratios = []
    wrong = 0
    count = 60
    for _ in range(count):
        link_prior = LinkPrior(_links(small_truth), 0.1)
        links = drawn_links(link_prior, rng)
        estimate = _with_errors(exact, rng)
        prior = LinkPrior(links, 0.1)
        full = full_parameters(found.system, estimate, prior)
        gain_difference = full.gains - exact.gains
        gains.append(gain_difference / full.gains_std)
        parameter_error = full.standard - small_truth.parameters
        standard.append(parameter_error / full.standard_std)
        base_difference = full.base - exact.parameters[: len(full.base)]
        base.append(base_difference / full.base_std)
        ratios.append((full.check.mass_ratio - 1.0) / full.check.mass_ratio_std)
        wrong += full.check.is_wrong
    for figures in (gains, standard, base):
        assert np.mean(np.abs(figures) < INSIDE) == pytest.approx(0.95, abs=0.03)
        mean_squared_figure = np.mean(np.square(figures))
        assert np.sqrt(mean_squared_figure) == pytest.approx(1.0, abs=0.1)
        # The mean of each parameter is within chance of its truth, also the largest of them.
        mean_figure = np.mean(figures, axis=0)
        assert np.abs(mean_figure).max() < 4.0 / np.sqrt(count)
    assert np.std(ratios) == pytest.approx(1.0, abs=0.3)
    assert wrong <= 3


@pytest.mark.parametrize("scale", [0.7, 1.3])
def test_masses_that_are_thirty_percent_off_are_noticed(
    small: Evidence, small_truth: Truth, scale: float
) -> None:
    found = small.identification
    exact = _with_truth(found, small_truth)
    links = scale * _links(small_truth)
    prior = LinkPrior(links, 0.1)
    full = full_parameters(found.system, exact, prior)
    assert full.check.is_wrong
    assert full.check.mass_ratio == pytest.approx(1.0 / scale, abs=2.0 * full.check.mass_ratio_std)
    mass_ratio_sign = np.sign(full.check.mass_ratio - 1.0)
    expected = np.sign(1.0 / scale - 1.0)
    assert mass_ratio_sign == expected


def test_the_link_that_is_wrong_is_named(small: Evidence, small_truth: Truth) -> None:
    found = small.identification
    links = _links(small_truth).copy()
    links[2] *= 1.5
    estimate = _with_truth(found, small_truth)
    prior = LinkPrior(links, 0.05)
    full = full_parameters(found.system, estimate, prior)
    assert 2 in full.check.wrong_links
    assert full.check.link_ratios[2] == pytest.approx(1.0 / 1.5, abs=0.1)


def test_each_parameter_says_what_it_rests_on(noisy_found: Identification, truth: Truth) -> None:
    prior = LinkPrior(_links(truth), 0.1)
    full = full_parameters(noisy_found.system, noisy_found.estimate, prior)
    assert len(full.basis) == len(truth.model.columns)
    for name in ("fv1", "fs2", "off3", "fs6"):
        assert full.basis[_index(full, name)] is RestsOn.DATA
        assert full.prior_share[_index(full, name)] < 0.1
    # No torque depends on the mass of the first link, nor on its moments across the axis.
    for name in ("m1", "Ixx1", "mz1"):
        place = _index(full, name)
        assert full.basis[place] is RestsOn.PRIOR
        assert full.prior_share[place] == pytest.approx(1.0)
        assert full.standard[place] == pytest.approx(truth.parameters[place], abs=1e-6)
        assert full.standard_std[place] == pytest.approx(full.prior_std[place])


def test_a_rotor_that_is_known_with_its_link_alone_rests_on_the_prior_of_the_link(
    clean_found: Identification, truth: Truth
) -> None:
    """Izz1 + Ia1 + … is known; the rotor has no prior,
    and the ratio of its σ after and before is zero.
    """
    prior = LinkPrior(_links(truth), 0.1)
    full = full_parameters(clean_found.system, clean_found.estimate, prior)
    rotor = _index(full, "Ia1")
    assert np.isinf(full.prior_std[rotor])
    assert full.basis[rotor] is RestsOn.PRIOR
    first = clean_found.system.base.grouping[0]
    assert first[_index(full, "Izz1")] != 0.0
    assert first[rotor] != 0.0
    assert full.basis[_index(full, "fv1")] is RestsOn.DATA


def test_no_prior_decides_where_the_tolerance_is_wide_and_the_data_are_sharp(
    clean_found: Identification, truth: Truth
) -> None:
    """Without noise, base parameters and gains are the data's whatever the prior says."""
    link_prior = LinkPrior(_links(truth), 0.3)
    links = drawn_links(link_prior, np.random.default_rng(4))
    prior = LinkPrior(links, 0.3)
    full = full_parameters(clean_found.system, clean_found.estimate, prior)
    base = clean_found.system.base
    assert full.base == pytest.approx(base.grouping @ truth.parameters, rel=0.02, abs=2e-3)
    assert full.gains == pytest.approx(truth.gains, rel=1e-3)


def test_what_cannot_exist_is_moved_to_what_can(small: Evidence, small_truth: Truth) -> None:
    found = small.identification
    exact = _with_truth(found, small_truth)
    names = found.system.base.names
    parameters = exact.parameters.copy()
    parameters[names.index("fs2")] = -0.5
    heavy = next(place for place, name in enumerate(names) if name.startswith("Izz1"))
    absolute_parameter = abs(parameters[heavy])
    parameters[heavy] = -2.0 * absolute_parameter
    prior = LinkPrior(_links(small_truth), 0.3)
    estimate = replace(exact, parameters=parameters)
    full = full_parameters(found.system, estimate, prior)
    assert full.bounded
    assert full.standard[_index(full, "fs2")] >= 0.0
    assert np.all(full.eigenvalues > 0.0)
    for link in full.standard[small_truth.model.link_columns]:
        assert link[9] > 0.0
        moments = np.linalg.eigvalsh(body_of(link).inertia_kg_m2)
        assert moments[0] > 0.0
        assert moments[0] + moments[1] > moments[2]


def test_rotors_of_which_the_data_show_the_difference_alone() -> None:
    """Two motors turn both joints of a wrist, one of them against the other."""
    arm = three_axes_truth()
    ratio = np.array([[40.0, 0.0, 0.0], [0.0, 50.0, 50.0], [0.0, 50.0, -50.0]])
    model = Model(arm.model.robot, DriveTrain(ratio))
    # Two rotors of 0.2 and 0.1 on both joints, and no dry friction of the motors.
    rotors = np.array([0.2, 0.3, 2.0, 0.1, 0.3, 1.0])
    standard = np.concatenate((arm.parameters, rotors))
    for joint in (1, 2):
        standard[14 * joint + 10] += 0.3
        standard[14 * joint + 11] += 0.6
    gains = np.array([33.9, 32.4, -24.2])
    truth = Truth(model, standard, gains)
    rng = np.random.default_rng(5)
    runs = [
        record(
            truth, f"run{number}", rng, MOUNTED if number % 2 else None, noise_a=0.3, seconds=16.0
        )
        for number in range(2)
    ]
    standstill_rad_s = (0.03,) * 3
    conditioning = replace(CONDITIONING, standstill_rad_s=standstill_rad_s)
    found = identify(model, runs, conditioning)
    prior = LinkPrior(_links(truth), 0.1)
    full = full_parameters(found.system, found.estimate, prior)
    one = _index(full, "Iam2")
    other = _index(full, "Iam3")
    smallest_standard = min(full.standard[one], full.standard[other])
    assert smallest_standard >= 0.0
    difference = full.standard[one] - full.standard[other]
    assert difference == pytest.approx(0.1, abs=0.1)
    assert full.basis[one] is RestsOn.PRIOR
    assert full.basis[other] is RestsOn.PRIOR


def test_fixed_gains_stay(
    small: Evidence, small_truth: Truth, small_runs: tuple[object, ...]
) -> None:
    found = small.identification
    fixed = replace(
        _with_truth(found, small_truth),
        gains_fixed=True,
        gains=small_truth.gains,
        covariance=_without_gains(found.estimate),
    )
    prior = LinkPrior(_links(small_truth), 0.1)
    full = full_parameters(found.system, fixed, prior)
    assert full.gains == pytest.approx(small_truth.gains)
    assert full.standard == pytest.approx(small_truth.parameters, abs=1e-6)
    assert np.all(full.gains_std == 0.0)


def _without_gains(estimate: Estimate) -> FloatArray:
    covariance = estimate.covariance.copy()
    count = len(estimate.gains)
    covariance[:count] = 0.0
    covariance[:, :count] = 0.0
    return covariance


def test_least_squares_have_full_parameters_too(small: Evidence, small_truth: Truth) -> None:
    found = small.identification
    estimate = wls(found.system)
    assert estimate.method is Method.WLS
    prior = LinkPrior(_links(small_truth), 0.1)
    full = full_parameters(found.system, estimate, prior)
    assert np.all(full.eigenvalues > 0.0)


def test_what_is_no_prior_is_refused(small: Evidence, small_truth: Truth) -> None:
    found = small.identification
    links = _links(small_truth)
    with pytest.raises(ModelError, match=r"tolerance of the prior is 0\.7; expected 0\.01 to 0\.5"):
        LinkPrior(links, 0.7)
    flat = links.copy()
    flat[1, 9] = -1.0
    with pytest.raises(ModelError, match="link 2 of the prior is no possible body"):
        LinkPrior(flat, 0.1)
    prior = LinkPrior(links[:2], 0.1)
    with pytest.raises(ModelError, match="the prior has 2 moving links, the robot 3"):
        full_parameters(found.system, found.estimate, prior)
    held = found.system.holding({0: 0.0})
    link_prior = LinkPrior(links, 0.1)
    with pytest.raises(ModelError, match="the fit has left out Izz1"):
        full_parameters(held, found.estimate, link_prior)
