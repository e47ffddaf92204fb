"""Every error of the three packages travels whole from one process to another:
a process pool hangs otherwise.
"""

from __future__ import annotations

import copy
import importlib
import inspect
import pickle
import pkgutil
from collections.abc import Iterator
from itertools import chain
from typing import Any

import pytest

import daq
import drivers
import ident
from daq.errors import DaqError
from drivers.errors import DriverError
from drivers.profiles.profile import Axis
from ident.errors import IdentificationError

ROOTS = (DaqError, DriverError, IdentificationError)
EVIDENCE: dict[str, object] = {
    "str": "some text",
    "str | None": "some text",
    "int": 3,
    "int | None": 0x8611,
    "float": 0.25,
    "float | None": 0.25,
    "Node": Axis("J3", 3),
    "Sequence[Node]": (Axis("J3", 3), 4),
    "Sequence[str]": ("J2", "J5"),
    "tuple[int, ...]": (2, 5),
    "tuple[float, ...]": (0.5, 2.0),
    "tuple[str, ...]": ("J2", "J5"),
}
"""What an argument of that type is tried with."""


def _kinds() -> tuple[type[Exception], ...]:
    for package in (daq, drivers, ident):
        for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
            importlib.import_module(module.name)
    kinds = set(chain.from_iterable(_below(root) for root in ROOTS))
    return tuple(sorted(kinds, key=lambda kind: kind.__qualname__))


def _below(kind: type[Any]) -> Iterator[type[Exception]]:
    yield kind
    for sub in kind.__subclasses__():
        if sub.__module__.split(".")[0] in {"daq", "drivers", "ident"}:
            yield from _below(sub)


def _made(kind: type[Exception]) -> Exception:
    if kind.__init__ is Exception.__init__:
        return kind("some text")
    parameters = inspect.signature(kind).parameters
    given = [p for p in parameters.values() if p.kind is not p.VAR_POSITIONAL]
    by_name = {p.name: EVIDENCE[p.annotation] for p in given if p.kind is p.KEYWORD_ONLY}
    return kind(*[EVIDENCE[p.annotation] for p in given if p.kind is not p.KEYWORD_ONLY], **by_name)


KINDS = _kinds()


def test_the_three_trees_are_there() -> None:
    assert set(ROOTS) < set(KINDS)
    assert len(KINDS) > 50


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__qualname__)
@pytest.mark.parametrize("protocol", [2, pickle.HIGHEST_PROTOCOL])
def test_an_error_arrives_with_its_message_its_evidence_and_its_notes(
    kind: type[Exception], protocol: int
) -> None:
    sent = _made(kind)
    sent.add_note("while stopping: node 3 did not answer")
    for arrived in (pickle.loads(pickle.dumps(sent, protocol)), copy.copy(sent)):
        assert type(arrived) is kind
        assert str(arrived) == str(sent) != ""
        assert arrived.args == sent.args
        assert vars(arrived) == vars(sent)
        assert arrived.__notes__ == sent.__notes__
