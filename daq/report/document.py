"""What a verb prints under `--json`: one frozen type a document, from which its JSON and its published schema are made."""

from __future__ import annotations

import json
from typing import Any

from pydantic import model_validator

from daq.config.yaml_file import StrictModel
from daq.report.text import json_safe

Figure = float | None
"""A number that may not be known, which is null."""


class Report(StrictModel):
    """A JSON document, or a part of one.

    When it is made, numbers that JSON lacks become null, and bytes of file names that are not UTF-8 are spelled out.
    """

    @model_validator(mode="before")
    @classmethod
    def _make_json_safe(cls, values: Any) -> Any:
        return json_safe(values)


def json_tree(report: Report) -> dict[str, Any]:
    """Return a document as mappings, lists, text and numbers; a key with a default is left out where none was given."""
    tree: dict[str, Any] = report.model_dump(mode="json", exclude_unset=True)
    return tree


def json_text(report: Report) -> str:
    """Return a document as JSON with a line end."""
    return json.dumps(json_tree(report), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
