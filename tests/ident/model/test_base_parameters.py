"""Base parameters: as many as the literature counts, and saying the same torque."""

from __future__ import annotations

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
    run = record(truth, "bare", np.random.default_rng(11), averaged=1)
    data = differentiate(run, truth.model.drive_train, CONDITIONING)
    system = regrouped(reduce_runs(truth.model, (run,), CONDITIONING))
    observation = observe(truth.model, [data], CONDITIONING, system)
    assert len(observation.columns) == 61
    assert observation.columns[0].name.startswith("Izz1 + 1.0*Ia1 + 1.0*Iyy2")
    torque = np.einsum(
        "jcr,c->jr", observation.regressor, observation.base.grouping @ truth.parameters
    )
    # The currents of this run were made from the standard parameters, without noise.
    measured = observation.torque(truth.gains)
    size = np.max(np.abs(measured[:, observation.use.any(axis=0)]))
    assert np.max(np.abs((torque - measured)[observation.use])) < 2e-3 * size


def test_columns_of_the_links_and_of_dry_friction_are_those_of_their_names(truth: Truth) -> None:
    names = np.array([column.name for column in truth.model.columns])
    numbers = range(1, 7)
    assert names[truth.model.link_columns].tolist() == [
        [f"{name}{number}" for name in LINK_PARAMETERS] for number in numbers
    ]
    assert names[truth.model.dry_friction_columns].tolist() == [f"fs{number}" for number in numbers]
    assert (
        np.arange(len(names))[truth.model.flange].tolist() == truth.model.link_columns[-1].tolist()
    )


def test_a_tiny_column_is_zero_and_not_a_parameter() -> None:
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(50, 3))
    matrix[:, 1] = 1e-12 * rng.normal(size=50)
    found = base_parameters(matrix, ("a", "b", "c"))
    assert found.independent == (0, 2)
    assert found.names == ("a", "c")


def test_regrouping_keeps_the_product() -> None:
    rng = np.random.default_rng(1)
    matrix = rng.normal(size=(60, 5))
    matrix[:, 2] = 2.0 * matrix[:, 0] - 0.5 * matrix[:, 1]
    found = base_parameters(matrix, ("a", "b", "c", "d", "e"))
    assert found.independent == (0, 1, 3, 4)
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
    acceleration = np.random.default_rng(2).normal(size=50)
    force = np.ones(50)
    mass = acceleration + 1e-6 * force
    found = base_parameters(np.column_stack((mass, acceleration, force)), ("m", "Ia", "off"))
    assert found.independent == (0, 2)
    assert found.names == ("m + 1.0*Ia", "off")
    assert np.max(np.abs(found.grouping)) == pytest.approx(1.0)


def test_columns_that_differ_by_a_millionth_of_what_is_nowhere_else_are_two() -> None:
    rng = np.random.default_rng(3)
    first = rng.normal(size=50)
    second = first + 1e-6 * rng.normal(size=50)
    assert base_parameters(np.column_stack((first, second)), ("a", "b")).independent == (0, 1)
