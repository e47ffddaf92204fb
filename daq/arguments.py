"""Checks of the arguments of public functions:
one error that names the function, the argument and what it takes.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import wraps
from pathlib import Path
from typing import ParamSpec, TypeVar

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
    return isinstance(value, (str, os.PathLike)) and bool(os.fspath(value))


def _is_list_of_paths(value: object) -> bool:
    return (
        isinstance(value, Sequence)
        and not isinstance(value, (str, bytes))
        and all(map(_is_path, value))
    )


def _is_file_to_write(value: object) -> bool:
    return _is_path(value) and not Path(str(value)).is_dir()


def _is_moment(value: object) -> bool:
    return isinstance(value, datetime) and value.tzinfo is not None


def _is_whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


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
A_TEXT = ExpectedArgument("a text", lambda value: isinstance(value, str))
A_LIST = ExpectedArgument(
    "a list",
    lambda value: isinstance(value, Sequence) and not isinstance(value, (str, bytes)),
    "write [value]",
)


def of_kind(kind: type) -> ExpectedArgument:
    """Expect an object of a class."""
    return ExpectedArgument(kind.__name__, lambda value: isinstance(value, kind))


def with_methods(described: str, *names: str) -> ExpectedArgument:
    """Expect an object that has some methods, of whatever class."""
    return ExpectedArgument(
        described, lambda value: all(callable(getattr(value, name, None)) for name in names)
    )


def optional(expected: ExpectedArgument) -> ExpectedArgument:
    """Expect the same, or None."""
    return ExpectedArgument(
        f"{expected.described}, or None",
        lambda value: value is None or expected.is_met(value),
        expected.hint,
    )


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

        @wraps(function)
        def checked(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
            for name, value in signature.bind(*args, **kwargs).arguments.items():
                if name in expected and not expected[name].is_met(value):
                    call = f"call {function.__name__}({', '.join(signature.parameters)})"
                    raise argument_refused(
                        f"{name} of {function.__name__}", value, expected[name], call
                    )
            return function(*args, **kwargs)

        return checked

    return decorate


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
    return UsageError(
        label,
        found=f"{shown} of type {type(value).__name__}",
        expected=expected.described,
        remedy=expected.hint or call,
    )
