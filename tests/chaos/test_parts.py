"""The parts of a round that do not need a bus:
clock, screens, results, and the listener's end on a hub.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from drivers.canopen.bus import base_frame, open_bus
from drivers.simulation.hub import Hub
from tests.chaos.__main__ import is_excused
from tests.chaos.clock import BUILT
from tests.chaos.ends import EXTENDED, ChaosBus
from tests.chaos.faults import KERNEL_ONLY, NEEDS_CLOCK, Act, Fault, Inside
from tests.chaos.judge import Round
from tests.chaos.processes import BUS_LOST, READY, Objects, Shared, Verb, hub_running, serve_cell
from tests.chaos.results import Row, append_row, read_rows
from tests.chaos.screens import Screen, plain, screen_of
from tests.vcan.cells import write_simulation
from tests.vcan.host_stalls import HostStalls
from tests.vcan.listener import HUB_CHANNEL, Frame, frames_of_hub, heard, listening

ROOT = Path(__file__).parents[2]
PATIENCE_S = 60.0


def until(true: Callable[[], bool], seconds: float = PATIENCE_S) -> bool:
    """Wait until something is true."""
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        if true():
            return True
        time.sleep(0.01)
    return False


def act(kind: Act | Inside, value: int = 0) -> Fault:
    """A fault of a kind."""
    return Fault(
        kind, True, 1.0, 0.2, node=3, times=1, gap_s=0.0, value=value, at_cycle=0, cycles=1
    )


@pytest.mark.skipif(not Path("/usr/bin/cc").exists(), reason="no C compiler")
def test_a_clock_is_stepped_while_a_process_runs_and_for_it_alone(tmp_path: Path) -> None:
    source = ROOT / "tests" / "chaos" / "clock.c"
    library = tmp_path / "clock.so"
    subprocess.run(
        ["cc", "-shared", "-fPIC", "-fno-builtin", "-o", str(library), str(source)], check=True
    )
    code = (
        "import os, time\n"
        "from datetime import UTC, datetime\n"
        "from tests.chaos.clock import StepClock, available\n"
        "assert available()\n"
        "clock = StepClock()\n"
        "real_s = time.time()\n"
        "begun_s = time.monotonic()\n"
        "clock.step(-730 * 86400)\n"
        "assert abs(time.time() - real_s) < 60\n"  # nobody has adopted it
        "if os.fork() == 0:\n"
        "    clock.adopt()\n"
        "    same = abs(datetime.now(UTC).timestamp() - time.time()) < 60\n"
        "    print(round((time.time() - real_s) / 86400), same, flush=True)\n"
        "    clock.step(3 * 86400)\n"
        "    print(round((time.time_ns() * 1e-9 - real_s) / 86400), time.monotonic() - begun_s < "
        "60, flush=True)\n"
        "    os._exit(0)\n"
        "os.wait()\n"
        "print(round((time.time() - real_s) / 86400))\n"
    )
    environment = {**os.environ, "LD_PRELOAD": str(library), BUILT: str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.stdout, done.stderr) == ("-730 True\n3 True\n0\n", "")


def test_a_stopped_reader_leaves_no_room_in_a_pipe_and_loses_nothing(tmp_path: Path) -> None:
    words = tmp_path / "words"
    screen = Screen(words, terminal=False)
    os.write(screen.inside, b"before ")
    screen.stop()
    writing = Verb.start(
        tmp_path / "unused", lambda: 0 if os.write(1, b"after") else 1, screen.inside
    )
    assert not writing.wait(0.3)
    screen.go_on()
    assert writing.wait(PATIENCE_S)
    screen.close()
    assert plain(words.read_text(encoding="utf-8")) == "before after"


@pytest.mark.parametrize(
    ("terminal", "code"), [(False, 32), (True, -1)], ids=["broken pipe", "hang-up"]
)
def test_a_reader_that_goes_away_breaks_a_pipe_and_hangs_up_a_terminal(
    tmp_path: Path, terminal: bool, code: int
) -> None:
    def print_on() -> int:
        # Under nohup every process ignores a hang-up.
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        try:
            while True:
                os.write(1, b"words")
                time.sleep(0.01)
        except OSError as error:
            return error.errno or 0

    words = tmp_path / "words"
    screen = Screen(words, terminal=terminal)
    printing = Verb.start(tmp_path / "unused", print_on, screen.inside)
    # A process that has printed has its terminal; before that, no hang-up reaches it.
    assert until(lambda: words.read_bytes() != b"")
    assert printing.running
    screen.close_reader()
    assert printing.wait(PATIENCE_S)
    assert printing.code == code
    screen.close()


def test_a_round_without_such_acts_has_no_screen(tmp_path: Path) -> None:
    assert screen_of([act(Act.EMCY)], tmp_path / "words") is None
    for kind, terminal in ((Act.SCREEN_CLOSED, False), (Act.TERMINAL_CLOSED, True)):
        screen = screen_of([act(kind)], tmp_path / "words")
        assert screen is not None
        assert screen.terminal is terminal
        screen.close()


def test_an_independent_listener_hears_a_hub(tmp_path: Path) -> None:
    with Hub((HUB_CHANNEL,)) as hub:
        bus = ChaosBus(hub.address().port)
        with listening(bus.address, tmp_path / "frames"), bus.end(((0x080, 0x7FF),)) as end:
            with open_bus(hub.address()) as driver:
                driver.send(base_frame(0x080))
                driver.send(base_frame(0x182, bytes(range(8))))
                assert until(lambda: end.hear(0.1) == [(0x080, b"")])
                end.send(0x701, b"\x05")
                end.send(EXTENDED | 0x182, b"\x01")  # no frame of CANopen
                first = driver.recv(PATIENCE_S)
                second = driver.recv(PATIENCE_S)
            assert first is not None
            assert (first.arbitration_id, bytes(first.data)) == (0x701, b"\x05")
            assert second is not None
            assert second.is_extended_id
            assert until(lambda: (tmp_path / "frames").stat().st_size >= 3 * 21)
    found = heard(tmp_path / "frames")
    assert [(one.identifier, one.data) for one in found] == [
        (0x080, b""),
        (0x182, bytes(range(8))),
        (0x701, b"\x05"),
    ]
    assert all(abs(one.time_ns * 1e-9 - time.time()) < 60 for one in found)


def test_frames_of_a_hub_may_come_in_pieces() -> None:
    text = b"< frame 080 12.000345  >< frame 181 12.5"
    frames, rest = frames_of_hub(text)
    assert frames == [Frame(12_000_345_000, 0x080, b"")]
    frames, rest = frames_of_hub(rest + b"00000 0A0B >")
    assert frames == [Frame(12_500_000_000, 0x181, b"\x0a\x0b")]
    assert rest == b""


def test_objects_are_read_over_a_hub_behind_answers_to_others() -> None:
    """An earlier answer to the recorder, for the same object,
    is not the answer to this question.
    """
    with Hub((HUB_CHANNEL,)) as hub:
        bus = ChaosBus(hub.address().port)
        objects = Objects(bus)
        with bus.end(((0x601, 0x7FF),)) as node:
            node.send(0x581, b"\x4b\x41\x60\x00\x27\x00\x00\x00")
            time.sleep(0.2)
            with pytest.raises(TimeoutError, match="node 1 does not answer to 6041h:0"):
                objects.read(1, 0x6041, 0)
            assert node.hear(0.0) == [(0x601, b"\x40\x41\x60\x00\x00\x00\x00\x00")]
        objects.close()


def test_a_broken_off_run_goes_on_behind_its_last_row(tmp_path: Path) -> None:
    path = tmp_path / "results" / "chaos.csv"
    assert read_rows(path, 7) == []
    outcome = Round((act(Act.EMCY),), struck=[(act(Act.EMCY), 1), (act(Act.NMT), 2)], code=5)
    rows = [Row.of(7, number, False, outcome, 10.0) for number in (1, 2)]
    for row in (*rows, Row.of(8, 1, True, outcome, 3.0)):
        append_row(path, row)
    assert read_rows(path, 7) == rows
    assert [(row.number, row.bus) for row in read_rows(path, 8)] == [(1, "kernel")]
    assert rows[0].faults == ("foreign EMCY of an axis", "foreign NMT")


def test_a_hub_has_all_acts_but_those_of_the_kernel() -> None:
    assert ChaosBus().absent == frozenset()
    assert ChaosBus(1234).absent == KERNEL_ONLY
    assert not KERNEL_ONLY & NEEDS_CLOCK


def test_a_cell_whose_bus_is_gone_ends_without_a_traceback(tmp_path: Path) -> None:
    truth = write_simulation(tmp_path, 20_000)
    with Hub((HUB_CHANNEL,)) as hub:
        bus = ChaosBus(hub.address().port)
        cell = Verb.start(tmp_path / "cell.txt", lambda: serve_cell(truth, bus, (), Shared()))
        assert until(lambda: READY in cell.said)
    assert cell.wait(PATIENCE_S)
    assert cell.code == BUS_LOST
    assert "Traceback" not in cell.said
    assert str(bus.port) in cell.said


def test_an_sdo_abort_meets_one_object_while_it_is_in_force(tmp_path: Path) -> None:
    truth = write_simulation(tmp_path, 20_000)
    shared = Shared()
    with hub_running() as bus:
        cell = Verb.start(
            tmp_path / "cell.txt", lambda: serve_cell(truth, bus, ((2, 0x6041, 0),), shared)
        )
        assert until(lambda: READY in cell.said)
        objects = Objects(bus)
        assert objects.read(2, 0x6041, 0) is not None
        shared.aborting = True
        assert objects.read(2, 0x6041, 0) is None
        assert objects.read(1, 0x6041, 0) is not None
        assert objects.read(2, 0x6061, 0) is not None
        objects.close()
        assert cell.end(signal.SIGINT) == 0


SLEPT = HostStalls(count=2, longest_s=0.08, lasted_s=18.0)
AWAKE = HostStalls(count=0, longest_s=0.0, lasted_s=18.0)
LATE = "(c) foreign EMCY of an axis: an axis is enabled 0.52 s after it"
INVENTED = "(a, b) cycle 7, axis 1: (3, 0, 0) was not on the bus"


@pytest.mark.parametrize(
    ("violations", "stalls", "expected"),
    [
        ([LATE], SLEPT, True),
        ([LATE, "(e) exit code 4, expected one of [0]: "], SLEPT, True),
        ([LATE], AWAKE, False),
        ([LATE, INVENTED], SLEPT, False),
        (["(f) node 1 was enabled without permission to move"], SLEPT, False),
        (["(g) the controller's file has gains of no single write: ()"], SLEPT, False),
        (["(h) audit log: line 2 was changed"], SLEPT, False),
        ([], SLEPT, False),
    ],
)
def test_a_machine_that_stood_still_excuses_lateness_alone(
    violations: list[str], stalls: HostStalls, expected: bool
) -> None:
    judged = Round((act(Act.EMCY),), violations=violations)
    assert is_excused(judged, stalls) is expected
