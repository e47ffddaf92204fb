"""The sentence of `fit` on the paper's total least squares:
only where its gains say something about the model.
"""

from __future__ import annotations

import numpy as np
import pytest

from daq.report.fit import paper_note
from ident.estimators.estimate import Estimate
from ident.estimators.method import Method

AXES = ("crank-1", "crank-2")


def _estimate(
    method: Method, gains: tuple[float, float], std: tuple[float, float] = (0.07, 0.07)
) -> Estimate:
    covariance = np.diag(np.square(std))
    parameters = np.zeros(0)
    axis_noise = np.ones(2)
    singular_values = np.ones(1)
    return Estimate(
        method=method,
        gains=np.array(gains),
        gains_fixed=False,
        unknowns=(),
        parameters=parameters,
        covariance=covariance,
        axis_noise=axis_noise,
        singular_values=singular_values,
        condition=1.0,
        rows=100,
    )


def test_paper_note_with_gains_far_apart_names_these_axes() -> None:
    gains = (7.352, -6.838)
    estimate = _estimate(Method.ML, gains)
    paper = _estimate(Method.TLS, (7.314, -8.113))
    note = paper_note(AXES, estimate, paper)
    assert note is not None
    assert "finds crank-2 -8.113 (+18.6 %)." in note
    assert "crank-1" not in note


@pytest.mark.parametrize(
    ("tls_gain", "std"),
    [(-6.97, 0.07), (-6.97, 0.01), (-8.113, 0.7)],
    ids=["alike", "significant but small", "large but not significant"],
)
def test_paper_note_with_gains_alike_is_not_printed(tls_gain: float, std: float) -> None:
    gains = (7.352, -6.838)
    estimate = _estimate(Method.ML, gains, (std, std))
    paper = _estimate(Method.TLS, (7.352, tls_gain))
    assert paper_note(AXES, estimate, paper) is None


@pytest.mark.parametrize("method", [Method.LS, Method.WLS, Method.TLS, Method.IV])
def test_paper_note_of_another_method_than_ml_is_not_printed(method: Method) -> None:
    gains = (7.352, -6.838)
    estimate = _estimate(method, gains)
    paper = _estimate(Method.TLS, (7.314, -8.113))
    assert paper_note(AXES, estimate, paper) is None


def test_paper_note_with_wrong_weights_of_tls_is_not_printed() -> None:
    gains = (7.352, -6.838)
    estimate = _estimate(Method.ML, gains)
    paper = _estimate(Method.TLS, (7.314, -8.113))
    assert paper_note(AXES, estimate, paper, misjudged=(0,)) is None
