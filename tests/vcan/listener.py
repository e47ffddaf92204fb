"""An independent listener: every frame of a SocketCAN interface with the kernel's stamp, in a file.

    python listener.py INTERFACE FILE     (writes "ready" when it listens; SIGTERM ends it)
    python listener.py HOST:PORT FILE     (the same on channel can0 of a socketcand hub, with the hub's stamps)

It shares no code with the recorder, so that a mistake of the recorder's capture or stream shows as
a difference between log and file. As a program it needs the standard library alone and starts
within a tenth of a second.
"""  # noqa: E501

from __future__ import annotations

import os
import re
import select
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

SO_TIMESTAMPNS, SO_RCVBUFFORCE, SO_RXQ_OVFL = 35, 33, 40  # asm-generic/socket.h
CAN_ERR_FLAG = 0x2000_0000  # linux/can.h
KEPT = tuple((base, 0xC000_0780) for base in range(0, 0x780, 0x80))
"""struct can_filter, identifier and mask: base data frames below 780h;
tests flood the bus with 7F0h.
"""
BUFFER_BYTES = 8 << 20
RECORD = struct.Struct("=qIB8s")
"""Time stamp [ns since 1970], identifier, bytes of data, eight bytes; a stamp of 0:
so many frames were lost.
"""
IDLE_S = 0.05
HUB_CHANNEL = "can0"
HUB_FRAME = re.compile(
    rb"< frame ([0-9A-F]{3}) ([0-9]+)\.([0-9]{6}) "
    rb"([0-9A-F]{0,16}) >",
    re.IGNORECASE,
)
"""Base frames of the socketcand protocol, whose stamps have microseconds."""
RECEIVE_BYTES = 1 << 20


class Frame(NamedTuple):
    """One frame on the bus."""

    time_ns: int  #: the kernel's stamp [ns since 1970]
    identifier: int
    data: bytes


@contextmanager
def listening(interface: str, path: Path) -> Iterator[None]:
    """Listen in a process of its own until the block ends; the file is complete then."""
    command = [sys.executable, "-I", "-S", str(Path(__file__).resolve()), interface, str(path)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            if process.stdout is None or process.stdout.readline() != "ready\n":
                raise RuntimeError(f"nothing listens on {interface}")
            yield
        finally:
            process.terminate()
            if process.wait(timeout=60) != 0:
                raise RuntimeError(f"the listener on {interface} ended with {process.returncode}")


def heard(path: Path) -> list[Frame]:
    """Return the frames of a listener's file.

    Raises:
        RuntimeError: the listener lost frames, so nothing can be judged by it.
    """
    data = path.read_bytes()
    frames = []
    for time_ns, identifier, length, payload in RECORD.iter_unpack(
        data[: len(data) // RECORD.size * RECORD.size]
    ):
        if time_ns == 0:
            raise RuntimeError(f"the listener lost {identifier} frames")
        frames.append(Frame(time_ns, identifier, payload[:length]))
    return frames


def main(interface: str, path: str) -> None:
    """Listen until SIGTERM; frames that wait then are still taken."""
    ended = []
    signal.signal(signal.SIGTERM, lambda number, _: ended.append(number))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with suppress(PermissionError):  # a listener that is late would need a larger buffer
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    if ":" in interface:
        listen_to_hub(interface, path, ended)
        return
    with (
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as end,
        Path(path).open("wb") as file,
    ):
        filters = b"".join(struct.pack("=II", *one) for one in KEPT)
        end.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, filters)
        end.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, BUFFER_BYTES)
        end.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        end.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
        end.bind((interface,))
        end.setblocking(False)
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        lost = 0
        while True:
            last = bool(ended)
            if not last:
                select.select((end,), (), (), IDLE_S)
            records, lost = _waiting(end, lost)
            file.write(records)
            file.flush()
            if last:
                break
        if lost:
            file.write(RECORD.pack(0, lost, 0, bytes(8)))


def connect_to_hub(address: str) -> socket.socket:
    """Return a connection to a socketcand hub, past its handshake."""
    host, _, port = address.rpartition(":")
    end = socket.create_connection((host, int(port)), timeout=10.0)
    end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    for command, answer in (
        ("", "< hi >"),
        (f"< open {HUB_CHANNEL} >", "< ok >"),
        ("< rawmode >", "< ok >"),
    ):
        end.sendall(command.encode("ascii"))
        found = end.recv(len(answer), socket.MSG_WAITALL).decode("ascii", "replace")
        if found != answer:
            raise RuntimeError(f"{address} answers {found!r} to {command!r}; expected {answer!r}")
    return end


def frames_of_hub(buffer: bytes) -> tuple[list[Frame], bytes]:
    """Return the base data frames in what a hub sent, and its unfinished end."""
    whole, end, rest = buffer.rpartition(b">")
    frames = []
    for identifier, seconds, microseconds, data in HUB_FRAME.findall(whole + end):
        stamp_ns = 1_000_000_000 * int(seconds) + 1000 * int(microseconds)
        frames.append(Frame(stamp_ns, int(identifier, 16), bytes.fromhex(data.decode("ascii"))))
    return frames, rest


def listen_to_hub(address: str, path: str, ended: list[int]) -> None:
    """Listen on a hub until SIGTERM; where the hub is gone, wait for that."""
    with connect_to_hub(address) as end, Path(path).open("wb") as file:
        end.setblocking(False)
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        rest = b""
        gone = False
        while not gone:
            last = bool(ended)
            if not last:
                select.select((end,), (), (), IDLE_S)
            with suppress(BlockingIOError, ConnectionError):
                chunk = end.recv(RECEIVE_BYTES)
                gone = not chunk
                frames, rest = frames_of_hub(rest + chunk)
                for one in frames:
                    if one.identifier < KEPT[-1][0] + 0x80:
                        file.write(
                            RECORD.pack(
                                one.time_ns, one.identifier, len(one.data), one.data.ljust(8, b"\0")
                            )
                        )
                file.flush()
                continue  # more may wait
            if last:
                return
        while not ended:
            signal.pause()


def _waiting(end: socket.socket, lost: int) -> tuple[bytes, int]:
    """Return the records of all frames that wait, and the number of frames lost until then."""
    records = bytearray()
    while True:
        try:
            data, ancillary, _, _ = end.recvmsg(16, 128)
        except BlockingIOError:
            return bytes(records), lost
        except OSError:  # the interface is down; it may come up again
            select.select((), (), (), IDLE_S)
            return bytes(records), lost
        stamp_ns = 0
        for _, kind, value in ancillary:
            if kind == SO_TIMESTAMPNS:
                seconds, rest_ns = struct.unpack("=qq", value)
                stamp_ns = 1_000_000_000 * seconds + rest_ns
            elif kind == SO_RXQ_OVFL:
                (lost,) = struct.unpack("=I", value)
        identifier, length, payload = struct.unpack("=IB3x8s", data)
        records += RECORD.pack(stamp_ns, identifier, length, payload)


if __name__ == "__main__":
    main(*sys.argv[1:])
