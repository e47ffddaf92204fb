"""Processor time to start: the help of every verb, and `scan`,
`info` and `history` on a small cell and log.
"""

from __future__ import annotations

import os
import shutil
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

from daq.cli.app import VERBS

CELL = Path("configs/cells/demo.yaml")


def start_up(out: Path, log: Path, repeats: int, environment: dict[str, str]) -> dict[str, float]:
    """Median processor time of whole commands [s].

    Args:
        out: folder for a copy of the demo cell, whose history is made there.
        log: that `info` reads.
        repeats: of every command.
        environment: of the commands.
    """
    folder = out / "start-up"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree("configs", folder, ignore=shutil.ignore_patterns("*.jsonl*", "*.sqlite*"))
    cell = str(folder / "cells" / CELL.name)
    commands = {f"{verb.name} --help": [verb.name, "--help"] for verb in VERBS}
    commands |= {
        "scan": ["scan", cell, "--wait", "0.05"],
        "info": ["info", str(log)],
        "history": ["history", cell],
    }
    medians_s = {}
    for name, command in commands.items():
        medians_s[name] = statistics.median(_seconds(command, environment) for _ in range(repeats))
    return medians_s


def _seconds(command: list[str], environment: dict[str, str]) -> float:
    silent: dict[str, Any] = {
        "stdout": subprocess.DEVNULL,
        "stderr": subprocess.DEVNULL,
        "env": environment,
    }
    with subprocess.Popen([sys.executable, "-m", "daq", *command], **silent) as child:
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
    return usage.ru_utime + usage.ru_stime


def summary_text(seconds: dict[str, float]) -> str:
    """A line for each command."""
    lines = [f"  {name:22} {value:.2f} s" for name, value in seconds.items()]
    return "\n".join(("start-up, processor time of whole commands:", *lines))
