"""A simulated cell that a process of its own serves over a hub on 127.0.0.1."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def served_cell(folder: Path, checkout: Path) -> Iterator[Path]:
    """Serve the clean demo cell within the block;
    yields a cell file in the folder whose bus is its hub.
    """
    configs = checkout / "configs"
    command = [
        sys.executable,
        "-m",
        "daq",
        "simulate",
        str(configs / "simulation" / "clean.yaml"),
        "--port",
        "0",
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=checkout) as process:
        try:
            assert process.stdout is not None
            recorded = list(iter(process.stdout.readline, "\n")) + list(
                iter(process.stdout.readline, "\n")
            )
            # What it prints to paste is pasted.
            bus = "".join(recorded[recorded.index("bus:\n") :])
            text = (
                (configs / "cells" / "demo.yaml")
                .read_text()
                .replace("../robots", str(configs / "robots"))
            )
            path = folder / "cell.yaml"
            path.write_text(re.sub(r"bus:\n.*?(?=axes:)", bus, text, flags=re.DOTALL))
            yield path
        finally:
            process.send_signal(signal.SIGINT)
            assert process.wait(timeout=20) == 0
