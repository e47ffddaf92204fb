"""Who sends SYNC, as the cell file says it; and what the losses of a stream make of a run."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import pytest

from daq.config.cell import KERNEL, RECORDER
from daq.config.cell_file import load_cell
from daq.errors import ConfigurationInconsistent
from daq.workflow.record import Clocks, _pacing, _sync_producer, network_of, stream_losses
from drivers.stream.answers import StreamStatistics
from drivers.stream.producers import DriveProducer, KernelProducer
from drivers.stream.sync import FollowedSync

CONFIGURATIONS = Path(__file__).parents[3] / "configs"
EXPLAINED = ("cycles", "frames", "foreign")
"""What may be counted in a sound run."""


def cell_with(folder: Path, interface: str, pacing: str, producer: str | None) -> Path:
    demo_path = CONFIGURATIONS / "cells" / "demo.yaml"
    text = demo_path.read_text(encoding="utf-8")
    changed_text = text.replace("../", f"{CONFIGURATIONS}/")
    text = changed_text.replace("interface: virtual", f"interface: {interface}")
    said = "" if producer is None else f"\n  producer: {producer}"
    path = folder / "cell.yaml"
    path.write_text(text.replace("pacing: lockstep ", f"pacing: {pacing}{said} "), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("interface", "pacing", "producer", "expected"),
    [
        ("virtual", "lockstep", None, RECORDER),
        ("virtual", "lockstep", "recorder", RECORDER),
        ("socketcan", "timed", "kernel", KERNEL),
        ("socketcan", "timed", "J3", "J3"),
        ("socketcand", "timed", "J6", "J6"),
    ],
)
def test_a_producer_that_there_is(
    tmp_path: Path, interface: str, pacing: str, producer: str | None, expected: str
) -> None:
    path = cell_with(tmp_path, interface, pacing, producer)
    cell = load_cell(path)
    assert cell.sync is not None
    assert cell.sync.producer == expected


@pytest.mark.parametrize(
    ("interface", "pacing", "producer", "message"),
    [
        ("virtual", "timed", "kernel", "kernel on virtual; expected a bus of interface socketcan"),
        (
            "socketcand",
            "timed",
            "kernel",
            "kernel on socketcand; expected a bus of interface socketcan",
        ),
        (
            "socketcan",
            "timed",
            "J9",
            r"J9; expected recorder, kernel, or an axis \(J1, J2, J3, "
            r"J4, J5, J6\)",
        ),
        ("virtual", "lockstep", "J3", "J3 with pacing lockstep"),
    ],
)
def test_a_producer_that_there_is_not(
    tmp_path: Path, interface: str, pacing: str, producer: str, message: str
) -> None:
    path = cell_with(tmp_path, interface, pacing, producer)
    with pytest.raises(ConfigurationInconsistent, match=message):
        load_cell(path)


@pytest.mark.parametrize("producer", ["kernel", "J3"])
def test_the_stream_can_stop_the_sync_that_it_follows(
    tmp_path: Path, producer: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = cell_with(tmp_path, "socketcan", "timed", producer)
    cell = load_cell(path)
    sender = _sync_producer(cell, network_of(cell))
    assert isinstance(sender, KernelProducer | DriveProducer)
    monkeypatch.setattr(type(sender), "start", lambda _: None)
    pacing = _pacing(cell, 0, Clocks(), sender)
    assert isinstance(pacing, FollowedSync)
    assert pacing.producer is sender


@pytest.mark.parametrize("name", [field.name for field in fields(StreamStatistics)])
def test_whatever_is_lost_makes_a_run_invalid(name: str) -> None:
    statistics = StreamStatistics(**{name: 3})
    reason = stream_losses(statistics)
    assert (not reason) == (name in EXPLAINED)
    assert not reason or reason.startswith("3 ")
