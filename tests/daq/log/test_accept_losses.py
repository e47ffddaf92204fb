"""A log that is invalid because of lost frames is refused unless --accept-losses is given."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daq.errors import RunInvalid
from daq.log.conversion import load_run
from daq.log.metadata import Loss, reports_only_losses
from daq.log.reader import LossyLogs
from daq.workflow.record import stream_losses
from drivers.stream.answers import StreamStatistics
from tests.daq.logs import demo_content, samples, write

MASKED = (
    "missing answers",
    "late answers",
    "answers of wrong length",
    "frames dropped by the kernel",
    "frames dropped by the interface",
    "frames dropped by the capture process",
)
"""As logs have them: a reader must know these texts for ever."""


@given(st.lists(st.tuples(st.integers(1, 10**9), st.sampled_from(MASKED)), min_size=1, max_size=6))
def test_counted_losses_may_be_accepted(losses: list[tuple[int, str]]) -> None:
    reason = ", ".join(f"{count} {kind}" for count, kind in losses)
    assert reports_only_losses(reason)


@pytest.mark.parametrize(
    "reason",
    [
        "",
        "not concluded",
        "2 answers twice",
        "3 missing answers, 1 periods without SYNC",
        "stopped after 3 of 20 moves: 12 MB",
        "3 missing answers, emergency (EMCY 3220h)",
        "missing answers",
    ],
)
def test_nothing_else_may(reason: str) -> None:
    assert not reports_only_losses(reason)


def test_a_lossy_log_is_refused_until_it_is_accepted_and_is_then_partial(
    checkout: Path, tmp_path: Path
) -> None:
    rows = samples([[k, k, k, k, k, k] for k in range(40)])
    lossy_path = tmp_path / "lossy.mcap"
    path = write(lossy_path, demo_content(checkout), rows, verdict=(False, "3 missing answers"))
    with pytest.raises(RunInvalid, match="--accept-losses"):
        load_run(path)
    run, _ = load_run(path, lossy=LossyLogs.ACCEPTED)
    assert run.partial
    doubled_path = tmp_path / "doubled.mcap"
    doubled = write(doubled_path, demo_content(checkout), rows, verdict=(False, "3 answers twice"))
    with pytest.raises(RunInvalid):
        load_run(doubled, lossy=LossyLogs.ACCEPTED)


def test_the_recorder_counts_them_by_these_names() -> None:
    counted = StreamStatistics(
        missing=1, late=2, wrong_length=3, kernel_dropped=4, interface_dropped=5, backlog_dropped=6
    )
    reason = stream_losses(counted)
    assert reason
    assert reports_only_losses(reason)
    expected = {loss.value for loss in Loss if loss.masked}
    words = reason.split(", ")
    assert {part.split(" ", 1)[1] for part in words} == expected
    losses = {loss.value for loss in Loss if loss.masked}
    assert losses == set(MASKED)
    statistics = StreamStatistics(missing=1, skipped_periods=1)
    assert not reports_only_losses(stream_losses(statistics))
