"""The demonstration on a busy computer: a run that came out invalid is recorded again."""

from __future__ import annotations

from pathlib import Path

import pytest

from daq.config.cell_file import load_cell
from daq.log.metadata import RunStatistics
from daq.simulation import demo
from daq.simulation.demo import RETRIES, ProgressReporter, Settings
from daq.workflow.plan import Plan
from daq.workflow.record import Recorded
from drivers.stream.answers import StreamStatistics

NOTHING_LOST = StreamStatistics(*(0 for _ in StreamStatistics.__slots__))


@pytest.mark.parametrize("spoilt", range(RETRIES + 2))
def test_an_invalid_run_is_made_again_and_said_so(
    spoilt: int, checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    attempts = 0
    steps: list[str] = []

    def record(*_: object) -> Recorded:
        nonlocal attempts
        attempts += 1
        path = tmp_path / "bare-1.mcap"
        path.touch(exist_ok=False)
        log = RunStatistics(10, 0, (0,), valid=attempts > spoilt, reason="3 late answers")
        return Recorded(path, log, NOTHING_LOST)

    monkeypatch.setattr("daq.simulation.demo._record", record)
    cell_file = checkout / "configs/cells/demo.yaml"
    plans = (Plan.__new__(Plan),) * 3
    done = demo._record_valid(
        Settings(tmp_path, tmp_path / "not-read.yaml", 1, 10.0),
        cell_file,
        load_cell(cell_file),
        plans,
        0,
        ProgressReporter(steps.append, lambda *_: None),
    )
    assert attempts == min(spoilt, RETRIES) + 1
    assert done.log.valid is (spoilt <= RETRIES)
    assert [step for step in steps if "again" in step] == [
        f"record bare-1 again ({attempt} of at most {RETRIES} times): 3 late answers"
        for attempt in range(1, min(spoilt, RETRIES) + 1)
    ]
    assert done.path.exists()
