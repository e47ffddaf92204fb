"""Pytest plugin: tell coverage which test is running, and write down how long each test took.

Used by `coverage_map`, as `coverage run -m pytest -p tests.mutation.contexts`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Generator
from pathlib import Path

import coverage
import pytest

DURATIONS_VARIABLE = "DRIVEGAIN_MUTATION_DURATIONS"
_durations: dict[str, float] = {}


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, bool, bool]:
    """Record the lines of a test, its fixtures included, under the test's name."""
    running = coverage.Coverage.current()
    if running is not None:
        running.switch_context(item.nodeid)
    result = yield
    if running is not None:
        running.switch_context("")
    return result


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Sum the times of set-up, call and teardown."""
    _durations[report.nodeid] = _durations.get(report.nodeid, 0.0) + report.duration


def pytest_sessionfinish() -> None:
    """Write the durations in seconds by test."""
    Path(os.environ[DURATIONS_VARIABLE]).write_text(json.dumps(_durations))
