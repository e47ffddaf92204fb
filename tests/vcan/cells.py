"""The demo cell on vcan0, with its amplifiers in a process of their own,
and what the verbs say of it.
"""

from __future__ import annotations

import io
import json
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

from daq.cli.app import main
from daq.errors import ExitCode
from tests.vcan.run import INTERFACE

CONFIGURATIONS = Path(__file__).parents[2] / "configs"
SIMULATION = "clean"
MAX_SUBSTEPS = 100
POSITION_CUTOFF = 0.2
DECIMATION_CUTOFF = 0.1
"""Fraction of the sampling rate."""


ON_THE_KERNEL = f"bus:\n  interface: socketcan\n  channel: {INTERFACE}\n  bitrate_bit_s: 1000000\n"


def write_cell(folder: Path, period_us: int, pacing: str, bus: str = ON_THE_KERNEL) -> Path:
    """A folder with the demo cell's file, its bus vcan0 or another one,
    and a copy of its controller's file.
    """
    shutil.copy(CONFIGURATIONS / "controllers" / "demo.yaml", folder / "controller.yaml")
    text = (CONFIGURATIONS / "cells" / "demo.yaml").read_text(encoding="utf-8")
    text = text.replace("../robots", str(CONFIGURATIONS / "robots"))
    text = text.replace("../controllers/demo.yaml", "controller.yaml")
    bus += f"sync:\n  period_us: {period_us}\n  pacing: {pacing}\n"
    # There is nothing above half the rate, and the filters need room below that.
    rate_hz = 1e6 / period_us
    text = text.replace(
        "position_cutoff_hz: 40.0", f"position_cutoff_hz: {POSITION_CUTOFF * rate_hz}"
    )
    text = text.replace(
        "decimation_cutoff_hz: 20.0", f"decimation_cutoff_hz: {DECIMATION_CUTOFF * rate_hz}"
    )
    path = folder / "cell.yaml"
    path.write_text(re.sub(r"bus:\n.*?(?=axes:)", bus, text, flags=re.DOTALL), encoding="utf-8")
    return path


def write_simulation(folder: Path, period_us: int) -> Path:
    """The clean cell's truth at another sync period;
    the mechanics are computed as finely as before, or nearly so.
    """
    text = (CONFIGURATIONS / "simulation" / f"{SIMULATION}.yaml").read_text(encoding="utf-8")
    text = text.replace("tx40-plant.urdf", str(CONFIGURATIONS / "simulation" / "tx40-plant.urdf"))
    text = re.sub(r"sync_period_us: \d+", f"sync_period_us: {period_us}", text)
    text = re.sub(r"substeps: \d+", f"substeps: {min(4 * period_us // 1000, MAX_SUBSTEPS)}", text)
    path = folder / "simulation.yaml"
    path.write_text(text, encoding="utf-8")
    return path


@contextmanager
def simulated(
    simulation: Path, payload: str | None = None, buses: Mapping[str, Sequence[int]] | None = None
) -> Iterator[None]:
    """`drivegain simulate` on vcan0, or on several interfaces with their nodes,
    until the block ends.
    """
    command = [sys.executable, "-m", "daq", "simulate", str(simulation), "--interface", "socketcan"]
    for channel, nodes in (buses or {}).items():
        command += ["--bus", f"{channel}={','.join(map(str, nodes))}"]
    command += ["--channel", INTERFACE, *(() if payload is None else ("--payload", payload))]
    folder = CONFIGURATIONS.parent
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=folder
    ) as process:
        try:
            if process.stdout is None or "amplifiers" not in process.stdout.readline():
                raise RuntimeError(f"no simulated cell: {process.communicate()[1]}")
            yield
        finally:
            process.send_signal(signal.SIGINT)
            if process.wait(timeout=60) != 0:
                raise RuntimeError(f"the simulated cell ended with {process.returncode}")


def say(*arguments: str) -> dict[str, Any]:
    """Run a verb of drivegain with --json and return its document; it must succeed."""
    with redirect_stdout(io.StringIO()) as out:
        code = main([*arguments, "--json"])
    assert code == ExitCode.OK, f"drivegain {' '.join(arguments)} ended with {code}"
    document: dict[str, Any] = json.loads(out.getvalue())
    return document


def record_once(cell: Path, plan: Path, log: Path, *mounted: str) -> dict[str, Any]:
    """Document of `record`; a run that supervision ended is as invalid as one that is marked so."""
    moving = ("--enable-motion", "--operator", "test", "--json")
    with redirect_stdout(io.StringIO()) as out:
        code = main(["record", str(cell), str(plan), "--out", str(log), *moving, *mounted])
    if code == ExitCode.DEVICE_FAULT:
        return {"valid": False, "reason": "ended by supervision, see above"}
    assert code in (ExitCode.OK, ExitCode.DATA_UNFIT), f"record ended with {code}"
    document: dict[str, Any] = json.loads(out.getvalue())
    return document
