"""The cell as a console knows it now: curves, states, events and losses, as the feed brings them; and the stop."""

from __future__ import annotations

import asyncio
import json
import re
import shutil
import socket
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise
from math import nan
from pathlib import Path
from typing import Any

import numpy as np

from daq.config.cell import Cell
from daq.console.prediction import Predictor
from daq.errors import DaqError
from daq.log.conversion import SiScaling
from daq.report.bus import ENABLED, FAULTY
from daq.workflow.feed import (
    ACCEPTED,
    HEAD,
    LARGEST_PACKET,
    SAMPLES,
    STOP,
    of_this_user,
    sample_dtype,
    socket_names,
)
from drivers.canopen.emcy import remedy_of
from drivers.profiles.cia402 import decode
from drivers.stream.sample import EventKind
from ident.arrays import FloatArray
from ident.calibration import Calibration
from ident.errors import IdentificationError

POINTS_HZ = 50.0  #: Points a second of the curves, in the time of the samples
KEPT_POINTS = 6000  #: Two minutes
KEPT_EVENTS = 500
DISK_S = 1.0  #: Time between two looks at the free space of the disk
READ_S = 0.03  #: Time between two looks at the feed
LARGEST_TURN = 100  #: Packets at one look; requests are answered between two
RETRY_S = 0.5  #: Time between two tries to find a feed
STOP_ACCEPTED_S = 3.0  #: Time for the recorder's answer to a stop
STOP_ENDED_S = 60.0  #: Time until the recorder must have ended

GONE = (
    "the recorder is gone without a word: it was killed or has crashed. The amplifiers stop by themselves where they "
    "supervise its heartbeat (1016h); look at the robot, and use the emergency stop if it moves"
)
REMEDIES = {
    EventKind.HEARTBEAT_LOST: "check the drive's power and its cable; `drivegain scan` shows which nodes answer",
    EventKind.FOLLOWING_ERROR: "check brake, load and collision; use slower moves (`record --speed 0.5`)",
    EventKind.LIMIT: "check limit switches and current limits, or use slower moves",
    EventKind.SAMPLE_LOST: "check the load of bus and computer; the run is marked invalid, record it again",
    EventKind.BUS_BUSY: "end the other program on this bus",
    EventKind.BUS_LOST: "check the CAN interface and its cable",
    EventKind.BUS_PASSIVE: "check the bus's cable and its two terminating resistors",
    EventKind.FRAMES_DROPPED: "reduce the load of this computer; the run is marked invalid, record it again",
    EventKind.SYNC_LOST: "check the device that produces SYNC",
    EventKind.PDO_LENGTH: "did another program change the mapping, or does another device use this identifier?",
    EventKind.FROZEN: "check the encoder and the motor cable; restart the drive",
    EventKind.STOP_UNCONFIRMED: "look at this axis; use the emergency stop if it moves",
}
ALARMING = frozenset(REMEDIES) | {EventKind.EMCY}


class Ring:
    """The last entries of a growing list; readers keep the number of the next entry that they have not seen."""

    def __init__(self, kept: int) -> None:
        self.end = 0  #: Number of entries ever
        self._entries: deque[Any] = deque(maxlen=kept)

    def add(self, entries: Sequence[Any]) -> None:
        """Append entries; the oldest are forgotten."""
        self._entries.extend(entries)
        self.end += len(entries)

    def since(self, seen: int) -> list[Any]:
        """Return what is kept of the entries from that number on."""
        new = min(self.end - seen, len(self._entries))
        return [] if new <= 0 else [self._entries[index] for index in range(-new, 0)]


class Live:
    """The cell as the feed shows it. All of it runs in one event loop."""

    def __init__(self, cell_file: Path, cell: Cell) -> None:
        self.cell = cell
        self.calibration: Calibration | None = None
        self.epoch = 0  #: Number of the run; readers begin anew when it changes
        self.run: dict[str, Any] | None = None  #: Facts of the run, as in the feed
        self.phase = "waiting"  #: waiting, running or ended
        self.end: dict[str, Any] | None = None  #: How the program ended
        self.stop_state: dict[str, Any] | None = None  #: Of the last stop
        self.remark = ""  #: Why there is no prediction
        self._file = cell_file
        self._tasks: set[asyncio.Task[None]] = set()
        self._clear(None)

    def _clear(self, run: dict[str, Any] | None) -> None:
        self.epoch += 1
        self.run, self.result, self.end, self.remark = run, None, None, ""
        self.points, self.rows, self.events = Ring(KEPT_POINTS), Ring(KEPT_POINTS), Ring(KEPT_EVENTS)
        self.samples = self.lost = self.missing = self.dropped = self.done = 0
        self._number: int | None = None
        self._last: Any = None
        self._words = [0] * len(self.cell.axes)
        self._origin_ns: int | None = None
        self._predictor: Predictor | None = None
        self._band = [nan] * len(self.cell.axes)
        self._rate: deque[tuple[float, int]] = deque(maxlen=50)
        self._free: int | None = None
        self._free_s = -DISK_S
        self._every = 1
        if run is None:
            return
        self._every = max(1, round(run["rate_hz"] / POINTS_HZ))
        self._dtype = sample_dtype(len(run["axes"]))
        arrays = (np.array(run[key]) for key in ("rad_per_count", "to_joint", "offset_rad", "current_per_unit"))
        self._scale = SiScaling(*arrays)
        self._unit = np.array([axis.unit.si for axis in self.cell.axes])
        if tuple(run["axes"]) != self.cell.axis_names:
            self.remark = "the run has other axes than the cell file: restart the console"
        elif self.calibration is not None:
            payload = next((one.payload for one in self.cell.payloads if one.name == run["payload"]), None)
            try:
                self._predictor = Predictor(self.calibration, self.cell, payload, run["rate_hz"])
                self.remark = self._predictor.problem
            except (DaqError, IdentificationError) as error:
                self.remark = f"no prediction: {error}"

    def take(self, packet: bytes) -> None:
        """Process one packet of the feed."""
        kind, number, samples, lost, missing, count = HEAD.unpack_from(packet)
        content = packet[HEAD.size :]
        if kind != SAMPLES:
            self._take_text(json.loads(content))
        if self._number is not None and number > self._number:
            self.dropped += number - self._number - 1
        self._number = number
        self.samples, self.lost, self.missing = samples, lost, missing
        self._rate.append((time.monotonic(), samples))
        if kind == SAMPLES and count and self.run is not None:
            self._take_samples(np.frombuffer(content, self._dtype, count))

    def _take_text(self, message: dict[str, Any]) -> None:
        if message.get("run") is not None:
            before = self._number
            self._clear(message["run"])
            self.phase, self._number = "running", before
        self.events.add([self._shown(event) for event in message.get("events", ())])
        if message.get("result") is not None:
            self.result = message["result"]
        if message.get("end") is not None:
            self.phase, self.end = "ended", message["end"]

    def _shown(self, event: dict[str, Any]) -> dict[str, Any]:
        """Return an event for the page: time since the start of the run, axis by name, and the remedy."""
        if self._origin_ns is None:
            self._origin_ns = event["time_ns"]
        kind = EventKind(event["kind"])
        if kind is EventKind.MOVE_END:
            self.done = max(self.done, event["code"] + 1)
        if kind is EventKind.STATE and event["axis"] is not None:
            # The stop after a fault has no samples, but its states are events.
            self._words[event["axis"]] = event["code"]
        axis = None if event["axis"] is None else self.cell.axis_names[event["axis"]]
        remedy = remedy_of(event["code"]) if kind is EventKind.EMCY else REMEDIES.get(kind, "")
        # The axis is shown beside the text.
        text = event["text"] if axis is None else re.sub(rf"^{re.escape(axis)}( \(node \d+\))?: ", "", event["text"])
        time_s = 1e-9 * (event["time_ns"] - self._origin_ns)
        return {
            **{"time_s": round(time_s, 6), "axis": axis, "kind": kind.value, "text": text},
            **{"remedy": remedy, "alarm": kind in ALARMING},
        }

    def _take_samples(self, samples: Any) -> None:
        if self._origin_ns is None:
            self._origin_ns = int(samples["time_ns"][0])
        position = self._scale.joint_position(samples["position_counts"].astype(np.int64))
        current = samples["current_raw"] * self._scale.current_per_unit
        shown = samples["cycle"] % self._every == 0
        times = 1e-9 * (samples["time_ns"] - self._origin_ns)
        self.points.add(np.column_stack((times, position / self._unit, current))[shown].tolist())
        self._last, self._words = samples[-1], samples[-1]["statusword"].tolist()
        if self._predictor is not None and not self.remark:
            self._predict(samples, position, current, float(times[-1]))

    def _predict(self, samples: Any, position: FloatArray, current: FloatArray, last_s: float) -> None:
        assert self._predictor is not None and self.run is not None
        last = int(samples["cycle"][-1])
        gaps = np.flatnonzero(np.diff(samples["cycle"].astype(np.int64)) != 1) + 1
        edges = [0, *gaps.tolist(), len(samples)]
        try:
            for begin, end in pairwise(edges):
                first = int(samples["cycle"][begin])
                rows = self._predictor.take(first, position[begin:end], current[begin:end])
                if rows is not None:
                    times = last_s - (last - rows.cycle) / self.run["rate_hz"]
                    self.rows.add(np.column_stack((times, rows.predicted, rows.residual)).tolist())
                    self._band = rows.band.tolist()
        except IdentificationError as error:
            self.remark = f"no prediction: {error}"

    def status(self) -> dict[str, Any]:
        """Return everything that is shown as a number or a word."""
        share = 0.0 if self.run is None else self.rate_hz / self.run["rate_hz"]
        return {
            "phase": self.phase,
            "axes": [] if self._last is None else self._axes(self._last),
            **{"samples": self.samples, "lost": self.lost, "missing": self.missing, "dropped": self.dropped},
            "rate_hz": round(self.rate_hz, 1),
            "moves": 0 if self.run is None else self.run["moves"],
            "done": self.done,
            "bus_load": {} if self.run is None else {bus: share * load for bus, load in self.run["bus_load"].items()},
            "free_bytes": self._free_bytes(),
            "band": self._band,
            **{"remark": self.remark, "result": self.result, "end": self.end, "stop": self.stop_state},
        }

    def _axes(self, last: Any) -> list[dict[str, Any]]:
        position = self._scale.joint_position(last["position_counts"].astype(np.int64)) / self._unit
        current = last["current_raw"] * self._scale.current_per_unit
        return [
            {
                "state": str(state := decode(word)),
                "power": state in ENABLED,
                "fault": state in FAULTY,
                "silent": bool(int(last["missing"]) >> index & 1),
                "position": float(position[index]),
                "current": float(current[index]),
            }
            for index, word in enumerate(self._words)
        ]

    @property
    def rate_hz(self) -> float:
        """Samples a second by this computer's clock, over the last packets."""
        if len(self._rate) < 2 or self.phase != "running":
            return 0.0
        (begin_s, first), (end_s, last) = self._rate[0], self._rate[-1]
        return (last - first) / max(end_s - begin_s, 1e-3)

    def _free_bytes(self) -> int | None:
        if self.run is not None and time.monotonic() - self._free_s > DISK_S:
            self._free, self._free_s = None, time.monotonic()
            with suppress(OSError):
                self._free = shutil.disk_usage(Path(self.run["log"]).parent).free
        return self._free

    async def follow(self) -> None:
        """Follow the recorders of the cell, one after the other, for ever."""
        while True:
            connection = _connected(socket_names(self._file)[0], socket.SOCK_SEQPACKET, 0.0)
            if connection is not None:
                with connection:
                    await self._read(connection)
            await asyncio.sleep(RETRY_S)

    async def _read(self, connection: socket.socket) -> None:
        """Take what has come, READ_S after READ_S: waiting for each packet would cost as much as taking it."""
        self._clear(None)
        self.phase = "running"
        with suppress(OSError):
            while True:
                for _ in range(LARGEST_TURN):
                    try:
                        packet = connection.recv(LARGEST_PACKET)
                    except BlockingIOError:
                        break
                    if not packet:
                        raise ConnectionResetError
                    self.take(packet)
                await asyncio.sleep(READ_S)
        if self.phase == "running":
            self.phase, self.end = "ended", {"ok": False, "axes_stopped": False, "text": GONE}

    async def stop(self) -> dict[str, Any]:
        """Ask the recorder to stop its axes, and return its answer; how it ended comes later, in `stop_state`."""
        asked = time.strftime("%H:%M:%S")
        place = socket_names(self._file)[1]
        connection = await asyncio.to_thread(_connected, place, socket.SOCK_STREAM, STOP_ACCEPTED_S)
        answer = b"" if connection is None else await asyncio.to_thread(_ask, connection)
        if connection is None or answer != ACCEPTED:
            found = "no recorder of this cell runs" if connection is None else "the recorder did not answer"
            text = f"{found}; if the robot moves, use the emergency stop"
            self.stop_state = {"accepted": False, "at": asked, "text": text}
            return self.stop_state
        self.stop_state = {"accepted": True, "at": asked, "text": "the recorder stops the axes"}
        task = asyncio.create_task(self._await_end(connection, asked))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return self.stop_state

    async def _await_end(self, connection: socket.socket, asked: str) -> None:
        connection.settimeout(STOP_ENDED_S)
        ended: dict[str, Any] = {}
        with connection, suppress(OSError, ValueError):
            ended = json.loads(await asyncio.to_thread(connection.recv, LARGEST_PACKET))
        sure = bool(ended.get("axes_stopped"))
        text = "the recorder has ended, its axes are stopped" if sure else f"NOT CONFIRMED: {ended.get('text', GONE)}"
        self.stop_state = {"accepted": True, "at": asked, "text": text, "axes_stopped": sure}


def _connected(name: str, kind: int, timeout_s: float) -> socket.socket | None:
    """Connect to a socket of a program of this user; None where there is none."""
    connection = socket.socket(socket.AF_UNIX, kind)
    connection.settimeout(timeout_s)
    with suppress(OSError):
        connection.connect(name)
        if of_this_user(connection):
            return connection
    connection.close()
    return None


def _ask(connection: socket.socket) -> bytes:
    with suppress(OSError):
        connection.sendall(STOP)
        return connection.recv(len(ACCEPTED), socket.MSG_WAITALL)
    return b""
