"""Checks of the arguments of public functions: an error names function, argument, what it takes."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import wraps
from pathlib import Path
from typing import ParamSpec, TypeGuard, TypeVar

from daq.errors import UsageError

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")
SHOWN_CHARACTERS = 200  #: Of a wrong value in a message


@dataclass(frozen=True, slots=True)
class ExpectedArgument:
    """What an argument takes."""

    described: str  #: for messages
    is_met: Callable[[object], bool]
    hint: str = ""  #: how to write it; the call of the function where empty


def _is_path(value: object) -> bool:
    if not isinstance(value, (str, os.PathLike)):
        return False
    return bool(os.fspath(value))


def _is_list(value: object) -> TypeGuard[Sequence[object]]:
    return isinstance(value, Sequence) and not isinstance(value, (str, bytes))


def _is_list_of_paths(value: object) -> bool:
    return _is_list(value) and all(map(_is_path, value))


def _is_file_to_write(value: object) -> bool:
    return _is_path(value) and not Path(str(value)).is_dir()


def _is_moment(value: object) -> bool:
    return isinstance(value, datetime) and value.tzinfo is not None


def _is_whole(value: object) -> bool:
    if not isinstance(value, int) or isinstance(value, bool):
        return False
    return value >= 0


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def _is_collection_of_texts(value: object) -> bool:
    if not isinstance(value, Collection) or isinstance(value, (str, bytes, Mapping)):
        return False
    return all(map(_is_text, value))


A_PATH = ExpectedArgument("the path of a file, as Path or text", _is_path)
A_FILE_TO_WRITE = ExpectedArgument(
    "the path of a file, and no folder, as Path or text", _is_file_to_write
)
PATHS = ExpectedArgument(
    "a list of paths, each as Path or text", _is_list_of_paths, "give a list: [bare, loaded]"
)
A_MOMENT = ExpectedArgument("a datetime with its time zone", _is_moment, "write datetime.now(UTC)")
A_WHOLE_NUMBER = ExpectedArgument("a whole number, zero or above", _is_whole)
A_FLAG = ExpectedArgument("True or False", lambda value: isinstance(value, bool))
A_FUNCTION = ExpectedArgument("a function", callable)
A_TEXT = ExpectedArgument("a text", _is_text)
TEXTS = ExpectedArgument("a list of texts", _is_collection_of_texts, 'write ["Ada"]')
BYTES = ExpectedArgument("bytes", lambda value: isinstance(value, bytes))
A_PATH_OBJECT = ExpectedArgument(
    "a pathlib.Path", lambda value: isinstance(value, Path), 'write Path("...")'
)
A_NUMBER = ExpectedArgument("a number", _is_number)
A_LIST = ExpectedArgument("a list", _is_list, "write [value]")


def of_kind(kind: type) -> ExpectedArgument:
    """Expect an object of a class."""
    return ExpectedArgument(kind.__name__, lambda value: isinstance(value, kind))


def by_name(values: ExpectedArgument) -> ExpectedArgument:
    """Expect a mapping from names to values of one kind."""

    def is_met(value: object) -> bool:
        if not isinstance(value, Mapping):
            return False
        return all(map(_is_text, value)) and all(map(values.is_met, value.values()))

    return ExpectedArgument(f"a mapping from a name to {values.described}", is_met)


def with_methods(described: str, *names: str) -> ExpectedArgument:
    """Expect an object that has some methods, of whatever class."""

    def is_met(value: object) -> bool:
        return all(callable(getattr(value, name, None)) for name in names)

    return ExpectedArgument(described, is_met)


def optional(expected: ExpectedArgument) -> ExpectedArgument:
    """Expect the same, or None."""

    def is_met(value: object) -> bool:
        return value is None or expected.is_met(value)

    return ExpectedArgument(f"{expected.described}, or None", is_met, expected.hint)


def checks_arguments(
    **expected: ExpectedArgument,
) -> Callable[[Callable[Arguments, Result]], Callable[Arguments, Result]]:
    """Make a function refuse other arguments by name, as a `UsageError`, before it runs.

    Args:
        expected: of the arguments by their names; others, and those that are left out, are not
            looked at.
    """

    def decorate(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
        signature = inspect.signature(function)
        function_name = function.__qualname__

        @wraps(function)
        def checked(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
            given = signature.bind(*args, **kwargs).arguments
            for name, value in given.items():
                if name not in expected or expected[name].is_met(value):
                    continue
                taken = [one for one in signature.parameters if one not in {"cls", "self"}]
                call = f"call {function_name}({', '.join(taken)})"
                label = f"{name} of {function_name}"
                raise argument_refused(label, value, expected[name], call)
            return function(*args, **kwargs)

        return checked

    return decorate


def require_fields(
    label: str, thing: object, expected: Mapping[str, ExpectedArgument], call: str
) -> None:
    """Refuse an object with a field of another type: constructors only store.

    Args:
        label: of the object, for messages.
        thing: whose fields are looked at.
        expected: of its fields, by their names.
        call: how to make the object.

    Raises:
        UsageError: a field is of another type; it is named.
    """
    for name, one in expected.items():
        value = getattr(thing, name)
        if not one.is_met(value):
            raise argument_refused(f"{name} of {label}", value, one, call)


def argument_refused(
    label: str, value: object, expected: ExpectedArgument, call: str
) -> UsageError:
    """Make the error for an argument.

    Args:
        label: of the argument, for messages.
        value: that was given.
        expected: what it takes.
        call: advice where the expectation has none.
    """
    shown = repr(value)[:SHOWN_CHARACTERS]
    kind = type(value).__name__
    remedy = expected.hint or call
    return UsageError(
        label, found=f"{shown} of type {kind}", expected=expected.described, remedy=remedy
    )
