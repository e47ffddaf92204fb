"""What a verb prints under `--json`: one frozen type a document; its JSON and its published schema are made of it."""

from __future__ import annotations

import json
import math
import re
from typing import Any

from pydantic import model_validator

from daq.config.yaml_file import StrictModel
from daq.report.text import spelled_bytes

Figure = float | None
"""A number that may not be known, which is null."""


class Report(StrictModel):
    """A JSON document, or a part of one.

    When it is made, numbers that JSON lacks become null, and bytes of file names that are not UTF-8 are spelled out.
    """

    @model_validator(mode="before")
    @classmethod
    def _as_json_has_it(cls, values: Any) -> Any:
        return _as_json_has_it(values)


def _as_json_has_it(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, str):
        return spelled_bytes(value)
    if isinstance(value, dict):
        return {_as_json_has_it(key): _as_json_has_it(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_as_json_has_it(item) for item in value]
    if isinstance(value, tuple):
        return tuple(_as_json_has_it(item) for item in value)
    return value


def json_tree(report: Report) -> dict[str, Any]:
    """Return a document as mappings, lists, text and numbers; a key with a default is left out where none was given."""
    tree: dict[str, Any] = report.model_dump(mode="json", exclude_unset=True)
    return tree


_SPELLED = re.compile(r"\\\\(ud[c-f][0-9a-f]{2})")
"""A byte that is not UTF-8, as `spelled_bytes` spells it, in the text of a JSON string."""


def json_text(report: Report) -> str:
    """Return a document as JSON with a line end.

    A byte of a file name that is not UTF-8 is the escape of its surrogate: Python reads the same name from it.
    """
    text = json.dumps(json_tree(report), indent=2, ensure_ascii=False, allow_nan=False)
    return _SPELLED.sub(r"\\\1", text) + "\n"
