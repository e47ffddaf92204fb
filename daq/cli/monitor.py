"""`drivegain monitor` and `console`: the axes live in the terminal,
and on a page during a recording.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from daq.cli.record import mounted
from daq.cli.scan import no_answer
from daq.cli.terminal import ENDING, interruptible, until_interrupted
from daq.cli.verb import CellArgument, JsonOption, print_json, read_calibration, read_cell
from daq.environment import require_packages
from daq.errors import UsageError


def monitor_verb(
    cell: CellArgument,
    once: Annotated[bool, typer.Option("--once", help="Show one reading and end.")] = False,
    interval: Annotated[
        float, typer.Option(help="Time between two readings [s].", min=0.1, max=60.0)
    ] = 0.5,
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration that predicts the currents.")
    ] = None,
    payload: Annotated[
        str | None, typer.Option(help="Mounted payload, by its name in the cell file.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Show position, current, state, rate and losses of every axis, and the load of the bus,
    until Ctrl-C.

    The first two seconds only listen. While another master is on the bus, nothing is sent, and the
    axes' answers to that master are shown; otherwise the axes are queried. Nothing is written,
    enabled or moved. `drivegain console` shows the same as curves. Currents are predicted while a
    master sends SYNC: a queried axis is not sampled fast enough for an acceleration. --json implies
    --once.
    """
    from rich.console import Console

    from daq.cli.patient_live import PatientLive
    from daq.config.cell_buses import cell_address, drive_axes
    from daq.log.feed import Feed
    from daq.report.bus_views import monitor_report, monitor_view
    from daq.workflow.monitor import CellWatch
    from daq.workflow.validate import check_cell
    from drivers.canopen.network import CanopenNetwork
    from drivers.canopen.sdo import SdoPolicy
    from drivers.stream.monitor import ABANDONED_S, QUIET_S

    declared = read_cell(cell)
    carried = mounted(declared, payload)
    if calibration is None:
        known = None
    else:
        known = read_calibration(calibration)
    if known is not None:
        check_cell(known, cell, declared)
    console = Console(highlight=False)
    policy = SdoPolicy(timeout_s=0.3, attempts=2)
    with (
        until_interrupted(),
        interruptible(signals=ENDING),
        Feed(cell, stop=None) as feed,
        CanopenNetwork(cell_address(declared), drive_axes(declared), policy=policy) as network,
    ):
        watch = CellWatch(
            cell, declared, network, feed, known, None if carried is None else carried.name
        )
        watch.listen(QUIET_S)
        if once or json or not console.is_terminal:
            report = monitor_report(declared, watch.read(interval))
            if any(axis.silent for axis in report.axes):  # it may be a slow one
                report = monitor_report(declared, watch.read(ABANDONED_S))
            if json:
                print_json(report)
            else:
                console.print(monitor_view(report))
            silent = [
                axis for axis, shown in zip(network.axes, report.axes, strict=True) if shown.silent
            ]
            heard = tuple(axis.node_id for axis in report.axes if not axis.silent)
            if silent:
                raise no_answer(declared, silent, heard, QUIET_S + interval + ABANDONED_S)
            return
        if feed.remark:
            console.print(feed.remark)
        with PatientLive(console=console, auto_refresh=False, screen=False) as live:
            while True:
                live.update(
                    monitor_view(monitor_report(declared, watch.read(interval))), refresh=True
                )


def console_verb(
    cell: CellArgument,
    calibration: Annotated[
        Path | None,
        typer.Option(
            help="Calibration that predicts the currents; that of the last session by default."
        ),
    ] = None,
    report: Annotated[
        Path | None, typer.Option(help="Folder of a report; that of the last session by default.")
    ] = None,
    port: Annotated[
        int, typer.Option(help="Port on 127.0.0.1; 0 takes a free one.", min=0, max=65535)
    ] = 0,
    foxglove: Annotated[
        int | None,
        typer.Option(
            metavar="PORT",
            help="Also stream to Foxglove; all programs of this computer can read it.",
            min=0,
            max=65535,
        ),
    ] = None,
) -> None:
    """Serve a page that shows the cell while `record`, `recalibrate` or `monitor` runs;
    open the printed address.

    The page reads only, but for a stop button, which does what Ctrl-C does to `record` and
    `recalibrate` and is no safety function. It never opens the bus, and cannot delay a recording.
    Ctrl-C ends the page alone.
    """
    require_packages("the console", "the web server", "console", "starlette", "uvicorn")
    if foxglove is not None:
        require_packages("the console", "the stream's server", "foxglove", "foxglove")
    from daq.console.live import Live
    from daq.console.results import Results
    from daq.console.server import Page, listen, new_token, server_of
    from daq.workflow.validate import check_cell

    declared = read_cell(cell)
    if report is not None and not report.is_dir():
        raise UsageError(
            str(report),
            found="no such folder",
            expected="the folder of a report",
            remedy="check the name, or leave --report out",
        )
    results = Results(cell, declared, calibration, report)
    if calibration is None:
        known = results.calibration()
    else:
        known = (calibration, read_calibration(calibration))
    if calibration is not None and known is not None:
        check_cell(known[1], cell, declared)
    live = Live(cell, declared)
    live.calibration = None if known is None else known[1]
    beside = []
    with until_interrupted(), ExitStack() as closing:
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
        typer.echo(
            f"Open http://127.0.0.1:{port}/{token}/ in a browser on this computer; Ctrl-C "
            "ends the page."
        )
        server_of(Page(declared, live, results, *beside), token, port).run(sockets=[listener])
