"""From logs to a calibration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.configuration.cell import Cell
from daq.configuration.cell_model import model_of
from daq.conversion import load_run
from daq.errors import LogRepeated, LogsDiffer, RolesExchanged
from daq.version import software
from ident.calibration import AcceptedEffect, Calibration, Gain, Parameter, Source
from ident.estimate import Estimate, Method
from ident.estimators.total_least_squares import tls
from ident.identify import Identification, Step, close_the_loop, identify
from ident.relative_error import RelativeError
from ident.run import Run


@dataclass(frozen=True, slots=True)
class Fit:
    """An identification with the cell and the runs it speaks of.

    Attributes:
        cell: as the logs describe it.
        runs, holdout: what was fitted, and what was not.
        identification: the estimate without effects.
        steps: turns of the loop, empty where nobody looked for effects.
        paper: the paper's total least squares on the same rows, None with fixed gains.
    """

    cell: Cell
    runs: tuple[Run, ...]
    holdout: tuple[Run, ...]
    identification: Identification
    steps: tuple[Step, ...]
    paper: Estimate | None

    @property
    def final(self) -> Identification:
        """With all accepted effects."""
        return self.steps[-1].after if self.steps else self.identification


def load_runs(logs: Sequence[Path], cell: Cell | None = None) -> tuple[tuple[Run, ...], Cell]:
    """Read logs of one cell.

    Args:
        logs: at least one.
        cell: another description of the cell than the one that the logs carry.

    Raises:
        DataError, ConfigurationError: a log cannot be used.
        LogsDiffer: they do not carry the same cell configuration.
    """
    loaded = [load_run(log, cell) for log in logs]
    first = loaded[0][1]
    for log, (_, other) in zip(logs, loaded, strict=True):
        if other.digest != first.digest:
            raise LogsDiffer(
                str(log),
                found=f"cell {other.name!r}, configuration {other.digest[:12]}",
                expected=f"cell {first.name!r}, configuration {first.digest[:12]}, as in {logs[0]}",
                remedy="fit logs of one cell and one configuration, or name the right one with --cell",
            )
    return tuple(run for run, _ in loaded), first


def fit(
    logs: Sequence[Path],
    *,
    holdout: Sequence[Path] = (),
    method: Method | None = None,
    gains_fixed: bool = False,
    cell: Cell | None = None,
) -> Fit:
    """Identify gains and parameters.

    Args:
        logs: without load and with a weighed payload; any, where the gains are fixed.
        holdout: logs that the fit must not see.
        method: estimator; ``ml``, or with fixed gains the classical IDIM-WLS, when None.
        gains_fixed: hold the gains at their nameplate values.
        cell: another description of the cell than the one in the logs.

    Raises:
        DataError, ConfigurationError, IdentificationError: see daq/errors.py and ident/errors.py.
    """
    runs, declared = load_runs((*logs, *holdout), cell)
    _check_distinct((*logs, *holdout), runs)
    used, rest = runs[: len(logs)], runs[len(logs) :]
    nameplate = np.array([axis.nameplate_gain for axis in declared.axes])
    chosen = method or (Method.WLS if gains_fixed else Method.ML)
    result = identify(
        model_of(declared),
        used,
        declared.conditioning,
        holdout=rest,
        method=chosen,
        fixed_gains=nameplate if gains_fixed else None,
    )
    if not gains_fixed:
        check_signs(result.estimate, nameplate)
    paper = None if gains_fixed else tls(result.training)
    return Fit(declared, used, rest, result, (), paper)


def _check_distinct(logs: Sequence[Path], runs: tuple[Run, ...]) -> None:
    """A log given twice would count twice, and a held-out one would be held out of nothing."""
    seen: dict[str, Path] = {}
    for log, run in zip(logs, runs, strict=True):
        if run.digest in seen:
            raise LogRepeated(
                str(log),
                found=f"the same recording as {seen[run.digest]}",
                expected="every recording once, in the fit or held out",
                remedy="name other logs",
            )
        seen[run.digest] = log


def check_signs(estimate: Estimate, nameplate: NDArray[np.float64]) -> None:
    """The payload's weight sets the sign of all gains together: taken from the wrong runs it turns them all."""
    if np.all(np.sign(estimate.gains) == -np.sign(nameplate)):
        raise RolesExchanged(
            "all drive gains",
            found=", ".join(f"{gain:.3g}" for gain in estimate.gains),
            expected="the signs of the nameplate: " + ", ".join(f"{gain:.3g}" for gain in nameplate),
            remedy="were the payload's run and the run without load exchanged? look at `drivegain info` of each log",
        )


def close_loop(start: Fit, seed: int, progress: Callable[[str], None] = lambda _: None) -> Fit:
    """Look for effects that the model lacks, and refit with those that pass.

    Args:
        start: of method ``ml``; another one is refitted by it, because candidates are judged in its terms.
        seed: of the bootstrap.
        progress: told what is being done.

    Raises:
        IdentificationError: a refit failed.
    """
    identification = start.identification
    if identification.estimate.method is not Method.ML:
        fixed = identification.estimate.gains if identification.estimate.gains_fixed else None
        identification = identify(
            identification.model,
            start.runs,
            start.cell.conditioning,
            holdout=start.holdout,
            method=Method.ML,
            fixed_gains=fixed,
        )
    steps = close_the_loop(identification, np.random.default_rng(seed), progress=progress)
    return replace(start, identification=identification, steps=steps)


def calibration_of(fitted: Fit, created: datetime) -> Calibration:
    """The calibration that a fit amounts to.

    Args:
        fitted: with or without effects.
        created: when, with its time zone.
    """
    final = fitted.final
    estimate = final.estimate
    gains = tuple(
        Gain(axis.name, float(value), float(std), axis.gain_unit, axis.nameplate_gain)
        for axis, value, std in zip(fitted.cell.axes, estimate.gains, estimate.gains_std, strict=True)
    )
    parameters = tuple(
        Parameter(column.name, float(value), float(std), column.unit)
        for column, value, std in zip(estimate.unknowns, estimate.parameters, estimate.parameters_std, strict=True)
    )
    return Calibration(
        cell=fitted.cell.name,
        method=estimate.method.value,
        gains=gains,
        parameters=parameters,
        effects=_effects(fitted, parameters),
        relative_error_percent=final.training_error,
        holdout_error_percent=final.holdout_error,
        condition=estimate.condition,
        rows=estimate.rows,
        filter=final.training.conditioning.document(),
        sources=tuple(
            Source(run.name, run.digest, role)
            for runs, role in ((fitted.runs, "fit"), (fitted.holdout, "holdout"))
            for run in runs
        ),
        configuration_sha256=fitted.cell.digest,
        created=created.isoformat(timespec="seconds"),
        software=software(),
    )


def _effects(fitted: Fit, parameters: tuple[Parameter, ...]) -> tuple[AcceptedEffect, ...]:
    accepted = []
    before = fitted.identification
    for step in fitted.steps:
        if step.accepted is None:
            continue
        placed = step.after.effects[-1]
        names = {column.name for column in placed.columns}
        error_before, error_after = _axis_error(before, placed.axis), _axis_error(step.after, placed.axis)
        accepted.append(
            AcceptedEffect(
                name=placed.effect.name,
                axis=fitted.cell.axes[placed.axis].name,
                settings={name: float(value) for name, value in placed.effect.settings.items()},
                coefficients=tuple(parameter for parameter in parameters if parameter.name in names),
                # Without a run that was held out, the moves that were left out in turn must do.
                error_before_percent=step.accepted.error_before_percent if error_before is None else error_before,
                error_after_percent=step.accepted.error_after_percent if error_after is None else error_after,
                ambiguity=step.accepted.ambiguity,
            )
        )
        before = step.after
    return tuple(accepted)


def _axis_error(identification: Identification, axis: int) -> float | None:
    error: RelativeError | None = identification.holdout_error
    return None if error is None else error.axes[axis]
