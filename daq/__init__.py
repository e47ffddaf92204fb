"""Calibrate the drive gains of a robot cell:
from recorded logs to the current gains of its controller.

Everything that a program needs is here; importing `daq` loads no module before a name is used::

    import daq

    cell = daq.load_cell(Path("cells/press.yaml"))
    logs = [Path("bare.mcap"), Path("loaded.mcap")]
    calibration = daq.fit_logs(logs, holdout=[Path("held-out.mcap")])
    for gain in calibration.gains:
        print(f"{gain.axis}: {gain.value:.2f} ± {gain.std:.2f} {gain.unit}")
    daq.save_calibration(calibration, Path("calibration.yaml"))
    proposal = daq.propose(daq.FileTarget.of(cell), daq.Request(calibration, now=datetime.now(UTC)))
    if not proposal.refusals:
        daq.apply(proposal, datetime.now(UTC), audit=cell.history.audit, who="Ada")

==================================  ==============================================================================
describe a cell                     `load_cell`, `Cell`
read a log                          `read_log` (raw counts), `load_run` (SI units); `Log`, `LossyLogs`
logs to a `Calibration`              `fit_logs`; in steps: `fit`, `close_loop`, `calibration_of`, `Fit`
keep a calibration                  `save_calibration`, `load_calibration`
test it on other logs               `validate`, `Validation`
where the gains are written         `FileTarget`, `ControllerFormat`, `DriveTarget`
write them, and undo it             `Request`, `propose`, `Proposal`, `apply`, `Written`, `rollback`
errors                              `DaqError` and its subclasses (daq/errors.py)
==================================  ==============================================================================

Logs carry the description of their cell, so a fit needs no other file. Nothing is written unless
every check of a proposal passes. The science is in `ident`, the bus in `drivers`; their
errors (`ident.IdentificationError`, `drivers.DriverError`) pass through.
"""  # noqa: E501

from __future__ import annotations

from typing import TYPE_CHECKING

from lazy_names import lazy_names

if TYPE_CHECKING:  # the names of a module stand together
    # ruff: noqa: I001
    from daq.config.cell import Cell as Cell
    from daq.config.cell_file import load_cell as load_cell
    from daq.config.controller import ControllerFormat as ControllerFormat
    from daq.documents.calibration_file import (
        load_calibration as load_calibration,
        save_calibration as save_calibration,
    )
    from daq.errors import (
        CalibrationRefused as CalibrationRefused,
        ConfigurationError as ConfigurationError,
        ControllerChanged as ControllerChanged,
        ControllerUnfit as ControllerUnfit,
        DaqError as DaqError,
        DataError as DataError,
        ExitCode as ExitCode,
        LogUnreadable as LogUnreadable,
        OutputFailed as OutputFailed,
        UsageError as UsageError,
    )
    from daq.log.conversion import load_run as load_run
    from daq.log.reader import (
        Log as Log,
        LossyLogs as LossyLogs,
        read_log as read_log,
    )
    from daq.workflow.fit import (
        Fit as Fit,
        calibration_of as calibration_of,
        close_loop as close_loop,
        fit as fit,
        fit_logs as fit_logs,
    )
    from daq.workflow.validate import (
        Validation as Validation,
        validate as validate,
    )
    from daq.writeback.drive_target import DriveTarget as DriveTarget
    from daq.writeback.file_target import FileTarget as FileTarget
    from daq.writeback.request import Request as Request
    from daq.writeback.target import (
        Proposal as Proposal,
        Written as Written,
        apply as apply,
        propose as propose,
        rollback as rollback,
    )
    from ident.calibration import Calibration as Calibration

    __all__: list[str]
else:
    __getattr__, __dir__ = lazy_names(__name__)
