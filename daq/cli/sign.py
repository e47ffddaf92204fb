"""`drivegain sign`: a person stands for a calibration, so that a cell can ask for a second one."""

from __future__ import annotations

import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from daq.cli.terminal import say_written
from daq.cli.verb import JsonOption, Verb, VerbGroup, print_json, printable
from daq.config.cell_file import load_cell
from daq.errors import UsageError
from daq.report.gains import gain_table
from daq.workflow.calibration_file import load
from daq.writeback.signature import generate, needs_password, sign, signers_of


def sign_verb() -> None:
    """Sign a calibration, so that a cell whose policy asks for a second person takes it.

    Signatures and keys are files of minisign: `minisign -V` checks them too, and its keys can be used here.
    """


def sign_key_verb(
    name: Annotated[str, typer.Option("--name", help="Of the person, as the cell file shall spell it.")],
    folder: Annotated[Path, typer.Option("--folder", help="Where NAME.key and NAME.pub go.")] = Path(),
    no_password: Annotated[
        bool, typer.Option("--no-password", help="A key that nothing but the rights of its file protects.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """Make a key pair: NAME.key is secret and stays with the person, the public key goes into the cell file."""
    password = "" if no_password else _new_password()
    secret, public = generate(folder, name, password)
    if json:
        print_json({"name": name, "secret_key": str(secret), "public_key": public.line})
        return
    console = Console(soft_wrap=True, highlight=False, markup=False)
    console.print(f"For the cell file, under `policy: {{apply: {{signers: …}}}}`:\n  {name}: {public.line}")
    say_written(console, secret, secret.with_suffix(".pub"))
    console.print(f"Keep {secret.name} to yourself: whoever has it signs as {name}.")


def sign_calibration_verb(
    calibration: Annotated[Path, typer.Argument(help="calibration.yaml of `drivegain fit`.")],
    key: Annotated[Path, typer.Option("--key", help="Your secret key, NAME.key.")],
    name: Annotated[str, typer.Option("--name", help="Your name, as the cell file spells it.")],
    json: JsonOption = False,
) -> None:
    """Look at a calibration and put your signature beside it; a change of the file makes it invalid."""
    known = load(calibration)
    password = _password() if needs_password(key) else ""
    console = Console(soft_wrap=True, highlight=False, markup=False)
    if not json:
        console.print(gain_table(known.gains, title=f"{printable(known.cell)}, {printable(known.created)}"))
    path = sign(calibration, key, name, password=password, at=datetime.now(UTC))
    if json:
        print_json({"calibration": str(calibration), "signature": str(path), "name": name})
    else:
        say_written(console, path)


def sign_check_verb(
    calibration: Annotated[Path, typer.Argument(help="calibration.yaml of `drivegain fit`.")],
    cell: Annotated[Path, typer.Option("--cell", help="Cell file; its policy names the signers.")],
    json: JsonOption = False,
) -> None:
    """Say who of the cell's signers has signed a calibration; a signature that does not fit is exit code 3."""
    policy = load_cell(cell).apply
    found = signers_of(calibration, policy.signers)
    if json:
        print_json({"signers": list(found), "signatures_needed": policy.signatures})
        return
    console = Console(soft_wrap=True, highlight=False, markup=False)
    console.print(f"Signed by: {', '.join(found) or 'nobody whom the cell knows'}.")
    console.print(f"The cell asks for {policy.signatures}, without whoever applies it.")


def _new_password() -> str:
    first = _password()
    again = typer.prompt("Once more", hide_input=True, err=True) if sys.stdin.isatty() else first
    if not first or first != again:
        raise UsageError(
            "password",
            found="none" if not first else "two that differ",
            expected="the same twice",
            remedy="try again, or --no-password for a key that the rights of its file protect",
        )
    return first


def _password() -> str:
    if not sys.stdin.isatty():
        return sys.stdin.readline().rstrip("\n")
    return str(typer.prompt("Password of the key", hide_input=True, err=True))


SIGN_KEY = Verb("key", sign_key_verb, "drivegain sign key --name anna --folder keys")
SIGN_CALIBRATION = Verb(
    "calibration", sign_calibration_verb, "drivegain sign calibration calibration.yaml --key keys/anna.key --name anna"
)
SIGN_CHECK = Verb("check", sign_check_verb, "drivegain sign check calibration.yaml --cell cells/demo.yaml")
SIGN = VerbGroup("sign", sign_verb, SIGN_CALIBRATION.example, (SIGN_KEY, SIGN_CALIBRATION, SIGN_CHECK))
