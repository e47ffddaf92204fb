"""Published schemas of the documents under `--json`; tests/conftest.py holds the documents against them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

from daq.cli import main
from daq.cli.app import VERBS
from daq.report.schemas import REPORTS, ErrorReport
from ident.calibration import Source
from ident.errors import Diagnosis


def _objects(schema: Any) -> Iterator[dict[str, Any]]:
    if isinstance(schema, dict):
        if "properties" in schema:
            yield schema
        for part in schema.values():
            yield from _objects(part)
    elif isinstance(schema, list):
        for part in schema:
            yield from _objects(part)


@pytest.mark.parametrize("report", [*REPORTS.values(), ErrorReport], ids=[*REPORTS, "error"])
def test_a_schema_allows_no_other_key(report: Any) -> None:
    objects = list(_objects(TypeAdapter(report).json_schema()))
    assert objects
    of_ident = {Source.__name__, "Recording", Diagnosis.__name__}
    assert {one["title"] for one in objects if one.get("additionalProperties") is not False} <= of_ident


def test_every_verb_with_json_has_a_schema() -> None:
    def takes_json(command: Any) -> bool:
        kinds = getattr(command, "commands", {}).values()
        return any(param.name == "json" for param in command.params) or any(map(takes_json, kinds))

    with_json = {listed.name for listed in VERBS if takes_json(listed.load().command())}
    assert with_json == REPORTS.keys()


def test_what_a_verb_prints_is_held_against_its_schema(monkeypatch: pytest.MonkeyPatch) -> None:
    """The watch of tests/conftest.py is awake."""
    monkeypatch.setitem(REPORTS, "explain-emcy", ErrorReport)
    with pytest.raises(ValidationError, match="Extra inputs are not permitted"):
        main(["explain-emcy", "8611", "--json"])
