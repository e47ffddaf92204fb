"""`drivegain plan`: moves that show every gain, for a person to read before anything moves."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from daq.cli.terminal import check_output, progress_bar
from daq.cli.verb import JsonOption, Verb, print_json
from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.errors import OutputFailed
from daq.workflow.experiment import RUNS, Experiment, experiment_of, paths_of
from daq.workflow.plan import EXCHANGES, LARGEST_CONDITION, LARGEST_STD_PERCENT, Plan, extra_moves, plan
from daq.workflow.plan_file import save_plan
from ident.planning.verdict import GainVerdict, verdicts


def plan_verb(
    cell: Annotated[Path, typer.Argument(help="Cell file.")],
    out: Annotated[Path, typer.Option("--out", help="Plan to write (YAML).")],
    seed: Annotated[int, typer.Option(help="The same seed gives the same plan.", min=0)] = 1,
    duration: Annotated[float, typer.Option(help="Of the run [s].", min=5.0, max=3600.0)] = 40.0,
    payload: Annotated[str | None, typer.Option(help="That will be mounted; the cell's first one.")] = None,
    exchanges: Annotated[int, typer.Option(help="Changes to try; 0 gives random moves.", min=0)] = EXCHANGES,
    speed: Annotated[
        float, typer.Option(help="Share of the limits that the fastest move uses.", min=0.05, max=1.0)
    ] = 1.0,
    condition: Annotated[float, typer.Option(help="Largest condition number.", min=1.0)] = LARGEST_CONDITION,
    sigma: Annotated[
        float, typer.Option(help="Largest standard deviation predicted for a gain [%].", min=0.01)
    ] = LARGEST_STD_PERCENT,
    json: JsonOption = False,
) -> None:
    """Choose point-to-point moves that let the worst gain be known as well as the time allows.

    The moves keep the joint limits, the cell's workspace and clear of the arm itself. What is predicted is for the same
    moves made once without load and once with the payload.
    """
    check_output(out, (cell,), "drivegain-plan")
    declared = load_cell(cell)
    experiment = experiment_of(declared, payload)
    with progress_bar("planning") as report_progress:
        made = plan(
            declared,
            seed=seed,
            duration_s=duration,
            exchanges=exchanges,
            speed=speed,
            largest_condition=condition,
            largest_std_percent=sigma,
            experiment=experiment,
            progress=lambda done, worst: report_progress(done, exchanges, f"worst gain σ {worst:.2f} %"),
        )
    try:
        save_plan(made, out)
    except OSError as error:
        raise OutputFailed.of(out, error) from error
    excitation, _ = experiment.excitation(paths_of(declared, made.moves))
    judged = verdicts(experiment.design, [(excitation, RUNS)], extra_moves(experiment))
    if json:
        print_json(_document(out, declared, experiment, made, judged))
    else:
        typer.echo(_text(out, declared, experiment, made, judged))


def _document(
    out: Path, cell: Cell, experiment: Experiment, made: Plan, judged: tuple[GainVerdict, ...]
) -> dict[str, object]:
    return {
        "plan": str(out),
        "cell": made.cell,
        "seed": made.seed,
        "payload": experiment.payload.name,
        "moves": len(made.moves),
        "duration_s": round(made.duration_s, 3),
        "condition": round(made.condition, 1),
        "assumed": list(experiment.remarks),
        "gains": [
            {
                "axis": axis.name,
                "predicted_std_percent": round(gain.std_percent, 3),
                "verdict": gain.verdict.value,
                "seen_by": [source.value for source in gain.sources],
                "alone_percent": {
                    source.value: round(alone, 3) if math.isfinite(alone) else None
                    for source, alone in gain.alone_percent.items()
                },
                "words": gain.words(axis.name),
            }
            for axis, gain in zip(cell.axes, judged, strict=True)
        ],
    }


def _text(out: Path, cell: Cell, experiment: Experiment, made: Plan, judged: tuple[GainVerdict, ...]) -> str:
    width = max(len(name) for name in (*cell.axis_names, "axis"))
    lines = [
        f"{out}: {len(made.moves)} moves in {made.duration_s:.0f} s, condition {made.condition:.0f}",
        f"  {'axis':{width}}  predicted σ  verdict",
        *(
            f"  {axis.name:{width}}  {gain.std_percent:9.2f} %  {gain.verdict.value}"
            for axis, gain in zip(cell.axes, judged, strict=True)
        ),
        *(f"  {gain.words(axis.name)}" for axis, gain in zip(cell.axes, judged, strict=True)),
        "Assumed: " + "; ".join(experiment.remarks) + ".",
        "Read the plan before you let the robot make it; the way to its first target is not checked.",
    ]
    return "\n".join(lines)


PLAN = Verb("plan", plan_verb, "drivegain plan cells/demo.yaml --out plan.yaml --seed 1 --duration 40")
