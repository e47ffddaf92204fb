"""Several payloads, mountings and runs in one identification."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from ident.data.run import Run
from ident.equations.reduction import reduce_runs, regrouped
from ident.estimators.estimate import Identification
from ident.estimators.identify import estimate_with, identify
from ident.estimators.maximum_likelihood import ml
from ident.estimators.method import Method
from ident.model.bodies import LINK_PARAMETERS, Payload
from tests.ident.recordings import CONDITIONING, GAINS, MOUNTED, PAYLOAD_TRUTH, Truth, record

OTHER_MOUNTING = dict(
    zip(
        LINK_PARAMETERS,
        (0.06, 0.004, -0.01, 0.07, 0.012, 0.04, 0.21, -0.11, 0.30, 4.59),
        strict=True,
    )
)
"""The same disc, turned and put elsewhere."""
PLATE = dict(
    zip(
        LINK_PARAMETERS,
        (0.013, -0.001, 0.003, 0.014, 0.002, 0.01, 0.05, 0.03, 0.1, 1.686),
        strict=True,
    )
)


def _record(
    truth: Truth,
    name: str,
    rng: np.random.Generator,
    payload: Payload | None,
    body: dict[str, float] | None,
) -> Run:
    """A run with any body: `record` mounts the one of PAYLOAD_TRUTH,
    so the last link makes up the difference.
    """
    parameters = truth.parameters.copy()
    if body is not None:
        parameters[truth.model.flange] += [
            body[name] - PAYLOAD_TRUTH[name] for name in LINK_PARAMETERS
        ]
    changed_truth = replace(truth, parameters=parameters)
    return record(changed_truth, name, rng, payload, noise_a=0.1)


@pytest.fixture(scope="module")
def mixed(truth: Truth) -> tuple[Run, ...]:
    """Two runs without load; the disc in two mountings and the plate, two runs of each."""
    rng = np.random.default_rng(21)
    bodies: list[tuple[Payload | None, dict[str, float] | None]] = [
        (None, None),
        (MOUNTED, PAYLOAD_TRUTH),
        (Payload("disc", "b", {"m": 4.59}), OTHER_MOUNTING),
        (Payload("plate", "c"), PLATE),
    ]
    runs = []
    for index in range(2):
        for payload, body in bodies:
            if payload is None:
                load = "bare"
            else:
                load = payload.mounting
            run = _record(truth, f"{load}{index}", rng, payload, body)
            runs.append(run)
    return tuple(runs)


@pytest.fixture(scope="module")
def identified(truth: Truth, mixed: tuple[Run, ...]) -> Identification:
    """All of them together."""
    return identify(truth.model, mixed, CONDITIONING)


@pytest.mark.slow
def test_each_mounting_has_its_own_unknowns(identified: Identification) -> None:
    """Disc twice, plate once, runs of each in any order;
    the plate's mass is unknown and is found.
    """
    found = identified.estimate
    assert found.gains == pytest.approx(GAINS, rel=0.01)
    values = dict(zip((column.name for column in found.unknowns), found.parameters, strict=True))
    expected = 61 + 9 + 9 + 10
    assert len(values) == expected
    for mounting, body in (("a", PAYLOAD_TRUTH), ("b", OTHER_MOUNTING), ("c", PLATE)):
        for name in ("mx", "my", "mz"):
            assert values[f"{name}:{mounting}"] == pytest.approx(body[name], abs=0.01)
    assert values["m:c"] == pytest.approx(1.686, rel=0.01)
    assert "m:a" not in values


@pytest.mark.slow
def test_one_unknown_vector_for_two_mountings_ruins_the_gains(
    truth: Truth, mixed: tuple[Run, ...]
) -> None:
    """Why a mounting has a name: the disc turned, and declared as if it had not been."""
    runs = [run for run in mixed if run.payload is None or run.payload.name == "disc"]
    confused = [replace(run, payload=MOUNTED) if run.payload else run for run in runs]

    def worst_error(given: Sequence[Run]) -> float:
        reduced = reduce_runs(truth.model, given, CONDITIONING)
        estimate = ml(regrouped(reduced))
        relative_error = np.abs(estimate.gains / GAINS - 1.0)
        return float(relative_error.max())

    right = worst_error(runs)
    wrong = worst_error(confused)
    assert right < 0.01
    assert wrong > 5.0 * right


@pytest.mark.parametrize("names", [("m",), ("m", "mx", "my", "mz"), LINK_PARAMETERS], ids=len)
def test_more_knowledge_is_used(
    truth: Truth, clean_runs: tuple[Run, ...], names: tuple[str, ...]
) -> None:
    """n_kL of eq.

    (5) from one to ten: what is known is not estimated, and all of it is consistent.
    """
    known = {name: PAYLOAD_TRUTH[name] for name in names}
    payload = Payload("disc", "a", known)
    changed_clean_run = replace(clean_runs[1], payload=payload)
    runs = (clean_runs[0], changed_clean_run)
    system = identify(truth.model, runs, CONDITIONING).system
    for method in (Method.WLS, Method.TLS, Method.ML):
        found = estimate_with(method, system)
        assert found.gains == pytest.approx(GAINS, rel=2e-4)
        unknown = {column.name for column in found.unknowns if ":" in column.name}
        expected = {f"{name}:a" for name in LINK_PARAMETERS if name not in names}
        assert unknown == expected
