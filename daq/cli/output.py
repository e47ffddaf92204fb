"""Where a verb may write: never over what it was given, nor over a file of another kind; and what it says of it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from rich.console import Console

from daq.cli.verb import printable
from daq.errors import OutputExists

_LOOK_BYTES = 4096


def check_output(out: Path | None, inputs: Iterable[Path], format_: str) -> None:
    """Refuse an output that would destroy something.

    Args:
        out: file to write, None where nothing is written.
        inputs: files that the verb reads.
        format_: what the first lines of a file of the same kind say (``format: …``); such a file may be replaced.

    Raises:
        OutputExists: it is one of the inputs, or a file of another kind.
    """
    if out is None or not out.exists():
        return
    if any(given.exists() and out.samefile(given) for given in inputs):
        raise OutputExists(
            str(out), found="one of the files to read", expected="a name of its own", remedy="choose another name"
        )
    if not out.is_file() or f"format: {format_}".encode() not in _head(out):
        raise OutputExists(
            str(out),
            found="something that is no " + format_,
            expected="no file, or an earlier one of the same kind",
            remedy="choose another name, or move it away",
        )


def say_written(console: Console, *paths: Path | None) -> None:
    """Tell what was written, a line each, as the last thing that a verb says.

    Args:
        console: for a person.
        paths: files and folders; None for what nobody asked for.
    """
    for path in paths:
        if path is not None:
            name = f"{path}/" if path.is_dir() else str(path)
            console.print(f"Written: {printable(name)}", markup=False, highlight=False)


def _head(path: Path) -> bytes:
    with path.open("rb") as stream:
        return stream.read(_LOOK_BYTES)
