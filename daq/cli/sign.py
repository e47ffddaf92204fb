"""`drivegain sign`: a second person approves a calibration with a signature."""

from __future__ import annotations

import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from daq.cli.output import wait_until_shown
from daq.cli.terminal import print_view, say
from daq.cli.verb import (
    CalibrationArgument,
    JsonOption,
    output_option,
    print_json,
    read_calibration,
    read_cell,
)
from daq.errors import UsageError


def sign_verb() -> None:
    """Sign a calibration for a cell whose policy requires a second approver.

    Signatures and keys are minisign files: `minisign -V` checks the signatures, and minisign keys
    can be used here.
    """


def sign_key_verb(
    name: Annotated[str, typer.Option("--name", help="Name of the person, as in the cell file.")],
    folder: Annotated[
        Path, output_option("--folder", "Folder for NAME.key and NAME.pub.")
    ] = Path(),
    no_password: Annotated[
        bool, typer.Option("--no-password", help="Only its file's permissions protect it.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """Make a key pair: NAME.key is secret and stays with the person,
    the public key goes into the cell file.
    """
    from daq.report.job_schemas import KeyReport
    from daq.writeback.signature import generate

    password = "" if no_password else _password()
    again = password
    if not no_password and sys.stdin.isatty():
        again = typer.prompt("Repeat the password", hide_input=True, err=True)
    if password != again or not (password or no_password):
        raise UsageError(
            "password",
            found="two that differ" if password else "none",
            expected="the same twice",
            remedy="try again, or use --no-password for a key that only its file "
            "permissions protect",
        )
    secret, public = generate(folder, name, password)
    if json:
        print_json(KeyReport(name=name, secret_key=str(secret), public_key=public.line))
        return
    entry = (
        f"For the cell file, under `policy: {{apply: {{signers: …}}}}`:\n  {name}: {public.line}"
    )
    print_view([entry], secret, secret.with_suffix(".pub"))
    say(f"Keep {secret.name} secret: anyone who has it can sign as {name}.")


def sign_calibration_verb(
    calibration: CalibrationArgument,
    key: Annotated[Path, typer.Option("--key", help="Your secret key, NAME.key.")],
    name: Annotated[str, typer.Option("--name", help="Your name, as the cell file spells it.")],
    json: JsonOption = False,
) -> None:
    """Show a calibration and write your signature next to it;
    changing the file makes the signature invalid.
    """

    from daq.report.gains import gain_table
    from daq.report.job_schemas import SignatureReport
    from daq.writeback.signature import needs_password, sign

    known = read_calibration(calibration)
    password = _password() if needs_password(key) else ""
    if not json:
        print_view([gain_table(known.gains, title=f"{known.cell}, {known.created}")])
    path = sign(calibration, key, name, password=password, at=datetime.now(UTC))
    if json:
        print_json(SignatureReport(calibration=str(calibration), signature=str(path), name=name))
    else:
        print_view([], path)


def sign_check_verb(
    cell: Annotated[Path, typer.Argument(help="Cell file; its policy names the signers.")],
    calibration: CalibrationArgument,
    json: JsonOption = False,
) -> None:
    """Show which of the cell's signers have signed a calibration;
    an invalid signature is exit code 3.
    """
    from daq.report.job_schemas import SignersReport
    from daq.writeback.signature import signers_of

    policy = read_cell(cell).apply
    found = signers_of(calibration, policy.signers)
    if json:
        print_json(SignersReport(signers=list(found), signatures_needed=policy.signatures))
        return
    signed = ", ".join(found) or "none of the cell's signers"
    print_view(
        [
            f"Signed by: {signed}.",
            f"Signatures required by the cell: {policy.signatures}, not counting the applier's.",
        ]
    )


def _password() -> str:
    if not sys.stdin.isatty():
        return sys.stdin.readline().rstrip("\n")
    wait_until_shown(sys.stdout, sys.stderr)
    return str(typer.prompt("Password of the key", hide_input=True, err=True))
