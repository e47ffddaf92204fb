"""What the numbers of chosen bodies rest on, compared with a covariance that has numbers in place
of limits.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.model.base import base_parameters
from ident.model.model import DriveTrain, Model
from ident.model.urdf import robot_from_urdf
from ident.physical.full_parameters import LinkPrior
from ident.physical.physical import inertia_prior, random_motion
from ident.physical.prior_shares import prior_shares
from tests.ident.arms import SEVEN_AXES

FloatArray = NDArray[np.float64]
RATIO = np.diag([100.0, 100.0, 80.0, -80.0, 60.0, 50.0, 50.0])
RATIO[5, 6] = 50.0
MODEL = Model(robot_from_urdf(SEVEN_AXES.urdf), DriveTrain(RATIO))
NAMES = [column.name for column in MODEL.columns]
PRIOR = LinkPrior(inertia_prior(SEVEN_AXES.urdf).links, 0.1)
WIDE = 1e4  #: σ of what has no prior, next to numbers of about one


def _grouping() -> FloatArray:
    limits = np.repeat([[0.2], [1.0], [2.0], [5.0]], 7, axis=1)
    motion = random_motion(limits, 300, 5)
    rows = MODEL.regressor(motion).transpose(0, 2, 1).reshape(-1, len(NAMES))
    triangle = np.asarray(np.linalg.qr(rows, mode="r"))
    return base_parameters(triangle, tuple(NAMES)).grouping


def _prior_covariance() -> FloatArray:
    identity = np.eye(len(NAMES))
    covariance = WIDE**2 * identity
    for columns, directions in zip(MODEL.link_columns, PRIOR.directions(), strict=True):
        covariance[np.ix_(columns, columns)] = directions @ directions.T
    return covariance


def _link_std() -> FloatArray:
    direction_norm = np.linalg.norm(PRIOR.directions(), axis=2)
    return np.asarray(direction_norm.ravel())


def test_shares_are_those_of_the_choice_written_out() -> None:
    grouping = _grouping()
    rng = np.random.default_rng(2)
    sizes = np.linalg.norm(grouping[:, MODEL.link_columns.ravel()] * _link_std(), axis=1) + 1e-3
    factor = 0.01 * sizes[:, None] * rng.standard_normal((len(grouping), len(grouping)))
    covariance = factor @ factor.T
    # The choice written out, χ = χ₀ + K (β̂ − G χ₀) with K = S Gᵀ (G S Gᵀ)⁻¹: S has numbers in
    # place of limits.
    prior = _prior_covariance()
    inverse = np.linalg.inv(grouping @ prior @ grouping.T)
    gain = prior @ grouping.T @ inverse
    by_data = np.diag(gain @ covariance @ gain.T)
    identity = np.eye(len(NAMES))
    rest = identity - gain @ grouping
    by_prior = np.diag(rest @ prior @ rest.T)
    found = prior_shares(MODEL, grouping, covariance, PRIOR)
    expected = by_prior / (by_prior + by_data)
    assert found == pytest.approx(expected, abs=1e-5)
    assert ((found > 0.1) & (found < 0.9)).sum() > 10


def test_a_parameter_of_its_own_rests_on_data_and_a_sum_with_a_link_on_the_prior() -> None:
    grouping = _grouping()
    identity = np.eye(len(grouping))
    covariance = 1e-12 * identity
    found = dict(zip(NAMES, prior_shares(MODEL, grouping, covariance, PRIOR), strict=True))
    # Only the sum Izz1 + Ia1 is seen; the prior of the link decides on both.
    assert found["Ia1"] > 0.99
    assert found["Izz1"] > 0.99
    assert found["fs1"] < 0.01
    assert found["off7"] < 0.01
