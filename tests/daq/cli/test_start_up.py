"""Start-up: help, `scan`, `info` and `history` load no library that they do not use."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from daq.errors import ExitCode
from tests.daq.histories import fill, ledger_of
from tests.daq.logs import DISC, demo_content, samples, write

NUMERICS = ("scipy.signal", "scipy.stats", "pinocchio", "numba", "matplotlib")
"""Libraries that only identification, simulation and pictures use."""

UNUSED = {
    "scan": (
        "scipy",
        "cryptography",
        "mcap",
        "rich.progress",
        "ident.estimators",
        "ident.discovery",
    ),
    "info": (
        "scipy",
        "can",
        "canopen",
        "asyncio",
        "cryptography",
        "ruamel",
        "sqlite3",
        "rich.progress",
        "daq.writeback",
    ),
    "history": (
        "scipy",
        "can",
        "canopen",
        "asyncio",
        "cryptography",
        "mcap",
        "rich.progress",
        "ident.discovery",
    ),
}
"""Further modules that each of these verbs does without; `scan` alone opens a bus."""

HELP = """
import contextlib, io
from daq.cli.app import VERBS, main
for verb in VERBS:
    for kind in ((), *((kind.name,) for kind in verb.kinds)):
        with contextlib.redirect_stdout(io.StringIO()) as shown:
            assert main([verb.name, *kind, "--help"]) == 0, verb.name
        assert "Usage" in shown.getvalue()
"""


def _loaded(code: str, names: tuple[str, ...], checkout: Path) -> list[str]:
    """Return those of the modules that a process has loaded after running some code."""
    last = (
        f"import sys; print(*(name for name in {names!r} if name in sys.modules), file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", f"{code}\n{last}"],
        capture_output=True,
        text=True,
        cwd=checkout,
        check=True,
    )
    last_line = done.stderr.splitlines()[-1]
    return last_line.split()


@pytest.mark.slow
def test_no_help_waits_for_numerics_or_the_bus(checkout: Path) -> None:
    names = (*NUMERICS, "scipy", "numpy", "can", "canopen", "mcap")
    assert _loaded(HELP, names, checkout) == []


def test_an_error_as_text_waits_for_no_types_of_documents(checkout: Path) -> None:
    assert (
        _loaded(
            "from daq.cli.app import main; main(['recrod'])",
            ("daq.report.document", "yaml"),
            checkout,
        )
        == []
    )


@pytest.mark.slow
@pytest.mark.parametrize("verb", UNUSED)
def test_a_quick_verb_loads_only_libraries_that_it_uses(
    verb: str, checkout: Path, tmp_path: Path
) -> None:
    code = "from daq.cli.app import main\n"
    if verb == "scan":
        # No node answers on this bus: the table is printed, and then the error.
        command = ["scan", "configs/cells/demo.yaml", "--wait", "0.05"]
        expected = ExitCode.DEVICE_FAULT
    elif verb == "info":
        path = tmp_path / "a.mcap"
        log = write(path, demo_content(checkout, DISC), samples([[k] * 6 for k in range(50)]))
        command = ["info", str(log)]
        expected = ExitCode.OK
    else:
        command = ["history", str(_cell_with_history(checkout, tmp_path))]
        expected = ExitCode.OK
    code += f"assert main({command!r}) == {int(expected)}\n"
    names = (*NUMERICS, *UNUSED[verb])
    assert _loaded(code, names, checkout) == []


def _cell_with_history(checkout: Path, folder: Path) -> Path:
    kept = shutil.ignore_patterns("*.jsonl*", "*.sqlite*")
    shutil.copytree(checkout / "configs", folder / "configs", ignore=kept)
    cells_folder = folder / "configs" / "cells"
    cell = cells_folder / "demo.yaml"
    fill(ledger_of(cell), 12, lambda _week: (1.0,) * 6)
    return cell
