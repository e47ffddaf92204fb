"""From logs to a calibration file: the gains with their uncertainty,
and the error on a held-out log.

python examples/calibrate_from_logs.py bare.mcap loaded.mcap --held-out other.mcap --out
calibration.yaml
"""

from __future__ import annotations

import argparse
from pathlib import Path

import daq
import ident


def main() -> daq.Calibration:
    """Fit the logs named on the command line, print the gains, and save the calibration."""
    parser = argparse.ArgumentParser(description="Logs to a calibration.")
    parser.add_argument(
        "logs", type=Path, nargs="+", help="runs without load and with a weighed payload"
    )
    parser.add_argument(
        "--held-out", type=Path, nargs="*", default=[], help="runs that the fit must not see"
    )
    parser.add_argument("--out", type=Path, default=Path("calibration.yaml"))
    arguments = parser.parse_args()

    # Each log carries the description of its cell: drive train, robot, limits and payloads.
    calibration = daq.fit_logs(arguments.logs, holdout=arguments.held_out, progress=print)

    for gain in calibration.gains:
        print(
            f"{gain.axis}: {gain.value:8.3f} ± {gain.std:.3f} {gain.unit} (nameplate "
            f"{gain.nameplate:g})"
        )
    for effect in calibration.effects:
        print(
            f"{effect.axis}: effect {effect.name} was missing in the model, and is part of it now"
        )
    if calibration.holdout_error_percent is not None:
        print(f"error on the held-out runs: {calibration.holdout_error_percent.total:.1f} %")

    # The file is written whole and read back; `daq.propose` shows how it would change the current
    # gains.
    daq.save_calibration(calibration, arguments.out)
    return calibration


if __name__ == "__main__":
    try:
        main()
    except (daq.DataError, ident.IdentificationError) as error:
        raise SystemExit(f"{error}") from error  # names the log, what was found, and what to do
