"""A process that has imported the libraries already, and runs pytest in a fork of itself.

Imports take most of the time of a short run of pytest. `python -m tests.mutation.fork_server`
reads a request a line from its input and answers each with a line, both JSON. It is started in
the tree that is tested and imports nothing of the product, so each fork sees the present sources.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import math
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import pytest

LIBRARIES = (
    "can",
    "canopen",
    "cryptography.hazmat.primitives.asymmetric.ed25519",
    "hypothesis",
    "mcap.reader",
    "mcap.writer",
    "numba",
    "numpy.testing",
    "pinocchio",
    "pydantic",
    "rich.console",
    "rich.progress",
    "rosbags.highlevel",
    "ruamel.yaml",
    "scipy.linalg",
    "scipy.optimize",
    "scipy.signal",
    "scipy.spatial.transform",
    "scipy.special",
    "scipy.stats",
    "starlette.applications",
    "typer",
    "uvicorn",
    "yaml",
)
"""What the product imports and takes long; a library that is not installed is left out."""

TIMED_OUT = -1
"""Exit status of a run that did not end in time."""

LOOK_S = 0.02
"""Time between two looks at whether a fork has ended."""


@dataclass(frozen=True, slots=True)
class Run:
    """What one run of pytest ended with.

    Attributes
    ----------
    status : exit status of pytest, or `TIMED_OUT`.
    printed : what it printed.

    """

    status: int
    printed: str


class ForkServer:
    """A fork server in a tree; a context manager that ends it.

    Parameters
    ----------
    tree : folder that is tested: a checkout.
    environment : environment of the server and of the tests.

    """

    def __init__(self, tree: Path, environment: dict[str, str]) -> None:
        self._tree = tree
        self._environment = environment
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> Self:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.mutation.fork_server"],
            cwd=self._tree,
            env=self._environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        assert self._process is not None
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()

    def run(self, tests: list[str], timeout_s: float, processor_s: float) -> Run:
        """Run tests until the first that fails, files in the order of their first test.

        Parameters
        ----------
        tests : names of tests, such as `tests/a/test_b.py::test_c[1]`.
        timeout_s : time in s after which the run and what it started is killed.
        processor_s : the same for processor time, which a busy machine does not make longer.

        """
        assert self._process is not None
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        request = {"tests": tests, "timeout_s": timeout_s, "processor_s": processor_s}
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        if not answer:
            raise RuntimeError("the fork server has ended: see its messages above")
        return Run(**json.loads(answer))


class _Selection:
    """Pytest plugin: keep the tests that are named.

    Names as arguments would not do: one that a fault takes away would be an error of usage.
    """

    def __init__(self, tests: list[str]) -> None:
        self._tests = set(tests)

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = [item for item in items if item.nodeid in self._tests]


def _run_here(tests: list[str]) -> int:
    files = dict.fromkeys(test.split("::", maxsplit=1)[0] for test in tests)
    arguments = ["-q", "-x", "-n", "0", "-p", "no:cacheprovider"]
    # Hypothesis was imported before pytest could rewrite its assertions.
    arguments += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]
    return int(pytest.main([*arguments, *files], plugins=[_Selection(tests)]))


def _fork(request: dict[str, Any], printed: Path) -> int:
    child = os.fork()
    if child:
        return child
    status = 3
    try:
        os.setsid()
        output = os.open(printed, os.O_WRONLY | os.O_TRUNC)
        nothing = os.open(os.devnull, os.O_RDONLY)
        os.dup2(nothing, 0)
        os.dup2(output, 1)
        os.dup2(output, 2)
        limit_s = math.ceil(request["processor_s"])
        resource.setrlimit(resource.RLIMIT_CPU, (limit_s, limit_s))
        status = _run_here(request["tests"])
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(status)


def _wait(child: int, timeout_s: float) -> int:
    """Exit status of a fork; nothing that it started is left behind."""
    ends_at_s = time.monotonic() + timeout_s
    status = TIMED_OUT
    while time.monotonic() < ends_at_s:
        ended, code = os.waitpid(child, os.WNOHANG)
        if ended:
            status = os.waitstatus_to_exitcode(code)
            break
        time.sleep(LOOK_S)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
    if status == TIMED_OUT:
        os.waitpid(child, 0)
    if status == -signal.SIGKILL:
        # Linux ends a process so where soft and hard limit of processor time are the same.
        status = TIMED_OUT
    return status


def main() -> int:
    """Serve until the input ends."""
    for library in LIBRARIES:
        with contextlib.suppress(ImportError):
            importlib.import_module(library)
    gc.freeze()
    with tempfile.NamedTemporaryFile() as file:
        printed = Path(file.name)
        for line in sys.stdin:
            request = json.loads(line)
            child = _fork(request, printed)
            status = _wait(child, request["timeout_s"])
            answer = {"status": status, "printed": printed.read_text(errors="replace")}
            sys.stdout.write(json.dumps(answer) + "\n")
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
