"""What a cell lets through to its controller, and who may let it through: `policy.apply` of the cell file."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Annotated

from pydantic import Field

from daq.configuration.yaml_file import StrictModel

_Percent = Annotated[float, Field(ge=0)]


class Applier(Enum):
    """Who applies what a scheduled job has found."""

    PERSON = "person"
    """The job proposes; a named person applies."""
    JOB = "job"
    """The job itself, where every gate is open."""


@dataclass(frozen=True, slots=True)
class ApplyPolicy:
    """Bounds of the write-back.

    Attributes:
        max_change_percent: from the gain in the file now [%].
        max_nameplate_percent: from the manufacturer's gain [%].
        max_std_percent: relative standard deviation of the identified gain [%].
        max_error_percent: relative error of the torques, on held-out data where there are any [%].
        by: who applies what a scheduled job has found.
    """

    max_change_percent: float = 35.0
    max_nameplate_percent: float = 50.0
    max_std_percent: float = 3.0
    max_error_percent: float = 25.0
    by: Applier = Applier.PERSON


DEFAULT_APPLY_POLICY = ApplyPolicy()


class ApplyPolicyModel(StrictModel):
    """`policy.apply`; what is not given stays as `ApplyPolicy` has it."""

    max_change_percent: _Percent = DEFAULT_APPLY_POLICY.max_change_percent
    max_nameplate_percent: _Percent = DEFAULT_APPLY_POLICY.max_nameplate_percent
    max_std_percent: _Percent = DEFAULT_APPLY_POLICY.max_std_percent
    max_error_percent: _Percent = DEFAULT_APPLY_POLICY.max_error_percent
    by: Applier = DEFAULT_APPLY_POLICY.by

    @property
    def policy(self) -> ApplyPolicy:
        """As the gates take it."""
        return ApplyPolicy(**self.model_dump())
