"""The equations of eq.

(17): unknowns that get a value, the condition number, and what is refused.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from ident.equations.system import (
    GivenUnknowns,
    System,
    require_distinct,
    require_known_payload,
    require_rows,
)
from ident.equations.triangles import Triangles
from ident.errors import DataUnfit, PayloadMissing, RankDeficient
from ident.estimators.estimate import Identification


@pytest.fixture(scope="module")
def system(noisy_found: Identification) -> System:
    return noisy_found.system


def test_the_torque_of_a_given_unknown_joins_the_last_column() -> None:
    rng = np.random.default_rng(6)
    currents = 2
    unknowns = 4
    rows = rng.normal(size=(10, currents + unknowns + 1))
    values = {1: 0.5, 2: 0.0}
    given = GivenUnknowns.of(values, unknowns)
    solution = np.array([3.0, -1.0, 7.0, 0.5, 0.0, 9.0, 1.0])
    joined = given.joined_in(rows, currents)
    expected = (10, currents + 2 + 1)
    assert joined.shape == expected
    left = np.array([3.0, -1.0, 7.0, 9.0, 1.0])
    assert_allclose(joined @ left, rows @ solution, rtol=1e-12)


def test_a_system_with_given_unknowns_has_the_residual_of_the_whole_one(
    system: System, noisy_found: Identification
) -> None:
    gains = noisy_found.estimate.gains
    parameters = noisy_found.estimate.parameters
    parameter = float(parameters[0])
    given = {0: parameter, 3: float(parameters[3])}
    reduced = system.holding(given)
    kept = np.delete(parameters, list(given))
    expected = len(system.unknowns) - 2
    assert len(reduced.unknowns) == expected
    stacked_gains = np.concatenate((gains, parameters, [1.0]))
    whole = system.joints.square_sum(stacked_gains)
    less = reduced.joints.square_sum(np.concatenate((gains, kept, [1.0])))
    assert_allclose(less, whole, rtol=1e-8)
    of_motors = reduced.currents.cost(gains, kept, np.ones(len(gains)))
    assert of_motors == pytest.approx(
        system.currents.cost(gains, parameters, np.ones(len(gains))), rel=1e-9
    )


def test_the_condition_does_not_depend_on_the_unit_of_an_effect(
    system: System, noisy_found: Identification
) -> None:
    estimate = noisy_found.estimate
    solution = np.concatenate((estimate.gains, estimate.parameters, [1.0]))
    name = system.columns[0].name
    # The first column is taken for that of an effect.
    names = tuple(one for one in system.base.names if one != name)
    base = replace(system.base, names=names)
    first = system.axis_count
    values = []
    for unit in (1.0, 1e6):
        factors = []
        for factor in system.joints.factors:
            scaled = factor.copy()
            scaled[:, first] *= unit
            factors.append(scaled)
        joints = Triangles(tuple(factors), system.joints.rows)
        scaled_solution = solution.copy()
        scaled_solution[first] /= unit
        changed = replace(system, base=base, joints=joints)
        free = len(solution) - 1
        values.append(changed.weighted_singular_values(scaled_solution, free, gains=True))
    assert_allclose(values[0], values[1], rtol=1e-9)
    assert values[0][0] / values[0][-1] > 10.0


def test_singular_values_are_of_the_weighted_unknowns(
    system: System, noisy_found: Identification
) -> None:
    estimate = noisy_found.estimate
    solution = np.concatenate((estimate.gains, estimate.parameters, [1.0]))
    free = len(solution) - 1
    weight = 1.0 / system.joints.residual_std(solution, free)
    weighted = system.joints.stacked(weight)
    with_gains = np.linalg.svd(weighted[:, :-1], compute_uv=False)
    without = np.linalg.svd(weighted[:, system.axis_count : -1], compute_uv=False)
    assert_allclose(
        system.weighted_singular_values(solution, free, gains=True), with_gains, rtol=1e-9
    )
    assert_allclose(
        system.weighted_singular_values(solution, free, gains=False), without, rtol=1e-9
    )


def test_as_many_rows_as_unknowns_are_too_few(system: System) -> None:
    count = len(system.unknowns)
    rows = system.motors.rows.copy()
    rows[2] = count + 1
    motors = replace(system.motors, rows=rows)
    require_rows(replace(system, motors=motors))
    rows[2] = count
    changed_motor = replace(system.motors, rows=rows)
    with pytest.raises(DataUnfit, match=f"motor 3 has {count} usable rows for {count} unknowns"):
        require_rows(replace(system, motors=changed_motor))
    rows[2] = 0
    changed_motor_motors = replace(system.motors, rows=rows)
    with pytest.raises(DataUnfit, match="which motor 3 turns with, never move at the same time"):
        require_rows(replace(system, motors=changed_motor_motors))


def test_without_a_known_payload_nothing_sets_the_scale(system: System) -> None:
    require_known_payload(system)
    factors = []
    for factor in system.joints.factors:
        unloaded = factor.copy()
        unloaded[:, -1] = 0.0
        factors.append(unloaded)
    joints = Triangles(tuple(factors), system.joints.rows)
    bare = replace(system, joints=joints)
    with pytest.raises(PayloadMissing):
        require_known_payload(bare)


def test_a_current_of_zero_is_named(system: System) -> None:
    require_distinct(system, gains=True)
    factors = [factor.copy() for factor in system.motors.factors]
    factors[1][:, 0] = 0.0
    motors = Triangles(tuple(factors), system.motors.rows)
    silent = replace(system, motors=motors)
    with pytest.raises(RankDeficient, match="the current of motor 2 is zero throughout"):
        require_distinct(silent, gains=True)
    require_distinct(silent, gains=False)


def test_equal_columns_are_named(system: System) -> None:
    factors = []
    first = system.axis_count
    for factor in system.joints.factors:
        doubled = factor.copy()
        doubled[:, first + 1] = doubled[:, first]
        factors.append(doubled)
    joints = Triangles(tuple(factors), system.joints.rows)
    same = replace(system, joints=joints)
    with pytest.raises(RankDeficient, match="do not distinguish payload and robot") as caught:
        require_distinct(same, gains=False)
    lost = str(caught.value)
    names = [column.name for column in system.unknowns[:2]]
    assert any(name in lost for name in names)


def test_instruments_explain_the_columns_as_least_squares_do_by_few_rows(system: System) -> None:
    """With more rows than unknowns, but fewer than unknowns and instruments together."""
    rng = np.random.default_rng(7)
    axes = system.axis_count
    unknowns = len(system.unknowns)
    rows = unknowns + 5
    cluster = tuple(rng.normal(size=(rows, unknowns + 2)) for _ in range(axes))
    instruments = tuple(rng.normal(size=(rows, 30)) for _ in range(axes))
    few = replace(system, clusters=(cluster,), instruments=(instruments,))
    (projected,) = few.on_instruments().clusters
    for own, own_instruments, found in zip(cluster, instruments, projected, strict=True):
        coefficients, *_ = np.linalg.lstsq(own_instruments, own[:, 1:], rcond=None)
        assert_allclose(found[:, 0], own[:, 0])
        assert_allclose(found[:, 1:], own_instruments @ coefficients, atol=1e-9)
