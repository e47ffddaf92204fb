"""Numbers in messages, written so that they show on which side of a limit they are."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ident.plausible import format_at_limit

Numbers = st.floats(-1e6, 1e6, allow_nan=False)


@given(
    value=Numbers,
    limit=st.floats(1e-3, 1e5),
    digits=st.integers(0, 4),
    form=st.sampled_from(["f", "g", "+f", "+g"]),
)
def test_a_number_shows_on_which_side_of_its_limit_it_is(
    value: float, limit: float, digits: int, form: str
) -> None:
    shown = format_at_limit(value, limit, digits, form)
    assert (abs(float(shown)) > limit) == (abs(value) > limit)
    usual = f"{value:{form[:-1]}.{digits}{form[-1]}}"
    if (abs(float(usual)) > limit) == (abs(value) > limit):
        assert shown == usual


@pytest.mark.parametrize(
    ("value", "shown"),
    [(1.004, "1.004"), (0.996, "1.00"), (1.0, "1.00"), (1.00002, "1.00002"), (1.2, "1.20")],
)
def test_a_number_has_no_more_digits_than_its_limit_needs(value: float, shown: str) -> None:
    assert format_at_limit(value, 1.0, 2) == shown


def test_what_is_no_number_is_said_as_such() -> None:
    assert format_at_limit(math.nan, 1.0, 2) == "nan"
    assert format_at_limit(math.inf, 1.0, 2) == "inf"
