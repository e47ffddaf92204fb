"""`drivegain console`: the live page beside a recording."""

from __future__ import annotations

from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Annotated

import typer

from daq.cli.verb import CellArgument, Verb
from daq.environment import require_packages
from daq.errors import UsageError


def console_verb(
    cell: CellArgument,
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration that predicts the currents; that of the last session by default.")
    ] = None,
    report: Annotated[
        Path | None, typer.Option(help="Folder of a report; that of the last session by default.")
    ] = None,
    port: Annotated[int, typer.Option(help="Port on 127.0.0.1; 0 takes a free one.", min=0, max=65535)] = 0,
    foxglove: Annotated[
        int | None,
        typer.Option(
            metavar="PORT", help="Also stream to Foxglove; all programs of this computer can read it.", min=0, max=65535
        ),
    ] = None,
) -> None:
    """Serve a page that shows the cell while `record`, `recalibrate` or `monitor` runs; open the printed address.

    The page reads only, but for a stop button, which does what Ctrl-C does to `record` and `recalibrate` and is no
    safety function. It never opens the bus, and cannot delay a recording. Ctrl-C ends the page alone.
    """
    require_packages("the console", "the web server", "console", "starlette", "uvicorn")
    if foxglove is not None:
        require_packages("the console", "the stream's server", "foxglove", "foxglove")
    from daq.config.cell_file import load_cell
    from daq.console.live import Live
    from daq.console.results import Results
    from daq.console.server import Page, listen, new_token, server_of
    from daq.documents.calibration_file import load_calibration

    declared = load_cell(cell)
    if report is not None and not report.is_dir():
        raise UsageError(
            str(report),
            found="no such folder",
            expected="the folder of a report",
            remedy="check the name, or leave --report out",
        )
    results = Results(cell, declared, calibration, report)
    known = results.calibration() if calibration is None else (calibration, load_calibration(calibration))
    live = Live(cell, declared)
    live.calibration = None if known is None else known[1]
    beside = []
    with suppress(KeyboardInterrupt), ExitStack() as closing:
        try:
            listener = closing.enter_context(listen(port))
            if foxglove is not None:
                from daq.console.stream import FoxgloveStream

                stream = FoxgloveStream(live, foxglove)
                beside.append(stream.follow)
                typer.echo(f"In Foxglove, open the connection ws://127.0.0.1:{stream.port}")
        except (OSError, RuntimeError) as error:
            raise UsageError(
                f"--port {port}" + ("" if foxglove is None else f" or --foxglove {foxglove}"),
                found=str(getattr(error, "strerror", None) or error),
                expected="a free port on 127.0.0.1",
                remedy="end the other program, or choose another port",
            ) from error
        port = listener.getsockname()[1]
        token = new_token()
        typer.echo(f"Open http://127.0.0.1:{port}/{token}/ in a browser on this computer; Ctrl-C ends the page.")
        server_of(Page(declared, live, results, *beside), token, port).run(sockets=[listener])


CONSOLE = Verb("console", console_verb, "drivegain console CELL --calibration calibration.yaml")
