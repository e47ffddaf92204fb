"""What can happen to a recording: readings that are held, drives that give less than asked,
faults of single channels.

Run by `make damage-study`; half an hour. `--part held`, `limited`, `channels` or `sound` makes one
part. The real recordings are in ../shared/data or $DRIVEGAIN_DATA, and what needs one that is not
there is left out.

held: each reading of the TX-40's positions, its currents or both is held for a while, and the error
of the whole arm is that of a fit with the nameplate gains. limited: a simulated drive of J4 gives
1.6 A at most where its reference asks for more. channels: every fault of `planted_faults.py` by
each way, as a table in out/damaged-recordings. sound: the judgement of a simulated run of every
shipped robot and of the real ones, which have none of these faults.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from daq.config.cell import model_of
from daq.config.cell_file import load_cell
from drivers.simulation.spec import UndeclaredEffect
from ident.arrays import FloatArray
from ident.data.run import Run
from ident.estimators.diagnosis import diagnose
from ident.estimators.identify import identify
from tests.studies.effect_cells import EffectCase
from tests.studies.effect_runs import CaseTask, load_runs, make_case
from tests.studies.fault_table import judge_sound_recordings, write_fault_table
from tests.studies.output import print_line
from tests.studies.real_runs import Recording, data_folder, tx40
from tests.studies.study_cells import world_cell
from tests.studies.study_plans import CELL, make_plan

OUT = Path("out/damaged-recordings")
HOLDS_S = (0.002, 0.005, 0.010)
WORLD = "measurement"
LIMITED = EffectCase(
    "limited-J4", 2322, (UndeclaredEffect("clipped-current", 3, {"limit_a": 1.6}),)
)
NOISE_HZ = 300.0  #: From which on the currents of the real arm hold noise alone


def held(channels: FloatArray, samples: int) -> FloatArray:
    """Channels of which every reading stays for so many samples, shape (k, n)."""
    rows = np.arange(len(channels)) // samples * samples
    return np.asarray(channels[rows])


def held_readings(recording: Recording) -> None:
    """Print the error of a real arm with readings that are held."""
    (run,) = recording.runs
    line = f"as recorded: {_error_percent(recording, run):.2f} %"
    print_line(line)
    for hold_s in HOLDS_S:
        samples = round(hold_s * run.rate_hz)
        position_rad = held(run.position_rad, samples)
        position = replace(run, position_rad=position_rad)
        current_a = held(run.current_a, samples)
        current = replace(run, current_a=current_a)
        both = replace(position, current_a=current.current_a)
        errors = [_error_percent(recording, one) for one in (position, current, both)]
        of_each = "positions {:.2f} %, currents {:.2f} %, both {:.2f} %".format(*errors)
        print_line(f"held for {1e3 * hold_s:g} ms: {of_each}")
    noise_a = _noise_a(run)
    print_line(
        f"noise of the currents above {NOISE_HZ:g} Hz: "
        f"{', '.join(f'{one:.3f}' for one in noise_a)} A"
    )


def _error_percent(recording: Recording, run: Run) -> float:
    model = model_of(recording.cell)
    found = identify(model, (run,), recording.cell.conditioning, fixed_gains=recording.gains)
    return found.training_error.total


def _noise_a(run: Run) -> list[float]:
    """Root mean square of each current above NOISE_HZ [A]."""
    spectrum = np.fft.rfft(run.current_a, axis=0)
    frequency_hz = np.fft.rfftfreq(len(run.current_a), 1.0 / run.rate_hz)
    spectrum[frequency_hz < NOISE_HZ] = 0.0
    noise = np.fft.irfft(spectrum, len(run.current_a), axis=0)
    rms_noise = np.sqrt(np.mean(noise**2, axis=0))
    rms: list[float] = rms_noise.tolist()
    return rms


def limited_drive() -> None:
    """Print the gain of a motor whose drive gives less than its reference,
    with and without these samples.
    """
    task = CaseTask(OUT, WORLD, LIMITED)
    for plan in task.plans:
        make_plan(plan)
    make_case(task)
    runs = load_runs(task, imported=False)
    cell = load_cell(CELL)
    motor = LIMITED.effects[0].axis
    bare = world_cell(LIMITED.seed, WORLD).bare
    truth = bare.axes[motor].gain_nm_per_a
    for words, keep_rows in (("with all samples", False), ("without what it did not give", True)):
        found = identify(model_of(cell), runs.fit, cell.conditioning, keep_rows=keep_rows)
        error = 100.0 * (found.estimate.gains[motor] / truth - 1.0)
        std = 100.0 * found.estimate.gains_std[motor] / abs(truth)
        left = found.training_error.axes[motor]
        line = f"{words}: gain {error:+.2f} ± {std:.2f} % off, error of the axis {left:.1f} %"
        print_line(line)
        for one in diagnose(found, cell.axis_names):
            print_line(f"  {one.text}")


def held_readings_of_the_tx40() -> None:
    """Print the errors of the TX-40 with readings that are held, if its recording is there."""
    if (data_folder() / "tx40").is_dir():
        held_readings(tx40(data_folder()))
    else:
        line = f"found no {data_folder() / 'tx40'}; the held readings are left out"
        print_line(line)


PARTS: dict[str, Callable[[], None]] = {
    "held": held_readings_of_the_tx40,
    "limited": limited_drive,
    "channels": lambda: write_fault_table(OUT, WORLD, data_folder()),
    "sound": lambda: judge_sound_recordings(data_folder()),
}


def main() -> int:
    """Make the study and print its figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--part", choices=PARTS, help="one part alone")
    options = parser.parse_args()
    for name, make in PARTS.items():
        if options.part in {None, name}:
            make()
    return 0


if __name__ == "__main__":
    sys.exit(main())
