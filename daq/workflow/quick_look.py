"""The gains after each move of a block that is being recorded, by the quick linear estimate.

A look is for the eye, and nothing is decided by it. The quick estimate is honest from half a minute
of motion on (docs/evidence/stopping.md), so there are no figures before.

The quick estimate knows no effects. What the search has found after the last block is noise to it,
and its σ may be several times that of the estimator. So σ is shown in proportion to that of the
last block, and the quick one says how it falls since (`GainsSoFar.in_proportion`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from daq.config.cell import Cell
from daq.log.conversion import answers, limit_active, moves, unwrapped
from daq.log.feed import QuickGain, QuickLook, RunFacts
from daq.workflow.experiment import Experiment, experiment_of
from drivers.messages import CellEvent
from ident.arrays import FloatArray
from ident.data.dataset import differentiate
from ident.data.run import Run
from ident.estimators.growing import GrowingFit
from ident.estimators.quick import QuickGains, Unknown
from ident.model.bodies import Payload
from ident.planning.excitation import Excitation, recorded
from ident.planning.gain_verdict import verdicts
from ident.planning.target import slow_cause, time_to_target

HONEST_S = 30.0  #: Motion before the first figures (docs/evidence/stopping.md)


class RunSoFar:
    """The samples of a run that is being recorded, as the feed brings them."""

    def __init__(self, cell: Cell, facts: RunFacts, name: str) -> None:
        """Store the arguments.

        Args:
            cell: of the run.
            facts: of the run, as the recorder publishes them.
            name: of the run.
        """
        self.is_whole = True  #: no sample is missing in between
        self.finished_moves = 0
        self._cell = cell
        self._facts = facts
        self._name = name
        self._rows: list[NDArray[np.void]] = []
        self._events: list[CellEvent] = []
        self._next_cycle: int | None = None

    def take(self, rows: NDArray[np.void]) -> None:
        """Take samples in the layout of `daq.log.feed.packet_dtype`."""
        first_cycle = int(rows["cycle"][0])
        expected = range(first_cycle, first_cycle + len(rows))
        follows = self._next_cycle in (None, expected.start)
        if not follows or not np.array_equal(rows["cycle"], expected):
            self.is_whole = False
        self._next_cycle = expected.stop
        self._rows.append(rows)

    def take_event(self, event: CellEvent) -> None:
        """Take an event, which may say that a move begins."""
        self._events.append(event)

    @property
    def payload(self) -> Payload | None:
        """What is mounted."""
        for payload in self._cell.payloads:
            if payload.name == self._facts.payload:
                return payload.payload
        return None

    def run(self) -> Run | None:
        """Return all samples so far in SI; None before the first one."""
        if not self._rows:
            return None
        rows = np.concatenate(self._rows)
        self._rows = [rows]
        scale = self._facts.scaling
        answered = answers(rows["missing"], len(self._cell.axes))
        limited = limit_active(self._cell, rows["statusword"])
        cycle = rows["cycle"].astype(np.int64)
        motor_counts = unwrapped(rows["position_counts"])
        return Run(
            name=self._name,
            time_s=(cycle - cycle[0]) / self._facts.rate_hz,
            position_rad=scale.joint_position(motor_counts),
            current_a=rows["current_raw"] * scale.current_per_unit,
            payload=self.payload,
            move=moves(tuple(self._events), rows["time_ns"]),
            valid=answered & ~limited,
        )


@dataclass(frozen=True, slots=True)
class BlockMove:
    """The move of a block after which the gains are looked at."""

    block: str  #: name of the block
    move: int  #: finished moves of it
    moves: int  #: in its plan
    is_held_out: bool = False  #: its moves do not count


@dataclass(frozen=True, slots=True, eq=False)
class GainsSoFar:
    """All blocks so far, folded into triangles, and their motions."""

    experiment: Experiment  #: of the cell with the payload of the session
    target_percent: float  #: σ that every gain shall reach [%]
    fit: GrowingFit  #: of these blocks
    #: Motion of each block with what was mounted.
    motions: tuple[tuple[Excitation, tuple[int | None, ...]], ...] = ()
    motion_s: float = 0.0  #: of these blocks
    loaded_s: float = 0.0  #: of those with the payload
    honest_s: float = HONEST_S  #: motion before the first figures
    #: σ of the estimator over the quick one after the same blocks, shape (n,); None before the
    #: first block was judged.
    scale: FloatArray | None = None

    @classmethod
    def of(cls, cell: Cell, payload: str, target_percent: float) -> GainsSoFar:
        """Return what is known before the first block.

        Args:
            cell: that is recorded.
            payload: name of the body for the loaded blocks.
            target_percent: σ that every gain shall reach [%].
        """
        experiment = experiment_of(cell, payload)
        model = experiment.design.expectation.model
        return cls(
            experiment,
            target_percent,
            GrowingFit(model, cell.conditioning, (experiment.payload.payload,)),
        )

    def with_run(self, run: Run, *, is_complete: bool = True) -> GainsSoFar:
        """Fold in a block; one that is not complete is folded in again and again as it grows,
        into the result.

        Raises:
            DataUnfit: see `GrowingFit.with_run`.
        """
        if is_complete:
            fit = self.fit.with_run(run)
        else:
            fit = self.fit.with_run_so_far(run)
        return replace(self, fit=fit)

    def with_motion(self, run: Run) -> GainsSoFar:
        """Add the motion of a block, which says why a gain takes long.

        Raises:
            DataUnfit: see `ident.data.dataset.differentiate`.
        """
        model = self.fit.model
        data = differentiate(run, model.drive_train, self.fit.conditioning)
        mounted = None if run.payload is None else 0
        motion = recorded(model, data, self.fit.conditioning)
        seconds = float(run.time_s[-1] - run.time_s[0])
        loaded_s = self.loaded_s
        if mounted is not None:
            loaded_s += seconds
        motions = (*self.motions, (motion, (mounted,)))
        motion_s = self.motion_s + seconds
        return replace(self, motions=motions, motion_s=motion_s, loaded_s=loaded_s)

    @property
    def counting_s(self) -> float:
        """Motion as far as it counts for σ [s]: twice that of the mounting with less of it.

        Gains need both mountings. In the first loaded block, σ falls with the motion of that block
        alone, however long the bare ones were.
        """
        bare_s = self.motion_s - self.loaded_s
        return 2.0 * min(bare_s, self.loaded_s)

    def in_proportion(self, std_percent: FloatArray) -> GainsSoFar:
        """Show σ from now on in proportion to that of the estimator after these blocks.

        Args:
            std_percent: σ of each gain by the estimator [% of it], shape (n,).
        """
        quick_percent = self.fit.gains().std_percent
        if quick_percent is None or not np.all(np.isfinite(quick_percent)):
            return self
        return replace(self, scale=std_percent / quick_percent)

    def look(self, place: BlockMove, causes: Mapping[str, str]) -> QuickLook:
        """Estimate the gains, or say what is missing for that.

        Args:
            place: where the recording is.
            causes: why each axis takes long, by the last block; empty where that is not known yet.
        """
        nothing = QuickLook(place.block, place.move, place.moves, self.motion_s, place.is_held_out)
        missing = self._missing()
        if missing:
            return replace(nothing, missing=missing)
        found = self.fit.gains()
        std_percent = found.std_percent
        if found.gains is None or std_percent is None:
            return replace(nothing, missing=self._unknown(found))
        if not np.all(np.isfinite(std_percent)):
            return replace(nothing, missing="a gain does not show against the noise yet")
        if self.scale is not None:
            std_percent = std_percent * self.scale
        target_percent = np.full(len(std_percent), self.target_percent)
        outlook = time_to_target(std_percent, target_percent, self.counting_s)
        worst = self.experiment.cell.axes[outlook.worst].name
        return replace(
            nothing,
            gains=self._gains(found.gains, std_percent),
            why=causes.get(worst) or self._why(outlook.worst),
            left_s=outlook.longest_s,
        )

    def _missing(self) -> str:
        """Say what the blocks lack for figures; empty where they lack nothing."""
        mounted = [payloads for _, payloads in self.motions]
        name = self.experiment.payload.name.upper()
        if (0,) not in mounted:
            return f"the gains need a known mass, and no block with {name} is recorded yet"
        if (None,) not in mounted:
            return f"the gains need a block without {name}, and none is recorded yet"
        if self.motion_s < self.honest_s:
            return f"there are none before {self.honest_s:g} s of motion"
        return ""

    def _unknown(self, found: QuickGains) -> str:
        """Say why nothing fixes the gains yet, with the axes."""
        unknown = found.unknown or Unknown.PAYLOAD_UNSEEN
        names = ", ".join(self.experiment.cell.axis_names[axis] for axis in found.axes)
        if not names:
            return unknown.value
        return f"{names}: {unknown.value}"

    def _gains(self, gains: FloatArray, std_percent: FloatArray) -> list[QuickGain]:
        """Return the gains, the worst first."""
        axes = self.experiment.cell.axes
        found = []
        for axis, value, std in zip(axes, gains.tolist(), std_percent.tolist(), strict=True):
            gain = QuickGain(axis.name, axis.gain_unit, value, std, self.target_percent)
            found.append(gain)
        return sorted(found, key=lambda gain: -gain.ratio)

    def _why(self, axis: int) -> str:
        """Say why the gain of an axis takes long, by the motions so far and a nominal robot."""
        judged = verdicts(self.experiment.design, self.motions)
        return slow_cause(judged.gains[axis], has_payload=True).value
