"""By what a content is recognised: SHA-256, hexadecimal."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from pathlib import Path

from daq.regular_file import open_regular


def sha256(content: bytes) -> str:
    """Of bytes that have been read."""
    return hashlib.sha256(content).hexdigest()


def sha256_of(path: Path) -> str | None:
    """Of a file, read piece by piece; None where there is no regular file that can be read."""
    with suppress(OSError), open_regular(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
    return None
