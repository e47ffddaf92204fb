"""What a scheduled recalibration does, and when it may: `recalibration` of the cell file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator

from daq.config.yaml_file import StrictModel

Argument = Annotated[str, Field(max_length=4000, pattern=r"^[^\x00]+$")]
FileName = Annotated[str, Field(min_length=1, max_length=400, pattern=r"^[^\x00]+$")]
RunName = Annotated[str, Field(max_length=40, pattern=r"^[a-z0-9][a-z0-9_-]*$")]
Seconds = Annotated[float, Field(gt=0, le=24 * 3600)]
Hours = Annotated[float, Field(ge=0, le=100_000)]
NotNegative = Annotated[float, Field(ge=0)]
RESERVED = ("warm-up",)
"""Names of logs that are no run of the fit."""


@dataclass(frozen=True, slots=True)
class Command:
    """A program of the cell's own.

    Attributes:
        arguments: program and arguments; no shell reads them.
        timeout_s: after which it is ended and has failed [s].
    """

    arguments: tuple[str, ...]
    timeout_s: float


@dataclass(frozen=True, slots=True)
class InterlockFile:
    """A file that a safety controller's gateway renews while the cell is closed.

    Attributes:
        path: of it, absolute.
        says: its first line while the robot may move.
        max_age_s: an older one releases nothing [s].
    """

    path: Path
    says: str
    max_age_s: float


@dataclass(frozen=True, slots=True)
class Interlock:
    """Who is asked whether the cell is closed, in automatic mode and empty; one of the two, or both must say yes."""

    command: Command | None
    file: InterlockFile | None


@dataclass(frozen=True, slots=True)
class PlannedRun:
    """One recording of a session.

    Attributes:
        name: of its log.
        payload: what is mounted, None without load.
        mass_kg: the payload's mass as entered for this job, beside that of the cell's payload [kg]; None without load.
        plan_file: approved moves, absolute; None where they are planned from a seed.
        seed, duration_s: of the moves that are planned [s].
        holdout: the fit does not see it.
    """

    name: str
    payload: str | None
    mass_kg: float | None
    plan_file: Path | None
    seed: int
    duration_s: float
    holdout: bool


@dataclass(frozen=True, slots=True)
class Recalibration:
    """A scheduled recalibration.

    Attributes:
        folder: where its sessions are, each with logs, state and report; absolute.
        runs: in the order of their recording.
        interlock: asked before each of them.
        mount: called before each of them with the payload's name, or "none", as its last argument.
        warm_up_min: moves before the first of them that no log keeps [min].
        every_h: nothing is due while the last good calibration is younger [h].
        max_duration_min: of a whole job [min].
        resume_within_h: age of a session that is still taken up [h].
        retries: of a run that its recorder does not stand for.
        min_free_mb: room on the disk of the folder before anything begins [MB].
        keep_sessions: ended ones whose logs stay.
        seed: of the significance test.
        metrics: folder for Prometheus' textfile collector, None where nobody collects.
        working_folder: where commands run: that of the cell file.
    """

    folder: Path
    runs: tuple[PlannedRun, ...]
    interlock: Interlock
    mount: Command
    warm_up_min: float
    every_h: float
    max_duration_min: float
    resume_within_h: float
    retries: int
    min_free_mb: float
    keep_sessions: int
    seed: int
    metrics: Path | None
    working_folder: Path


class CommandModel(StrictModel):
    """`mount`."""

    command: Annotated[tuple[Argument, ...], Field(min_length=1, max_length=100)]
    timeout_s: Seconds = 900.0


class InterlockModel(StrictModel):
    """`interlock`."""

    command: Annotated[tuple[Argument, ...], Field(min_length=1, max_length=100)] | None = None
    timeout_s: Seconds = 10.0
    file: FileName | None = None
    says: Annotated[str, Field(min_length=1, max_length=200)] = "closed"
    max_age_s: Seconds = 10.0

    @model_validator(mode="after")
    def _asked(self) -> InterlockModel:
        if self.command is None and self.file is None:
            raise ValueError("a command, a file, or both: no job moves a robot unasked")
        return self

    def interlock(self, folder: Path) -> Interlock:
        """With absolute paths."""
        return Interlock(
            None if self.command is None else Command(self.command, self.timeout_s),
            None if self.file is None else InterlockFile((folder / self.file).resolve(), self.says, self.max_age_s),
        )


class SeededPlanModel(StrictModel):
    """`plan` of a run: moves made anew from a seed."""

    seed: Annotated[int, Field(ge=0)]
    duration_s: Annotated[float, Field(ge=5, le=3600)] = 40.0


class RunModel(StrictModel):
    """One of `runs`."""

    name: RunName
    payload: Annotated[str, Field(min_length=1)] | None = None
    mass_kg: Annotated[float, Field(gt=0)] | None = None
    plan: SeededPlanModel | None = None
    plan_file: FileName | None = None
    holdout: bool = False

    @model_validator(mode="after")
    def _whole(self) -> RunModel:
        if self.name in RESERVED:
            raise ValueError(f"another name than {self.name}")
        if (self.payload is None) != (self.mass_kg is None):
            raise ValueError("payload and its mass_kg, as weighed for this job, or neither of the two")
        if (self.plan is None) == (self.plan_file is None):
            raise ValueError("plan: {seed, duration_s}, or plan_file with approved moves")
        return self

    def run(self, folder: Path) -> PlannedRun:
        """With absolute paths."""
        plan = self.plan or SeededPlanModel(seed=0)
        file = None if self.plan_file is None else (folder / self.plan_file).resolve()
        return PlannedRun(self.name, self.payload, self.mass_kg, file, plan.seed, plan.duration_s, self.holdout)


class RecalibrationModel(StrictModel):
    """`recalibration`; paths are relative to the cell file (docs/how-to/schedule-recalibration.md has an example)."""

    folder: FileName | None = None
    runs: Annotated[tuple[RunModel, ...], Field(min_length=3, max_length=100)]
    interlock: InterlockModel
    mount: CommandModel
    warm_up_min: Annotated[float, Field(ge=0, le=240)] = 10.0
    every_h: Hours = 144.0
    max_duration_min: Annotated[float, Field(gt=0, le=24 * 60)] = 120.0
    resume_within_h: Hours = 12.0
    retries: Annotated[int, Field(ge=0, le=5)] = 1
    min_free_mb: NotNegative = 1000.0
    keep_sessions: Annotated[int, Field(ge=1)] = 20
    seed: Annotated[int, Field(ge=0)] = 0
    metrics: FileName | None = None

    @model_validator(mode="after")
    def _fits(self) -> RecalibrationModel:
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
        """With absolute paths."""
        folder = cell_file.parent
        return Recalibration(
            # Of the cell file's name, as its history: two cells in one folder have sessions of their own.
            folder=(folder / (self.folder or f"{cell_file.stem}.recalibration")).resolve(),
            runs=tuple(run.run(folder) for run in self.runs),
            interlock=self.interlock.interlock(folder),
            mount=Command(self.mount.command, self.mount.timeout_s),
            warm_up_min=self.warm_up_min,
            every_h=self.every_h,
            max_duration_min=self.max_duration_min,
            resume_within_h=self.resume_within_h,
            retries=self.retries,
            min_free_mb=self.min_free_mb,
            keep_sessions=self.keep_sessions,
            seed=self.seed,
            metrics=None if self.metrics is None else (folder / self.metrics).resolve(),
            working_folder=folder.resolve(),
        )
