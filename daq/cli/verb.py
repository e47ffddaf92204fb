"""A verb of the command line, and the options that several verbs share.

A verb parses, calls and prints. Its module imports what the help needs; the verb imports what it runs when it runs, so
that no help waits for numerics or for the bus.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from daq.report.text import json_text

JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout and nothing else.")]
CellArgument = Annotated[Path, typer.Argument(help="Cell file.")]
CellOption = Annotated[Path | None, typer.Option("--cell", help="Another cell file than the one in the logs.")]
CalibrationArgument = Annotated[Path, typer.Argument(help="calibration.yaml written by `drivegain fit`.")]


@dataclass(frozen=True, slots=True)
class Verb:
    """One verb."""

    name: str  #: on the command line
    function: Callable[..., None]  #: takes its arguments as typer parses them; its docstring is the help
    example: str  #: a command line that works, shown at the end of the help
    #: Verbs with arguments of their own, `drivegain export urdf …`; then `function` takes none and is the help alone.
    kinds: tuple[Verb, ...] = ()

    def command(self) -> Any:
        """Click command of this verb, or group of its kinds."""
        # rich would read the units in brackets, [s], as markup and drop them.
        app = typer.Typer(
            add_completion=False,
            pretty_exceptions_enable=False,
            rich_markup_mode=None,
            no_args_is_help=True,
            epilog=self._epilog,
        )
        if self.kinds:
            app.callback()(self.function)
        for verb in self.kinds or (self,):
            app.command(verb.name, epilog=verb._epilog)(verb.function)
        return typer.main.get_command(app)

    @property
    def _epilog(self) -> str:
        """Example as click shows it; \\b keeps it on one line, ready to copy."""
        return f"\b\nExample:\n  {self.example}"


@dataclass(frozen=True, slots=True)
class Listed:
    """Entry of the list of verbs, before the verb is imported."""

    name: str  #: on the command line
    place: str  #: where its `Verb` is defined, as module:name
    summary: str  #: one line for the list

    def load(self) -> Verb:
        """Import the verb."""
        module, _, name = self.place.partition(":")
        verb = getattr(importlib.import_module(module), name)
        if not isinstance(verb, Verb):
            raise TypeError(f"{self.place} is no Verb")
        return verb


def print_json(document: Any) -> None:
    """Print one JSON document on stdout."""
    sys.stdout.write(json_text(document))
