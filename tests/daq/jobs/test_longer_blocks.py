"""Blocks that have no room for enough moves take longer, as do all later ones,
also after a session was interrupted.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from daq.config.cell import Cell
from daq.documents.session_state import GuidedState, Outcome
from daq.errors import PlanTooShort
from daq.jobs.block_order import FIRST_BLOCKS
from daq.jobs.story import SENTENCES
from daq.workflow.plan import Plan
from daq.workflow.record import Recorded, RecordingRequest
from tests.daq.jobs.made_session import (
    BLOCK_S,
    MadeSession,
    given_answers,
    made_session_rig,
    run_session,
)
from tests.daq.jobs.rig import Rig


def _rig(folder: Path, made: MadeSession, needed_s: float) -> Rig:
    """A rig whose plans have room for enough moves in so many seconds."""
    rig = made_session_rig(folder, made)
    planned = rig.tools.plan

    def plan_if_long(cell: Cell, *, seed: int, duration_s: float, **further: Any) -> Plan:
        if duration_s < needed_s:
            raise PlanTooShort(
                "plan", found="room for 4 moves", expected="at least 5", remedy="allow a longer run"
            )
        return planned(cell, seed=seed, duration_s=duration_s, **further)

    rig.tools = replace(rig.tools, plan=plan_if_long)
    return rig


def _state(rig: Rig) -> GuidedState:
    state = rig.session.state
    assert isinstance(state, GuidedState)
    return state


def _said(rig: Rig) -> list[dict[str, Any]]:
    # The moves that accept the gains have a duration of their own, 10 s.
    return [
        event
        for event in rig.events
        if event["event"] == "longer blocks" and event["asked_s"] % BLOCK_S == 0.0
    ]


def test_blocks_are_twice_as_long_where_the_asked_duration_has_no_room(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    needed_s = 4.0 * BLOCK_S
    rig = _rig(folder, made_session, needed_s)
    ended = run_session(rig)
    assert ended.outcome is Outcome.APPLIED
    state = _state(rig)
    assert state.block_s == 4.0 * BLOCK_S
    expected = [4.0 * BLOCK_S] * len(FIRST_BLOCKS)
    duration_s = [block.duration_s for block in state.blocks]
    assert duration_s == expected
    motion_s = state.progress[-1].motion_s
    assert motion_s == 4.0 * BLOCK_S * len(FIRST_BLOCKS)
    fitted_s = state.progress[-1].fitted_s
    assert fitted_s == 4.0 * BLOCK_S * (len(FIRST_BLOCKS) - 1)
    # Both doublings are of the first block; the later ones are asked for with the new length.
    said = _said(rig)
    assert [(one["asked_s"], one["duration_s"]) for one in said] == [(6.0, 12.0), (12.0, 24.0)]
    sentence = SENTENCES["longer blocks"].format_map(said[0])
    assert sentence == (
        "6 s of moves are too short: found room for 4 moves; expected at least 5. The moves take "
        "12 s instead."
    )


def test_a_session_that_goes_on_keeps_the_length_of_its_blocks(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    needed_s = 2.0 * BLOCK_S
    rig = _rig(folder, made_session, needed_s)

    def stop_before(payload: str | None) -> None:
        if rig.session.state.runs:
            raise KeyboardInterrupt

    operator = given_answers(rig, put=stop_before)
    with pytest.raises(KeyboardInterrupt):
        run_session(rig, operator)
    assert len(_state(rig).runs) == 1
    rig.clock.go_on(minutes=5)
    ended = run_session(rig)
    assert ended.outcome is Outcome.APPLIED
    blocks = _state(rig).blocks
    duration_s = [block.duration_s for block in blocks]
    expected = [2.0 * BLOCK_S] * len(FIRST_BLOCKS)
    assert duration_s == expected
    assert len(_said(rig)) == 1


def test_the_time_limit_counts_the_longer_blocks(tmp_path: Path, made_session: MadeSession) -> None:
    folder = tmp_path / "cell"
    needed_s = 2.0 * BLOCK_S
    rig = _rig(folder, made_session, needed_s)
    time_limit_min = 6.0 * BLOCK_S / 60.0
    run_session(rig, target_percent=0.1, time_limit_min=time_limit_min)
    blocks = _state(rig).blocks
    assert len(blocks) == len(FIRST_BLOCKS)
    assert _state(rig).missing


def test_blocks_are_at_most_eight_times_as_long(tmp_path: Path, made_session: MadeSession) -> None:
    folder = tmp_path / "cell"
    needed_s = 9.0 * BLOCK_S
    rig = _rig(folder, made_session, needed_s)
    with pytest.raises(PlanTooShort, match="room for 4 moves"):
        run_session(rig)
    duration_s = [one["duration_s"] for one in _said(rig)]
    assert duration_s == [12.0, 24.0, 48.0]
    assert not rig.session.state.runs


def test_a_rehearsal_finds_the_length_of_the_blocks(
    tmp_path: Path, made_session: MadeSession
) -> None:
    folder = tmp_path / "cell"
    needed_s = 2.0 * BLOCK_S
    rig = _rig(folder, made_session, needed_s)
    record = rig.tools.record

    def slowly(request: RecordingRequest, **further: Any) -> Recorded:
        if request.out.stem != "warm-up":
            recorded: Recorded = record(request, **further)
            return recorded
        request.out.touch()
        return made_session.recorded["block-1-bare"]

    rig.tools = replace(rig.tools, record=slowly)
    ended = run_session(rig, rehearse=True)
    assert ended.outcome is Outcome.APPLIED
    block_s = _state(rig).block_s
    assert block_s == 2.0 * BLOCK_S
    assert len(_said(rig)) == 1
