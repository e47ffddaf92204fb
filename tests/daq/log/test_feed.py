"""The feed never waits, counts what it drops, and takes a stop by another way."""

from __future__ import annotations

import json
import os
import resource
import socket
import struct
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from canopen.sdo.exceptions import SdoAbortedError

from daq.config.cell import Cell
from daq.log import feed as feeds
from daq.log.feed import (
    ACCEPTED,
    HEAD,
    LARGEST_CONSOLES,
    LARGEST_PACKET,
    SAMPLES,
    STOP,
    Feed,
    connected,
    end_of,
    facts_of_recorder,
    packet_dtype,
    read_packet,
    socket_names,
)
from drivers.errors import SetupRefused
from drivers.messages import CellEvent, EventKind
from tests.daq.console.feeds import Recording, arrivals, facts


@pytest.fixture
def cell_file(tmp_path: Path) -> Path:
    """A path of its own, so that the feeds of two tests have different addresses;
    it is not read.
    """
    return tmp_path / "cell.yaml"


def _console(cell_file: Path, feed: Feed) -> socket.socket:
    accepted = arrivals(feed)
    console = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    console.settimeout(10)
    console.connect(socket_names(cell_file).feed)
    assert accepted.wait(10)
    return console


def test_a_console_gets_every_sample_and_event_in_their_order(cell_file: Path, cell: Cell) -> None:
    with Feed(cell_file) as feed:
        recording = Recording(feed, cell, cell_file)
        recording.run(5)  # without a console
        with _console(cell_file, feed) as console:
            recording.run(25)
            event = CellEvent(50_000_000, 1, EventKind.EMCY, 0x7305, "EMCY 7305h")
            feed.event(event)
            recording.run(10)
            feed.finish()
            packets = [console.recv(LARGEST_PACKET) for _ in range(6)]
    heads = [HEAD.unpack_from(packet) for packet in packets]
    text = packets[0][HEAD.size :]
    document = json.loads(text)
    axes = document["run"]["axes"]
    assert axes == list(cell.axis_names)
    numbers = [number - heads[0][1] for _, number, *_ in heads]
    assert numbers == [0, 1, 2, 3, 4, 5]
    kinds = ["samples" if kind == SAMPLES else next(iter(json.loads(packet[HEAD.size :]))) for packet, (kind, *_) in  # noqa: E501
             zip(packets, heads, strict=True)]  # fmt: skip
    expected = ["run", "samples", "samples", "samples", "events", "samples"]
    assert kinds == expected
    cycles = []
    for packet, head in zip(packets, heads, strict=True):
        if head[0] == SAMPLES:
            rows = np.frombuffer(packet[HEAD.size :], packet_dtype(len(cell.axes)))
            cycles.extend(rows["cycle"].tolist())
    assert cycles == list(range(5, 40))
    last_head = heads[-1]
    assert last_head[2] == 40  # all samples of the run, also those from before


def test_a_console_that_does_not_read_loses_packets_and_delays_nothing(
    cell_file: Path, cell: Cell
) -> None:
    with Feed(cell_file) as feed:
        recording = Recording(feed, cell, cell_file)
        with _console(cell_file, feed) as console:
            recording.run(60_000)  # would wait for ever if it waited
            console.setblocking(False)
            numbers = []
            while True:
                try:
                    unpack = HEAD.unpack_from(console.recv(LARGEST_PACKET))
                    numbers.append(unpack[1])
                except BlockingIOError:
                    break
            recording.run(10)
            after = HEAD.unpack_from(console.recv(LARGEST_PACKET))
        recording.run(20)  # it has gone
        assert not feed._consoles
    assert 0 < len(numbers) < 5000
    last_number = numbers[-1]
    assert after[1] - last_number > 100
    assert after[2] == 60_010


def test_a_monitor_asks_a_recorder_for_the_facts_of_its_run(cell_file: Path, cell: Cell) -> None:
    assert facts_of_recorder(cell_file, 10.0) is None
    feed = Feed(cell_file)
    accepted = arrivals(feed)
    with feed, ThreadPoolExecutor(1) as pool:
        recording = Recording(feed, cell, cell_file)
        asked = pool.submit(facts_of_recorder, cell_file, 10.0)
        assert accepted.wait(10)
        recording.run(10)
        assert asked.result() == facts(cell, cell_file)
        recording.run(20)  # it has gone
        assert not feed._consoles


def test_a_stop_is_acknowledged_and_its_end_reported_while_the_curves_stall(
    cell_file: Path, cell: Cell
) -> None:
    stopped = threading.Event()
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
        asking.settimeout(10)
        feed = Feed(cell_file, stopped.set).__enter__()
        recording = Recording(feed, cell, cell_file)
        with _console(cell_file, feed):
            recording.run(60_000)
            asking.connect(socket_names(cell_file).stop)
            asking.sendall(STOP)
            assert asking.recv(len(ACCEPTED)) == ACCEPTED
            assert stopped.wait(10)
            feed.__exit__(KeyboardInterrupt, KeyboardInterrupt(), None)
        document = json.loads(asking.recv(4096))
        expected = {"ok": False, "axes_stopped": True, "text": "stopped"}
        assert document == expected


def test_silent_clients_delay_no_stop(cell_file: Path) -> None:
    stopped = threading.Event()
    name = socket_names(cell_file).stop
    with ExitStack() as closing, Feed(cell_file, stopped.set):
        clients = [connected(name, socket.SOCK_STREAM, 10.0) for _ in range(2 * LARGEST_CONSOLES)]
        for silent in clients:
            assert silent is not None
            closing.enter_context(silent)
        asking = connected(name, socket.SOCK_STREAM, 10.0)
        assert asking is not None
        with asking:
            asking.sendall(STOP)
            assert asking.recv(len(ACCEPTED)) == ACCEPTED
            assert stopped.wait(10)


@contextmanager
def _without_descriptors() -> Iterator[None]:
    """Leave this process no free file descriptor, as one that leaks them."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    held: list[int] = []
    with suppress(OSError):
        while len(held) < 10_000:
            held.append(os.dup(0))
            if len(held) == 64:
                resource.setrlimit(resource.RLIMIT_NOFILE, (held[-1] + 1, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        for descriptor in held:
            os.close(descriptor)


def test_a_process_without_descriptors_serves_a_stop_once_it_has_one(cell_file: Path) -> None:
    stopped = threading.Event()
    name = socket_names(cell_file).stop
    with Feed(cell_file, stopped.set), socket.socket(socket.AF_UNIX) as asking:
        asking.settimeout(10)
        with _without_descriptors():
            # No console of this process either
            assert connected(name, socket.SOCK_STREAM, 1.0) is None
            asking.connect(name)
            asking.sendall(STOP)
            assert not stopped.wait(3 * feeds.ACCEPT_AGAIN_S)
        assert asking.recv(len(ACCEPTED)) == ACCEPTED
        assert stopped.wait(10)


def test_a_feed_without_descriptors_says_so_and_one_that_ends_without_them_ends(
    cell_file: Path,
) -> None:
    with _without_descriptors(), Feed(cell_file) as feed:
        assert "too many open files" in feed.remark.lower()
    feed = Feed(cell_file)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as console:
        feed.__enter__()
        with _without_descriptors():
            console.connect(socket_names(cell_file).feed)  # waits in vain
            feed.__exit__(None, None, None)
            for thread in threading.enumerate():
                assert thread.name != "drivegain feed"


def test_another_word_stops_nothing(cell_file: Path) -> None:
    with (
        Feed(cell_file, stop=lambda: pytest.fail("stopped")),
        socket.socket(socket.AF_UNIX) as asking,
    ):
        asking.settimeout(10)
        asking.connect(socket_names(cell_file).stop)
        asking.sendall(b"GET /")
        assert asking.recv(10) == b""


def test_other_users_are_not_served(cell_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one, other = socket.socketpair(socket.AF_UNIX)
    with one, other:
        assert feeds.of_this_user(one)
        credentials = struct.pack("3i", 1, 1234, 1)
        monkeypatch.setattr(os, "getuid", lambda: 4711)
        fake = type("Peer", (), {"getsockopt": lambda *_: credentials})()
        assert not feeds.of_this_user(fake)


def test_a_second_program_on_a_cell_publishes_nothing_and_goes_on(
    cell_file: Path, cell: Cell
) -> None:
    with Feed(cell_file), Feed(cell_file) as second:
        Recording(second, cell, cell_file).run(20)
        assert "no console can watch" in second.remark


def test_what_a_stop_could_not_confirm_is_in_its_end() -> None:
    error = RuntimeError("node 3")
    error.add_note("while stopping: node 2 does not answer")
    assert end_of(error)["axes_stopped"]
    error.add_note("not confirmed without power: node 2")
    assert end_of(error) == {
        "ok": False,
        "axes_stopped": False,
        "text": "node 3; while stopping: node 2 does not answer; not confirmed without "
        "power: node 2",
    }
    assert end_of(None) == {"ok": True, "axes_stopped": True, "text": ""}


def _behind(error: BaseException) -> SetupRefused:
    """An error with another behind it."""
    refused = SetupRefused(2, "TPDO1: writing 0x0 to 1A00h:00: aborted")
    refused.__cause__ = error
    refused.__context__ = error
    return refused


def test_an_sdo_abort_behind_an_error_does_not_keep_its_end_from_a_console() -> None:
    """The `__eq__` of canopen's abort raises where the other error has no abort code."""
    abort = SdoAbortedError(0x0601_0002)
    abort.add_note("not confirmed without power: J3")
    assert end_of(_behind(abort)) == {
        "ok": False,
        "axes_stopped": False,
        "text": "node 2: TPDO1: writing 0x0 to 1A00h:00: aborted; not confirmed without power: J3",
    }


def test_an_error_that_cannot_be_written_is_named() -> None:
    class Unwritable(Exception):
        def __str__(self) -> str:
            raise ValueError("no text")

    assert end_of(Unwritable())["text"] == "Unwritable"
    error = _behind(Unwritable())
    assert end_of(error)["text"].startswith("node 2: ")


def _end_at(console: socket.socket) -> dict[str, object]:
    """The end that a console receives, after whatever else it was sent."""
    while True:
        packet = read_packet(console.recv(LARGEST_PACKET), None)
        if packet.message is not None and packet.message.end is not None:
            return asdict(packet.message.end)


def test_samples_that_cannot_be_sent_do_not_keep_the_end_from_a_console(
    cell_file: Path, cell: Cell
) -> None:
    feed = Feed(cell_file)
    with ExitStack() as closing:
        with pytest.raises(SetupRefused), feed:
            console = closing.enter_context(_console(cell_file, feed))
            Recording(feed, cell, cell_file)
            feed._packed = ["no bytes"]  # type: ignore[list-item]
            raise _behind(SdoAbortedError(0x0601_0002))
        end = _end_at(console)
    expected = {
        "ok": False,
        "axes_stopped": True,
        "text": "node 2: TPDO1: writing 0x0 to 1A00h:00: aborted",
    }
    assert end == expected
