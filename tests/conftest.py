"""Fixtures and hooks shared by several packages' tests."""

from __future__ import annotations

import os

# Before NumPy is imported: what is equal bit by bit with one thread need not be with two.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import resource
from pathlib import Path

import pytest
from hypothesis import settings

# A busy machine is no reason to fail: no test asserts on a clock. And what passed once passes again.
settings.register_profile("drivegain", deadline=None, derandomize=True)
settings.load_profile("drivegain")

CHECKOUT = Path(__file__).resolve().parent.parent


LONG = ("test_guide.py", "test_main_job.py", "test_any_robot.py")
"""Files that take a minute and more: begun last, they would keep one processor busy after the other has ended."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the longest files first."""
    items.sort(key=lambda item: item.path.name not in LONG)


@pytest.fixture(scope="session")
def checkout() -> Path:
    """The folder of the checkout."""
    return CHECKOUT


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder with recordings and EDS files that are not part of the repository."""
    folder = Path(os.environ.get("DRIVEGAIN_DATA", CHECKOUT.parent / "shared" / "data"))
    if not (folder / "tx40").is_dir():
        pytest.skip(f"no real recordings at {folder}: set DRIVEGAIN_DATA to the folder that holds tx40/")
    return folder


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the processor time of the whole run: this process, its workers and the programs that they started."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    seconds = sum(one.ru_utime + one.ru_stime for one in used)
    terminalreporter.write_line(f"processor time: {seconds:.0f} s")
