"""A payload that was not where the runs say it was:
no residual need show it, but the scatter of the gains does.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ident.data.run import Run
from ident.equations.reduction import reduce_runs, regrouped
from ident.errors import ModelContradicted, PayloadUnseen, RolesExchanged
from ident.estimators.estimate import Estimate, RelativeError
from ident.estimators.identify import identify
from ident.estimators.maximum_likelihood import ml
from ident.estimators.method import Method
from ident.estimators.refusals import require_plausible, require_seen_payload
from tests.ident.recordings import CONDITIONING, GAINS, MOUNTED, Truth, record


@pytest.fixture(scope="module")
def undeclared(truth: Truth) -> tuple[Run, ...]:
    """Runs with the payload mounted that say they went without."""
    rng = np.random.default_rng(5)
    runs = (
        record(truth, f"undeclared{i}", rng, MOUNTED, noise_a=0.3, seconds=22.0) for i in range(2)
    )
    return tuple(replace(run, payload=None) for run in runs)


@pytest.mark.slow
def test_mounted_in_every_run_but_declared_absent(
    truth: Truth, noisy_runs: tuple[Run, ...], undeclared: tuple[Run, ...]
) -> None:
    runs = (*undeclared, noisy_runs[1], noisy_runs[3])
    with pytest.raises(PayloadUnseen, match="mounted in every loaded run") as caught:
        identify(truth.model, runs, CONDITIONING)
    assert min(caught.value.std_percent) > 50.0


@pytest.mark.slow
def test_mounted_in_one_of_two_runs_declared_unloaded(
    truth: Truth, noisy_runs: tuple[Run, ...], undeclared: tuple[Run, ...]
) -> None:
    runs = (undeclared[0], *noisy_runs[1:])
    with pytest.raises(PayloadUnseen, match="undeclared0"):
        identify(truth.model, runs, CONDITIONING)


@pytest.mark.slow
def test_forgotten_in_a_run_declared_loaded(truth: Truth, noisy_runs: tuple[Run, ...]) -> None:
    changed_noisy_run = replace(noisy_runs[0], payload=MOUNTED)
    runs = (changed_noisy_run, *noisy_runs[1:3])
    with pytest.raises(PayloadUnseen):
        identify(truth.model, runs, CONDITIONING)


@pytest.mark.slow
def test_exchanged_roles_turn_every_sign_and_friction_shows_it(
    truth: Truth, noisy_runs: tuple[Run, ...]
) -> None:
    """They are no contradiction: the robot is taken to be lighter by the payload.

    But friction then adds energy.
    """
    exchanged = tuple(replace(run, payload=None if run.payload else MOUNTED) for run in noisy_runs)
    with pytest.raises(
        RolesExchanged,
        match=r"fs1 = -5\..*; expected above 0.*payload's run .* "
        r"exchanged",
    ):
        identify(truth.model, exchanged, CONDITIONING)
    standard = reduce_runs(truth.model, exchanged, CONDITIONING)
    estimate = ml(regrouped(standard))
    assert estimate.gains == pytest.approx(-GAINS, rel=0.05)


@pytest.mark.slow
def test_currents_of_another_sign_are_no_exchanged_roles(
    truth: Truth, noisy_runs: tuple[Run, ...]
) -> None:
    """A drive may count its current the other way:
    its gain is negative, and friction still takes energy.
    """
    signs = np.array([1.0, -1.0, -1.0, 1.0, 1.0, -1.0])
    for turned in (-np.ones(6), signs):
        runs = tuple(replace(run, current_a=run.current_a * turned) for run in noisy_runs[:2])
        gains = identify(truth.model, runs, CONDITIONING).estimate.gains
        assert gains == pytest.approx(GAINS * turned, rel=0.05)


def test_fixed_gains_of_the_wrong_sign_are_refused(
    truth: Truth, noisy_runs: tuple[Run, ...]
) -> None:
    for method in (Method.WLS, Method.ML):
        with pytest.raises(RolesExchanged, match="fixed gains"):
            identify(truth.model, noisy_runs[:1], CONDITIONING, method=method, fixed_gains=-GAINS)


@pytest.mark.slow
def test_a_robot_without_dry_friction_is_not_refused(truth: Truth) -> None:
    """Its friction is identified as zero, above or below by chance."""
    rng = np.random.default_rng(4)
    slippery = truth.parameters.copy()
    slippery[[14 * joint + 12 for joint in range(6)]] = 0.0
    runs = tuple(
        record(
            replace(truth, parameters=slippery), f"r{i}", rng, MOUNTED if i else None, noise_a=0.3
        )
        for i in (0, 1)
    )
    gains = identify(truth.model, runs, CONDITIONING).estimate.gains
    assert gains == pytest.approx(GAINS, rel=0.05)
    known = identify(truth.model, runs[:1], CONDITIONING, method=Method.WLS, fixed_gains=GAINS)
    friction = [
        v
        for c, v in zip(known.estimate.unknowns, known.estimate.parameters, strict=True)
        if c.name[:2] == "fs"
    ]
    assert min(friction) < 0.0


def test_gains_beside_which_the_payload_weighs_nothing_have_no_scale(
    truth: Truth, noisy_runs: tuple[Run, ...]
) -> None:
    """As of exchanged channels: an optimum at infinity, with a small σ."""
    found = identify(truth.model, noisy_runs[:2], CONDITIONING)
    require_seen_payload(found.estimate, found.system)
    one = found.estimate
    scale = np.concatenate((np.full(6, 1e8), np.full(len(one.parameters), 1e8)))
    scale_outer = np.outer(scale, scale)
    covariance = one.covariance * scale_outer
    gains = 1e8 * one.gains
    parameters = 1e8 * one.parameters
    away = replace(
        one,
        gains=gains,
        parameters=parameters,
        covariance=covariance,
    )
    with pytest.raises(PayloadUnseen, match="not in rad, or columns in another order"):
        require_seen_payload(away, found.system)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "method"),
    [
        ([0, 1, 2, 3, 5, 4], Method.ML),
        ([0, 1, 2, 4, 3, 5], Method.ML),
        ([5, 1, 2, 3, 4, 0], Method.LS),
        ([0, 1, 2, 3, 5, 4], Method.TLS),
    ],
    ids=str,
)
def test_exchanged_channels_are_refused(
    truth: Truth, noisy_runs: tuple[Run, ...], order: list[int], method: Method
) -> None:
    """A gain of 2e-13 or 98 in place of 16 or 9 is no result."""
    crossed = [replace(run, current_a=run.current_a[:, order]) for run in noisy_runs]
    with pytest.raises(ModelContradicted, match=r"on axis J.* ± .*two channels exchanged"):
        identify(truth.model, crossed, CONDITIONING, method=method)


@given(total=st.floats(0.0, 200.0), axis=st.floats(0.0, 1000.0), unknown=st.booleans())
def test_what_is_refused_is_what_the_limits_say(total: float, axis: float, unknown: bool) -> None:
    error = RelativeError((axis, 1.0), total)
    covariance = np.diag([4.41 if unknown else 3.61, 1.0])
    gains = np.array([2.0, -3.0])
    parameters = np.zeros(0)
    axis_noise = np.ones(2)
    singular_values = np.ones(2)
    estimate = Estimate(
        method=Method.ML,
        gains=gains,
        gains_fixed=False,
        unknowns=(),
        parameters=parameters,
        covariance=covariance,
        axis_noise=axis_noise,
        singular_values=singular_values,
        condition=1.0,
        rows=9,
    )
    if total > 50.0 or axis > (25.0 if unknown else 100.0):
        with pytest.raises(ModelContradicted, match="J1" if axis > 100.0 else "total"):
            require_plausible(estimate, error, ("J1", "J2"))
    else:
        require_plausible(estimate, error, ("J1", "J2"))
    axes = (float("nan"), 1.0)
    relative_error = RelativeError(axes, float("nan"))
    with pytest.raises(ModelContradicted):  # what is no number is within no limit
        require_plausible(estimate, relative_error, ("J1", "J2"))


def test_few_but_honest_data_pass(truth: Truth) -> None:
    """A gate must not refuse what is merely short: twelve seconds a run at six per cent noise."""
    rng = np.random.default_rng(8)
    runs = [
        record(truth, f"r{i}", rng, MOUNTED if i % 2 else None, noise_a=0.3, seconds=12.0)
        for i in range(2)
    ]
    found = identify(truth.model, runs, CONDITIONING, method=Method.ML)
    absolute_gain = np.abs(found.estimate.gains)
    assert np.max(found.estimate.gains_std / absolute_gain) < 0.1
