"""Output of `make setup` while pip works."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from runpy import run_path
from typing import Any

import pytest

SAID = """\
Looking in links: /opt/wheels
Ignoring colorama: markers 'sys_platform == "win32"' don't match your environment
Collecting numpy==2.4.6 (from -r requirements.lock (line 7))
  Downloading numpy-2.4.6-cp311-cp311-manylinux_2_27_x86_64.manylinux_2_28_x86_64.whl (16.2 MB)
Collecting can==4.5 (from -r requirements.lock (line 9))
  Using cached can-4.5-py3-none-any.whl (300 kB)
Processing /opt/wheels/cmeel_qhull-8.0.2.1-1-py3-none-manylinux_2_28_x86_64.whl (from -r requirements.lock (line 12))
Requirement already satisfied: pip==25.0 in ./lib (from -r requirements.lock (line 14)) (25.0)
"""


@pytest.fixture
def set_up(checkout: Path) -> dict[str, Any]:
    return run_path(str(checkout / ".ci" / "set_up.py"))


def test_it_is_said_how_many_packages_of_how_many(set_up: dict[str, Any]) -> None:
    progress = set_up["Progress"](5)
    for line in SAID.splitlines(keepends=True):
        progress = progress.heard(line)
    assert list(progress.fetched) == ["numpy 2.4.6", "can 4.5", "cmeel_qhull 8.0.2.1", "pip 25.0"]
    assert progress.words(0) == "fetched 4 of 4 packages, 16 MB: pip 25.0"
    progress = progress.heard("Installing collected packages: numpy, can, cmeel_qhull\n")
    assert progress.words(2) == "unpacked 2 of 3 packages"


def test_the_lock_is_counted_with_what_other_machines_need(set_up: dict[str, Any], checkout: Path) -> None:
    lock = (checkout / "requirements.lock").read_text()
    assert set_up["packages_in"](lock) == sum(not line.startswith((" ", "#")) for line in lock.splitlines())


def test_what_pip_complains_of_is_shown(checkout: Path, tmp_path: Path) -> None:
    lock = tmp_path / "requirements.lock"
    lock.write_text(f"no-such-package==1.0 --hash=sha256:{64 * '0'}\n")
    done = subprocess.run(
        [sys.executable, checkout / ".ci" / "set_up.py", lock],
        env={**os.environ, "PIP_NO_INDEX": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert "ERROR: No matching distribution found for no-such-package==1.0" in done.stderr
