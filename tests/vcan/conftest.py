"""Fixtures of all tests on the kernel's CAN: they are marked `vcan`, and skipped where there is no vcan0."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.vcan.run import INTERFACE

_FIGURES = pytest.StashKey[list[str]]()


def pytest_configure(config: pytest.Config) -> None:
    """Make the marker known."""
    config.addinivalue_line("markers", f"vcan: needs the kernel's CAN as {INTERFACE} (make test-vcan)")
    config.stash[_FIGURES] = []


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what is in this folder."""
    here = Path(__file__).parent
    absent = not (Path("/sys/class/net") / INTERFACE).exists()
    for item in items:
        if here in item.path.parents and item.path.name != "test_run.py":
            item.add_marker("vcan")
            if absent:
                item.add_marker(pytest.mark.skip(reason=f"no {INTERFACE} in this kernel; `make test-vcan` brings one"))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Print what was measured."""
    if config.stash[_FIGURES]:
        terminalreporter.section(f"measured on {INTERFACE}")
        for line in config.stash[_FIGURES]:
            terminalreporter.line(line)


@pytest.fixture(scope="session")
def figure(pytestconfig: pytest.Config) -> Iterator[Callable[[str], None]]:
    """Takes a line for the end of the session's report."""
    yield pytestconfig.stash[_FIGURES].append
