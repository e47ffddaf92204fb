"""Journal of a job while it runs, and metrics for a monitor."""

from __future__ import annotations

import io
import json
import math
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import NoReturn, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st
from prometheus_client.parser import text_string_to_metric_families

from daq.documents.session_state import Outcome
from daq.errors import OutputFailed
from daq.jobs.context import SessionContext
from daq.jobs.journal import Form, Journal, Level, form_of
from daq.jobs.reporting import Conclusion, report_failure, write_metrics
from drivers.errors import DriveFault

AT = datetime(2026, 1, 5, 3, 0, tzinfo=UTC)


def said(form: Form, level: Level = Level.INFO, event: str = "event", **fields: object) -> str:
    stream = io.StringIO()
    journal = Journal(stream, form, lambda: AT, session="s", step="fit")
    journal.say(level, event, **fields)
    return stream.getvalue()


@given(
    st.text(),
    st.dictionaries(st.text(), st.floats() | st.text() | st.integers()),
    st.sampled_from(Level),
)
def test_an_event_is_one_line_whatever_is_in_it(
    text: str, values: dict[str, object], level: Level
) -> None:
    for form in (Form.JSON, Form.JOURNAL):
        line = said(form, level, "event", text=text, values=values)
        assert line.endswith("\n")
        assert line.count("\n") == 1
        prefix = f"<{int(level)}>" if form is Form.JOURNAL else ""
        assert line.startswith(prefix)
        found = json.loads(line.removeprefix(prefix))
        assert (found["event"], found["text"], found["step"]) == ("event", text, "fit")
        assert found["level"] == level.name.lower()
        assert datetime.fromisoformat(found["time"]) == AT


def test_a_report_that_fails_does_not_hide_the_error_that_ended_the_job(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unreadable(*_: object) -> NoReturn:
        raise TypeError("no session")

    monkeypatch.setattr("daq.jobs.session.sessions", unreadable)
    error = DriveFault(3, "fault")
    context = cast("SessionContext", None)  # the report fails before it is used
    report_failure(context, tmp_path, error)
    assert error.__notes__ == ["kept: the end of the session may not be recorded: no session"]


def test_a_report_without_a_readable_session_says_what_is_missing(tmp_path: Path) -> None:
    error = DriveFault(3, "fault")
    context = cast("SessionContext", None)  # the report fails before it is used
    folder = tmp_path / "session"
    report_failure(context, folder, error)
    (note,) = error.__notes__
    assert note.startswith("kept: the end of the session may not be recorded: ")
    assert f"{folder}: found no session that can be read" in note


def test_a_report_that_fails_without_words_names_the_kind_of_its_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def out_of_memory(*_: object) -> NoReturn:
        raise MemoryError

    monkeypatch.setattr("daq.jobs.session.sessions", out_of_memory)
    error = DriveFault(3, "fault")
    context = cast("SessionContext", None)  # the report fails before it is used
    report_failure(context, tmp_path, error)
    assert error.__notes__ == ["kept: the end of the session may not be recorded: MemoryError"]


def test_a_person_reads_words_and_no_control_characters() -> None:
    line = said(Form.TEXT, text="one\n\x1b[31mtwo", share=0.25)
    assert line.count("\n") == 1
    assert "\x1b" not in line
    assert "share 0.25" in line


def test_a_person_reads_no_keys_and_no_lists_of_python() -> None:
    recorded = said(Form.TEXT, samples=5000, lost_cycles=0, missing=(0, 0, 0))
    assert recorded.endswith("samples 5000, lost cycles 0, missing samples of each axis: none\n")
    missing = said(Form.TEXT, missing=(0, 2, 0))
    assert missing.endswith("missing samples of each axis: 0, 2, 0\n")
    assert said(Form.TEXT, text="J3 is stiff", in_short=True).endswith(": J3 is stiff\n")
    assert said(Form.TEXT, remark="written", exit_code=0, outcome="applied").endswith(
        ": written, outcome applied\n"
    )
    assert said(Form.TEXT, free_mb=500, seconds=30.0, payload=None).endswith(
        ": free 500 MB, seconds 30, payload none\n"
    )
    # Programs read the keys as ever.
    text = said(Form.JSON, missing=(0, 0, 0))
    document = json.loads(text)
    assert document["missing"] == [0, 0, 0]


def test_a_person_reads_a_finding_once_in_the_conclusion() -> None:
    for form, count in ((Form.TEXT, 0), (Form.JSON, 1)):
        stream = io.StringIO()
        journal = Journal(stream, form, lambda: AT)
        journal.say(Level.INFO, "found", text="J3 has friction by load", in_short=True)
        assert stream.getvalue().count("J3 has friction by load") == count


def test_numbers_that_json_cannot_say_are_null() -> None:
    more = [math.inf, 1.0]
    text = said(Form.JSON, gain=math.nan, more=more)
    document = json.loads(text)
    assert document["more"] == [None, 1.0]


def test_a_reader_that_has_gone_does_not_stop_a_job(tmp_path: Path) -> None:
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as stream:
        journal = Journal(stream, Form.JSON, lambda: AT)
        journal.say(Level.INFO, "event")
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def test_the_journal_is_known_by_the_stream_that_systemd_names(tmp_path: Path) -> None:
    path = tmp_path / "stderr"
    with path.open("w") as stream:
        found = os.fstat(stream.fileno())
        JOURNAL_STREAM = f"{found.st_dev}:{found.st_ino}"
        environment = {"JOURNAL_STREAM": JOURNAL_STREAM}
        assert form_of(stream, environment) is Form.JOURNAL
        # Of a service whose stderr was redirected since.
        form = form_of(stream, {"JOURNAL_STREAM": "1:2"})
        assert form is Form.JSON
        assert form_of(stream, {}) is Form.JSON


def written(outcome: Outcome, folder: Path) -> Path:
    conclusion = Conclusion(outcome, 11, None, "")
    return write_metrics(folder, 'the "cell"\\', conclusion, AT, 12.5, None)


def test_metrics_are_replaced_whole_and_can_be_read_by_the_collector(tmp_path: Path) -> None:
    (tmp_path / "drivegain_the_cell__e183a8.prom").write_text("half of a fi")
    path = written(Outcome.STOPPED, tmp_path)
    assert path.name == "drivegain_the_cell__e183a8.prom"
    st_mode = path.stat().st_mode
    assert st_mode & 0o777 == 0o644
    names = [entry.name for entry in tmp_path.iterdir()]
    assert names == [path.name]
    families = {family.name: family for family in text_string_to_metric_families(path.read_text())}
    samples = families["drivegain_recalibration_outcome"].samples
    outcomes = {s.labels["outcome"]: s.value for s in samples}
    assert outcomes["stopped"] == 1.0
    assert sum(outcomes.values()) == 1.0
    first_sample = families["drivegain_recalibration_exit_code"].samples[0]
    assert first_sample.labels["cell"] == 'the "cell"\\'
    assert "drivegain_recalibration_last_success_timestamp_seconds" not in families


def test_a_folder_that_is_not_there_is_reported(tmp_path: Path) -> None:
    folder = tmp_path / "none"
    with pytest.raises(OutputFailed, match="found no folder"):
        written(Outcome.APPLIED, folder)
