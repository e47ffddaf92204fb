"""The stream for Foxglove: a client of its protocol gets what the feed holds,
and can change nothing.
"""

from __future__ import annotations

import asyncio
import base64
import json
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory

from daq.config.cell import Cell, joint_names
from daq.console.live import Live
from daq.errors import ExitCode
from daq.log.bag_writer import joint_effort
from daq.log.feed import HEAD, SAMPLES, TEXT, packet_struct
from tests.daq.calibrations import demo_calibration
from tests.daq.command_line import run_verb
from tests.daq.console.feeds import facts

pytest.importorskip("foxglove", reason="needs foxglove-sdk, of the optional extra `foxglove`")
from daq.console.stream import PREDICTED_TOPIC, RESIDUAL_TOPIC, SCHEMAS, FoxgloveStream

TEXT_FRAME = 1
DATA_FRAME = 2
MESSAGE_DATA = 1
ORIGIN_NS = 1_700_000_000_000_000_000
PERIOD_NS = 20_000_000


class Client:
    """As little of WebSocket (RFC 6455) and of Foxglove's protocol as a subscription needs."""

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=30)
        self.socket.sendall(
            f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: "
            "Upgrade\r\n"
            "Sec-WebSocket-Key: "
            f"{base64.b64encode(bytes(16)).decode()}\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n".encode()
        )
        self.incoming = self.socket.makefile("rb")
        while self.incoming.readline() != b"\r\n":
            pass
        self.topics: dict[int, str] = {}
        self.schemas: dict[str, str] = {}
        self.info = json.loads(self.receive()[1])

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.incoming.close()
        self.socket.close()

    def receive(self) -> tuple[int, bytes]:
        """The next frame: its kind and content."""
        kind, length = self.incoming.read(2)
        if length >= 126:
            (length,) = struct.unpack(
                ">H" if length == 126 else ">Q", self.incoming.read(2 if length == 126 else 8)
            )
        return kind & 0x0F, self.incoming.read(length)

    def send(self, message: dict[str, Any]) -> None:
        """Send a JSON object, masked by zeros."""
        content = json.dumps(message).encode()
        packed = struct.pack(">BBH4x", 0x80 | TEXT_FRAME, 0x80 | 126, len(content))
        self.socket.sendall(packed + content)

    def subscribe(self) -> None:
        """Subscribe to every topic, once all are advertised."""
        while len(self.topics) < len(SCHEMAS):
            _, content = self.receive()
            for channel in json.loads(content)["channels"]:
                self.topics[channel["id"]] = channel["topic"]
                self.schemas[channel["topic"]] = channel["schema"]
        wanted = [{"id": number, "channelId": number} for number in self.topics]
        self.send({"op": "subscribe", "subscriptions": wanted})

    def message(self) -> tuple[str, int, Any]:
        """The next message: topic, time and content."""
        while True:
            kind, content = self.receive()
            if kind == DATA_FRAME and content[0] == MESSAGE_DATA:
                number, time_ns = struct.unpack_from("<IQ", content, 1)
                topic = self.topics[number]
                encoded_schemas = self.schemas[topic].encode()
                schema = Schema(number, encoded_schemas, "ros2msg", SCHEMAS[topic])
                decode = DecoderFactory().decoder_for("cdr", schema)
                assert decode is not None
                return topic, time_ns, decode(content[13:])


def _samples(cell: Cell, number: int, count: int) -> bytes:
    """Samples of 50 Hz as the feed packs them:
    positions and currents are the numbers of the cycle and of the axis.
    """
    axes = len(cell.axes)
    layout = packet_struct(axes)
    packed = b""
    for cycle in range(count):
        values = [cycle + axis for axis in range(axes)]
        time_ns = ORIGIN_NS + PERIOD_NS * cycle
        packed += layout.pack(
            cycle, time_ns, 0, *values, *(-value for value in values), *[0x1237] * axes
        )
    return HEAD.pack(SAMPLES, number, count, 0, 0, count) + packed


@contextmanager
def _followed(stream: FoxgloveStream) -> Iterator[asyncio.AbstractEventLoop]:
    """Run the stream in a thread."""
    loop = asyncio.new_event_loop()

    async def main() -> None:
        with suppress(asyncio.CancelledError):
            await stream.follow()

    task = loop.create_task(main())
    thread = threading.Thread(target=lambda: loop.run_until_complete(task))
    thread.start()
    try:
        yield loop
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join(30)
        loop.close()


def test_a_client_gets_what_the_feed_holds_and_can_change_nothing(
    cell: Cell, cell_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daq.console.stream.URDF_S", 0.05)
    live = Live(cell_file, cell)
    axes = len(cell.axes)
    live.calibration = demo_calibration()
    stream = FoxgloveStream(live, 0)
    with _followed(stream) as loop, Client(stream.port) as client:
        assert client.info["capabilities"] == []
        client.subscribe()
        topic, _, urdf = client.message()  # the subscription holds from now on
        assert (topic, urdf.data) == ("/robot_description", cell.urdf)
        run = {"run": asdict(replace(facts(cell, None), rate_hz=50.0))}
        event = {
            "time_ns": ORIGIN_NS,
            "axis": 2,
            "kind": "emcy",
            "code": 0x7305,
            "text": "EMCY 7305h",
        }
        for number, message in enumerate((run, _samples(cell, 1, 30), {"events": [event]})):
            head = HEAD.pack(TEXT, number, 30, 0, 0, 0)
            if isinstance(message, bytes):
                packet = message
            else:
                encoded_text = json.dumps(message).encode()
                packet = head + encoded_text
            loop.call_soon_threadsafe(live.take, packet)
        loop.call_soon_threadsafe(
            lambda: live.rows.add([[0.1, *range(axes), *range(10, 10 + axes)]])
        )
        found: dict[str, list[tuple[int, Any]]] = {topic: [] for topic in SCHEMAS}
        expected = {
            "/joint_states": 30,
            "/cell/currents": 30,
            "/cell/predicted": 1,
            "/cell/residual": 1,
        }
        while any(
            len(found[topic]) < count for topic, count in {**expected, "/cell/events": 1}.items()
        ):
            topic, *rest = client.message()
            found[topic].append((rest[0], rest[1]))
    gains = [gain.value for gain in demo_calibration().gains]
    for cycle, ((time_ns, state), (_, current)) in enumerate(
        zip(found["/joint_states"], found["/cell/currents"], strict=True)
    ):
        raw = np.arange(cycle, cycle + axes, dtype=np.float64)
        assert time_ns == pytest.approx(ORIGIN_NS + PERIOD_NS * cycle, abs=1000)
        assert tuple(state.name) == joint_names(cell)
        assert state.position == pytest.approx(1e-3 * raw)
        assert current.current_a == pytest.approx(-1e-3 * raw)
        assert state.velocity == pytest.approx([1e-3 / 0.02] * axes if cycle else [])
        assert state.effort == pytest.approx(joint_effort(cell, -1e-3 * raw, gains))
    ((at_ns, predicted),) = found["/cell/predicted"]
    assert at_ns == ORIGIN_NS + 100_000_000
    assert list(predicted.current_a) == list(range(axes))
    current_a = list(found["/cell/residual"][0][1].current_a)
    assert current_a == list(range(10, 10 + axes))
    ((_, event_seen),) = found["/cell/events"]
    assert event_seen.axis == 2
    assert event_seen.kind == "emcy"
    assert event_seen.code == 0x7305
    assert event_seen.text == "EMCY 7305h"


def test_the_shipped_layout_shows_what_the_stream_sends(checkout: Path) -> None:
    viewers_folder = checkout / "configs" / "viewers"
    foxglove_path = viewers_folder / "foxglove.json"
    layout = json.loads(foxglove_path.read_text(encoding="utf-8"))
    plotted = set()
    for panel in layout["configById"].values():
        for path in panel.get("paths", ()):
            plotted.add(path["value"])
    topics = {path.partition(".")[0] for path in plotted}
    topics_without_schema = topics - set(SCHEMAS)
    assert topics_without_schema == {"/cell/samples"}  # in logs alone
    for topic in (PREDICTED_TOPIC, RESIDUAL_TOPIC):
        assert {f"{topic}.current_a[{axis}]" for axis in range(6)} <= plotted


def test_a_port_that_is_taken_is_a_wrong_command_line(
    checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = str(other.getsockname()[1])
        cells_folder = checkout / "configs" / "cells"
        cell_file = str(cells_folder / "demo.yaml")
        assert run_verb("console", cell_file, "--foxglove", port) == ExitCode.USAGE
    error_output = capsys.readouterr().err
    assert f"--foxglove {port}" in error_output
