"""`drivegain demo`: the main job from end to end on a simulated cell."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from daq.cli.residual import before_after_table, ranking_table
from daq.cli.scan import scan_rows, scan_table
from daq.cli.terminal import Stepper
from daq.cli.verb import JsonOption, Verb, json_text, print_json
from daq.errors import OutputFailed
from daq.files import replace_file
from daq.report.gains import gain_table
from daq.report.proposal import show as show_proposal
from daq.simulation.demo import Outcome, ProgressReporter, Settings, demonstrate, summary
from daq.simulation.simulation_file import shipped_simulation


def demo(
    out: Annotated[Path, typer.Option("--out", help="Folder to fill.")] = Path("out/demo"),
    simulation: Annotated[Path | None, typer.Option(help="Another simulation file than the shipped one.")] = None,
    seed: Annotated[int, typer.Option(help="Of plans and noise.", min=0)] = 1,
    duration: Annotated[float, typer.Option(help="Of each of the five runs [s].", min=10.0, max=600.0)] = 40.0,
    json: JsonOption = False,
) -> None:
    """Calibrate a simulated six-axis cell: scan, plan, record, identify, close the loop, write a copy of its file."""
    began = time.monotonic()
    settings = Settings(out, simulation or shipped_simulation(), seed, duration)
    try:
        with Stepper() as stepper:
            outcome = demonstrate(settings, lambda: datetime.now(UTC), ProgressReporter(stepper.step, stepper.progress))
        document = {**summary(outcome), "seconds": round(time.monotonic() - began, 1)}
        replace_file(out / "summary.json", json_text(document).encode())
    except OSError as error:
        raise OutputFailed.of(out, error) from error
    if json:
        print_json(document)
    else:
        show(outcome, out, Console(highlight=False))


def show(outcome: Outcome, out: Path, console: Console) -> None:
    """The whole story for a person."""
    console.print(scan_table(scan_rows(outcome.cell, outcome.nodes, outcome.cell.buses[0].name)))
    console.print()
    for number, step in enumerate(outcome.fitted.steps, start=1):
        console.print(ranking_table(outcome.fitted, step.findings, f"Turn {number}: best candidates on left-out moves"))
        if step.accepted is not None:
            axis = outcome.cell.axis_names[step.accepted.axis]
            console.print(f"Added: {step.accepted.effect.name} on {axis}.\n")
        else:
            console.print("No candidate passes every gate: nothing more is added.\n")
    console.print(before_after_table(outcome.fitted))
    console.print()
    console.print(
        gain_table(outcome.calibration.gains, outcome.truth, title="Drive gains, and the simulated cell's truth")
    )
    paper = outcome.fitted.paper
    if paper is not None:
        errors = (
            100.0 * (gain / outcome.truth[axis] - 1.0) for axis, gain in zip(outcome.truth, paper.gains, strict=True)
        )
        console.print(
            "The paper's total least squares on the same rows errs by " + ", ".join(f"{e:+.2f} %" for e in errors)
        )
    console.print()
    show_proposal(outcome.proposal, console)
    if outcome.written is not None:
        console.print(f"Written to the copy {outcome.written.edit.subject}.")
    console.print(f"\nLogs, calibration.yaml, pictures and summary.json are in {out}.")


DEMO = Verb("demo", demo, "drivegain demo --out out/demo")
