"""The curves as a stream for Foxglove, which shows them live next to its 3-D view of the arm.

The topics are those of a log: `/joint_states`, `/cell/currents`, `/cell/events` and
`/robot_description`; with a calibration also `/cell/predicted` and `/cell/residual`, which a log
does not have. The layout in `configs/viewers` serves both: panels of `/cell/samples`, raw numbers
that only a log has, stay empty here. Values come at the rate of the page's curves; a velocity is
the mean since the value before. The stream can only be read. It has no token: the protocol of
Foxglove knows none, and its server accepts any origin, so that every program and every page on this
computer can read it.
"""

from __future__ import annotations

import asyncio
import time
from typing import Any

import foxglove
import numpy as np

from daq.config.cell import joint_names
from daq.console.live import Live, Reader
from daq.log.bag_writer import joint_effort
from daq.log.message import (
    CURRENTS_SCHEMA,
    CURRENTS_TOPIC,
    DEFINITIONS,
    EVENTS_TOPIC,
    JOINTS_TOPIC,
    SCHEMA_OF,
    URDF_TOPIC,
    currents_bytes,
    event_bytes,
    joint_state_bytes,
    joint_state_prefix,
    text_bytes,
)
from drivers.messages import CellEvent, EventKind
from ident.arrays import FloatArray

PREDICTED_TOPIC = "/cell/predicted"
RESIDUAL_TOPIC = "/cell/residual"
SCHEMAS = {
    JOINTS_TOPIC: SCHEMA_OF[JOINTS_TOPIC],
    CURRENTS_TOPIC: SCHEMA_OF[CURRENTS_TOPIC],
    EVENTS_TOPIC: SCHEMA_OF[EVENTS_TOPIC],
    URDF_TOPIC: SCHEMA_OF[URDF_TOPIC],
    PREDICTED_TOPIC: CURRENTS_SCHEMA,
    RESIDUAL_TOPIC: CURRENTS_SCHEMA,
}
TICK_S = 0.04  #: Time between two looks at the curves
URDF_S = 2.0  #: Time between two messages with the URDF, for clients that come late


class FoxgloveStream:
    """Serves the curves of a console on 127.0.0.1 until it is stopped."""

    def __init__(self, live: Live, port: int) -> None:
        """Begin to listen; port 0 takes a free one.

        Raises:
            RuntimeError: the port is taken.
        """
        self._live = live
        self._context = foxglove.Context()
        self._prefix = joint_state_prefix(joint_names(live.cell))
        self._unit = np.array([axis.unit.si for axis in live.cell.axes])
        self._before: tuple[float, FloatArray] | None = None  # time and position of the last point
        # Without capabilities a client can neither publish nor set anything.
        self._server = foxglove.start_server(
            name=f"drivegain {live.cell.name}",
            host="127.0.0.1",
            port=port,
            capabilities=[],
            context=self._context,
        )
        self._channels = {}
        for topic, schema in SCHEMAS.items():
            self._channels[topic] = self._channel(topic, schema)

    def _channel(self, topic: str, schema: str) -> foxglove.Channel:
        definition = DEFINITIONS[schema].encode()
        return foxglove.Channel(
            topic,
            message_encoding="cdr",
            schema=foxglove.Schema(name=schema, encoding="ros2msg", data=definition),
            context=self._context,
        )

    @property
    def port(self) -> int:
        """Port on 127.0.0.1."""
        return self._server.port

    async def follow(self) -> None:
        """Send what is new, for ever; the server is stopped when the task is cancelled."""
        reader = Reader(self._live)
        described_s = -URDF_S
        try:
            while True:
                begun, news = reader.news()
                if begun:
                    self._before = None
                self._send(**news)
                if time.monotonic() - described_s > URDF_S:
                    described_s = time.monotonic()
                    self._channels[URDF_TOPIC].log(text_bytes(self._live.cell.urdf))
                await asyncio.sleep(TICK_S)
        finally:
            self._server.stop()

    def _send(
        self,
        points: list[list[float]] | None = None,
        rows: list[list[float]] | None = None,
        events: list[dict[str, Any]] | None = None,
    ) -> None:
        axes = len(self._unit)
        calibration = self._live.calibration
        gains = []
        if calibration is not None:
            gains = [gain.value for gain in calibration.gains]
        for time_s, *values in points or ():
            position = np.array(values[:axes]) * self._unit
            current = np.array(values[axes:])
            effort = []
            if len(gains) == axes:
                effort = joint_effort(self._live.cell, current, gains).tolist()
            velocity: list[float] = []
            if self._before is not None:
                before_s, position_before = self._before
                velocity = ((position - position_before) / (time_s - before_s)).tolist()
            self._before = (time_s, position)
            stamp_ns = self._stamp_ns(time_s)
            state = joint_state_bytes(self._prefix, stamp_ns, position.tolist(), velocity, effort)
            self._log(JOINTS_TOPIC, stamp_ns, state)
            self._log(CURRENTS_TOPIC, stamp_ns, currents_bytes(stamp_ns, values[axes:]))
        for time_s, *values in rows or ():
            stamp_ns = self._stamp_ns(time_s)
            self._log(PREDICTED_TOPIC, stamp_ns, currents_bytes(stamp_ns, values[:axes]))
            self._log(RESIDUAL_TOPIC, stamp_ns, currents_bytes(stamp_ns, values[axes:]))
        names = self._live.cell.axis_names
        for event in events or ():
            stamp_ns = self._stamp_ns(event["time_s"])
            axis = None
            if event["axis"] is not None:
                axis = names.index(event["axis"])
            kind = EventKind(event["kind"])
            cell_event = CellEvent(stamp_ns, axis, kind, event["code"], event["text"])
            self._log(EVENTS_TOPIC, stamp_ns, event_bytes(cell_event))

    def _stamp_ns(self, time_s: float) -> int:
        return (self._live.origin_ns or 0) + round(1e9 * time_s)

    def _log(self, topic: str, stamp_ns: int, message: bytes) -> None:
        self._channels[topic].log(message, log_time=stamp_ns)
