"""The main job from end to end on a simulated cell,
over the same driver that a real one is recorded with.

This file and the simulate verb are the only ones that may read a simulation file: the truth serves
to judge the result once it is final.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import datetime
from io import StringIO
from itertools import chain
from pathlib import Path
from typing import Any

from daq.config.cell import Cell
from daq.config.cell_buses import bus_address
from daq.config.cell_file import load_cell
from daq.config.policy import HistoryPlace
from daq.config.recalibration import PlannedRun
from daq.documents.calibration_file import EffectEntry, as_document
from daq.documents.session_state import JobState
from daq.environment import shipped_configurations
from daq.errors import CalibrationRefused, UsageError
from daq.files import replace_file
from daq.jobs.context import SessionContext, Tools
from daq.jobs.gain_target import GainTarget
from daq.jobs.journal import Form, Journal
from daq.jobs.operator import GivenAnswers
from daq.jobs.recording import FixedRuns
from daq.jobs.session import REPORT, Session, save
from daq.jobs.stages import TO_DECISION, run_stages
from daq.ledger.audit import head_file
from daq.report.comparison import compare
from daq.report.fit import start_of
from daq.report.job_schemas import DemoGain, DemoLog, DemoPlan, DemoReport, FleetEffect
from daq.report.plots import draw_fit
from daq.report.residual_page import save_report
from daq.simulation.simulation_file import load_simulation, require_simulator
from daq.workflow.fit import Fit, calibration_of, close_loop, fit
from daq.workflow.plan import Plan, plan, save_plan
from daq.workflow.record import Recorded, RecordingRequest, network_of, record
from daq.workflow.safeguards import FreeBytes
from daq.writeback.file_target import FileEdit
from daq.writeback.request import Request
from daq.writeback.target import Proposal, Target, Written, apply, propose
from drivers.canopen.bus import open_bus
from drivers.canopen.network import SignalBlocker
from drivers.canopen.node_scan import FoundNode
from drivers.simulation.spec import CellSpec
from ident.calibration import Calibration, Gain
from ident.discovery.before_after import Account, account
from ident.estimators.estimate import RelativeError

MARK = ".drivegain-demo"
AUDIT = "audit.jsonl"
CONTROLLER_COPY = "controller.yaml"
SUFFIX = ".mcap"  #: Of the logs
RETRIES = 2  #: Of a run that came out invalid
PLANS = ("a", "b", "c")
RUNS = (
    ("bare-1", None, "a"),
    ("loaded-1", "disc", "a"),
    ("bare-2", None, "b"),
    ("loaded-2", "disc", "b"),
    ("held-out", "disc", "c"),
)
"""Name, payload and plan of each run; bare and loaded in turn, so that warm-up is no payload.

The last validates.
"""


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


def demonstrate(
    settings: Settings, now: Callable[[], datetime], reporter: ProgressReporter
) -> DemoOutcome:
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
    logs = tuple(out / f"{name}{SUFFIX}" for name, _, _ in RUNS)
    replaced = make_room(out, logs)
    if replaced:
        names = ", ".join(log.name for log in replaced)
        reporter.step(
            f"start anew: {names} of an earlier demonstration are recorded again and replaced"
        )
    reporter.step("scan the bus")
    spec = load_simulation(settings.simulation)
    with _simulated(cell, spec), network_of(cell) as network:
        nodes = network.scan()
        network.check_identities()
    reporter.step("plan exciting moves")
    plans = [_plan(settings, cell, index, reporter) for index in range(len(PLANS))]
    stages = DemoStages(settings, cell, now, reporter)
    stages.run(cell_file)
    reporter.step("draw the pictures")
    true_gains = [true.gain_nm_per_a for true in spec.axes]
    truth = dict(zip(cell.axis_names, true_gains, strict=True))
    fitted = stages.fitted
    calibration = stages.calibration
    proposal = stages.proposal
    draw_fit(fitted, calibration, truth, out)
    changed = account(start_of(fitted), fitted.steps)
    # After the write, so that the certificate says that the gains are written.
    request = Request(calibration, now())
    compared = compare(cell, request, file=out / CONTROLLER_COPY, audit=out / AUDIT)
    save_report(fitted, changed, calibration, out / REPORT, compared)
    recorded = tuple(stages.recorded[name] for name, _, _ in RUNS)
    return DemoOutcome(
        cell=cell,
        nodes=nodes,
        plans=tuple(plans),
        recorded=recorded,
        fitted=fitted,
        changed=changed,
        calibration=calibration,
        truth=truth,
        proposal=proposal,
        written=stages.written,
    )


@dataclass(frozen=True, slots=True)
class _Limits:
    """Limits and places of a session, as a demonstration has them (`SessionSettings`)."""

    folder: Path
    seed: int
    warm_up_min: float = 0.0
    retries: int = RETRIES
    min_free_mb: float = 0.0
    keep_sessions: int = 1
    metrics: Path | None = None


class DemoStages:
    """The stages of a job on the simulated cell, and what they make.

    Attributes:
        recorded: recordings by the names of their runs, the last one of each.
        fitted: with the effects that were found.
        calibration: as saved.
        proposal: what the controller file would get.
        written: what its copy got; None where a gate is closed.
    """

    fitted: Fit
    calibration: Calibration
    proposal: Proposal[FileEdit]

    def __init__(
        self,
        settings: Settings,
        cell: Cell,
        now: Callable[[], datetime],
        reporter: ProgressReporter,
    ) -> None:
        """Store the arguments, those of `demonstrate`."""
        self._settings = settings
        self._cell = cell
        self._now = now
        self._reporter = reporter
        self._attempts: Counter[str] = Counter()
        self.recorded: dict[str, Recorded] = {}
        self.written: Written | None = None

    def run(self, cell_file: Path) -> None:
        """Take the stages.

        Raises:
            DaqError, DriverError, IdentificationError: whatever a job on a real cell could raise,
                but for a closed gate: the proposal says which one it is.
        """
        cell = self._cell
        out = self._settings.out
        assert cell.controller_path is not None  # the shipped cell has a controller
        controller_copy = out / CONTROLLER_COPY
        replace_file(controller_copy, cell.controller_path.read_bytes())
        masses_kg = {payload.name: payload.mass_kg for payload in cell.payloads}
        limits = _Limits(out, self._settings.seed)
        runs = FixedRuns(_planned_runs(out, masses_kg))
        # A run powers on a cell that carries its payload: there is nothing to mount.
        answers = GivenAnswers(
            "demo", masses_kg, lambda _payload: None, "the demonstration: a simulated cell"
        )
        history = HistoryPlace(out / "history.sqlite", out / AUDIT)
        target = GainTarget(cell, history, controller_copy)
        journal = Journal(StringIO(), Form.TEXT, self._now)
        context = SessionContext(
            cell_file, cell, limits, runs, answers, target, self._tools(), journal
        )
        at = self._now().isoformat(timespec="seconds")
        state = JobState(
            session="demo",
            cell=cell.name,
            configuration_sha256=cell.digest,
            began=at,
            attempt_began=at,
        )
        with suppress(CalibrationRefused):
            run_stages(TO_DECISION, context, save(Session(out, state)))

    def _tools(self) -> Tools:
        """Return the tools of a job, which report their progress and keep what they make."""
        reporter = self._reporter

        def fit_runs(logs: Sequence[Path], *, holdout: Sequence[Path]) -> Fit:
            reporter.step("identify all gains and parameters")
            return fit(logs, holdout=holdout, keep_rows=True)

        def close_reported(fitted: Fit, seed: int, _report: Callable[[str], None]) -> Fit:
            reporter.step("detect missing effects")
            self.fitted = close_loop(fitted, seed, lambda step: reporter.progress(0, 0, step))
            return self.fitted

        def calibrate(fitted: Fit, created: datetime) -> Calibration:
            self.calibration = calibration_of(fitted, created)
            return self.calibration

        def propose_copy(target: Target[Any], request: Request) -> Proposal[FileEdit]:
            reporter.step("write the calibration to a copy of the controller file")
            self.proposal = propose(target, request)
            return self.proposal

        def apply_copy(
            proposal: Proposal[FileEdit], now: datetime, *, audit: Path, who: str
        ) -> Written | None:
            self.written = apply(proposal, now, audit=audit, who=who)
            return self.written

        return Tools(
            save_report=lambda *_: None,  # it is made with the pictures, when all is done
            drives=lambda *_: None,  # they were scanned
            record=self._record,
            fit=fit_runs,
            close_loop=close_reported,
            calibration=calibrate,
            propose=propose_copy,
            apply=apply_copy,
            now=self._now,
        )

    def _record(
        self,
        request: RecordingRequest,
        *,
        free: FreeBytes,
        block_signals: SignalBlocker,
        require_released: Callable[[], None],
    ) -> Recorded:
        """Record one run of a simulated cell that carries its payload;
        an invalid one is recorded again.
        """
        settings = self._settings
        reporter = self._reporter
        name = request.out.stem
        payload = None
        if request.payload is not None:
            payload = request.payload.name
        self._attempts[name] += 1
        if name not in self.recorded:
            load = "without load"
            if payload is not None:
                load = f"with {payload}"
            reporter.step(f"record {name}: {load}")
        else:
            # A busy computer lets the simulated cell answer late, or twice in a period.
            reason = self.recorded[name].log.reason
            again = self._attempts[name] - 1
            reporter.step(f"record {name} again ({again} of at most {RETRIES} times): {reason}")
        spec = load_simulation(settings.simulation, payload)
        # Another noise in every run, as another day would bring; the plant is the same.
        names = [run for run, _, _ in RUNS]
        seed = spec.seed + 100 * settings.seed + names.index(name)
        spec = replace(spec, seed=seed)
        request = replace(request, run_id=f"demo-{settings.seed}-{name}")
        with _simulated(self._cell, spec):
            self.recorded[name] = record(
                request,
                free=free,
                block_signals=block_signals,
                progress=lambda done, total: reporter.progress(done, total, "moves"),
                require_released=require_released,
            )
        return self.recorded[name]


def _planned_runs(out: Path, masses_kg: dict[str, float]) -> tuple[PlannedRun, ...]:
    """Return the runs of the demonstration."""
    last_name, _, _ = RUNS[-1]
    runs = []
    for name, payload, plan_name in RUNS:
        mass_kg = None
        if payload is not None:
            mass_kg = masses_kg[payload]
        run = PlannedRun(
            name=name,
            payload=payload,
            mass_kg=mass_kg,
            plan_file=out / f"plan-{plan_name}.yaml",
            holdout=name == last_name,
        )
        runs.append(run)
    return tuple(runs)


def demo_report(outcome: DemoOutcome, seconds: float) -> DemoReport:
    """Return the outcome as `summary.json` holds it;
    `seconds` is how long the demonstration took.
    """
    before = outcome.fitted.identification.holdout_error
    after = outcome.fitted.final.holdout_error
    first = next(iter(outcome.calibration.effects), None)
    effect = None
    if first is not None:
        effect = FleetEffect.of(first)
    entries = as_document(outcome.calibration)["effects"]
    effects = [EffectEntry.model_validate(entry, strict=False) for entry in entries]
    before_percent, before_percent_axes = _error_percent(before)
    after_percent, after_percent_axes = _error_percent(after)
    return DemoReport(
        gains=demo_gains(outcome),
        effect=effect,
        effects=effects,
        error_before_percent=before_percent,
        error_after_percent=after_percent,
        error_before_percent_axes=before_percent_axes,
        error_after_percent_axes=after_percent_axes,
        plans=[DemoPlan.of(made, moves=len(made.moves)) for made in outcome.plans],
        logs=[DemoLog.of(run.log, log=run.path.name) for run in outcome.recorded],
        controller_diff=outcome.proposal.edit.diff,
        applied=outcome.written is not None,
        seconds=seconds,
    )


def _error_percent(error: RelativeError | None) -> tuple[float | None, list[float | None] | None]:
    """Return a relative error of all axes together and of each; None where there is none."""
    if error is None:
        return None, None
    return error.total, list(error.axes)


def demo_gains(outcome: DemoOutcome) -> list[DemoGain]:
    """Return each gain with the true one."""
    gains = outcome.calibration.gains
    paper = outcome.fitted.paper
    paper_gains: list[float | None] = [None] * len(gains)
    if paper is not None:
        paper_gains = paper.gains.tolist()
    compared = []
    for gain, paper_tls in zip(gains, paper_gains, strict=True):
        truth = outcome.truth[gain.axis]
        compared.append(_gain(gain, truth, paper_tls))
    return compared


def _gain(gain: Gain, truth: float, paper_tls: float | None) -> DemoGain:
    error_percent = 100.0 * (gain.value / truth - 1.0)
    return DemoGain.of(
        gain,
        identified=gain.value,
        truth=truth,
        error_percent=error_percent,
        paper_tls=paper_tls,
    )


def make_room(out: Path, logs: tuple[Path, ...]) -> tuple[Path, ...]:
    """Take a folder, and remove what an earlier demonstration left in it;
    a folder of anything else is not ours.

    Args:
        out: the folder.
        logs: that the demonstration will record in it.

    Returns:
        those of the logs that were there.
    """
    if out.exists() and not _is_replaceable(out):
        raise UsageError(
            str(out),
            found="something that is no folder of a demonstration",
            expected="no such folder, an empty one, or that of an earlier demonstration",
            remedy="choose another --out",
        )
    out.mkdir(parents=True, exist_ok=True)
    replace_file(
        out / MARK, b"Made by `drivegain demo`, which may replace what is in this folder.\n"
    )
    replaced = tuple(log for log in logs if log.is_file())
    for log in logs:
        log.unlink(missing_ok=True)
        log.with_name(log.name + ".part").unlink(missing_ok=True)
    pictures = out.glob("residual-*")
    logs_aside = out.glob(f"*-aside-*{SUFFIX}")
    for older in chain(pictures, logs_aside):
        older.unlink()
    # The audit and its head: the copy of the controller file is a new one.
    for older in (out / AUDIT, head_file(out / AUDIT)):
        older.unlink(missing_ok=True)
    return replaced


def _is_replaceable(out: Path) -> bool:
    """Whether a path is an empty folder, or that of an earlier demonstration."""
    if not out.is_dir():
        return False
    is_empty = not any(out.iterdir())
    return is_empty or (out / MARK).is_file()


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
    name = PLANS[index]
    exchanges = 800

    def report_exchange(done: int, std_percent: float) -> None:
        reporter.progress(done, exchanges, f"plan {name}, worst gain σ {std_percent:.2f} %")

    made = plan(
        cell,
        seed=10 * settings.seed + index,
        duration_s=settings.duration_s,
        exchanges=exchanges,
        progress=report_exchange,
    )
    save_plan(made, settings.out / f"plan-{name}.yaml")
    return made
