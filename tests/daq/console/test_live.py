"""The page when its feed does not fit, stalls or changes: it says so."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from starlette.applications import Starlette

from daq.config.cell import Cell, PacingMode
from daq.console.live import Live
from daq.console.results import Results
from daq.console.server import Page
from daq.log.feed import (
    HEAD,
    SAMPLES,
    TEXT,
    Feed,
    FeedUnfit,
    QuickGain,
    QuickLook,
    facts_of_recorder,
    packet_struct,
    socket_names,
)
from tests.daq.console.feeds import TOKEN, Recording, arrivals, facts, served

EVENT = {"time_ns": 0, "axis": 2, "kind": "emcy", "code": 0x7305, "text": "EMCY 7305h"}


def _text(message: Any) -> bytes:
    return HEAD.pack(TEXT, 0, 0, 0, 0, 0) + json.dumps(message).encode()


def _samples(axes: int, count: int, so_far: int = 1) -> bytes:
    sample = packet_struct(axes).pack(0, 0, 0, *[0] * axes, *[0] * axes, *[0x237] * axes)
    return HEAD.pack(SAMPLES, 1, so_far, 0, 0, count) + sample


def _run(cell: Cell, **changed: Any) -> dict[str, Any]:
    return {"run": {**asdict(facts(cell, Path("run.mcap"))), **changed}}


@pytest.mark.parametrize(
    "packet",
    [
        pytest.param(lambda _: b"x", id="one byte"),
        pytest.param(lambda _: HEAD.pack(TEXT, 0, 0, 0, 0, 0) + b"{", id="no JSON"),
        pytest.param(lambda _: _text([1]), id="a list"),
        pytest.param(lambda _: HEAD.pack(7, 0, 0, 0, 0, 0), id="an unknown packet"),
        pytest.param(
            lambda _: _text({"events": [{**EVENT, "kind": "surprise"}]}), id="an unknown event"
        ),
        pytest.param(
            lambda cell: _text(
                {"run": {k: v for k, v in _run(cell)["run"].items() if k != "moves"}}
            ),
            id="a run without a key",
        ),
        pytest.param(
            lambda cell: _text({"run": asdict(facts(replace(cell, axes=cell.axes[:5]), None))}),
            id="a run of five axes",
        ),
        pytest.param(lambda cell: _samples(len(cell.axes), 2), id="too many samples"),
        pytest.param(lambda cell: _samples(len(cell.axes) - 1, 1), id="samples of fewer axes"),
    ],
)
def test_a_packet_that_does_not_fit_is_one_kind_of_error(
    cell: Cell, cell_file: Path, packet: Callable[[Cell], bytes]
) -> None:
    live = Live(cell_file, cell)
    live.take(_text(_run(cell)))
    with pytest.raises(FeedUnfit):
        live.take(packet(cell))


def test_keys_of_a_later_version_are_ignored(cell: Cell, cell_file: Path) -> None:
    live = Live(cell_file, cell)
    message = {**_run(cell, of_tomorrow=1), "of_tomorrow": 2}
    live.take(_text(message))
    live.take(_samples(len(cell.axes), 1))
    assert (live.phase, live.samples) == ("running", 1)


def test_a_look_at_the_gains_is_shown_until_the_next_run(cell: Cell, cell_file: Path) -> None:
    gains = [QuickGain("J1", "Nm/A", 33.9, 0.4, 0.5)]
    look = QuickLook("block-2-loaded", 3, 9, 31.0, gains=gains, left_s=12.0)
    live = Live(cell_file, cell)
    live.take(_text(_run(cell)))
    assert live.status()["quick"] is None
    message = {"quick": asdict(look)}
    live.take(_text(message))
    quick = live.status()["quick"]
    assert quick == asdict(look)
    live.take(_text(_run(cell)))
    assert live.status()["quick"] is None


@contextmanager
def _other_program(cell_file: Path, packet: bytes) -> Iterator[None]:
    """A feed that sends one packet to each console, until the block ends."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(socket_names(cell_file).feed)
        listener.listen(8)

        def serve() -> None:
            while True:
                try:
                    console, _ = listener.accept()
                except OSError:
                    return
                with console:
                    console.send(packet)
                    console.recv(1)  # until the console goes

        thread = threading.Thread(target=serve)
        thread.start()
        yield
        listener.shutdown(socket.SHUT_RDWR)
        thread.join(30)


def test_a_recorder_of_another_version_is_said_and_the_next_one_is_shown(
    cell: Cell, cell_file: Path
) -> None:
    with served(cell_file, cell) as console:
        live = console.live
        message = _run(cell, rate_hz="fast")
        with _other_program(cell_file, _text(message)):
            live.wait(lambda: "cannot show the recorder" in live.status()["alarm"])
            assert facts_of_recorder(cell_file, 10.0) is None  # monitor goes on with its own
            assert live.phase == "running"  # so that the page's button can stop it
        live.wait(lambda: live.phase == "ended")
        assert live.end is not None
        assert not live.end["axes_stopped"]
        assert live.status()["alarm"] == ""
        feed = Feed(cell_file, lambda: None)
        accepted = arrivals(feed)
        with feed:
            recording = Recording(feed, cell, cell_file)
            assert accepted.wait(30)
            recording.run(100)
            live.wait(lambda: live.samples == 100)
            status = live.status()
            assert status["phase"] == "running"
            assert status["end"] is None
            assert status["alarm"] == ""


def test_a_background_task_that_ends_is_said(cell: Cell, cell_file: Path) -> None:
    live = Live(cell_file, cell)

    async def broken() -> None:
        raise LookupError("a defect")

    async def lived() -> None:
        results = Results(cell_file, cell)
        page = Page(cell, live, results, broken)
        async with page._background(Starlette()):
            while not live.failed:
                await asyncio.sleep(0)

    asyncio.run(asyncio.wait_for(lived(), 30))
    assert "a defect" in live.status()["alarm"]
    assert "restart the console" in live.status()["alarm"]


def test_a_recorder_that_hangs_is_said_and_its_states_are_marked_as_old(
    cell: Cell, cell_file: Path
) -> None:
    now_s = [0.0]
    live = Live(cell_file, cell, clock=lambda: now_s[0])
    live.take(_text(_run(cell)))
    now_s[0] = 60.0
    assert live.status()["alarm"] == ""  # the drives are prepared
    for number in range(10):
        now_s[0] += 0.02
        so_far = 10 * number
        live.take(_samples(len(cell.axes), 1, so_far=so_far))
    fresh = live.status()
    assert fresh["alarm"] == ""
    assert fresh["old"] is False
    assert fresh["rate_hz"] > 0.0
    now_s[0] += 4.1
    old = live.status()
    assert "Nothing has come for 4 s" in old["alarm"]
    assert "use the emergency stop" in old["alarm"]
    assert old["old"] is True
    assert old["rate_hz"] == 0.0
    live.take(_samples(len(cell.axes), 1, so_far=91))
    assert live.status()["old"] is False
    message = {"result": {"valid": True, "reason": "", "samples": 91}}
    live.take(_text(message))
    now_s[0] += 60.0
    assert live.status()["alarm"] == ""  # between two runs of a job


def test_a_stop_is_forgotten_when_the_next_recorder_begins(cell: Cell, cell_file: Path) -> None:
    with served(cell_file, cell) as console:
        live = console.live
        own = f"http://127.0.0.1:{console.port}"
        for number in range(2):
            asked = threading.Event()
            feed = Feed(cell_file, asked.set)
            accepted = arrivals(feed)
            with feed:
                recording = Recording(feed, cell, cell_file)
                assert accepted.wait(30)
                recording.run(100)
                live.wait(lambda: live.samples == 100 and live.stop_state is None)
                path = f"/{TOKEN}/stop"
                text = console.ask(path, "POST", origin=own)[1]
                document = json.loads(text)
                assert document["accepted"]
                assert asked.wait(30), number
            live.wait(lambda: bool(live.stop_state and live.stop_state.get("axes_stopped")))


def test_a_simulated_cell_in_lockstep_has_no_load_of_a_bus(cell: Cell, cell_file: Path) -> None:
    assert cell.sync is not None
    for pacing, buses in ((PacingMode.LOCKSTEP, set()), (PacingMode.TIMED, {"can0"})):
        sync = replace(cell.sync, pacing=pacing)
        changed_cell = replace(cell, sync=sync)
        live = Live(cell_file, changed_cell)
        live.take(_text(_run(cell)))
        bus_load = live.status()["bus_load"]
        assert bus_load.keys() == buses
        simulated = live.status()["simulated"]
        assert simulated is (pacing is PacingMode.LOCKSTEP)


@pytest.mark.parametrize("pacing", PacingMode)
def test_the_sample_rate_is_that_of_the_cells_own_time(
    cell: Cell, cell_file: Path, pacing: PacingMode
) -> None:
    """A simulated cell answers half as fast again as a real one:
    its rate is that of its SYNC all the same.
    """
    assert cell.sync is not None
    now_s = [0.0]
    sync = replace(cell.sync, pacing=pacing)
    declared = replace(cell, sync=sync)
    live = Live(cell_file, declared, clock=lambda: now_s[0])
    live.take(_text(_run(cell)))
    live.take(_samples(len(cell.axes), 1, so_far=0))
    live.take(_samples(len(cell.axes), 1, so_far=1))
    assert live.status()["rate_hz"] == 0.0  # two packets at once are no rate
    for number in range(40):
        now_s[0] += 0.02
        so_far = 15 * number
        live.take(_samples(len(cell.axes), 1, so_far=so_far))
    assert live.run is not None
    measured = live.rate_hz
    assert measured > 1.2 * live.run.rate_hz
    rate_hz = live.status()["rate_hz"]
    expected = live.run.rate_hz if pacing is PacingMode.LOCKSTEP else round(measured, 1)
    assert rate_hz == expected
