"""`drivegain salvage`: what can be saved of a recording whose recorder was killed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from daq.cli.progress import progress_bar
from daq.cli.verb import JsonOption, Verb, print_json, printable
from daq.salvage import salvage


def salvage_verb(
    log: Annotated[Path, typer.Argument(help="Unfinished (.mcap.part), cut off or damaged log; it is only read.")],
    out: Annotated[Path, typer.Option("--out", help="Log to write (.mcap); must not exist.")],
    json: JsonOption = False,
) -> None:
    """Save what stands before the damage of a log into a new one that is labelled partial.

    A fit takes a partial log that is valid and says so; what it finds is never written to a controller.
    """
    with progress_bar("salvaging") as told:
        saved = salvage(log, out, lambda samples: told(samples, 0, "samples"))
    statistics = saved.statistics
    if json:
        print_json({"log": str(out), "partial": statistics.partial, "samples": statistics.samples,
                    "duration_s": saved.duration_s, "lost_cycles": statistics.lost_cycles,
                    "missing": statistics.missing, "valid": statistics.valid, "reason": statistics.reason,
                    "left_out_bytes": saved.left_out_bytes, "damage": saved.damage})  # fmt: skip
        return
    use = "a fit takes it and says so, and nothing fitted with it is written to a controller"
    typer.echo(
        f"{printable(str(out))}: {statistics.samples} samples, {saved.duration_s:g} s, PARTIAL"
        + (f": {use}" if statistics.valid else "")
    )
    if saved.left_out_bytes:
        typer.echo(f"left out: {saved.left_out_bytes} bytes, from {printable(saved.damage)}")
    if not statistics.valid:
        typer.echo(f"INVALID: {printable(statistics.reason)}; a fit will refuse it")


SALVAGE = Verb("salvage", salvage_verb, "drivegain salvage bare.mcap.part --out bare-partial.mcap")
