"""Who acts in a session: mounts payloads, answers for motion, approves a write.

A person, or the policy of the cell.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from daq.config.cell import Cell
from daq.config.policy import AppliedBy, Permission
from daq.config.recalibration import PlannedRun, Recalibration
from daq.errors import JobHeld
from daq.workflow.interlock import Runner
from daq.writeback.target import Proposal

NOTHING = "none"  #: Argument of the mount command for a run without load


class Operator(Protocol):
    """Answers what a session cannot decide itself."""

    @property
    def who(self) -> str:
        """Name in logs, audit log and history."""

    @property
    def unguarded(self) -> bool:
        """Whether axes may move that go on moving when this program is killed."""

    def mount(self, run: PlannedRun) -> None:
        """Mount what a run carries; before every run, also where nothing changes.

        Raises:
            JobHeld: it is not mounted.
        """

    def weigh(self, payload: str) -> float:
        """Return the mass of a payload as read from the scale [kg].

        Raises:
            JobHeld: it was not weighed.
        """

    def permit_motion(self, run: PlannedRun) -> str:
        """Return who permits the motion of a run, in words for its log.

        Raises:
            MotionRefused: motion is not permitted.
        """

    def record_again(self, run: PlannedRun, blocks: Sequence[str], mistake: str) -> bool:
        """Decide whether blocks are recorded again because of a mistake that the last one shows;
        else they stay.

        Args:
            run: the last block.
            blocks: names of those to record again.
            mistake: what was found and what to do.
        """

    def approve(self, proposal: Proposal[Any], *, touched: bool) -> bool:
        """Decide whether a change that passed all gates is written.

        Args:
            proposal: the change.
            touched: the controller's file was written or rolled back since the session began.
        """


@dataclass(frozen=True, slots=True)
class CellPolicy:
    """The cell file answers: its mount command mounts, its policy permits and approves."""

    cell: Cell
    section: Recalibration
    who: str
    run: Runner  #: runs the mount command

    @property
    def unguarded(self) -> bool:
        """Whether `policy` allows unguarded axes."""
        return self.cell.unguarded is Permission.ALLOWED

    @property
    def writes(self) -> bool:
        """Whether the job may write gains; else it only proposes them."""
        is_of_job = self.cell.apply.by is AppliedBy.JOB
        has_drives = self.cell.controller is not None and bool(self.cell.controller.objects)
        return is_of_job and not has_drives

    def mount(self, run: PlannedRun) -> None:
        """Run the mount command with the payload's name.

        Raises:
            JobHeld: it did not end with 0, in its time.
        """
        wanted = run.payload or NOTHING
        ended = self.run(self.section.mount, (wanted,), self.section.working_folder)
        if ended.code != 0:
            raise JobHeld(
                f"mount command {self.section.mount.command[0]} {wanted}",
                found=str(ended),
                expected="exit code 0: it is mounted as the run needs it",
                remedy=f"mount {wanted} by hand or see to the changer; the next job goes on with "
                f"run {run.name}",
            )

    def weigh(self, payload: str) -> float:
        """Return the mass that was weighed for this job, from the cell file [kg]."""
        for run in self.section.runs:
            if run.payload == payload and run.mass_kg is not None:
                return run.mass_kg
        raise JobHeld(
            f"payload {payload}",
            found="no run of `recalibration` that carries it",
            expected="its mass_kg, as weighed for the job",
            remedy="add it to the runs of the cell file",
        )

    def permit_motion(self, run: PlannedRun) -> str:
        """Name policy and interlock; `section_of` has refused a cell without this permission."""
        return f"the policy of cell {self.cell.name} and its interlock, for {self.who}"

    def record_again(self, run: PlannedRun, blocks: Sequence[str], mistake: str) -> bool:
        """Yes: the mount command is asked once more."""
        return True

    def approve(self, proposal: Proposal[Any], *, touched: bool) -> bool:
        """Whether `policy: {apply: {by: job}}` lets the job write;
        what an operator changed since is left to one.
        """
        return self.writes and not touched


@dataclass(frozen=True, slots=True)
class GivenAnswers:
    """Answers that were given beforehand:
    for a demonstration, and for a simulated cell without a person.
    """

    who: str
    masses_kg: Mapping[str, float]  #: of each payload
    put: Callable[[str | None], None]  #: mounts a payload by its name, None for nothing
    granted_by: str  #: who permits the motion, in words for the logs
    writes: bool = True  #: whether a change that passed all gates is written
    unguarded: bool = False

    def mount(self, run: PlannedRun) -> None:
        """Mount what the run carries."""
        self.put(run.payload)

    def weigh(self, payload: str) -> float:
        """Return the given mass [kg]."""
        return self.masses_kg[payload]

    def permit_motion(self, run: PlannedRun) -> str:
        """Return who permitted it beforehand."""
        return self.granted_by

    def record_again(self, run: PlannedRun, blocks: Sequence[str], mistake: str) -> bool:
        """Yes: what it carries is mounted once more."""
        return True

    def approve(self, proposal: Proposal[Any], *, touched: bool) -> bool:
        """Approve what was approved beforehand, unless the file was changed since."""
        return self.writes and not touched
