"""Names of the estimators; imports no numerics, so that a command line can offer them quickly."""

from __future__ import annotations

from enum import Enum

from ident.errors import ModelError


class Method(Enum):
    """The estimators, by the names technicians use."""

    LS = "ls"
    WLS = "wls"
    TLS = "tls"
    ML = "ml"
    IV = "iv"

    @property
    def is_of_currents(self) -> bool:
        """Whether it fits the motors' currents, so that the search for effects can build on it."""
        return self in (Method.ML, Method.IV)

    @classmethod
    def _missing_(cls, value: object) -> Method:
        raise ModelError(
            f"there is no method {value!r}; expected one of "
            f"{', '.join(method.value for method in cls)}"
        )
