"""A job that is killed (-9) in a recording, at a cell that is a process of its own;
the next job takes it up.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from daq.documents.session_state import Outcome
from daq.log.container import UNFINISHED
from tests.daq.jobs.made import Made
from tests.daq.jobs.rig import Rig, make_rig
from tests.daq.killing import in_a_child

pytestmark = pytest.mark.processes

SHARE = 0.5  #: Of the size of a whole log that is written when the job is killed: the axes move


@contextmanager
def cell_process(rig: Rig) -> Iterator[None]:
    """`drivegain simulate` on a hub of its own, to which the rig's cell file is changed."""
    command = [sys.executable, "-m", "daq", "simulate", "demo", "--port", "0"]
    mounted_folder = rig.cells / "mounted"
    with subprocess.Popen(
        [*command, "--payload-from", str(mounted_folder)], stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            found = re.search(r"can0@127\.0\.0\.1:(\d+)", process.stdout.readline())
            assert found is not None
            text = rig.cell_file.read_text(encoding="utf-8")
            document = json.loads(text)
            document["bus"] |= {"interface": "socketcand", "channel": "can0", "port": int(found[1])}
            document["bus"] |= {"host": "127.0.0.1"}
            document["sync"]["period_us"] = 1000  # of the shipped simulation
            rig.cell_file.write_text(json.dumps(document), encoding="utf-8")
            yield
        finally:
            process.send_signal(signal.SIGINT)
            assert process.wait(timeout=60) == 0


def real_recorder(rig: Rig, made: Made) -> Rig:
    """The rig with its own recorder and check of the drives; the fit is what was found before."""
    own = rig.tools
    rig.tools = replace(made.tools(rig), drives=own.drives, record=own.record)
    return rig


def kill_while_recording(rig: Rig, name: str, part_bytes: float) -> None:
    """Run the job in a process of its own, and kill it when the unfinished log of this run has that
    size.
    """
    child = in_a_child(lambda: rig.job().exit_code)
    ended = 0
    while not ended:
        files = rig.cells.glob(f"*/*/{name}.mcap{UNFINISHED}")
        parts = [path.stat().st_size for path in files]
        if parts and parts[0] > part_bytes:
            os.kill(child, signal.SIGKILL)
            break
        ended, _ = os.waitpid(child, os.WNOHANG)
        time.sleep(0.002)
    assert not ended, "the job ended before its axes moved"
    _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status)


def taken_up_from_a_recording(rig: Rig, made: Made, name: str, share: float) -> None:
    """Kill a job in a recording, with that share of its log written,
    and let the next one finish the session.
    """
    rig = real_recorder(rig, made)
    with cell_process(rig):
        stat = made.logs[name].stat()
        part_bytes = share * stat.st_size
        kill_while_recording(rig, name, part_bytes)
        assert rig.session.state.outcome is None
        rig.clock.go_on(minutes=10)
        assert rig.job().outcome is Outcome.APPLIED
    assert rig.session.state.attempt == 2
    assert (rig.session.folder / f"{name}-partial-1.mcap").exists()


def test_a_job_killed_in_a_recording_is_taken_up_by_the_next(tmp_path: Path, made: Made) -> None:
    """One moment; `tests.studies.recalibration_study --recordings 5` takes more."""
    folder = tmp_path / "cell"
    rig = make_rig(folder, made.plan_file)
    taken_up_from_a_recording(rig, made, "bare-1", SHARE)
