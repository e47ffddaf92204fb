"""`recalibration` of a cell file: the steps of a scheduled recalibration, and its limits."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator

Argument = Annotated[str, Field(max_length=4000, pattern=r"^[^\x00]+$")]
Arguments = Annotated[tuple[Argument, ...], Field(min_length=1, max_length=100)]
FileName = Annotated[str, Field(min_length=1, max_length=400, pattern=r"^[^\x00]+$")]
RunName = Annotated[str, Field(max_length=40, pattern=r"^[a-z0-9][a-z0-9_-]*$")]
Seconds = Annotated[float, Field(gt=0, le=24 * 3600)]
Hours = Annotated[float, Field(ge=0, le=100_000)]
RESERVED = ("warm-up",)  #: Names of logs that are not runs of the fit


@dataclass(frozen=True, slots=True)
class Command:
    """A program of the cell."""

    command: Arguments  #: program and arguments; no shell is involved
    timeout_s: Seconds = 900.0  #: time after which the program is killed and counts as failed [s]


@dataclass(frozen=True, slots=True)
class InterlockFile:
    """A file that the gateway of a safety controller renews while the cell is closed."""

    path: Path  #: absolute
    says: str  #: first line of the file while the robot may move
    max_age_s: float  #: an older file releases nothing [s]


@dataclass(frozen=True, slots=True)
class Interlock:
    """Sources that confirm that the cell is closed, empty and in automatic mode. If both are given, both must agree."""

    command: Command | None
    file: InterlockFile | None


@dataclass(frozen=True, slots=True)
class PlannedRun:
    """One recording of a session."""

    name: str  #: name of its log
    payload: str | None  #: mounted payload, None without load
    #: Mass of the payload as weighed for this job, beside that in `payloads` [kg]; None without load.
    mass_kg: float | None
    plan_file: Path | None  #: approved moves, absolute; None if they are planned from a seed
    seed: int  #: seed of the planned moves
    duration_s: float  #: duration of the planned moves [s]
    holdout: bool  #: the run is held out of the fit


@dataclass(frozen=True, slots=True, kw_only=True)
class _Bounds:
    """Keys that mean the same in the file and in the program."""

    mount: Command  #: called before each run with the payload's name, or "none", as last argument
    #: Duration of the moves before the first run, which are not logged [min].
    warm_up_min: Annotated[float, Field(ge=0, le=240)] = 10.0
    every_h: Hours = 144.0  #: nothing is due while the last good calibration is younger [h]
    max_duration_min: Annotated[float, Field(gt=0, le=24 * 60)] = 120.0  #: longest duration of a job [min]
    resume_within_h: Hours = 12.0  #: largest age of a session that is resumed [h]
    retries: Annotated[int, Field(ge=0, le=5)] = 1  #: further attempts of a run that its recorder marked invalid
    min_free_mb: Annotated[float, Field(ge=0)] = 1000.0  #: free space on the disk required at the start [MB]
    keep_sessions: Annotated[int, Field(ge=1)] = 20  #: number of ended sessions whose logs are kept
    seed: Annotated[int, Field(ge=0)] = 0  #: seed of the significance test


@dataclass(frozen=True, slots=True, kw_only=True)
class Recalibration(_Bounds):
    """A scheduled recalibration."""

    folder: Path  #: parent of its sessions, each with logs, state and report; absolute
    runs: tuple[PlannedRun, ...]  #: in the order of their recording
    interlock: Interlock  #: checked before each run
    metrics: Path | None  #: folder of Prometheus' textfile collector, None without one
    working_folder: Path  #: folder in which commands run: that of the cell file


# The file writes three parts differently: file names are relative to the cell file, the interlock is one mapping, and
# a run has a plan or a plan file.


@dataclass(frozen=True, slots=True, kw_only=True)
class InterlockSection:
    """`interlock`."""

    command: Arguments | None = None
    timeout_s: Seconds = 10.0
    file: FileName | None = None
    says: Annotated[str, Field(min_length=1, max_length=200)] = "closed"
    max_age_s: Seconds = 10.0

    @model_validator(mode="after")
    def _check_sources(self) -> InterlockSection:
        if self.command is None and self.file is None:
            raise ValueError("a command, a file, or both: no job moves a robot unasked")
        return self

    def interlock(self, folder: Path) -> Interlock:
        """Resolve paths."""
        return Interlock(
            None if self.command is None else Command(self.command, self.timeout_s),
            None if self.file is None else InterlockFile((folder / self.file).resolve(), self.says, self.max_age_s),
        )


@dataclass(frozen=True, slots=True)
class SeededPlan:
    """`plan` of a run: moves planned from a seed."""

    seed: Annotated[int, Field(ge=0)]
    duration_s: Annotated[float, Field(ge=5, le=3600)] = 40.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RunSection:
    """One of `runs`."""

    name: RunName
    payload: Annotated[str, Field(min_length=1)] | None = None
    mass_kg: Annotated[float, Field(gt=0)] | None = None
    plan: SeededPlan | None = None
    plan_file: FileName | None = None
    holdout: bool = False

    @model_validator(mode="after")
    def _check_plan_and_payload(self) -> RunSection:
        if self.name in RESERVED:
            raise ValueError(f"another name than {self.name}")
        if (self.payload is None) != (self.mass_kg is None):
            raise ValueError("payload and its mass_kg, as weighed for this job, or neither of the two")
        if (self.plan is None) == (self.plan_file is None):
            raise ValueError("plan: {seed, duration_s}, or plan_file with approved moves")
        return self

    def run(self, folder: Path) -> PlannedRun:
        """Resolve paths."""
        plan = self.plan or SeededPlan(seed=0)
        file = None if self.plan_file is None else (folder / self.plan_file).resolve()
        return PlannedRun(self.name, self.payload, self.mass_kg, file, plan.seed, plan.duration_s, self.holdout)


@dataclass(frozen=True, slots=True, kw_only=True)
class RecalibrationSection(_Bounds):
    """`recalibration`; docs/how-to/schedule-recalibration.md has an example."""

    folder: FileName | None = None
    runs: Annotated[tuple[RunSection, ...], Field(min_length=3, max_length=100)]
    interlock: InterlockSection
    metrics: FileName | None = None

    @model_validator(mode="after")
    def _check_runs(self) -> RecalibrationSection:
        names = [run.name for run in self.runs]
        if len(set(names)) < len(names):
            raise ValueError("runs with names of their own")
        fitted = {run.payload is None for run in self.runs if not run.holdout}
        if fitted != {True, False}:
            raise ValueError("at least one run without and one with a payload that the fit sees (no holdout)")
        if not any(run.holdout for run in self.runs):
            raise ValueError("at least one run with holdout: true, by which the result is judged")
        return self

    def recalibration(self, cell_file: Path) -> Recalibration:
        """Resolve paths."""
        folder = cell_file.parent
        return Recalibration(
            **{bound.name: getattr(self, bound.name) for bound in fields(_Bounds)},
            # Named after the cell file, as its history: two cells in one folder have separate sessions.
            folder=(folder / (self.folder or f"{cell_file.stem}.recalibration")).resolve(),
            runs=tuple(run.run(folder) for run in self.runs),
            interlock=self.interlock.interlock(folder),
            metrics=None if self.metrics is None else (folder / self.metrics).resolve(),
            working_folder=folder.resolve(),
        )
