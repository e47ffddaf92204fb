"""The cell as a console knows it now: curves, states, events and losses, as the feed brings them;
and the stop.
"""

from __future__ import annotations

import asyncio
import json
import shutil
import socket
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict
from math import nan
from pathlib import Path
from typing import Any

import numpy as np

from daq.config.cell import Cell, PacingMode
from daq.log.feed import (
    ACCEPTED,
    LARGEST_PACKET,
    STOP,
    FeedUnfit,
    Message,
    ProgramEnd,
    RunFacts,
    connected,
    read_packet,
    socket_names,
)
from daq.workflow.events import notice_of
from daq.workflow.live_prediction import Predictor, predictor_of
from drivers.messages import CellEvent, EventKind
from drivers.profiles.cia402 import ENABLED, FAULTY, decode
from ident.arrays import FloatArray
from ident.calibration import Calibration
from ident.errors import IdentificationError

POINTS_HZ = 50.0  #: Points a second of the curves, in the time of the samples
KEPT_POINTS = 6000  #: Two minutes
KEPT_EVENTS = 500
DISK_S = 1.0  #: Time between two looks at the free space of the disk
READ_S = 0.03  #: Time between two looks at the feed
LARGEST_TURN = 100  #: Packets at one look; requests are answered between two
RATE_S = 0.1  #: Shortest time over which a rate of samples is taken
RETRY_S = 0.5  #: Time between two tries to find a feed
#: Silence after which values are old; readings of a monitor are rare
OLD_S = {"running": 2.0, "watching": 65.0}
STOP_ACCEPTED_S = 3.0  #: Time for the recorder's answer to a stop
STOP_ENDED_S = 60.0  #: Time until the recorder must have ended

GONE = (
    "the recorder is gone without a word: it was killed or has crashed. The amplifiers stop by "
    "themselves where they supervise its heartbeat (1016h); look at the robot, and use the "
    "emergency stop if it moves"
)
HANGS = (
    "The recorder is held, or waits for disk or bus; the amplifiers stop by themselves where they "
    "supervise its heartbeat (1016h). If the robot moves, use the emergency stop"
)
UNKNOWN = "this page could not follow the recorder, and does not know how it ended"


class Ring:
    """The last entries of a growing list; readers keep the number of the next entry that they have
    not seen.
    """

    def __init__(self, size: int) -> None:
        self.end = 0  #: Number of entries ever
        self._entries: deque[Any] = deque(maxlen=size)

    def add(self, entries: Sequence[Any]) -> None:
        """Append entries; the oldest are forgotten."""
        self._entries.extend(entries)
        self.end += len(entries)

    def since(self, seen: int) -> list[Any]:
        """Return the entries from that number on, without those that were forgotten."""
        new = min(self.end - seen, len(self._entries))
        if new <= 0:
            return []
        return [self._entries[index] for index in range(-new, 0)]


class Reader:
    """Remembers the place of one reader in the curves."""

    def __init__(self, live: Live) -> None:
        self._live = live
        self._epoch = -1
        self._seen = [0, 0, 0]

    def news(self) -> tuple[bool, dict[str, list[Any]]]:
        """Return whether another run has begun, and the new points, rows and events."""
        live = self._live
        begun = self._epoch != self._live.epoch
        if begun:
            self._epoch = live.epoch
            self._seen = [0, 0, 0]
        found = {}
        rings = {"points": live.points, "rows": live.rows, "events": live.events}
        for place, (name, ring) in enumerate(rings.items()):
            new = ring.since(self._seen[place])
            if new:
                found[name] = new
            self._seen[place] = ring.end
        return begun, found


class Live:
    """The cell as the feed shows it. All of it runs in one event loop."""

    def __init__(
        self, cell_file: Path, cell: Cell, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.cell = cell
        self._clock = clock  # [s]
        self.calibration: Calibration | None = None
        self.epoch = 0  #: Number of the run; readers begin again when it changes
        self.run: RunFacts | None = None
        self.phase = "waiting"  #: Also running (a recorder), watching (a monitor) and ended
        self.end: dict[str, Any] | None = None  #: How the program ended
        self.stop_state: dict[str, Any] | None = None  #: Of the last stop
        self.remark = ""  #: Why there is no prediction
        self.failed = ""  #: What of this console has ended before it should
        self._unfit = ""  # why the feed cannot be shown
        self._recorder = 0  # number of the recorder that is followed
        self._file = cell_file
        self._tasks: set[asyncio.Task[None]] = set()
        self.result: dict[str, Any] | None = None
        self.quick: dict[str, Any] | None = None  #: Quick estimate of the gains after the last move
        self._clear("waiting", None)

    def _clear(self, phase: str, run: RunFacts | None) -> None:
        self.epoch += 1
        self.phase = phase
        self.run = run
        self.remark = ""
        self._unfit = ""
        if phase != "watching":  # how the last recording ended stays on the page
            self.result = self.end = self.quick = None
        self.points = Ring(KEPT_POINTS)
        self.rows = Ring(KEPT_POINTS)
        self.events = Ring(KEPT_EVENTS)
        self.samples = self.lost = self.missing = self.dropped = self.done = 0
        self._number: int | None = None
        self._last: Any = None
        self._words = [0] * len(self.cell.axes)
        self.origin_ns: int | None = None  #: Time of the points' zero [ns since 1970]
        self._predictor: Predictor | None = None
        self._band = [nan] * len(self.cell.axes)
        self._rate: deque[tuple[float, int]] = deque(maxlen=50)
        self._measured: dict[str, float] = {}  # load of the buses, by a monitor
        self._came_s = self._clock()  # when the last packet came
        self._free: int | None = None
        self._free_s = -DISK_S
        self._every = 1
        if run is None:
            return
        self._every = max(1, round(run.rate_hz / POINTS_HZ))
        self._scale = run.scaling
        self._unit = np.array([axis.unit.si for axis in self.cell.axes])
        if self.calibration is not None:
            self._predictor, self.remark = predictor_of(self.calibration, self.cell, run)

    def take(self, packet: bytes) -> None:
        """Process one packet of the feed.

        Raises:
            FeedUnfit: this version does not understand it, or its run has other axes than the cell.
        """
        found = read_packet(packet, len(self.cell.axes))
        if found.message is not None:
            self._take_message(found.message)
        self._came_s = self._clock()
        if self._number is not None and found.number > self._number:
            self.dropped += found.number - self._number - 1
        self._number = found.number
        self.samples = found.samples
        self.lost = found.lost
        self.missing = found.missing
        self._rate.append((self._came_s, found.samples))
        if found.rows is not None and self.run is not None:
            self._take_samples(found.rows)

    def _take_message(self, message: Message) -> None:
        run = message.run
        if run is not None:
            if run.axes != self.cell.axis_names:
                raise FeedUnfit("its cell file has other axes than this console's")
            before = self._number
            self._clear("watching" if run.log is None else "running", run)
            self._number = before
        self.events.add([self._shown(event) for event in message.events])
        if message.bus_load is not None:
            self._measured = message.bus_load
        if message.quick is not None:
            self.quick = asdict(message.quick)
        if message.result is not None:
            self.result = asdict(message.result)
        if message.end is not None:
            self._finish(message.end)

    def _finish(self, end: ProgramEnd) -> None:
        if self.phase != "watching":  # a monitor's end says nothing of the axes
            self.end = asdict(end)
        self.phase = "ended"
        self._unfit = ""

    def _shown(self, event: CellEvent) -> dict[str, Any]:
        """Return an event for the page: time since the start of the run, axis by name,
        and the remedy.
        """
        if self.origin_ns is None:
            self.origin_ns = event.time_ns
        if event.kind is EventKind.MOVE_END:
            self.done = max(self.done, event.code + 1)
        if event.kind is EventKind.STATE and event.axis is not None:
            # The stop after a fault has no samples, but its states are events.
            self._words[event.axis] = event.code
        axis = None
        if event.axis is not None:
            axis = self.cell.axis_names[event.axis]
        time_s = 1e-9 * (event.time_ns - self.origin_ns)
        notice = notice_of(event.kind, event.code, axis, event.text)
        return {"time_s": round(time_s, 6), **asdict(notice)}

    def _take_samples(self, samples: Any) -> None:
        if self.origin_ns is None:
            self.origin_ns = int(samples["time_ns"][0])
        position = self._scale.joint_position(samples["position_counts"].astype(np.int64))
        current = samples["current_raw"] * self._scale.current_per_unit
        shown = samples["cycle"] % self._every == 0
        times = 1e-9 * (samples["time_ns"] - self.origin_ns)
        points = np.column_stack((times, position / self._unit, current))
        self.points.add(points[shown].tolist())
        self._last = samples[-1]
        self._words = samples[-1]["statusword"].tolist()
        if self._predictor is not None and not self.remark:
            self._predict(samples, position, current, float(times[-1]))

    def _predict(
        self, samples: Any, position: FloatArray, current: FloatArray, last_s: float
    ) -> None:
        assert self._predictor is not None and self.run is not None
        cycle = samples["cycle"].astype(np.int64)
        complete = samples["missing"] == 0
        try:
            for rows in self._predictor.take(
                cycle[complete], position[complete], current[complete]
            ):
                cycles_ago = cycle[-1] - rows.cycle
                times = last_s - cycles_ago / self.run.rate_hz
                curves = np.column_stack((times, rows.predicted, rows.residual))
                self.rows.add(curves.tolist())
                self._band = rows.band.tolist()
        except IdentificationError as error:
            self.remark = f"no prediction: {error}"

    def status(self) -> dict[str, Any]:
        """Return everything that is shown as a number or a word."""
        computed: dict[str, float] = {}
        share = 0.0
        if self.run is not None and not self._is_simulated:
            computed = self.run.bus_load
            share = self.rate_hz / self.run.rate_hz
        axes = []
        if self._last is not None:
            axes = self._axes(self._last)
        moves = 0
        if self.run is not None:
            moves = self.run.moves
        bus_load = self._measured
        if not bus_load:
            bus_load = {bus: share * load for bus, load in computed.items()}
        old = bool(self._silent_s) or bool(self.failed)
        return {
            "phase": self.phase,
            "axes": axes,
            "samples": self.samples,
            "lost": self.lost,
            "missing": self.missing,
            "dropped": self.dropped,
            "rate_hz": round(self._shown_rate_hz, 1),
            "simulated": self._is_simulated,
            "moves": moves,
            "done": self.done,
            "bus_load": bus_load,
            "free_bytes": self._free_bytes(),
            "band": self._band,
            "alarm": self._alarm(),
            "old": old,
            "remark": self.remark,
            "result": self.result,
            "end": self.end,
            "stop": self.stop_state,
            "quick": self.quick,
        }

    def _alarm(self) -> str:
        """Return why this page does not show the cell as it is now; empty where it does."""
        if self.failed or self._unfit or not self._silent_s:
            return self.failed or self._unfit
        said = f"Nothing has come for {self._silent_s} s; states and values below are of that time"
        if self.phase == "running":
            return f"{said}. {HANGS}"
        return said

    @property
    def _silent_s(self) -> int:
        """Time since the last packet of a run that is under way [s]; 0 where no packet is late."""
        if not self.samples or self.result is not None or self.phase not in OLD_S:
            return 0  # before the first sample and between two runs there is nothing to send
        silent_s = self._clock() - self._came_s
        if silent_s > OLD_S[self.phase]:
            return int(silent_s)
        return 0

    def _axes(self, last: Any) -> list[dict[str, Any]]:
        counts = last["position_counts"].astype(np.int64)
        position = self._scale.joint_position(counts) / self._unit
        current = last["current_raw"] * self._scale.current_per_unit
        missing = int(last["missing"])
        axes = []
        for index, word in enumerate(self._words):
            state = decode(word)
            axis = {
                "state": str(state),
                "power": state in ENABLED,
                "fault": state in FAULTY,
                "silent": bool(missing >> index & 1),
                "position": float(position[index]),
                "current": float(current[index]),
            }
            axes.append(axis)
        return axes

    @property
    def rate_hz(self) -> float:
        """Samples a second by this computer's clock, over the last packets."""
        if len(self._rate) < 2 or self._silent_s:
            return 0.0
        if self.phase not in ("running", "watching"):
            return 0.0
        begin_s, first = self._rate[0]
        end_s, last = self._rate[-1]
        duration_s = end_s - begin_s
        if duration_s < RATE_S:
            return 0.0  # packets that wait for the page arrive together
        return (last - first) / duration_s

    @property
    def _is_simulated(self) -> bool:
        """Whether the cell runs in lockstep: as fast as its computer can, in simulated time,
        on no real bus.
        """
        return self.cell.sync is not None and self.cell.sync.pacing is PacingMode.LOCKSTEP

    @property
    def _shown_rate_hz(self) -> float:
        """Samples a second of the cell's own time; 0 where none come."""
        if self._is_simulated and self.run is not None and self.rate_hz > 0.0:
            return self.run.rate_hz
        return self.rate_hz

    def _free_bytes(self) -> int | None:
        if self.run is None or self.run.log is None:
            return self._free
        now_s = time.monotonic()
        if now_s - self._free_s > DISK_S:
            self._free = None
            self._free_s = now_s
            with suppress(OSError):
                disk = shutil.disk_usage(Path(self.run.log).parent)
                self._free = disk.free
        return self._free

    async def follow(self) -> None:
        """Follow the recorders of the cell, one after the other, for ever,
        and a monitor while there is none.
        """
        names = socket_names(self._file)
        while True:
            for name, phase in ((names.feed, "running"), (names.monitor, "watching")):
                connection = connected(name, socket.SOCK_SEQPACKET, 0.0)
                if connection is not None:
                    with connection:
                        await self._read(connection, phase)
                    break
            else:
                if self._unfit:
                    self._finish(ProgramEnd(ok=False, axes_stopped=False, text=UNKNOWN))
            await asyncio.sleep(RETRY_S)

    async def _read(self, connection: socket.socket, phase: str) -> None:
        """Follow one program until it ends, or until it sends what does not fit:
        `follow` then tries again.
        """
        if not (self._unfit and self.phase == phase):  # else it is the same program again
            self._clear(phase, None)
            if phase == "running":
                self._recorder += 1
                self.stop_state = None  # it was asked of another recorder
        try:
            with suppress(OSError):
                await self._take_all(connection, phase)
                return
        except FeedUnfit as error:
            self._refuse(phase, error)
            return
        if self.phase != "ended":
            self._finish(ProgramEnd(ok=False, axes_stopped=False, text=GONE))

    def _refuse(self, phase: str, error: FeedUnfit) -> None:
        if not self._unfit:
            self._clear(phase, None)
        program = "monitor"
        if phase == "running":
            program = "recorder"
        self._unfit = (
            f"This page cannot show the {program}: {error}. Restart the console, with "
            "the same drivegain"
        )

    async def _take_all(self, connection: socket.socket, phase: str) -> None:
        """Take what has come every READ_S: waiting for each packet would cost as much as taking it.

        Returns when a monitor is left because a recorder begins.

        Raises:
            OSError: the program has ended.
            FeedUnfit: see `take`.
        """
        looked_s = self._clock()
        while True:
            if phase == "watching" and self._clock() - looked_s > RETRY_S:
                looked_s = self._clock()
                recorder = connected(socket_names(self._file).feed, socket.SOCK_SEQPACKET, 0.0)
                if recorder is not None:
                    with recorder:
                        await self._read(recorder, "running")
                    return
            for _ in range(LARGEST_TURN):
                try:
                    packet = connection.recv(LARGEST_PACKET)
                except BlockingIOError:
                    break
                if not packet:
                    raise ConnectionResetError
                self.take(packet)
            await asyncio.sleep(READ_S)

    async def stop(self) -> dict[str, Any]:
        """Ask the recorder to stop its axes, and return its answer;
        how it ended comes later, in `stop_state`.
        """
        asked = time.strftime("%H:%M:%S")
        place = socket_names(self._file).stop
        recorder = self._recorder
        connection = await asyncio.to_thread(connected, place, socket.SOCK_STREAM, STOP_ACCEPTED_S)
        answer = b""
        if connection is not None:
            answer = await asyncio.to_thread(_ask, connection)
        if connection is None or answer != ACCEPTED:
            found = "this console reaches no recorder of this cell"
            if connection:
                found = "the recorder did not answer"
            text = f"{found}; if the robot moves, use the emergency stop"
            self.stop_state = {"accepted": False, "at": asked, "text": text}
            return self.stop_state
        text = "the recorder stops the axes"
        self.stop_state = {"accepted": True, "at": asked, "text": text}
        end = self._await_end(connection, asked, recorder)
        task = asyncio.create_task(end)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return self.stop_state

    def _note_stop(self, state: dict[str, Any], recorder: int) -> None:
        if recorder == self._recorder:  # the next one may move its axes already
            self.stop_state = state

    async def _await_end(self, connection: socket.socket, asked: str, recorder: int) -> None:
        connection.settimeout(STOP_ENDED_S)
        ended: dict[str, Any] = {}
        with connection, suppress(OSError, ValueError):
            packet = await asyncio.to_thread(connection.recv, LARGEST_PACKET)
            ended = json.loads(packet)
        is_stopped = bool(ended.get("axes_stopped"))
        text = "the recorder has ended, its axes are stopped"
        if not is_stopped:
            text = f"NOT CONFIRMED: {ended.get('text', GONE)}"
        state = {"accepted": True, "at": asked, "text": text, "axes_stopped": is_stopped}
        self._note_stop(state, recorder)


def _ask(connection: socket.socket) -> bytes:
    with suppress(OSError):
        connection.sendall(STOP)
        return connection.recv(len(ACCEPTED), socket.MSG_WAITALL)
    return b""
