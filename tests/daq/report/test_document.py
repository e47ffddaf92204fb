"""Documents as JSON: numbers that it lacks, names that are no text, keys that are left out."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daq.report.document import Figure, Report, json_text, json_tree


class Part(Report):
    """A part of the document."""

    name: str
    sigma: Figure


class Whole(Report):
    """A document with a key that may be left out."""

    parts: list[Part]
    sizes: tuple[Figure, ...]
    by_name: dict[str, Figure]
    remark: str = ""


NAMES = st.text(
    st.characters(min_codepoint=1, max_codepoint=0x2FF) | st.sampled_from("\udc80\udcff\\udcff")
)


@given(name=NAMES)
def test_a_name_of_any_bytes_comes_back_from_the_document(name: str) -> None:
    parts = [Part(name=name, sigma=1.0)]
    made = Whole(parts=parts, sizes=(), by_name={name: 2.0})
    document = json.loads(json_text(made))
    assert document == json_tree(made)
    first_part = json_tree(made)["parts"][0]
    assert first_part["name"] == name
    by_name = json_tree(made)["by_name"]
    assert list(by_name) == [name]


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_a_number_that_json_lacks_is_null_wherever_it_is(number: float) -> None:
    parts = [Part(name="J1", sigma=number)]
    made = Whole(parts=parts, sizes=(1.0, number), by_name={"J1": number})
    expected = {
        "parts": [{"name": "J1", "sigma": None}],
        "sizes": [1.0, None],
        "by_name": {"J1": None},
    }
    assert json_tree(made) == expected


def test_a_key_with_a_default_is_there_where_it_was_given() -> None:
    report = Whole(parts=[], sizes=(), by_name={})
    assert "remark" not in json_tree(report)
    whole = Whole(parts=[], sizes=(), by_name={}, remark="")
    assert json_tree(whole)["remark"] == ""


@dataclass(frozen=True)
class Measured:
    """What a document is made of."""

    name: Path
    sigma: float
    other: str = "no field of the document"


class Measurement(Report):
    """A document with parts that are dataclasses."""

    first: Part
    parts: list[Part]
    name: str
    sigma: Figure


def test_a_document_takes_the_attributes_of_its_sources_by_name_and_the_first_source_wins() -> None:
    one = Measured(Path("a"), math.inf)
    two = Measured(Path("b"), 2.0)
    made = Measurement.of(one, two, first=two, parts=(one, two), sigma=two.sigma)
    part = {"name": "b", "sigma": 2.0}
    parts = [{"name": "a", "sigma": None}, part]
    expected = {
        "first": part,
        "parts": parts,
        "name": "a",
        "sigma": 2.0,
    }
    assert json_tree(made) == expected


def test_a_source_that_is_none_gives_null_to_what_the_others_lack() -> None:
    report = Part.of(None, name="J1")
    assert json_tree(report) == {"name": "J1", "sigma": None}
