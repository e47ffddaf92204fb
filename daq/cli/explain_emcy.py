"""`drivegain explain-emcy`: what an error code of an amplifier means."""

from __future__ import annotations

import re
from typing import Annotated

import typer

from daq.cli.verb import JsonOption, Verb, print_json
from daq.errors import UsageError
from drivers.emcy import CODES, describe

_HEX = re.compile(r"(?:0[xX])?([0-9a-fA-F]{1,4})[hH]?")


def explain_emcy_verb(
    code: Annotated[str, typer.Argument(help="As manuals write it, in hexadecimal: 8611, 8611h or 0x8611.")],
    json: JsonOption = False,
) -> None:
    """Say what an emergency error code (EMCY, object 603Fh) means by CiA 301 and CiA 402.

    Codes that these leave to the manufacturer are told by their class; the drive's manual knows more.
    """
    number = read_code(code)
    standard = number in CODES
    text = describe(number)
    if json:
        print_json({"code": number, "hex": f"{number:04X}h", "text": text, "standard": standard})
        return
    typer.echo(f"{number:04X}h: {text}")


def read_code(text: str) -> int:
    """The number in a code as people write it.

    Raises:
        UsageError: it is no hexadecimal number of at most four digits.
    """
    found = _HEX.fullmatch(text.strip())
    if found is None:
        raise UsageError(
            f"code {text!r}",
            found="no error code",
            expected="a hexadecimal number of at most four digits, as 8611, 8611h or 0x8611",
            remedy="take it from the event's text (`drivegain info LOG`) or from object 603Fh",
        )
    return int(found.group(1), 16)


EXPLAIN_EMCY = Verb("explain-emcy", explain_emcy_verb, "drivegain explain-emcy 8611h")
