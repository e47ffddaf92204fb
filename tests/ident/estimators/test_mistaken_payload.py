"""A payload that was not where the runs say it was: no residual need show it, but the scatter of the gains does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ident.data.run import Run
from ident.errors import PayloadUnseen
from ident.estimators.identify import identify
from ident.estimators.method import Method
from tests.ident.recordings import CONDITIONING, GAINS, MOUNTED, Truth, record


@pytest.fixture(scope="module")
def undeclared(truth: Truth) -> tuple[Run, ...]:
    """Runs with the payload mounted that say they went without."""
    rng = np.random.default_rng(5)
    runs = (record(truth, f"undeclared{i}", rng, MOUNTED, noise_a=0.3, seconds=22.0) for i in range(2))
    return tuple(replace(run, payload=None) for run in runs)


def test_mounted_in_every_run_but_declared_absent(
    truth: Truth, noisy_runs: tuple[Run, ...], undeclared: tuple[Run, ...]
) -> None:
    with pytest.raises(PayloadUnseen, match="mounted in every loaded run") as caught:
        identify(truth.model, (*undeclared, noisy_runs[1], noisy_runs[3]), CONDITIONING)
    assert min(caught.value.std_percent) > 50.0


def test_mounted_in_one_of_two_runs_declared_unloaded(
    truth: Truth, noisy_runs: tuple[Run, ...], undeclared: tuple[Run, ...]
) -> None:
    with pytest.raises(PayloadUnseen, match="undeclared0"):
        identify(truth.model, (undeclared[0], *noisy_runs[1:]), CONDITIONING)


def test_forgotten_in_a_run_declared_loaded(truth: Truth, noisy_runs: tuple[Run, ...]) -> None:
    with pytest.raises(PayloadUnseen):
        identify(truth.model, (replace(noisy_runs[0], payload=MOUNTED), *noisy_runs[1:3]), CONDITIONING)


def test_exchanged_roles_turn_every_sign(truth: Truth, noisy_runs: tuple[Run, ...]) -> None:
    """They are no contradiction: the robot is taken to be lighter by the payload. The nameplate's signs show it."""
    exchanged = tuple(replace(run, payload=None if run.payload else MOUNTED) for run in noisy_runs)
    assert identify(truth.model, exchanged, CONDITIONING).estimate.gains == pytest.approx(-GAINS, rel=0.05)


def test_few_but_honest_data_pass(truth: Truth) -> None:
    """A gate must not refuse what is merely short: twelve seconds a run at six per cent noise."""
    rng = np.random.default_rng(8)
    runs = [record(truth, f"r{i}", rng, MOUNTED if i % 2 else None, noise_a=0.3, seconds=12.0) for i in range(2)]
    found = identify(truth.model, runs, CONDITIONING, method=Method.ML)
    assert np.max(found.estimate.gains_std / np.abs(found.estimate.gains)) < 0.1
