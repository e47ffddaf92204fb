"""The drawing of the faults and the judgement of a round, on outcomes that are made up; this part needs no CAN."""

from __future__ import annotations

from collections.abc import Callable
from itertools import islice

import pytest

from tests.chaos.faults import CYCLES, INSIDE, Act, Fault, rounds
from tests.chaos.rounds import ALLOWANCE_S, BOUND_S, Round, judge_end, judge_stop
from tests.vcan.judgement import FEEDBACK, SYNC, TPDO1
from tests.vcan.listener import Frame

MOVED_NS, STRUCK_NS = 1_000_000_000, 2_000_000_000
ENABLED, DISABLED = 0x0627, 0x0250


def fault(kind: Act) -> Fault:
    return Fault(kind, in_motion=True, at_s=1.0, for_s=0.1, node=3, times=1, gap_s=0.0, value=1, at_cycle=1, cycles=1)


def outcome(act: Act, enabled_s: float, code: int = 5) -> Round:
    """A round in which axis 3 answers that it is enabled for so long after an act, and then that it is not."""
    end_ns = STRUCK_NS + round(enabled_s * 1e9)
    frames = [
        Frame(time_ns, TPDO1 + 3, FEEDBACK.pack(7, 0, ENABLED if time_ns <= end_ns else DISABLED))
        for time_ns in range(MOVED_NS, STRUCK_NS + 4_000_000_000, 20_000_000)
    ]
    return Round((fault(act),), struck=[(act, STRUCK_NS)], moved_ns=MOVED_NS, frames=frames, code=code)


def test_a_seed_gives_the_same_rounds_and_every_kind_comes_once_in_a_turn() -> None:
    some = [one for faults in islice(rounds(1), 200) for one in faults]
    assert some == [one for faults in islice(rounds(1), 200) for one in faults]
    kinds = [*Act, *INSIDE]
    for begin in range(0, len(some) - len(kinds), len(kinds)):
        assert {one.kind for one in some[begin : begin + len(kinds)]} == set(kinds)
    assert {one.at_cycle for one in some} <= set(CYCLES)
    assert next(rounds(1)) != next(rounds(2))


@pytest.mark.parametrize("act", BOUND_S)
def test_an_axis_that_is_enabled_beyond_the_bound_is_found(act: Act) -> None:
    late = 1.0 if act is Act.CAPTURE_HANG else 0.0
    for enabled_s, expected in (
        (BOUND_S[act] + ALLOWANCE_S + late - 0.05, 0),
        (BOUND_S[act] + ALLOWANCE_S + late + 0.05, 1),
    ):
        judged = outcome(act, enabled_s)
        judge_stop(judged)
        assert len(judged.violations) == expected, judged.violations


def test_the_answers_of_a_second_node_are_not_the_axis() -> None:
    judged = outcome(Act.EMCY, 0.01)
    twin = FEEDBACK.pack(8, 0, ENABLED)
    judged.frames.append(Frame(STRUCK_NS + 3_000_000_000, TPDO1 + 3, twin))
    judged.twins.add(twin)
    judge_stop(judged)
    assert judged.violations == []


def changed(**fields: object) -> Callable[[], Round]:
    def make() -> Round:
        made = outcome(Act.EMCY, 0.01)
        for name, value in fields.items():
            setattr(made, name, value)
        return made

    return make


@pytest.mark.parametrize(
    ("made", "expected"),
    [
        (changed(), ""),
        (changed(code=1), "(e) exit code 1"),
        (changed(code=130), "(e) exit code 130"),
        (changed(code=None), "(e) exit code None"),
        (changed(said="Traceback (most recent call last)"), "(e) record shows a traceback"),
        (changed(cell_said="Traceback (most recent call last)"), "(e) the cell shows a traceback"),
        (changed(cell=False), "the simulated cell ended by itself"),
        (changed(enabled=[2]), "(c) after its end nodes [2] are enabled"),
        (changed(powered=[4]), "(c) after its end nodes [] are enabled, nodes [4] have power"),
        (changed(unrestored=[1]), "(d) nodes [1] have other settings"),
        (changed(unrestored=[1], said="settings not restored (node 1)"), ""),
        (changed(silent=[1]), "(d) nodes [1] do not answer"),
        (changed(scanned=(5, "no")), "(d) scan ended with 5"),
    ],
)
def test_each_condition_on_the_end_is_judged(made: Callable[[], Round], expected: str) -> None:
    judged = made()
    judge_end(judged)
    assert [line[: len(expected)] for line in judged.violations] == ([expected] if expected else [])


def test_a_fault_that_came_after_the_end_excuses_nothing() -> None:
    judged = Round((fault(Act.RECORDER_KILL),), code=-9, frames=[Frame(1, SYNC, b"")])
    judge_end(judged)
    assert judged.injected == []
    assert [line[:16] for line in judged.violations] == ["(e) exit code -9"]
