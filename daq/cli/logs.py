"""`drivegain info`: what is in a log."""

from __future__ import annotations

from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from daq.cli.terminal import progress_bar
from daq.cli.verb import JsonOption, Verb, print_json, printable
from daq.config.cell import Cell
from daq.config.cell_file import cell_from_bundle
from daq.environment import software
from daq.errors import LogIncomplete
from daq.log.conversion import scaling
from daq.log.csv_import import import_csv
from daq.log.metadata import RunStatistics
from daq.log.reader import LogHead, LogReader
from daq.log.salvage import salvage
from daq.report.fit import current_signals
from drivers.stream.sample import EventKind

_ROUTINE = {EventKind.MOVE_START, EventKind.MOVE_END, EventKind.NMT, EventKind.STATE}
"""Events of every run; the others are worth reading."""


def describe_log(path: Path) -> dict[str, Any]:
    """Everything that is known of a log without converting it, in one pass and bounded memory.

    Raises:
        LogUnreadable: the log cannot be read, or says of itself what its samples deny; a fit refuses it too.
        ConfigurationError: the cell in it is inconsistent.
    """
    reader = LogReader(path)
    samples, first_ns, last_ns, widths = 0, None, 0, set[int]()
    for block in reader:
        samples += len(block.cycle)
        widths.add(block.position_counts.shape[1])
        first_ns = int(block.time_ns[0]) if first_ns is None else first_ns
        last_ns = int(block.time_ns[-1])
    head, statistics = reader.head, reader.statistics
    cell = cell_from_bundle(head.files, names={"cell.yaml": f"{path}, cell.yaml"})
    run = head.run
    _check_counts(path, cell, head, statistics, samples, widths)
    return {
        "log": str(path),
        "sha256": reader.digest,
        "run_id": run.run_id,
        "cell": cell.name,
        "cell_sha256": cell.digest,
        "axes": list(cell.axis_names),
        "current": current_signals(cell),
        "role": run.role.value,
        "payload": None
        if run.payload is None
        else {"name": run.payload.name, "mounting": run.payload.mounting, "known": run.payload.known},
        "rate_hz": run.rate_hz,
        "speed": run.speed,
        "samples": samples,
        "duration_s": samples / run.rate_hz,
        "stamped_duration_s": 0.0 if first_ns is None else (last_ns - first_ns) * 1e-9,
        "moves": sum(event.kind is EventKind.MOVE_START for event in reader.events),
        "lost_cycles": statistics.lost_cycles,
        "missing": dict(zip(cell.axis_names, statistics.missing, strict=True)),
        "partial": reader.partial,
        "valid": statistics.valid,
        "reason": statistics.reason,
        "events": [
            {"time_ns": e.time_ns, "axis": e.axis, "kind": e.kind.value, "code": e.code, "text": e.text}
            for e in reader.events
            if e.kind not in _ROUTINE
        ],
        "operator": run.operator,
        "software": run.software,
        "started": datetime.fromtimestamp(run.started_wall_ns / 1e9, UTC).isoformat() if run.started_wall_ns else None,
        "wall_minus_monotonic_s": run.wall_minus_monotonic_ns * 1e-9,
        "wall_clock_step_s": None
        if statistics.wall_minus_monotonic_ns is None
        else (statistics.wall_minus_monotonic_ns - run.wall_minus_monotonic_ns) * 1e-9,
        "origin": run.origin,
        "attachments": {name: len(data) for name, data in sorted(head.files.items())},
    }


def _check_counts(
    path: Path, cell: Cell, head: LogHead, statistics: RunStatistics, samples: int, widths: set[int]
) -> None:
    """What `daq.log.reader.read_log` and `daq.log.conversion.scaling` ask of a log, without holding it in memory."""
    scaling(cell, head.readback)
    axes = len(cell.axes)
    pairs = (
        (f"{samples} samples", samples == statistics.samples, f"{statistics.samples}, as its recorder counted"),
        (f"samples of {sorted(widths)} axes", widths <= {axes}, f"{axes}, as in its cell configuration"),
        (f"losses of {len(statistics.missing)} axes", len(statistics.missing) == axes, f"{axes}"),
    )
    for found, agrees, expected in pairs:
        if not agrees:
            raise LogIncomplete(
                str(path),
                found=found,
                expected=expected,
                remedy="another tool may have cut or changed the log; take the original",
            )


def info(
    log: Annotated[Path, typer.Argument(help="A log (.mcap).")],
    json: JsonOption = False,
) -> None:
    """Show what is in a log: role and payload, duration, losses, moves, validity."""
    description = describe_log(log)
    if json:
        print_json(description)
        return
    table = Table(show_header=False, box=None)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for key, value in description.items():
        table.add_row(key.replace("_", " "), Text(printable(_readable(value))))
    Console(soft_wrap=True).print(table)


def _readable(value: Any) -> str:
    if value is None or value in ("", [], {}):
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, dict):
        return ", ".join(f"{key} {_readable(item)}" for key, item in value.items())
    if isinstance(value, list):
        return ", ".join(_readable(item) for item in value)
    return str(value)


INFO = Verb("info", info, "drivegain info runs/unloaded-1.mcap --json")


# `drivegain import`: CSV files of another controller become a log.


def import_files(
    description: Annotated[Path, typer.Argument(help="Import description (YAML): columns, units, rate.")],
    data: Annotated[Path, typer.Option("--data", help="Folder of the CSV files.")],
    out: Annotated[Path, typer.Option("--out", help="Log to write (.mcap); must not exist.")],
    cell: Annotated[Path | None, typer.Option("--cell", help="Another cell file than the description's.")] = None,
    json: JsonOption = False,
) -> None:
    """Make a log of the CSV files that another controller wrote."""
    statistics = import_csv(description, data, out, software=software(), cell_path=cell)
    if json:
        print_json({"log": str(out), **asdict(statistics)})
    else:
        typer.echo(f"{out}: {statistics.samples} samples of {len(statistics.missing)} axes")


IMPORT = Verb(
    "import", import_files, "drivegain import configs/imports/tx40.yaml --data ../shared/data/tx40 --out tx40.mcap"
)


# `drivegain salvage`: what can be saved of a recording whose recorder was killed.


def salvage_verb(
    log: Annotated[Path, typer.Argument(help="Unfinished (.mcap.part), cut off or damaged log; it is only read.")],
    out: Annotated[Path, typer.Option("--out", help="Log to write (.mcap); must not exist.")],
    json: JsonOption = False,
) -> None:
    """Save what stands before the damage of a log into a new one that is labelled partial.

    A fit takes a partial log that is valid and says so; what it finds is never written to a controller.
    """
    with progress_bar("salvaging") as report_progress:
        saved = salvage(log, out, lambda samples: report_progress(samples, 0, "samples"))
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
