"""Payloads that no body can be are refused; those that a drawing gives, rounded, are not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import ident
from ident.model.bodies import LINK_PARAMETERS, Body

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
    plate = {"Ixx": 0.0500, "Ixy": 0.0, "Ixz": 0.0, "Iyy": 0.0500, "Iyz": 0.0, "Izz": 0.1001}
    ident.Payload("plate", "flange", {"m": 4.0, **plate})


@pytest.mark.parametrize("tolerance_kg", [-0.1, np.nan, np.inf, "0.1"])
def test_a_tolerance_is_zero_or_more(tolerance_kg: Any) -> None:
    with pytest.raises(ident.ModelError, match=r"mass.tolerance.*expected"):
        ident.Payload("disc", "flange", {"m": 4.59}, mass_tolerance_kg=tolerance_kg)
