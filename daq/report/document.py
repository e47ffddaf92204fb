"""What a verb prints under `--json`: one frozen type a document;
its JSON and its published schema are made of it.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import is_dataclass
from datetime import datetime
from enum import Enum
from pathlib import Path
from typing import Any, Self

from pydantic import ConfigDict, Field, model_validator

from daq.config.yaml_file import StrictModel
from daq.report.text import spelled_bytes

Figure = float | None
"""A number that may not be known, which is null."""


class Report(StrictModel):
    """A JSON document, or a part of one; when it is made, numbers that JSON lacks become null.

    A part may be given as the frozen dataclass whose attributes it has. The published schema
    describes a field by the text below it.
    """

    model_config = ConfigDict(use_attribute_docstrings=True)

    @classmethod
    def of(cls, *sources: object, **others: Any) -> Self:
        """Return the document of an object: `others`, and its attributes for the other fields,
        by their names.

        Args:
            sources: the object, or several; the first that has an attribute gives it. One that is
                None comes after the others: it gives null to what they lack.
            others: fields that no source has, or not as the document says them.
        """
        given: dict[str, Any] = {}
        for source in reversed(sources):
            given |= _attributes(cls, source)
        given |= {name: _plain(value) for name, value in others.items()}
        return cls(**given)

    @model_validator(mode="before")
    @classmethod
    def _make_valid(cls, values: Any) -> Any:
        if is_dataclass(values):
            values = _attributes(cls, values)
        return json_safe(values, _without_surrogates)


class ErrorReport(Report):
    """One line on stderr for a command that failed."""

    error: str
    """subject, or the whole message where that says what was found"""
    found: str
    expected: str
    do: str
    exit_code: int
    kind: str
    """class of the error"""
    kept: str = ""
    """files that were written before"""
    hint: str = ""
    axes: str = ""
    """axes that had power and are not confirmed without it"""
    unconfirmed: list[str] = Field(default=[])
    """what could not be confirmed"""


def _attributes(kind: type[Report], source: object) -> dict[str, Any]:
    """Return the attributes of an object that are fields of a document;
    null for each of them without an object.
    """
    if source is None:
        return dict.fromkeys(
            name for name, field in kind.model_fields.items() if field.is_required()
        )
    return {
        name: _plain(getattr(source, name)) for name in kind.model_fields if hasattr(source, name)
    }


def _plain(value: Any) -> Any:
    """Return an attribute as documents have it:
    a path or time as text, a tuple or array as a list.
    """
    if hasattr(value, "tolist"):  # an array of numpy, or a number from one
        value = value.tolist()
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, datetime):
        return value.isoformat()
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, Mapping):
        return {_plain(key): _plain(item) for key, item in value.items()}
    return value


def json_tree(report: Report) -> dict[str, Any]:
    """Return a document as mappings, lists, text and numbers;
    a key with a default is left out where none was given.
    """
    tree: dict[str, Any] = json_safe(
        report.model_dump(mode="json", exclude_unset=True), _with_surrogates
    )
    return tree


def json_text(report: Report) -> str:
    """Return a document as JSON with a line end;
    bytes of file names that are not UTF-8 are spelled out.
    """
    tree = json_tree(report)
    text = json.dumps(tree, indent=2, ensure_ascii=False, allow_nan=False)
    return spelled_bytes(f"{text}\n")


def json_safe(value: Any, change: Callable[[str], str] = str) -> Any:
    """Copy a document with null for numbers that JSON lacks, and with other texts."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, str):
        return change(value)
    if isinstance(value, dict):
        return {json_safe(key, change): json_safe(item, change) for key, item in value.items()}
    if isinstance(value, list):
        return [json_safe(item, change) for item in value]
    if isinstance(value, tuple):
        return tuple(json_safe(item, change) for item in value)
    return value


_SURROGATE = re.compile("[\ud800-\udfff]")
"""A byte of a file name that is not UTF-8, as Python reads it; pydantic takes no text with one."""
#: Before the digits of a surrogate while it is in a type: no character, so no text has it
_MARK = "\ufdd0"
_MARKED = re.compile(f"{_MARK}([0-9a-f]{{4}})")


def _without_surrogates(text: str) -> str:
    return _SURROGATE.sub(lambda found: f"{_MARK}{ord(found[0]):04x}", text)


def _with_surrogates(text: str) -> str:
    return _MARKED.sub(lambda found: chr(int(found[1], 16)), text)
