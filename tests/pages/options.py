"""The verbs of the command line and the options of each."""

from __future__ import annotations

from typing import Any

import typer

from daq.cli.app import build_app
from daq.cli.verb import HELP_NAMES

ALWAYS = frozenset(HELP_NAMES)
"""Options that every verb has."""


def verb_options() -> dict[str, frozenset[str]]:
    """Options by verb, as `plan` or `export urdf`."""
    group: Any = typer.main.get_command(build_app())
    context = typer.Context(group, info_name="drivegain")
    found: dict[str, frozenset[str]] = {}
    for name in group.list_commands(context):
        _, command, _ = group.resolve_command(context, [name])
        found[name] = _options(command)
        for kind_name, kind in getattr(command, "commands", {}).items():
            found[f"{name} {kind_name}"] = _options(kind)
    return found


def _options(command: Any) -> frozenset[str]:
    named: set[str] = set()
    for parameter in command.params:
        named.update(parameter.opts, parameter.secondary_opts)
    return ALWAYS | named
