"""Weigh the body on the flange, and find contacts:
a calibration used on logs that it has not seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from daq.config.cell import Cell
from daq.config.same_cell import differing_sections
from daq.errors import ConfigurationError, LogRepeated, LogsDiffer
from daq.log.conversion import load_run
from daq.workflow.experiment import experiment_of, extra_moves
from daq.workflow.validate import (
    Corrections,
    check_cell,
    conditioning_of,
    on_cell,
    unpredictable,
    warn_of_corrections,
    warn_of_fitted,
    warn_without_temperature,
)
from ident.calibration import Calibration
from ident.contact import ExternalTorque, external_torque, prediction_band
from ident.data.run import Run
from ident.prediction import as_calibrated
from ident.weighing import Help, WeighedBody, moves_that_help, weigh


@dataclass(frozen=True, slots=True)
class Weighed:
    """A body weighed from logs."""

    cell: Cell  #: as the first log describes it
    logs: tuple[Path, ...]  #: with the body
    bare: tuple[Path, ...]  #: without load
    body: WeighedBody  #: mass, centre and inertia
    help: tuple[Help, ...]  #: moves for what the logs do not show
    #: mass of the payload that the logs declare; None where they do not, or differ
    declared_kg: float | None
    #: runs that the calibration's fit has seen: their agreement proves nothing
    fitted: tuple[str, ...] = ()


def weigh_logs(
    calibration: Calibration,
    logs: Sequence[Path],
    *,
    bare: Sequence[Path] = (),
    cell: Cell | None = None,
) -> Weighed:
    """Weigh the body that some logs carry.

    Args:
        calibration: of the cell.
        logs: with one body, mounted one way; the payload that they declare is only reported.
        bare: of the same robot without load.
        cell: corrected description of the same cell, which replaces the one in the logs.

    Raises:
        DataError, ConfigurationError: a log cannot be used.
        LogsDiffer: a log is of another cell, one that should be bare declares a payload, or the
            logs with the body declare different ones.
        LogRepeated: a log was given twice: its moves would count twice.
        IdentificationError: see `ident.weigh`.
    """
    reading = _Logs(calibration, cell)
    loaded = [reading.load(log) for log in logs]
    _require_one_body(logs, loaded)
    without = []
    for log in bare:
        run = reading.load(log)
        if run.payload is not None:
            raise LogsDiffer(
                str(log),
                found=f"payload {run.payload.name!r}",
                expected="a run without load",
                remedy="give --bare logs that were recorded without a payload",
            )
        without.append(run)
    for run in (*loaded, *without):
        warn_without_temperature(calibration, run.name, run.temperature_c)
    _require_once((*logs, *bare), (*loaded, *without))
    fitted = warn_of_fitted(
        calibration, loaded, "the agreement proves nothing; weigh a log that the fit has not seen"
    )
    described = reading.described
    warn_of_corrections(calibration, loaded[0].name, described.digest)
    calibration, model = on_cell(calibration, described)
    body = weigh(calibration, model, loaded, conditioning_of(calibration), bare=without)
    help_: tuple[Help, ...] = ()
    if not body.identifiable.all():
        with suppress(ConfigurationError):  # the cell does not say enough to plan moves in it
            help_ = moves_that_help(body, extra_moves(experiment_of(described)))
    masses = {None if run.payload is None else run.payload.known.get("m") for run in loaded}
    declared_kg = masses.pop() if len(masses) == 1 else None
    return Weighed(described, tuple(logs), tuple(bare), body, help_, declared_kg, fitted)


def _require_one_body(logs: Sequence[Path], runs: Sequence[Run]) -> None:
    """Refuse logs that declare different payloads: one body is weighed, mounted one way."""
    declared = [_declared(run) for run in runs]
    for log, text in zip(logs, declared, strict=True):
        if text != declared[0]:
            raise LogsDiffer(
                str(log),
                found=f"{text}, and {declared[0]} in {logs[0]}",
                expected="logs with one body, mounted one way",
                remedy="weigh each body by itself; give logs without load with --bare",
            )


def _declared(run: Run) -> str:
    """Name what a run declares to be mounted."""
    if run.payload is None:
        return "no load"
    return f"payload {run.payload.name!r} in mounting {run.payload.mounting!r}"


def contact_in(
    calibration: Calibration, log: Path, *, quiet: Sequence[Path] = (), cell: Cell | None = None
) -> tuple[ExternalTorque, Cell]:
    """Compute the external torque in a log, with band and thresholds from quiet logs or the log's
    own quiet part.

    Raises:
        DataError, ConfigurationError: a log cannot be used.
        LogsDiffer: a log is of another cell.
        LogRepeated: a log was given twice: a contact in it would count as quiet motion.
        IdentificationError: see `ident.external_torque`.
    """
    conditioning = conditioning_of(calibration)
    reading = _Logs(calibration, cell)
    run = reading.load(log)
    described = reading.described
    warn_of_corrections(calibration, run.name, described.digest)
    calibration, model = on_cell(calibration, described)
    band = None
    if quiet:
        calm = [reading.load(one) for one in quiet]
        _require_once((log, *quiet), (run, *calm))
        warn_of_fitted(
            calibration,
            calm,
            "other motion has larger errors than it, and the threshold is too low",
        )
        known = (
            _predictable(calibration, one, other) for one, other in zip(quiet, calm, strict=True)
        )
        band = prediction_band(calibration, model, known, conditioning)
    return external_torque(
        calibration, model, _predictable(calibration, log, run), conditioning, band
    ), described


def _require_once(logs: Sequence[Path], runs: Sequence[Run]) -> None:
    digests = [run.digest for run in runs]
    for log, digest in zip(logs, digests, strict=True):
        if digests.count(digest) > 1:
            raise LogRepeated(
                str(log),
                found="the same log twice",
                expected="every log once",
                remedy="name other logs",
            )


class _Logs:
    """Logs of the cell of a calibration, all read by one description:
    the model of the first is that of all.
    """

    def __init__(self, calibration: Calibration, given: Cell | None) -> None:
        self._calibration = calibration
        self._given = given
        self._corrections = Corrections()
        self._first: tuple[Path, Cell] | None = None

    @property
    def described(self) -> Cell:
        """The cell as the first log describes it, or as given."""
        assert self._first is not None  # a log was read before
        return self._first[1]

    def load(self, log: Path) -> Run:
        """Read a log.

        Raises:
            DataError, ConfigurationError: it cannot be used.
            LogsDiffer: it is of another cell, or of another description of it than the first log.
        """
        run, described = load_run(log, self._given)
        self._corrections.note(log, run)
        check_cell(self._calibration, log, described)
        if self._first is None:
            self._first = log, described
        first_log, first = self._first
        if described.recording_digest != first.recording_digest:
            sections = ", ".join(differing_sections(first, described)) or "the files of the cell"
            raise LogsDiffer(
                str(log),
                found=f"a description of the cell that differs from that of {first_log} in "
                f"{sections}",
                expected="one description for all logs",
                remedy="give the right one for all of them with --cell, or logs of one description",
            )
        return run


def _predictable(calibration: Calibration, log: Path, run: Run) -> Run:
    reason = unpredictable(calibration, run.payload)
    if reason:
        raise LogsDiffer(
            str(log),
            found=reason,
            expected="no load, or a payload of the calibration",
            remedy="give another log, or a calibration whose fit had this payload",
        )
    warn_without_temperature(calibration, run.name, run.temperature_c)
    return replace(run, payload=as_calibrated(calibration, run.payload, run.name))
