"""The gate of the second person: whoever applies a calibration is not the only one who stands for it."""

from __future__ import annotations

import unicodedata
from collections.abc import Collection
from pathlib import Path

from daq.config.policy import ApplyPolicy
from daq.errors import SignatureInvalid
from daq.writeback.gates.table import Gate, Refusal
from daq.writeback.signature import signers_of


def signature_refusals(
    file: Path | None, content: bytes, policy: ApplyPolicy, appliers: Collection[str]
) -> tuple[Refusal, ...]:
    """Closed where fewer persons have signed than the policy wants; signatures are beside the calibration's file.

    Names are compared as they are read, without case, blanks and ways to encode them (NFKC). A name given must be a
    signer's, or the login: a look-alike of one's own name would make two persons of one.

    Args:
        file: of the calibration, None where it is in no file.
        content: of the file, as it was read.
        policy: who may sign, and how many must.
        appliers: names of whoever applies it in this order, the login last; their signatures do not count.

    Raises:
        ConfigurationInconsistent: a public key of the policy is none.
    """
    if not policy.signatures:
        return ()
    subject = "calibration" if file is None else str(file)
    try:
        signed = () if file is None else signers_of(file, policy.signers, content)
    except SignatureInvalid as error:
        return (Refusal(Gate.SIGNATURE, error.subject, error.found, error.expected, error.remedy),)
    *given, login = appliers or ("",)
    closed = [_unknown(name, policy) for name in given if not _known(name, login, policy)]
    applying = {_as_read(name) for name in appliers}
    others = _others(signed, applying)
    if len(others) < policy.signatures:
        may = ", ".join(_others(tuple(policy.signers), applying)) or "nobody else"
        closed.append(
            Refusal(
                Gate.SIGNATURE,
                subject,
                f"{len(others)} signatures ({', '.join(others) or 'none'}), not counting whoever applies it",
                f"{policy.signatures} of: {may}",
                "have them look at it and sign it with `drivegain sign`",
            )
        )
    return tuple(closed)


def _as_read(name: str) -> str:
    """The same for all spellings that look alike: case, blanks around, composed or not, wide or narrow."""
    folded = unicodedata.normalize("NFKC", unicodedata.normalize("NFKC", name).casefold())
    return " ".join(folded.split())


def _legible(name: str) -> bool:
    """Whether every character shows: no control, format, private or unassigned one."""
    return bool(name) and not any(unicodedata.category(character).startswith("C") for character in name)


def _known(name: str, login: str, policy: ApplyPolicy) -> bool:
    return _legible(name) and _as_read(name) in {_as_read(other) for other in (*policy.signers, login)}


def _unknown(name: str, policy: ApplyPolicy) -> Refusal:
    return Refusal(
        Gate.SIGNATURE,
        "whoever applies it",
        ascii(name),
        f"one of {', '.join(map(repr, policy.signers))}, or the login",
        "give --by as the cell file spells it under `signers`, or leave it out",
    )


def _others(names: tuple[str, ...], applying: set[str]) -> list[str]:
    """Persons other than whoever applies it, each once however often a name is spelt."""
    persons = {_as_read(name): name for name in reversed(names) if _legible(name)}
    return [name for name in names if persons.get(_as_read(name)) == name and _as_read(name) not in applying]
