"""One whole job, made once: the tests of what follows the recordings take its logs and its fit."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from pathlib import Path

import pytest

from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.jobs import guided
from daq.workflow.experiment import Experiment
from daq.workflow.fit import Fit
from daq.workflow.outlook import Outlook, outlook_of
from ident.arrays import FloatArray
from tests.daq.jobs.made import Made, whole_job
from tests.daq.jobs.made_session import MadeSession, whole_session
from tests.daq.jobs.rig import Rig, make_plan


@pytest.fixture(scope="session")
def short_plan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few moves."""
    path = shipped_configurations() / "cells" / "demo.yaml"
    cell = load_cell(path)
    short_path = tmp_path_factory.mktemp("plan") / "short.yaml"
    return make_plan(cell, short_path, seed=3, duration_s=6.0, moves=2)


@pytest.fixture(scope="session")
def one_move(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A single move."""
    path = shipped_configurations() / "cells" / "demo.yaml"
    cell = load_cell(path)
    one_path = tmp_path_factory.mktemp("plan") / "one.yaml"
    return make_plan(cell, one_path, seed=3, duration_s=6.0, moves=1)


@pytest.fixture(scope="session", name="whole_job")
def whole_job_once(tmp_path_factory: pytest.TempPathFactory) -> tuple[Rig, Made]:
    """A real job from the first frame to the controller's file, and what it made."""
    folder = tmp_path_factory.mktemp("whole") / "cell"
    folder.mkdir()
    return whole_job(folder)


@pytest.fixture(scope="session")
def made(whole_job: tuple[Rig, Made]) -> Made:
    """Its logs and its fit."""
    return whole_job[1]


@pytest.fixture(scope="session", name="whole_session")
def whole_session_once(tmp_path_factory: pytest.TempPathFactory) -> tuple[Rig, MadeSession]:
    """A real guided session from the first frame to the acceptance, and what it made."""
    folder = tmp_path_factory.mktemp("guided") / "cell"
    folder.mkdir()
    return whole_session(folder)


@pytest.fixture(scope="session")
def made_session(whole_session: tuple[Rig, MadeSession]) -> MadeSession:
    """Its logs and its fit."""
    return whole_session[1]


@pytest.fixture(scope="session", autouse=True)
def _outlooks_once() -> Iterator[None]:
    """All sessions that copy the one that was made have its fit,
    whose outlook is computed once for each question.
    """
    known: dict[tuple[int, bytes], tuple[Fit, Outlook]] = {}

    def outlook_once(fitted: Fit, experiment: Experiment, std_percent: FloatArray) -> Outlook:
        question = id(fitted), pickle.dumps((experiment, std_percent))
        if question not in known:
            outlook = outlook_of(fitted, experiment, std_percent)
            known[question] = fitted, outlook
        return known[question][1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(guided, "outlook_of", outlook_once)
        yield
