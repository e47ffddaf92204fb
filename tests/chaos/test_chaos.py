"""The drawing of the faults and the judgement of a round, on outcomes that are made up;
this part needs no CAN.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import chain, islice

import pytest

from tests.chaos.faults import CYCLES, KINDS, SETUP_OBJECTS, Act, Fault, Inside, rounds
from tests.chaos.judge import ALLOWANCE_S, STOPS, Round, judge_code, judge_end, judge_stop
from tests.vcan.judgement import FEEDBACK, SYNC, TPDO1
from tests.vcan.listener import Frame

MOVED_NS = 1_000_000_000
STRUCK_NS = 2_000_000_000
CYCLE_NS = 20_000_000
ENABLED = 0x0627
DISABLED = 0x0250


def fault(
    kind: Act | Inside, for_s: float = 0.2, cycles: int | None = 40, times: int = 10
) -> Fault:
    """A fault in motion; one of the cell begins when an act would strike."""
    at_cycle = (STRUCK_NS - MOVED_NS) // CYCLE_NS
    return Fault(
        kind,
        True,
        1.0,
        for_s,
        node=3,
        times=times,
        gap_s=0.0,
        value=1,
        at_cycle=at_cycle,
        cycles=cycles,
    )


def outcome(made: Fault, enabled_s: float, code: int = 5) -> Round:
    """A round in which axis 5 answers that it is enabled for so long after a fault,
    and then that it is not.
    """
    end_ns = STRUCK_NS + round(enabled_s * 1e9)
    frames = []
    for time_ns in range(MOVED_NS, STRUCK_NS + 8_000_000_000, CYCLE_NS):
        frames.append(Frame(time_ns, SYNC, b""))
        frames.append(
            Frame(
                time_ns, TPDO1 + 5, FEEDBACK.pack(7, 0, ENABLED if time_ns <= end_ns else DISABLED)
            )
        )
    struck = [(made, STRUCK_NS)] if isinstance(made.kind, Act) else []
    return Round((made,), struck=struck, moved_ns=MOVED_NS - 1, frames=frames, code=code)


def test_a_seed_gives_the_same_rounds_and_every_kind_comes_once_in_a_turn() -> None:
    some = list(chain.from_iterable(islice(rounds(1), 200)))
    assert some == list(chain.from_iterable(islice(rounds(1), 200)))
    kinds = KINDS
    for begin in range(0, len(some) - len(kinds), len(kinds)):
        assert {one.kind for one in some[begin : begin + len(kinds)]} == set(kinds)
    assert {one.at_cycle for one in some} <= set(CYCLES)
    assert next(rounds(1)) != next(rounds(2))


@pytest.mark.parametrize("kind", STOPS, ids=lambda kind: kind.name)
def test_an_axis_that_is_enabled_beyond_the_bound_is_found(kind: Act | Inside) -> None:
    made = fault(kind)
    bound_s = STOPS[kind].bound_s + (made.for_s if STOPS[kind].lasts else 0.0) + ALLOWANCE_S
    for enabled_s, expected in ((bound_s - 0.05, 0), (bound_s + 0.05, 1)):
        judged = outcome(made, enabled_s)
        judge_stop(judged)
        assert len(judged.violations) == expected, judged.violations


@pytest.mark.parametrize("kind", STOPS, ids=lambda kind: kind.name)
@pytest.mark.parametrize("code", [0, 4])
def test_a_recording_that_came_to_its_end_after_a_fault_that_must_stop_it_is_found(
    kind: Act | Inside, code: int
) -> None:
    judged = outcome(fault(kind), 0.01, code)
    judge_end(judged)
    judge_code(judged)
    assert [line[:27] for line in judged.violations] == [
        f"(e) exit code {code} after {judged.faults[0].name}"[:27]
    ]
    before = outcome(fault(kind), 0.01, code)
    before.moved_ns = STRUCK_NS + 1
    judge_end(before)
    judge_code(before)
    assert not [line for line in before.violations if before.faults[0].name in line]


@pytest.mark.parametrize(
    ("made", "demanded"),
    [
        (fault(Inside.LOST, cycles=2), False),
        (fault(Inside.LOST, cycles=6), True),
        (fault(Inside.EMERGENCY, cycles=None), True),
        (fault(Inside.DUPLICATE, cycles=50), False),
        (fault(Act.CELL_PAUSE, for_s=0.1), False),
        (fault(Act.CELL_PAUSE, for_s=0.2), True),
        (fault(Act.TWIN), False),
        (fault(Act.SYNC, times=5), False),
        (fault(Act.SYNC, times=6), True),
    ],
)
def test_a_stop_is_demanded_where_the_fault_lasts_long_enough(made: Fault, demanded: bool) -> None:
    assert bool(outcome(made, 0.01).stopping) is demanded


@pytest.mark.parametrize(("other", "excused"), [(Act.CAPTURE_HANG, True), (Act.NOISE, False)])
def test_a_stopped_process_delays_the_stop_of_another_fault_but_not_its_own(
    other: Act, excused: bool
) -> None:
    late_s = STOPS[Act.EMCY].bound_s + ALLOWANCE_S + 0.5
    judged = outcome(fault(Act.EMCY), late_s)
    judged.struck.append((fault(other), STRUCK_NS))
    judge_stop(judged)
    assert (judged.violations == []) is excused


def test_the_repeated_answers_of_an_axis_are_no_power() -> None:
    judged = outcome(fault(Inside.STALE), 0.03)
    judged.frames.append(Frame(STRUCK_NS + 3_000_000_000, TPDO1 + 3, FEEDBACK.pack(8, 0, ENABLED)))
    judge_stop(judged)
    assert judged.violations == []
    assert judged.late_s["cell: stale"] < 0.0


def test_a_sync_after_the_end_of_the_recorder_makes_no_fault_of_the_cell() -> None:
    judged = outcome(fault(Inside.LOST), 0.01)
    assert judged.kinds == {Inside.LOST}
    judged.ended_ns = STRUCK_NS
    assert judged.kinds == set()


def test_the_answers_of_a_second_node_are_not_the_axis() -> None:
    judged = outcome(fault(Act.EMCY), 0.01)
    twin = FEEDBACK.pack(8, 0, ENABLED)
    judged.frames.append(Frame(STRUCK_NS + 3_000_000_000, TPDO1 + 3, twin))
    judged.twins.add(twin)
    judge_stop(judged)
    assert judged.violations == []


LEFT = "settings of J1 (node 1) not restored; switch these drives off"
GAVE_UP = (
    "settings not restored (asked a second time): J1: TPDO1, 1016h; J2: 1017h; switch these "
    "drives off"
)


def changed(kind: Act | Inside = Act.EMCY, **fields: object) -> Callable[[], Round]:
    def make() -> Round:
        made = outcome(fault(kind), 0.01)
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
        (changed(Act.NMT, unrestored=[1]), ""),
        (changed(unrestored=[1], said=LEFT), "(d) nodes [1] were left"),
        (changed(Act.LINK_DOWN, unrestored=[1], said=LEFT), ""),
        (changed(Inside.SILENT, unrestored=[1, 2], said=GAVE_UP), ""),
        (
            changed(Act.LINK_DOWN, unrestored=[1, 3], said=GAVE_UP),
            "(d) nodes [3] have other settings",
        ),
        (changed(Act.DISK_FULL, code=1), ""),
        (changed(silent=[1]), "(d) nodes [1] do not answer"),
        (changed(scanned=(5, "no")), "(d) scan ended with 5"),
        (changed(scanned=(5, "a SYNC (080h) that we did not send")), "(d) scan ended with 5"),
        (changed(Inside.SECOND_MASTER, scanned=(5, "no answer")), "(d) scan ended with 5"),
        (changed(Inside.SECOND_MASTER, scanned=(5, "a SYNC (080h) that we did not send")), ""),
        (changed(Inside.SDO_MASTER, scanned=(5, "an SDO request that we did not send")), ""),
    ],
)
def test_each_condition_on_the_end_is_judged(made: Callable[[], Round], expected: str) -> None:
    judged = made()
    judge_end(judged)
    judge_code(judged)
    assert [line[: len(expected)] for line in judged.violations] == ([expected] if expected else [])


REFUSED_UNGUARDED = "axes that are UNGUARDED: J1: no 1016h; pass --unguarded to move J1"


@pytest.mark.parametrize(
    ("aborted", "said", "expected"),
    [
        ((0x1016, 1), REFUSED_UNGUARDED, []),
        ((0x1016, 1), "motion is refused", ["(e) no message names J1"]),
        ((0x1A00, 1), REFUSED_UNGUARDED, ["(e) exit code 2, expected"]),
    ],
)
def test_an_axis_that_refuses_to_watch_the_recorder_moves_with_an_option_alone(
    aborted: tuple[int, int], said: str, expected: list[str]
) -> None:
    abort = replace(fault(Act.SDO_ABORT), node=1, value=SETUP_OBJECTS.index(aborted))
    judged = outcome(abort, 0.01)
    judged.code = 2
    judged.said = said
    judge_code(judged)
    found = [line for line in judged.violations if line.startswith("(e)")]
    assert [line[: len(start)] for line, start in zip(found, expected, strict=True)] == expected


def test_a_fault_that_came_after_the_end_excuses_nothing() -> None:
    judged = Round((fault(Act.RECORDER_KILL),), code=-9, frames=[Frame(1, SYNC, b"")])
    judge_end(judged)
    judge_code(judged)
    assert judged.injected == []
    assert [line[:16] for line in judged.violations] == ["(e) exit code -9"]
