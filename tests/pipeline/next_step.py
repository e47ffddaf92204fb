"""The command that a verb names as the next step: a reader can type it."""

from __future__ import annotations

import shlex
from pathlib import Path

from daq.cli.app import VERBS

_WRITTEN = {"out", "report", "preview"}
"""Options whose files the next step makes."""
_FILLED_IN = {"KG": "1", "CELL": __file__}
"""Words that a reader replaces, where the folder shows no value, and an example of what with."""


def next_step(output: str) -> str | None:
    """Return the verb of the next step after the output of a verb, or None where there is none.

    Its options and values are parsed as the command line would; every file that it reads must
    exist.
    """
    lines = [line for line in output.splitlines() if line.startswith("Next: ")]
    if not lines:
        return None
    (line,) = lines
    program, verb, *words = shlex.split(line.removeprefix("Next: "))
    assert program == "drivegain", line
    (called,) = [one for one in VERBS if one.name == verb]
    context = called.command().make_context(verb, [_FILLED_IN.get(word, word) for word in words])
    for name, value in context.params.items():
        for path in value if isinstance(value, list | tuple) else [value]:
            assert not isinstance(path, Path) or name in _WRITTEN or path.exists(), (
                f"{line}: {name} {path}"
            )
    return verb
