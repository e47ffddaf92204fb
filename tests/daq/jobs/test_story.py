"""What a person reads of a session, and where the console says that it is."""

from __future__ import annotations

import io
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from daq.config.cell_file import load_cell
from daq.console.results import Results
from daq.documents.session_state import (
    Acceptance,
    Block,
    Decision,
    Fitted,
    GainSoFar,
    GuidedState,
    Outcome,
    RecordedRun,
)
from daq.environment import shipped_configurations
from daq.jobs.guided import motion_left_s
from daq.jobs.journal import Form, Level
from daq.jobs.position import StageName, goes_on_with, position_of
from daq.jobs.session import Session, save
from daq.jobs.story import PARAGRAPHS, SENTENCES, Story
from daq.log.feed import QuickGain, QuickLook
from tests.daq.jobs.made_session import MadeSession, made_session_rig, run_session
from tests.daq.jobs.rig import BEGAN, Rig

GAINS = (
    {"axis": "J1", "unit": "Nm/A", "value": 33.9, "std_percent": 0.4, "target_percent": 0.5},
    {"axis": "J6", "unit": "Nm/A", "value": 6.79, "std_percent": 1.0, "target_percent": 0.5},
)


def story() -> tuple[Story, io.StringIO]:
    stream = io.StringIO()
    return Story(stream, Form.TEXT, lambda: datetime(2026, 1, 5, tzinfo=UTC)), stream


def test_the_worst_gain_comes_first_with_what_it_lacks() -> None:
    journal, stream = story()
    journal.say(
        Level.INFO, "gains so far", gains=list(GAINS), blocks=3, motion_s=60.0, left_s=180.0
    )
    written = stream.getvalue().strip()
    title, worst, other, outlook = written.splitlines()
    assert title == "Gains after 3 blocks, 60 s of motion:"
    expected = ["J6", "6.79", "Nm/A", "±", "1.00", "%", "not", "yet:", "2.0", "×", "the", "target"]
    assert worst.split() == expected
    assert other.split() == ["J1", "33.9", "Nm/A", "±", "0.40", "%", "✓"]
    assert "J6 needs the longest: about 3 min more at this rate" in outlook


def test_why_the_worst_gain_is_worst_is_said_after_a_block() -> None:
    journal, stream = story()
    explained = (
        {**GAINS[0], "cause": ""},
        {**GAINS[1], "cause": "its current is noisier than planned"},
    )
    journal.say(
        Level.INFO, "gains so far", gains=list(explained), blocks=3, motion_s=60.0, left_s=100.0
    )
    lines = stream.getvalue().strip().splitlines()
    outlook = lines[-1]
    assert "J6 needs the longest (its current is noisier than planned): about 100 s more" in outlook


def quick(**changed: Any) -> str:
    """What a person reads of a look after a move."""
    quick_gain = QuickGain("J6", "Nm/A", 6.79, 1.0, 0.5)
    gains = [quick_gain, QuickGain("J1", "Nm/A", 33.9, 0.4, 0.5)]
    look = QuickLook(
        "block-4-loaded", 3, 14, 80.0, gains=gains, why="it needs more moves", left_s=240.0
    )
    journal, stream = story()
    changed_look = replace(look, **changed)
    journal.say(Level.INFO, "quick estimate", **asdict(changed_look))
    return stream.getvalue()


def test_after_a_move_one_line_has_every_gain_beside_its_target() -> None:
    (line,) = quick().splitlines()
    assert line == (
        "Quick estimate, move 3 of 14, target ± 0.5 %: J6 6.79 ± 1.00 %, J1 33.9 ± 0.40 %. "
        "J6 is worst (it needs more moves): about 4 min left."
    )


def test_what_is_missing_is_said_in_the_place_of_figures() -> None:
    assert quick(gains=[], missing="no payload") == "No gains yet: no payload.\n"
    held_out = quick(is_held_out=True)
    assert held_out.startswith("Held out, not counted.")
    assert "left" not in held_out
    assert "the end of the block decides" in quick(left_s=0.0)


def test_at_the_time_limit_it_is_said_what_would_help() -> None:
    journal, stream = story()
    journal.say(
        Level.NOTICE,
        "time is up",
        missing="J6 1.02 %",
        would_help=("more time", "J6: mount a heavier body"),
    )
    lines = stream.getvalue().strip().splitlines()
    assert lines == [
        "The time is up. Not reached: J6 1.02 %.",
        "What would help:",
        "  more time",
        "  J6: mount a heavier body",
    ]


def test_time_that_is_left_is_that_of_the_worst_gain() -> None:
    """σ twice the target needs four times the motion, three times of it still to come."""
    gains = [GainSoFar.model_validate(gain) for gain in GAINS]
    path = shipped_configurations() / "cells" / "demo.yaml"
    cell = load_cell(path)
    blocks = []
    for number, (kind, payload) in enumerate(
        [("bare", None), ("loaded", "disc"), ("held-out", "disc")], 1
    ):
        blocks.append(
            Block(
                name=f"block-{number}-{kind}",
                payload=payload,
                mass_kg=None,
                holdout=kind == "held-out",
                plan="",
            )
        )
    assert motion_left_s(cell, gains, blocks, 30.0) == pytest.approx(180.0)
    assert motion_left_s(cell, gains[:1], blocks, 30.0) == 0.0
    # Three more blocks of each kind, as friction by payload needs no order.
    by_payload = replace(cell, friction_by_payload=True)
    assert motion_left_s(by_payload, gains, blocks, 30.0) == pytest.approx(180.0)
    assert motion_left_s(by_payload, gains[:1], blocks, 30.0) == 0.0
    assert motion_left_s(by_payload, [], blocks, 30.0) == 0.0


def test_a_warning_is_said_once_and_what_is_for_programs_never() -> None:
    journal, stream = story()
    for _ in range(2):
        journal.say(Level.WARNING, "warning of the recorder", text="no rated torque")
    journal.say(Level.INFO, "mounted", payload="disc")
    journal.say(Level.ERROR, "something new", text="with its reason\x1b[2J")
    lines = stream.getvalue().splitlines()
    assert lines == [
        "! no rated torque",
        "! something new: with its reason\\x1b[2J",
    ]


LARGEST_COUNT = 160  #: Words of a session of three blocks, without questions


def test_every_sentence_is_one_that_a_session_says(whole_session: tuple[Rig, MadeSession]) -> None:
    """Each event of a real session has its fields as the sentences expect them,
    and no line has a time stamp.
    """
    rig, _ = whole_session
    journal, stream = story()
    of_journal = {"time", "level", "event", "session", "step"}
    for event in rig.events:
        fields = {key: value for key, value in event.items() if key not in of_journal}
        level = event["level"].upper()
        journal.say(Level[level], event["event"], **fields)
    text = stream.getvalue()
    assert "Gains after 3 blocks" in text
    assert "Every gain is within ± 5 %" in text
    assert "Accepted" in text
    assert "kg more than without load" in text
    # What a technician reads of a session, without names of files, numbers and signs.
    assert len([word for word in text.split() if word.isalpha()]) < LARGEST_COUNT
    # But for the names of folders, and for the certificate, which says when it was accepted.
    timeless = [
        line
        for line in text.splitlines()
        if "/" not in line and not line.startswith("Certificate ")
    ]
    assert "2026-" not in "".join(timeless)
    # A session that reaches its target has no end of its time, and looks after a move are not of
    # the session itself.
    elsewhere = {"quick estimate", "time is up"}
    events = {event["event"] for event in rig.events}
    assert set(PARAGRAPHS) - elsewhere <= events
    assert not set(PARAGRAPHS) & set(SENTENCES)


def state(**changed: object) -> GuidedState:
    blocks = (
        Block(name="block-1-bare", payload=None, mass_kg=None, holdout=False, plan="plan-1.yaml"),
        Block(
            name="block-2-loaded", payload="disc", mass_kg=4.59, holdout=False, plan="plan-2.yaml"
        ),
    )
    runs = tuple(_run(block.name) for block in blocks)
    made = GuidedState(
        session="s",
        cell="demo",
        configuration_sha256="",
        began=BEGAN.isoformat(),
        attempt_began=BEGAN.isoformat(),
        blocks=blocks,
        runs=runs,
    )
    return made.model_copy(update=changed)


def _run(name: str) -> RecordedRun:
    return RecordedRun(name=name, sha256="", attempts=1, samples=1, lost_cycles=0, missing=())


ENDED = BEGAN.isoformat()
FITTED = Fitted(calibration_sha256="", sentences=())
DECIDED = {"complete": True, "fitted": FITTED, "decision": Decision(gains=(), remark="")}
ACCEPTED = Acceptance(
    log_sha256="",
    scales=(),
    old_error_percent=5.0,
    new_error_percent=2.0,
    accepted=True,
    remark="good",
)


@pytest.mark.parametrize(
    ("changed", "stage", "step"),
    [
        (
            {"runs": ()},
            StageName.RECORD,
            "NOTHING on the flange, then the robot moves: block-1-bare",
        ),
        ({"runs": (_run("block-1-bare"),)}, StageName.RECORD, "DISC (4.59 kg) on the flange"),
        ({}, StageName.RECORD, "the next block is being prepared"),
        ({"complete": True}, StageName.IDENTIFY, "being identified"),
        (DECIDED, StageName.WRITE, "type yes"),
        ({**DECIDED, "outcome": Outcome.APPLIED}, StageName.ACCEPT, "moves that are new"),
        (
            {**DECIDED, "outcome": Outcome.APPLIED, "ended": ENDED},
            StageName.ACCEPT,
            "moves that are new",
        ),
        (
            {**DECIDED, "outcome": Outcome.APPLIED, "acceptance": ACCEPTED, "ended": ENDED},
            StageName.ENDED,
            "applied",
        ),
        (
            {
                **DECIDED,
                "outcome": Outcome.APPLIED,
                "acceptance": ACCEPTED,
                "ended": ENDED,
                "problem": "interrupted",
            },
            StageName.ACCEPT,
            "the certificate",
        ),
        ({**DECIDED, "outcome": Outcome.PROPOSED, "ended": ENDED}, StageName.ENDED, "proposed"),
    ],
)
def test_the_position_of_a_session_is_what_its_state_lacks(
    changed: dict[str, object], stage: StageName, step: str
) -> None:
    position = position_of(state(**changed))
    assert position.stage is stage
    assert step in position.next_step


@pytest.mark.parametrize(
    ("changed", "step"),
    [
        (
            {"runs": (_run("block-1-bare"),)},
            "it records block-2-loaded again, which does not count yet",
        ),
        ({}, "it goes on with the next block"),
        ({"complete": True}, "it records nothing again, and goes on with the identification"),
        (
            {**DECIDED, "outcome": Outcome.APPLIED},
            "it goes on with the moves that accept the gains",
        ),
        (
            {**DECIDED, "outcome": Outcome.APPLIED, "acceptance": ACCEPTED},
            "it makes the certificate again",
        ),
    ],
)
def test_the_next_step_after_an_error_is_what_the_same_command_does(
    changed: dict[str, object], step: str
) -> None:
    assert goes_on_with(state(**changed)).startswith(step)


def test_the_console_shows_where_a_session_is_and_how_its_precision_grew(
    tmp_path: Path, made_session: MadeSession
) -> None:
    cell_folder = tmp_path / "cell"
    rig = made_session_rig(cell_folder, made_session)
    results = Results(rig.cell_file, rig.cell)
    assert results.document()["guided"] is None
    run_session(rig)
    shown = results.document()
    assert shown["problems"] == []
    assert shown["guided"]["stage"] == "ended"
    acceptance = shown["guided"]["acceptance"]
    assert acceptance["accepted"] is True
    precision = shown["guided"]["precision"]
    assert precision["left_s"] == 0.0
    (progress,) = precision["progress"]
    assert progress["motion_s"] == 18.0
    assert progress["fitted_s"] == 12.0
    assert len(progress["std_percent"]) == len(precision["axes"]) == 6
    assert precision["worst"] in precision["axes"]
    assert shown["session"]["kind"] == "Session"
    runs = (_run("block-1-bare"),)
    waiting = state(runs=runs)
    folder = rig.session.folder
    update = {"session": folder.name}
    session = Session(folder, waiting.model_copy(update=update))
    save(session)
    guided = results.document()["guided"]
    assert guided["next_step"].startswith("DISC (4.59 kg) on the flange")
