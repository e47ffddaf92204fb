"""Room for a log: refused before anything moves,
and a controlled end while there is still room for it.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.errors import DiskSpaceShort, ExitCode, OutputFailed, RunInvalid, exit_code
from daq.log.conversion import load_run
from daq.log.reader import read_log
from daq.log.writer import LogWriter
from daq.workflow.safeguards import RESERVE_BYTES, DiskRoom, free_bytes, largest_log_bytes
from drivers.messages import EventKind, Sample
from drivers.profiles.cia402 import POWERLESS, decode
from tests.daq.logs import START_NS, content, write
from tests.daq.workflow.test_record import Rig

GIGABYTE = 10**9


@settings(deadline=None, max_examples=15)
@given(st.integers(1, 12), st.integers(1, 3000), st.integers(0, 2**32 - 1))
def test_no_log_is_larger_than_the_estimate(
    tmp_path_factory: pytest.TempPathFactory, axes: int, count: int, seed: int
) -> None:
    """Noise over the whole range, which no packing makes smaller."""
    rng = np.random.default_rng(seed)
    noise = rng.integers(-(2**31), 2**31, size=(count, 2, axes)).tolist()
    rows = [
        Sample(k, START_NS + k * 1_000_000, tuple(p), tuple(c), (k & 0xFFFF,) * axes)
        for k, (p, c) in enumerate(noise)
    ]
    start = content(axes)
    a_path = tmp_path_factory.mktemp("log") / "a.mcap"
    path = write(a_path, start, rows)
    duration_s = count * 1e-3
    bound = largest_log_bytes(start.joint_names, 1000.0, duration_s, start.files)
    assert path.stat().st_size <= bound <= 3 * path.stat().st_size + 200_000


def test_the_estimate_grows_with_what_it_depends_on() -> None:
    names = ("J1", "J2")
    base = largest_log_bytes(names, 1000.0, 60.0, {})
    assert largest_log_bytes(names, 1000.0, 120.0, {}) > 1.9 * base
    assert largest_log_bytes(names, 500.0, 60.0, {}) < 0.7 * base
    assert largest_log_bytes((*names, "J3"), 1000.0, 60.0, {}) > base
    attached = {"robot.urdf": b"x" * 1000}
    assert largest_log_bytes(names, 1000.0, 60.0, attached) == base + 2000


def test_a_real_disk_is_asked(tmp_path: Path) -> None:
    assert free_bytes(tmp_path) > 0
    log = tmp_path / "none" / "a.mcap"
    with pytest.raises(OutputFailed, match="no such file"):
        DiskRoom(log).require(1)


def _rig(
    checkout: Path, folder: Path, patch: pytest.MonkeyPatch, free: Callable[[Path], int]
) -> Rig:
    rig = Rig(checkout, folder, patch, "lockstep")
    genuine = DiskRoom
    patch.setattr("daq.workflow.record.DiskRoom", lambda log, _free: genuine(log, free))
    return rig


def test_nothing_moves_where_the_log_has_no_room(
    checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = _rig(checkout, tmp_path, monkeypatch, lambda _: RESERVE_BYTES + 1_000_000)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(DiskSpaceShort, match="nothing has moved"):
        rig.run()
    assert exit_code(DiskSpaceShort) is ExitCode.UNEXPECTED
    assert sorted(tmp_path.iterdir()) == before
    assert not any(node.powered_cycles for node in rig.bus.nodes)


def test_a_disk_that_fills_up_ends_the_run_in_a_controlled_way(
    checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[int] = []

    def filling(_: Path) -> int:
        looks.append(len(looks))
        return GIGABYTE if len(looks) < 5 else RESERVE_BYTES - 1

    rig = _rig(checkout, tmp_path, monkeypatch, filling)
    with pytest.raises(DiskSpaceShort, match="sent a stop") as caught:
        rig.run()
    assert not getattr(caught.value, "__notes__", [])
    assert {decode(node.statusword) for node in rig.bus.nodes} <= set(POWERLESS)
    assert any(node.powered_cycles for node in rig.bus.nodes)
    assert not rig.out.with_name("a.mcap.part").exists()
    log = read_log(rig.out)
    assert (log.statistics.valid, log.partial) == (False, False)
    assert "stopped after 1 of 2 moves: 67.1 MB left" in log.statistics.reason
    assert EventKind.STOP in [event.kind for event in log.events]
    assert 300 <= log.statistics.samples <= 310  # four looks, a tenth of a second apart
    with pytest.raises(RunInvalid, match="left on its disk"):
        load_run(rig.out)


@pytest.mark.slow
def test_an_axis_that_does_not_stop_then_is_reported(
    checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not swallowed with the walk that was closed: it must be shouted."""

    def filling(_: Path) -> int:
        if rig.bus.cycle > 150:
            rig.bus.nodes[2].control = lambda word, cycle: None  # type: ignore[method-assign]
            return 0
        return GIGABYTE

    rig = _rig(checkout, tmp_path, monkeypatch, filling)
    with pytest.raises(DiskSpaceShort) as caught:
        rig.run()
    assert any("while stopping" in note and "node 3" in note for note in caught.value.__notes__)


def test_a_disk_that_is_full_all_at_once_stops_the_axes_too(
    checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = _rig(checkout, tmp_path, monkeypatch, lambda _: GIGABYTE)
    genuine = LogWriter.write

    def refuse(self: LogWriter, sample: Sample) -> None:
        if sample.cycle == 170:
            raise OutputFailed.of(self.part, OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
        genuine(self, sample)

    monkeypatch.setattr(LogWriter, "write", refuse)
    with pytest.raises(OutputFailed, match="no space left"):
        rig.run()
    assert {decode(node.statusword) for node in rig.bus.nodes} <= set(POWERLESS)
    assert rig.out.with_name("a.mcap.part").exists()
    assert not rig.out.exists()


def test_check_of_a_folder_that_was_moved_says_where_the_recording_may_be(tmp_path: Path) -> None:
    folder = tmp_path / "sessions"
    folder.mkdir()
    room = DiskRoom(folder / "bare.mcap", lambda _: 10**12)
    room.check()
    folder.rename(tmp_path / "elsewhere")
    with pytest.raises(OutputFailed) as refused:
        room.check()
    assert "moved or removed" in refused.value.found
    assert "bare.mcap.part" in refused.value.remedy
    assert "nothing was written" not in refused.value.remedy
