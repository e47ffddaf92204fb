"""Our driver against drives on a CANopen stack that is not ours (npm `canopen`),
over the kernel's CAN.

Driver and simulated cell could agree on a mistake; these drives have another project's CANopen
stack.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import chain, islice
from pathlib import Path

import numpy as np
import pytest

from drivers.canopen.bus import BusAddress
from drivers.canopen.network import CanopenNetwork
from drivers.canopen.pdo import STATUSWORD, feedback_entries, read_pdo_record
from drivers.canopen.pdo import Direction as PdoDirection
from drivers.canopen.setup import HEARTBEAT_TIME, MODE_OF_OPERATION
from drivers.profiles.cia402 import State, decode
from drivers.profiles.profile import Axis, Identity
from drivers.stream.stream import SyncStream
from drivers.stream.sync import LockstepSync
from tests.drivers.scripted import PROFILE
from tests.vcan.run import INTERFACE

FOLDER = Path(__file__).parent / "foreign"
NODES = (11, 12)
STEP = 7
"""Counts that the shaft turns at each SYNC, as device.js has it."""
PERIOD_NS = 1_000_000
CYCLES = 2000
ADDRESS = BusAddress("socketcan", INTERFACE)
AXES = tuple(Axis(f"F{node}", node, PROFILE, Identity(0x5A, 0x40200, 77)) for node in NODES)


@pytest.fixture(scope="module", autouse=True)
def drives() -> Iterator[None]:
    """A process a drive, ready to answer."""
    node = shutil.which("node")
    environment = {
        **os.environ,
        "NODE_PATH": os.environ.get("NODE_PATH", str(FOLDER / "node_modules")),
    }
    probe = "require('canopen'); require('socketcan')"
    if (
        node is None
        or subprocess.run(
            [node, "-e", probe], env=environment, capture_output=True, check=False
        ).returncode
    ):
        pytest.skip(f"no node with the packages of {FOLDER}: npm ci --prefix tests/vcan/foreign")
    with ExitStack() as stack:
        for number in NODES:
            command = [node, str(FOLDER / "device.js"), INTERFACE, str(number)]
            process = stack.enter_context(
                subprocess.Popen(
                    command,
                    env=environment,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    text=True,
                )
            )
            stack.callback(process.terminate)
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n", process.stdout.read()
        yield


def test_they_are_found_with_identity_name_and_state() -> None:
    with CanopenNetwork(ADDRESS, AXES) as network:
        found = network.scan(wait_s=1.0)
    assert [node.node_id for node in found] == list(NODES)
    for node in found:
        assert node.identity == Identity(0x5A, 0x40200, 77)
        assert (node.revision, node.device_name) == (1, "foreign drive")
        assert node.state is State.SWITCH_ON_DISABLED


def test_they_are_mapped_started_streamed_from_and_given_back(
    figure: Callable[[str], None],
) -> None:
    with CanopenNetwork(ADDRESS, AXES) as network:
        before = [
            read_pdo_record(network.link.objects(node), PdoDirection.TPDO, 0) for node in NODES
        ]
        network.prepare()
        assert network.ampere_per_unit() == (0.002, 0.002)
        begun = time.monotonic()
        # Each SYNC waits for the answers to the one before: a drive in JavaScript keeps no time.
        stream = SyncStream(network, LockstepSync(PERIOD_NS))
        samples = list(islice(stream, CYCLES))
        seconds = time.monotonic() - begun
        statistics = stream.statistics
        assert {network.link.nmt[node] for node in NODES} == {5}
    positions = np.array([sample.position_counts for sample in samples])
    assert (
        statistics.missing,
        statistics.late,
        statistics.duplicate,
        statistics.surplus,
        statistics.wrong_length,
    ) == (
        0,
        0,
        0,
        0,
        0,
    )
    # The shaft turns STEP counts a SYNC: a sample that is repeated, left out or of another SYNC
    # would show.
    assert (np.diff(positions, axis=0) == STEP).all()
    assert {sample.current_raw for sample in samples} == {(-11, -12)}
    words = chain.from_iterable(sample.statusword for sample in samples)
    assert {decode(word) for word in words} == {State.SWITCH_ON_DISABLED}
    figure(
        f"foreign stack: {CYCLES} cycles of {len(NODES)} drives in {seconds:.2f} s, "
        f"{statistics.frames} answers, 0 lost"
    )
    with CanopenNetwork(ADDRESS, AXES) as network:
        for node, record in zip(NODES, before, strict=True):
            access = network.link.objects(node)
            assert read_pdo_record(access, PdoDirection.TPDO, 0) == record
            assert access.read(MODE_OF_OPERATION) == 8
            assert access.read(HEARTBEAT_TIME) == 0
            assert decode(access.read(STATUSWORD)) is State.SWITCH_ON_DISABLED


def test_the_mapping_is_that_of_the_driver_while_it_is_used() -> None:
    with CanopenNetwork(ADDRESS, AXES) as network:
        network.prepare()
        for axis in AXES:
            record = read_pdo_record(network.link.objects(axis.node_id), PdoDirection.TPDO, 0)
            assert record is not None
            words = tuple(
                entry.index << 16 | entry.subindex << 8 | entry.bits
                for entry in feedback_entries(axis)
            )
            assert (record.cob_id, record.transmission, record.entries) == (
                0x180 + axis.node_id,
                1,
                words,
            )
