"""Signatures of a calibration: one file next to it for each person,
which `minisign -V` checks too.
"""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator, Mapping
from datetime import datetime
from pathlib import Path

from daq.config.policy import SIGNER_NAME, UNTRUSTED, PublicKey, public_keys
from daq.config.yaml_file import read_file
from daq.errors import CalibrationMissing, OutputFailed, SignatureInvalid, UsageError, reason_of
from daq.files import read_regular, replace_file
from daq.writeback.minisign import (
    SecretKey,
    check_signature,
    is_encrypted,
    parse_secret_key,
    parse_signature,
)

SUFFIX = ".minisig"
_LARGEST_BYTES = 16_384


def generate(folder: Path, name: str, password: str = "") -> tuple[Path, PublicKey]:
    """Make a key pair: `<name>.key`, readable by its owner alone, and `<name>.pub` for all.

    Without a password only the file's mode protects the secret key. A missing folder is made.

    Returns:
        File of the secret key, and the public key, whose `line` goes into the cell file.

    Raises:
        UsageError: not a name for a file.
        UsageError: there is a key of this name; it is never replaced.
        OutputFailed: from the file system.
    """
    secret = folder / f"{_checked(name)}.key"
    public = folder / f"{name}.pub"
    for path in (secret, public):
        if path.exists() or path.is_symlink():
            raise UsageError(
                str(path),
                found="a key",
                expected="no file",
                remedy="keys are not replaced: choose another name",
            )
    key = SecretKey(os.urandom(8), os.urandom(32))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _write_new(secret, key.text(password, os.urandom(32)), 0o600)
        try:
            _write_new(public, key.public.text, 0o644)
        except BaseException:
            # Ctrl-C too: a secret key alone would keep the next try from its name.
            secret.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise OutputFailed.of(Path(error.filename or folder), error) from error
    return secret, key.public


def needs_password(secret_key: Path) -> bool:
    """Whether a secret key is encrypted. Raises UsageError as `sign`."""
    with _reading_key(secret_key):
        return is_encrypted(_text_of(secret_key))


def sign(
    file: Path, secret_key: Path, name: str, *, password: str = "", at: datetime | None = None
) -> Path:
    """Write a signature of the file's bytes next to it; it replaces one of the same name.

    Args:
        file: a calibration.
        secret_key: made by `generate` or by `minisign -G`.
        name: of the person, as cells know it.
        password: of the secret key.
        at: time for the trusted comment, aware; None leaves it out.

    Returns:
        File of the signature, `<file>.<name>.minisig`.

    Raises:
        UsageError: not a name for a file.
        UsageError: no secret key, another password, or a plain key that others may read.
        CalibrationMissing: the file cannot be read.
        UsageError: another file has the name of the signature.
        OutputFailed: from the file system.
    """
    path = signature_path(file, _checked(name))
    key = _secret_key(secret_key, password)
    content = _read_signed(file)
    if path.exists():
        try:
            is_signature = _text_of(path).startswith(UNTRUSTED)
        except (OSError, ValueError):  # a pipe, a folder, a file of another kind
            is_signature = False
        if not is_signature:
            raise UsageError(
                str(path),
                found="no signature",
                expected="no file, or an earlier signature",
                remedy="move it away",
            )
    if at is None:
        when = []
    else:
        when = [f"timestamp:{int(at.timestamp())}", f"at:{at.isoformat(timespec='seconds')}"]
    shown = "".join(c if c.isprintable() else "?" for c in file.name)
    signature = key.sign(content, "\t".join([*when, f"file:{shown}", f"signer:{name}", "hashed"]))
    try:
        replace_file(path, signature.text.encode())
    except OSError as error:
        raise OutputFailed.of(path, error) from error
    return path


def signature_path(file: Path, name: str) -> Path:
    """Return the file of a person's signature."""
    return file.with_name(f"{file.name}.{name}{SUFFIX}")


def signers_of(
    file: Path, trusted: Mapping[str, str], content: bytes | None = None
) -> tuple[str, ...]:
    """Find the trusted persons who have signed a file.

    Args:
        file: a calibration; only its name is used where `content` is given.
        trusted: public key by name, each its line of base64. Signatures of others are ignored.
        content: bytes of the file where it was read already, so that the checked bytes are the used
            ones.

    Returns:
        Names with a valid signature next to the file, in the order of `trusted`.

    Raises:
        SignatureInvalid: the signature of a trusted person does not fit the file: one of the two
            was changed.
        ConfigurationInconsistent: a public key is none, or two names share one: they would be one
            person.
        CalibrationMissing: the file cannot be read.
    """
    keys = public_keys(trusted)
    content = _read_signed(file) if content is None else content
    found = []
    for name, key in keys.items():
        path = signature_path(file, name)
        if path.exists() or path.is_symlink():
            try:
                check_signature(key, parse_signature(_text_of(path)), content)
            except (ValueError, OSError) as error:
                raise SignatureInvalid(
                    str(path),
                    found=_spelled(error),
                    expected=f"the signature of {name} for {file.name} as it is now",
                    remedy=f"have {name} review the calibration and sign it again, or remove the "
                    "signature",
                ) from error
            found.append(name)
    return tuple(found)


def _checked(name: str) -> str:
    if not SIGNER_NAME.fullmatch(name):
        raise UsageError(
            "name of the signer",
            found=repr(name),
            expected="letters, digits, '.', '_' and '-', at most 64, beginning with a "
            "letter or digit",
            remedy="give another one, as the cell file spells it",
        )
    return name


def _secret_key(path: Path, password: str) -> SecretKey:
    with _reading_key(path):
        text = _text_of(path)
        plain = not is_encrypted(text)
        key = parse_secret_key(text, password)
    mode = stat.S_IMODE(path.stat().st_mode)
    if plain and mode & 0o077:
        raise UsageError(
            str(path),
            found=f"a key without a password that others may read (mode {mode:04o})",
            expected="mode 0600",
            remedy=f"if no other user had it: chmod 600 {path}; otherwise make a new key",
        )
    return key


@contextlib.contextmanager
def _reading_key(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError, MemoryError) as error:
        raise UsageError(
            str(path),
            found=_spelled(error),
            expected="a secret key of `drivegain sign key` or `minisign -G`, and its password if "
            "it has one",
            remedy="check the name (the file that ends in .key is the secret one) and the password",
        ) from error


def _spelled(error: Exception) -> str:
    if isinstance(error, OSError):
        return reason_of(error)
    return str(error)


def _text_of(path: Path) -> str:
    return read_regular(path, _LARGEST_BYTES).decode()


def _read_signed(file: Path) -> bytes:
    wanted = "the calibration to be signed or checked"
    return read_file(file, CalibrationMissing, expected=wanted, remedy="check the name")


def _write_new(path: Path, text: str, mode: int) -> None:
    # O_EXCL: a key that is made at the same time stays. The mode is set before a byte of the secret
    # is written.
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
    try:
        with os.fdopen(descriptor, "wb") as stream:
            os.fchmod(descriptor, mode)
            stream.write(text.encode())
            stream.flush()
            os.fsync(descriptor)
    except BaseException:
        # Half a key is of no use, and would keep the next try from its name.
        path.unlink(missing_ok=True)
        raise
