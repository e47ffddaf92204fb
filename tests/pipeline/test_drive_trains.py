"""The simulated cell and the identification each have their own rule of the gears:
here they are held to each other.
"""

from __future__ import annotations

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from drivers.simulation.plant import motor_rows, reduction
from ident.model.model import DriveTrain

ENTRY = st.sampled_from((0.0, 0.0, 0.0, 1.0, -1.0, 32.0, 45.0, -48.0, 101.5))


@st.composite
def ratios(draw: st.DrawFn) -> list[list[float]]:
    """Square matrices with zeros, also on the diagonal, and negative ratios."""
    n = draw(st.integers(1, 6))
    row = st.lists(ENTRY, min_size=n, max_size=n)
    return draw(st.lists(row, min_size=n, max_size=n))


@given(ratios())
def test_both_rooms_have_the_same_reduction(rows: list[list[float]]) -> None:
    ratio = np.array(rows)
    assume(np.linalg.matrix_rank(ratio) == len(ratio) and np.linalg.cond(ratio) < 1e6)
    train = DriveTrain(ratio)
    np.testing.assert_array_equal(reduction(ratio), train.reduction)
    np.testing.assert_allclose(motor_rows(ratio), train.direction, rtol=1e-14)


def test_a_motor_that_does_not_drive_its_own_joint_has_its_largest_ratio() -> None:
    """A differential: both motors drive both joints, crossed."""
    ratio = np.array([[0.0, -40.0, 10.0], [20.0, 0.0, 0.0], [0.0, 0.0, 30.0]])
    np.testing.assert_array_equal(reduction(ratio), [-40.0, 20.0, 30.0])
    np.testing.assert_array_equal(DriveTrain(ratio).reduction, [-40.0, 20.0, 30.0])
