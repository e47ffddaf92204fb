"""A cell for the console's tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from daq.config.cell import Cell
from daq.config.cell_file import load_cell


@pytest.fixture(scope="session")
def cell(checkout: Path) -> Cell:
    """The demo cell."""
    cells_folder = checkout / "configs" / "cells"
    path = cells_folder / "demo.yaml"
    return load_cell(path)


@pytest.fixture
def cell_file(tmp_path: Path) -> Path:
    """A path of its own, so that the feeds of two tests have different addresses;
    it is not read.
    """
    return tmp_path / "cell.yaml"
