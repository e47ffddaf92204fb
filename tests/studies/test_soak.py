"""The judge of the soak, on made-up recordings with a loss of each kind planted;
the watch on this machine; and what the soak does next.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import chain, product
from pathlib import Path

import numpy as np
import pytest

from tests.studies.soak import (
    NAMES,
    Row,
    append_row,
    highest_rate,
    next_rate,
    read_rows,
    summary,
)
from tests.studies.soak_judge import Cause, LossKind, Verdict, cause_of_end, judge_losses
from tests.vcan.host_watch import TICK_NS, Tick, watched, watching
from tests.vcan.listener import Frame
from tests.vcan.log_reader import Recorded
from tests.vcan.test_judgement import AXES, CYCLES, FIRST, NODES, PERIOD_NS, START_NS, made

ROOT = Path(__file__).parents[2]
WORK_NS = 20_000  #: Of the watch, in a tick
STRUCK = 12  #: Cycle of the planted loss


@dataclass
class Scene:
    """A recording, the frames of each cycle on the bus, and the ticks of a quiet machine."""

    log: Recorded
    bus: list[list[Frame]]
    ticks: list[Tick]

    by_clock: bool = False  #: whether the recorder sends SYNC by the clock, as on a hub

    def judged(self) -> Verdict:
        """The verdict on it."""
        frames = list(chain.from_iterable(self.bus))
        return judge_losses(self.log, frames, self.ticks, PERIOD_NS, NODES, in_order=self.by_clock)

    def mark_missing(self, cycle: int, axis: int) -> None:
        """Mark a value as missing in the log, which repeats the one before."""
        self.log.values[cycle, axis] = self.log.values[cycle - 1, axis]
        self.log.missing[cycle] |= 1 << axis

    def answer(self, cycle: int, axis: int) -> Frame:
        """Take the answer of an axis away from the bus."""
        return self.bus[FIRST + cycle].pop(1 + axis)

    def leave_out(self, cycle: int) -> None:
        """Remove the sample of a cycle from the log."""
        kept = self.log.cycle != cycle
        self.log = replace(
            self.log,
            cycle=self.log.cycle[kept],
            time_ns=self.log.time_ns[kept],
            values=self.log.values[kept],
            missing=self.log.missing[kept],
        )

    def sync_ns(self, cycle: int) -> int:
        """Time of a SYNC."""
        return self.bus[FIRST + cycle][0].time_ns

    def take(self, cycle: int, **counts: int) -> None:
        """Let the machine take something in a cycle."""
        after_ns = self.sync_ns(cycle) + PERIOD_NS // 2
        number = next(at for at, tick in enumerate(self.ticks) if tick.time_ns >= after_ns)
        self.ticks[number] = self.ticks[number]._replace(**counts)


def scene() -> Scene:
    """A sound recording on a quiet machine."""
    log, bus = made()
    begin_ns = bus[0][0].time_ns - 10 * PERIOD_NS
    end_ns = bus[-1][0].time_ns + 10 * PERIOD_NS
    times_ns = range(begin_ns, end_ns, TICK_NS)
    ticks = [
        Tick(at_ns, TICK_NS, 0, WORK_NS, 0, 0, 0, cpu) for cpu, at_ns in product(range(2), times_ns)
    ]
    return Scene(replace(log, valid=False), bus, ticks)


def late_on_the_bus(made_scene: Scene) -> None:
    """The answer of an axis comes behind the next SYNC: the listener lacks the value, too."""
    answer = made_scene.answer(STRUCK, 1)
    following = made_scene.bus[FIRST + STRUCK + 1]
    following.insert(1, answer._replace(time_ns=following[0].time_ns + 1000))
    made_scene.mark_missing(STRUCK, 1)


def absent_from_the_bus(made_scene: Scene) -> None:
    """An axis does not answer."""
    made_scene.answer(STRUCK, 1)
    made_scene.mark_missing(STRUCK, 1)


def unread(made_scene: Scene) -> None:
    """The listener has the value, and the log has not."""
    made_scene.mark_missing(STRUCK, 1)


def unread_while_starved(made_scene: Scene) -> None:
    """As before, while the programs wait for a processor."""
    made_scene.mark_missing(STRUCK, 1)
    made_scene.take(STRUCK, waited_ns=PERIOD_NS)


def unread_while_stolen(made_scene: Scene) -> None:
    """As before, while the hypervisor has the processor."""
    made_scene.mark_missing(STRUCK, 1)
    made_scene.take(STRUCK, stolen_ns=PERIOD_NS)


def unread_while_slow(made_scene: Scene) -> None:
    """As before, while one processor runs at a tenth of its speed, and no counter shows it."""
    made_scene.mark_missing(STRUCK, 1)
    begin_ns = made_scene.sync_ns(STRUCK)
    for number, tick in enumerate(made_scene.ticks):
        if tick.cpu == 1 and begin_ns <= tick.time_ns < begin_ns + PERIOD_NS:
            made_scene.ticks[number] = tick._replace(work_ns=10 * WORK_NS)


def unread_while_sleeper_is_late(made_scene: Scene) -> None:
    """As before, while even the highest priority does not wake."""
    made_scene.mark_missing(STRUCK, 1)
    made_scene.take(STRUCK, since_ns=PERIOD_NS, late_ns=PERIOD_NS - TICK_NS)


def late_by_the_stamps(made_scene: Scene) -> None:
    """On a hub SYNC is late, and an answer comes before it, but after it was due."""
    made_scene.by_clock = True
    following = made_scene.bus[FIRST + STRUCK + 1]
    late_ns = PERIOD_NS // 3
    moved = [frame._replace(time_ns=frame.time_ns + late_ns) for frame in following]
    made_scene.bus[FIRST + STRUCK + 1] = moved
    own = made_scene.bus[FIRST + STRUCK]
    own[2] = own[2]._replace(time_ns=moved[0].time_ns - 1000)
    made_scene.mark_missing(STRUCK, 1)


def unread_with_full_queue(made_scene: Scene) -> None:
    """As before, while the kernel drops packets."""
    made_scene.mark_missing(STRUCK, 1)
    made_scene.take(STRUCK, dropped=3)


def unread_with_short_wait(made_scene: Scene) -> None:
    """The programs wait for less than half a period."""
    made_scene.mark_missing(STRUCK, 1)
    made_scene.take(STRUCK, waited_ns=PERIOD_NS // 3)


def unread_with_early_wait(made_scene: Scene) -> None:
    """The programs waited, but some periods before."""
    made_scene.mark_missing(STRUCK, 1)
    made_scene.take(STRUCK - 5, waited_ns=PERIOD_NS)


def no_sync(made_scene: Scene) -> None:
    """A period without SYNC, counted by the log, on a quiet machine: its sender was late."""
    del made_scene.bus[FIRST + STRUCK]
    made_scene.leave_out(STRUCK)


def no_sync_while_starved(made_scene: Scene) -> None:
    """As before, while its sender waits for a processor."""
    made_scene.take(STRUCK, waited_ns=PERIOD_NS)
    no_sync(made_scene)


def no_sync_behind_a_late_one(made_scene: Scene) -> None:
    """A SYNC comes at the end of a wait, and the next one, due in the wait, is left out.

    The wait is over before the frames between which the SYNC is missing.
    """
    made_scene.take(STRUCK - 1, waited_ns=PERIOD_NS)
    no_sync_behind_one_sent_late(made_scene)


def no_sync_behind_one_sent_late(made_scene: Scene) -> None:
    """As before, but nothing was taken: the sender held both up itself."""
    late_ns = made_scene.sync_ns(STRUCK) + PERIOD_NS * 9 // 10
    before = made_scene.bus[FIRST + STRUCK - 1]
    made_scene.log.time_ns[STRUCK - 1] = START_NS + late_ns - made_scene.sync_ns(0)
    made_scene.bus[FIRST + STRUCK - 1] = [frame._replace(time_ns=late_ns) for frame in before]
    no_sync(made_scene)


def sync_too_late(made_scene: Scene) -> None:
    """SYNC comes just before the next one, so that no axis can answer in time."""
    late_ns = made_scene.sync_ns(STRUCK + 1) - PERIOD_NS // 10
    own = made_scene.bus[FIRST + STRUCK]
    own[0] = own[0]._replace(time_ns=late_ns)
    made_scene.log.time_ns[STRUCK] = START_NS + late_ns - made_scene.sync_ns(0)
    for axis in reversed(range(AXES)):
        made_scene.answer(STRUCK, axis)
        made_scene.mark_missing(STRUCK, axis)


def counted_but_on_the_bus(made_scene: Scene) -> None:
    """The log counts a period without SYNC, and the bus had it."""
    made_scene.leave_out(STRUCK)


def uncounted(made_scene: Scene) -> None:
    """A sample is left out, and the log does not say so."""
    made_scene.leave_out(STRUCK)
    made_scene.log = replace(made_scene.log, cycle=np.arange(CYCLES - 1))


def doubtful(made_scene: Scene) -> None:
    """Behind an answer that is absent from the bus, the next one is in doubt."""
    absent_from_the_bus(made_scene)
    made_scene.mark_missing(STRUCK + 1, 1)


def doubtful_after_ours(made_scene: Scene) -> None:
    """The same behind a loss of ours."""
    unread(made_scene)
    made_scene.mark_missing(STRUCK + 1, 1)


def other_axis(made_scene: Scene) -> None:
    """Behind an absent answer of one axis, another one is marked: that is no doubt."""
    absent_from_the_bus(made_scene)
    made_scene.mark_missing(STRUCK + 1, 0)


PLANTED: tuple[tuple[Callable[[Scene], None], int, int, dict[LossKind, int]], ...] = (
    (late_on_the_bus, 0, 1, {LossKind.LATE: 1}),
    (absent_from_the_bus, 0, 1, {LossKind.LATE: 1}),
    (unread, 1, 0, {LossKind.UNREAD: 1}),
    (unread_while_starved, 0, 1, {LossKind.UNREAD: 1}),
    (unread_while_stolen, 0, 1, {LossKind.UNREAD: 1}),
    (unread_while_slow, 0, 1, {LossKind.UNREAD: 1}),
    (unread_while_sleeper_is_late, 0, 1, {LossKind.UNREAD: 1}),
    (late_by_the_stamps, 0, 1, {LossKind.LATE: 1}),
    (unread_with_full_queue, 0, 1, {LossKind.UNREAD: 1}),
    (unread_with_short_wait, 1, 0, {LossKind.UNREAD: 1}),
    (unread_with_early_wait, 1, 0, {LossKind.UNREAD: 1}),
    (no_sync, AXES, 0, {LossKind.NO_SYNC: AXES}),
    (no_sync_while_starved, 0, AXES, {LossKind.NO_SYNC: AXES}),
    (no_sync_behind_a_late_one, 0, AXES, {LossKind.NO_SYNC: AXES}),
    (no_sync_behind_one_sent_late, AXES, 0, {LossKind.NO_SYNC: AXES}),
    (sync_too_late, AXES, 0, {LossKind.LATE: AXES}),
    (counted_but_on_the_bus, AXES, 0, {LossKind.UNREAD: AXES}),
    (uncounted, AXES, 0, {LossKind.UNCOUNTED: AXES}),
    (doubtful, 0, 2, {LossKind.LATE: 1, LossKind.DOUBTFUL: 1}),
    (doubtful_after_ours, 2, 0, {LossKind.UNREAD: 1, LossKind.DOUBTFUL: 1}),
    (other_axis, 1, 1, {LossKind.LATE: 1, LossKind.UNREAD: 1}),
)


def test_a_sound_recording_has_no_loss() -> None:
    found = scene().judged()
    assert (found.values, found.losses, found.wrong) == (CYCLES * AXES, [], 0)
    assert found.frames == CYCLES * (1 + AXES)
    assert found.starved_share == 0.0


@pytest.mark.parametrize(
    ("plant", "ours", "hosts", "kinds"), PLANTED, ids=[plant.__name__ for plant, *_ in PLANTED]
)
def test_a_planted_loss_has_its_cause(
    plant: Callable[[Scene], None], ours: int, hosts: int, kinds: dict[LossKind, int]
) -> None:
    made_scene = scene()
    plant(made_scene)
    found = made_scene.judged()
    assert (found.lost(Cause.OURS), found.lost(Cause.HOST)) == (ours, hosts)
    assert dict(found.by_kind()) == kinds
    assert found.values == CYCLES * AXES - AXES * (plant is uncounted)


def test_each_kind_of_loss_is_planted() -> None:
    planted = set(chain.from_iterable(kinds for _, _, _, kinds in PLANTED))
    assert planted == set(LossKind)


def test_a_value_that_was_not_on_the_bus_is_a_wrong_one() -> None:
    made_scene = scene()
    made_scene.log.values[STRUCK, 1, 0] ^= 1
    assert made_scene.judged().wrong == 1


def test_a_wait_is_counted_where_it_was_not_where_it_ended() -> None:
    made_scene = scene()
    unread(made_scene)
    made_scene.take(STRUCK + 4, waited_ns=6 * PERIOD_NS)
    assert made_scene.judged().lost(Cause.HOST) == 1


def test_the_share_of_starved_periods_is_that_of_the_cycles_around_a_wait() -> None:
    made_scene = scene()
    made_scene.take(STRUCK, waited_ns=PERIOD_NS)
    # A sample looks at the period before its SYNC and the one after: a wait over two periods is
    # in the windows of at most four samples.
    assert 1 / CYCLES <= made_scene.judged().starved_share <= 4 / CYCLES


def test_an_early_end_is_the_hosts_where_it_took_time_or_the_last_losses_are_its_own() -> None:
    made_scene = scene()
    ended_ns = made_scene.sync_ns(CYCLES - 1)
    verdict = made_scene.judged()
    assert cause_of_end(verdict, made_scene.log, made_scene.ticks, ended_ns) is Cause.OURS
    assert cause_of_end(verdict, None, made_scene.ticks, ended_ns) is Cause.OURS
    starved = scene()
    starved.take(CYCLES - 4, waited_ns=400_000_000)
    assert cause_of_end(verdict, made_scene.log, starved.ticks, ended_ns) is Cause.HOST
    absent_from_the_bus(made_scene)
    assert cause_of_end(made_scene.judged(), made_scene.log, made_scene.ticks, ended_ns) is (
        Cause.OURS
    )
    near_end = scene()
    near_end.answer(CYCLES - 2, 1)
    near_end.mark_missing(CYCLES - 2, 1)
    verdict = near_end.judged()
    assert cause_of_end(verdict, near_end.log, near_end.ticks, ended_ns) is Cause.HOST


@pytest.mark.skipif(
    not Path("/proc/self/schedstat").exists(), reason="this kernel counts no waiting for processors"
)
def test_the_watch_counts_what_two_busy_programs_take_from_a_third(tmp_path: Path) -> None:
    busy = [sys.executable, "-c", "while True: pass"]
    with watching(tmp_path / "host") as watch:
        programs = [subprocess.Popen(["taskset", "-c", "0", *busy]) for _ in range(3)]
        try:
            watch.add("recorder", programs[0].pid)
            wait_for(tmp_path / "host", lambda ticks: sum(one.waited_ns for one in ticks) > 10**8)
        finally:
            for program in programs:
                program.kill()
                program.wait()
    ticks = watched(tmp_path / "host")
    assert all(one.since_ns > 0 for one in ticks)
    assert [(one.cpu, one.time_ns) for one in ticks] == sorted(
        (one.cpu, one.time_ns) for one in ticks
    )
    assert {one.cpu for one in ticks} == os.sched_getaffinity(0)
    assert all(one.work_ns > 0 for one in ticks)
    assert sum(one.ran_ns for one in ticks) > 10**7
    assert all(one.ran_ns <= 1.1 * one.since_ns + 10**7 for one in ticks)


def test_a_loss_of_ours_says_what_the_recorder_did() -> None:
    """Another loss needs no explanation."""
    made_scene = scene()
    made_scene.mark_missing(STRUCK, 1)
    made_scene.take(STRUCK, ran_ns=2_000_000, major_faults=3, disk_waits=1)
    (note,) = made_scene.judged().notes
    assert f"cycle {made_scene.log.cycle[STRUCK]}:" in note
    assert "ran 2.0 ms" in note
    assert "read 3 pages from a disk and waited for it at 1 ticks" in note
    made_scene.take(STRUCK, waited_ns=PERIOD_NS)
    assert made_scene.judged().notes == []


def wait_for(path: Path, done: Callable[[list[Tick]], bool]) -> None:
    """Wait until a watch's file shows something."""
    for _ in range(600):
        if done(watched(path)):
            return
        time.sleep(0.1)
    raise AssertionError("the watch shows nothing within a minute")


def test_the_judge_and_the_watch_import_nothing_of_the_product() -> None:
    code = (
        "import sys, tests.studies.soak_judge\n"
        "found = {name.partition('.')[0] for name in sys.modules} & {'daq', 'drivers', 'ident', "
        "'can', 'canopen'}\n"
        "sys.exit(', '.join(sorted(found)) or 0)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


def row(rate_hz: int, **changed: object) -> Row:
    """A row without losses."""
    values: dict[str, object] = dict.fromkeys(NAMES, 0)
    values |= {"begun": "2026-01-01T00:00:00+00:00", "bus": "hub", "screen": "pipe", "code": "0"}
    values["priority"] = "usual"
    values |= {"ended_by": "", "rate_hz": rate_hz, "seconds": 60.0}
    values |= {"starved_percent": 1.5, "load": 0.5, "processors": 2}
    return Row(**(values | changed))  # type: ignore[arg-type]


def test_each_rate_comes_once_and_then_the_highest_without_a_loss_of_ours() -> None:
    rates = (100, 25, 50)
    rows: list[Row] = []
    for rate_hz, losses in ((25, {}), (50, {"lost_by_host": 3}), (100, {"lost_by_us": 6})):
        assert next_rate(rows, rates) == rate_hz
        rows.append(row(rate_hz, **losses))
    assert next_rate(rows, rates) == 50
    assert (highest_rate(rows), highest_rate(rows, with_host=True)) == (50, 25)
    rows.append(row(50))
    assert next_rate(rows, rates) == 50
    rows.append(row(50, ended_by="ours"))
    assert next_rate(rows, rates) == 25
    rows.append(row(25, wrong=1))
    assert next_rate(rows, rates) == 25
    assert highest_rate(rows) is None


def test_a_rate_that_only_the_host_has_spoilt_is_tried_again_in_turn_with_the_best() -> None:
    rates = (25, 50, 100)
    rows = [row(25), row(50, ended_by="host"), row(100, ended_by="host")]
    assert highest_rate(rows) == 25
    assert next_rate(rows, rates) == 25
    rows.append(row(25))
    assert next_rate(rows, rates) == 50
    rows.append(row(50, lost_by_host=6))
    assert (highest_rate(rows), next_rate(rows, rates)) == (50, 100)
    rows.append(row(100, ended_by="host"))
    assert next_rate(rows, rates) == 50
    rows.append(row(50))
    assert next_rate(rows, rates) == 100


def test_rows_are_read_as_they_were_written(tmp_path: Path) -> None:
    path = tmp_path / "data" / "soak.csv"
    rows = [row(25), row(50, ended_by="host", lost_by_host=12, priority="realtime")]
    assert read_rows(path) == []
    for one in rows:
        append_row(path, one)
    assert read_rows(path) == rows
    lines = list(summary(rows))
    assert lines[-2] == "highest rate without a loss of ours: 25 Hz"
    assert lines[-1] == "highest rate without any loss: 25 Hz"
    assert lines[2].split() == ["50", "1", "1.0", "0", "0", "0", "12", "1", "1.5%"]
