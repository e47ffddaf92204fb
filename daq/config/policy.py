"""`policy` and `history` of a cell file: permissions, bounds of the write-back, approvers,
the record of all writes.
"""

from __future__ import annotations

import base64
import binascii
import os
import re
import struct
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator

from daq.config.yaml_file import Fault, FileName
from daq.errors import ConfigurationInconsistent
from daq.files import follow_links

_Percent = Annotated[float, Field(ge=0)]


class Permission(Enum):
    """Whether a cell allows something that is refused by default."""

    REFUSED = "refused"
    ALLOWED = "allowed"


class AppliedBy(Enum):
    """Actor that applies the result of a scheduled job."""

    PERSON = "person"  #: The job proposes; a named person applies
    JOB = "job"  #: The job itself, if every gate passes


class HoldOut(Enum):
    """Whether a calibration must have been tested on a held-out run."""

    REQUIRED = "required"
    OPTIONAL = "optional"


@dataclass(frozen=True, slots=True)
class ApplyPolicy:
    """Bounds of the write-back."""

    max_change_percent: _Percent = 35.0  #: change from the current gain [%]
    max_nameplate_percent: _Percent = 50.0  #: change from the nameplate [%]
    max_std_percent: _Percent = 3.0  #: relative standard deviation of the identified gain [%]
    #: relative error of all torques, on held-out data where available [%]
    max_error_percent: _Percent = 25.0
    max_axis_error_percent: _Percent = 50.0  #: the same for each axis [%]
    #: Misfit of redundant encoders that nothing explains [mrad, or thousandths of the robot's
    #: size].
    max_encoder_misfit_mrad: Annotated[float, Field(ge=0)] = 0.1
    #: Age of the oldest log [days]; None to ignore it, as for imported logs without the time of
    #: day.
    max_age_days: Annotated[float, Field(gt=0)] | None = 30.0
    #: share of an axis's samples in which a limit was active [%]
    max_saturated_percent: _Percent = 2.0
    by: AppliedBy = AppliedBy.PERSON  #: who applies the result of a scheduled job
    #: Number of signers who must have signed the calibration, not counting the operator who applies
    #: it.
    signatures: Annotated[int, Field(ge=0)] = 0
    #: Public key (minisign) of each person who may sign, by name.
    signers: Mapping[str, str] = field(default_factory=dict)
    #: whether held-out data are required; None means required if the job itself applies
    holdout: HoldOut | None = None
    #: Largest change from the current gain, by axis name [unit of the gain].
    max_change: Mapping[str, Annotated[float, Field(ge=0)]] = field(default_factory=dict)

    @property
    def requires_holdout(self) -> bool:
        """Whether held-out data are required. A job never applies a calibration without them."""
        return self.holdout is HoldOut.REQUIRED or self.by is AppliedBy.JOB

    @model_validator(mode="after")
    def _check_holdout_and_signers(self) -> ApplyPolicy:
        if self.signatures > len(self.signers):
            raise ValueError(
                f"at least {self.signatures} `signers`, a public key by each name, for so many "
                "signatures"
            )
        if self.by is AppliedBy.JOB and self.holdout is HoldOut.OPTIONAL:
            raise ValueError("`holdout: required` where the job applies by itself")
        return self


DEFAULT_APPLY_POLICY = ApplyPolicy()
DEFAULT_TARGET_SIGMA_PERCENT = 0.5  #: σ of every gain at which a guided session ends


def max_change_faults(policy: ApplyPolicy, axes: Collection[str]) -> Iterator[Fault]:
    """Find bounds for axes that the cell does not have: misspelt, they would bound nothing."""
    for name in policy.max_change:
        if name not in axes:
            known = ", ".join(axes)
            path = ("policy", "apply", "max_change", name)
            yield Fault(path, f"axis {name!r}", f"one of {known}")


def policy_judged(cell_file: Path, key: str, path: Path) -> Path:
    """Resolve a path that a cell file names or implies, so far as its links can be trusted
    (`daq.files.follow_links`).

    Raises:
        ConfigurationInconsistent: they cannot.
    """
    try:
        return follow_links(path)
    except OSError as error:
        raise ConfigurationInconsistent(
            f"{cell_file}: {key}",
            found=f"{path}, {error.strerror}",
            expected="a path without links, or with your own",
            remedy="correct the link, or name the file itself",
        ) from error


@dataclass(frozen=True, slots=True)
class HistorySection:
    """`history`: file names relative to the cell file.

    By default they are next to it, with its name.
    """

    store: FileName | None = None  #: SQLite file of an earlier version, which is migrated
    audit: FileName | None = None  #: audit log

    def place(self, cell_file: Path, controller: str | None) -> HistoryPlace:
        """Resolve the file names; refuse a history that would replace the cell file or the
        controller file.

        Raises:
            ConfigurationInconsistent: it would, or a link in one of the names must not be followed.
        """
        folder = cell_file.parent
        stem = cell_file.stem
        store_name = self.store or f"{stem}.history.sqlite"
        audit_name = self.audit or f"{stem}.audit.jsonl"
        store = policy_judged(cell_file, "history.store", folder / store_name)
        for other in (cell_file, folder / (controller or cell_file.name)):
            if _is_same_file(store, other):
                raise ConfigurationInconsistent(
                    f"{cell_file}: history.store",
                    found=f"the same file as {other}",
                    expected="a file of the history's own",
                    remedy="give it another name",
                )
        audit = policy_judged(cell_file, "history.audit", folder / audit_name)
        return HistoryPlace(store, audit)


def _is_same_file(path: Path, other: Path) -> bool:
    if str(path) == os.path.realpath(other):
        return True
    return path.exists() and other.exists() and path.samefile(other)


@dataclass(frozen=True, slots=True)
class HistoryPlace:
    """Files of a cell's history, absolute."""

    #: SQLite file in which earlier versions kept the history; the records of drives are named after
    #: it
    store: Path
    audit: Path  #: hash-chained record of all write actions, of which the history is folded


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
    line = lines[-1] if lines else ""
    content = decode_line(line, _LAYOUT.size, "a public key")
    algorithm, key_id, key = _LAYOUT.unpack(content)
    if algorithm != KEY_ALGORITHM or len(lines) > 2:
        raise ValueError(f"a key of algorithm {algorithm!r}, or more than a key")
    return PublicKey(key_id, key)


def signer_faults(signers: Mapping[str, str]) -> Iterator[Fault]:
    """Find malformed keys and names when the cell is read, and not at the first signature,
    long after the recording.
    """
    owners: dict[bytes, str] = {}
    for name, line in signers.items():
        if SIGNER_NAME.fullmatch(name):
            problem = None
        else:
            problem = "a name that cannot be part of a file name"
        try:
            key = parse_public_key(line).key
        except ValueError as error:
            problem = str(error)
        else:
            if key in owners:
                problem = f"the key of {owners[key]}"
            owners.setdefault(key, name)
        if problem is not None:
            expected = "a public key of their own, the line that `drivegain sign key` prints"
            yield Fault(("policy", "apply", "signers", name), problem, expected)


def public_keys(signers: Mapping[str, str]) -> dict[str, PublicKey]:
    """Parse and check the keys of the trusted people.

    Raises:
        ConfigurationInconsistent: a public key is none, or two names share one: they would be one
            person.
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
