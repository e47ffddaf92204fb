"""`drivegain demo`: the whole calibration on a simulated cell."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from daq.cli.verb import JsonOption, Verb, print_json

if TYPE_CHECKING:
    from rich.console import RenderableType

    from daq.simulation.demo import Outcome


def demo(
    out: Annotated[Path, typer.Option("--out", help="Folder to fill.")] = Path("out/demo"),
    simulation: Annotated[Path | None, typer.Option(help="Another simulation file than the shipped one.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of plans and noise.", min=0)] = 1,
    duration: Annotated[float, typer.Option(help="Duration of each of the five runs [s].", min=10.0, max=600.0)] = 40.0,
    json: JsonOption = False,
) -> None:
    """Calibrate a simulated six-axis cell: scan, plan, record, identify, add effects, write a copy of its file."""
    import time
    from datetime import UTC, datetime

    from rich.console import Console

    from daq.cli.terminal import Stepper, print_view, writing
    from daq.files import replace_file
    from daq.report.proposal import show as show_proposal
    from daq.report.text import json_text
    from daq.simulation.demo import ProgressReporter, Settings, demonstrate, summary
    from daq.simulation.simulation_file import shipped_simulation

    began = time.monotonic()
    settings = Settings(out, simulation or shipped_simulation(), seed, duration)
    with writing(out):
        with Stepper() as stepper:
            outcome = demonstrate(settings, lambda: datetime.now(UTC), ProgressReporter(stepper.step, stepper.progress))
        document = {**summary(outcome), "seconds": round(time.monotonic() - began, 1)}
        replace_file(out / "summary.json", json_text(document).encode())
    if json:
        print_json(document)
        return
    print_view(demo_view(outcome))
    show_proposal(outcome.proposal, Console(highlight=False))
    if outcome.written is not None:
        typer.echo(f"Written to the copy {outcome.written.edit.subject}.")
    typer.echo(f"\nLogs, calibration.yaml, pictures and summary.json are in {out}.")


def demo_view(outcome: Outcome) -> Iterator[RenderableType]:
    """Nodes on the bus, turns of the loop, errors before and after, and the gains beside the truth."""
    from daq.report.bus import scan_rows, scan_table
    from daq.report.fit import start_of
    from daq.report.gains import gain_table
    from daq.report.residual import before_after_table, turns_view
    from ident.discovery.before_after import account

    fitted, truth = outcome.fitted, outcome.truth
    yield scan_table(scan_rows(outcome.cell, outcome.nodes, outcome.cell.buses[0].name))
    yield ""
    yield from turns_view(fitted)
    yield before_after_table(account(start_of(fitted), fitted.steps), fitted.cell.axis_names)
    yield ""
    yield gain_table(outcome.calibration.gains, truth, title="Drive gains beside the truth of the simulated cell")
    if fitted.paper is not None:
        errors = (100.0 * (gain / truth[axis] - 1.0) for axis, gain in zip(truth, fitted.paper.gains, strict=True))
        yield "Errors of the paper's total least squares on the same rows: " + ", ".join(f"{e:+.2f} %" for e in errors)
    yield ""


DEMO = Verb("demo", demo, "drivegain demo --out out/demo")
