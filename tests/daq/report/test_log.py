"""Time stamps of an import in a sentence, and the report of its held-out part."""

from __future__ import annotations

from pathlib import Path

import pytest

from daq.log.importing import Imported
from daq.log.metadata import RunStatistics, Timing
from daq.report.log import import_report, timing_text


@pytest.mark.parametrize(
    ("rate_hz", "jitter_s", "says"),
    [
        (125.0, 0.25e-3, "uniform at 125 Hz: usual step 8 ms, longest 8 ms, jitter 0.250 ms"),
        # Rounding errors of the stamps are no jitter, and no rate has an exponent.
        (
            1e6,
            9.39e-16,
            "uniform at 1000000 Hz: usual step 0.001 ms, longest 0.001 ms, jitter 0.000",
        ),
    ],
)
def test_time_stamps_are_told_without_exponents(rate_hz: float, jitter_s: float, says: str) -> None:
    timing = Timing(
        rows=1000,
        rate_hz=rate_hz,
        usual_step_s=1.0 / rate_hz,
        longest_step_s=1.0 / rate_hz,
        jitter_s=jitter_s,
        drift_s=0.0,
        missing=0,
        resampled=False,
    )
    text = timing_text(timing)
    assert text.startswith(says)


def test_a_held_out_part_without_the_path_of_its_log_is_refused() -> None:
    statistics = RunStatistics(100, 0, (0,), valid=True, reason="")
    imported = Imported(statistics, None, (), holdout=statistics)
    log = Path("log.mcap")
    report = import_report(log, imported, Path("held-out.mcap"))
    assert report.holdout is not None
    assert report.holdout.log == "held-out.mcap"
    with pytest.raises(ValueError, match="no path of the log of the held-out part"):
        import_report(log, imported, None)
