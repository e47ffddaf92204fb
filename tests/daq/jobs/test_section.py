"""`recalibration` of the cell file: what it may contain, and what is refused with its line."""

from __future__ import annotations

import json
import re
from dataclasses import fields, replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import TypeAdapter

from daq.config.cell_file import load_cell
from daq.config.recalibration import PlannedRun, RecalibrationSection, SeededPlan
from daq.documents.session_state import Fitted, Outcome
from daq.errors import SchemaMismatch
from daq.jobs.session import Basis, begin, last_good, remove_old, resumable_session, save, sessions
from tests.daq.jobs.rig import BEGAN, make_rig

DOCUMENT = Path(__file__).parents[3] / "docs" / "how-to" / "schedule-recalibration.md"


def changed(tmp_path: Path, **section: Any) -> Path:
    folder = tmp_path / "cell"
    plan_file = tmp_path / "plan.yaml"
    rig = make_rig(folder, plan_file, **section)
    return rig.cell_file


BASIS = Basis("demo", "c" * 64, "b" * 64)
RUN = {"name": "bare-1", "plan": {"seed": 1}}
LOADED = {"name": "loaded-1", "payload": "disc", "mass_kg": 4.59, "plan": {"seed": 1}}
HELD_OUT = {**LOADED, "name": "held-out", "holdout": True}


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"interlock": {}}, "no job moves a robot unasked"),
        ({"warm_up_minutes": 1}, "warm_up_min"),
        ({"runs": [RUN, LOADED, {**HELD_OUT, "holdout": False}]}, "holdout: true"),
        (
            {"runs": [RUN, {**LOADED, "holdout": True}, HELD_OUT]},
            "one run without and one with a payload",
        ),
        ({"runs": [RUN, {**LOADED, "name": "bare-1"}, HELD_OUT]}, "names of their own"),
        ({"runs": [{**RUN, "mass_kg": 1.0}, LOADED, HELD_OUT]}, "payload and its mass_kg"),
        (
            {"runs": [{**RUN, "plan_file": "a.yaml"}, LOADED, HELD_OUT]},
            "plan_file with approved moves",
        ),
        ({"runs": [{**RUN, "name": "warm-up"}, LOADED, HELD_OUT]}, "another name than warm-up"),
        ({"runs": [{**RUN, "name": "../up"}, LOADED, HELD_OUT]}, "name"),
        ({"mount": {"command": []}}, "at least 1 item"),
        ({"mount": {"command": "mount-it"}}, "mount"),
        ({"every_h": -1}, "greater than or equal to 0"),
    ],
)
def test_what_is_not_so_is_refused(tmp_path: Path, section: dict[str, Any], message: str) -> None:
    with pytest.raises(SchemaMismatch, match=re.escape(message)):
        load_cell(changed(tmp_path, **section))


def test_paths_are_meant_from_the_cell_file(tmp_path: Path) -> None:
    runs = [{**RUN, "plan": None, "plan_file": "plans/a.yaml"}, LOADED, HELD_OUT]
    file = changed(
        tmp_path,
        runs=runs,
        interlock={"file": "state/interlock"},
        metrics="../metrics",
    )
    section = load_cell(file).recalibration
    assert section is not None
    plans_folder = file.parent / "plans"
    expected = (plans_folder / "a.yaml").resolve()
    assert section.runs[0].plan_file == expected
    seeded_plan = SeededPlan(seed=1, duration_s=40.0)
    assert section.runs[1].plan == seeded_plan
    assert section.interlock.command is None
    interlock_folder = file.parent / "state" / "interlock"
    assert section.interlock.file == interlock_folder.resolve()
    metrics_folder = file.parent.parent / "metrics"
    assert section.metrics == metrics_folder.resolve()
    demo_path = file.parent / "demo.recalibration"
    assert section.folder == demo_path.resolve()


def test_the_page_shows_every_key_and_its_example_is_one() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    (example,) = re.findall(r"```yaml\n(recalibration:\n.*?)```", text, re.DOTALL)
    recalibration = yaml.safe_load(example)["recalibration"]
    TypeAdapter(RecalibrationSection).validate_json(json.dumps(recalibration))
    for section in (RecalibrationSection, PlannedRun):
        for key in fields(section):
            pattern = rf"\b{key.name}:"
            assert re.search(pattern, example), key.name


def test_sessions_are_found_taken_up_and_removed_by_their_age(tmp_path: Path) -> None:
    made = []
    for week in range(6):
        days = 7 * week
        began_now = BEGAN + timedelta(days=days)
        session = begin(tmp_path, BASIS, began_now)
        outcome = (Outcome.APPLIED, Outcome.STOPPED)[week % 2]
        state = session.state.with_(outcome=outcome, ended=session.state.began)
        made.append(save(type(session)(session.folder, state)))
    (tmp_path / "20260101T000000Z").mkdir()
    (tmp_path / "notes").mkdir()
    found = sessions(tmp_path)
    assert found == tuple(made)
    assert last_good(found) == made[4]
    now = BEGAN + timedelta(days=35)
    assert resumable_session(found, BASIS, now + timedelta(hours=1), 2.0) == made[5]
    configuration_sha256 = "d" * 64
    changed_basis = replace(BASIS, configuration_sha256=configuration_sha256)
    plans_sha256 = "d" * 64
    for basis in (
        changed_basis,
        replace(BASIS, plans_sha256=plans_sha256),
    ):
        assert resumable_session(found, basis, now + timedelta(hours=1), 2.0) is None
    for later_h in (3, -1):
        assert resumable_session(found, BASIS, now + timedelta(hours=later_h), 2.0) is None
    began = made[4].began
    assert resumable_session(found[:5], BASIS, began, 2.0) is None
    # The calibration of the third week is in force: its logs and signatures are what the controller
    # rests on.
    calibration_sha256 = "f" * 64
    fitted = Fitted(calibration_sha256=calibration_sha256, sentences=())
    changed_made = replace(made[2], state=made[2].state.with_(fitted=fitted))
    save(changed_made)
    removed = remove_old(sessions(tmp_path), 1, {"f" * 64})
    expected = tuple(session.folder for session in (made[0], made[1], made[3]))
    assert removed == expected
    folders = [session.folder for session in sessions(tmp_path)]
    folders_expected = [made[i].folder for i in (2, 4, 5)]
    assert folders == folders_expected


def test_two_sessions_of_one_second_have_folders_of_their_own(tmp_path: Path) -> None:
    names = [begin(tmp_path, BASIS, BEGAN).folder.name for _ in range(3)]
    assert names == ["20260105T020000Z", "20260105T020000Z-02", "20260105T020000Z-03"]
    assert [session.folder.name for session in sessions(tmp_path)] == names
