"""The file formats of minisign: keys and signatures with Ed25519 (RFC 8032) and BLAKE2b.

Layouts from minisign's documentation, numbers little-endian, each as base64 under a line of
comment::

    public key   "Ed" | key id 8 | public key 32
    secret key   "Ed" | kdf 2 | "B2" | salt 32 | opslimit 8 | memlimit 8 | key id 8 | seed 32 | public key 32 | check 32
    signature    "ED" | key id 8 | signature 64 of BLAKE2b-512(file);
                 then a trusted comment, and 64 bytes that sign signature | trusted comment

The last 104 bytes of a secret key are XORed with scrypt's key stream where kdf is "Sc"; then check
is BLAKE2b-256("Ed" | key id | seed | public key). Where kdf is zero they are plain, and check is
zero. Text that does not fit is a ValueError with what was found.
"""  # noqa: E501

from __future__ import annotations

import base64
import hashlib
import struct
from dataclasses import dataclass

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.kdf.scrypt import Scrypt

from daq.config.policy import KEY_ALGORITHM, UNTRUSTED, PublicKey, decode_line, shown_id

TRUSTED = "trusted comment: "
_PREHASHED = b"ED"
_CHECK = b"B2"
_SCRYPT = b"Sc"
_PLAIN = b"\0\0"
_SECRET = struct.Struct("<2s2s2s32sQQ104s")
_BODY = struct.Struct("<8s32s32s32s")
_SIGNATURE = struct.Struct("<2s8s64s")
_SIGNATURE_LINES = 4

# scrypt with N = 2¹⁷, r = 8, p = 1: 128 MB and half a second, which the PC of a cell can spare
# (minisign's own: 1 GB).
_OPSLIMIT = 2**22
_MEMLIMIT = 2**27
_MEMLIMIT_ALLOWED = 2**30
_OPSLIMIT_ALLOWED = 2**26


@dataclass(frozen=True, slots=True)
class SecretKey:
    """Key that a file is signed with, in memory only."""

    key_id: bytes  #: 8 bytes that name the key pair
    seed: bytes  #: Ed25519 private key, 32 bytes; hidden from every representation

    def __repr__(self) -> str:
        """Hide the secret, which must not reach a log with a traceback."""
        return f"SecretKey({shown_id(self.key_id)})"

    @property
    def public(self) -> PublicKey:
        """The public half."""
        return PublicKey(
            self.key_id,
            Ed25519PrivateKey.from_private_bytes(self.seed).public_key().public_bytes_raw(),
        )

    def sign(self, content: bytes, comment: str) -> Signature:
        """Sign bytes, and with them a comment of one line."""
        private = Ed25519PrivateKey.from_private_bytes(self.seed)
        signed = private.sign(hashlib.blake2b(content).digest())
        return Signature(self.key_id, signed, comment, private.sign(signed + comment.encode()))

    def text(self, password: str, salt: bytes) -> str:
        """Format its file.

        Args:
            password: empty for a key that only the file's mode protects.
            salt: 32 random bytes.
        """
        public = self.public.key
        if password:
            body = _BODY.pack(
                self.key_id, self.seed, public, _checksum(self.key_id, self.seed, public)
            )
            body = _xor(body, _stream(password, salt, _OPSLIMIT, _MEMLIMIT))
            packed = _SECRET.pack(KEY_ALGORITHM, _SCRYPT, _CHECK, salt, _OPSLIMIT, _MEMLIMIT, body)
        else:
            body = _BODY.pack(self.key_id, self.seed, public, bytes(32))
            packed = _SECRET.pack(KEY_ALGORITHM, _PLAIN, _CHECK, bytes(32), 0, 0, body)
        kind = "encrypted" if password else "unencrypted"
        return f"{UNTRUSTED}minisign {kind} secret key\n{base64.b64encode(packed).decode()}\n"


@dataclass(frozen=True, slots=True)
class Signature:
    """One signature."""

    key_id: bytes  #: of the key pair that made it
    signature: bytes  #: of the content's BLAKE2b-512, 64 bytes
    comment: str  #: the trusted comment
    whole: bytes  #: of `signature` and `comment` together, 64 bytes

    @property
    def text(self) -> str:
        """Content of its file."""
        signed = base64.b64encode(_SIGNATURE.pack(_PREHASHED, self.key_id, self.signature)).decode()
        whole = base64.b64encode(self.whole).decode()
        return f"{UNTRUSTED}signature by drivegain\n{signed}\n{TRUSTED}{self.comment}\n{whole}\n"


def check_signature(key: PublicKey, signature: Signature, content: bytes) -> None:
    """Check that the holder of the secret key signed these bytes and this comment.

    Raises:
        ValueError: they did not.
    """
    if signature.key_id != key.key_id:
        raise ValueError(
            f"a signature of key {shown_id(signature.key_id)}, not of {shown_id(key.key_id)}"
        )
    public = Ed25519PublicKey.from_public_bytes(key.key)
    try:
        public.verify(signature.signature, hashlib.blake2b(content).digest())
    except InvalidSignature:
        raise ValueError("a signature of other content") from None
    try:
        public.verify(signature.whole, signature.signature + signature.comment.encode())
    except InvalidSignature:
        raise ValueError("a trusted comment that was changed") from None


def is_encrypted(text: str) -> bool:
    """Whether a secret key requires a password; raises ValueError where the text is none."""
    return _parts(text)[0] == _SCRYPT


def parse_secret_key(text: str, password: str = "") -> SecretKey:
    """Parse the file of a secret key.

    Raises:
        ValueError: it is none, or does not decrypt with this password.
    """
    kdf, salt, opslimit, memlimit, body = _parts(text)
    if kdf == _SCRYPT:
        if not password:
            raise ValueError("a key with a password, and no password")
        body = _xor(body, _stream(password, salt, opslimit, memlimit))
    key_id, seed, public, check = _BODY.unpack(body)
    if kdf == _SCRYPT and check != _checksum(key_id, seed, public):
        raise ValueError("a key that this password does not open")
    key = SecretKey(key_id, seed)
    if key.public.key != public:
        raise ValueError("a secret key whose halves do not belong together")
    return key


def parse_signature(text: str) -> Signature:
    """Parse the file of a signature.

    Raises:
        ValueError: it is none, or not a prehashed one.
    """
    # Line ends of a mail or of Windows are not signed.
    lines = text.replace("\r\n", "\n").removesuffix("\n").split("\n")
    shaped = (
        len(lines) == _SIGNATURE_LINES
        and lines[0].startswith(UNTRUSTED)
        and lines[2].startswith(TRUSTED)
    )
    if not shaped:
        raise ValueError(
            "no signature: expected four lines, comment, signature, trusted comment, signature"
        )
    packed = decode_line(lines[1], _SIGNATURE.size, "a signature")
    algorithm, key_id, signature = _SIGNATURE.unpack(packed)
    if algorithm != _PREHASHED:
        raise ValueError(
            f"a signature of kind {algorithm!r}, not the prehashed kind ED (`minisign -S -H` makes "
            "it)"
        )
    whole = decode_line(lines[3], 64, "the signature of the trusted comment")
    return Signature(key_id, signature, lines[2].removeprefix(TRUSTED), whole)


def _parts(text: str) -> tuple[bytes, bytes, int, int, bytes]:
    lines = text.strip().splitlines()
    packed = decode_line(lines[-1] if lines else "", _SECRET.size, "a secret key")
    algorithm, kdf, check, salt, opslimit, memlimit, body = _SECRET.unpack(packed)
    if algorithm != KEY_ALGORITHM or check != _CHECK or kdf not in {_SCRYPT, _PLAIN}:
        raise ValueError(
            f"a key of algorithm {algorithm!r}, key derivation {kdf!r}, checksum {check!r}"
        )
    return kdf, salt, opslimit, memlimit, body


def _checksum(key_id: bytes, seed: bytes, public: bytes) -> bytes:
    return hashlib.blake2b(KEY_ALGORITHM + key_id + seed + public, digest_size=32).digest()


def _stream(password: str, salt: bytes, opslimit: int, memlimit: int) -> bytes:
    if opslimit > _OPSLIMIT_ALLOWED or memlimit > _MEMLIMIT_ALLOWED:
        raise ValueError(f"a key that asks for {memlimit} bytes and {opslimit} operations to open")
    work, parallel = _scrypt_parameters(opslimit, memlimit)
    return Scrypt(salt=salt, length=_BODY.size, n=work, r=8, p=parallel).derive(password.encode())


def _scrypt_parameters(opslimit: int, memlimit: int) -> tuple[int, int]:
    """Return N and p for r = 8, as libsodium derives them from its two limits
    (crypto_pwhash_scryptsalsa208sha256).
    """
    opslimit = max(opslimit, 32768)
    quick = opslimit < memlimit // 32
    largest = opslimit // 32 if quick else memlimit // 1024
    exponent = max(1, (largest // 2).bit_length())
    return 2**exponent, 1 if quick else max(1, (opslimit // 4 >> exponent) // 8)


def _xor(left: bytes, right: bytes) -> bytes:
    return bytes(a ^ b for a, b in zip(left, right, strict=True))
