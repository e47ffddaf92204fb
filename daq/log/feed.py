"""The feed of a recording: every sample and event for consoles that may be slow,
and a stop that is acknowledged.

A recorder publishes its samples and events and never waits. Each packet of a Unix SEQPACKET socket
is sent without blocking: where a console does not read, packets are dropped, the console sees from
their numbers how many, and the recording goes on. A second socket takes the stop, so that it works
while the curves are stalled. `drivegain monitor` has a feed of the same kind at another address,
without a stop. All are in Linux's abstract namespace: they leave no file and end with the process.
Only processes of the same user, or of root, are served.
"""

from __future__ import annotations

import json
import os
import selectors
import signal
import socket
import struct
import threading
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from daq.files import sha256
from daq.log.conversion import SiScaling
from daq.log.metadata import RunStatistics
from drivers.errors import POWERED, WHILE, stop_notes, text_of
from drivers.messages import CellEvent, Sample

BATCH_S = 0.02  #: Time of the samples in one packet
#: Asked of the kernel, which may give less: seconds of samples for a console that pauses
SEND_BUFFER_BYTES = 1 << 20
EVENTS_KEPT = 200  #: Events that a console gets which comes late
BACKLOG = 128  #: Clients that may connect before the next is accepted; beyond, they are refused
WAITER_ENDS_S = 3.0  #: Time for the thread that waits to end
#: Time after which a client is accepted that could not be, as by a process without descriptors
ACCEPT_AGAIN_S = 0.1
STOP = b"stop\n"
ACCEPTED = b"accepted\n"
LARGEST_PACKET = 1 << 18  #: [bytes]
LARGEST_CONSOLES = 8  #: Served at the same time, and clients of the stop that have not asked yet

SAMPLES = 0
TEXT = 1
"""Kinds of packets: samples, or a JSON object with some of the keys run, events, bus_load, quick,
result and end.
"""
HEAD = struct.Struct("<BQQIIH")
"""Kind; number of the packet; of the run so far its samples, lost cycles and missing answers;
samples in the packet.
"""


@dataclass(frozen=True, slots=True)
class RunFacts:
    """Facts of a run that a console needs to show its samples; lists have one entry an axis."""

    run_id: str  #: of the log
    log: str | None  #: its path; None for `drivegain monitor`, which writes none
    axes: tuple[str, ...]  #: names
    rate_hz: float  #: of the samples
    moves: int  #: in the plan
    rad_per_count: list[float]  #: motor angle of a count [rad]
    #: current of a raw unit, in the current's unit of the gains; NaN where unknown
    current_per_unit: list[float]
    to_joint: list[list[float]]  #: R⁻¹, shape (n, n)
    offset_rad: list[float]  #: joint positions at zero counts [rad; m of a prismatic joint]
    payload: str | None  #: name in the cell file
    #: computed mean load of each bus at this rate, as a share; empty for a monitor
    bus_load: dict[str, float]

    @property
    def scaling(self) -> SiScaling:
        """Factors from raw numbers to SI."""
        return SiScaling(
            rad_per_count=np.array(self.rad_per_count),
            to_joint=np.array(self.to_joint),
            offset_rad=np.array(self.offset_rad),
            current_per_unit=np.array(self.current_per_unit),
        )


class FeedUnfit(ValueError):
    """A packet that this version does not understand:
    its program is of another version, or no recorder.
    """


@dataclass(frozen=True, slots=True)
class RunResult:
    """Result of a run whose log is complete."""

    valid: bool
    reason: str  #: why it is not valid
    samples: int


@dataclass(frozen=True, slots=True)
class ProgramEnd:
    """How a program ended."""

    ok: bool
    axes_stopped: bool  #: whether all axes are known to be stopped
    text: str


@dataclass(frozen=True, slots=True)
class QuickGain:
    """Quick estimate of a gain, with its target."""

    axis: str
    unit: str
    value: float
    std_percent: float
    target_percent: float

    @property
    def ratio(self) -> float:
        """Return σ over its target."""
        return self.std_percent / self.target_percent


@dataclass(frozen=True, slots=True)
class QuickLook:
    """What a quick linear estimate says of the gains after a move.

    It is for the eye and decides nothing.
    """

    block: str  #: that is being recorded
    move: int  #: finished moves of the block
    moves: int  #: in its plan
    motion_s: float  #: motion that the estimate is made from [s]
    is_held_out: bool = False  #: the moves of this block do not count
    #: the worst first; empty where nothing is known yet
    gains: list[QuickGain] = field(default_factory=list)
    missing: str = ""  #: why nothing is known yet
    why: str = ""  #: why the worst gain takes longest
    left_s: float = 0.0  #: motion until every gain is at its target, if σ falls as 1/√time [s]


@dataclass(frozen=True, slots=True)
class Message:
    """The JSON object of a packet."""

    run: RunFacts | None = None
    events: list[CellEvent] = field(default_factory=list)
    bus_load: dict[str, float] | None = None
    quick: QuickLook | None = None
    result: RunResult | None = None
    end: ProgramEnd | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Packet:
    """A packet as a console reads it."""

    number: int
    samples: int  #: of the run so far
    lost: int  #: cycles of the run so far
    missing: int  #: answers of the run so far
    message: Message | None  #: of a TEXT packet
    rows: NDArray[np.void] | None  #: of a SAMPLES packet, in the layout of `packet_dtype`


_MESSAGE = TypeAdapter(Message)


def read_packet(packet: bytes, axes: int | None) -> Packet:
    """Decode a packet; keys that a later version added are ignored.

    Args:
        packet: as it was received.
        axes: number of axes of the samples; None where only the facts of a run are wanted.

    Raises:
        FeedUnfit: its layout, a key, a type or a length is not that of this version.
    """
    try:
        kind, number, samples, lost, missing, count = HEAD.unpack_from(packet)
        message = None
        rows = None
        fits = kind in (SAMPLES, TEXT)
        if kind == TEXT:
            message = _MESSAGE.validate_json(packet[HEAD.size :])
        elif axes is not None:
            rows = np.frombuffer(packet, packet_dtype(axes), offset=HEAD.size)
            fits = fits and len(rows) == count > 0
    except (struct.error, ValueError) as error:
        raise FeedUnfit("it sends packets that this version does not understand") from error
    if not fits:
        raise FeedUnfit("it sends packets whose numbers do not fit together")
    return Packet(number, samples, lost, missing, message, rows)


@dataclass(frozen=True, slots=True)
class SocketNames:
    """Addresses for one cell file, in the abstract namespace."""

    feed: str  #: of a recorder's samples and events
    stop: str  #: of a recorder
    monitor: str  #: of a monitor's samples and events


def socket_names(cell_file: Path) -> SocketNames:
    """Return the addresses for a cell file."""
    digest = sha256(str(cell_file.resolve()).encode())[:24]
    return SocketNames(*(f"\0drivegain-{digest}-{name}" for name in ("feed", "stop", "monitor")))


def connected(name: str, kind: int, timeout_s: float) -> socket.socket | None:
    """Connect to a socket of a program of this user; None where there is none."""
    with suppress(OSError), ExitStack() as closing:
        connection = closing.enter_context(socket.socket(socket.AF_UNIX, kind))
        connection.settimeout(timeout_s)
        connection.connect(name)
        if of_this_user(connection):
            closing.pop_all()
            return connection
    return None


def facts_of_recorder(cell_file: Path, within_s: float) -> RunFacts | None:
    """Return the facts of the run that a recorder publishes now; None without one in that time."""
    connection = connected(socket_names(cell_file).feed, socket.SOCK_SEQPACKET, within_s)
    if connection is None:
        return None
    with connection, suppress(OSError, FeedUnfit):
        # A new console first gets what it missed.
        message = read_packet(connection.recv(LARGEST_PACKET), None).message
        return None if message is None else message.run
    return None


def packet_struct(axes: int) -> struct.Struct:
    """Return the layout of a sample in a packet:
    cycle, time, missing, positions, currents, statuswords.
    """
    return struct.Struct(f"<QqI{axes}i{axes}i{axes}H")


def packet_dtype(axes: int) -> np.dtype[np.void]:
    """Return the layout of `packet_struct` for numpy."""
    return np.dtype(
        [
            ("cycle", "<u8"),
            ("time_ns", "<i8"),
            ("missing", "<u4"),
            ("position_counts", "<i4", (axes,)),
            ("current_raw", "<i4", (axes,)),
            ("statusword", "<u2", (axes,)),
        ]
    )


def of_this_user(connection: socket.socket) -> bool:
    """Return whether the process at the other end is of this user or of root."""
    ids = struct.Struct("3i")  # struct ucred: pid, uid, gid
    _, uid, _ = ids.unpack(connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, ids.size))
    return uid in (os.getuid(), 0)


def interrupt_main_thread() -> None:
    """Do what Ctrl-C does; a main thread that waits in a system call is woken."""
    main = threading.main_thread().ident
    if main is not None:
        signal.pthread_kill(main, signal.SIGINT)


class Feed:
    """Context manager that publishes the runs of one program;
    methods other than `__enter__` never raise or wait.

    Where its addresses are taken, by another program on this cell, nothing is published and
    `remark` says so.
    """

    def __init__(
        self, cell_file: Path, stop: Callable[[], None] | None = interrupt_main_thread
    ) -> None:
        """Store the arguments.

        Args:
            cell_file: of the cell; consoles of the same file find the feed.
            stop: does what a stop asks for, in another thread than the caller's; None for a
                monitor, which takes none.
        """
        self.remark = ""
        self._names = socket_names(cell_file)
        self._stop = stop
        self._listening: list[socket.socket] = []
        self._new: deque[socket.socket] = deque()
        self._consoles: list[socket.socket] = []
        self._stopping: list[socket.socket] = []
        self._number = 0
        self._run: RunFacts | None = None
        self._statistics: Callable[[], RunStatistics] = lambda: RunStatistics(0, 0, (), valid=False)
        self._events: deque[dict[str, Any]] = deque(maxlen=EVENTS_KEPT)
        self._result: dict[str, Any] | None = None
        self._looks: deque[QuickLook] = deque(maxlen=1)  # of another thread; the newest is enough
        self._quick: dict[str, Any] | None = None
        self._packed: list[bytes] = []
        self._layout = packet_struct(0)
        self._batch = 1
        self._waiter: threading.Thread | None = None
        self._ended = threading.Event()

    def __enter__(self) -> Feed:
        """Begin to listen for consoles and stops, in a thread that waits."""
        names = self._names
        packets = socket.SOCK_SEQPACKET
        stream = socket.SOCK_STREAM
        if self._stop is None:
            places = [(names.monitor, packets)]
        else:
            places = [(names.feed, packets), (names.stop, stream)]
        try:
            for name, kind in places:
                listener = socket.socket(socket.AF_UNIX, kind)
                self._listening.append(listener)
                listener.bind(name)
                listener.listen(BACKLOG)
            selector = selectors.DefaultSelector()
        except OSError as error:
            for listener in self._listening:
                listener.close()
            self.remark = (
                f"no console can watch: {error.strerror or error}; is another program on this cell?"
            )
            return self
        self._waiter = threading.Thread(
            target=self._wait, args=(selector,), name="drivegain feed", daemon=True
        )
        self._waiter.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        ended = end_of(error)
        # Samples that cannot be sent must not hide the error that ended the run
        with suppress(Exception):
            self._flush()
        self._send({"end": ended})
        self._ended.set()
        if self._waiter is not None:
            for listener in self._listening:
                with suppress(OSError):
                    listener.shutdown(socket.SHUT_RDWR)  # wakes the thread
            self._waiter.join(WAITER_ENDS_S)
        for connection in self._stopping:
            with suppress(OSError):
                connection.send(json.dumps(ended).encode() + b"\n", socket.MSG_DONTWAIT)
        for connection in (*self._stopping, *self._consoles, *self._new):
            connection.close()

    def begin(self, run: RunFacts, statistics: Callable[[], RunStatistics]) -> None:
        """Begin a run; the statistics are those of its log so far."""
        self._run = run
        self._statistics = statistics
        self._result = None
        self._layout = packet_struct(len(run.axes))
        self._batch = max(1, round(BATCH_S * run.rate_hz))
        self._events.clear()
        self._looks.clear()
        self._quick = None
        self._send({"run": asdict(run)})

    def sample(self, sample: Sample) -> None:
        """Publish a sample; the packet goes when BATCH_S are full."""
        if not self._consoles and not self._new:
            return
        self._packed.append(
            self._layout.pack(
                sample.cycle,
                sample.time_ns,
                sample.missing,
                *sample.position_counts,
                *sample.current_raw,
                *sample.statusword,
            )
        )
        if len(self._packed) >= self._batch:
            self._flush()

    def event(self, event: CellEvent) -> None:
        """Publish an event, in its place between the samples."""
        shown = {**asdict(event), "kind": event.kind.value}
        self._flush()
        self._events.append(shown)
        self._send({"events": [shown]})

    def measured(self, bus_load: dict[str, float]) -> None:
        """Publish the load that a monitor has measured on each bus, as a share,
        with the longest bit stuffing.
        """
        self._send({"bus_load": bus_load})

    def look(self, look: QuickLook) -> None:
        """Publish a look at the gains, with the next samples. Any thread may call this."""
        self._looks.append(look)

    def finish(self) -> None:
        """Publish the result of the run, whose log is complete."""
        self._flush()
        found = self._statistics()
        self._result = {"valid": found.valid, "reason": found.reason, "samples": found.samples}
        self._send({"result": self._result})

    def _flush(self) -> None:
        self._publish_look()
        if not self._packed:
            return
        packed = self._packed
        self._packed = []
        self._send_to_all(SAMPLES, b"".join(packed), len(packed))

    def _publish_look(self) -> None:
        """Send the newest look, if there is one; the thread that sends all packets calls this."""
        with suppress(IndexError):
            self._quick = asdict(self._looks.pop())
            self._send({"quick": self._quick})

    def _send(self, message: dict[str, Any]) -> None:
        self._send_to_all(TEXT, json.dumps(message).encode(), 0)

    def _send_to_all(self, kind: int, content: bytes, samples: int) -> None:
        # Consoles that came meanwhile first get what they missed; all packets are sent by this
        # thread alone.
        while self._new:
            if len(self._consoles) >= LARGEST_CONSOLES:
                self._new.popleft().close()
                continue
            fresh = self._new.popleft()
            self._consoles.append(fresh)
            if self._run is not None:
                past = {
                    "run": asdict(self._run),
                    "events": list(self._events),
                    "quick": self._quick,
                    "result": self._result,
                }
                self._put(fresh, self._head(TEXT, 0) + json.dumps(past).encode())
        self._number += 1
        if self._consoles:
            packet = self._head(kind, samples) + content
        else:
            packet = b""
        for console in tuple(self._consoles):
            self._put(console, packet)

    def _head(self, kind: int, samples: int) -> bytes:
        so_far = self._statistics()
        return HEAD.pack(
            kind, self._number, so_far.samples, so_far.lost_cycles, sum(so_far.missing), samples
        )

    def _put(self, console: socket.socket, packet: bytes) -> None:
        try:
            console.send(packet, socket.MSG_DONTWAIT)
        except BlockingIOError:
            pass  # it does not read; the numbers of the packets show the gap
        except OSError:
            with suppress(ValueError):
                self._consoles.remove(console)
            console.close()

    def _wait(self, selector: selectors.BaseSelector) -> None:
        """Accept consoles and stops until the listeners are shut down."""
        # Clients of the stop that have not asked yet are waited for all at once: a silent one
        # delays no other.
        asking: deque[socket.socket] = deque()
        with ExitStack() as closing:
            closing.enter_context(selector)
            for listener in self._listening:
                closing.enter_context(listener)
                selector.register(listener, selectors.EVENT_READ)
            while True:
                for key, _ in selector.select():
                    ready = key.fileobj
                    assert isinstance(ready, socket.socket)
                    if ready in asking:
                        asking.remove(ready)
                        selector.unregister(ready)
                        self._take_stop(ready)
                        continue
                    try:
                        connection, _ = ready.accept()
                    except OSError:
                        # No descriptor is free, or the client is gone: the next one, and a stop,
                        # must be served still.
                        if not self._ended.wait(ACCEPT_AGAIN_S):
                            continue
                        for silent in asking:
                            silent.close()
                        return
                    if not of_this_user(connection):
                        connection.close()
                    elif ready is self._listening[0]:
                        with suppress(OSError):
                            connection.setsockopt(
                                socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES
                            )
                        self._new.append(connection)
                    else:
                        asking.append(connection)
                        selector.register(connection, selectors.EVENT_READ)
                while len(asking) > LARGEST_CONSOLES:  # the one that has been silent for longest
                    silent = asking.popleft()
                    selector.unregister(silent)
                    silent.close()

    def _take_stop(self, connection: socket.socket) -> None:
        try:
            if self._stop is None or connection.recv(len(STOP), socket.MSG_DONTWAIT) != STOP:
                connection.close()
                return
            self._stop()
            # It receives the outcome of the stop when the program ends.
            self._stopping.append(connection)
            connection.send(ACCEPTED, socket.MSG_DONTWAIT)
        except OSError:
            connection.close()


SHOWN = (f"{WHILE}stopping", POWERED)  #: Notes of an error that a console shows


def end_of(error: BaseException | None) -> dict[str, Any]:
    """Describe how a program ended: whether all axes are known to be stopped,
    and the error in words.

    It never raises: it describes the error that a stop was made for, and must not take its place.
    """
    notes = [note for note in stop_notes(error) if note.startswith(SHOWN)]
    parts = notes if error is None else [_in_words(error), *notes]
    return {
        "ok": error is None,
        "axes_stopped": not any(note.startswith(POWERED) for note in notes),
        "text": "; ".join(parts),
    }


def _in_words(error: BaseException) -> str:
    """Return the text of an error, or what it is where it has none."""
    if isinstance(error, KeyboardInterrupt):
        usual = "stopped"
    else:
        usual = type(error).__name__
    return text_of(error) or usual
