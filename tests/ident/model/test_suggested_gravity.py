"""A gravity that is to be typed in has no digits of noise."""

from __future__ import annotations

import numpy as np
import pytest

from ident.model.suggested_gravity import suggested_gravity


@pytest.mark.parametrize(
    ("found", "std_deg", "expected"),
    [
        ([0.003, -0.012, -9.81], 0.1, [0.0, 0.0, -9.81]),
        ([-0.001, 0.002, -9.808], 0.02, [0.0, 0.0, -9.808]),
        ([0.0, 9.8066, 0.001], 0.1, [0.0, 9.8066, 0.0]),
        ([0.3423, 0.0021, -9.8041], 0.02, [0.342, 0.0, -9.804]),
        ([0.3423, 0.0321, -9.8041], 0.02, [0.342, 0.032, -9.804]),
        ([0.3423, 0.0321, -9.8041], 0.2, [0.34, 0.0, -9.8]),
        ([0.1, 0.2, -9.8], 40.0, [0.0, 0.0, -9.8026]),
        ([0.1, 0.2, -9.8], 0.0, [0.1, 0.2, -9.8]),
    ],
)
def test_digits_of_noise_are_left_out(
    found: list[float], std_deg: float, expected: list[float]
) -> None:
    std_m_s2 = float(np.linalg.norm(found) * np.radians(std_deg))
    found_m_s2 = np.array(found)
    suggested = suggested_gravity(found_m_s2, np.full(3, std_m_s2))
    assert suggested.tolist() == pytest.approx(expected, abs=1.5e-4)
    assert not np.any(np.signbit(suggested[suggested == 0.0]))


def test_a_component_that_is_known_well_stays_beside_one_that_is_noise() -> None:
    """Moves may show one of the two turns of gravity alone."""
    found_m_s2 = np.array([0.069, 0.02, -9.81])
    std_m_s2 = np.array([0.009, 0.09, 0.0])
    suggested = suggested_gravity(found_m_s2, std_m_s2)
    assert suggested[0] == pytest.approx(0.069, abs=1e-4)
    assert suggested[1] == 0.0
