"""Every Python block of every page runs, after the Python that stands for what the reader
brings.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import pytest

from docs.reference_pages import API_PAGES, api_names
from tests.pages.blocks import blocks_of, needed_packages, pages, python_before

ROOT = Path(__file__).parents[2]


def _with_python() -> list[Path]:
    found = []
    for page in pages(ROOT / "docs"):
        blocks = blocks_of(page.read_text(encoding="utf-8"))
        if any(block.runs_here for block in blocks):
            found.append(page)
    return found


WITH_PYTHON = _with_python()


@pytest.mark.parametrize("page", WITH_PYTHON, ids=lambda page: str(page.relative_to(ROOT / "docs")))
def test_the_python_of_a_page_runs(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    monkeypatch.syspath_prepend(str(tmp_path))
    source = page.read_text(encoding="utf-8")
    for package in needed_packages(source):
        pytest.importorskip(package)
    module = ModuleType("page")  # a class of the page is in a module, as the reader's is
    monkeypatch.setitem(sys.modules, "page", module)
    names = vars(module)
    loaded = set(sys.modules)
    exec(compile(python_before(source), f"{page} before", "exec"), names)  # noqa: S102 - the page is the program
    for block in blocks_of(source):
        if block.runs_here:
            # Lines of a traceback are those of the page.
            text = "\n" * block.line + block.text
            exec(compile(text, str(page), "exec"), names)  # noqa: S102
    for name in set(sys.modules) - loaded:
        if str(tmp_path) in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]


def test_every_page_of_the_api_has_an_example() -> None:
    examples = {page.stem for page in WITH_PYTHON if page.parent.name == "api"}
    assert examples == set(API_PAGES)


@pytest.mark.parametrize("package", ["ident", "daq", "drivers"])
def test_every_exported_name_is_on_one_page(package: str) -> None:
    described: list[str] = []
    for page, (owner, _) in API_PAGES.items():
        if owner == package:
            described.extend(api_names(page))
    exported = {f"{package}.{name}" for name in __import__(package).__all__}
    again = {"daq.Calibration"}  # it is `ident.Calibration`
    assert len(described) == len(set(described))
    assert set(described) == exported - again


def test_a_test_that_a_page_names_is_there_and_reads_the_page() -> None:
    for page in pages(ROOT / "docs"):
        for block in blocks_of(page.read_text(encoding="utf-8")):
            if block.elsewhere is not None:
                assert page.name in (ROOT / block.elsewhere).read_text(encoding="utf-8"), page
