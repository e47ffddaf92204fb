"""What a verb prints under `--json`: one frozen type a document; its JSON and its published schema are made of it."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from typing import Any

from pydantic import model_validator

from daq.config.yaml_file import StrictModel
from daq.report.text import spelled_bytes

Figure = float | None
"""A number that may not be known, which is null."""


class Report(StrictModel):
    """A JSON document, or a part of one; when it is made, numbers that JSON lacks become null."""

    @model_validator(mode="before")
    @classmethod
    def _make_valid(cls, values: Any) -> Any:
        return _changed(values, _without_surrogates)


def json_tree(report: Report) -> dict[str, Any]:
    """Return a document as mappings, lists, text and numbers; a key with a default is left out where none was given."""
    tree: dict[str, Any] = _changed(report.model_dump(mode="json", exclude_unset=True), _with_surrogates)
    return tree


def json_text(report: Report) -> str:
    """Return a document as JSON with a line end; bytes of file names that are not UTF-8 are spelled out."""
    return spelled_bytes(json.dumps(json_tree(report), indent=2, ensure_ascii=False, allow_nan=False) + "\n")


def _changed(value: Any, change: Callable[[str], str]) -> Any:
    """Copy a document with other texts, and with null for numbers that JSON lacks."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, str):
        return change(value)
    if isinstance(value, dict):
        return {_changed(key, change): _changed(item, change) for key, item in value.items()}
    if isinstance(value, list):
        return [_changed(item, change) for item in value]
    if isinstance(value, tuple):
        return tuple(_changed(item, change) for item in value)
    return value


_SURROGATE = re.compile("[\ud800-\udfff]")
"""A byte of a file name that is not UTF-8, as Python reads it; pydantic takes no text with one."""
_MARK = "\ufdd0"  #: Before the digits of a surrogate while it is in a type: no character, so no text has it
_MARKED = re.compile(f"{_MARK}([0-9a-f]{{4}})")


def _without_surrogates(text: str) -> str:
    return _SURROGATE.sub(lambda found: f"{_MARK}{ord(found[0]):04x}", text)


def _with_surrogates(text: str) -> str:
    return _MARKED.sub(lambda found: chr(int(found[1], 16)), text)
