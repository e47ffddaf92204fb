"""A cell on two buses of the kernel: one plant behind vcan0 and vcan1, scanned, recorded,
and cut in half.
"""

from __future__ import annotations

import socket
import struct
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Self

import pytest

from daq.config.cell_file import load_cell
from daq.workflow.record import network_of
from drivers.errors import BusError
from tests.two_buses import LEFT, RIGHT, on_two_buses
from tests.vcan.cells import record_once, say, simulated, write_cell, write_simulation
from tests.vcan.run import INTERFACE, SECOND_INTERFACE

PERIOD_US = 40_000
"""Four capture processes, the recorder and the cell share the one processor of the guest."""
BUSES = {INTERFACE: LEFT, SECOND_INTERFACE: RIGHT}
SO_TIMESTAMPNS, SO_RCVBUFFORCE = 35, 33  # asm-generic/socket.h

pytestmark = pytest.mark.skipif(
    not (Path("/sys/class/net") / SECOND_INTERFACE).exists(),
    reason=f"no {SECOND_INTERFACE} in this kernel; `make test-vcan` brings one",
)


class SyncTimes:
    """When SYNC passed an interface, by the kernel;
    a socket for SYNC alone costs the guest little.
    """

    def __init__(self, interface: str) -> None:
        self._interface = interface
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)

    def __enter__(self) -> Self:
        # struct can_filter: base data frames of that identifier
        wanted = struct.pack("=II", 0x080, 0xC000_07FF)
        self._socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, wanted)
        self._socket.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, 8 << 20)
        self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._socket.bind((self._interface,))
        self._socket.setblocking(False)
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def taken(self) -> list[int]:
        """Times since the last call [ns since 1970]."""
        times: list[int] = []
        while True:
            try:
                _, ((_, _, stamp), *_), _, _ = self._socket.recvmsg(16, 64)
            except BlockingIOError:
                return times
            seconds, nanoseconds = struct.unpack("=qq", stamp)
            times.append(1_000_000_000 * seconds + nanoseconds)


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The cell file; its amplifiers serve in a process of their own."""
    folder = tmp_path_factory.mktemp("two-buses")
    path = write_cell(folder, PERIOD_US, "timed")
    text = on_two_buses(path.read_text(encoding="utf-8"), "socketcan", INTERFACE, SECOND_INTERFACE)
    path.write_text(text, encoding="utf-8")
    with simulated(write_simulation(folder, PERIOD_US), buses=BUSES):
        yield path


def test_scan_reports_the_bus_of_each_node(cell: Path) -> None:
    found = [
        (node["bus"], node["node_id"], node["verdict"]) for node in say("scan", str(cell))["nodes"]
    ]
    assert found == [("left", node, "ok") for node in LEFT] + [
        ("right", node, "ok") for node in RIGHT
    ]


def test_a_run_is_complete_and_its_syncs_are_near_together(
    cell: Path, tmp_path: Path, attempts: range, figure: Callable[[str], None]
) -> None:
    plan = tmp_path / "plan.yaml"
    how = ("--seed", "3", "--condition", "1e9", "--duration", "8", "--exchanges", "20")
    say("plan", str(cell), "--out", str(plan), *how)
    with SyncTimes(INTERFACE) as left, SyncTimes(SECOND_INTERFACE) as right:
        for attempt in attempts:
            log = tmp_path / f"{attempt}.mcap"
            done = record_once(cell, plan, log)
            syncs = left.taken(), right.taken()
            if done["valid"]:
                break
    assert done["valid"], done["reason"]
    assert (done["lost_cycles"], done["missing"]) == (0, [0] * 6)
    assert len(syncs[0]) == len(syncs[1]) >= done["samples"]
    apart_us = sorted(1e-3 * (after - before) for before, after in zip(*syncs, strict=True))
    middle = apart_us[len(apart_us) // 2]
    assert apart_us[0] > 0
    figure(
        f"two buses: {done['samples']} samples, {done['lost_cycles']} cycles lost, attempt "
        f"{attempt}; SYNCs {middle:.0f} µs apart (median; "
        f"{apart_us[len(apart_us) * 99 // 100]:.0f} µs at 99 %)"
    )


def test_an_interface_that_goes_down_is_named_and_the_other_bus_still_answers(cell: Path) -> None:
    try:
        with network_of(load_cell(cell)) as network:
            network.check_identities()
            subprocess.run(["ip", "link", "set", SECOND_INTERFACE, "down"], check=True)
            with pytest.raises(BusError, match=rf"bus right \(socketcan:{SECOND_INTERFACE}\)"):
                for _ in range(100):
                    network.link.pump(0.05)
            silent = network.find_silent(network.axes)
            assert silent is not None
            assert (silent.node_ids, silent.found) == (RIGHT, LEFT)
    finally:
        subprocess.run(["ip", "link", "set", SECOND_INTERFACE, "up"], check=True)
