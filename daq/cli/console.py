"""`drivegain console`: the live page beside a recording."""

from __future__ import annotations

from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from daq.cli.verb import CellArgument, Verb
from daq.errors import ConfigurationMissing, UsageError


def console_verb(
    cell: CellArgument,
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration that predicts the currents; that of the last session by default.")
    ] = None,
    report: Annotated[
        Path | None, typer.Option(help="Folder of a report; that of the last session by default.")
    ] = None,
    port: Annotated[int, typer.Option(help="Port on 127.0.0.1; 0 takes a free one.", min=0, max=65535)] = 0,
) -> None:
    """Serve a page that shows the cell while it is recorded; open the address that is printed.

    The page reads only, but for a stop button, which does what Ctrl-C does to `record` and `recalibrate` and is no
    safety function. It never opens the bus, and cannot delay a recording. Ctrl-C ends the page alone.
    """
    missing = [package for package in ("starlette", "uvicorn") if find_spec(package) is None]
    if missing:
        raise ConfigurationMissing(
            "the console",
            found=f"no package {' and '.join(missing)}",
            expected="the web server of the optional extra `console`",
            remedy="pip install 'drivegain[console]'",
        )
    from daq.config.cell_file import load_cell
    from daq.console.live import Live
    from daq.console.results import Results
    from daq.console.server import Page, listen, new_token, server_of

    declared = load_cell(cell)
    results = Results(cell, declared, calibration, report)
    known = results.calibration()
    live = Live(cell, declared)
    live.calibration = None if known is None else known[1]
    try:
        listener = listen(port)
    except OSError as error:
        raise UsageError(
            f"--port {port}",
            found=str(error.strerror or error),
            expected="a free port on 127.0.0.1",
            remedy="end the other program, or leave --port out",
        ) from error
    with listener, suppress(KeyboardInterrupt):
        port, token = listener.getsockname()[1], new_token()
        typer.echo(f"Open http://127.0.0.1:{port}/{token}/ in a browser on this computer; Ctrl-C ends the page.")
        server_of(Page(declared, live, results), token, port).run(sockets=[listener])


CONSOLE = Verb("console", console_verb, "drivegain console CELL --calibration calibration.yaml")
