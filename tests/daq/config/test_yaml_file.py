"""Strict YAML refuses what it would otherwise have to guess."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field

from daq.config.cell_schema import CellModel
from daq.config.drive import DriveModel
from daq.config.import_description import ImportDescription
from daq.config.yaml_file import (
    MAX_BYTES,
    PATTERNS,
    StrictModel,
    parse_yaml,
    read_model,
    read_yaml_bytes,
)
from daq.errors import ConfigurationError, ConfigurationMissing, SchemaMismatch, YamlInvalid
from daq.simulation.simulation_file import SimulationModel


class _Limits(StrictModel):
    velocity_deg_s: float
    range_deg: tuple[float, float] = (0.0, 1.0)


class _Axis(StrictModel):
    name: str
    limits: _Limits


class _File(StrictModel):
    axes: Annotated[tuple[_Axis, ...], Field(min_length=1)]
    bodies: dict[str, _Limits] = Field(default_factory=dict)


def _read(text: str) -> _File:
    document = parse_yaml(text.encode(), "file.yaml")
    return read_model(document, _File)


def test_a_good_file_is_read() -> None:
    file = _read("axes:\n  - {name: J1, limits: {velocity_deg_s: 1e-3, range_deg: [-1, 2]}}\n")
    assert file.axes[0].limits.velocity_deg_s == 1e-3
    expected = (-1.0, 2.0)
    assert file.axes[0].limits.range_deg == expected


@pytest.mark.parametrize(
    ("text", "where", "found", "expected"),
    [
        (
            "axes:\n - name: J1\n   limits: {velocity_deg: 3}\n",
            "axes[0].limits.velocity_deg",
            "unknown key",
            "velocity_deg_s",
        ),
        (
            "axes:\n - name: J1\n   limits: {velocity_deg_s: fast}\n",
            "axes[0].limits.velocity_deg_s",
            '"fast"',
            "number",
        ),
        (
            "axes:\n - name: J1\n   limits: {velocity_deg_s: '3'}\n",
            "axes[0].limits.velocity_deg_s",
            '"3"',
            "number",
        ),
        (
            "axes:\n - name: J1\n   limits: {velocity_deg_s: true}\n",
            "axes[0].limits.velocity_deg_s",
            "true",
            "number",
        ),
        (
            "axes:\n - name: J1\n   limits: {velocity_deg_s: .nan}\n",
            "axes[0].limits.velocity_deg_s",
            "NaN",
            "finite",
        ),
        (
            "axes:\n - name: 1\n   limits: {velocity_deg_s: 1}\n",
            "axes[0].name",
            "integer 1",
            "string",
        ),
        ("axes:\n - name: J1\n", "axes[0].limits", "nothing", "required"),
        ("axes: []\n", "axes", "list []", "at least 1"),
        (
            "bodies: {disc: {velocity_deg_s: 1, rang_deg: [1, 2]}}\naxes: 3\n",
            "bodies.disc.rang_deg",
            "unknown",
            "range_deg",
        ),
        ("- 1\n", "the whole file", "list [1]", "object"),
        ("", "the whole file", "null", "object"),
    ],
)
def test_a_mistake_is_named_with_place_found_and_expected(
    text: str, where: str, found: str, expected: str
) -> None:
    with pytest.raises(SchemaMismatch) as caught:
        _read(text)
    message = str(caught.value)
    assert where in message
    assert found in message
    assert expected in message


def test_all_mistakes_come_at_once_with_their_lines() -> None:
    with pytest.raises(SchemaMismatch, match="2 faults") as caught:
        _read("axes:\n  - name: J1\n    limits:\n      velocity_deg_s: x\n      colour: red\n")
    assert "file.yaml:4: axes[0].limits.velocity_deg_s" in str(caught.value)
    assert "file.yaml:5: axes[0].limits.colour" in str(caught.value)


@pytest.mark.parametrize("model", [CellModel, DriveModel, ImportDescription, SimulationModel])
def test_the_remedy_names_a_page_with_every_key(model: type[StrictModel], checkout: Path) -> None:
    """The page is made from the schema: its keys, or a link to it."""
    with pytest.raises(SchemaMismatch) as caught:
        read_model(parse_yaml(b"colour: red\n", "file.yaml"), model)
    page = checkout / "docs/reference" / model.reference
    expected = f"docs/reference/{page.name} has every key"
    assert expected in caught.value.remedy
    text = page.read_text(encoding="utf-8")
    assert re.search("^<!-- generated: (cell file|schemas) -->$", text, re.MULTILINE)


@pytest.mark.parametrize(
    ("text", "line", "found"),
    [
        ("a: 1\nb: 2\na: 3\n", ":3", "duplicate key 'a', first on line 1"),
        ("a:\n  b: 1\n  b: 2\n", ":3: a.b", "duplicate key 'b'"),
        ("a: &x [1]\nb: *x\n", ":2", "alias"),
        ("a: !!python/name:os.system\n", ":1: a", "tag"),
        ("a: [1, 2\nb: 3\n", ":2", ""),
        ("a: 1\n---\nb: 2\n", ":2", "a second document, behind `---`"),
        ("1: x\n", ":1", "key '1'"),
        ("? [a, b]\n: x\n", ":1", "a sequence as a key"),
        ("a:\n\tb: 1\n", ":2", ""),
        ('a: "\\ud800"\n', ":1", "found invalid Unicode character"),
        ("a: \xff\x00", "", ""),
        ("[" * 3000, ":1", "lists in lists"),
        ("a: [" + "1," * 60_000 + "]", ":1", "more than 50000 values"),
        ("\n".join(f"k{k}: 1" for k in range(30_000)), ":25000", "more than 50000 values"),
    ],
)
def test_what_yaml_allows_and_a_configuration_must_not(text: str, line: str, found: str) -> None:
    with pytest.raises(YamlInvalid) as caught:
        parse_yaml(text.encode("latin-1"), "file.yaml")
    assert f"file.yaml{line}" in str(caught.value)
    assert found in str(caught.value)
    assert "found found" not in str(caught.value)
    assert "Node(" not in str(caught.value)


@pytest.mark.parametrize("character", ["\u0085", "\u2028", "\u2029"])
def test_a_character_that_ends_a_line_and_is_not_to_be_seen_is_named_where_it_breaks_the_file(
    character: str,
) -> None:
    text = f"a: 1\nname: press{character}4\nb: 2\n"
    with pytest.raises(YamlInvalid) as caught:
        parse_yaml(text.encode(), "cell.yaml")
    assert f"U+{ord(character):04X}" in str(caught.value)
    assert "remove that character" in str(caught.value)

    # Logs of before have such files: where nothing is broken by it, it is read.
    in_quotes = f'a: 1\nname: "press{character}4"\n'
    assert parse_yaml(in_quotes.encode(), "cell.yaml").tree["a"] == 1
    in_comment = f"# one{character}\na: 1\n"
    assert parse_yaml(in_comment.encode(), "cell.yaml").tree == {"a": 1}


def test_a_tab_before_a_comment_is_read() -> None:
    """A tab indents nothing there (YAML 1.2, 6.6)."""
    document = parse_yaml(b"bus:\t# the left one\n  channel: can0\t\t# tabs\n", "cell.yaml")
    assert document.tree == {"bus": {"channel": "can0"}}


def _patterns(schema: object) -> Iterator[str]:
    """Yield each pattern of a text in a JSON schema."""
    if isinstance(schema, dict):
        if isinstance(schema.get("pattern"), str):
            yield schema["pattern"]
        for part in schema.values():
            yield from _patterns(part)
    elif isinstance(schema, list):
        for part in schema:
            yield from _patterns(part)


@pytest.mark.parametrize("model", [CellModel, DriveModel, ImportDescription, SimulationModel])
def test_a_message_says_in_words_what_a_pattern_allows(model: type[StrictModel]) -> None:
    patterns = set(_patterns(model.model_json_schema()))
    assert patterns
    assert patterns <= set(PATTERNS)


def test_a_name_with_other_characters_is_refused_in_words() -> None:
    with pytest.raises(SchemaMismatch) as caught:
        read_model(parse_yaml(b"name: ../../evil\n", "file.yaml"), CellModel)
    assert "beginning with a letter, a digit or _" in str(caught.value)
    assert "pattern" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("no", "no"),
        ("on", "on"),
        ("12:30:00", "12:30:00"),
        ("2024-01-01", "2024-01-01"),
        ("017", "017"),
        ("0x1F", 31),
    ],
)
def test_scalars_are_those_of_yaml_1_2(text: str, value: object) -> None:
    yaml = parse_yaml(f"a: {text}\n".encode(), "file.yaml")
    assert yaml.tree == {"a": value}


@given(st.binary(max_size=200))
def test_any_bytes_give_a_document_or_a_named_error(data: bytes) -> None:
    try:
        read_model(parse_yaml(data, "file.yaml"), _File)
    except ConfigurationError as error:
        assert error.subject.startswith("file.yaml")


def test_a_pipe_or_a_device_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    # Opened for reading as usual, the one would be waited for, and the other never end.
    for path in (tmp_path / "pipe", Path("/dev/zero")):
        with pytest.raises(ConfigurationMissing, match="no regular file"):
            read_yaml_bytes(path)


def test_of_a_file_that_is_too_large_little_is_read(tmp_path: Path) -> None:
    path = tmp_path / "large.yaml"
    with path.open("wb") as stream:
        stream.truncate(2**40)  # a hole: it would fill the memory, not the disk
    pattern = f"more than {MAX_BYTES} bytes"
    with pytest.raises(ConfigurationMissing, match=pattern):
        read_yaml_bytes(path)
    with path.open("wb") as stream:
        stream.truncate(MAX_BYTES)
    assert len(read_yaml_bytes(path)) == MAX_BYTES


def test_a_folder_is_no_configuration(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationMissing, match="directory"):
        read_yaml_bytes(tmp_path)


def test_a_missing_file_of_the_command_line_is_sought_in_the_current_folder(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationMissing, match="on a command line to the current folder"):
        read_yaml_bytes(tmp_path / "none.yaml")


@pytest.mark.parametrize(
    "text", ["0x" + "f" * 9999, "0x1" + "0" * 16, "9" * 4000, "-" + "9" * 4000, "9" * 9999]
)
def test_an_integer_that_nothing_can_hold_is_reported(text: str) -> None:
    with pytest.raises(YamlInvalid):
        _read(f"axes:\n  - {{name: J1, limits: {{velocity_deg_s: {text}}}}}\n")


@given(st.integers(-(2**64) + 1, 2**64 - 1))
def test_every_other_integer_is_what_was_written(value: int) -> None:
    written = f"0x{value:x}" if value >= 0 else str(value)
    text = f"a: {written}".encode()
    tree = parse_yaml(text, "x").tree
    assert tree == {"a": value}


def test_bytes_of_another_encoding_are_named_with_their_line() -> None:
    """It was the name of a class of the parser, without a line."""
    text = "name: press\n# für die Zelle 4\n".encode("latin-1")
    with pytest.raises(YamlInvalid, match=r"cell\.yaml:2: found byte 0xfc.*save the file as UTF-8"):
        parse_yaml(text, "cell.yaml")
