"""A plan and what it promises: the predicted σ of each gain and the verdict on it."""

from __future__ import annotations

import math
from pathlib import Path

from daq.config.cell import Cell
from daq.workflow.experiment import Experiment
from daq.workflow.plan import Plan
from ident.planning.verdict import Identifiability


def plan_document(
    out: Path, cell: Cell, experiment: Experiment, made: Plan, judged: Identifiability
) -> dict[str, object]:
    """Build the JSON document of a plan, with the verdict on the gain of each axis."""
    return {
        "plan": str(out),
        "cell": made.cell,
        "seed": made.seed,
        "payload": experiment.payload.name,
        "moves": len(made.moves),
        "duration_s": round(made.duration_s, 3),
        "condition": round(made.condition, 1),
        "assumed": list(experiment.remarks),
        "rank": judged.rank,
        "known_preload_rank": judged.known_preload_rank,
        "hidden": list(judged.sentences(cell.axis_names)),
        "gains": [
            {
                "axis": axis.name,
                "predicted_std_percent": round(gain.std_percent, 3),
                "known_preload_std_percent": _finite(gain.known_preload_percent),
                "verdict": gain.verdict.value,
                "hidden_by": gain.hidden_by and gain.hidden_by.value,
                "seen_by": [source.value for source in gain.sources],
                "alone_percent": {source.value: _finite(alone) for source, alone in gain.alone_percent.items()},
                "words": gain.words(axis.name),
            }
            for axis, gain in zip(cell.axes, judged.gains, strict=True)
        ],
    }


def _finite(std_percent: float | None) -> float | None:
    return None if std_percent is None or not math.isfinite(std_percent) else round(std_percent, 3)


def _nothing_hidden(judged: Identifiability) -> tuple[str, ...]:
    if judged.known_preload_rank is None:
        return ()
    directions = f"{judged.rank} of {len(judged.gains)} independent directions of the gains"
    return (f"Internal preload obscures no gain: these moves determine {directions}.",)


def plan_text(
    out: Path, preview: Path | None, cell: Cell, experiment: Experiment, made: Plan, judged: Identifiability
) -> str:
    """Describe a plan in lines for the operator, who looks at its preview, if there is one."""
    look = ", or look at it (--preview PAGE)" if preview is None else f": {preview} shows the moves"
    width = max(len(name) for name in (*cell.axis_names, "axis"))
    lines = [
        f"{out}: {len(made.moves)} moves in {made.duration_s:.0f} s, condition {made.condition:.0f}",
        f"  {'axis':{width}}  predicted σ  verdict",
        *(
            f"  {axis.name:{width}}  {gain.std_percent:9.2f} %  {gain.verdict.value}"
            for axis, gain in zip(cell.axes, judged.gains, strict=True)
        ),
        *(f"  {gain.words(axis.name)}" for axis, gain in zip(cell.axes, judged.gains, strict=True)),
        *(judged.sentences(cell.axis_names) or _nothing_hidden(judged)),
        "Assumed: " + "; ".join(experiment.remarks) + ".",
        f"Read the plan before the robot executes it{look}. "
        + (
            "`record` checks the way to its first target from where the robot stands."
            if cell.clearance is not None
            else "The way to its first target is not checked: the cell file declares no `workspace` and no `clearance`."
        ),
    ]
    return "\n".join(lines)
