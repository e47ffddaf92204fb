"""What makes a verb of the command line, and what all of them share."""

from __future__ import annotations

import importlib
import json
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import typer

JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout and nothing else.")]


@dataclass(frozen=True, slots=True)
class Verb:
    """One verb.

    Attributes:
        name: as technicians say it.
        function: takes its arguments as typer reads them; its docstring is the help.
        example: a command line that works, shown at the end of the help.
    """

    name: str
    function: Callable[..., None]
    example: str


@dataclass(frozen=True, slots=True)
class Listed:
    """A verb as the list of verbs has it, before it is imported.

    Attributes:
        name: as technicians say it.
        place: of its `Verb`, as an entry point is written: module, colon, name.
        summary: one line for the list.
    """

    name: str
    place: str
    summary: str

    def load(self) -> Verb:
        """Import it."""
        module, _, name = self.place.partition(":")
        verb = getattr(importlib.import_module(module), name)
        if not isinstance(verb, Verb):
            raise TypeError(f"{self.place} is no Verb")
        return verb


def json_text(document: Any) -> str:
    """One JSON document; numbers that JSON cannot say become null, bytes of names that are no UTF-8 are spelt out."""
    text = json.dumps(_json_safe(document), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    return text.encode(errors="backslashreplace").decode()


def print_json(document: Any) -> None:
    """One JSON document on stdout."""
    sys.stdout.write(json_text(document))


def printable(text: str) -> str:
    """Text from a file as a terminal may show it: control characters, which could command it, are spelt out."""
    return "".join(c if c.isprintable() or c == "\n" else f"\\x{ord(c):02x}" for c in text)


def _json_safe(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, dict):
        return {str(key): _json_safe(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_json_safe(item) for item in value]
    return value


# A verb of several kinds, each with arguments of its own: `drivegain export urdf …`.


@dataclass(frozen=True, slots=True)
class VerbGroup(Verb):
    """One verb with kinds; `function` takes no arguments, its docstring is the help of all.

    Attributes:
        kinds: in the order of the help.
    """

    kinds: tuple[Verb, ...]

    def command(self) -> Any:
        """As click runs it."""
        group = typer.Typer(
            no_args_is_help=True,
            add_completion=False,
            pretty_exceptions_enable=False,
            rich_markup_mode=None,
            epilog=_epilog(self),
        )
        group.callback()(self.function)
        for kind in self.kinds:
            group.command(kind.name, epilog=_epilog(kind))(kind.function)
        return typer.main.get_command(group)


def _epilog(verb: Verb) -> str:
    # \b keeps the example on one line: it is there to be copied.
    return f"\b\nExample:\n  {verb.example}"
