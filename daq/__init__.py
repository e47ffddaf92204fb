"""Calibrate the drive gains of a robot cell: from recorded logs to the numbers in the controller.

Everything that a program needs is here; importing `daq` loads no module before a name is used::

    import daq

    cell = daq.load_cell(Path("cells/press.yaml"))
    calibration = daq.fit_logs([Path("bare.mcap"), Path("loaded.mcap")], holdout=[Path("held-out.mcap")])
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

Logs carry the description of their cell, so a fit needs no other file. Nothing is written unless every check of a
proposal passes. The science behind is in `ident`, the bus in `drivers`; their errors (`ident.IdentificationError`,
`drivers.DriverError`) pass through.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from daq.config.cell import Cell
    from daq.config.cell_file import load_cell
    from daq.config.controller import ControllerFormat
    from daq.errors import (
        CalibrationRefused,
        ConfigurationError,
        ControllerChanged,
        ControllerUnfit,
        DaqError,
        DataError,
        ExitCode,
        LogUnreadable,
        OutputFailed,
        UsageError,
    )
    from daq.log.conversion import load_run
    from daq.log.reader import Log, LossyLogs, read_log
    from daq.workflow.calibration_file import load as load_calibration
    from daq.workflow.calibration_file import save as save_calibration
    from daq.workflow.fit import Fit, calibration_of, close_loop, fit, fit_logs
    from daq.workflow.validate import Validation, validate
    from daq.writeback.drive_target import DriveTarget
    from daq.writeback.file_target import FileTarget
    from daq.writeback.request import Request
    from daq.writeback.target import Proposal, Written, apply, propose, rollback
    from ident.calibration import Calibration

__all__ = [
    "Calibration",
    "CalibrationRefused",
    "Cell",
    "ConfigurationError",
    "ControllerChanged",
    "ControllerFormat",
    "ControllerUnfit",
    "DaqError",
    "DataError",
    "DriveTarget",
    "ExitCode",
    "FileTarget",
    "Fit",
    "Log",
    "LogUnreadable",
    "LossyLogs",
    "OutputFailed",
    "Proposal",
    "Request",
    "UsageError",
    "Validation",
    "Written",
    "apply",
    "calibration_of",
    "close_loop",
    "fit",
    "fit_logs",
    "load_calibration",
    "load_cell",
    "load_run",
    "propose",
    "read_log",
    "rollback",
    "save_calibration",
    "validate",
]

_HOMES = {
    "daq.config.cell": ("Cell",),
    "daq.config.cell_file": ("load_cell",),
    "daq.config.controller": ("ControllerFormat",),
    "daq.log.conversion": ("load_run",),
    "daq.log.reader": ("Log", "LossyLogs", "read_log"),
    "daq.workflow.calibration_file": ("load_calibration", "save_calibration"),
    "daq.workflow.fit": ("Fit", "calibration_of", "close_loop", "fit", "fit_logs"),
    "daq.workflow.validate": ("Validation", "validate"),
    "daq.writeback.drive_target": ("DriveTarget",),
    "daq.writeback.file_target": ("FileTarget",),
    "daq.writeback.request": ("Request",),
    "daq.writeback.target": ("Proposal", "Written", "apply", "propose", "rollback"),
    "ident.calibration": ("Calibration",),
}
_MODULES = {name: home for home, names in _HOMES.items() for name in names}
_RENAMED = {"load_calibration": "load", "save_calibration": "save"}


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it exports {', '.join(__all__)}")
    module = import_module(_MODULES.get(name, "daq.errors"))
    value = globals()[name] = getattr(module, _RENAMED.get(name, name))
    return value


def __dir__() -> list[str]:
    return __all__
