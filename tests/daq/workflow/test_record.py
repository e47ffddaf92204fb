"""Recording against drives that live in a time of their own:
what the bus did must be in the log and in its verdict.
"""

from __future__ import annotations

import gc
import io
import json
import os
import resource
import sys
import threading
from collections.abc import Callable, Iterable
from math import radians
from pathlib import Path

import can
import numpy as np
import pytest

from daq.cli.app import main
from daq.config.cell import Cell
from daq.config.cell_file import bundle, load_cell
from daq.errors import ConfigurationInconsistent, ExitCode, OutputFailed, RunInvalid
from daq.log.conversion import load_run
from daq.log.queued_file import QueuedFile
from daq.log.reader import read_log
from daq.log.salvage import salvage
from daq.workflow.on_time import NEVER, SWITCH_S, real_time_priority
from daq.workflow.plan import load_plan
from daq.workflow.record import LATE_LOSSES_S, Clocks, Recorded, RecordingRequest, record
from drivers.canopen.network import CanopenNetwork, SignalBlocker
from drivers.canopen.socketcan import Losses
from drivers.errors import MotionRefused, NodeMisplaced, SampleLost
from drivers.messages import EventKind
from tests.daq.log.disks import Disk, refuse
from tests.drivers.scripted import PERIOD_NS, ScriptedBus, cell

SECOND_NS = 10**9
DAY_NS = 86_400 * SECOND_NS
WALL_NS = 1_700_000_000_000_000_000
ELBOW = 3
ELBOW_COUNTS = round(radians(60) * 45 / (2 * 3.141592653589793) * 65536)
PLAN = """format: drivegain-plan
cell: demo
seed: 1
condition: 100.0
moves:
  - {target_deg: [5, -5, 70, 5, -5, 5], velocity: 0.5, acceleration: 0.5, dwell_s: 0.01}
  - {target_deg: [0, 0, 60, 0, 0, 0], velocity: 0.5, acceleration: 0.5, dwell_s: 0.01}
"""


class Rig:
    """Six scripted drives in the place of the demo cell's, the elbow at 60 deg."""

    def __init__(
        self, checkout: Path, folder: Path, patch: pytest.MonkeyPatch, pacing: str
    ) -> None:
        configs = checkout / "configs"
        text = (
            (configs / "cells/demo.yaml").read_text().replace("../robots", str(configs / "robots"))
        )
        self.cell_file = folder / "cell.yaml"
        changed_text = text.replace("pacing: lockstep", f"pacing: {pacing}")
        self.cell_file.write_text(changed_text)
        self.plan = folder / "plan.yaml"
        self.plan.write_text(PLAN)
        self.out = folder / "a.mcap"
        self.network, self.bus = cell(6)
        self.bus.nodes[ELBOW - 1].position = ELBOW_COUNTS

        def network_of(_cell: Cell, _undisturbed: SignalBlocker) -> CanopenNetwork:
            return self.network

        patch.setattr("daq.workflow.record.network_of", network_of)

    def run(
        self,
        clocks: Clocks | None = None,
        *,
        unguarded: bool = True,
        granted_by: str | None = "the test",
        require_released: Callable[[], None] | None = None,
    ) -> Recorded:
        """Record the plan."""
        declared = load_cell(self.cell_file)
        clocks = clocks or Clocks(lambda: WALL_NS, self.bus.clock)
        moves = load_plan(self.plan, declared)
        request = RecordingRequest(
            self.cell_file,
            declared,
            moves,
            self.out,
            payload=None,
            operator="Ada",
            granted_by=granted_by,
            run_id="1",
            unguarded=unguarded,  # the scripted drives have no 1016h
        )
        return record(request, clocks=clocks, require_released=require_released)

    def profiles(self) -> list[bytes]:
        """Commands to the elbow that set velocity and acceleration."""
        cob_id = 0x300 + ELBOW
        return [bytes(frame.data) for frame in self.bus.sent if frame.arbitration_id == cob_id]


@pytest.fixture
def lockstep(checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Rig:
    return Rig(checkout, tmp_path, monkeypatch, "lockstep")


@pytest.fixture
def timed(checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Rig:
    return Rig(checkout, tmp_path, monkeypatch, "timed")


def silent_at_first(bus: ScriptedBus, cycles: int) -> None:
    """Let the elbow's first answers be lost."""
    first: list[int] = []

    def tamper(message: can.Message) -> Iterable[can.Message]:
        if message.arbitration_id != 0x180 + ELBOW or len(first) == cycles:
            return (message,)
        first.append(bus.cycle)
        return ()

    bus.tamper = tamper


def test_no_full_collection_delays_a_sync(timed: Rig) -> None:
    usual = gc.get_threshold()
    during = set()

    def tamper(message: can.Message) -> Iterable[can.Message]:
        during.add(gc.get_threshold()[2])
        return (message,)

    timed.bus.tamper = tamper
    timed.run()
    assert during == {NEVER}
    assert gc.get_threshold() == usual


@pytest.mark.slow
@pytest.mark.parametrize("pacing", ["lockstep", "timed"])
def test_a_sound_run_is_valid_and_starts_at_wall_time(
    pacing: str, checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = Rig(checkout, tmp_path, monkeypatch, pacing)
    done = rig.run()
    assert (done.log.valid, done.log.reason, done.log.lost_cycles) == (True, "", 0)
    time_ns = read_log(rig.out).samples.time_ns
    expected = [WALL_NS + PERIOD_NS * k for k in range(len(time_ns))]
    assert time_ns.tolist() == expected
    events = read_log(rig.out).events
    assert all(event.time_ns in time_ns for event in events)
    move = load_run(rig.out)[0].move
    assert move is not None


@pytest.mark.slow
def test_a_glitch_of_an_encoder_makes_the_run_invalid(lockstep: Rig) -> None:
    """One answer of the elbow, in the middle of the run, has a position that is 0.9 rad away."""
    sound = lockstep.run()
    assert (sound.log.valid, sound.log.reason) == (True, "")
    middle = lockstep.bus.cycle // 2
    lockstep.out.unlink()
    begun = lockstep.bus.cycle
    wrong: list[int] = []

    def tamper(message: can.Message) -> Iterable[can.Message]:
        if message.arbitration_id == 0x180 + ELBOW and lockstep.bus.cycle == begun + middle:
            position = int.from_bytes(message.data[:4], "little", signed=True)
            position_difference = abs(position - ELBOW_COUNTS)
            assert position_difference < ELBOW_COUNTS // 4
            wrong.append(position)
            glitch = position + round(0.9 * 45 / (2 * 3.141592653589793) * 65536)
            message.data[:4] = glitch.to_bytes(4, "little", signed=True)
        return (message,)

    lockstep.bus.tamper = tamper
    done = lockstep.run()
    assert len(wrong) == 1
    assert not done.log.valid
    assert done.log.reason.startswith("axis J3: a step of 51.")
    with pytest.raises(RunInvalid, match="axis J3: a step of 51"):
        load_run(lockstep.out)


def test_what_is_done_before_the_first_sample_costs_no_period(
    timed: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def slow_bundle(cell_file: Path) -> dict[str, bytes]:
        timed.bus.clock.now_ns += 30_000_000
        return bundle(cell_file)

    monkeypatch.setattr("daq.workflow.record.bundle", slow_bundle)
    done = timed.run()
    assert (done.log.valid, done.log.reason) == (True, "")
    samples = read_log(timed.out).samples
    time_steps_ns = np.diff(samples.time_ns)
    assert set(time_steps_ns) == {PERIOD_NS}


def test_a_cell_file_that_was_changed_since_it_was_read_is_refused_before_anything_moves(
    lockstep: Rig,
) -> None:
    """Somebody saves it while the operator is at the prompt: a comment makes another digest."""

    def edit_at_first() -> None:
        content = lockstep.cell_file.read_text()
        lockstep.cell_file.write_text(content + "# J3 was slower\n")

    with pytest.raises(
        ConfigurationInconsistent, match=r"another content .* than when this command read it"
    ):
        lockstep.run(require_released=edit_at_first)
    assert not lockstep.out.exists()
    assert lockstep.profiles() == []


@pytest.mark.slow
def test_moves_are_planned_from_where_the_axes_are_known_to_be(
    lockstep: Rig, checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    silent_at_first(lockstep.bus, 2)
    done = lockstep.run()
    samples = read_log(lockstep.out).samples
    # They were lost before the recording began.
    assert not samples.missing.any()
    assert samples.position_counts[0, ELBOW - 1] == ELBOW_COUNTS
    assert (done.log.valid, done.log.reason) == (True, "")
    (tmp_path / "sound").mkdir()
    folder = tmp_path / "sound"
    sound = Rig(checkout, folder, monkeypatch, "lockstep")
    sound.run()
    assert lockstep.profiles() == sound.profiles() != []


def test_axes_that_would_go_on_when_the_recorder_is_killed_do_not_move_unasked(
    lockstep: Rig,
) -> None:
    with pytest.raises(
        MotionRefused,
        match=r"UNGUARDED: J1: no 1016h.*pass --unguarded to move "
        r"J1, J2, .*emergency",
    ):
        lockstep.run(unguarded=False)
    assert not lockstep.out.exists()
    assert not any(node.powered_cycles for node in lockstep.bus.nodes)


def test_an_axis_that_never_answers_is_not_waited_for_for_ever(lockstep: Rig) -> None:
    silent_at_first(lockstep.bus, 1000)
    with pytest.raises(SampleLost, match=f"no answer from J{ELBOW}"):
        lockstep.run()
    assert not lockstep.out.exists()
    assert not any(node.powered_cycles for node in lockstep.bus.nodes)


def test_a_schedule_that_slipped_is_refused(timed: Rig) -> None:
    def busy(cycle: int) -> None:
        if cycle == 150:
            timed.bus.clock.now_ns += 3 * PERIOD_NS

    timed.bus.on_cycle = busy
    done = timed.run()
    skipped = done.stream.skipped_periods
    assert skipped >= 2
    assert (done.log.valid, done.log.lost_cycles) == (False, skipped)
    assert f"{skipped} periods without SYNC" in done.log.reason
    with pytest.raises(RunInvalid, match="periods without SYNC"):
        load_run(timed.out)


@pytest.mark.parametrize(
    ("twice", "says"), [(0x182, "1 answers twice"), (0x482, "no axis was configured to send")]
)
def test_what_the_stream_cannot_explain_makes_a_run_invalid(
    lockstep: Rig, twice: int, says: str
) -> None:
    sent: list[int] = []

    def tamper(message: can.Message) -> Iterable[can.Message]:
        if message.arbitration_id != 0x182 or lockstep.bus.cycle < 150 or sent:
            return (message,)
        sent.append(lockstep.bus.cycle)
        return (message, can.Message(arbitration_id=twice, is_extended_id=False, data=message.data))

    lockstep.bus.tamper = tamper
    done = lockstep.run()
    assert not done.log.valid
    assert says in done.log.reason


def test_another_node_on_the_bus_does_no_harm(lockstep: Rig) -> None:
    lockstep.bus.on_cycle = lambda cycle: lockstep.bus.inject(
        can.Message(arbitration_id=0x1C0, is_extended_id=False, data=bytes(8))
    )
    done = lockstep.run()
    assert done.stream.foreign > 100
    assert (done.log.valid, done.log.reason) == (True, "")


@pytest.mark.slow
@pytest.mark.parametrize(
    "step_ns", [0, 3 * SECOND_NS, 3 * DAY_NS, -3 * DAY_NS, 730 * DAY_NS, -730 * DAY_NS]
)
def test_a_wall_clock_that_was_set_meanwhile_shows_and_moves_no_stamp(
    lockstep: Rig, step_ns: int, capsys: pytest.CaptureFixture[str]
) -> None:
    wall = {"ns": WALL_NS}

    def set_clock(cycle: int) -> None:
        if cycle == 150:
            wall["ns"] += step_ns

    lockstep.bus.on_cycle = set_clock
    clocks = Clocks(lambda: wall["ns"] + lockstep.bus.clock(), lockstep.bus.clock)
    lockstep.run(clocks)
    log = read_log(lockstep.out)
    assert log.statistics.wall_minus_monotonic_ns == WALL_NS + step_ns
    assert log.head.run.wall_minus_monotonic_ns == WALL_NS
    time_steps_ns = np.diff(log.samples.time_ns)
    assert set(time_steps_ns) == {PERIOD_NS}
    assert main(["info", str(lockstep.out), "--json"]) == ExitCode.OK
    document = json.loads(capsys.readouterr().out)
    assert document["wall_clock_step_s"] == step_ns * 1e-9


def test_what_is_reported_after_the_last_sample_counts_too(
    lockstep: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The interface's own counters are read five times a second,
    so they may report losses after the last cycle.
    """
    bus = lockstep.bus
    recv = lockstep.bus.recv
    ended_ns: list[int] = []

    def late(timeout: float | None = None) -> can.Message | None:
        if timeout == pytest.approx(LATE_LOSSES_S) and not ended_ns:
            ended_ns.append(bus.clock.now_ns)
        if ended_ns and bus.clock.now_ns - ended_ns[0] > 200_000_000:
            bus.losses = Losses(interface=2)
        return recv(timeout)

    monkeypatch.setattr(bus, "recv", late)
    done = lockstep.run()
    assert (done.log.valid, done.log.reason) == (False, "2 frames dropped by the interface")
    events = read_log(lockstep.out).events
    assert any(event.kind is EventKind.FRAMES_DROPPED for event in events)


@pytest.mark.parametrize(
    "error", [KeyboardInterrupt, NodeMisplaced(1, "A", "B")], ids=["Ctrl-C", "misplaced"]
)
def test_a_recording_that_ended_early_is_not_salvaged_as_a_valid_one(
    lockstep: Rig, error: BaseException, tmp_path: Path
) -> None:
    def end(cycle: int) -> None:
        if cycle == 150:
            raise error

    lockstep.bus.on_cycle = end
    with pytest.raises((KeyboardInterrupt, NodeMisplaced)):
        lockstep.run()
    damaged = lockstep.out.with_name("a.mcap.part")
    saved = salvage(damaged, tmp_path / "saved.mcap")
    assert not saved.statistics.valid
    assert "ended (" in saved.statistics.reason


def test_an_answer_that_comes_twice_to_the_last_sync_of_all_is_counted(lockstep: Rig) -> None:
    """Behind it SDO answers are looked for on the same bus: the amplifiers end watching us."""
    for node in lockstep.bus.nodes:
        node.objects[0x1016, 0], node.objects[0x1016, 1], node.objects[0x6007, 0] = (
            (1, 1),
            (0, 4),
            (1, 2),
        )

    doubled: list[int] = []

    def tamper(message: can.Message) -> Iterable[can.Message]:
        nodes = lockstep.bus.nodes
        stopped = all(node.statusword & 0x6F == 0x40 and node.powered_cycles for node in nodes)
        if message.arbitration_id != 0x186 or not stopped:
            return (message,)
        doubled.append(lockstep.bus.cycle)
        return (message, message)

    lockstep.bus.tamper = tamper
    done = lockstep.run()
    assert doubled[-1] == lockstep.bus.cycle
    expected = (False, f"{len(doubled)} answers twice")
    assert (done.log.valid, done.log.reason) == expected


def test_axes_that_are_stopped_by_sdo_leave_no_doubt_about_the_samples(
    timed: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That takes SYNCs too, whose answers belong to no sample."""
    network = timed.network
    bus = timed.bus
    unguard = network.unguard

    def late_answers() -> None:
        unguard()
        for node in bus.nodes:
            for answer in node.on_sync(bus.cycle):
                bus.inject(answer)

    monkeypatch.setattr(network, "unguard", late_answers)
    done = timed.run()
    assert (done.log.valid, done.log.reason) == (True, "")


def test_another_master_that_reads_meanwhile_is_named_at_the_end(lockstep: Rig) -> None:
    reading = can.Message(
        arbitration_id=0x602, is_extended_id=False, data=bytes((0x40, 0x41, 0x60, *bytes(5)))
    )
    lockstep.bus.on_cycle = lambda cycle: lockstep.bus.inject(reading) if cycle == 200 else None
    done = lockstep.run()
    assert done.log.valid
    texts = [text for text in done.warnings if "another master" in text]
    assert texts == [
        "another master was on the bus: an SDO request to J2 (node 2) (602h); it only read, but "
        "end that program before the next run"
    ]


def test_threads_switch_soon_while_a_recording_runs(lockstep: Rig) -> None:
    before_s = sys.getswitchinterval()
    found_s = []
    lockstep.bus.on_cycle = lambda _cycle: found_s.append(sys.getswitchinterval())
    lockstep.run()
    assert max(found_s) == pytest.approx(SWITCH_S)
    assert before_s > SWITCH_S
    assert sys.getswitchinterval() == before_s


def _policy() -> int:
    return os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK


@pytest.fixture
def priority_is_permitted() -> None:
    """Skip where this user may have no real-time priority."""
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    except PermissionError:
        pytest.skip("this user may have no real-time priority (CAP_SYS_NICE, or a limit rtprio)")
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@pytest.mark.usefixtures("priority_is_permitted")
def test_a_recording_has_real_time_priority_and_gives_it_to_no_thread(lockstep: Rig) -> None:
    found: set[int] = set()
    inherited: set[int] = set()

    def look(_cycle: int) -> None:
        found.add(_policy())
        if not inherited:
            started = threading.Thread(target=lambda: inherited.add(_policy()))
            started.start()
            started.join()

    lockstep.bus.on_cycle = look
    lockstep.run()
    assert found == {os.SCHED_RR}
    assert inherited == {os.SCHED_OTHER}
    assert _policy() == os.SCHED_OTHER


@pytest.mark.usefixtures("priority_is_permitted")
def test_the_second_block_of_a_session_has_real_time_priority_too() -> None:
    policies = []
    for _ in range(2):
        with real_time_priority():
            policies.append(_policy())
    assert policies == [os.SCHED_RR, os.SCHED_RR]


def _kept_kib() -> int:
    """Memory of this process that the kernel may not take away [KiB]."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    (line,) = [line for line in status.splitlines() if line.startswith("VmLck")]
    return int(line.split()[1])


def test_memory_of_a_recorder_stays_while_it_records(lockstep: Rig) -> None:
    soft_limit, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if os.geteuid() != 0 and soft_limit != resource.RLIM_INFINITY:
        pytest.skip("this user may not keep memory (CAP_IPC_LOCK, or a limit memlock)")
    before_kib = _kept_kib()
    found_kib = []
    lockstep.bus.on_cycle = lambda _cycle: found_kib.append(_kept_kib())
    lockstep.run()
    assert min(found_kib) > before_kib + 10_000
    assert _kept_kib() == before_kib


def test_a_disk_that_takes_nothing_for_200_cycles_costs_none_of_them(
    lockstep: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A recorder that waited for this disk would wait for itself."""
    now_s = 0.0
    is_over = threading.Event()

    def count(cycle: int) -> None:
        if cycle == 200:
            is_over.set()

    def stall() -> None:
        nonlocal now_s
        assert is_over.wait(60.0)
        now_s = 1.2

    def slow_file(file: io.FileIO) -> QueuedFile:
        return QueuedFile(Disk(file, stall), lambda: now_s)

    lockstep.bus.on_cycle = count
    monkeypatch.setattr("daq.log.writer.QueuedFile", slow_file)
    done = lockstep.run()
    assert is_over.is_set()
    assert (done.log.valid, done.log.lost_cycles) == (True, 0)
    samples = read_log(done.path).samples
    assert samples.cycle.tolist() == list(range(len(samples.cycle)))
    texts = [text for text in done.warnings if "the disk of" in text]
    assert len(texts) == 1
    assert "took 1.2 s for a part of the log" in texts[0]


def test_a_disk_that_refuses_ends_the_recording_with_its_reason(
    lockstep: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse_later() -> None:
        if lockstep.bus.cycle > 100:
            refuse()

    def full_file(file: io.FileIO) -> QueuedFile:
        return QueuedFile(Disk(file, refuse_later))

    monkeypatch.setattr("daq.log.writer.QueuedFile", full_file)
    with pytest.raises(OutputFailed, match="no space left"):
        lockstep.run()
    assert lockstep.out.with_name("a.mcap.part").exists()
