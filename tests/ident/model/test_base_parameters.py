"""Base parameters: as many as the literature counts, and saying the same torque."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ident.data.dataset import differentiate
from ident.equations.observation import observe
from ident.equations.reduction import reduce_runs, regrouped
from ident.model.base import base_parameters
from ident.model.bodies import LINK_PARAMETERS
from tests.ident.recordings import CONDITIONING, Truth, record


def test_the_tx40_has_61(truth: Truth) -> None:
    # Where dry friction turns within a millisecond
    rng = np.random.default_rng(11)
    run = record(truth, "bare", rng, averaged=1)
    data = differentiate(run, truth.model.drive_train, CONDITIONING)
    standard = reduce_runs(truth.model, (run,), CONDITIONING)
    system = regrouped(standard)
    observation = observe(truth.model, [data], CONDITIONING, system)
    assert len(observation.columns) == 61
    assert observation.columns[0].name.startswith("Izz1 + 1.0*Ia1 + 1.0*Iyy2")
    torque = np.einsum(
        "jcr,c->jr", observation.regressor, observation.base.grouping @ truth.parameters
    )
    # The currents of this run were made from the standard parameters, without noise.
    measured = observation.torque(truth.gains)
    absolute_measured = np.abs(measured[:, observation.use.any(axis=0)])
    size = np.max(absolute_measured)
    absolute_torque = np.abs((torque - measured)[observation.use])
    assert np.max(absolute_torque) < 2e-3 * size


def test_columns_of_the_links_and_of_dry_friction_are_those_of_their_names(truth: Truth) -> None:
    names = np.array([column.name for column in truth.model.columns])
    numbers = range(1, 7)
    expected = []
    for number in numbers:
        expected.append([f"{name}{number}" for name in LINK_PARAMETERS])
    assert names[truth.model.link_columns].tolist() == expected
    assert names[truth.model.dry_friction_columns].tolist() == [f"fs{number}" for number in numbers]
    # The motor of the last wrist turns with two joints; what a payload adds to friction is behind.
    by_payload = replace(truth.model, friction_by_payload=True)
    for model in (truth.model, by_payload):
        coupled_names = [model.columns[index].name for index in model.coupled_dry_friction_columns]
        assert coupled_names == ["fsm6"]
    last_link_column = truth.model.link_columns[-1]
    link_column = last_link_column.tolist()
    assert np.arange(len(names))[truth.model.flange].tolist() == link_column


def test_a_tiny_column_is_zero_and_not_a_parameter() -> None:
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(50, 3))
    matrix[:, 1] = 1e-12 * rng.normal(size=50)
    names = ("a", "b", "c")
    found = base_parameters(matrix, names)
    assert found.independent == (0, 2)
    assert found.names == ("a", "c")


def test_regrouping_keeps_the_product() -> None:
    rng = np.random.default_rng(1)
    matrix = rng.normal(size=(60, 5))
    matrix[:, 2] = 2.0 * matrix[:, 0] - 0.5 * matrix[:, 1]
    names = ("a", "b", "c", "d", "e")
    found = base_parameters(matrix, names)
    expected = (0, 1, 3, 4)
    assert found.independent == expected
    assert found.names[0] == "a + 2.0*c"
    assert found.names[1] == "b - 0.5*c"
    parameters = rng.normal(size=5)
    assert matrix[:, [0, 1, 3, 4]] @ (found.grouping @ parameters) == pytest.approx(
        matrix @ parameters
    )


def test_columns_that_differ_by_a_millionth_of_another_give_no_weights_of_a_million() -> None:
    """A carriage in a gravity that leans by a millionth:
    mass, rotor, and the offset of the friction.
    """
    rng = np.random.default_rng(2)
    acceleration = rng.normal(size=50)
    force = np.ones(50)
    mass = acceleration + 1e-6 * force
    triangle = np.column_stack((mass, acceleration, force))
    names = ("m", "Ia", "off")
    found = base_parameters(triangle, names)
    assert found.independent == (0, 2)
    assert found.names == ("m + 1.0*Ia", "off")
    largest_absolute_grouping = np.max(np.abs(found.grouping))
    assert largest_absolute_grouping == pytest.approx(1.0)


def test_columns_that_differ_by_a_millionth_of_what_is_nowhere_else_are_two() -> None:
    rng = np.random.default_rng(3)
    first = rng.normal(size=50)
    second = first + 1e-6 * rng.normal(size=50)
    triangle = np.column_stack((first, second))
    independent = base_parameters(triangle, ("a", "b")).independent
    assert independent == (0, 1)
