"""The document of each verb under `--json`, for the published schemas
(docs/reference/schemas.md).
"""

from __future__ import annotations

from typing import Any

from daq.report.bus_views import ErrorCodeReport, MonitorReport, ScanReport
from daq.report.certificate import CertificateReport
from daq.report.fit import CasesReport, FitReport
from daq.report.history import HistoryReport
from daq.report.job_schemas import (
    DemoReport,
    DryRunReport,
    FleetReport,
    JobReport,
    KeyReport,
    RefusedJob,
    SessionReport,
    SignatureReport,
    SignersReport,
)
from daq.report.log import (
    BagReport,
    ImportReport,
    InfoReport,
    RecordReport,
    SalvageReport,
    TableReport,
)
from daq.report.mjcf_views import MjcfReport
from daq.report.plan import PlanReport
from daq.report.proposal import DriveChange, DriveRollback, FileChange, FileRollback
from daq.report.residual_document import ResidualReport
from daq.report.urdf_views import UrdfReport
from daq.report.validation import ResidualTableReport, ValidateReport
from daq.report.weighing_views import ContactReport, WeighReport

REPORTS: dict[str, Any] = {
    "demo": DemoReport,
    "scan": ScanReport,
    "monitor": MonitorReport,
    "explain-emcy": ErrorCodeReport,
    "plan": PlanReport,
    "record": RecordReport,
    "fit": FitReport | CasesReport,
    "residual": ResidualReport,
    "validate": ValidateReport,
    "certificate": CertificateReport,
    "apply": FileChange | DriveChange,
    "rollback": FileRollback | DriveRollback,
    "info": InfoReport,
    "history": HistoryReport,
    "calibrate": SessionReport | RefusedJob,
    "recalibrate": DryRunReport | JobReport | RefusedJob,
    "sign": KeyReport | SignatureReport | SignersReport,
    "fleet": FleetReport,
    "salvage": SalvageReport,
    "import": ImportReport,
    "export": TableReport | ResidualTableReport | BagReport | UrdfReport | MjcfReport,
    "weigh": WeighReport,
    "contact": ContactReport,
}
"""Types of the documents by the verb that prints them."""
