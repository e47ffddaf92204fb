"""By what a content is recognised."""

from __future__ import annotations

import os
from pathlib import Path

from daq.files import sha256, sha256_of

OF_A = "ca978112ca1bbdcafac231b39a23dc4da786eff8147c4e72b9807785afee48bb"


def test_a_digest_is_that_of_the_content(tmp_path: Path) -> None:
    path = tmp_path / "a"
    assert sha256_of(path) is None
    path.write_bytes(b"a")
    assert sha256_of(path) == sha256(b"a") == OF_A


def test_what_is_no_regular_file_has_none_and_no_one_waits(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    assert [sha256_of(path) for path in (tmp_path / "pipe", tmp_path, Path("/dev/zero"))] == [
        None
    ] * 3
