"""Fixtures of all tests on the kernel's CAN:
they are marked `vcan`, and skipped where there is no vcan0.

Beside each module listens a process of its own, and every log that the module made is compared with
what it heard.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.vcan.host_stalls import stalls_between
from tests.vcan.host_watch import watched, watching
from tests.vcan.judgement import SAME_SYNC_NS, compare
from tests.vcan.listener import heard, listening
from tests.vcan.log_reader import read_recorded
from tests.vcan.run import INTERFACE

SECOND_BUS_NS = 10_000_000
"""SYNC is sent on one bus after the other, by a process that may have to wait between;
cycles last 40 ms there.
"""
WITHOUT_CAN = ("test_run.py", "test_judgement.py", "test_host_stalls.py")
ATTEMPTS = 8
"""A guest on a busy host stands still for a moment: SYNC is late, or the amplifiers miss the
recorder, and the run is ended or marked invalid as at a real cell. One records again.
"""
FIGURES = pytest.StashKey[list[str]]()
EXCUSED = pytest.StashKey[dict[BaseException, str]]()
"""Reason by the error that is excused: a fixture of a module raises the same one for each test."""
HOST_WATCH = pytest.StashKey[Path]()


def pytest_configure(config: pytest.Config) -> None:
    """Make the marker known."""
    config.addinivalue_line(
        "markers", f"vcan: needs the kernel's CAN as {INTERFACE} (make test-vcan)"
    )
    config.stash[FIGURES] = []
    config.stash[EXCUSED] = {}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what is in this folder."""
    here = Path(__file__).parent
    absent = not (Path("/sys/class/net") / INTERFACE).exists()
    for item in items:
        if here in item.path.parents and item.path.name not in WITHOUT_CAN:
            item.add_marker("vcan")
            if absent:
                item.add_marker(
                    pytest.mark.skip(
                        reason=f"no {INTERFACE} in this kernel; `make test-vcan` brings one"
                    )
                )


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Skip a test that failed while the machine stood still again and again.

    What the logs hold is compared in the teardown of a module; that is never excused.
    """
    report = yield
    host_watch = item.config.stash.get(HOST_WATCH, None)
    if host_watch is None or call.excinfo is None:
        return report
    if not report.failed or call.when == "teardown":
        return report
    error = call.excinfo.value
    excused = item.config.stash[EXCUSED]
    if error not in excused:
        stalls = stalls_between(watched(host_watch), call.start, call.stop)
        if not stalls.excuse_a_failure:
            return report
        excused[error] = f"it failed, and {stalls}"
    path, line, _ = item.location
    reason = excused[error]
    item.config.stash[FIGURES].append(f"{item.nodeid}: {reason}; {report.longreprtext[-300:]}")
    report.outcome = "skipped"
    report.longrepr = (path, (line or 0) + 1, reason)
    return report


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    """Print what was measured."""
    if config.stash[FIGURES]:
        terminalreporter.section(f"measured on {INTERFACE}")
        for line in config.stash[FIGURES]:
            terminalreporter.line(line)


@pytest.fixture(scope="session")
def figure(pytestconfig: pytest.Config) -> Iterator[Callable[[str], None]]:
    """Takes a line for the end of the session's report."""
    yield pytestconfig.stash[FIGURES].append


@pytest.fixture(scope="session", autouse=True)
def host_watch(
    pytestconfig: pytest.Config,
    tmp_path_factory: pytest.TempPathFactory,
    figure: Callable[[str], None],
) -> Iterator[None]:
    """Notes when the machine stands still, while there is a bus."""
    if not (Path("/sys/class/net") / INTERFACE).exists():
        yield
        return
    path = tmp_path_factory.mktemp("host") / "watch"
    begun_s = time.time()
    with watching(path):
        pytestconfig.stash[HOST_WATCH] = path
        yield
        del pytestconfig.stash[HOST_WATCH]
    figure(str(stalls_between(watched(path), begun_s, time.time())))


@pytest.fixture(scope="module")
def attempts(pytestconfig: pytest.Config) -> range:
    """Numbers of the attempts at a recording; one alone once a test was excused."""
    if pytestconfig.stash[EXCUSED]:
        return range(1, 2)
    return range(1, ATTEMPTS + 1)


@pytest.fixture(scope="module", autouse=True)
def listener(
    request: pytest.FixtureRequest,
    tmp_path_factory: pytest.TempPathFactory,
    figure: Callable[[str], None],
) -> Iterator[None]:
    """Compares every log of a module with an independent listener, bit for bit;
    `BUSES` of the module has the nodes.
    """
    buses: Mapping[str, Sequence[int]] = getattr(request.module, "BUSES", {INTERFACE: range(1, 7)})
    if request.path.name in WITHOUT_CAN or not all(
        (Path("/sys/class/net") / name).exists() for name in buses
    ):
        yield
        return
    base = tmp_path_factory.getbasetemp()
    before = set(_logs(base))
    folder = tmp_path_factory.mktemp("heard")
    with ExitStack() as stack:
        for name in buses:
            stack.enter_context(listening(name, folder / name))
        yield
    made = [path for path in _logs(base) if path not in before]
    problems = []
    values = 0
    flagged = 0
    for name, nodes in buses.items():
        frames = heard(folder / name)
        for path in made:
            if (log := read_recorded(path)) is not None:
                axes = {node - 1: node for node in nodes}
                found = compare(
                    log,
                    frames,
                    axes,
                    same_sync_ns=SAME_SYNC_NS if len(buses) == 1 else SECOND_BUS_NS,
                )
                values = values + found.values
                flagged = flagged + found.flagged
                problems += [
                    f"{path.relative_to(base)}, {name}: {line}" for line in found.violations
                ]
    if made:
        figure(
            f"{request.path.stem}: {len(made)} logs, {values} values bit for bit as on the bus, "
            f"{flagged} missing"
        )
    assert not problems, "\n".join(problems[:20])


def _logs(base: Path) -> list[Path]:
    return sorted(
        path
        for path in base.rglob("*.mcap*")
        if path.is_file() and path.suffix in (".mcap", ".part")
    )
