"""Many cells' logs: each fitted as it would be alone,
by any worker and however often it was interrupted.
"""

from __future__ import annotations

import csv
import io
import json
import logging
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from typing import Any

import distributed
import pytest
from hypothesis import given
from hypothesis import strategies as st

from daq.cli import main
from daq.config.cell_file import bundle
from daq.documents.calibration_file import as_document, load_calibration
from daq.errors import (
    ConfigurationMissing,
    DaqError,
    ExitCode,
    LogMissing,
    OutputFailed,
    UsageError,
    WorkersLost,
)
from daq.jobs import fleet as fleet_module
from daq.jobs.cell_fit import Failure, FleetFit, Loop, failure_of, fit_cell, open_cache
from daq.jobs.fleet import FleetRow, WorkerPool, each, fit_fleet, worker_pool
from daq.jobs.fleet_survey import (
    CellLogs,
    SeenLog,
    StoredLog,
    UnknownLog,
    at_hand,
    by_cell,
    list_logs,
    survey,
)
from daq.workflow.fit import calibration_of, fit
from ident.errors import DataUnfit
from tests.bench.fleet_cells import FleetCell, make_cell, plans_of
from tests.daq.logs import content, samples, write

pytestmark = pytest.mark.slow

CELLS = 4
WITH_HOLDOUT = 1
"""Of them; the others have one run without load and one with."""
CREATED = datetime(2025, 1, 2, tzinfo=UTC)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Short logs of simulated cells at 250 Hz; to make them takes most of the time here."""
    folder = tmp_path_factory.mktemp("fleet")
    (plans,) = plans_of(1, exchanges=40, duration_s=5.5)
    for number in range(CELLS):
        runs = 3 if number < WITH_HOLDOUT else 2
        cell = FleetCell(folder, number, plans, runs=runs, period_us=4000)
        make_cell(cell)
    return folder


@pytest.fixture(scope="module")
def single(fleet: Path) -> dict[str, dict[str, Any]]:
    """Results of single fits, by cell."""
    made = {}
    for folder in sorted(fleet.iterdir()):
        held_out = folder / "held-out.mcap"
        holdout = [held_out] if held_out.exists() else []
        logs = [folder / "bare.mcap", folder / "loaded.mcap"]
        fitted = fit(logs, holdout=holdout)
        document = as_document(calibration_of(fitted, CREATED))
        made[folder.name] = _timeless(document)
    return made


@pytest.fixture
def few(fleet: Path, tmp_path: Path) -> Path:
    """A folder of its own with the logs of three of the cells."""
    folder = tmp_path / "logs"
    for cell in ("cell-000", "cell-002", "cell-003"):
        shutil.copytree(fleet / cell, folder / cell)
    return folder


def _timeless(document: dict[str, object]) -> dict[str, Any]:
    timeless = dict(document)
    del timeless["created"]
    return timeless


def _files(out: Path) -> dict[str, dict[str, Any]]:
    """Calibrations in a folder, by cell."""
    documents = {}
    for file in sorted(out.glob("*.yaml")):
        calibration = load_calibration(file)
        document = as_document(calibration)
        documents[calibration.cell] = _timeless(document)
    return documents


def _fleet(logs: str | Path, *arguments: str | Path) -> int:
    """Run `drivegain fleet` on the logs; its exit code."""
    texts = [str(argument) for argument in arguments]
    return main(["fleet", str(logs), *texts])


def _by_cell(logs: str | Path) -> tuple[CellLogs, ...]:
    """The logs of each cell in a place."""
    found = survey(list_logs(str(logs)))
    return by_cell(log for log in found if isinstance(log, SeenLog))


def _are_cached(rows: Iterable[FleetRow]) -> list[bool]:
    return [row.kept for row in rows]


def _fitted(logs: Path, out: Path | None, loop: Loop = Loop.OPEN) -> tuple[FleetRow, ...]:
    with worker_pool("threads", 2) as pool:
        cache = None if out is None else open_cache(out, loop)
        found = list_logs(str(logs))
        return fit_fleet(found, pool, loop, cache, lambda: CREATED)


def _reported(rows: tuple[FleetRow, ...]) -> list[FleetRow]:
    """All but what differs from one run to the next."""
    return [replace(row, seconds=0.0, kept=False) for row in rows]


def test_threads_give_each_cell_what_a_single_fit_gives(
    fleet: Path,
    single: dict[str, dict[str, Any]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Several tasks look at heads, and a cell's logs are spread over two of them.
    monkeypatch.setattr(fleet_module, "SURVEYED", 4)
    out = tmp_path / "out"
    table = tmp_path / "fleet.csv"

    code = _fleet(fleet, "--workers", "2", "--out", out, "--csv", table, "--json")

    assert code == ExitCode.OK
    document = json.loads(capsys.readouterr().out)
    assert document["fitted"] == CELLS
    assert document["failed"] == 0
    assert _files(out) == single

    cells = document["cells"]
    errors_on = [cell["error_on"] for cell in cells]
    without_holdout = CELLS - WITH_HOLDOUT
    assert errors_on == ["holdout"] * WITH_HOLDOUT + ["fit"] * without_holdout

    string_io = io.StringIO(table.read_text())
    rows = list(csv.DictReader(string_io))
    for row, cell in zip(rows, cells, strict=True):
        name = row["cell"]
        assert name == cell["cell"]
        columns = [f"{gain['axis']} gain" for gain in cell["gains"]]
        printed = [float(row[column]) for column in columns]
        single_gains = [gain["value"] for gain in single[name]["gains"]]
        assert printed == single_gains
        path = Path(row["calibration"])
        assert load_calibration(path).cell == name


@pytest.mark.processes
def test_processes_give_the_same(
    fleet: Path, single: dict[str, dict[str, Any]], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    code = _fleet(fleet, "--scheduler", "processes", "--workers", "2", "--out", out)
    assert code == ExitCode.OK
    assert _files(out) == single


@pytest.mark.processes
def test_a_scheduler_that_runs_already_gives_the_same(
    few: Path, single: dict[str, dict[str, Any]], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    with distributed.LocalCluster(  # type: ignore[no-untyped-call]
        n_workers=1,
        threads_per_worker=2,
        processes=False,
        host="127.0.0.1",
        protocol="tcp",
        dashboard_address=None,
    ) as cluster:
        address = cluster.scheduler_address
        code = _fleet(few, "--scheduler", address, "--out", out)
        assert code == ExitCode.OK
        assert len(cluster.scheduler.workers) == 1  # it goes on
    made = _files(out)
    expected = {cell: single[cell] for cell in made}
    assert made == expected
    assert len(made) == 3


def test_the_table_shows_every_cell_and_marks_errors_on_the_fit_itself(
    few: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    assert _fleet(few) == ExitCode.OK
    shown = capsys.readouterr().out
    assert "3 of 3 fitted." in shown
    lines = [line for line in shown.splitlines() if line.startswith("cell-")]
    cells = [line.split()[0] for line in lines]
    assert cells == ["cell-000", "cell-002", "cell-003"]
    marked = [line.split()[0] for line in lines if "*" in line]
    assert marked == ["cell-002", "cell-003"]
    assert "* on the moves of the fit" in shown


def test_a_cell_that_cannot_be_fitted_is_a_row_and_not_the_end(
    few: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (few / "cell-000" / "loaded.mcap").unlink()
    (few / "cell-000" / "held-out.mcap").unlink()
    bare = few / "cell-002" / "bare.mcap"
    complete = bare.read_bytes()
    half = len(complete) // 2
    bare.write_bytes(complete[:half])
    (few / "ownerless.mcap").write_bytes(b"\x89MCAP0\r\nno log of ours")
    foreign = few / "foreign.mcap"
    write(foreign, content(2), samples([(1, 2)] * 5))

    code = _fleet(few, "--json")

    assert code == ExitCode.DATA_UNFIT
    cells = json.loads(capsys.readouterr().out)["cells"]
    errors = {}
    for cell in cells:
        name = cell["cell"]
        error = cell["error"]
        errors[name] = error and error["kind"]
    expected = {
        "cell-000": "PayloadMissing",
        "cell-002": "LogTruncated",
        "cell-003": None,
        "foreign.mcap": "SchemaMismatch",
        "ownerless.mcap": "LogTruncated",
    }
    assert errors == expected
    exit_codes = [cell["exit_code"] for cell in cells]
    assert exit_codes == [4, 4, 0, 6, 4]
    (truncated,) = [cell for cell in cells if cell["cell"] == "cell-002"]
    text = truncated["error"]["text"]
    assert str(bare) in text


def test_a_run_that_its_recorder_marked_invalid_is_reported_its_cell(
    tmp_path: Path, checkout: Path
) -> None:
    files = bundle(checkout / "configs/cells/demo.yaml")
    path = tmp_path / "a.mcap"
    zeros = samples([(0,) * 6] * 9)
    write(path, content(6, None, files), zeros, verdict=(False, "the drives fell off"))
    (row,) = _fitted(tmp_path, None)
    assert row.cell == "demo"
    assert isinstance(row.result, Failure)
    assert row.result.kind == "RunInvalid"
    assert row.result.exit_code == ExitCode.DATA_UNFIT
    assert "the drives fell off" in row.result.text


def test_two_configurations_of_a_cell_are_two_rows_and_said_so(
    tmp_path: Path, checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = bundle(checkout / "configs/cells/demo.yaml")
    cell_file = files["cell.yaml"] + b"\n# moved to another hall\n"
    other = files | {"cell.yaml": cell_file}
    files_of_log = {"a": files, "b": other, "c": files}
    zeros = [(0,) * 6] * 9
    for name, carried in files_of_log.items():
        path = tmp_path / f"{name}.mcap"
        write(path, content(6, None, carried), samples(zeros))

    assert _fleet(tmp_path, "--json") == ExitCode.DATA_UNFIT
    printed = capsys.readouterr().out
    document = json.loads(printed)["cells"]
    cells = [cell["cell"] for cell in document]
    assert cells == ["demo", "demo"]
    configurations = [cell["configurations"] for cell in document]
    assert configurations == [2, 2]
    fit_counts = [len(cell["fit"]) for cell in document]
    assert sorted(fit_counts) == [1, 2]

    assert _fleet(tmp_path) == ExitCode.DATA_UNFIT
    printed = capsys.readouterr().out
    words = " ".join(printed.split())
    assert "demo: logs of 2 configurations" in words


def test_a_second_run_does_only_what_is_new(few: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    first = _fitted(few, out)
    assert _are_cached(first) == [False, False, False]
    second = _fitted(few, out)
    assert _are_cached(second) == [True, True, True]
    changed_rows = tuple(replace(row, kept=True) for row in first)
    assert second == changed_rows

    # Another log
    (few / "cell-000" / "held-out.mcap").unlink()
    rows = _fitted(few, out)
    assert _are_cached(rows) == [False, True, True]

    # Another content
    bare = few / "cell-002" / "bare.mcap"
    bare.write_bytes(bare.read_bytes()[:-1])
    third = _fitted(few, out)
    assert _are_cached(third) == [True, False, True]
    assert not third[1].fitted

    # A damaged calibration
    file = third[2].file
    assert file is not None
    changed_content = file.read_bytes().replace(b"cell-003", b"cell-004")
    file.write_bytes(changed_content)
    rows = _fitted(few, out)
    assert _are_cached(rows) == [True, False, False]

    # A state that is none
    file.with_suffix(".json").write_text("[]")
    rows = _fitted(few, out)
    assert _are_cached(rows) == [True, False, False]

    for cell in ("cell-000", "cell-002"):
        shutil.rmtree(few / cell)
    rows = _fitted(few, None)
    third_row = _reported(third)[2]
    assert _reported(rows) == [replace(third_row, file=None)]


def _only(few: Path, cell: str) -> CellLogs:
    """The logs of one of the cells, the others removed."""
    for folder in few.iterdir():
        if folder.name != cell:
            shutil.rmtree(folder)
    (logs,) = _by_cell(few)
    return logs


def _cache_file(out: Path, cell: CellLogs, ending: str) -> Path:
    cache = open_cache(out, Loop.OPEN)
    return cache.file(cell).with_suffix(ending)


@pytest.mark.parametrize("ending", [".yaml", ".json"])
def test_a_file_on_the_shelf_that_is_too_large_is_replaced(
    ending: str, few: Path, tmp_path: Path
) -> None:
    cell = _only(few, "cell-003")
    out = tmp_path / "out"
    (first,) = _fitted(few, out)
    file = _cache_file(out, cell, ending)
    file.unlink()
    with file.open("wb") as stream:
        stream.truncate(2**40)
    rows = _fitted(few, out)
    assert _reported(rows) == _reported((first,))
    assert file.is_file()
    st_size = file.stat().st_size
    assert st_size < 2**20
    (third,) = _fitted(few, out)
    assert third.kept


@pytest.mark.parametrize("ending", [".yaml", ".json"])
@pytest.mark.parametrize("what", ["folder", "pipe", "link to a folder", "link to a pipe"])
def test_what_cannot_be_replaced_on_the_shelf_is_reported_before_anything_is_fitted(
    ending: str, what: str, few: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = _only(few, "cell-003")
    out = tmp_path / "out"
    monkeypatch.setattr(fleet_module, "fit_cell", None)
    file = _cache_file(out, cell, ending)
    target = tmp_path / "there" if what.startswith("link") else file
    if what.endswith("folder"):
        target.mkdir()
        found = "a folder"
    else:
        os.mkfifo(target)
        found = "no regular file"
    if target != file:
        file.symlink_to(target)
    before = file.lstat().st_ino

    name = re.escape(str(file))
    with pytest.raises(UsageError, match=name) as caught:
        _fitted(few, out)

    message = str(caught.value)
    assert found in message
    assert "move it away" in message
    assert file.lstat().st_ino == before
    assert _fleet(few, "--out", out) == ExitCode.USAGE


def test_a_folder_that_comes_in_the_place_of_a_note_meanwhile_is_reported_by_its_name(
    few: Path, tmp_path: Path
) -> None:
    cell = _only(few, "cell-003")
    folder = tmp_path / "out"
    cache = open_cache(folder, Loop.OPEN)
    made = fit_cell(cell, Loop.OPEN, CREATED)
    note = cache.file(cell).with_suffix(".json")
    note.mkdir()
    assert isinstance(made, FleetFit)
    name = re.escape(str(note))
    with pytest.raises(OutputFailed, match=name):
        cache.store(cell, made)


def test_other_options_are_another_fit(few: Path, tmp_path: Path) -> None:
    for cell in ("cell-000", "cell-003"):
        shutil.rmtree(few / cell)
    logs = _by_cell(few)
    out = tmp_path / "out"
    _fitted(few, out)
    opened = open_cache(out, Loop.OPEN)
    closed = open_cache(out, Loop.CLOSED)
    for cell_logs in logs:
        assert opened.cached(cell_logs) is not None
        assert closed.cached(cell_logs) is None


KILLED = """
import os, signal, sys
from datetime import UTC, datetime
from importlib import import_module
from daq.jobs.cell_fit import Loop, open_cache
from daq.jobs.fleet import fit_fleet, worker_pool
from daq.jobs.fleet_survey import list_logs

def report(done, total, remark):
    if remark.startswith("cell-") and done == int(sys.argv[3]):
        os.kill(os.getpid(), signal.SIGKILL)

with worker_pool("threads", 2) as pool:
    cache = open_cache(__import__("pathlib").Path(sys.argv[2]), Loop.OPEN)
    fit_fleet(list_logs(sys.argv[1]), pool, Loop.OPEN, cache, lambda: datetime.now(UTC), report)
"""


@pytest.mark.processes
def test_killed_in_the_middle_and_started_again_it_gives_the_same(
    fleet: Path, single: dict[str, dict[str, Any]], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    env = os.environ | {"OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", KILLED, str(fleet), str(out), "2"]
    done = subprocess.run(command, check=False, env=env)
    assert done.returncode == -signal.SIGKILL
    again = _fitted(fleet, out)
    cached_count = sum(_are_cached(again))
    assert 2 <= cached_count < CELLS
    cells = [row.cell for row in again]
    assert cells == sorted(single)
    assert _files(out) == single
    # No half file is left beside the calibrations and their states.
    files = list(out.iterdir())
    assert len(files) == 2 * CELLS


def test_an_object_store_is_read_in_the_workers_and_leaves_nothing_behind(
    few: Path, single: dict[str, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    store: Any = import_module("fsspec").filesystem("memory")
    for log in few.rglob("*.mcap"):
        name = log.relative_to(few)
        store.pipe(f"/hall/{name}", log.read_bytes())
    try:
        out = tmp_path / "out"
        assert _fleet("memory://hall", "--out", out) == ExitCode.OK
        made = _files(out)
        expected = {cell: single[cell] for cell in made}
        assert made == expected
        assert len(made) == 3
        assert list(scratch.iterdir()) == []
        for cell in _by_cell("memory://hall"):
            cache = open_cache(out, Loop.OPEN)
            assert cache.cached(cell) is not None

        # A fault of a copy is reported under the name of its original.
        complete = store.cat_file("/hall/cell-002/bare.mcap")
        store.pipe("/hall/cell-002/bare.mcap", complete[:-100])
        with worker_pool("threads", 1) as pool:
            logs = list_logs("memory://hall")
            rows = fit_fleet(logs, pool, Loop.OPEN, None, lambda: CREATED)
        results = [row.result for row in rows]
        (failed,) = [result for result in results if isinstance(result, Failure)]
        assert failed.text.startswith("memory:///hall/cell-002/bare.mcap")
    finally:
        store.rm("/hall", recursive=True)


def _facts(logs: Sequence[StoredLog]) -> list[tuple[str, str | None, int]]:
    seen_logs = [log for log in survey(logs) if isinstance(log, SeenLog)]
    return [(log.cell, log.mounting, log.started_ns) for log in seen_logs]


def test_a_folder_by_its_address_is_that_folder(few: Path) -> None:
    by_path = list_logs(str(few))
    by_address = list_logs(f"file://{few}")
    expected = [log.name for log in by_address]
    assert [log.name for log in by_path] == expected
    found_by_path = _facts(by_path)
    assert found_by_path == _facts(by_address)
    assert len(found_by_path) == 7


@pytest.mark.parametrize("address", ["{}", "file://{}", "local://{}"])
def test_a_name_of_a_log_that_is_no_file_is_a_row(
    address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """None of them is opened: nothing would ever open the other end of the pipe."""
    logs = tmp_path / "logs"
    (logs / "folder.mcap").mkdir(parents=True)
    gone_path = logs / "folder.mcap" / "gone.mcap"
    gone_path.symlink_to(tmp_path / "unmounted.mcap")
    (logs / "link.mcap").symlink_to(logs / "folder.mcap")
    (logs / "round.mcap").symlink_to(logs / "round.mcap")
    (logs / "zero.mcap").symlink_to("/dev/zero")
    os.mkfifo(logs / "pipe.mcap")
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(str(logs / "socket.mcap"))
        code = _fleet(address.format(logs), "--json")

    assert code == ExitCode.DATA_UNFIT
    printed = capsys.readouterr().out
    cells = json.loads(printed)["cells"]
    found_of = {
        "folder.mcap": "a folder",
        "folder.mcap/gone.mcap": f"a link to {tmp_path}/unmounted.mcap, which leads nowhere",
        "link.mcap": "a folder",
        "pipe.mcap": "something that is no regular file",
        "round.mcap": f"a link to {logs}/round.mcap, which leads nowhere",
        "socket.mcap": "something that is no regular file",
        "zero.mcap": "something that is no regular file",
    }
    names = {cell["cell"] for cell in cells}
    assert names == set(found_of)
    for cell in cells:
        name = cell["cell"]
        error = cell["error"]
        text = error["text"].split("; expected")[0]
        found = found_of[name]
        assert text == f"{logs}/{name}: found {found}"
        assert error["kind"] == "LogMissing"
        assert cell["exit_code"] == 4


def test_a_log_by_a_link_is_that_log(few: Path, tmp_path: Path) -> None:
    links = tmp_path / "links"
    links.mkdir()
    for log in (few / "cell-002").iterdir():
        (links / log.name).symlink_to(log)
    (row,) = _fitted(links, None)
    assert row.fitted is True


def test_a_pipe_that_takes_the_place_of_a_log_meanwhile_is_not_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.mcap")
    address = str(tmp_path / "a.mcap")
    with pytest.raises(LogMissing, match="no regular file"):
        at_hand(StoredLog(address, "a.mcap"), tmp_path)


@pytest.mark.parametrize("place", ["nowhere", "memory://nowhere", "."])
def test_a_place_without_logs_is_no_empty_table(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(LogMissing):
        list_logs(place)
    assert _fleet(place) == ExitCode.DATA_UNFIT


def test_what_is_not_installed_is_named_with_the_line_that_installs_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def absent(name: str) -> Any:
        raise ImportError(name)

    monkeypatch.setattr(fleet_module, "import_module", absent)
    command = r"pip install 'drivegain\[fleet\]'"
    with pytest.raises(ConfigurationMissing, match=command), worker_pool("processes", 1):
        pass
    with pytest.raises(ConfigurationMissing, match="nonsense"):
        list_logs("nonsense://bucket/logs")


def test_processes_of_this_machine_say_nothing_about_their_end() -> None:
    """On a busy machine a heartbeat finds the scheduler gone,
    and a worker would print its traceback.
    """
    of_a_worker = logging.getLogger("distributed.worker")
    with worker_pool("processes", 1) as pool:
        level = pool.executor.submit(of_a_worker.getEffectiveLevel).result()
    assert level == logging.CRITICAL


def test_processes_of_this_machine_listen_to_no_one_else() -> None:
    with worker_pool("processes", 1) as pool:
        future = pool.executor.submit(len, "abc")
        assert future.result() == 3
        assert pool.present()
        psutil = import_module("psutil")  # distributed brings it
        here = psutil.Process()
        ours = [here, *here.children(recursive=True)]
        listening = []
        for process in ours:
            for connection in process.net_connections("inet"):
                if connection.status == psutil.CONN_LISTEN:
                    listening.append(connection.laddr.ip)
    assert len(listening) >= 3
    assert set(listening) == {"127.0.0.1"}


def test_a_scheduler_that_does_not_answer_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet_module, "CONNECT_S", 0.2)
    # Port 9, discard: nothing answers there.
    with (
        pytest.raises(UsageError, match="a dask scheduler that answers"),
        worker_pool("tcp://127.0.0.1:9", 1),
    ):
        pass


def test_the_words_of_scheduler(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[tuple[str | int | None, ...]] = []

    def processes(workers: int | None) -> None:
        started.append(("processes", workers))

    def scheduler(address: str, workers: int | None) -> None:
        started.append(("scheduler", address, workers))

    monkeypatch.setattr(fleet_module, "_processes", processes)
    monkeypatch.setattr(fleet_module, "_scheduler", scheduler)

    with worker_pool("threads", 3) as pool:
        assert pool.workers == 3
    with worker_pool("threads", None) as as_many_as_processors:
        processors = os.sched_getaffinity(0)
        assert as_many_as_processors.workers == len(processors)

    worker_pool("processes", 2)
    worker_pool("tcp://10.0.0.1:8786", None)
    on_processes, on_scheduler = started
    assert on_processes == ("processes", 2)
    assert on_scheduler == ("scheduler", "tcp://10.0.0.1:8786", None)

    with pytest.raises(UsageError):
        worker_pool("process", None)


def test_another_file_is_never_replaced_by_a_table(few: Path, tmp_path: Path) -> None:
    notes = tmp_path / "notes.csv"
    notes.write_text("my notes\n")
    assert _fleet(few, "--csv", notes) == ExitCode.USAGE
    assert notes.read_text() == "my notes\n"
    fleet_path = tmp_path / "absent" / "fleet.csv"
    assert _fleet(few, "--csv", fleet_path) == ExitCode.UNEXPECTED
    assert _fleet(few, "--out", notes) == ExitCode.USAGE


def test_an_error_that_no_one_expected_is_a_row(few: Path, monkeypatch: pytest.MonkeyPatch) -> None:

    def sometimes(cell: CellLogs, loop: Loop, created: datetime) -> FleetFit | Failure:
        if cell.cell == "cell-002":
            raise MemoryError
        return fit_cell(cell, loop, created)

    monkeypatch.setattr(fleet_module, "fit_cell", sometimes)
    rows = _fitted(few, None)
    are_fitted = [row.fitted for row in rows]
    assert are_fitted == [True, False, True]
    expected = Failure("MemoryError", "MemoryError", ExitCode.UNEXPECTED)
    assert rows[1].result == expected


def test_heads_that_no_one_could_read_are_rows(few: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def killed(_logs: object) -> None:
        raise MemoryError

    monkeypatch.setattr(fleet_module, "survey", killed)
    rows = _fitted(few, None)
    assert len(rows) == 7
    assert not any(row.fitted for row in rows)


def test_a_name_that_is_no_text_ends_nothing(
    few: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Bytes that are no UTF-8, in a log of a cell and in one of no cell."""
    shutil.rmtree(few / "cell-000")
    bare_path = few / "cell-002" / "bare.mcap"
    no_utf8 = os.fsdecode(b"b\xff.mcap")
    bare_path.rename(few / "cell-002" / no_utf8)
    (few / os.fsdecode(b"=c\xff\x1b[2J.mcap")).write_bytes(b"\x89MCAP0\r\nno log of ours")
    out = tmp_path / "out"
    table = tmp_path / "fleet.csv"
    code = _fleet(few, "--out", out, "--csv", table)
    assert code == ExitCode.DATA_UNFIT
    assert "\x1b[2J" not in capsys.readouterr().out
    string_io = io.StringIO(table.read_text())
    dict_reader = csv.DictReader(string_io)
    names = [row["cell"] for row in dict_reader]
    assert names == ["cell-002", "cell-003", "'=c\\udcff\x1b[2J.mcap"]

    assert _fleet(few, "--out", out, "--json") == ExitCode.DATA_UNFIT
    printed = capsys.readouterr().out
    cells = json.loads(printed.encode())["cells"]
    exit_codes = [cell["exit_code"] for cell in cells]
    assert exit_codes == [4, 0, 4]
    error = cells[0]["error"]
    assert "rename it" in error["text"]
    fit_names = " ".join(cells[0]["fit"])
    assert "b\\udcff.mcap" in fit_names


def test_a_log_that_changes_meanwhile_is_reported(few: Path) -> None:
    cells = _by_cell(few)
    bare_path = few / "cell-002" / "bare.mcap"
    shutil.copy(bare_path, few / "cell-003" / "loaded.mcap")
    loaded_path = few / "cell-000" / "loaded.mcap"
    held_out_path = few / "cell-000" / "held-out.mcap"
    shutil.copy(loaded_path, held_out_path)
    results = [fit_cell(cell, Loop.OPEN, CREATED) for cell in cells]
    first, second, third = results
    assert isinstance(first, Failure)
    assert first.kind == "LogRepeated"
    assert isinstance(second, FleetFit)
    assert isinstance(third, Failure)
    assert third.kind == "LogsDiffer"

    log, *others = cells[1].fit
    changed_log = replace(log, fingerprint="0" * 64)
    stale = replace(cells[1], fit=(changed_log, *others))
    made = fit_cell(stale, Loop.OPEN, CREATED)
    assert isinstance(made, Failure)
    assert "another content" in made.text


class _Gone(Executor):
    """Whose scheduler has died: everything is cancelled, or nothing ever comes back."""

    def __init__(self, cancels: bool) -> None:
        self.cancels = cancels

    def submit(self, _function: Callable[..., Any], /, *_: Any, **__: Any) -> Future[Any]:
        future: Future[Any] = Future()
        if self.cancels:
            future.cancel()
            future.set_running_or_notify_cancel()
        return future


@pytest.mark.parametrize("cancels", [True, False])
def test_workers_that_have_gone_end_it(cancels: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet_module, "WORKER_CHECK_S", 0.01)
    pool = WorkerPool(_Gone(cancels), 2, lambda: False)

    def submit(piece: int) -> Future[str]:
        return pool.executor.submit(str, piece)

    work = (1, 2, 3)
    outcomes = each(submit, work, pool)
    with pytest.raises(WorkersLost, match="goes on where it was"):
        next(outcomes)


@given(st.integers(1, 5), st.integers(0, 30))
def test_no_more_is_in_work_than_there_are_workers(workers: int, pieces: int) -> None:
    handed = 0
    back = 0
    most = 0
    with ThreadPoolExecutor(workers) as executor:

        def submit(piece: int) -> Future[int]:
            nonlocal handed, most
            handed += 1
            most = max(most, handed - back)
            return executor.submit(pow, piece, 2)

        results = {}
        pool = WorkerPool(executor, workers, lambda: True)
        for piece, made in each(submit, range(pieces), pool):
            results[piece] = made
            back += 1
    squares = {piece: piece**2 for piece in range(pieces)}
    assert results == squares
    # The next one goes out before the finished one is examined.
    assert most <= workers + 1


def _seen_logs() -> st.SearchStrategy[list[SeenLog]]:
    same_log = st.just(StoredLog("", ""))
    same_fingerprint = st.just("")
    cells = st.sampled_from(("a", "b"))
    configurations = st.sampled_from(("1", "2"))
    mountings = st.sampled_from((None, "x", "y"))
    times_ns = st.integers(0, 5)
    one = st.builds(
        SeenLog,
        log=same_log,
        fingerprint=same_fingerprint,
        cell=cells,
        configuration_sha256=configurations,
        mounting=mountings,
        started_ns=times_ns,
    )

    def numbered(logs: list[SeenLog]) -> list[SeenLog]:
        changed = []
        for number, log in enumerate(logs):
            stored = StoredLog(f"/{number}", str(number))
            fingerprint = f"{number:064x}"
            changed.append(replace(log, log=stored, fingerprint=fingerprint))
        return changed

    return st.lists(one, max_size=12).map(numbered)


@given(_seen_logs(), st.randoms(use_true_random=False))
def test_every_log_has_one_role_in_one_cell(logs: list[SeenLog], random: Any) -> None:
    cells = by_cell(logs)

    used: list[SeenLog] = []
    identities = []
    for cell in cells:
        logs_of_cell = (*cell.fit, *cell.holdout)
        used.extend(logs_of_cell)
        identity = (cell.cell, cell.configuration_sha256)
        identities.append(identity)
        logs_identities = {(seen.cell, seen.configuration_sha256) for seen in logs_of_cell}
        assert logs_identities == {identity}
    used_names = sorted(seen.log.name for seen in used)
    names = sorted(seen.log.name for seen in logs)
    assert used_names == names
    assert len(set(identities)) == len(cells)

    for cell in cells:
        fitted = [seen.mounting for seen in cell.fit]
        with_payload = [seen for seen in cell.fit if seen.mounting is not None]
        assert len(cell.holdout) <= 1
        for held_out in cell.holdout:
            assert held_out.mounting is not None
            assert {held_out.mounting, None} <= set(fitted)
            for seen in with_payload:
                assert seen.started_ns <= held_out.started_ns
        if not cell.holdout and None in fitted:
            for newest in with_payload[-1:]:
                assert fitted.count(newest.mounting) == 1

    shuffled = list(logs)
    random.shuffle(shuffled)
    assert by_cell(shuffled) == cells


def test_a_log_that_cannot_be_read_is_reported_by_its_name(tmp_path: Path) -> None:
    (tmp_path / "gone.mcap").symlink_to(tmp_path / "nowhere")
    address = str(tmp_path / "gone.mcap")
    logs = [StoredLog(address, "gone.mcap")]
    (found,) = survey(logs)
    assert isinstance(found, UnknownLog)
    assert isinstance(found.error, DaqError)


def test_a_failure_names_options_of_the_command_line() -> None:
    error = DataUnfit("run", "no `Run.payload`")
    assert "record --payload NAME --mass KG" in failure_of(error).text
