"""`make bench`: speed and memory against figaroh and loops over Pinocchio,
growth to 4 million samples, a whole fit, start-up, reading logs, and a fleet.

Prints ratios and writes out/bench.json; asserts nothing, because no clock of this machine is a
property of the code. Each job runs in a child process of its own, and this one stays small: Linux
counts what a parent holds to the peak of its children. One core: every child process gets one
thread for its linear algebra, figaroh's too.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from tests.bench.compiled import NotCompiled, compiled
from tests.bench.figaroh_environment import figaroh_python
from tests.bench.fleet import summary_text as fleet_text
from tests.bench.log_reading import summary_text
from tests.bench.start_up import start_up
from tests.bench.start_up import summary_text as start_up_text

OUT = Path("out/bench")
RESULT = Path("out/bench.json")
URDF = Path("configs/robots/tx40.urdf")
LOGS = ("bare", "loaded")
SAMPLES = 100_000
SIZES = (100_000, 500_000, 1_000_000, 2_000_000, 4_000_000)
ENVIRONMENT = os.environ | dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"
)


def main() -> int:
    """Run all six, one after the other."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--repeats", type=int, default=3, help="of the comparison with figaroh; the median counts"
    )
    parser.add_argument("--largest", type=int, default=SIZES[-1], help="samples, of the growth")
    parser.add_argument(
        "--hour", type=int, default=3600, help="seconds of the long log that is read"
    )
    parser.add_argument("--cells", type=int, default=200, help="of the fleet")
    parser.add_argument(
        "--only-comparison", action="store_true", help="with figaroh and Pinocchio; nothing else"
    )
    arguments = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    comparison = _comparison(arguments.repeats)
    if arguments.only_comparison:
        return 0
    growth = _growth(tuple(size for size in SIZES if size <= arguments.largest))
    whole_fit = _whole_fit(arguments.repeats)
    start = start_up(OUT, OUT / f"{LOGS[0]}.mcap", arguments.repeats, ENVIRONMENT)
    _print_line(f"\n{start_up_text(start)}")
    log_reading = _log_reading(arguments.hour)
    fleet = _fleet(arguments.cells, arguments.repeats)
    result = {
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": _machine(),
        "comparison": comparison,
        "growth": growth,
        "fit": whole_fit,
        "start_up": start,
        "log_reading": log_reading,
        "fleet": fleet,
    }
    RESULT.write_text(json.dumps(result, indent=2) + "\n")
    _print_line(f"\nwritten: {RESULT}")
    return 0


def _comparison(repeats: int) -> dict[str, Any]:
    python = figaroh_python()
    data = OUT / "measurements.npz"
    _print_line(
        f"{SAMPLES} samples × 6 axes: rows of 84 standard parameters, base parameters, "
        "least squares; one core"
    )
    make = [sys.executable, "-m", "tests.bench.synthetic", str(URDF), str(SAMPLES), str(data)]
    subprocess.run(make, env=ENVIRONMENT, check=True)
    predicted = {"ours": OUT / "predicted-ours.npy", "figaroh": OUT / "predicted-figaroh.npy"}
    ours = [
        sys.executable,
        "-m",
        "tests.bench.our_fit",
        str(data),
        str(URDF),
        str(predicted["ours"]),
    ]
    figaroh = [
        str(python),
        "tests/bench/figaroh_fit.py",
        str(data),
        str(URDF),
        str(predicted["figaroh"]),
    ]
    commands = {
        "ours": ours,
        "figaroh": figaroh,
        "Pinocchio in Python": [
            sys.executable,
            "-m",
            "tests.bench.pinocchio_fit",
            str(data),
            str(URDF),
        ],
    }
    compiled_command = _compiled(data)
    if compiled_command is not None:
        commands["Pinocchio in C++"] = compiled_command
    found = {name: _json_of([*command, str(repeats)]) for name, command in commands.items()}
    our_torque, their_torque = (np.load(predicted[name]) for name in ("ours", "figaroh"))
    difference = float(np.max(np.abs(our_torque - their_torque)) / np.max(np.abs(their_torque)))
    _print_line(
        "\n| | processor time s, median (all) | ratio | base parameters | residual norm Nm | "
        "peak MB |\n"
        "|---|---|---|---|---|---|"
    )
    for name, figures in found.items():
        totals = [run["total"] for run in figures["seconds"]]
        figures["median_seconds"] = statistics.median(totals)
        figures["ratio"] = figures["median_seconds"] / found["ours"]["median_seconds"]
        all_totals = ", ".join(f"{total:.3f}" for total in totals)
        _print_line(
            f"| {name} | {figures['median_seconds']:.3f} ({all_totals}) | {figures['ratio']:.2f} "
            f"| {figures['base_parameters']} | {figures['residual_norm_nm']:.9g} | "
            f"{figures['peak_mb']:.0f} |"
        )
    _print_line(f"predicted torques differ from figaroh's by {difference:.1e} of the largest")
    for key, which in (
        ("bare_qr_seconds", "that ours reduces"),
        ("standard_qr_seconds", "of all standard parameters"),
    ):
        bare_qr = statistics.median(found["ours"][key])
        _print_line(
            f"LAPACK's QR (dgeqrf) of each joint's columns {which}, rows already built: "
            f"{bare_qr:.3f} s; the whole of ours is "
            f"{found['ours']['median_seconds'] / bare_qr:.2f} times that"
        )
    return {
        "samples": SAMPLES,
        **found,
        "ratio": found["figaroh"]["ratio"],
        "largest_relative_difference": difference,
    }


def _compiled(data: Path) -> list[str] | None:
    """Command of the compiled program without the repeats;
    None without a compiler, and it is said.
    """
    folder = OUT / "compiled"
    folder.mkdir(parents=True, exist_ok=True)
    _print_line("compiling Pinocchio's regressor and LAPACK's QR in C++ (a minute)")
    try:
        program = compiled(folder)
    except NotCompiled as error:
        _print_line(f"without C++: {error}")
        return None
    measurements = folder / "measurements.bin"
    joints = folder / "joints.txt"
    write = [
        sys.executable,
        "-m",
        "tests.bench.compiled_inputs",
        str(data),
        str(URDF),
        str(measurements),
        str(joints),
    ]
    subprocess.run(write, check=True)
    return [str(program), str(measurements), str(joints)]


def _growth(sizes: tuple[int, ...]) -> list[dict[str, Any]]:
    _print_line(
        "\n| samples | processor time s | µs a sample | against the first | peak MB | residual std "
        "Nm (true: 1) |"
    )
    _print_line("|---" * 6 + "|")
    rows: list[dict[str, Any]] = []
    for size in sizes:
        row = _json_of([sys.executable, "-m", "tests.bench.growth", str(URDF), str(size)])
        row["microseconds_a_sample"] = 1e6 * row["seconds"] / size
        row["against_first"] = (
            row["microseconds_a_sample"] / (rows or [row])[0]["microseconds_a_sample"]
        )
        rows.append(row)
        _print_line(
            f"| {size} | {row['seconds']:.2f} | {row['microseconds_a_sample']:.2f} | "
            f"{row['against_first']:.2f} | {row['peak_mb']:.0f} | {row['residual_std_nm']:.4f} |"
        )
    return rows


def _whole_fit(repeats: int) -> dict[str, Any]:
    subprocess.run([sys.executable, "-m", "tests.bench.finished_logs", str(OUT)], check=True)
    logs = [str(OUT / f"{name}.mcap") for name in LOGS]
    command = [sys.executable, "-m", "daq", "fit", *logs, "--method", "ml", "--json"]
    runs = []
    for _ in range(repeats):
        calibration = OUT / "calibration.yaml"
        calibration.unlink(missing_ok=True)
        with subprocess.Popen(
            [*command, "--out", str(calibration)], stdout=subprocess.DEVNULL, env=ENVIRONMENT
        ) as child:
            _, status, usage = os.wait4(child.pid, 0)
            child.returncode = os.waitstatus_to_exitcode(status)
        if child.returncode:
            raise SystemExit(f"`{' '.join(command)}` ended with {child.returncode}")
        runs.append(
            {"user": usage.ru_utime, "system": usage.ru_stime, "peak_mb": usage.ru_maxrss / 1024.0}
        )
    seconds = statistics.median(run["user"] + run["system"] for run in runs)
    _print_line(
        f"\nfit by ml, two finished logs of 60 s at 1 kHz to calibration.yaml: {seconds:.2f} s of "
        "processor time"
    )
    for run in runs:
        _print_line(
            f"  user {run['user']:.2f} s, system {run['system']:.2f} s, peak "
            f"{run['peak_mb']:.0f} MB"
        )
    return {"seconds": seconds, "runs": runs}


def _log_reading(hour_s: int) -> dict[str, Any]:
    _print_line("")
    found = _json_of(
        [sys.executable, "-m", "tests.bench.log_reading", "--json", "--hour", str(hour_s)]
    )
    _print_line(summary_text(found))
    return found


def _fleet(cells: int, repeats: int) -> dict[str, Any]:
    _print_line(f"\n`drivegain fleet` on {cells} simulated cells, wall time of whole commands")
    found = _json_of(
        [
            sys.executable,
            "-m",
            "tests.bench.fleet",
            "--json",
            "--cells",
            str(cells),
            "--repeats",
            str(repeats),
        ]
    )
    _print_line(fleet_text(found))
    return found


def _json_of(command: list[str]) -> dict[str, Any]:
    """Return what a child process prints; its stderr is shown only if it fails."""
    child = subprocess.run(command, capture_output=True, text=True, env=ENVIRONMENT, check=False)
    if child.returncode:
        raise SystemExit(f"`{' '.join(command)}` ended with {child.returncode}:\n{child.stderr}")
    return dict(json.loads(child.stdout.splitlines()[-1]))


def _machine() -> dict[str, Any]:
    return {
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "numpy": np.__version__,
        "load_average": os.getloadavg(),
    }


def _print_line(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
