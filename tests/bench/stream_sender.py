"""Six amplifiers' frames on SocketCAN:
`python -m tests.bench.stream_sender INTERFACE PERIOD_US CYCLES`.

Writes `ready`, waits for a line, then sends SYNC and one TPDO of each node every period (0: as fast
as it can), on an absolute schedule that leaves nothing out; after a pause one more such cycle,
whose positions are LAST. Writes how many frames it sent, and in how many seconds the periodic ones.
"""

from __future__ import annotations

import os
import socket
import struct
import sys
import time
from contextlib import suppress

NODES = 6
FRAMES_A_CYCLE = 1 + NODES
LAST = -1
PAUSE_S = 2.0
_FRAME = struct.Struct("=IB3x8s")
_TPDO = struct.Struct("<ihH")
_SWITCH_ON_DISABLED = 0x0250


def main(interface: str, period_us: int, cycles: int) -> None:
    """Send them."""
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    sys.stdin.readline()
    if period_us:
        # Wires and drives do not wait: on one processor a busy thread would else set the rate of
        # the bus.
        with suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(2))
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as bus:
        bus.bind((interface,))
        # It reads nothing: what others send must not queue up for it.
        bus.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")
        sync = _FRAME.pack(0x080, 0, bytes(8))
        time.sleep(PAUSE_S / 10)  # until the first SYNC is waited for
        begun_ns = time.monotonic_ns()
        sent = 0
        for cycle in range(cycles):
            left_ns = begun_ns + 1000 * period_us * cycle - time.monotonic_ns()
            if period_us and left_ns > 0:
                time.sleep(left_ns * 1e-9)
            sent += _cycle(bus, sync, cycle)
        seconds = (time.monotonic_ns() - begun_ns) * 1e-9
        time.sleep(PAUSE_S)
        sent += _cycle(bus, sync, LAST)
    sys.stdout.write(f"{sent} {seconds}\n")


def _cycle(bus: socket.socket, sync: bytes, position: int) -> int:
    bus.send(sync)
    for node in range(1, 1 + NODES):
        bus.send(_FRAME.pack(0x180 + node, 8, _TPDO.pack(position, -node, _SWITCH_ON_DISABLED)))
    return FRAMES_A_CYCLE


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
