"""`drivegain plan`: choose the moves of a recording."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from daq.cli.next_step import say_after_plan
from daq.cli.terminal import (
    check_folder,
    check_output,
    check_page,
    check_replaceable,
    progress_bar,
    replace_output,
    say,
    write_file,
)
from daq.cli.verb import CellArgument, JsonOption, output_option, print_json, read_cell
from daq.errors import UsageError
from daq.workflow.choices import EXCHANGES, LARGEST_STD_PERCENT


def plan_verb(
    cell: CellArgument,
    out: Annotated[Path, output_option("--out", "Plan to write (YAML).")],
    seed: Annotated[int, typer.Option(help="The same seed gives the same plan.", min=0)] = 1,
    duration: Annotated[
        float, typer.Option(help="Duration of the run [s].", min=5.0, max=3600.0)
    ] = 40.0,
    payload: Annotated[
        str | None, typer.Option(help="Payload that will be mounted; the cell's first one.")
    ] = None,
    exchanges: Annotated[
        int, typer.Option(help="Changes to try; 0 gives random moves.", min=0)
    ] = EXCHANGES,
    speed: Annotated[
        float,
        typer.Option(help="Share of the limits that the fastest move uses.", min=0.05, max=1.0),
    ] = 1.0,
    condition: Annotated[
        float | None,
        typer.Option(help="Largest condition number; 3500, of a closed chain 1e5.", min=1.0),
    ] = None,
    preview: Annotated[
        Path | None,
        output_option("--preview", "Page to write (HTML): the arm moves through the plan."),
    ] = None,
    sigma: Annotated[
        float, typer.Option(help="Largest σ predicted for a gain [%].", min=0.01)
    ] = LARGEST_STD_PERCENT,
    json: JsonOption = False,
) -> None:
    """Choose point-to-point moves that identify the worst gain as precisely as the time allows.

    The moves keep the joint limits and the cell's workspace, and keep clear of the arm itself. The
    prediction is for these moves made once without load and once with the payload.
    """
    from daq.report.plan import plan_report, plan_text
    from daq.report.plan_preview import MARK, preview_page
    from daq.workflow.experiment import RUNS, experiment_of, extra_moves, paths_of
    from daq.workflow.nameplates import check_controller
    from daq.workflow.plan import load_plan, plan, save_plan
    from ident.planning.gain_verdict import verdicts

    check_folder(out)
    check_output(out, (cell,), "drivegain-plan")
    if preview is not None:
        if os.path.realpath(preview) == os.path.realpath(out):
            raise UsageError(
                "--preview",
                found="the name of --out",
                expected="another",
                remedy="choose another name",
            )
        check_page(preview, "--preview")
        check_folder(preview)
        check_replaceable(preview, MARK, "preview of a plan")
    declared = read_cell(cell)
    check_controller(cell, declared)
    experiment = experiment_of(declared, payload)
    tried = [0]
    with say_how_to_resume(tried, exchanges), progress_bar("planning") as report_progress:

        def report(done: int, worst: float) -> None:
            tried.append(done)
            report_progress(done, exchanges, f"worst gain σ {worst:.2f} %")

        made = plan(
            declared,
            seed=seed,
            duration_s=duration,
            exchanges=exchanges,
            speed=speed,
            largest_condition=condition,
            largest_std_percent=sigma,
            experiment=experiment,
            progress=report,
        )
    with replace_output(out):
        save_plan(made, out)
    if preview is not None:
        checked = load_plan(out, declared)
        write_file(
            preview,
            preview_page(declared, checked.moves, experiment.scene.checker, out.read_bytes()),
        )
    excitation, _ = experiment.excitation(paths_of(declared, made.moves))
    judged = verdicts(experiment.design, [(excitation, RUNS)], extra_moves(experiment))
    if json:
        print_json(plan_report(out, declared, experiment, made, judged))
    else:
        say(plan_text(out, preview, declared, experiment, made, judged, duration))
        say_after_plan(cell, declared, out, made)


@contextmanager
def say_how_to_resume(tried: list[int], exchanges: int) -> Iterator[None]:
    """After an interrupt, say how to get the plan that the search had then:
    the same seed gives the same moves.
    """
    try:
        yield
    except KeyboardInterrupt:
        if done := tried[-1]:
            say(
                f"{done} of {exchanges} exchanges were tried; --exchanges {done} writes their plan",
                err=True,
            )
        raise
