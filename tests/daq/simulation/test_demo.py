"""The demonstration on a busy computer: a run that came out invalid is recorded again."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import pytest

from daq.config.cell_file import load_cell
from daq.errors import DataError, RunInvalid
from daq.jobs.stages import Record
from daq.log.metadata import RunStatistics
from daq.simulation import demo
from daq.simulation.demo import RETRIES, DemoStages, ProgressReporter, Settings
from daq.simulation.simulation_file import shipped_simulation
from daq.workflow.plan import plan, save_plan
from daq.workflow.record import Recorded, RecordingRequest
from drivers.stream.answers import StreamStatistics
from tests.daq.jobs.rig import BEGAN

NOTHING_LOST = StreamStatistics(*(0 for _ in StreamStatistics.__slots__))


def test_recordings_of_an_earlier_demonstration_are_named_before_they_are_replaced(
    tmp_path: Path,
) -> None:
    logs = (tmp_path / "bare-1.mcap", tmp_path / "loaded-1.mcap")
    assert demo.make_room(tmp_path, logs) == ()
    logs[0].touch()
    room = demo.make_room(tmp_path, logs)
    assert room == logs[:1]
    assert not logs[0].exists()


@pytest.mark.parametrize("spoilt", range(RETRIES + 2))
def test_an_invalid_run_is_made_again_and_said_so(
    spoilt: int, checkout: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[RecordingRequest] = []
    steps: list[str] = []

    def record(request: RecordingRequest, **_: object) -> Recorded:
        made.append(request)
        request.out.touch(exist_ok=False)
        missing = (0,) * 6
        log = RunStatistics(10, 0, missing, valid=len(made) > spoilt, reason="3 late answers")
        return Recorded(request.out, log, NOTHING_LOST)

    monkeypatch.setattr(demo, "record", record)
    monkeypatch.setattr(demo, "_simulated", lambda _cell, _spec: nullcontext())
    monkeypatch.setattr(demo, "TO_DECISION", (Record(),))
    cell_file = checkout / "configs/cells/demo.yaml"
    cell = load_cell(cell_file)
    moves = plan(
        cell, seed=1, duration_s=6.0, exchanges=0, largest_condition=1e9, largest_std_percent=1e9
    )
    for name in demo.PLANS:
        changed_move = replace(moves, moves=moves.moves[:1])
        path = tmp_path / f"plan-{name}.yaml"
        save_plan(changed_move, path)
    settings = Settings(tmp_path, shipped_simulation(), 1, 10.0)
    reporter = ProgressReporter(steps.append, lambda *_: None)
    stages = DemoStages(settings, cell, lambda: BEGAN, reporter)
    if spoilt > RETRIES:
        with pytest.raises(RunInvalid, match="3 late answers"):
            stages.run(cell_file)
        assert issubclass(RunInvalid, DataError)  # as a fit of that run would end
    else:
        stages.run(cell_file)
        expected = [name for name, _, _ in demo.RUNS]
        assert [request.out.stem for request in made[spoilt:]] == expected
        assert all(stages.recorded[name].log.valid for name, _, _ in demo.RUNS)
    assert [step for step in steps if "again" in step] == [
        f"record bare-1 again ({attempt} of at most {RETRIES} times): 3 late answers"
        for attempt in range(1, min(spoilt, RETRIES) + 1)
    ]
    assert made[0].run_id == "demo-1-bare-1"
