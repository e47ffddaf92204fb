"""`drivegain fleet` on 200 simulated cells:
one worker against two, and whether all results are those of single fits.

    python -m tests.bench.fleet [--cells 200] [--repeats 3] [--json]

Wall time of whole commands, workers started and libraries imported included: it is about cells side
by side, so other work on the machine disturbs it. Commands with one worker and with two take turns;
the median of each counts. A ratio below 1.7 is reported. It ends with 1 where a result is another
one than that of a single fit.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from daq.documents.calibration_file import as_document, load_calibration
from daq.workflow.fit import calibration_of, fit
from tests.bench.fleet_cells import CELLS, FleetCell, make_fleet, print_line

LOGS = Path("out/bench/fleet")
OUT = Path("out/bench/fleet-results")
EXPECTED_RATIO = 1.7
"""Of the wall time with one worker to that with two,
on two processors that have nothing else to do.
"""
CREWS = (("processes", 1), ("processes", 2), ("threads", 2))
ENVIRONMENT = os.environ | dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"
)


def main() -> int:
    """Make what is missing, measure, compare."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cells", type=int, default=CELLS)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", action="store_true", help="one line of JSON at the end")
    parser.add_argument(
        "--single",
        type=Path,
        help="folder of one cell after another to fit, as the child process does",
    )
    arguments = parser.parse_args()
    if arguments.single is not None:
        sys.stdout.write(
            json.dumps(
                {folder.name: _single(folder) for folder in sorted(arguments.single.iterdir())}
            )
        )
        return 0
    make_fleet(LOGS, arguments.cells, print_line)
    # A folder of as many as were asked for: more may have been made.
    chosen = OUT / "logs"
    shutil.rmtree(OUT, ignore_errors=True)
    names = [FleetCell(LOGS, number, ()).name for number in range(arguments.cells)]
    for name in names:
        (chosen / name).mkdir(parents=True)
        for log in (LOGS / name).iterdir():
            (chosen / name / log.name).symlink_to(log.resolve())
    begun_s = time.perf_counter()
    # In a process with one thread for its linear algebra: with more, the last digits are others.
    command = [sys.executable, "-m", "tests.bench.fleet", "--single", str(chosen)]
    single = json.loads(
        subprocess.run(command, stdout=subprocess.PIPE, env=ENVIRONMENT, check=True).stdout
    )
    single_s = time.perf_counter() - begun_s
    runs: dict[str, list[dict[str, float]]] = {f"{kind} {workers}": [] for kind, workers in CREWS}
    equal = len(names)
    for repeat in range(arguments.repeats):
        for kind, workers in CREWS:
            out = OUT / f"{kind}-{workers}-{repeat}"
            figures = _fleet(chosen, out, kind, workers)
            runs[f"{kind} {workers}"].append(figures)
            same = sum(single[name] == _kept(out, name) for name in names)
            equal = min(equal, same)
            print_line(
                f"--scheduler {kind} --workers {workers}: {figures['seconds']:.1f} s, processor "
                f"time {figures['processor_s']:.1f} s, largest process {figures['peak_mb']:.0f} "
                f"MB, {same} of {len(names)} equal"
            )
    found = {
        "cells": len(names),
        "single_s": single_s,
        "runs": runs,
        "equal": equal,
        "load": os.getloadavg(),
    }
    medians = {}
    for name, several in runs.items():
        medians[name] = statistics.median(run["seconds"] for run in several)
    found |= {"seconds": medians, "ratio": medians["processes 1"] / medians["processes 2"]}
    print_line(json.dumps(found) if arguments.json else summary_text(found))
    return 0 if equal == len(names) else 1


def summary_text(found: dict[str, Any]) -> str:
    """The figures, for a person."""
    lines = [f"{found['cells']} single fits in one process: {found['single_s']:.1f} s"]
    for name, runs in found["runs"].items():
        seconds = ", ".join(f"{run['seconds']:.1f}" for run in runs)
        lines.append(
            f"  {name}: {seconds} s, processor time "
            f"{statistics.median(run['processor_s'] for run in runs):.1f} s, largest process "
            f"{max(run['peak_mb'] for run in runs):.0f} MB"
        )
    lines.append(
        f"  two workers against one: {found['ratio']:.2f}; equal results {found['equal']} "
        f"of {found['cells']}"
    )
    if found["ratio"] < EXPECTED_RATIO:
        lines.append(
            f"  below the {EXPECTED_RATIO:g} that an idle machine gives; load "
            f"{found['load'][0]:.1f}"
        )
    threads = found["seconds"]["processes 1"] / found["seconds"]["threads 2"]
    lines.append(f"  two threads against one worker: {threads:.2f}")
    return "\n".join(lines)


def _single(folder: Path) -> dict[str, Any]:
    """Result of `drivegain fit` for a cell's logs, without its time."""
    fitted = fit([folder / "bare.mcap", folder / "loaded.mcap"], holdout=[folder / "held-out.mcap"])
    return _timeless(as_document(calibration_of(fitted, datetime.now(UTC))))


def _kept(out: Path, name: str) -> dict[str, Any]:
    (file,) = out.glob(f"{name}-*.yaml")
    # Through JSON as the single ones: it gives every number back as it was.
    kept: dict[str, Any] = json.loads(json.dumps(_timeless(as_document(load_calibration(file)))))
    return kept


def _timeless(document: dict[str, object]) -> dict[str, Any]:
    return {key: value for key, value in document.items() if key != "created"}


def _fleet(logs: Path, out: Path, kind: str, workers: int) -> dict[str, float]:
    command = [
        sys.executable,
        "-m",
        "daq",
        "fleet",
        str(logs),
        "--scheduler",
        kind,
        "--workers",
        str(workers),
    ]
    begun_s = time.perf_counter()
    with subprocess.Popen(
        [*command, "--out", str(out), "--json"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=ENVIRONMENT,
    ) as child:
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise SystemExit(f"`{' '.join(command)}` ended with {child.returncode}")
    return {
        "seconds": time.perf_counter() - begun_s,
        "processor_s": usage.ru_utime + usage.ru_stime,
        "peak_mb": usage.ru_maxrss / 1024.0,
    }


if __name__ == "__main__":
    sys.exit(main())
