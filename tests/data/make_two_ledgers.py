"""Make `tests/data/two_ledgers`: audit log and SQLite history of a cell,
as the version wrote them that had both.

    git worktree add --detach ../previous 4b099fc
    cd ../previous && PYTHONPATH=$PWD python .../tests/data/make_two_ledgers.py FOLDER

`tests/daq/ledger/test_migration.py` migrates these files. Run this with that version, never with
the present one. FOLDER is new; its path is in the audit log.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from daq.cli.app import main as drivegain
from daq.errors import ExitCode
from tests.daq.calibrations import calibration_for


def run(*arguments: object) -> None:
    """Run a command of that version.

    Raises:
        RuntimeError: it failed.
    """
    code = drivegain([*map(str, arguments)])
    if code != ExitCode.OK:
        raise RuntimeError(f"{arguments} ended with {code}")


def main(folder: Path) -> int:
    """Apply two calibrations, roll the second one back, enter a third one,
    and acknowledge a change.
    """
    shutil.copytree("configs", folder, ignore=shutil.ignore_patterns("*.jsonl", "*.sqlite*"))
    cell = folder / "cells" / "demo.yaml"
    first, second, third = (calibration_for(cell, factor) for factor in (1.0, 1.02, 1.01))
    run("apply", cell, first, "--yes", "--by", "Ada")
    run("apply", cell, second, "--yes", "--by", "Bert")
    run("rollback", cell, "--by", "Cleo")
    run("history", cell, "--add", third)
    run("history", cell, "--acknowledge", "J4", "--by", "Dora", "--why", "gearbox exchanged")
    run("history", cell, "--verify")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(Path(sys.argv[1]).resolve()))
