"""What is in public signatures of `ident` can be imported from it,
and `help()` shows signatures that can be read.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import typing
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import ident

OPAQUE = {
    "Arm": "part of `Signals` for effects of the description",
    "Assembly": "of a model; nobody makes one",
    "DemandCache": "of an evidence, for instruments",
    "HeldChannels": "of a dataset, for diagnoses",
    "JudgedChannels": "of a run that was read, for whoever differentiates it",
    "Observation": "rows of an evidence",
    "RunChannels": "of an identification, for diagnoses",
    "RunProgress": "of a growing fit",
    "System": "equations of an identification",
    "TreeMotion": "of a closed chain, between methods of the model",
    "Uncorrected": "of an evidence, for corrections of the description",
}
"""Containers that one function returns inside its result and another one takes,
with what they are.
"""
LONGEST_SIGNATURE = 1000  #: Characters; `Calibration` has 25 fields with defaults


def _public() -> Iterator[tuple[str, Any]]:
    for name in ident.__all__:
        if name != "FloatArray":  # an alias
            yield name, getattr(ident, name)


def _classes_of_the_package() -> dict[str, type]:
    """All classes by name, for annotations of modules that import them for type checkers alone."""
    found: dict[str, type] = {}
    for module in pkgutil.walk_packages(ident.__path__, "ident."):
        for name, value in vars(importlib.import_module(module.name)).items():
            if inspect.isclass(value):
                found.setdefault(name, value)
    return found


def _named_in(hint: Any) -> Iterator[type]:
    """Classes of `ident` in an annotation."""
    if inspect.isclass(hint) and hint.__module__.startswith("ident."):
        yield hint
    for part in typing.get_args(hint):
        inner = part if isinstance(part, list) else [part]
        for one in inner:
            yield from _named_in(one)


def _annotated(thing: Any) -> Iterator[Callable[..., Any]]:
    """A function, or a class with its public methods and properties."""
    yield thing
    if inspect.isclass(thing):
        for name, value in vars(thing).items():
            if isinstance(value, property):
                function = value.fget
            else:
                function = getattr(value, "__func__", value)
            if not name.startswith("_") and inspect.isfunction(function):
                yield function


def test_what_is_in_public_signatures_is_exported() -> None:
    names = _classes_of_the_package()
    missing: dict[str, str] = {}
    for name, thing in _public():
        if inspect.isclass(thing) and issubclass(thing, Exception):
            continue
        for annotated in _annotated(thing):
            hints = typing.get_type_hints(annotated, localns=names)
            for field, hint in hints.items():
                for one in _named_in(hint):
                    if not field.startswith("_") and one.__name__ not in ident.__all__:
                        missing[one.__name__] = name
    assert {name: where for name, where in missing.items() if name not in OPAQUE} == {}
    difference = set(OPAQUE) - set(missing)
    assert sorted(difference) == []


@pytest.mark.parametrize("name", [name for name, thing in _public() if callable(thing)])
def test_a_signature_can_be_read(name: str) -> None:
    thing = getattr(ident, name)
    try:
        signature = inspect.signature(thing)
    except ValueError:  # an enum of Python 3.11
        return
    assert len(str(signature)) <= LONGEST_SIGNATURE
    for parameter in signature.parameters.values():
        is_given = parameter.default is not parameter.empty
        assert not is_given or len(repr(parameter.default)) <= 40, parameter
