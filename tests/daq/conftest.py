"""The demo cell, for the tests of every room."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from drivers.canopen.bus import BusAddress
from drivers.simulation.cell import SimulatedCell
from tests.daq.drives import on_its_own_bus, simulated


@pytest.fixture(scope="session")
def cell(checkout: Path) -> Cell:
    """The demo cell."""
    return load_cell(checkout / "configs/cells/demo.yaml")


@pytest.fixture
def cell_file(checkout: Path, tmp_path: Path) -> Path:
    """The demo cell's file in a folder of its own, with no history."""
    ledgers = shutil.ignore_patterns("*.jsonl*", "*.sqlite*")
    shutil.copytree(checkout / "configs", tmp_path / "configs", ignore=ledgers)
    return tmp_path / "configs/cells/demo.yaml"


@pytest.fixture
def drive_cell(request: pytest.FixtureRequest, tmp_path: Path) -> Cell:
    """The demo cell with its gains in the drives, on a virtual bus of this test."""
    return on_its_own_bus(tmp_path, request.node.name)


@pytest.fixture
def simulation(drive_cell: Cell) -> Iterator[SimulatedCell]:
    """The drives of that cell."""
    address = BusAddress("virtual", drive_cell.buses[0].channel)
    with simulated(address) as running:
        yield running
