"""Public keys of the people who may sign a calibration (`policy.apply.signers`), one line of minisign for each."""

from __future__ import annotations

import base64
import binascii
import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from daq.config.yaml_file import Fault
from daq.errors import ConfigurationInconsistent

SIGNER_NAME = re.compile(r"[^\W_][\w.-]{0,63}")  #: The name is part of the signature's file name
KEY_ALGORITHM = b"Ed"
UNTRUSTED = "untrusted comment: "
_LAYOUT = struct.Struct("<2s8s32s")


@dataclass(frozen=True, slots=True)
class PublicKey:
    """Key that a signature is checked with."""

    key_id: bytes  #: 8 bytes that name the key pair
    key: bytes  #: Ed25519 public key, 32 bytes

    @property
    def line(self) -> str:
        """One line, for `minisign -P` and a cell file."""
        return base64.b64encode(_LAYOUT.pack(KEY_ALGORITHM, self.key_id, self.key)).decode()

    @property
    def text(self) -> str:
        """Content of its file."""
        return f"{UNTRUSTED}minisign public key {shown_id(self.key_id)}\n{self.line}\n"


def parse_public_key(text: str) -> PublicKey:
    """Parse a public key: its one line of base64, or its file with the comment above.

    Raises:
        ValueError: it is none.
    """
    lines = text.strip().splitlines()
    algorithm, key_id, key = _LAYOUT.unpack(decode_line(lines[-1] if lines else "", _LAYOUT.size, "a public key"))
    if algorithm != KEY_ALGORITHM or len(lines) > 2:
        raise ValueError(f"a key of algorithm {algorithm!r}, or more than a key")
    return PublicKey(key_id, key)


def signer_faults(signers: Mapping[str, str]) -> Iterator[Fault]:
    """Find malformed keys and names when the cell is read, and not at the first signature, long after the recording."""
    owners: dict[bytes, str] = {}
    for name, line in signers.items():
        problem = None if SIGNER_NAME.fullmatch(name) else "a name that cannot be part of a file name"
        try:
            key = parse_public_key(line).key
        except ValueError as error:
            problem = str(error)
        else:
            problem = f"the key of {owners[key]}" if key in owners else problem
            owners.setdefault(key, name)
        if problem is not None:
            expected = "a public key of their own, the line that `drivegain sign key` prints"
            yield Fault(("policy", "apply", "signers", name), problem, expected)


def public_keys(signers: Mapping[str, str]) -> dict[str, PublicKey]:
    """Parse and check the keys of the trusted people.

    Raises:
        ConfigurationInconsistent: a public key is none, or two names share one: they would be one person.
    """
    for fault in signer_faults(signers):
        raise ConfigurationInconsistent(
            f"trusted signer {fault.path[-1]!r}",
            found=fault.found,
            expected=fault.expected,
            remedy="correct it in the cell file",
        )
    return {name: parse_public_key(line) for name, line in signers.items()}


def decode_line(line: str, size: int, what: str) -> bytes:
    """Decode a line of base64 with a known number of bytes.

    Raises:
        ValueError: it is no base64, or of another size.
    """
    try:
        decoded = base64.b64decode(line.strip(), validate=True)
    except (binascii.Error, ValueError) as error:
        raise ValueError(f"text that is not base64 where {what} should be") from error
    if len(decoded) != size:
        raise ValueError(f"{len(decoded)} bytes where {what} has {size}")
    return decoded


def shown_id(key_id: bytes) -> str:
    """Format a key id as minisign prints it."""
    return key_id[::-1].hex().upper()
