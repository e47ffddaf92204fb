"""Payloads that no body can be are refused; those that a drawing gives, rounded, are not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import ident
from ident.model.bodies import (
    LINK_PARAMETERS,
    Body,
    body_of,
    link_parameters,
    pseudo_inertia,
)

lax: Any = ident  #: As a notebook sees it

MOMENTS = {"Ixx": 0.02, "Ixy": 0.0, "Ixz": 0.0, "Iyy": 0.02, "Iyz": 0.0, "Izz": 0.02}

IMPOSSIBLE: list[tuple[str, dict[str, Any], str]] = [
    ("negative mass", {"m": -5.0}, "'disc' weighs -5 kg; expected its mass, above 0 kg"),
    ("no mass", {"m": 0.0}, "weighs 0 kg"),
    ("no number", {"m": np.nan}, "'disc' has m = nan; expected finite numbers"),
    ("no centre", {"m": 1.0, "mx": np.nan}, "has mx = nan; expected finite numbers"),
    ("endless", {"m": 1.0, "Ixx": np.inf}, "has Ixx = inf; expected finite numbers"),
    ("an array", {"m": 1.0, "Ixx": np.eye(3)}, r"known\['Ixx'\] is of type ndarray; expected Real"),
    (
        "one negative moment",
        {"m": 1.0, "Izz": -0.1},
        "has Izz = -0.1 kg m²; expected moments of inertia of zero",
    ),
    (
        "triangle inequality",
        {"m": 1.0, **MOMENTS, "Izz": 0.05},
        "has an inertia that no body has: .*Izz = 0.05.*expec",
    ),
    (
        "small negative moments",
        {"m": 0.1, **MOMENTS, "Ixx": -1e-4, "Iyy": -1e-4, "Izz": -1e-4},
        "has an inertia that no body has: .*Ixx = -0.0001",
    ),
    (
        "small moments with the sum zero",
        {"m": 0.1, **MOMENTS, "Ixx": 1e-4, "Iyy": -1e-4, "Izz": 0.0},
        "has an inertia that no body has: .*Iyy = -0.0001",
    ),
    (
        "products of inertia alone",
        {"m": 0.1, **MOMENTS, "Ixx": 0.0, "Iyy": 0.0, "Izz": 0.0, "Ixy": 1e-4},
        "has an inertia that no body has: .*Ixy = 0.0001",
    ),
    ("not positive", {"m": 1.0, **MOMENTS, "Ixy": 0.03}, "has an inertia that no body has"),
    (
        "about the centre of mass",
        {"m": 5.0, **MOMENTS, "mx": 0.0, "my": 0.0, "mz": 2.0},
        "about the joint's origin .*check signs and frame",
    ),
]


@pytest.mark.parametrize(
    ("known", "words"), [case[1:] for case in IMPOSSIBLE], ids=[case[0] for case in IMPOSSIBLE]
)
def test_a_payload_that_no_body_is_is_refused(known: dict[str, Any], words: str) -> None:
    with pytest.raises(ident.ModelError, match=words):
        ident.Payload("disc", "flange", known)


def test_a_point_mass_and_a_rounded_drawing_are_bodies() -> None:
    centre_m = np.array([0.1, 0.2, 0.3])
    inertia_kg_m2 = np.zeros((3, 3))
    point = Body(2.0, centre_m, inertia_kg_m2).parameters
    ident.Payload("point", "flange", dict(zip(LINK_PARAMETERS, point.tolist(), strict=True)))
    ident.Payload("point at the origin", "flange", {"m": 2.0, **dict.fromkeys(MOMENTS, 0.0)})
    plate = {"Ixx": 0.0500, "Ixy": 0.0, "Ixz": 0.0, "Iyy": 0.0500, "Iyz": 0.0, "Izz": 0.1001}
    ident.Payload("plate", "flange", {"m": 4.0, **plate})


@pytest.mark.parametrize("tolerance_kg", [-0.1, np.nan, np.inf, "0.1"])
def test_a_tolerance_is_zero_or_more(tolerance_kg: Any) -> None:
    with pytest.raises(ident.ModelError, match=r"mass.tolerance.*expected"):
        ident.Payload("disc", "flange", {"m": 4.59}, mass_tolerance_kg=tolerance_kg)


def _cuboid() -> Body:
    """12 kg of 0.2 m, 0.4 m and 0.6 m, its centre beside the joint."""
    sides_m = np.array([0.2, 0.4, 0.6])
    squares = sides_m**2
    # m/12 (b² + c²) for each axis.
    inertia = np.diag(squares.sum() - squares)
    return Body(12.0, np.array([0.1, -0.2, 0.3]), inertia)


def test_parameters_of_a_cuboid_are_those_of_huygens_and_steiner() -> None:
    parameters = dict(zip(LINK_PARAMETERS, _cuboid().parameters, strict=True))
    assert parameters["m"] == 12.0
    assert [parameters[name] for name in ("mx", "my", "mz")] == pytest.approx([1.2, -2.4, 3.6])
    # 0.4² + 0.6² = 0.52, and 12 (0.2² + 0.3²) = 1.56.
    assert parameters["Ixx"] == pytest.approx(0.52 + 1.56)
    assert parameters["Iyy"] == pytest.approx(0.40 + 1.20)
    assert parameters["Izz"] == pytest.approx(0.20 + 0.60)
    # −m cx cy and so on.
    assert parameters["Ixy"] == pytest.approx(0.24)
    assert parameters["Ixz"] == pytest.approx(-0.36)
    assert parameters["Iyz"] == pytest.approx(0.72)


def test_a_body_comes_back_from_its_parameters() -> None:
    body = _cuboid()
    again = body_of(body.parameters)
    assert again.mass_kg == 12.0
    np.testing.assert_allclose(again.centre_m, body.centre_m, rtol=1e-12)
    np.testing.assert_allclose(again.inertia_kg_m2, body.inertia_kg_m2, atol=1e-12)


def test_the_pseudo_inertia_has_the_second_moments_of_mass() -> None:
    pseudo = pseudo_inertia(_cuboid().parameters)
    # ∫ x² dm = m (a²/12 + cx²), and so on; off the diagonal m cx cy.
    centre_m = np.array([0.1, -0.2, 0.3])
    expected = np.diag([0.04, 0.16, 0.36]) + 12.0 * np.outer(centre_m, centre_m)
    np.testing.assert_allclose(pseudo[:3, :3], expected, atol=1e-12)
    np.testing.assert_allclose(pseudo[3], [*(12.0 * centre_m), 12.0], atol=1e-12)
    np.testing.assert_allclose(pseudo, pseudo.T)


def test_parameters_come_back_from_the_pseudo_inertia_and_from_its_mean() -> None:
    parameters = _cuboid().parameters
    pseudo = pseudo_inertia(parameters)
    np.testing.assert_allclose(link_parameters(pseudo), parameters, atol=1e-12)
    askew = np.zeros((4, 4))
    askew[0, 1] = 0.7
    askew[1, 0] = -0.7
    np.testing.assert_allclose(link_parameters(pseudo + askew), parameters, atol=1e-12)


def test_names_that_no_parameter_has_are_listed_with_those_there_are() -> None:
    with pytest.raises(ident.ModelError, match="parameters 'M', 'mass'; expected names among Ixx"):
        ident.Payload("disc", "flange", {"mass": 4.0, "M": 1.0})


def test_known_parameters_are_in_order_and_zero_where_unknown() -> None:
    known = ident.Payload("disc", "flange", {"mz": 0.3, "m": 4.0}).known_parameters
    assert known.tolist() == [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.3, 4.0]
