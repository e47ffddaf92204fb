"""What a write rests on, for the audit: digests of calibration, configuration and logs."""

from __future__ import annotations

from pathlib import Path

from daq.digest import sha256
from ident.calibration import Calibration


def evidence_of(calibration: Calibration, content: bytes, file: Path | None) -> dict[str, object]:
    """As plain JSON.

    Args:
        calibration: whose gains are written.
        content: of its file.
        file: where that is, None where there is none.
    """
    return {
        "calibration": {
            "file": None if file is None else str(file.absolute()),
            "sha256": sha256(content),
            "cell": calibration.cell,
            "created": calibration.created,
            "software": calibration.software,
        },
        "configuration_sha256": calibration.configuration_sha256,
        "logs": [{"name": one.name, "sha256": one.sha256, "role": one.role} for one in calibration.sources],
    }
