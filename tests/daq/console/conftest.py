"""A cell for the console's tests."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture
def cell_file(tmp_path: Path) -> Path:
    """A path of its own, so that the feeds of two tests have different addresses;
    it is not read.
    """
    return tmp_path / "cell.yaml"
