"""What a command that failed prints under `--json`."""

from __future__ import annotations

from pydantic import Field

from daq.report.document import Report


class ErrorReport(Report):
    """One line on stderr for a command that failed."""

    error: str
    """subject, or the whole message where that says what was found"""
    found: str
    expected: str
    do: str
    exit_code: int
    kind: str
    """class of the error"""
    kept: str = ""
    """files that were written before"""
    hint: str = ""
    axes: str = ""
    """axes that had power and are not confirmed without it"""
    unconfirmed: list[str] = Field(default=[], description="what could not be confirmed")
