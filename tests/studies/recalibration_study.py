"""Whole jobs week after week, recordings included, on a simulated cell:
quiet weeks, a gain that falls, faults between.

    python -m tests.studies.recalibration_study [--weeks 8] [--seconds 12]
    python -m tests.studies.recalibration_study --kills
    python -m tests.studies.recalibration_study --moments 60
    python -m tests.studies.recalibration_study --recordings 5
    python -m tests.studies.recalibration_study --years 300

Each week the timer calls the job, and where it was ended calls it again the next day. J4 loses 6 %
in the middle of the time; in one week a drive fails, in another the door is open. What is printed:
outcome, drift in σ, and the truth beside what the controller has.

`--kills` kills a job (-9) before and behind every call to another room and lets the next one finish
it; the tests do the same at some of them. `--moments` kills at random moments instead, and checks
that the controller's file is the old or the new one, that `history --verify` reports exactly the
writes that the history lacks, and that the next job ends with exit code 0. `--recordings` kills
jobs in recordings, at a simulated cell that is a process of its own: the next job takes the drives
over and ends with exit code 0. `--years` draws years of weekly jobs in which nothing changes, and
counts those in which a gain was changed all the same.
"""

from __future__ import annotations

import argparse
import random
import shutil
import sys
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from daq.cli.simulate import MountedFile
from daq.config.cell_buses import bus_address
from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.errors import DaqError
from daq.simulation.simulation_file import load_simulation, shipped_simulation
from drivers.canopen.bus import open_bus
from drivers.errors import DriverError
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.faults import FaultKind, FaultSpec
from drivers.simulation.spec import CellSpec
from ident.drift.change import DISPERSION, decide
from ident.errors import IdentificationError
from tests.daq.jobs.made import made_rig, whole_job
from tests.daq.jobs.rig import RUNS, Rig, make_plan, make_rig
from tests.daq.jobs.test_killed import (
    Kill,
    finished_by_the_next,
    finished_from_any_moment,
    job_duration_s,
)
from tests.daq.jobs.test_killed_recording import taken_up_from_a_recording
from tests.studies.output import print_line

AXIS = 3
LOSS = 0.94
FAULT = FaultSpec(FaultKind.EMERGENCY, 2, 2000, None, 0x7305)


def truth(name: str | None, factor: float) -> CellSpec:
    """The demonstration's cell, with that much of the gain of J4 left."""
    spec = load_simulation(shipped_simulation("demo"), name)
    axes = tuple(
        replace(axis, gain_nm_per_a=axis.gain_nm_per_a * (factor if index == AXIS else 1.0))
        for index, axis in enumerate(spec.axes)
    )
    return replace(spec, axes=axes)


def one_job(rig: Rig, factor: float, seed: int, *faults: FaultSpec) -> str:
    """A job with the cell as it is now; its outcome, or the error that ended it."""
    path = rig.cells / "mounted"
    load = partial(truth, factor=factor)
    mounted = MountedFile(path, load, lambda error: None)
    spec = replace(mounted.at_power_on(), faults=faults, seed=seed)
    bus = open_bus(bus_address(rig.cell))
    try:
        with SimulatedCell(spec, bus, mounted=mounted):
            return rig.job().outcome.value
    except (DaqError, DriverError, IdentificationError) as error:
        return type(error).__name__
    finally:
        bus.shutdown()


def week_text(rig: Rig, factor: float) -> str:
    """Drift and gain found on J4, beside the truth and the controller's gain."""
    state = rig.sessions[-1].state
    if state.decision is None:
        return ""
    gain = state.decision.gains[AXIS]
    true = truth(None, factor).axes[AXIS].gain_nm_per_a
    if gain.drift_sigma is None:
        drift = "-"
    else:
        drift = f"{gain.drift_sigma:+.1f}"
    return (
        f"{drift:>6} σ   found {gain.new:.3f} ± {gain.new_std:.3f}   was {gain.old:.3f}   truth "
        f"{true:.3f}"
    )


def study(weeks: int, seconds: float, folder: Path) -> int:
    """Run it; 1 where a quiet week was written, or the loss was not."""
    path = shipped_configurations() / "cells" / "demo.yaml"
    shipped = load_cell(path)
    plans = [
        make_plan(shipped, folder / f"{seed}.yaml", seed=seed, duration_s=seconds)
        for seed in (10, 11, 12)
    ]
    plan_text = str(plans[0])
    runs = [
        {**RUNS[0], "plan_file": plan_text},
        {**RUNS[1], "plan_file": str(plans[0])},
        {**RUNS[0], "name": "bare-2", "plan_file": str(plans[1])},
        {**RUNS[1], "name": "loaded-2", "plan_file": str(plans[1])},
        {**RUNS[2], "plan_file": str(plans[2])},
    ]
    policy = {"motion": "allowed", "apply": {"by": "job", "max_std_percent": 8}}
    cell_folder = folder / "cell"
    rig = make_rig(cell_folder, plans[0], policy=policy, runs=runs, every_h=160, resume_within_h=36)
    wrong = []
    for week in range(weeks):
        factor = LOSS if week >= weeks // 2 else 1.0
        if week in (0, weeks // 2):
            expected = "applied"
        else:
            expected = "unchanged"
        if week == 1:
            rig.closed.unlink()
        outcome = one_job(rig, factor, week, *((FAULT,) if week == 2 else ()))
        line = f"week {week}: {outcome:12} {week_text(rig, factor)}"
        print_line(line)
        rig.closed.touch()
        if week in (1, 2):
            rig.clock.go_on(days=1)
            week_seed = 100 + week
            outcome = one_job(rig, factor, week_seed)
            print_line(f"  next day: {outcome:12} {week_text(rig, factor)}")
        wrong += [week] if outcome != expected else []
        rig.clock.go_on(days=7)
    print_line(
        f"{weeks - len(wrong)} of {weeks} weeks as expected{f'; not {wrong}' if wrong else ''}"
    )
    return int(bool(wrong))


def kills(folder: Path) -> int:
    """A kill before and behind every call;
    an AssertionError where one was not finished as it should be.
    """
    (folder / "whole").mkdir()
    whole_folder = folder / "whole"
    _, made = whole_job(whole_folder)
    counted_folder = folder / "counted"
    counted = made_rig(new(counted_folder), made, metrics=None)
    kill = Kill()
    tools = kill.tools(counted.tools)
    replace(counted, tools=tools).job()
    for at, name in enumerate(kill.calls):
        for behind in (False, True):
            rig = made_rig(new(folder / f"{at}-{behind}"), made, metrics=None)
            finished_by_the_next(rig, Kill(at, behind=behind))
            shutil.rmtree(rig.folder)
        line = (
            f"call {at + 1} of {len(kill.calls)}, {name}: applied once, killed before it "
            "and behind it"
        )
        print_line(line)
    return 0


def moments(folder: Path, count: int, seed: int = 1) -> int:
    """Kills at so many random moments; an AssertionError where the next job does not finish it as
    it should.
    """
    (folder / "whole").mkdir()
    whole_folder = folder / "whole"
    _, made = whole_job(whole_folder)
    timed_folder = folder / "timed"
    whole_s = job_duration_s(made_rig(new(timed_folder), made, metrics=None))
    chance = random.Random(seed)
    done = killed = written = 0
    while killed < count and done < 4 * count:
        rig = made_rig(new(folder / f"{done}"), made, metrics=None)
        # A killed job is a process of its own, and slower: most of those that are given twice the
        # time end before it.
        wait_s = chance.uniform(0.0, 2.0 * whole_s)
        was_killed, was_written = finished_from_any_moment(rig, wait_s)
        shutil.rmtree(rig.folder)
        done = done + 1
        killed = killed + was_killed
        written = written + (was_killed and was_written)
    line = (
        f"{killed} jobs killed within {2.0 * whole_s:.1f} s, {written} of them after their write; "
        "every next job ended with 0, every file was the old or the new one, every --verify was "
        "right"
    )
    print_line(line)
    return int(killed < count)


def recordings(folder: Path, count: int, seed: int = 1) -> int:
    """Kills in so many recordings; an AssertionError where the next job does not take the session
    up.
    """
    (folder / "whole").mkdir()
    whole_folder = folder / "whole"
    _, made = whole_job(whole_folder)
    chance = random.Random(seed)
    for number in range(count):
        name = chance.choice(sorted(made.logs))
        share = chance.uniform(0.05, 0.9)
        rig = make_rig(new(folder / f"{number}"), made.plan_file)
        taken_up_from_a_recording(rig, made, name, share)
        line = f"killed in {name} with {share:.0%} of its log: the next job ended with 0"
        print_line(line)
    return 0


def new(folder: Path) -> Path:
    """An empty folder."""
    folder.mkdir()
    return folder


def unchanged_years(years: int, seed: int = 1) -> int:
    """Weekly jobs that write what differs, on a robot that stays as it is;
    its scatter is as large as is known.
    """
    rng = np.random.default_rng(seed)
    axes = tuple(f"J{number}" for number in range(1, 7))
    gain = 1000.0
    std = 1.0
    changes = np.zeros(years, int)
    for year in range(years):
        in_force = gain + DISPERSION * std * rng.standard_normal(len(axes))
        for _ in range(52):
            found = gain + DISPERSION * std * rng.standard_normal(len(axes))
            if decide(axes, in_force, std, found, std).differs:
                changes[year] += 1
                in_force = found
    line = (
        f"{years} years of 52 jobs: a change in {(changes > 0).mean():.0%} of them, "
        f"{changes.mean():.2f} a year"
    )
    print_line(line)
    return 0


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--weeks", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument("--kills", action="store_true")
    parser.add_argument("--moments", type=int)
    parser.add_argument("--recordings", type=int)
    parser.add_argument("--years", type=int)
    chosen = parser.parse_args()
    if chosen.years is not None:
        return unchanged_years(chosen.years)
    with tempfile.TemporaryDirectory() as folder:
        if chosen.moments is not None:
            return moments(Path(folder), chosen.moments)
        if chosen.recordings is not None:
            return recordings(Path(folder), chosen.recordings)
        if chosen.kills:
            return kills(Path(folder))
        return study(chosen.weeks, chosen.seconds, Path(folder))


if __name__ == "__main__":
    sys.exit(main())
