"""`drivegain plan`: moves that excite every parameter, for a person to read before anything moves."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from daq.cli.output import check_output
from daq.cli.progress import progress_bar
from daq.cli.verb import JsonOption, Verb, print_json
from daq.configuration.cell_file import load_cell
from daq.errors import OutputFailed
from daq.plan import LARGEST_CONDITION, plan
from daq.plan_file import save_plan


def plan_verb(
    cell: Annotated[Path, typer.Argument(help="Cell file.")],
    out: Annotated[Path, typer.Option("--out", help="Plan to write (YAML).")],
    seed: Annotated[int, typer.Option(help="The same seed gives the same plan.", min=0)] = 1,
    duration: Annotated[float, typer.Option(help="Of the run [s].", min=5.0, max=3600.0)] = 40.0,
    exchanges: Annotated[int, typer.Option(help="Moves to try in exchange.", min=0)] = 400,
    speed: Annotated[
        float, typer.Option(help="Share of the limits that the fastest move uses.", min=0.05, max=1.0)
    ] = 1.0,
    condition: Annotated[float, typer.Option(help="Largest condition number.", min=1.0)] = LARGEST_CONDITION,
    json: JsonOption = False,
) -> None:
    """Choose point-to-point moves inside the joint limits until the observation matrix is well conditioned."""
    check_output(out, (cell,), "drivegain-plan")
    declared = load_cell(cell)
    with progress_bar("planning") as told:
        made = plan(
            declared,
            seed=seed,
            duration_s=duration,
            exchanges=exchanges,
            speed=speed,
            largest_condition=condition,
            progress=lambda done, value: told(done, exchanges, f"condition {value:.0f}"),
        )
    try:
        save_plan(made, out)
    except OSError as error:
        raise OutputFailed.of(out, error) from error
    document = {
        "plan": str(out),
        "cell": made.cell,
        "seed": made.seed,
        "moves": len(made.moves),
        "duration_s": round(made.duration_s, 3),
        "condition": round(made.condition, 1),
    }
    if json:
        print_json(document)
    else:
        typer.echo(
            f"{out}: {len(made.moves)} moves in {made.duration_s:.0f} s, condition {made.condition:.0f} "
            f"(at most {condition:.0f}).\nRead it before you let the robot make it: drivegain keeps joint limits, "
            "it knows nothing of tables, cables and people."
        )


PLAN = Verb("plan", plan_verb, "drivegain plan cells/demo.yaml --out plan.yaml --seed 1 --duration 40")
