"""Who may read the page, and that a page that does not read delays no other."""

from __future__ import annotations

import asyncio
import json
import re
import shutil
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest

from daq.advice import for_command_line
from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.config.same_cell import calibrated_robot
from daq.console.live import Live
from daq.console.results import Results
from daq.console.server import CONNECTIONS, LARGEST_READERS, Page
from daq.documents.calibration_file import save_calibration
from daq.errors import ExitCode
from daq.ledger.ledger import MAY_LACK
from daq.log.feed import Feed
from drivers.canopen.emcy import remedy_of
from drivers.messages import CellEvent, EventKind
from ident.calibration import Calibration
from tests.daq.calibrations import demo_calibration
from tests.daq.command_line import run_verb
from tests.daq.console.feeds import TOKEN, Recording, Served, arrivals, served
from tests.daq.histories import calibration_of, enter, ledger_of


@pytest.fixture(scope="module")
def console(cell: Cell, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A console with a report."""
    folder = tmp_path_factory.mktemp("console")
    (folder / "report.html").write_text("<p>the report</p>")
    (folder / "secret.txt").write_text("secret")
    cell_file = folder / "cell.yaml"
    with served(cell_file, cell, folder) as one:
        yield one


def test_the_page_loads_nothing_from_elsewhere_and_runs_no_inline_script(console: Served) -> None:
    path = f"/{TOKEN}/"
    answer, page = console.ask(path)
    assert answer.status == 200
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "script-src 'self'" in policy
    assert "unsafe" not in policy
    assert answer.headers["referrer-policy"] == "no-referrer"
    assert "server" not in answer.headers
    for name in re.findall(rb'(?:src|href)="([^"]+)"', page):
        assert name == b"data:," or console.ask(f"/{TOKEN}/{name.decode()}")[0].status == 200
    script = console.ask(f"/{TOKEN}/page.js")[1]
    assert not re.search(rb"https?:|innerHTML|eval\(|document\.write", script + page)
    assert not re.search(rb"<script(?![^>]* src=)|<style|\son[a-z]+=|\sstyle=", page)


@pytest.mark.parametrize(
    "path", ["/", "/wrong/", "/wrong/stop", "//", f"/{TOKEN[:-1]}/", f"/x{TOKEN}/", f"/{TOKEN}x/"]
)
def test_without_the_token_there_is_nothing(console: Served, path: str) -> None:
    answer, content = console.ask(path)
    assert (answer.status, content) == (404, b"not found")
    assert "content-security-policy" in answer.headers


def test_a_question_about_the_whole_server_is_refused_like_any_other(console: Served) -> None:
    answer, content = console.ask("*", "OPTIONS")
    assert (answer.status, content) == (404, b"not found")
    assert "content-security-policy" in answer.headers


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1", "127.0.0.1:1", "localhost.evil.example", "[::1]"]
)
def test_a_name_that_was_bound_to_this_computer_is_refused(console: Served, host: str) -> None:
    path = f"/{TOKEN}/"
    status = console.ask(path, host=host)[0].status
    assert status == 421
    origin = f"http://{host}"
    assert console.ask(f"/{TOKEN}/stop", "POST", host=host, origin=origin)[0].status == 421


def test_another_origin_can_neither_read_nor_stop(console: Served) -> None:
    own = f"http://127.0.0.1:{console.port}"
    for headers in (
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"sec_fetch_site": "cross-site"},
    ):
        path = f"/{TOKEN}/cell"
        assert console.ask(path, **headers)[0].status == 403
    changed_own = own.replace("http", "https")
    for headers in ({}, {"origin": "null"}, {"origin": changed_own}):
        status = console.ask(f"/{TOKEN}/stop", "POST", **headers)[0].status
        assert status == 403
    assert console.ask(f"/{TOKEN}/stop", origin=own)[0].status == 405  # a link stops nothing
    answer, content = console.ask(f"/{TOKEN}/stop", "POST", origin=own)
    assert answer.status == 200
    assert json.loads(content)["accepted"] is False
    assert "use the emergency stop" in json.loads(content)["text"]


@pytest.mark.parametrize(
    "path", ["secret.txt", "report/secret.txt", "report/../secret.txt", "../secret.txt", "%2e%2e/secret.txt",  # noqa: E501
             "page.js/../../../pyproject.toml", "/etc/passwd", "report?file=secret.txt%00", "..%2fsecret.txt"]  # noqa: E501
)  # fmt: skip
def test_no_path_leads_to_a_file(console: Served, path: str) -> None:
    answer, content = console.ask(f"/{TOKEN}/{path}")
    assert b"secret" not in content
    assert b"root:" not in content
    assert b"[project]" not in content
    expected = 200 if path.startswith("report?") else 404
    assert answer.status == expected


def test_the_report_runs_no_script(console: Served) -> None:
    path = f"/{TOKEN}/report"
    answer, content = console.ask(path)
    assert content == b"<p>the report</p>"
    assert answer.headers["content-security-policy"].startswith("sandbox; default-src 'none'")


def test_a_reader_that_stalls_delays_neither_another_nor_a_stop(
    cell: Cell, cell_file: Path
) -> None:
    stopped = threading.Event()
    feed = Feed(cell_file, stopped.set)
    accepted = arrivals(feed)
    with served(cell_file, cell) as console, feed:
        recording = Recording(feed, cell, cell_file)
        assert accepted.wait(30)  # the console has found the feed
        with console.reader(), console.reader() as reading:
            lines = reading.makefile("rb")
            shown: list[list[float]] = []
            while len(shown) < 1000:
                recording.run(100)
                while b"data: " not in (line := lines.readline()):
                    pass
                document = json.loads(line[6:])
                shown += document["new"].get("points", [])
                console.live.wait(lambda: console.live.samples == recording.samples)
            own = f"http://127.0.0.1:{console.port}"
            path = f"/{TOKEN}/stop"
            answer, content = console.ask(path, "POST", origin=own)
            assert answer.status == 200
            assert json.loads(content)["accepted"]
            assert stopped.wait(10)
        # Every tenth sample of 500 Hz, with its values.
        first = round(shown[0][0] * 500)
        expected = [first + 10 * step for step in range(len(shown))]
        assert [round(500 * point[0]) for point in shown] == expected
        assert console.live.dropped == 0
    degree = cell.axes[0].unit.si
    for point in shown[:50]:
        cycle = round(point[1] * degree * 1e3)
        assert point[2] * degree * 1e3 == pytest.approx(cycle + 1)
        assert point[1 + len(cell.axes)] == pytest.approx(-1e-3 * cycle)


def test_a_monitor_is_shown_until_a_recorder_begins_and_again_after_it(
    cell: Cell, cell_file: Path
) -> None:
    watching = Feed(cell_file, stop=None)
    accepted = arrivals(watching)
    with served(cell_file, cell) as console, watching:
        live = console.live
        monitor = Recording(watching, cell, None)
        assert accepted.wait(30)
        monitor.run(100)
        live.wait(lambda: live.samples == 100)
        assert live.phase == "watching"
        assert (live.run is not None and live.run.log) is None
        shown = live.status()
        state = shown["axes"][0]["state"]
        assert state == "OPERATION ENABLED"
        assert shown["free_bytes"] is None
        assert len(live.points.since(0)) == 10
        assert shown["bus_load"] == {}  # nothing is computed where another master sends
        watching.measured({"can0": 0.25})
        live.wait(lambda: live.status()["bus_load"] == {"can0": 0.25})
        own = f"http://127.0.0.1:{console.port}"
        path = f"/{TOKEN}/stop"
        _, content = console.ask(path, "POST", origin=own)
        assert not json.loads(content)["accepted"]  # nothing of a monitor's can be stopped
        came = arrivals(watching)
        feed = Feed(cell_file, lambda: None)
        accepted = arrivals(feed)
        with feed:
            assert accepted.wait(30)
            recording = Recording(feed, cell, cell_file)
            recording.run(50)
            live.wait(lambda: live.phase == "running" and live.samples == 50)
            bus_load = live.status()["bus_load"]
            assert bus_load != {"can0": 0.25}
            feed.finish()
        assert came.wait(30)
        monitor.run(100)
        live.wait(lambda: live.phase == "watching" and live.samples == 200)
        # How the recording ended stays on the page; the monitor's end does not replace it.
        assert (live.end or {})["ok"]
        assert (live.result or {})["valid"]
        cell_event = CellEvent(0, 2, EventKind.EMCY, 0x7305, "J3 (node 3): EMCY 7305h")
        watching.event(cell_event)
        live.wait(lambda: live.events.end == 1)
        (event,) = live.events.since(0)
        expected = ("J3", "EMCY 7305h", for_command_line(remedy_of(0x7305)))
        assert (event["axis"], event["text"], event["remedy"]) == expected
    assert watching.remark == feed.remark == ""


def test_connections_without_a_request_do_not_hold_back_a_stop(console: Served) -> None:
    with ExitStack() as closing:
        silent = [
            closing.enter_context(socket.create_connection(("127.0.0.1", console.port), timeout=30))
            for _ in range(2 * CONNECTIONS)
        ]
        path = f"/{TOKEN}/stop"
        origin = f"http://127.0.0.1:{console.port}"
        answer, _ = console.ask(path, "POST", origin=origin)
        assert answer.status == 200
        assert silent[0].recv(1) == b""  # the oldest are closed
    refused, _ = console.ask("/wrong/")
    assert refused.headers["connection"] == "close"


def test_more_pages_than_are_served_are_refused_also_at_once(console: Served) -> None:
    with ExitStack() as closing:
        pages = [closing.enter_context(console.reader()) for _ in range(3 * LARGEST_READERS)]
        answers = [closing.enter_context(page.makefile("rb")).readline() for page in pages]
    found = sum(b" 200 " in line for line in answers)
    assert found == LARGEST_READERS
    assert sum(b" 503 " in line for line in answers) == 2 * LARGEST_READERS


def test_a_damaged_audit_log_is_a_problem_of_the_history_on_the_page(tmp_path: Path) -> None:
    configs = tmp_path / "configs"
    configs_folder = Path(__file__).parents[3] / "configs"
    ignore = shutil.ignore_patterns("*.jsonl*", "*.sqlite*")
    shutil.copytree(
        configs_folder,
        configs,
        ignore=ignore,
    )
    cell_file = configs / "cells" / "demo.yaml"
    results = Results(cell_file, load_cell(cell_file))
    ledger = ledger_of(cell_file)
    for week in range(2):
        enter(ledger, calibration_of(week))
    history = results.document()["history"]
    assert history["problem"] is None
    lines = ledger.audit.read_bytes().splitlines(keepends=True)
    content = b"".join(lines[1:])
    ledger.audit.write_bytes(content)
    shown = results.document()["history"]
    assert shown["problem"] == MAY_LACK
    assert shown["calibrations"] == 1


def test_the_gains_of_another_robot_are_a_problem_on_the_page(
    cell: Cell, cell_file: Path, tmp_path: Path
) -> None:
    own = calibrated_robot(cell)
    changed_drive = replace(own.drives[0], node_id=99)
    drives = (changed_drive, *own.drives[1:])
    other = replace(own, drives=drives)
    calibration = tmp_path / "calibration.yaml"
    results = Results(cell_file, cell, calibration)
    save_calibration(replace(demo_calibration(), robot=own), calibration)
    assert results.document()["gains"] is not None
    calibration.unlink()
    save_calibration(replace(demo_calibration(), robot=other), calibration)
    document = results.document()
    assert document["gains"] is None
    assert any("drive of J1 with node id 1" in problem for problem in document["problems"])


def test_a_file_that_no_reader_expected_does_not_end_the_looking(
    cell: Cell, cell_file: Path
) -> None:
    results = Results(cell_file, cell)
    live = Live(cell_file, cell)
    page = Page(cell, live, results)
    given: list[Calibration | ValueError] = [ValueError("5 errors for 6 axes"), demo_calibration()]

    def calibration() -> tuple[Path, Calibration]:
        found = given[0]
        if isinstance(found, ValueError):
            raise found
        return cell_file, found

    async def looked() -> None:
        task = asyncio.create_task(page._look())
        while not page._document:
            await asyncio.sleep(0)
        assert page._document["gains"] is None
        assert "5 errors for 6 axes" in page._document["problems"][0]
        given.pop(0)
        while not page._document["gains"]:
            await asyncio.sleep(0)
        assert page._document["problems"] == []
        task.cancel()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(results, "calibration", calibration)
        patch.setattr("daq.console.server.RESULTS_S", 0.0)
        asyncio.run(asyncio.wait_for(looked(), 30))


@pytest.mark.parametrize("option", ["--calibration", "--report"])
def test_a_named_file_that_does_not_exist_is_an_error(
    checkout: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str
) -> None:
    missing = tmp_path / "missing.yaml"
    cells_folder = checkout / "configs" / "cells"
    demo_path = cells_folder / "demo.yaml"
    assert run_verb("console", demo_path, option, missing) != ExitCode.OK
    error = capsys.readouterr().err
    for word in ("missing.yaml", "found", "expected"):
        assert word in error
