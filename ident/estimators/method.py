"""Names of the estimators; imports nothing, so that a command line can offer them without loading numerics."""

from __future__ import annotations

from enum import Enum


class Method(Enum):
    """The estimators, by the names technicians use."""

    LS = "ls"
    WLS = "wls"
    TLS = "tls"
    ML = "ml"
