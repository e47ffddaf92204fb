"""One write: `apply` and `rollback` of `daq.writeback.target` alone tell the ledger of a write to a
controller.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("daq", "drivers", "ident", "examples")
TARGET = "daq/writeback/target.py"
WRITERS = {
    # The audit log itself: nothing but the ledger appends to it.
    "append": ("daq.ledger.audit", {"daq/ledger/ledger.py"}),
    # Steps of a write to a controller.
    "record_write": ("daq.ledger.ledger", {TARGET}),
    # Calibrations: those that are written, and those that a job proposes or a person enters.
    "enter_calibration": (
        "daq.ledger.ledger",
        {TARGET, "daq/cli/history.py", "daq/jobs/stages.py"},
    ),
    # Steps of a job, which write to no controller. The verdict of new moves goes through
    # `audit_entry` of the report.
    "record_session": ("daq.ledger.ledger", {"daq/jobs/decision.py", "daq/jobs/reporting.py"}),
    "acknowledge": ("daq.ledger.ledger", {"daq/cli/history.py"}),
    "migrate": ("daq.ledger.ledger", {"daq/cli/history.py"}),
    "rename_cell": ("daq.ledger.ledger", {"daq/cli/history.py"}),
}
"""Each function that writes to the ledger, by name:
its module, and the files that may import it.
"""
DOORS = ("apply", "rollback")
"""The functions of `TARGET` that may lead to a writer."""


@dataclass(frozen=True)
class Import:
    """A name that a file imports from a module; None for the module itself."""

    file: str
    module: str
    name: str | None


def _imports(file: str, source: str) -> Iterator[Import]:
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom):
            for one in node.names:
                yield Import(file, node.module or "", one.name)
        elif isinstance(node, ast.Import):
            for one in node.names:
                yield Import(file, one.name, None)


def _offences(file: str, source: str) -> list[str]:
    """Return the imports by which a file could write to the ledger, and may not."""
    found = []
    modules = {module for module, _ in WRITERS.values()}
    for one in _imports(file, source):
        if one.name is None:
            whole = one.module
        else:
            whole = f"{one.module}.{one.name}"
        if whole in modules:  # by which every writer could be called
            found.append(f"{file} imports {whole}")
        elif one.name in WRITERS:
            module, allowed = WRITERS[one.name]
            if one.module == module and file not in allowed:
                found.append(f"{file} imports {one.name}")
    return found


def _sources() -> dict[str, str]:
    paths: list[Path] = []
    for package in PACKAGES:
        paths.extend((ROOT / package).rglob("*.py"))
    return {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in paths}


def test_only_the_named_files_write_to_the_ledger() -> None:
    offences = []
    for file, source in _sources().items():
        offences.extend(_offences(file, source))
    assert offences == []


@pytest.mark.parametrize(
    "line",
    [
        "from daq.ledger.audit import AuditAction, append",
        "from daq.ledger.audit import append as note",
        "from daq.ledger.ledger import record_write",
        "from daq.ledger import ledger",
        "import daq.ledger.ledger",
    ],
)
def test_another_file_that_writes_is_an_offence(line: str) -> None:
    assert len(_offences("daq/cli/apply.py", line)) == 1
    assert _offences("daq/cli/apply.py", "from daq.ledger.ledger import read_history") == []


def test_each_writer_is_where_the_table_says_and_is_used() -> None:
    sources = _sources()
    for name, (module, allowed) in WRITERS.items():
        changed_module = module.replace(".", "/")
        tree = ast.parse(sources[changed_module + ".py"])
        assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
        for file in allowed:
            assert Import(file, module, name) in set(_imports(file, sources[file])), (file, name)


def _uses(tree: ast.AST) -> set[str]:
    """Return the names that a piece of code reads, attributes included."""
    names = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    return names | {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}


def _callers(source: str, writers: set[str]) -> set[str]:
    """Return the public functions and classes of a module from which a writer can be reached."""
    uses: dict[str, set[str]] = {}
    for node in ast.parse(source).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            uses[node.name] = _uses(node)
    reaching = set(writers)
    while True:
        more = {name for name, used in uses.items() if used & reaching} - reaching
        if not more:
            break
        reaching |= more
    return {name for name in reaching - writers if not name.startswith("_")}


def test_in_target_apply_and_rollback_alone_lead_to_a_writer() -> None:
    source = (ROOT / TARGET).read_text(encoding="utf-8")
    assert _callers(source, set(WRITERS)) == set(DOORS)
    third = f"{source}\n\ndef third(recorder: object) -> None:\n    _write(recorder)\n"
    assert _callers(third, set(WRITERS)) == {*DOORS, "third"}
