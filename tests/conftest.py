"""Fixtures and hooks shared by several packages' tests."""

from __future__ import annotations

import os

# Before NumPy is imported: what is equal bit by bit with one thread need not be with two.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import gc
import resource
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from xdist.scheduler import LoadFileScheduling

# A busy machine is no reason to fail: no test asserts on a clock. And what passed once passes
# again.
settings.register_profile("drivegain", deadline=None, derandomize=True)
settings.load_profile("drivegain")

CHECKOUT = Path(__file__).resolve().parent.parent


LONG = (
    "test_main_job.py",
    "test_same_diagnoses.py",
    "test_plan_effort.py",
    "test_guided.py",
    "test_any_robot.py",
)
"""Files that take a minute and more: begun last, they would keep one processor busy after the other
has ended.
"""


def pytest_configure(config: pytest.Config) -> None:
    """Register what `make test` leaves to a target of its own."""
    config.addinivalue_line(
        "markers",
        "processes: a whole job: on several processes or buses, or a real recording "
        "(make test-processes)",
    )
    config.addinivalue_line(
        "markers",
        "slow: searches, plans and sessions on whole simulated recordings (make test-slow)",
    )
    config.addinivalue_line(
        "markers", "browser: drives Chromium, where DRIVEGAIN_CHROMIUM names it (make test-console)"
    )


def pytest_sessionstart() -> None:
    """Leave garbage alone while modules are imported:
    a third of that time would go into looking for it.
    """
    gc.disable()


def pytest_collection_finish() -> None:
    """Collect garbage again, but never look through what was imported."""
    gc.freeze()
    gc.enable()


WHOLE_SESSION = "whole_session"
"""Fixture that takes 17 s: one test that is not slow would make it for itself."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the longest files first; call slow what takes a whole guided session."""
    items.sort(key=lambda item: item.path.name not in LONG)
    for item in items:
        if WHOLE_SESSION in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.slow)


TOGETHER = "tests/daq/jobs/"
"""Folder whose files share a whole job: the worker that has made it runs them all."""


class _FolderTogether(LoadFileScheduling):  # type: ignore[misc]  # xdist has no types
    """As `--dist loadfile`, with the files of one folder in one worker."""

    def _split_scope(self, nodeid: str) -> str:
        if nodeid.startswith(TOGETHER):
            return TOGETHER
        return nodeid.split("::", 1)[0]


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> LoadFileScheduling | None:
    """Replace the scheduler of `--dist loadfile`."""
    if config.getvalue("dist") == "loadfile":
        return _FolderTogether(config, log)
    return None


@pytest.fixture(scope="session")
def checkout() -> Path:
    """The folder of the checkout."""
    return CHECKOUT


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder with recordings and EDS files that are not part of the repository."""
    folder = Path(os.environ.get("DRIVEGAIN_DATA", CHECKOUT.parent / "shared" / "data"))
    if not (folder / "tx40").is_dir():
        pytest.skip(
            f"no real recordings at {folder}: set DRIVEGAIN_DATA to the folder that holds tx40/"
        )
    return folder


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the processor time of the whole run:
    this process, its workers and the programs that they started.
    """
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    seconds = sum(one.ru_utime + one.ru_stime for one in used)
    terminalreporter.write_line(f"processor time: {seconds:.0f} s")
