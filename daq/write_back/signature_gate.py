"""The gate of the second person: whoever applies a calibration is not the only one who stands for it."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from daq.configuration.apply_policy import ApplyPolicy
from daq.errors import SignatureInvalid
from daq.signature import signers_of
from daq.write_back.gates import Gate, Refusal


def signature_refusals(
    file: Path | None, content: bytes, policy: ApplyPolicy, appliers: Collection[str]
) -> tuple[Refusal, ...]:
    """Closed where fewer persons have signed than the policy wants; signatures are beside the calibration's file.

    Args:
        file: of the calibration, None where it is in no file.
        content: of the file, as it was read.
        policy: who may sign, and how many must.
        appliers: names of whoever applies it; their signatures do not count.

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
    applying = {name.casefold() for name in appliers}
    others = [name for name in signed if name.casefold() not in applying]
    if len(others) >= policy.signatures:
        return ()
    may = ", ".join(name for name in policy.signers if name.casefold() not in applying) or "nobody else"
    return (
        Refusal(
            Gate.SIGNATURE,
            subject,
            f"{len(others)} signatures ({', '.join(others) or 'none'}), not counting whoever applies it",
            f"{policy.signatures} of: {may}",
            "have them look at it and sign it with `drivegain sign`",
        ),
    )
