"""A payload on another link than the last one:
gains and payload come back, and a wrong link does not pass.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ident.data.conditioning import Conditioning
from ident.errors import RankDeficient
from ident.estimators.identify import identify
from ident.estimators.method import Method
from ident.model.model import Model
from ident.model.urdf import robot_from_urdf
from tests.ident.arms import THREE_AXES
from tests.ident.recordings import MOUNTED, PAYLOAD_TRUTH, Truth, record, three_axes_truth

CONDITIONING = Conditioning(standstill_rad_s=(0.03,) * 3)


@pytest.fixture(scope="module")
def truth() -> Truth:
    """The arm of three axes, whose second link carries the payload."""
    last = three_axes_truth()
    robot = robot_from_urdf(THREE_AXES.urdf, platform="link1")
    model = Model(robot, last.model.drive_train)
    return replace(last, model=model)


def test_gains_and_payload_come_back(truth: Truth) -> None:
    rng = np.random.default_rng(5)
    known = {name: PAYLOAD_TRUTH[name] for name in ("mx", "my", "mz", "m")}
    drawn = replace(MOUNTED, known=known)
    runs = (
        record(truth, "bare", rng, noise_a=0.01),
        record(truth, "loaded", rng, drawn, noise_a=0.01),
    )
    found = identify(truth.model, runs, CONDITIONING, method=Method.ML)
    error_percent = 100.0 * (found.estimate.gains / truth.gains - 1.0)
    assert np.abs(error_percent).max() < 1.0
    last = identify(three_axes_truth().model, runs, CONDITIONING, method=Method.WLS, judge=False)
    wrong_percent = 100.0 * (last.estimate.gains / truth.gains - 1.0)
    assert np.abs(wrong_percent).min() > 100.0


def test_a_mass_that_does_not_show_behind_so_few_joints_asks_for_the_centre(truth: Truth) -> None:
    rng = np.random.default_rng(6)
    runs = (
        record(truth, "bare", rng, noise_a=0.01),
        record(truth, "loaded", rng, MOUNTED, noise_a=0.01),
    )
    with pytest.raises(RankDeficient, match=r"does not show behind so few joints: .*`centre_m`"):
        identify(truth.model, runs, CONDITIONING, method=Method.ML)
