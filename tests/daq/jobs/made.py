"""A whole job, made once: rigs whose recordings and fit are copies of it,
at a time of their own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.files import sha256_of
from daq.jobs.context import Tools
from daq.workflow.fit import Fit
from daq.workflow.record import Recorded, RecordingRequest
from ident.calibration import Calibration
from ident.discovery.before_after import Account
from tests.daq.jobs.rig import Rig, make_plan, make_rig, powerless, serving


@dataclass(frozen=True)
class Made:
    """Products of a whole real job, for tests of what comes after the recordings.

    Attributes:
        plan_file: of its runs.
        logs: by their runs' names.
        recorded: what the recorder reported on each.
        fitted, closed: before and after the loop.
        changed: what the loop has changed.
        calibration: of the fit after the loop.
    """

    plan_file: Path
    logs: dict[str, Path]
    recorded: dict[str, Recorded]
    fitted: Fit
    closed: Fit
    changed: Account
    calibration: Calibration

    def tools(self, rig: Rig, **factors: float) -> Tools:
        """Recorder and fit that know the result already: with the rig's cell, at the rig's time.

        Args:
            rig: whose tools they are.
            factors: by which gains have changed since, by axis.
        """

        def copied(request: RecordingRequest, **further: Any) -> Recorded:
            out = request.out
            further["require_released"]()  # before the drives are used
            further["require_released"]()  # before they get power
            # Logs of another day are other logs; the fit that would read them knows its result
            # already.
            content = self.logs[out.stem].read_bytes()
            out.write_bytes(content + str(rig.clock.at).encode())
            return replace(self.recorded[out.stem], path=out)

        def in_this_cell(_fit: Fit, created: datetime) -> Calibration:
            running = [one for one in rig.sessions if one.state.outcome is None]
            session = running[-1].folder  # by its date, one of the future is later
            sources = tuple(
                replace(
                    source,
                    sha256=sha256_of(session / f"{source.name}.mcap") or "",
                    recording=source.recording
                    and replace(
                        source.recording, controller_sha256=None, recorded_s=created.timestamp()
                    ),
                )
                for source in self.calibration.sources
            )
            return replace(
                self.calibration,
                created=created.isoformat(),
                configuration_sha256=rig.cell.digest,
                recording_configuration_sha256=rig.cell.recording_digest,
                sources=sources,
                gains=tuple(
                    replace(gain, value=gain.value * factors.get(gain.axis, 1.0))
                    for gain in self.calibration.gains
                ),
            )

        return replace(
            rig.tools,
            save_report=lambda _fit, _account, _calibration, folder: (
                folder / "report.html"
            ).touch(),
            drives=lambda _cell, _undisturbed, _take_over: None,
            record=copied,
            fit=lambda logs, *, holdout: self.fitted,
            close_loop=lambda _fit, _seed, _report: self.closed,
            account=lambda _start, _steps: self.changed,
            calibration=in_this_cell,
        )


def made_rig(folder: Path, made: Made, **section: Any) -> Rig:
    """A rig whose recordings are copies of those that were made."""
    rig = make_rig(folder, made.plan_file, **section)
    rig.tools = made.tools(rig)
    return rig


def whole_job(folder: Path) -> tuple[Rig, Made]:
    """A real job from the first frame to the controller's file, and what it made.

    Args:
        folder: of the cell; empty, the plan goes beside it.
    """
    path = shipped_configurations() / "cells" / "demo.yaml"
    cell = load_cell(path)
    plan_path = folder.parent / "plan.yaml"
    plan_file = make_plan(cell, plan_path, seed=11, duration_s=6.0, moves=4)
    rig = make_rig(folder, plan_file)
    kept: dict[str, Any] = {}
    recorded: dict[str, Recorded] = {}
    tools = rig.tools

    def keep_record(request: RecordingRequest, **further: Any) -> Recorded:
        found = tools.record(request, **further)
        recorded[found.path.stem] = found
        return found

    def keep(name: str) -> Any:
        def called(*given: Any, **further: Any) -> Any:
            found = getattr(tools, name)(*given, **further)
            kept[name] = found
            return found

        return called

    rig.tools = replace(
        tools,
        record=keep_record,
        **{name: keep(name) for name in ("fit", "close_loop", "account", "calibration")},
    )
    with serving(rig) as cell_there:
        rig.job()
        assert powerless(cell_there)
    logs = {name: rig.session.folder / f"{name}.mcap" for name in recorded}
    made = Made(
        plan_file,
        logs,
        recorded,
        kept["fit"],
        kept["close_loop"],
        kept["account"],
        kept["calibration"],
    )
    return rig, made
