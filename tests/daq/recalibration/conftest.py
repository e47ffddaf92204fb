"""One whole job, made once: the tests of what follows the recordings take its logs and its fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from daq.configuration.cell_file import load_cell
from daq.fit import Fit
from daq.record import Recorded
from daq.resources import shipped_configurations
from tests.daq.recalibration.rig import Made, Rig, make_plan, make_rig, powerless, serving


@pytest.fixture(scope="session")
def short_plan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few moves."""
    cell = load_cell(shipped_configurations() / "cells" / "demo.yaml")
    return make_plan(cell, tmp_path_factory.mktemp("plan") / "short.yaml", seed=3, duration_s=6.0, moves=2)


@pytest.fixture(scope="session")
def one_move(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A single move."""
    cell = load_cell(shipped_configurations() / "cells" / "demo.yaml")
    return make_plan(cell, tmp_path_factory.mktemp("plan") / "one.yaml", seed=3, duration_s=6.0, moves=1)


@pytest.fixture(scope="session")
def whole_job(tmp_path_factory: pytest.TempPathFactory) -> tuple[Rig, Made]:
    """A real job from the first frame to the controller's file, and what it made."""
    folder = tmp_path_factory.mktemp("whole") / "cell"
    folder.mkdir()
    cell = load_cell(shipped_configurations() / "cells" / "demo.yaml")
    plan_file = make_plan(cell, folder.parent / "plan.yaml", seed=10, duration_s=6.0)
    rig = make_rig(folder, plan_file)
    kept: dict[str, Any] = {}
    recorded: dict[str, Recorded] = {}
    tools = rig.tools

    def keep_record(*given: Any, **further: Any) -> Recorded:
        found = tools.record(*given, **further)
        recorded[found.path.stem] = found
        return found

    def keep(name: str) -> Any:
        def called(*given: Any, **further: Any) -> Fit:
            found: Fit = getattr(tools, name)(*given, **further)
            kept[name] = found
            return found

        return called

    rig.tools = replace(tools, record=keep_record, fit=keep("fit"), close_loop=keep("close_loop"))
    with serving(rig) as cell_there:
        rig.job()
        assert powerless(cell_there)
    logs = {name: rig.session.folder / f"{name}.mcap" for name in recorded}
    return rig, Made(plan_file, logs, recorded, kept["fit"], kept["close_loop"])


@pytest.fixture(scope="session")
def made(whole_job: tuple[Rig, Made]) -> Made:
    """Its logs and its fit."""
    return whole_job[1]
