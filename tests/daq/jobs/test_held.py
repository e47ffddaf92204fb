"""Reasons that hold a job: interlock, mount, another job, time, signals, room, clock;
the next job takes it up.
"""

from __future__ import annotations

import errno
import json
import os
import select
import signal
import socket
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

from daq.cli.terminal import interruptible
from daq.config.cell import Bus
from daq.config.recalibration import Command, Interlock
from daq.config.same_cell import calibrated_robot
from daq.documents.session_state import Outcome
from daq.errors import (
    AuditUnusable,
    BusTaken,
    ConfigurationInconsistent,
    ControllerUnfit,
    DiskSpaceShort,
    ExitCode,
    JobHeld,
    NotReleased,
    OutputFailed,
    TimeBoundReached,
    exit_code,
)
from daq.jobs.context import section_of
from daq.jobs.gain_target import file_of, target_of
from daq.jobs.job import Preview, preview, time_bound
from daq.jobs.journal import Form, Journal
from daq.ledger.audit import AuditAction, append
from daq.ledger.fold import figures_of
from daq.ledger.ledger import Ledger
from daq.workflow.bus_lock import bus_lock, lock_name
from daq.workflow.interlock import MAX_OUTPUT_CHARACTERS, Finished, require_release, run_command
from daq.workflow.record import Recorded, RecordingRequest
from drivers.canopen.network import CanopenNetwork
from drivers.errors import DriverError, MotionRefused
from drivers.simulation.drive import PowerState
from tests.daq.histories import calibration_of, digest_of
from tests.daq.jobs.made import Made, made_rig
from tests.daq.jobs.rig import BEGAN, Rig, make_rig, powerless, serving


def held(rig: Rig, kind: type[Exception], code: int) -> Exception:
    """The job is held by that; nothing was written but its report."""
    before = rig.controller.read_bytes()
    with pytest.raises(kind) as caught:
        rig.job()
    assert rig.controller.read_bytes() == before
    assert exit_code(kind) == code
    assert rig.session.state.outcome is Outcome.STOPPED
    assert rig.session.state.exit_code == code
    action = rig.audit[-1].action
    assert action is AuditAction.RECALIBRATION_ENDED
    details = rig.audit[-1].details
    assert details["exit_code"] == code
    return caught.value


def without_drives(rig: Rig) -> list[str]:
    """Replace the tool that looks at the drives; the list says that it was called."""
    calls: list[str] = []
    rig.tools = replace(rig.tools, drives=lambda *_: calls.append("drives"))
    return calls


@pytest.mark.slow
def test_an_interlock_that_says_no_lets_nothing_begin(tmp_path: Path, made: Made) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made)
    rig.closed.unlink()
    calls = without_drives(rig)
    held(rig, NotReleased, ExitCode.NOT_RELEASED)
    assert calls == []
    assert not (rig.cells / "mounted").exists()
    # The door is closed: the next job takes the session up.
    rig.closed.touch()
    assert rig.job().outcome is Outcome.APPLIED
    assert rig.session.state.attempt == 2


def test_a_cell_that_was_renamed_or_has_the_history_of_another_robot_is_held(
    tmp_path: Path, made: Made
) -> None:
    """Nothing has moved, and the message says the name, or the drive."""
    folder = tmp_path / "cell"
    rig = made_rig(folder, made)
    calls = without_drives(rig)
    robot = calibrated_robot(rig.cell)
    ledger = Ledger.of(rig.cell)
    assert ledger is not None
    first_drive, *other_drives = robot.drives
    changed_drive = replace(first_drive, product_code=1)
    other_robot = replace(robot, drives=(changed_drive, *other_drives))
    other = replace(calibration_of(0), robot=other_robot)
    sha256 = digest_of(other)
    entered = {
        "sha256": sha256,
        "cell": "demo",
        "entered": BEGAN.isoformat(),
        "figures": figures_of(other, sha256, BEGAN),
        "robot": asdict(other_robot),
    }

    def append_entry(action: AuditAction, subject: str, details: dict[str, Any]) -> None:
        append(ledger.audit, action, at=BEGAN, who="anna", subject=subject, details=details)

    append_entry(AuditAction.CALIBRATION_ENTERED, "history of demo", entered)
    error = held(rig, JobHeld, ExitCode.JOB_HELD)
    assert (
        "another robot with the cell name 'demo': found drive of J1 with product code 0x1;"
    ) in str(error)
    renamed = {"old_name": "demo", "cell": "press", "robot": asdict(robot)}
    append_entry(AuditAction.RENAMED, "cell press", renamed)
    error = held(rig, JobHeld, ExitCode.JOB_HELD)
    assert "a robot that was renamed to 'press'" in str(error)
    assert "if it is another robot, give it another name, or another audit log" in str(error)
    assert calls == []


@pytest.mark.slow
def test_an_interlock_that_opens_between_two_runs_ends_the_job_there(
    tmp_path: Path, one_move: Path
) -> None:
    """In the simulated cell: the person who mounts the payload leaves the door open."""
    left_open = {
        "command": ["sh", "-c", 'echo "$1" > mounted; test "$1" = none || rm -f closed', "mount"]
    }
    folder = tmp_path / "cell"
    rig = make_rig(folder, one_move, mount=left_open)
    with serving(rig) as cell:
        held(rig, NotReleased, ExitCode.NOT_RELEASED)
        assert powerless(cell)
        moved_s = cell.plant.time_s
    runs = rig.session.state.runs
    assert [run.name for run in runs] == ["bare-1"]
    loaded_1_path = rig.session.folder / "loaded-1.mcap.part"
    assert not loaded_1_path.exists()
    assert moved_s < 10.0


@pytest.mark.slow
@pytest.mark.parametrize("warm_up_min", [0, 0.05], ids=["run", "warm-up"])
def test_a_door_that_opens_while_the_drives_are_prepared_keeps_them_without_power(
    tmp_path: Path, one_move: Path, warm_up_min: float
) -> None:
    """Preflight and the recorder's begin have seen it closed;
    the last question comes when only the motion is left.
    """
    cell_folder = tmp_path / "cell"
    rig = make_rig(cell_folder, one_move, warm_up_min=warm_up_min)
    cycles: list[int] = []
    with serving(rig) as cell:

        def asking(command: Command, further: tuple[str, ...], folder: Path) -> Finished:
            ended = run_command(command, further, folder)
            if command.command[0] == "test":
                cycles.append(cell.cycles)
                if len(cycles) == 2:
                    rig.closed.unlink()
            return ended

        rig.tools = replace(rig.tools, run=asking)
        held(rig, NotReleased, ExitCode.NOT_RELEASED)
        states = {node.drive.state for node in cell.nodes}
        assert states == {PowerState.SWITCH_ON_DISABLED}
        assert cell.cycles == cycles[2]
    # By the third question the drives had been mapped and had answered a SYNC, and no move had been
    # made.
    assert len(cycles) == 3
    cycle_difference = cycles[2] - cycles[1]
    assert 0 < cycle_difference < 10
    files = rig.session.folder.glob("*.mcap*")
    assert not list(files)


@pytest.mark.slow
def test_a_payload_that_cannot_be_mounted_ends_the_job_and_the_next_goes_on_with_it(
    tmp_path: Path, made: Made
) -> None:
    mount = {"command": ["sh", "-c", 'test "$1" = none -o -e changer', "mount"]}
    folder = tmp_path / "cell"
    rig = made_rig(
        folder,
        made,
        mount=mount,
    )
    error = held(rig, JobHeld, ExitCode.JOB_HELD)
    assert "mount command" in str(error)
    assert "disc" in str(error)
    runs = rig.session.state.runs
    assert [run.name for run in runs] == ["bare-1"]
    first = rig.session.state.runs[0]
    (rig.cells / "changer").touch()
    recorded = []
    copied = rig.tools.record

    def noting(request: RecordingRequest, **further: Any) -> Recorded:
        recorded.append(request.out.stem)
        found: Recorded = copied(request, **further)
        return found

    rig.tools = replace(rig.tools, record=noting)
    assert rig.job().outcome is Outcome.APPLIED
    assert recorded == ["loaded-1", "held-out"]
    assert rig.session.state.runs[0] == first


def test_two_jobs_at_once_are_one(tmp_path: Path, made: Made) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made)
    taken = bus_lock(rig.cell, rig.folder)
    with taken, pytest.raises(BusTaken, match="one at a time"):
        rig.job()
    assert rig.sessions == ()
    assert exit_code(BusTaken) == ExitCode.BUS_TAKEN
    assert rig.job().outcome is Outcome.APPLIED
    assert not list(rig.folder.glob("*.lock"))


def test_the_lock_of_a_bus_ends_with_its_process(tmp_path: Path, made: Made) -> None:
    """A bus across processes; the other one is killed."""
    folder = tmp_path / "cell"
    rig = made_rig(folder, made)
    (bus,) = rig.cell.buses
    shared_bus = replace(bus, interface="socketcan", channel="vcan9")
    shared = replace(rig.cell, buses=(shared_bus,))
    read_end, signal_end = os.pipe()
    child = os.fork()
    if child == 0:
        with suppress(BaseException), bus_lock(shared, rig.folder):
            os.write(signal_end, b"x")
            signal.pause()
        os._exit(0)
    try:
        assert os.read(read_end, 1) == b"x"
        with pytest.raises(BusTaken), bus_lock(shared, rig.folder):
            pass
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        os.close(read_end)
        os.close(signal_end)
    with bus_lock(shared, rig.folder):
        pass


def test_another_user_learns_that_a_bus_is_taken_whatever_our_umask_is(
    tmp_path: Path, made: Made
) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made)
    before = os.umask(0o077)
    try:
        with bus_lock(rig.cell, rig.folder):
            (lock,) = rig.folder.glob("*.lock")
            st_mode = lock.stat().st_mode
            assert st_mode & 0o777 == 0o644
    finally:
        os.umask(before)


def test_a_lock_that_is_no_file_is_refused_at_once(tmp_path: Path, made: Made) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made)
    (bus,) = rig.cell.buses
    path = rig.folder / lock_name(bus)
    os.mkfifo(path)
    lock = bus_lock(rig.cell, rig.folder)
    with pytest.raises(OutputFailed, match="no regular file"), lock:
        pass
    assert path.is_fifo()


AddressInfo = tuple[Any, ...]


def address_info(address: str, port: int) -> AddressInfo:
    """An answer of getaddrinfo."""
    family = socket.AF_INET
    if ":" in address:
        family = socket.AF_INET6
    return (family, 1, 6, "", (address, port))


def hub_bus(bus: Bus, host: str) -> Bus:
    """A bus behind a hub."""
    return replace(bus, interface="socketcand", channel="can0", host=host, port=29536)


def test_a_hub_has_one_lock_whatever_it_is_called(
    tmp_path: Path, made: Made, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "cell"
    (bus,) = made_rig(folder, made).cell.buses
    known = {
        "hub": ["fd00::7", "10.0.0.9", "10.0.0.7"],
        "hub.lan": ["10.0.0.7", "10.0.0.9"],
        "other": ["10.0.0.8"],
        "localhost": ["::1", "127.0.0.1"],
        "127.0.0.1": ["127.0.0.1"],
        "::1": ["::1"],
    }

    def addresses(host: str, port: int, **_: object) -> list[AddressInfo]:
        if host not in known:
            raise socket.gaierror(-2, "Name or service not known")
        return [address_info(address, port) for address in known[host]]

    monkeypatch.setattr(socket, "getaddrinfo", addresses)

    def name(host: str) -> str:
        return lock_name(hub_bus(bus, host))

    hub = "drivegain-socketcand-can0-10.0.0.7-29536.lock"
    nowhere = "drivegain-socketcand-can0-nowhere-29536.lock"
    this_machine = name("localhost")
    assert name("hub") == hub
    assert name("hub.lan") == hub
    assert name("127.0.0.1") == this_machine
    assert name("::1") == this_machine
    assert this_machine != hub
    assert name("other") != hub
    assert name("Nowhere") == nowhere
    assert name("nowhere") == nowhere


@pytest.mark.parametrize(
    "host",
    [
        "127.0.0.1",
        "127.0.0.2",
        "0.0.0.0",
        "::",
        "::1",
        "::ffff:127.0.0.1",
        "::ffff:0.0.0.0",
        "::FFFF:7f00:1",
    ],
)
def test_this_machine_is_one_hub_by_all_its_names(host: str, tmp_path: Path, made: Made) -> None:
    folder = tmp_path / "cell"
    (bus,) = made_rig(folder, made).cell.buses
    name = "drivegain-socketcand-can0-localhost-29536.lock"
    assert lock_name(hub_bus(bus, host)) == name
    assert lock_name(hub_bus(bus, "localhost")) == name


@pytest.mark.parametrize(
    ("one", "other"),
    [("::ffff:10.0.0.7", "10.0.0.7"), ("::ffff:a00:7", "10.0.0.7"), ("fd00:0::7", "fd00::7")],
)
def test_an_address_of_a_hub_may_be_spelt_in_several_ways(
    one: str, other: str, tmp_path: Path, made: Made
) -> None:
    folder = tmp_path / "cell"
    (bus,) = made_rig(folder, made).cell.buses
    name = lock_name(hub_bus(bus, one))
    assert lock_name(hub_bus(bus, other)) == name
    assert lock_name(hub_bus(bus, "10.0.0.8")) != name


def test_a_hub_known_by_a_mapped_address_alone_is_that_of_its_ipv4_address(
    tmp_path: Path, made: Made, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As getaddrinfo answers where it maps;
    the IPv4 address goes before others as it does unmapped.
    """
    folder = tmp_path / "cell"
    (bus,) = made_rig(folder, made).cell.buses
    known = {"hub": ["2001:db8::1", "::ffff:10.0.0.7"], "10.0.0.7": ["10.0.0.7"]}

    def addresses(host: str, port: int, **_: object) -> list[AddressInfo]:
        return [address_info(address, port) for address in known[host]]

    monkeypatch.setattr(socket, "getaddrinfo", addresses)
    by_name = lock_name(hub_bus(bus, "hub"))
    by_address = lock_name(hub_bus(bus, "10.0.0.7"))
    assert by_name == by_address


@pytest.mark.slow
def test_a_job_that_is_out_of_time_stops_the_axes(tmp_path: Path, one_move: Path) -> None:
    folder = tmp_path / "cell"
    rig = make_rig(folder, one_move)
    powered = []
    with serving(rig) as cell:

        def room(_folder: Path) -> int:
            # Asked ten times a second of recorded time: in the middle of the first move the bound
            # is reached.
            states = [node.drive.state for node in cell.nodes]
            if PowerState.OPERATION_ENABLED in states:
                powered.append(True)
                if len(powered) == 3:
                    signal.raise_signal(signal.SIGALRM)
            return 10**12

        rig.tools = replace(rig.tools, free=room)
        held(rig, TimeBoundReached, ExitCode.TIME_BOUND)
        assert powerless(cell)
    assert len(powered) == 3
    assert (rig.session.folder / "bare-1.mcap.part").exists()


def test_an_alarm_does_not_cut_a_stop_short() -> None:
    with time_bound(60.0) as block_signals:
        with block_signals():
            signal.raise_signal(signal.SIGALRM)
            # It comes again.
            left_s, _ = signal.getitimer(signal.ITIMER_REAL)
            assert 0.0 < left_s <= 1.0
        with pytest.raises(TimeBoundReached):
            signal.raise_signal(signal.SIGALRM)
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    assert signal.getsignal(signal.SIGALRM) is signal.SIG_DFL


@pytest.mark.slow
def test_a_service_manager_that_ends_the_job_ends_the_motion(
    tmp_path: Path, one_move: Path
) -> None:
    folder = tmp_path / "cell"
    rig = make_rig(folder, one_move)
    asked = []
    with serving(rig) as cell:

        def room(_folder: Path) -> int:
            asked.append(True)
            if len(asked) == 5:
                signal.raise_signal(signal.SIGTERM)
            return 10**12

        rig.tools = replace(rig.tools, free=room)
        before = rig.controller.read_bytes()
        with interruptible() as block_signals, pytest.raises(KeyboardInterrupt):
            rig.job(block_signals=block_signals)
        assert powerless(cell)
    assert rig.controller.read_bytes() == before
    assert rig.session.state.outcome is Outcome.INTERRUPTED
    assert rig.session.state.exit_code == ExitCode.INTERRUPTED
    details = rig.audit[-1].details
    assert details["outcome"] == "interrupted"


@pytest.mark.slow
def test_a_job_that_is_ended_while_a_good_run_closes_moves_no_more(
    tmp_path: Path, one_move: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The signal was dropped: the job mounted the payload and recorded the next runs."""
    folder = tmp_path / "cell"
    rig = make_rig(folder, one_move)
    restore = CanopenNetwork._restore
    closed: list[CanopenNetwork] = []

    def ended_meanwhile(
        network: CanopenNetwork, asked_again: Callable[[], bool]
    ) -> list[DriverError]:
        if not closed and list(folder.rglob("*.mcap")):
            closed.append(network)
            signal.raise_signal(signal.SIGTERM)
        return restore(network, asked_again)

    monkeypatch.setattr(CanopenNetwork, "_restore", ended_meanwhile)
    with serving(rig) as cell:
        unblocked = interruptible(moves_again=True)
        with unblocked as block_signals, pytest.raises(KeyboardInterrupt) as interrupt:
            rig.job(block_signals=block_signals)
        assert powerless(cell)
    assert not hasattr(interrupt.value, "__notes__")
    assert len(list(folder.rglob("*.mcap"))) == 1
    assert rig.session.state.outcome is Outcome.INTERRUPTED


def test_a_disk_that_is_full_is_reported_before_and_during_a_run(
    tmp_path: Path, one_move: Path
) -> None:
    folder = tmp_path / "cell"
    rig = make_rig(folder, one_move, min_free_mb=1000)
    too_little = 999 * 10**6
    rig.tools = replace(rig.tools, free=lambda _: too_little)
    error = held(rig, DiskSpaceShort, ExitCode.UNEXPECTED)
    assert "min_free_mb" in str(error)
    rooms = iter([10**12] * 4)
    full = 10**6
    rig.tools = replace(rig.tools, free=lambda _: next(rooms, full))
    with serving(rig) as cell:
        held(rig, DiskSpaceShort, ExitCode.UNEXPECTED)
        assert powerless(cell)


# Steps of the clock. Such a session held every later job with exit code 14 until its folder was
# moved, two years for a date that was wrong once. Now it is said and does not count: what holds
# jobs must be what would harm, and a robot that is calibrated once more by its own policy is not
# harmed.

BY_JOB_AT_ANY_AGE = {"by": "job", "max_std_percent": 8, "max_age_days": None}
ANY_AGE = {"motion": "allowed", "apply": BY_JOB_AT_ANY_AGE}


def not_counted(rig: Rig) -> list[str]:
    """Folders that the journal names as sessions from the future."""
    name = "a session from the future does not count"
    events = [event for event in rig.events if event["event"] == name]
    return [event["folder"] for event in events]


@pytest.mark.slow
@pytest.mark.parametrize("days", [3, 730])
def test_a_job_under_a_later_date_does_not_hold_the_next_ones(
    tmp_path: Path, made: Made, days: int
) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made, policy=ANY_AGE, every_h=24)
    rig.clock.at = BEGAN + timedelta(days=days)
    assert rig.job().outcome is Outcome.APPLIED
    wrong = rig.session
    rig.clock.at = BEGAN + timedelta(hours=1)
    # Due: the calibration under the wrong date does not count. What it has written is in force all
    # the same.
    assert rig.job().outcome is Outcome.UNCHANGED
    assert not_counted(rig) == [str(wrong.folder)]
    right, last = rig.sessions
    assert last.folder == wrong.folder
    # σ of the gains in force is that of the calibration which was written last, whatever its date
    # is.
    written = wrong.state.decision
    compared = right.state.decision
    assert written is not None
    assert compared is not None
    expected = [gain.new_std for gain in written.gains]
    old_stds = [gain.old_std for gain in compared.gains]
    assert old_stds == expected
    assert right.folder.name.startswith("20260105T03")
    rig.clock.go_on(hours=12)
    ended = rig.job()
    assert ended.outcome is Outcome.NOT_DUE
    assert right.state.session in ended.remark
    rig.clock.go_on(hours=12)
    assert rig.job().outcome is Outcome.UNCHANGED
    assert len(rig.sessions) == 3


@pytest.mark.slow
def test_an_unfinished_session_under_a_later_date_is_not_continued(
    tmp_path: Path, made: Made
) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made, policy=ANY_AGE)
    rig.clock.at = BEGAN + timedelta(days=730)
    rig.closed.unlink()
    with pytest.raises(NotReleased):
        rig.job()
    wrong = rig.session
    rig.closed.touch()
    rig.clock.at = BEGAN + timedelta(hours=1)
    assert rig.job().outcome is Outcome.APPLIED
    assert not_counted(rig) == [str(wrong.folder)]
    assert wrong.folder.is_dir()


@pytest.mark.slow
def test_a_clock_that_went_back_is_said_and_the_next_session_is_one_of_its_own(
    tmp_path: Path, made: Made
) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made, policy=ANY_AGE, every_h=24)
    assert rig.job().outcome is Outcome.APPLIED
    first = rig.session
    rig.clock.at = BEGAN - timedelta(days=3)
    assert rig.job().outcome is Outcome.UNCHANGED
    assert not_counted(rig) == [str(first.folder)]
    # With the right date again, the first one is the newest one, and the ages are those of the
    # right dates.
    rig.clock.at = BEGAN + timedelta(hours=23)
    ended = rig.job()
    assert ended.outcome is Outcome.NOT_DUE
    assert first.state.session in ended.remark
    assert not_counted(rig) == [str(first.folder)]


def test_a_clock_before_this_program_was_made_holds_the_job_and_says_what_to_set(
    tmp_path: Path, made: Made
) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made)
    assert rig.job().outcome is Outcome.APPLIED
    rig.clock.at = BEGAN - timedelta(days=730)
    with pytest.raises(JobHeld, match=r"found 2024-01-06.*set the clock \(`timedatectl`\)"):
        rig.job()
    assert len(rig.sessions) == 1
    assert exit_code(JobHeld) == ExitCode.JOB_HELD


@pytest.mark.slow
@pytest.mark.parametrize("days", [-730, -3, 3, 730])
def test_a_clock_that_steps_in_a_session_changes_no_age(
    tmp_path: Path, made: Made, days: int
) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made, policy=ANY_AGE, every_h=24)
    copied = rig.tools.record

    def stepping(request: RecordingRequest, **further: Any) -> Recorded:
        found: Recorded = copied(request, **further)
        if request.out.stem == "loaded-1":
            rig.clock.go_on(days=days)
        return found

    rig.tools = replace(rig.tools, record=stepping)
    assert rig.job().outcome is Outcome.APPLIED
    assert rig.session.folder.name.startswith("20260105T02")
    assert rig.session.state.outcome is Outcome.APPLIED
    rig.clock.at = BEGAN + timedelta(hours=23)
    assert rig.job().outcome is Outcome.NOT_DUE
    rig.clock.at = BEGAN + timedelta(hours=25)
    assert rig.job().outcome is Outcome.UNCHANGED
    assert not_counted(rig) == []
    assert len(rig.sessions) == 2


def test_nothing_moves_without_the_cells_own_leave(tmp_path: Path, made: Made) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made, policy={"motion": "ask"})
    with pytest.raises(MotionRefused, match="policy"):
        rig.job()
    assert rig.sessions == ()
    assert not (rig.cells / "demo.audit.jsonl").exists()


def test_two_weighings_agree_as_they_do_everywhere(tmp_path: Path, made: Made) -> None:
    """0.4 - 0.3 is more than 0.1 in binary;
    as for `record` and the gates, two spellings of one number are one.
    """
    folder = tmp_path / "cell"
    cell = made_rig(folder, made).cell
    section = cell.recalibration
    assert section is not None
    runs = []
    for run in section.runs:
        mass_kg = None
        if run.payload is not None:
            mass_kg = 0.4
        runs.append(replace(run, mass_kg=mass_kg))
    payloads = []
    for payload in cell.payloads:
        payloads.append(replace(payload, mass_kg=0.3, mass_tolerance_kg=0.1))
    recalibration = replace(section, runs=tuple(runs))
    weighed = replace(cell, payloads=tuple(payloads), recalibration=recalibration)
    assert section_of(weighed).runs == tuple(runs)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [("payload", "anvil", "disc"), ("mass_kg", 4.7, r"4.59 kg ± 0.005")],
)
def test_a_run_whose_payload_is_not_the_cells_is_refused(
    tmp_path: Path, made: Made, key: str, value: object, message: str
) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made)
    text = rig.cell_file.read_text(encoding="utf-8")
    document = json.loads(text)
    document["recalibration"]["runs"][1][key] = value
    rig.cell_file.write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(ConfigurationInconsistent, match=message):
        rig.job()
    assert rig.sessions == ()


def set_age_of_began(path: Path) -> None:
    """Let a file be as old as the beginning of the job."""
    began_s = BEGAN.timestamp()
    os.utime(path, (began_s, began_s))


def test_an_interlock_is_asked_in_so_many_words(tmp_path: Path) -> None:
    path = tmp_path / "interlock"
    program = ("some", "program")
    interlock = Interlock(command=program, timeout_s=1.0, file=path, max_age_s=5.0)

    def ask(code: int | None = 0, later_s: float = 0.0) -> None:
        now = BEGAN + timedelta(seconds=later_s)
        finished = Finished(code, "said")
        require_release(interlock, lambda *_: finished, lambda: now, tmp_path)

    with pytest.raises(NotReleased, match="no such file"):
        ask()
    path.write_text("closed\nand more\n")
    set_age_of_began(path)
    for later_s in (-5.0, 0.0, 4.9):
        ask(later_s=later_s)
    for later_s in (-6.0, 6.0, 3600.0):
        with pytest.raises(NotReleased, match="an age of"):
            ask(later_s=later_s)
    for code in (1, None, -9):
        with pytest.raises(NotReleased, match="said"):
            ask(code)
    for text in ("open\n", "", "closed?\n"):
        path.write_text(text)
        set_age_of_began(path)
        with pytest.raises(NotReleased, match="in its first line"):
            ask()


def test_an_interlock_file_is_as_old_as_it_is_behind_the_command(tmp_path: Path) -> None:
    """A command that takes 9 s of a file's 5:
    the file was fresh when the command was asked, and is not any more.
    """
    path = tmp_path / "interlock"
    path.write_text("closed\n")
    set_age_of_began(path)
    at = [BEGAN]

    def slow(*_: object) -> Finished:
        at[0] += timedelta(seconds=9)
        return Finished(0, "")

    interlock = Interlock(command=("some", "program"), file=path, max_age_s=5.0)
    with pytest.raises(NotReleased, match="an age of 9 s"):
        require_release(interlock, slow, lambda: at[0], tmp_path)


def test_an_interlock_that_is_no_file_says_no_at_once(tmp_path: Path) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    for path in (fifo, tmp_path, Path(os.devnull)):
        interlock = Interlock(file=path, max_age_s=5.0)
        with pytest.raises(NotReleased, match=r"no regular file|is a directory"):
            require_release(interlock, run_command, lambda: BEGAN, tmp_path)


def test_a_program_that_says_much_is_heard_to_its_end_and_not_kept(tmp_path: Path) -> None:
    much = (
        "i=0; while [ $i -lt 2000 ]; do printf '%01000d' 0; i=$((i+1)); done; echo; echo the "
        "end; exit 3"
    )
    tracemalloc.start()
    try:
        command = Command(("sh", "-c", much), 60.0)
        ended = run_command(command, (), tmp_path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert ended.code == 3
    assert ended.said.endswith("0\nthe end")
    assert len(ended.said) == MAX_OUTPUT_CHARACTERS
    assert peak < 1_000_000
    not_ended = Finished(None, "not ended within 0.2 s")
    endless = Command(("yes",), 0.2)
    assert run_command(endless, (), tmp_path) == not_ended
    silent = Command(("sh", "-c", "exec >&- 2>&-; sleep 60"), 0.2)
    assert run_command(silent, (), tmp_path) == not_ended


def test_a_command_says_how_it_ended_and_leaves_nothing_behind(tmp_path: Path) -> None:
    command = Command(("sh", "-c", 'echo "$1" in "$(pwd)"; exit 3', "x"), 10.0)
    ended = run_command(command, ("disc",), tmp_path)
    assert ended.code == 3
    assert ended.said == f"disc in {tmp_path.resolve()}"
    missing = Command(("no such program",), 10.0)
    code = run_command(missing, (), tmp_path).code
    assert code is None
    with_child = Command(("sh", "-c", "sleep 60 & echo $! > pid; wait"), 0.2)
    slow = run_command(with_child, (), tmp_path)
    assert slow == Finished(None, "not ended within 0.2 s")
    with suppress(ProcessLookupError):  # which has gone already
        text = (tmp_path / "pid").read_text()
        started = os.pidfd_open(int(text))
        longest_s = 30.0
        ended_processes, _, _ = select.select([started], [], [], longest_s)
        assert ended_processes == [started]
        os.close(started)


def test_a_dry_run_asks_and_writes_nothing(tmp_path: Path, made: Made) -> None:
    folder = tmp_path / "cell"
    rig = made_rig(folder, made, warm_up_min=5)
    before = sorted(rig.folder.rglob("*"))
    journal = Journal(rig.said, Form.JSON, lambda: rig.clock.at)

    def dry_run() -> Preview:
        return preview(
            rig.cell_file, rig.cell, rig.tools, journal, who="a person", lock_folder=rig.folder
        )

    seen = dry_run()
    assert "a new session" in seen.remark
    assert seen.steps[0] == "warm up for 5 min"
    assert "mount disc, record loaded-1" in seen.steps
    files = rig.folder.rglob("*")
    assert sorted(files) == before
    rig.closed.unlink()
    with pytest.raises(NotReleased):
        dry_run()


@pytest.mark.slow
def test_a_warm_up_is_made_of_the_plans_moves_and_asks_the_interlock_too(
    tmp_path: Path, made: Made
) -> None:
    cell_folder = tmp_path / "cell"
    rig = made_rig(cell_folder, made, warm_up_min=0.2)
    made_of = []
    copied = rig.tools.record

    def noting(request: RecordingRequest, **further: Any) -> Recorded:
        made_of.append(request.out.stem)
        if request.out.stem == "warm-up":
            further["require_released"]()  # before the drives are used
            further["require_released"]()  # before they get power
            request.out.touch()
            return made.recorded["bare-1"]
        found: Recorded = copied(request, **further)
        return found

    asked = []

    def asking(command: Command, further: tuple[str, ...], folder: Path) -> Finished:
        asked.append(command.command[0])
        return run_command(command, further, folder)

    rig.tools = replace(rig.tools, record=noting, run=asking)
    assert rig.job().outcome is Outcome.APPLIED
    # 12 s in passes of a plan of about 4.4 s.
    expected = ["warm-up"] * 3 + ["bare-1", "loaded-1", "held-out"]
    assert made_of == expected
    # Preflight; then before each recording, and again before its motion.
    preflight = ["test"]
    bare = ["sh", *["test"] * 8]
    loaded = ["sh", "test", "test"]
    held_out = ["sh", "test", "test"]
    assert asked == preflight + bare + loaded + held_out
    files = rig.session.folder.glob("warm-up*")
    assert not list(files)


def test_a_link_that_no_write_would_follow_is_refused_before_anything_is_recorded(
    tmp_path: Path, short_plan: Path
) -> None:
    folder = tmp_path / "cell"
    rig = make_rig(folder, short_plan)
    behind = tmp_path / "open" / "gains.yaml"
    behind.parent.mkdir()
    rig.controller.rename(behind)
    rig.controller.symlink_to(behind)
    behind.parent.chmod(0o777)
    with pytest.raises(ControllerUnfit, match="everybody may write"):
        rig.job()
    assert rig.sessions == ()


def made_folder(parent: Path) -> Path:
    """A new folder for a cell."""
    folder = parent / "cell"
    folder.mkdir()
    return folder


@contextmanager
def refusing_new_files(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No file can be made in a folder, as on a disk that is mounted read-only, by root too."""
    really_open = os.open

    def refusing_open(path: Any, flags: int, *further: Any, **named: Any) -> int:
        if flags & os.O_CREAT and Path(os.fsdecode(path)).parent == folder:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))
        return really_open(path, flags, *further, **named)

    with monkeypatch.context() as patch:
        patch.setattr(os, "open", refusing_open)
        yield


def test_preflight_a_controllers_folder_that_is_read_only_holds_a_job_that_writes(
    tmp_path: Path, short_plan: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = make_rig(made_folder(tmp_path), short_plan)
    asked_drives = without_drives(rig)
    with refusing_new_files(rig.controller.parent, monkeypatch):
        refused = held(rig, OutputFailed, ExitCode.UNEXPECTED)
    assert "read-only file system" in str(refused)
    assert "nothing has moved" in str(refused)
    assert asked_drives == []


def test_a_gain_that_the_controllers_file_lacks_is_said_before_anything_moves(
    tmp_path: Path, short_plan: Path
) -> None:
    """A key that is misspelt was found after the recordings."""
    rig = make_rig(made_folder(tmp_path), short_plan)
    asked_drives = without_drives(rig)
    content = rig.controller.read_text()
    rig.controller.write_text(content.replace("gain:", "gein:", 1))
    for find in (target_of, file_of):
        with pytest.raises(ControllerUnfit, match="gain"):
            find(rig.cell)
    with pytest.raises(ControllerUnfit, match="gain"):
        rig.job()
    assert asked_drives == []
    assert rig.sessions == ()


def test_preflight_a_job_that_only_proposes_needs_no_place_in_the_controllers_folder(
    tmp_path: Path, short_plan: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = make_rig(made_folder(tmp_path), short_plan, policy={"motion": "allowed"})
    without_drives(rig)
    journal = Journal(rig.said, Form.JSON, lambda: rig.clock.at)
    with refusing_new_files(rig.controller.parent, monkeypatch):
        seen = preview(
            rig.cell_file, rig.cell, rig.tools, journal, who="a person", lock_folder=rig.folder
        )
    assert "write, approved by: person" in seen.steps


@pytest.mark.parametrize("taken", ["controllers/.demo.yaml.lock", "cells/demo.audit.jsonl"])
def test_dry_run_a_folder_in_place_of_a_file_to_write_refuses(
    tmp_path: Path, short_plan: Path, taken: str
) -> None:
    rig = make_rig(made_folder(tmp_path), short_plan)
    without_drives(rig)
    (rig.folder / taken).mkdir()
    before = sorted(rig.folder.rglob("*"))
    journal = Journal(rig.said, Form.JSON, lambda: rig.clock.at)
    with pytest.raises((OutputFailed, AuditUnusable)) as refused:
        preview(rig.cell_file, rig.cell, rig.tools, journal, who="a person", lock_folder=rig.folder)
    assert Path(taken).name in str(refused.value)
    assert sorted(rig.folder.rglob("*")) == before


def test_dry_run_with_places_to_write_leaves_nothing_behind(
    tmp_path: Path, short_plan: Path
) -> None:
    rig = make_rig(made_folder(tmp_path), short_plan)
    without_drives(rig)
    before = sorted(rig.folder.rglob("*"))
    journal = Journal(rig.said, Form.JSON, lambda: rig.clock.at)
    preview(rig.cell_file, rig.cell, rig.tools, journal, who="a person", lock_folder=rig.folder)
    assert sorted(rig.folder.rglob("*")) == before
