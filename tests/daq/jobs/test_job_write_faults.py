"""Kills, errors and short writes at system calls of whole jobs and guided sessions, a sample of
`tests.studies.write_faults`.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from functools import partial
from pathlib import Path

import pytest

from tests.daq.failing_calls import why_not_here
from tests.daq.jobs.made import Made
from tests.daq.jobs.made_session import MadeSession
from tests.studies.write_scenes import (
    KILL,
    SHORT,
    CallUnit,
    FaultRow,
    Injection,
    JobScene,
    Scene,
    SessionScene,
)

pytestmark = pytest.mark.slow

SAMPLE = (
    ("fsync", "audit log", "EIO"),  # its first entry is there, and not flushed
    ("rename", "file of the session", "ENOSPC"),
    ("rename", "controller's file", KILL),
    ("write", "note of the audit log", SHORT),
    ("mkdir", "folder", "EROFS"),  # of the report, behind a calibration that is written
)


@pytest.fixture(scope="module")
def small() -> Iterator[Executor]:
    """A process that has imported this module alone: its forks are quick."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        reason = pool.submit(why_not_here).result()
        if reason:
            if os.environ.get("CI"):
                pytest.fail(reason)
            pytest.skip(reason)
        yield pool


def _faults(make: Callable[[], Scene]) -> list[FaultRow]:
    """The last call of each kind of the sample, and the last flush of a folder."""
    scene = make()
    scene.set_up()
    last: dict[tuple[str, str], CallUnit] = {}
    for unit in scene.units():
        last[unit.call, unit.file] = unit
    rows = [scene.run(last[call, file], Injection(name)) for call, file, name in SAMPLE]
    injection = Injection("EIO", is_lasting=True)
    rows.append(scene.run(last["fsync", "folder"], injection))
    return rows


def _judge(rows: list[FaultRow]) -> None:
    found = [(row.call, row.file, row.false_sentences, row.bad_states) for row in rows]
    expected = [(row.call, row.file, (), ()) for row in rows]
    assert found == expected
    contents = {row.content for row in rows}
    assert contents == {"old", "new"}


def test_sampled_faults_of_a_job_leave_the_truth_and_the_next_job_ends_well(
    tmp_path: Path, made: Made, small: Executor
) -> None:
    rows = small.submit(_faults, partial(JobScene, tmp_path.resolve(), made)).result()
    _judge(rows)


def test_sampled_faults_of_a_session_leave_the_truth_and_the_same_command_ends_well(
    tmp_path: Path, made_session: MadeSession, small: Executor
) -> None:
    make = partial(SessionScene, tmp_path.resolve(), made_session)
    rows = small.submit(_faults, make).result()
    _judge(rows)
