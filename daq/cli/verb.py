"""A verb of the command line, its help, and the options that several verbs share.

A verb parses, calls and prints. Its module imports what the help needs; the verb imports what it
runs when it runs, so that no help waits for numerics or for the bus.
"""

from __future__ import annotations

import importlib
import inspect
import re
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer
from typer.core import TyperCommand, TyperGroup

from daq.errors import UsageError, reason_of
from daq.files import judge_target

if TYPE_CHECKING:
    from daq.config.cell import Cell
    from daq.report.document import Report
    from ident.calibration import Calibration

JsonOption = Annotated[
    bool, typer.Option("--json", help="Print one JSON object on stdout and nothing else.")
]
CellArgument = Annotated[Path, typer.Argument(help="Cell file.")]
CellOption = Annotated[
    Path | None,
    typer.Option(
        "--cell", help="Corrected file of the same cell, in place of the one in the logs."
    ),
]
CalibrationArgument = Annotated[
    Path, typer.Argument(help="calibration.yaml written by `drivegain fit`.")
]


RequestT = TypeVar("RequestT")


def judged_output(path: Path | None) -> Path | None:
    """Refuse, as the command line is parsed, a place to write to that another user has chosen,
    a device or pipe, and the name `-`.

    The callback of every option (`output_option`) and argument that names a file or folder to
    write; it returns the path as it was given.

    Raises:
        UsageError: as `judge_target`; or the name is `-`.
    """
    if path is None:
        return None
    if str(path) == "-":
        raise UsageError(
            "-",
            found="the name by which other programs mean standard output",
            expected="the name of a file or folder",
            remedy="give one; `--json` prints the result of most verbs",
        )
    try:
        judge_target(path)
    except OSError as error:
        raise UsageError(
            str(path),
            found=reason_of(error),
            expected="a file or folder, or a new name, without links of other users",
            remedy="choose another name, or name the place itself",
        ) from error
    return path


def output_option(name: str, about: str) -> Any:
    """Option that names a file or folder to write."""
    return typer.Option(name, help=about, callback=judged_output)


def require_printable(option: str, name: str | None) -> None:
    """Refuse a person's name that cannot be shown, in a log or an audit log, as it is.

    Args:
        option: as it is typed.
        name: its value; None where it was not given.

    Raises:
        UsageError: it has control characters, marks of direction, or bytes that are no characters.
    """
    if name is not None and not name.isprintable():
        raise UsageError(
            f"{option} {name!a}",
            found="characters that cannot be shown",
            expected="a name",
            remedy="type it again",
        )


def read_cell(path: Path) -> Cell:
    """Read a cell file.

    Raises:
        ConfigurationError: as `load_cell`.
    """
    from daq.config.cell_file import load_cell

    return load_cell(path)


def corrected_cell(path: Path | None) -> Cell | None:
    """Read the cell file of `--cell`; None where the description in the logs is used."""
    return None if path is None else read_cell(path)


def read_calibration(path: Path) -> Calibration:
    """Read a calibration.

    Raises:
        CalibrationMissing, CalibrationUnreadable, CalibrationRefused: as `load_calibration`.
    """
    from daq.documents.calibration_file import load_calibration

    return load_calibration(path)


def taking(request: type[RequestT]) -> Callable[[Callable[[RequestT], None]], Callable[..., None]]:
    """Let a verb take one frozen object in place of its arguments and options.

    Args:
        request: dataclass whose fields declare them, as the parameters of other verbs do.
    """

    def decorate(verb: Callable[[RequestT], None]) -> Callable[..., None]:
        def parsed(**given: Any) -> None:
            verb(request(**given))

        parsed.__doc__ = verb.__doc__
        parsed.__signature__ = inspect.signature(request, eval_str=True)  # type: ignore[attr-defined]
        return parsed

    return decorate


HELP_NAMES = ["-h", "--help"]


class Job(Enum):
    """Work of a person at a cell, which groups the verbs in the help."""

    COMMISSION = "Commission a cell"
    LOOK = "Look"
    MAINTAIN = "Maintain"
    EXPERT = "Expert"


@dataclass(frozen=True, slots=True)
class Verb:
    """One verb. The module of its function is imported when it is called or explained."""

    name: str  #: on the command line
    #: Function, as module:name; it takes its arguments as typer parses them, and its docstring is
    #: the help.
    place: str
    #: a command line that works, shown at the end of the help; CELL is the cell file of the user's
    #: folder
    example: str
    summary: str = ""  #: one line for the list of verbs
    #: Verbs with arguments of their own, `drivegain export urdf …`; then the function takes none
    #: and is the help alone.
    kinds: tuple[Verb, ...] = ()

    def function(self) -> Callable[..., None]:
        """Import the function."""
        module, _, name = self.place.partition(":")
        function: Callable[..., None] = getattr(importlib.import_module(module), name)
        return function

    def command(self) -> Any:
        """Click command of this verb, or group of its kinds."""
        # rich would read the units in brackets, [s], as markup and drop them.
        app = typer.Typer(
            cls=_Kinds,
            add_completion=False,
            pretty_exceptions_enable=False,
            rich_markup_mode=None,
            no_args_is_help=True,
            epilog=self.example,
        )
        if self.kinds:
            app.callback()(self.function())
        for verb in self.kinds or (self,):
            app.command(verb.name, cls=_VerbCommand, epilog=verb.example)(verb.function())
        return typer.main.get_command(app)


#: Non-breaking: a line is broken at spaces alone, so that --enable-motion stays whole
_HYPHEN = "\u2011"


def _example(command: str) -> str:
    r"""Example as click shows it; \b keeps the lines of the command, ready to copy."""
    width = max(min(shutil.get_terminal_size().columns, 80) - 2, 50)  # as click computes it
    words = " ".join(str(cell_here()) if word == "CELL" else word for word in command.split(" "))
    return "\b\nExample:\n" + "\n".join(continued(words, width - 2, indent="  "))


class _VerbCommand(TyperCommand):
    """Command whose help names values as a manual does: CELL, SECONDS.

    `--cell CELL` and `--calibration CALIBRATION` are other spellings of a first argument of that
    name.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        first = next(
            (param.name for param in self.params if param.param_type_name == "argument"), None
        )
        if first in _SPELLED_AS_OPTIONS:
            args = _in_front(first, args)
        return super().parse_args(ctx, args)

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        return [
            piece.replace("{", "").replace("}", "").upper()
            for piece in super().collect_usage_pieces(ctx)
        ]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        for title in ("argument", "option"):
            params = [param for param in self.get_params(ctx) if param.param_type_name == title]
            records = []
            for param in params:
                record = help_record(param, ctx)
                if record is not None:
                    name, text = record
                    records.append((name, text.replace("-", _HYPHEN)))
            if records:
                with formatter.section(f"{title.capitalize()}s"):
                    formatter.write_dl(records)

    def format_help_text(self, ctx: Any, formatter: Any) -> None:
        formatter.write_paragraph()
        with formatter.indentation():
            formatter.write_text(inspect.cleandoc(self.help or "").replace("-", _HYPHEN))

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        # Made when it is asked for: it looks for the cell files of this folder, and no other
        # command waits for them.
        self.epilog = _example(self.epilog or "")
        super().format_epilog(ctx, formatter)

    def get_help(self, ctx: Any) -> str:
        return super().get_help(ctx).replace(_HYPHEN, "-")


class _Kinds(TyperGroup):
    """Verb with kinds of its own, which are listed with their whole first sentences."""

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        self.epilog = _example(self.epilog or "")
        super().format_epilog(ctx, formatter)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        rows = [(name, str(kind.help).partition("\n\n")[0]) for name, kind in self.commands.items()]
        with formatter.section("Kinds"):
            formatter.write_dl([(name, " ".join(text.split())) for name, text in rows])


def help_record(param: Any, ctx: Any) -> tuple[str, str] | None:
    """Name of an argument or option with the word for its value, and its help;
    None for a hidden one.
    """
    # typer brings a click of its own, whose classes have no public name; hence Any.
    record = param.get_help_record(ctx)
    if record is None:
        return None
    _, text = record
    if param.param_type_name == "argument":
        return param.name.upper() + ("..." if param.nargs != 1 else ""), text
    names = ", ".join(sorted(param.opts, key=len))
    return names if param.is_flag or param.count else f"{names} {_value_word(param, ctx)}", text


_WORDS = {
    **dict.fromkeys(("by", "name", "operator", "payload"), "NAME"),
    **{
        "axis": "AXIS",
        "base": "BEFORE-AFTER",
        "channel": "CHANNEL",
        "payload_mass": "NAME=KG",
        "schedule": "WHEN",
    },
}
"""Words for the texts that options take, by the name of the option."""
_UNITS = {"s": "SECONDS", "kg": "KG", "%": "PERCENT"}


def _value_word(param: Any, ctx: Any) -> str:
    """Word for the value of an option: the declared one, or by its type,
    its unit or the first word of its help.
    """
    if param.metavar is not None:
        return str(param.metavar)
    described = param.type_descriptor
    if described.is_choice:
        return str(param.display_type(ctx)).strip("<>")
    if "Path" in str(described.annotation):
        return "FOLDER" if (param.help or "").startswith("Folder") else "FILE"
    if described.annotation in (str, list[str]):
        return _WORDS.get(param.name, "TEXT")
    unit = re.search(r"\[(\S+)\]", param.help or "")
    return _UNITS.get(unit[1], "NUMBER") if unit is not None else "NUMBER"


_SPELLED_AS_OPTIONS = ("cell", "calibration")


def _in_front(argument: str, args: Sequence[str]) -> list[str]:
    """Put the value of the option with the name of the first argument in front."""
    words = list(args)
    end = words.index("--") if "--" in words else len(words)
    for place, word in enumerate(words[:end]):
        name, equals, value = word.partition("=")
        if name == f"--{argument}" and (equals or place + 1 < end):
            taken = [value] if equals else words[place + 1 : place + 2]
            return [*taken, *words[:place], *words[place + (1 if equals else 2) :]]
    return words


_CELLS = ("*.yaml", "cells/*.yaml", "*/cells/*.yaml")
_TEMPLATE = Path("press-4/cells/press-4.yaml")  #: What the example of `drivegain init` makes


def cell_here() -> Path:
    """The only cell file in or below this folder, for a command to copy;
    else the one that `drivegain init` would make.

    Of several, one that is copied without a look may be the wrong one.
    """
    found = list(islice(cells_in(Path()), 2))
    return found[0] if len(found) == 1 else _TEMPLATE


def cells_in(folder: Path, name: str | None = None) -> Iterator[Path]:
    """Find the cell files in or below a folder; those of one cell, if a name is given."""
    for pattern in _CELLS:
        for path in sorted(folder.glob(pattern)):
            try:
                if not path.is_file():  # opening a FIFO would wait for its writer
                    continue
                with path.open(encoding="utf-8", errors="replace") as stream:
                    head = stream.read(4096)
            except OSError:
                continue
            found = re.search(r"^name: *(\S+)", head, re.MULTILINE)
            if re.search(r"^robot:", head, re.MULTILINE) and found and name in (None, found[1]):
                yield path


def continued(command: str, width: int, indent: str = "") -> list[str]:
    r"""Break a command at its spaces into lines that a shell reads as one,
    each but the last with ` \` at its end.
    """
    lines = []
    line = indent
    # An option stays with its value.
    for word in re.findall(r"--?\S+(?: [^-\s]\S*)?|\S+", command):
        longer = f"{line}{word}" if not line.strip() else f"{line} {word}"
        if line.strip() and len(longer) > len(indent) + width - 2:
            lines.append(f"{line} \\")
            longer = f"{indent}  {word}"
        line = longer
    return [*lines, line]


def print_json(document: Report) -> None:
    """Print one JSON document on stdout."""
    from daq.report.document import json_text

    sys.stdout.write(json_text(document))
