"""The main job from end to end on a simulated cell, over the same driver that a real one is recorded with.

This file and the simulate verb are the only ones that may read a simulation file: the truth serves to judge the result
once it is final.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from daq.config.cell import Cell
from daq.config.cell_buses import bus_address
from daq.config.cell_file import load_cell
from daq.documents.calibration_file import EffectEntry, as_document, save_calibration
from daq.environment import shipped_configurations
from daq.errors import UsageError
from daq.files import replace_file
from daq.report.comparison import compare
from daq.report.fit import start_of
from daq.report.job_schemas import DemoGain, DemoLog, DemoPlan, DemoReport, FleetEffect
from daq.report.plots import draw_fit
from daq.report.residual_page import save_report
from daq.simulation.simulation_file import load_simulation, require_simulator
from daq.workflow.fit import Fit, calibration_of, close_loop, fit
from daq.workflow.plan import Plan, plan, save_plan
from daq.workflow.record import Recorded, RecordingRequest, network_of, record
from daq.writeback.file_target import FileEdit, FileTarget
from daq.writeback.request import Request
from daq.writeback.target import Proposal, Written, apply, propose
from drivers.canopen.bus import open_bus
from drivers.canopen.node_scan import FoundNode
from drivers.simulation.spec import CellSpec
from ident.calibration import Calibration, Gain
from ident.discovery.before_after import Account, account

MARK = ".drivegain-demo"
REPORT = "report"  #: Folder of the certificate
RETRIES = 2  #: Of a run that came out invalid
PLANS = ("a", "b", "c")
RUNS = (
    ("bare-1", None, "a"),
    ("loaded-1", "disc", "a"),
    ("bare-2", None, "b"),
    ("loaded-2", "disc", "b"),
    ("held-out", "disc", "c"),
)
"""Name, payload and plan of each run; bare and loaded in turn, so that warm-up is no payload. The last is held out."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of a demonstration."""

    out: Path  #: folder that it fills; files of an earlier demonstration in it are replaced
    simulation: Path  #: file of the simulated cell
    seed: int  #: of plans, noise and significance test
    duration_s: float  #: of each run [s]


@dataclass(frozen=True, slots=True)
class ProgressReporter:
    """Receivers of the progress."""

    step: Callable[[str], None]  #: a new step begins, in words
    progress: Callable[[int, int, str], None]  #: done, total and a remark within it


@dataclass(frozen=True, slots=True)
class DemoOutcome:
    """All that the demonstration found."""

    cell: Cell  #: declared
    nodes: tuple[FoundNode, ...]  #: found on the bus
    plans: tuple[Plan, ...]  #: made
    recorded: tuple[Recorded, ...]  #: logs
    fitted: Fit  #: with the effects that were found
    changed: Account  #: by the effects
    calibration: Calibration  #: as saved
    truth: dict[str, float]  #: true gain by axis
    proposal: Proposal[FileEdit]  #: what the controller file would get
    written: Written | None  #: what its copy got


def demonstrate(settings: Settings, now: Callable[[], datetime], reporter: ProgressReporter) -> DemoOutcome:
    """Scan, plan, record, identify, close the loop, and write a copy of the controller file.

    Args:
        settings: what may be chosen.
        now: wall clock with time zone.
        reporter: receives the progress.

    Raises:
        DaqError, DriverError, IdentificationError: whatever a real cell could raise.
    """
    require_simulator()
    cell_file = shipped_configurations() / "cells" / "demo.yaml"
    cell = load_cell(cell_file)
    out = settings.out
    logs = tuple(out / f"{name}.mcap" for name, _, _ in RUNS)
    make_room(out, logs)
    reporter.step("scan the bus")
    with _simulated(cell, load_simulation(settings.simulation)), network_of(cell) as network:
        nodes = network.scan()
        network.check_identities()
    reporter.step("plan exciting moves")
    plans = tuple(_plan(settings, cell, index, reporter) for index in range(len(PLANS)))
    recorded = tuple(_record_valid(settings, cell_file, cell, plans, index, reporter) for index in range(len(RUNS)))
    reporter.step("identify all gains and parameters")
    fitted = fit(logs[:-1], holdout=logs[-1:], keep_rows=True)
    reporter.step("detect missing effects")
    fitted = close_loop(fitted, settings.seed, lambda step: reporter.progress(0, 0, step))
    calibration = calibration_of(fitted, now())
    save_calibration(calibration, out / "calibration.yaml")
    reporter.step("write the calibration to a copy of the controller file")
    if cell.controller_path is None:
        raise UsageError("the demo cell", found="no controller", expected="one", remedy="install drivegain again")
    target = out / "controller.yaml"
    audit = out / "audit.jsonl"
    replace_file(target, cell.controller_path.read_bytes())
    proposal = propose(FileTarget.of(cell, target), Request(calibration, now()))
    written = None if proposal.refusals else apply(proposal, now(), audit=audit, who="demo")
    reporter.step("draw the pictures")
    spec = load_simulation(settings.simulation)
    truth = {axis.name: true.gain_nm_per_a for axis, true in zip(cell.axes, spec.axes, strict=True)}
    draw_fit(fitted, calibration, truth, out)
    changed = account(start_of(fitted), fitted.steps)
    (out / REPORT).mkdir(exist_ok=True)
    # After the write, so that the certificate says that the gains are written.
    compared = compare(cell, Request(calibration, now()), file=target, audit=audit)
    save_report(fitted, changed, calibration, out / REPORT, compared)
    return DemoOutcome(cell, nodes, plans, recorded, fitted, changed, calibration, truth, proposal, written)


def demo_report(outcome: DemoOutcome, seconds: float) -> DemoReport:
    """Return the outcome as `summary.json` holds it; `seconds` is how long the demonstration took."""
    before, after = outcome.fitted.identification.holdout_error, outcome.fitted.final.holdout_error
    first = next(iter(outcome.calibration.effects), None)
    return DemoReport(
        gains=demo_gains(outcome),
        effect=None if first is None else FleetEffect(name=first.name, axis=first.axis),
        effects=[EffectEntry.model_validate(one, strict=False) for one in as_document(outcome.calibration)["effects"]],
        error_before_percent=None if before is None else before.total,
        error_after_percent=None if after is None else after.total,
        error_before_percent_axes=None if before is None else list(before.axes),
        error_after_percent_axes=None if after is None else list(after.axes),
        plans=[_made(made) for made in outcome.plans],
        logs=[_recorded(run) for run in outcome.recorded],
        controller_diff=outcome.proposal.edit.diff,
        applied=outcome.written is not None,
        seconds=seconds,
    )


def demo_gains(outcome: DemoOutcome) -> list[DemoGain]:
    """Return each gain beside the truth."""
    paper = outcome.fitted.paper
    values = [None] * len(outcome.truth) if paper is None else paper.gains.tolist()
    return [
        _gain(gain, outcome.truth[gain.axis], tls) for gain, tls in zip(outcome.calibration.gains, values, strict=True)
    ]


def _gain(gain: Gain, truth: float, paper_tls: float | None) -> DemoGain:
    return DemoGain(
        axis=gain.axis,
        nameplate=gain.nameplate,
        identified=gain.value,
        std_percent=gain.std_percent,
        truth=truth,
        error_percent=100.0 * (gain.value / truth - 1.0),
        paper_tls=paper_tls,
    )


def _made(made: Plan) -> DemoPlan:
    return DemoPlan(
        moves=len(made.moves),
        condition=made.condition,
        predicted_std_percent=list(made.predicted_std_percent),
    )


def _recorded(run: Recorded) -> DemoLog:
    return DemoLog(
        log=run.path.name,
        samples=run.log.samples,
        lost_cycles=run.log.lost_cycles,
        valid=run.log.valid,
    )


def make_room(out: Path, logs: tuple[Path, ...]) -> None:
    """Take a folder, and remove what an earlier demonstration left in it; a folder of anything else is not ours."""
    if out.exists() and (not out.is_dir() or (any(out.iterdir()) and not (out / MARK).is_file())):
        raise UsageError(
            str(out),
            found="something that is no folder of a demonstration",
            expected="no such folder, an empty one, or that of an earlier demonstration",
            remedy="choose another --out",
        )
    out.mkdir(parents=True, exist_ok=True)
    replace_file(out / MARK, b"Made by `drivegain demo`, which may replace what is in this folder.\n")
    for log in logs:
        log.unlink(missing_ok=True)
        log.with_name(log.name + ".part").unlink(missing_ok=True)
    for picture in out.glob("residual-*"):
        picture.unlink()


@contextmanager
def _simulated(cell: Cell, spec: CellSpec) -> Iterator[None]:
    """A simulated cell that answers on the bus of the demonstration."""
    from drivers.simulation.cell import SimulatedCell  # noqa: PLC0415 - its packages are an optional extra

    bus = open_bus(bus_address(cell))
    try:
        with SimulatedCell(spec, bus):
            yield
    finally:
        bus.shutdown()


def _plan(settings: Settings, cell: Cell, index: int, reporter: ProgressReporter) -> Plan:
    exchanges = 800
    made = plan(
        cell,
        seed=10 * settings.seed + index,
        duration_s=settings.duration_s,
        exchanges=exchanges,
        progress=lambda done, std: reporter.progress(done, exchanges, f"plan {PLANS[index]}, worst gain σ {std:.2f} %"),
    )
    save_plan(made, settings.out / f"plan-{PLANS[index]}.yaml")
    return made


def _record_valid(
    settings: Settings, cell_file: Path, cell: Cell, plans: tuple[Plan, ...], index: int, reporter: ProgressReporter
) -> Recorded:
    """Record one run, again where it is invalid; the last attempt is kept as it is, for the fit."""
    name, payload, plan_name = RUNS[index]
    reporter.step(f"record {name}: {'without load' if payload is None else 'with ' + payload}")
    for attempt in range(1, RETRIES + 1):
        recorded = _record(settings, cell_file, cell, plans[PLANS.index(plan_name)], index, reporter)
        if recorded.log.valid:
            return recorded
        # A busy computer lets the simulated cell answer late, or twice in a period.
        reporter.step(f"record {name} again ({attempt} of at most {RETRIES} times): {recorded.log.reason}")
        recorded.path.unlink()
    return _record(settings, cell_file, cell, plans[PLANS.index(plan_name)], index, reporter)


def _record(
    settings: Settings, cell_file: Path, cell: Cell, moves: Plan, index: int, reporter: ProgressReporter
) -> Recorded:
    name, payload, _ = RUNS[index]
    spec = load_simulation(settings.simulation, payload)
    declared = {candidate.name: candidate for candidate in cell.payloads}
    mounted = None if payload is None else declared[payload]
    request = RecordingRequest(
        cell_file,
        cell,
        moves,
        settings.out / f"{name}.mcap",
        payload=None if mounted is None else mounted.payload,
        operator="demo",
        granted_by="the demonstration: a simulated cell",
        run_id=f"demo-{settings.seed}-{name}",
        entered_kg=None if mounted is None else mounted.mass_kg,  # the simulated disc is what it is called
    )
    # Another noise in every run, as another day would bring; the plant is the same.
    with _simulated(cell, replace(spec, seed=spec.seed + 100 * settings.seed + index)):
        return record(request, progress=lambda done, total: reporter.progress(done, total, "moves"))
