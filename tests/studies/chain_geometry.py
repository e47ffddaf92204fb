"""A closed chain whose zero or rod is not as described, over the whole driver path:
what `fit` and `residual` say.

    python -m tests.studies.chain_geometry --seeds 1
    python -m tests.studies.chain_geometry --robot five-bar

The plant is built otherwise than its cell file says. The encoders of the redundant DualV-like robot
contradict each other then, and its drives work against each other; the five-bar has as many
encoders as degrees of freedom, and shows it in its torques alone. Prints the errors of the gains,
σ, the misfit and the corrections of each case; the first one is the clean cell.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import re
import sys
import tempfile
from dataclasses import dataclass, replace
from math import radians
from pathlib import Path
from typing import Any

import numpy as np

from daq.cli.app import main as drivegain
from daq.config.cell import Cell
from daq.config.cell_closures import robot_with
from daq.errors import ExitCode
from drivers.simulation.spec import CellSpec
from ident.model.closed_chain import assemble
from tests.pipeline.cells import Job, as_json, make_plan, record_job, record_run

NOISE = 0.8  #: Factor of the simulation's current noise, as in the robot study


@dataclass(frozen=True, slots=True)
class WrongGeometry:
    """A joint of the plant that is not where the cell file has it."""

    joint: str  #: a crank with another zero, or the fixed joint at the end of a rod
    zero_deg: float = 0.0  #: by which the crank is turned when its encoder reads zero
    longer_percent: float = 0.0  #: by which the rod is longer

    def urdf(self, text: str) -> str:
        """Build it into a URDF."""
        number = r"([-0-9.e]+)"
        found = re.search(
            rf'<joint name="{self.joint}"[^>]*>\s*<origin xyz="{number} [^"]*"( rpy="0 0 '
            rf"{number})?",
            text,
        )
        assert found is not None
        if self.zero_deg:
            first, last = found.span(3)
            new = float(found.group(3)) + radians(self.zero_deg)
        else:
            first, last = found.span(1)
            new = float(found.group(1)) * (1.0 + self.longer_percent / 100.0)
        return f"{text[:first]}{new!r}{text[last:]}"

    def plant(self, spec: CellSpec, cell: Cell) -> CellSpec:
        """Build it into a plant, which starts where its loops close."""
        urdf = self.urdf(spec.urdf)
        robot = robot_with(cell.chain, self.urdf(cell.urdf), cell.gravity_m_s2)
        position_rad = assemble(robot).position_rad
        start_rad = position_rad[list(robot.axis_joints)]
        return replace(spec, urdf=urdf, start_rad=start_rad)


ROD_ENDS = {"dualv": "tip-3", "five-bar": "tip-2"}
"""Fixed joint at the end of the rod that is longer, of each robot that is studied."""


def cases_of(robot: str) -> tuple[WrongGeometry | None, ...]:
    """The clean cell, wrong zeros and wrong rods."""
    zeros = (WrongGeometry("crank-2", zero_deg=size) for size in (0.05, 0.1, 0.5))
    rods = (WrongGeometry(ROD_ENDS[robot], longer_percent=size) for size in (0.1, 0.3, 1.0))
    return (None, *zeros, *rods)


def study_case(job: Job, wrong: WrongGeometry | None, seed: int, verb: str) -> dict[str, Any]:
    """Record the plan of a job with a plant that is built otherwise, and identify;
    the JSON of the verb.
    """
    logs = []
    with contextlib.redirect_stdout(io.StringIO()):
        first_payload = job.cell.payloads[0]
        for number, mounted in enumerate((None, first_payload.name)):
            logs.append(
                job.folder
                / f"{'bare' if mounted is None else 'loaded'}-{wrong}.mcap".replace(" ", "")
            )
            if not logs[-1].exists():
                number_seed = 100 * seed + number
                plan = job.folder / "plan.yaml"
                log = logs[-1]
                record_run(
                    job,
                    plan,
                    log,
                    mounted=mounted,
                    declared=mounted is not None,
                    seed=number_seed,
                    changed=lambda spec: spec if wrong is None else wrong.plant(spec, job.cell),
                )
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        code = drivegain([verb, *map(str, logs), "--json"])
    assert code == ExitCode.OK, f"drivegain {verb} ended with {code}"
    return as_json(printed.getvalue())


def row(job: Job, found: dict[str, Any]) -> str:
    """Errors and σ of the gains [%], misfit and corrections."""
    gains = found["gains"]
    errors = np.array([100.0 * (gain["value"] / job.truth[gain["axis"]] - 1.0) for gain in gains])
    std = np.array([100.0 * gain["std"] / abs(job.truth[gain["axis"]]) for gain in gains])
    misfit = found["encoder_misfit"]
    encoders = "no encoder beyond the degrees of freedom"
    if misfit is not None:
        named = [
            f"{one['kind']} {one['joint']} {one['end']} {one['change']:+.7f} ± {one['std']:.7f} "
            f"{one['unit']}"
            for one in misfit["corrections"]
        ]
        encoders = (
            f"misfit {misfit['described']:.1e} → {misfit['left']:.1e}, "
            f"{'; '.join(named) or 'nothing named'}"
        )
    effects = [f"{one['name']} on {one['axis']}" for one in found["effects"]]
    diagnoses = [f"{one['name']}: {one['found']}" for one in found["diagnoses"]]
    return (
        f"errors {np.round(errors, 2)} σ {np.round(std, 2)} largest z "
        f"{np.max(np.abs(errors / std)):.1f}, {encoders}; effects {', '.join(effects) or 'none'}; "
        f"diagnoses {'; '.join(diagnoses) or 'none'}"
    )


def main(arguments: list[str] | None = None) -> int:
    """Study every case with plans and noise of each seed."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.studies.chain_geometry", description=__doc__
    )
    parser.add_argument("--robot", choices=ROD_ENDS, default="dualv")
    parser.add_argument("--seeds", nargs="+", type=int, default=[1])
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument(
        "--verbs", nargs="+", choices=["fit", "residual"], default=["fit", "residual"]
    )
    options = parser.parse_args(arguments)
    for seed in options.seeds:
        with tempfile.TemporaryDirectory() as folder:
            job, _ = record_job(
                options.robot,
                Path(folder),
                seconds=options.seconds,
                pairs=0,
                seed=seed,
                noise=NOISE,
            )
            with contextlib.redirect_stdout(io.StringIO()):
                make_plan(job, "plan.yaml", seed=10 * seed, seconds=options.seconds, exchanges=50)
            for wrong in cases_of(options.robot):
                for verb in options.verbs:
                    sys.stdout.write(
                        f"{seed} {verb} {wrong}: {row(job, study_case(job, wrong, seed, verb))}\n"
                    )
                    sys.stdout.flush()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
