"""A fit that grows with a recording: new pieces are folded in, and the gains are there at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from ident.arrays import require_entries, require_kind
from ident.data.conditioning import Conditioning, require_cutoffs, require_settings
from ident.data.run import Run, require_named
from ident.equations.joined import join_systems
from ident.equations.reduction import reduce_built, regrouped
from ident.equations.system import System
from ident.equations.unfinished_run import RunProgress, new_rows
from ident.errors import DataUnfit
from ident.estimators.quick import QuickGains, Unknown, quick_gains
from ident.model.bodies import Payload
from ident.model.model import Model


@dataclass(frozen=True, slots=True)
class GrowingFit:
    """Triangles of everything recorded so far. Samples are not kept.

    Begin with ``GrowingFit(model, conditioning, payloads)``. Effects that a cell declares are not
    in the model of this fit, and nothing of it is diagnosed: it is for a look while a cell is
    recorded.
    """

    model: Model  #: the declared model
    conditioning: Conditioning  #: the filters
    payloads: tuple[Payload, ...]  #: all that will be mounted
    #: the equations so far, in the standard parameters; None before the first row
    standard: System | None = None
    runs: tuple[RunProgress, ...] = ()  #: in the order in which they began

    def with_run(self, run: Run) -> GrowingFit:
        """Fold in a run to its end: all of it, or what `with_run_so_far` has left of it.

        Args:
            run: all its samples.

        Raises:
            ModelError: the fit was begun with an argument of another type, or the run is none.
            DataUnfit: see `ident.data.dataset.differentiate`; or it is in the fit already, or
                carries a payload that is not among ``payloads``.
        """
        return self._folded(run, is_complete=True)

    def with_run_so_far(self, run: Run) -> GrowingFit:
        """Fold in what is new of a run that still goes on.

        The newest fifth of a second waits for the samples that follow
        (`ident.equations.unfinished_run`).

        Args:
            run: its samples so far, from the first one on.

        Raises:
            ModelError, DataUnfit: as for `with_run`.
        """
        return self._folded(run, is_complete=False)

    def _folded(self, run: Run, *, is_complete: bool) -> GrowingFit:
        self._require_begun()
        require_kind("run", run, Run, "write Run(name, time_s, position_rad, current_a)")
        require_named(run)
        before = self._before(run)
        found = new_rows(self.model, run, self.conditioning, before, is_complete=is_complete)
        standard = self.standard
        if found.built is not None:
            new = reduce_built(self.model, [found.built], payloads=self.payloads)
            if standard is not None:
                new = join_systems(standard, new, continues_move=found.continues_move)
            standard = new
        others = tuple(other for other in self.runs if other.name != run.name)
        return replace(self, standard=standard, runs=(*others, found.progress))

    def _require_begun(self) -> None:
        """Refuse a fit that was begun with something of another type, as a `ModelError`."""
        require_kind("model", self.model, Model, "write Model(robot, drive_train)")
        require_kind("conditioning", self.conditioning, Conditioning, "write Conditioning()")
        require_settings(self.conditioning)
        require_cutoffs(self.conditioning)
        remedy = "give a tuple of the payloads that will be mounted"
        require_kind("payloads", self.payloads, Sequence, remedy)
        require_entries("payloads", self.payloads, Payload, remedy)
        remedy = "leave it out: a fit has its own"
        if self.standard is not None:
            require_kind("standard", self.standard, System, remedy)
        require_kind("runs", self.runs, tuple, remedy)
        require_entries("runs", self.runs, RunProgress, remedy)

    def _before(self, run: Run) -> RunProgress | None:
        """Return how far a run is folded in, None for a new one; refuse one that may not be."""
        if run.payload is not None and run.payload not in self.payloads:
            mountings = ", ".join(repr(payload.mounting) for payload in self.payloads) or "none"
            raise DataUnfit(
                run.name,
                f"found payload {run.payload}; expected one of those that this fit was begun with "
                f"(mountings: {mountings}); name all payloads when it begins",
            )
        for other in self.runs:
            if other.name == run.name:
                if other.is_complete:
                    raise DataUnfit(
                        run.name,
                        "found it in this fit already; expected each run once: name runs apart",
                    )
                return other
        return None

    @property
    def move_count(self) -> int:
        """Number of moves that can be left out for σ; one above two seconds counts as several."""
        if self.standard is None:
            return 0
        return len(self.standard.clusters)

    def gains(self) -> QuickGains:
        """Estimate the gains by linear algebra alone, or say why they are not known yet."""
        if self.standard is None:
            return QuickGains(None, None, Unknown.NO_MOTION)
        return quick_gains(self.standard)

    def system(self) -> System:
        """Return the equations so far in base parameters, for `maximum_likelihood.ml`.

        Raises:
            DataUnfit: a joint has not moved yet.
        """
        if self.standard is None:
            raise DataUnfit("", "nothing has moved so far; expected rows of every joint")
        return regrouped(self.standard)
