"""A run to publish without a robot, and a console's page served to the test."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from http.client import HTTPConnection, HTTPResponse
from pathlib import Path
from typing import Any

from daq.config.cell import Cell
from daq.console.live import Live
from daq.console.results import Results
from daq.console.server import Page, listen, server_of
from daq.log.feed import Feed, FeedUnfit, ProgramEnd, RunFacts
from daq.log.metadata import RunStatistics
from drivers.messages import Sample
from ident.calibration import Calibration, Parameter
from ident.data.conditioning import Conditioning
from tests.daq.calibrations import demo_calibration

TOKEN = "the-token-of-the-test"
RATE_HZ = 500.0


def facts(cell: Cell, log: Path | None) -> RunFacts:
    """A run of a cell of uncoupled motors, in which a count is a milliradian and a raw unit a
    milliampere.
    """
    count = len(cell.axes)
    identity = []
    for row in range(count):
        identity.append([float(row == column) for column in range(count)])
    scales = [1e-3] * count, [1e-3] * count, identity, [0.0] * count
    loads = {} if log is None else {"can0": 0.4}
    return RunFacts(
        "id", None if log is None else str(log), cell.axis_names, RATE_HZ, 3, *scales, None, loads
    )


def predicting_calibration() -> Calibration:
    """A calibration of the demo cell with every filter and without effects."""
    standstill_rad_s = (0.03,) * 6
    filters = Conditioning(standstill_rad_s=standstill_rad_s).document()
    # Without dry friction, whose sign depends on the last digit of a speed near zero.
    each = {"Ia": 1.0, "fv": 3.0, "off": 0.5}
    parameters: list[Parameter] = []
    for name, value in each.items():
        of_axes = []
        for axis in range(1, 7):
            of_axes.append(Parameter(f"{name}{axis}", value / axis, 0.1, "SI"))
        parameters.extend(of_axes)
    parameter = Parameter("my3", -1.0, 0.1, "kg m")
    gravity = Parameter("mx2", 2.0, 0.1, "kg m"), parameter
    left = (0.01,) * 6  # of currents of some tenths of an ampere
    found = demo_calibration()
    return replace(
        found, filter=filters, effects=(), parameters=(*parameters, *gravity), current_residual=left
    )


class Recording:
    """Publishes samples, as the recorder does; as a monitor does without a log."""

    def __init__(self, feed: Feed, cell: Cell, log: Path | None) -> None:
        self.feed = feed
        self.axes = len(cell.axes)
        self.samples = 0
        feed.begin(facts(cell, log), self.statistics)

    def statistics(self) -> RunStatistics:
        """Statistics of the log that there would be."""
        missing = (0,) * self.axes
        return RunStatistics(self.samples, 0, missing, valid=True)

    def run(self, count: int) -> None:
        """Publish so many samples; positions and currents are the number of the cycle and of the
        axis.
        """
        for _ in range(count):
            cycle = self.samples
            self.samples += 1
            position = tuple(cycle + axis for axis in range(self.axes))
            current = tuple(-cycle - axis for axis in range(self.axes))
            statusword = (0x237,) * self.axes
            time_ns = cycle * 2_000_000
            sample = Sample(cycle, time_ns, position, current, statusword)
            self.feed.sample(sample)


class Arrivals(deque[socket.socket]):
    """Consoles that a feed has accepted; a test waits for them."""

    def __init__(self) -> None:
        super().__init__()
        self.came = threading.Event()

    def append(self, one: socket.socket, /) -> None:
        """Take one."""
        super().append(one)
        self.came.set()


def arrivals(feed: Feed) -> threading.Event:
    """Event that is set once a console was accepted after this call."""
    feed._new = Arrivals()
    return feed._new.came


class WatchedLive(Live):
    """A console's state for whose changes another thread can wait."""

    def __init__(self, cell_file: Path, cell: Cell) -> None:
        self.changed = threading.Condition()
        super().__init__(cell_file, cell)

    def take(self, packet: bytes) -> None:
        """Take a packet as a whole: whoever waits never sees a half of what it changes."""
        with self.changed:
            super().take(packet)
            self._notify()

    def _clear(self, phase: str, run: RunFacts | None) -> None:
        super()._clear(phase, run)
        self._notify()

    def _finish(self, end: ProgramEnd) -> None:
        super()._finish(end)
        self._notify()

    def _refuse(self, phase: str, error: FeedUnfit) -> None:
        super()._refuse(phase, error)
        self._notify()

    def _note_stop(self, state: dict[str, Any], recorder: int) -> None:
        super()._note_stop(state, recorder)
        self._notify()

    def _notify(self) -> None:
        with self.changed:
            self.changed.notify_all()

    def wait(self, until: Callable[[], bool]) -> None:
        """Wait for a condition."""
        with self.changed:
            assert self.changed.wait_for(until, timeout=30), "it did not happen in 30 s"


class Served:
    """A console on a free port, in a thread."""

    def __init__(self, cell_file: Path, cell: Cell, report: Path | None = None) -> None:
        self.live = WatchedLive(cell_file, cell)
        self.listener = listen(0)
        self.port = self.listener.getsockname()[1]
        results = Results(cell_file, cell, report=report)
        page = Page(cell, self.live, results)
        self.server = server_of(page, TOKEN, self.port)
        self.thread = threading.Thread(
            target=lambda: asyncio.run(self.server.serve(sockets=[self.listener]))
        )

    def ask(self, path: str, method: str = "GET", **headers: str) -> tuple[HTTPResponse, bytes]:
        """Ask for a path as it is written; underscores of the headers' names are hyphens."""
        connection = HTTPConnection("127.0.0.1", self.port, timeout=10)
        try:
            named = {name.replace("_", "-"): value for name, value in headers.items()}
            connection.request(method, path, headers=named)
            answer = connection.getresponse()
            return answer, answer.read()
        finally:
            connection.close()

    def reader(self) -> socket.socket:
        """A page that has asked for the curves, and does not read yet."""
        connection = socket.create_connection(("127.0.0.1", self.port), timeout=10)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.sendall(
            f"GET /{TOKEN}/curves HTTP/1.1\r\nHost: 127.0.0.1:{self.port}\r\n\r\n".encode()
        )
        return connection


@contextmanager
def served(cell_file: Path, cell: Cell, report: Path | None = None) -> Iterator[Served]:
    """Serve a console until the block ends."""
    console = Served(cell_file, cell, report)
    with console.listener:
        console.thread.start()
        try:
            yield console
        finally:
            console.server.should_exit = True
            console.thread.join(20)
