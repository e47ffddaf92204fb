"""Pictures of matplotlib."""

from __future__ import annotations

import os
import subprocess
import sys


def test_a_picture_without_a_home_folder_says_nothing() -> None:
    environment = {**os.environ, "HOME": "/proc"}
    for name in ("MPLCONFIGDIR", "XDG_CONFIG_HOME", "XDG_CACHE_HOME"):
        environment.pop(name, None)
    program = "from daq.report.picture import single; single('gains', 2.0)"
    ended = subprocess.run(
        [sys.executable, "-c", program],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert ended.stdout == ""
    assert ended.stderr == ""
