"""A verb of several kinds, each with arguments of its own: `drivegain export urdf …`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import typer

from daq.cli.verb import Verb


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
