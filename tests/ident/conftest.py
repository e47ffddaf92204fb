"""Recordings shared by the tests of the science; making them is the slow part."""

from __future__ import annotations

import numpy as np
import pytest

from ident.data.run import Run
from ident.discovery.evidence import Evidence, gather
from ident.estimators.estimate import Identification
from ident.estimators.identify import identify
from tests.ident.recordings import (
    CONDITIONING,
    MOUNTED,
    Truth,
    gathered,
    record,
    three_axes_truth,
    tx40_truth,
)


@pytest.fixture(scope="session")
def truth() -> Truth:
    """The TX-40-like arm."""
    return tx40_truth()


@pytest.fixture(scope="session")
def clean_runs(truth: Truth) -> tuple[Run, ...]:
    """One run without load and one with, without any noise."""
    rng = np.random.default_rng(11)
    return (record(truth, "bare", rng), record(truth, "loaded", rng, MOUNTED))


@pytest.fixture(scope="session")
def noisy_runs(truth: Truth) -> tuple[Run, ...]:
    """Two runs without load and two with, at a relative error of about six per cent."""
    rng = np.random.default_rng(3)
    return tuple(
        record(truth, f"run{index}", rng, MOUNTED if index % 2 else None, noise_a=0.3, seconds=22.0)
        for index in range(4)
    )


@pytest.fixture(scope="session")
def clean_found(truth: Truth, clean_runs: tuple[Run, ...]) -> Identification:
    """The runs without noise, identified."""
    return identify(truth.model, clean_runs, CONDITIONING)


@pytest.fixture(scope="session")
def noisy_found(truth: Truth, noisy_runs: tuple[Run, ...]) -> Identification:
    """The noisy runs, identified."""
    return identify(truth.model, noisy_runs, CONDITIONING)


@pytest.fixture(scope="session")
def noisy(noisy_found: Identification, noisy_runs: tuple[Run, ...]) -> Evidence:
    """The same with their rows; nothing undeclared is in them."""
    return gather(noisy_found, noisy_runs)


@pytest.fixture(scope="session")
def small_truth() -> Truth:
    """The arm of three axes."""
    return three_axes_truth()


@pytest.fixture(scope="session")
def small_runs(small_truth: Truth) -> tuple[Run, ...]:
    """Four runs of it, every other one loaded, at a relative error of about seven per cent."""
    rng = np.random.default_rng(3)
    return tuple(
        record(
            small_truth,
            f"run{index}",
            rng,
            MOUNTED if index % 2 else None,
            noise_a=0.3,
            seconds=22.0,
        )
        for index in range(4)
    )


@pytest.fixture(scope="session")
def small(small_truth: Truth, small_runs: tuple[Run, ...]) -> Evidence:
    """Identified, and nothing undeclared in them."""
    return gathered(small_truth, small_runs)
