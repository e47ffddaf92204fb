"""Imports run one way, and a contract that is broken is reported."""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("daq", "drivers", "ident")
FOREIGN_TO_IDENT = (
    "can",
    "canopen",
    "mcap",
    "pydantic",
    "yaml",
    "ruamel",
    "typer",
    "rich",
    "matplotlib",
    "pinocchio",
    "numba",
    "drivers",
    "daq",
)


def _lint_imports(folder: Path) -> subprocess.CompletedProcess[str]:
    # -c with the folder first on the path: an editable installation must not be examined instead of
    # the copy.
    code = (
        "import sys; sys.path.insert(0, ''); from importlinter.cli import lint_imports_command; "
        "lint_imports_command()"
    )
    env = {**os.environ, "PYTHONPATH": str(folder), "COLUMNS": "200"}
    return subprocess.run(
        [sys.executable, "-c", code, "--no-cache"],
        cwd=folder,
        env=env,
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_contracts_are_kept() -> None:
    done = _lint_imports(ROOT)
    assert done.returncode == 0, done.stdout + done.stderr


BROKEN = [
    ("ident/data/run.py", "import can", "ident is not allowed to import can"),
    ("ident/data/run.py", "import pinocchio", "ident is not allowed to import pinocchio"),
    ("ident/data/run.py", "import drivers.messages", "ident is not allowed to import drivers"),
    (
        "ident/model/base.py",
        "import ident.estimators.estimate",
        "ident.model is not allowed to import ident.est",
    ),
    (
        "ident/effects/effect.py",
        "import ident.discovery.search",
        "ident.effects is not allowed to import ident.dis",
    ),
    (
        "ident/drift/change.py",
        "import ident.model.model",
        "ident.drift is not allowed to import ident.model",
    ),
    (
        "drivers/canopen/bus.py",
        "import drivers.stream.stream",
        "drivers.canopen is not allowed to import drivers.st",
    ),
    (
        "drivers/profiles/profile.py",
        "import drivers.canopen.sdo",
        "drivers.profiles is not allowed to import drivers",
    ),
    (
        "drivers/stream/watch.py",
        "import drivers.motion.execute",
        "drivers.stream is not allowed to import drivers.mo",
    ),
    ("drivers/messages.py", "import daq.errors", "drivers is not allowed to import daq"),
    ("drivers/messages.py", "import mcap.writer", "drivers is not allowed to import mcap"),
    (
        "drivers/profiles/profile.py",
        "import pinocchio",
        "drivers.profiles is not allowed to import pinocchio",
    ),
    ("daq/errors.py", "import canopen", "daq is not allowed to import canopen"),
    (
        "daq/jobs/units.py",
        "import daq.console.live",
        "daq.jobs is not allowed to import daq.console",
    ),
    (
        "daq/workflow/fit.py",
        "import daq.simulation.simulation_file",
        "daq.workflow is not allowed to import daq.sim",
    ),
    (
        "daq/workflow/nameplates.py",
        "import daq.report.text",
        "daq.workflow is not allowed to import daq.report",
    ),
    (
        "daq/workflow/nameplates.py",
        "import daq.ledger.fold",
        "daq.workflow is not allowed to import daq.ledger",
    ),
    (
        "daq/ledger/fold.py",
        "import daq.writeback.request",
        "daq.ledger is not allowed to import daq.writeback",
    ),
    (
        "daq/report/text.py",
        "import daq.jobs.session",
        "daq.report is not allowed to import daq.jobs",
    ),
    (
        "daq/log/reader.py",
        "import drivers.simulation.spec",
        "daq.log is not allowed to import drivers.simulation",
    ),
    (
        "daq/log/reader.py",
        "import daq.workflow.fit",
        "daq.log is not allowed to import daq.workflow",
    ),
    ("daq/files.py", "import daq.config.cell", "daq.files is not allowed to import daq.config"),
    (
        "daq/config/drive.py",
        "import daq.log.metadata",
        "daq.config is not allowed to import daq.log",
    ),
    # Also through a module that no contract names.
    (
        "drivers/errors.py",
        "import drivers.simulation.spec",
        "daq.writeback is not allowed to import drivers.sim",
    ),
    (
        "daq/console/live.py",
        "import drivers.canopen.bus",
        "daq.console is not allowed to import drivers.canopen.bus",
    ),
]
"""File, line that breaks a contract, and what is reported."""
CIRCLE = ("ident/estimators/estimate.py", "ident.estimators.identify")
"""File, and the module of its own room that it is made to import, which imports it."""


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The packages copied, and all their contracts broken at once."""
    folder = tmp_path_factory.mktemp("broken")
    for package in PACKAGES:
        ignore = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / package, folder / package, ignore=ignore)
    shutil.copyfile(ROOT / "pyproject.toml", folder / "pyproject.toml")
    begin = "from __future__ import annotations\n"
    for file, line, _ in BROKEN:
        path = folder / file
        changed_text = path.read_text().replace(begin, f"{begin}\n{line}\n", 1)
        path.write_text(changed_text)
    for package in PACKAGES:
        nowhere_path = folder / package / "nowhere.py"
        nowhere_path.write_text('"""A module that no layer names."""\n')
    circle = folder / CIRCLE[0]
    circle.write_text(circle.read_text().replace(begin, f"{begin}\nimport {CIRCLE[1]}\n", 1))
    done = _lint_imports(folder)
    assert done.returncode == 1, done.stdout + done.stderr
    return " ".join(done.stdout.split())


@pytest.mark.parametrize(("file", "line", "says"), BROKEN)
def test_a_contract_broken_on_purpose_is_reported(
    report: str, file: str, line: str, says: str
) -> None:
    """By its import: that of another line would not do."""
    module = file.removesuffix(".py").replace("/", ".")
    imported = line.removeprefix("import ")
    package = imported.partition(".")[0]
    if package not in PACKAGES:  # of a foreign one the package alone is named
        imported = package
    _, found, reported = report.partition(says)
    assert found
    # The import is among those listed behind the sentence, before the next one of its kind.
    assert f"{module} -> {imported} (l." in reported.partition("is not allowed")[0], reported[:500]


@pytest.mark.parametrize("package", PACKAGES)
def test_a_module_in_no_layer_is_reported(report: str, package: str) -> None:
    assert f"{package}.nowhere" in report


def test_a_circle_within_a_room_is_reported(report: str) -> None:
    _, found, reported = report.partition("No cycles are allowed in ident.estimators")
    assert found, report[-3000:]
    assert "identify" in reported


def test_the_science_brings_no_bus_no_log_and_no_screen() -> None:
    """A program that uses `ident` alone imports none of them, even with all of its modules."""
    code = (
        "import importlib, pkgutil, sys, ident\n"
        "names = [m.name for m in pkgutil.walk_packages(ident.__path__, 'ident.')]\n"
        "for name in names: importlib.import_module(name)\n"
        "print(len(names), *sorted({name.partition('.')[0] for name in sys.modules}))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    count, *loaded = done.stdout.split()
    assert int(count) > 5
    assert "numpy" in loaded
    assert not set(FOREIGN_TO_IDENT) & set(loaded)


def test_the_helper_of_the_front_doors_imports_the_standard_library_alone() -> None:
    """It is beside the packages, where no contract sees it;
    whatever it imports, all three would.
    """
    imported = set[str]()
    text = (ROOT / "lazy_names.py").read_text()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            imported.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            imported.add(str(node.module))
    assert {name.partition(".")[0] for name in imported} <= sys.stdlib_module_names
