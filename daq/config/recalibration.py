"""`recalibration` of a cell file: the steps of a scheduled recalibration, and its limits."""

from __future__ import annotations

import os
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator

from daq.config.policy import policy_judged
from daq.config.yaml_file import FilePath

Argument = Annotated[str, Field(max_length=4000, pattern=r"^[^\x00]+$")]
Arguments = Annotated[tuple[Argument, ...], Field(min_length=1, max_length=100)]
RunName = Annotated[str, Field(max_length=40, pattern=r"^[a-z0-9][a-z0-9_-]*$")]
Seconds = Annotated[float, Field(gt=0, le=24 * 3600)]
Hours = Annotated[float, Field(ge=0, le=100_000)]
RESERVED = ("warm-up",)  #: Names of logs that are not runs of the fit


@dataclass(frozen=True, slots=True)
class Command:
    """A program of the cell."""

    command: Arguments  #: program and arguments; no shell is involved
    timeout_s: Seconds = 900.0  #: time after which the program is killed and counts as failed [s]


@dataclass(frozen=True, slots=True, kw_only=True)
class Interlock:
    """Sources that confirm that the cell is closed, empty and in automatic mode.

    If both are given, both must agree.
    """

    #: program of the safety controller's gateway, with its arguments
    command: Arguments | None = None
    timeout_s: Seconds = 10.0  #: time after which the program is killed and counts as failed [s]
    file: FilePath | None = None  #: file that the gateway renews while the cell is closed
    #: its first line while the robot may move
    says: Annotated[str, Field(min_length=1, max_length=200)] = "closed"
    max_age_s: Seconds = 10.0  #: an older file releases nothing [s]

    @model_validator(mode="after")
    def _check_sources(self) -> Interlock:
        if self.command is None and self.file is None:
            raise ValueError("a command, a file, or both: no job moves a robot unasked")
        return self


@dataclass(frozen=True, slots=True)
class SeededPlan:
    """`plan` of a run: moves planned from a seed."""

    seed: Annotated[int, Field(ge=0)]  #: another seed gives other moves
    duration_s: Annotated[float, Field(ge=5, le=3600)] = 40.0  #: of the run [s]


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedRun:
    """One recording of a session."""

    name: RunName  #: name of its log
    #: mounted payload, None without load
    payload: Annotated[str, Field(min_length=1)] | None = None
    #: Mass of the payload as weighed for this job, besides that in `payloads` [kg]; None without
    #: load.
    mass_kg: Annotated[float, Field(gt=0)] | None = None
    plan: SeededPlan | None = None  #: moves planned from a seed
    plan_file: FilePath | None = None  #: approved moves instead
    holdout: bool = False  #: the run is held out of the fit

    @model_validator(mode="after")
    def _check_plan_and_payload(self) -> PlannedRun:
        if self.name in RESERVED:
            raise ValueError(f"another name than {self.name}")
        if (self.payload is None) != (self.mass_kg is None):
            raise ValueError(
                "payload and its mass_kg, as weighed for this job, or neither of the two"
            )
        if (self.plan is None) == (self.plan_file is None):
            raise ValueError("plan: {seed, duration_s}, or plan_file with approved moves")
        return self


@dataclass(frozen=True, slots=True, kw_only=True)
class RecalibrationSection:
    """`recalibration`; docs/how-to/schedule-recalibration.md has an example."""

    #: in the order of their recording
    runs: Annotated[tuple[PlannedRun, ...], Field(min_length=3, max_length=100)]
    interlock: Interlock  #: checked before each run
    mount: Command  #: called before each run with the payload's name, or "none", as last argument
    #: Duration of the moves before the first run, which are not logged [min].
    warm_up_min: Annotated[float, Field(ge=0, le=240)] = 10.0
    every_h: Hours = 144.0  #: nothing is due while the last good calibration is younger [h]
    #: longest duration of a job [min]
    max_duration_min: Annotated[float, Field(gt=0, le=24 * 60)] = 120.0
    resume_within_h: Hours = 12.0  #: largest age of a session that is resumed [h]
    #: further attempts of a run that its recorder marked invalid
    retries: Annotated[int, Field(ge=0, le=5)] = 1
    #: free space on the disk required at the start [MB]
    min_free_mb: Annotated[float, Field(ge=0)] = 1000.0
    keep_sessions: Annotated[int, Field(ge=1)] = 20  #: number of ended sessions whose logs are kept
    seed: Annotated[int, Field(ge=0)] = 0  #: seed of the significance test
    metrics: FilePath | None = None  #: folder of Prometheus' textfile collector, None without one
    #: parent of its sessions; None for the one named after the cell file
    folder: FilePath | None = None

    @model_validator(mode="after")
    def _check_runs(self) -> RecalibrationSection:
        names = [run.name for run in self.runs]
        if len(set(names)) < len(names):
            raise ValueError("runs with names of their own")
        fitted = {run.payload is None for run in self.runs if not run.holdout}
        if fitted != {True, False}:
            raise ValueError(
                "at least one run without and one with a payload that the fit sees (no holdout)"
            )
        if not any(run.holdout for run in self.runs):
            raise ValueError("at least one run with holdout: true, by which the result is judged")
        return self

    def recalibration(self, cell_file: Path) -> Recalibration:
        """Add the folders that follow from the cell file's own."""
        # Named after the cell file, as its history: two cells in one folder have separate sessions.
        named = cell_file.with_suffix(".recalibration")
        keys = {key.name: getattr(self, key.name) for key in fields(RecalibrationSection)}
        keys["folder"] = self.folder or policy_judged(cell_file, "recalibration.folder", named)
        return Recalibration(**keys, working_folder=Path(os.path.realpath(cell_file.parent)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Recalibration(RecalibrationSection):
    """A scheduled recalibration."""

    folder: Path  #: parent of its sessions, each with logs, state and report; absolute
    working_folder: Path  #: folder in which commands run: that of the cell file
