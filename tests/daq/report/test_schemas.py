"""Published schemas of the documents under `--json`: every type that a verb prints has one."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from types import ModuleType, SimpleNamespace, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import pytest
from pydantic import TypeAdapter

import daq.report
from daq.cli.app import VERBS
from daq.report.document import ErrorReport, Report
from daq.report.job_schemas import ProposalReport
from daq.report.residual_document import ResidualFile
from daq.report.schemas import REPORTS
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
    schema = TypeAdapter(report).json_schema()
    objects = list(_objects(schema))
    assert objects
    of_ident = {Source.__name__, "Recording", Diagnosis.__name__}
    assert {
        one["title"] for one in objects if one.get("additionalProperties") is not False
    } <= of_ident


def test_every_verb_with_json_has_a_schema() -> None:
    def takes_json(command: Any) -> bool:
        kinds = getattr(command, "commands", {}).values()
        return any(param.name == "json" for param in command.params) or any(map(takes_json, kinds))

    with_json = {verb.name for verb in VERBS if takes_json(verb.command())}
    assert with_json == REPORTS.keys()


FILES = (ProposalReport, ResidualFile)
"""Documents that are written into files and printed by no verb."""


def _reports_in(kind: Any) -> Iterator[type[Report]]:
    """Types of documents in an annotation, with their bases and all their parts."""
    if isinstance(kind, type) and issubclass(kind, Report):
        yield from (base for base in kind.__mro__ if issubclass(base, Report))
        for field in kind.model_fields.values():
            yield from _reports_in(field.annotation)
    for part in get_args(kind):
        yield from _reports_in(part)


def _subclasses(kind: type[Report]) -> Iterator[type[Report]]:
    for child in kind.__subclasses__():
        yield child
        yield from _subclasses(child)


def test_every_type_of_a_document_is_published() -> None:
    """Or is part of one that is: what no schema has, a verb must not print."""
    for module in pkgutil.iter_modules(daq.report.__path__, "daq.report."):
        importlib.import_module(module.name)
    made = {kind for kind in _subclasses(Report) if kind.__module__.startswith("daq.")}
    published = set()
    for kind in (*REPORTS.values(), ErrorReport, *FILES):
        for found in _reports_in(kind):
            published.add(found)
    assert {kind.__name__ for kind in made - published} == set()


def _kinds(annotation: Any) -> set[Any]:
    """Members of a union."""
    if get_origin(annotation) in (Union, UnionType):
        return set(get_args(annotation))
    return {annotation}


def _named(module: ModuleType, tree: ast.Module, name: str) -> Any:
    """What a name of a module is, also where a verb imports it when it runs."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and name in {
            one.asname or one.name for one in node.names
        }:
            return getattr(importlib.import_module(str(node.module)), name)
    return getattr(module, name)


def _made_by(module: ModuleType, tree: ast.Module, value: ast.expr) -> set[Any]:
    """Types of a value: of a call, or of what is assigned to a name."""
    if isinstance(value, ast.Name):
        places = [node for node in ast.walk(tree) if isinstance(node, ast.Assign)]
        given = []
        for one in places:
            if value.id in {getattr(target, "id", "") for target in one.targets}:
                given.append(one.value)
        return set[Any]().union(*(_made_by(module, tree, one) for one in given))
    assert isinstance(value, ast.Call), ast.unparse(value)
    assert isinstance(value.func, ast.Name), ast.unparse(value)
    called = _named(module, tree, value.func.id)
    if isinstance(called, type):
        return {called}
    # Alone: what the arguments are may be imported for the type checker only.
    alone = SimpleNamespace(__annotations__={"return": called.__annotations__["return"]})
    annotation = get_type_hints(alone, called.__globals__)["return"]
    return _kinds(annotation)


def _module_of(place: str) -> str:
    return place.partition(":")[0]


@pytest.mark.parametrize("place", sorted({_module_of(verb.place) for verb in VERBS}))
def test_a_verb_prints_the_types_that_are_published_for_it(place: str) -> None:
    """Modules with verbs, and those with kinds of these verbs."""
    verbs = [verb for verb in VERBS if _module_of(verb.place) == place]
    places = {place}
    for verb in verbs:
        places.update(_module_of(kind.place) for kind in verb.kinds)
    printed = set[Any]()
    for one in places:
        module = importlib.import_module(one)
        tree = ast.parse(inspect.getsource(module))
        nodes = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
        calls = [node for node in nodes if ast.unparse(node.func) == "print_json"]
        printed = printed.union(*(_made_by(module, tree, call.args[0]) for call in calls))
    names = [verb.name for verb in verbs]
    expected = set[Any]().union(*(_kinds(REPORTS[name]) for name in names if name in REPORTS))
    assert printed == expected
