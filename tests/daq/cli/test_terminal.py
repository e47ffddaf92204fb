"""Files and folders that a verb writes."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from daq.cli.terminal import write_new_folder


@pytest.mark.parametrize(("umask", "mode"), [(0o077, 0o700), (0o022, 0o755), (0o027, 0o750)])
def test_a_new_folder_under_a_umask_has_the_mode_of_the_folders_in_it(
    tmp_path: Path, umask: int, mode: int
) -> None:
    folder = tmp_path / "cells"
    before = os.umask(umask)
    try:
        with write_new_folder(folder) as temporary:
            inner = temporary / "controllers"
            inner.mkdir()
    finally:
        os.umask(before)
    modes = [path.stat().st_mode & 0o777 for path in (folder, folder / "controllers")]
    assert modes == [mode, mode]
