"""What a cell lets through to its controller, and who may let it through: `policy.apply` of the cell file."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator

from daq.config.yaml_file import Fault, StrictModel

_Percent = Annotated[float, Field(ge=0)]


class AppliedBy(Enum):
    """Who applies what a scheduled job has found."""

    PERSON = "person"
    """The job proposes; a named person applies."""
    JOB = "job"
    """The job itself, where every gate is open."""


class HoldOut(Enum):
    """Whether a calibration must have been put to the test on a run that the fit did not see."""

    REQUIRED = "required"
    OPTIONAL = "optional"


@dataclass(frozen=True, slots=True)
class ApplyPolicy:
    """Bounds of the write-back.

    Attributes:
        max_change_percent: from the gain in the file now [%].
        max_change: from the gain in the file now, by the axis's name [unit of the gain]; an axis without one is bounded
            by the per cent alone.
        max_nameplate_percent: from the manufacturer's gain [%].
        max_std_percent: relative standard deviation of the identified gain [%].
        max_error_percent, max_axis_error_percent: relative error of all torques together, and of those of an axis, on
            held-out data where there are any [%].
        holdout: whether there must be some.
        max_age_days: of the oldest log [days]; None where age does not matter, as for imported logs, which have none.
        max_saturated_percent: share of an axis's samples in which a limit acted [%].
        by: who applies what a scheduled job has found.
        signatures: how many of the signers must have signed the calibration; whoever applies it is not counted.
        signers: public key (minisign) of each person who may sign, by name.
    """

    max_change_percent: float = 35.0
    max_nameplate_percent: float = 50.0
    max_std_percent: float = 3.0
    max_error_percent: float = 25.0
    max_axis_error_percent: float = 50.0
    max_age_days: float | None = 30.0
    max_saturated_percent: float = 2.0
    by: AppliedBy = AppliedBy.PERSON
    signatures: int = 0
    signers: Mapping[str, str] = field(default_factory=dict)
    holdout: HoldOut = HoldOut.OPTIONAL
    max_change: Mapping[str, float] = field(default_factory=dict)


DEFAULT_APPLY_POLICY = ApplyPolicy()


class ApplyPolicyModel(StrictModel):
    """`policy.apply`; what is not given stays as `ApplyPolicy` has it."""

    max_change_percent: _Percent = DEFAULT_APPLY_POLICY.max_change_percent
    max_nameplate_percent: _Percent = DEFAULT_APPLY_POLICY.max_nameplate_percent
    max_std_percent: _Percent = DEFAULT_APPLY_POLICY.max_std_percent
    max_error_percent: _Percent = DEFAULT_APPLY_POLICY.max_error_percent
    max_axis_error_percent: _Percent = DEFAULT_APPLY_POLICY.max_axis_error_percent
    max_age_days: Annotated[float, Field(gt=0)] | None = DEFAULT_APPLY_POLICY.max_age_days
    max_saturated_percent: _Percent = DEFAULT_APPLY_POLICY.max_saturated_percent
    by: AppliedBy = DEFAULT_APPLY_POLICY.by
    signatures: Annotated[int, Field(ge=0)] = DEFAULT_APPLY_POLICY.signatures
    signers: dict[str, str] = Field(default_factory=dict)
    holdout: HoldOut | None = None
    max_change: dict[str, Annotated[float, Field(ge=0)]] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _signers_enough(self) -> ApplyPolicyModel:
        if self.signatures > len(self.signers):
            raise ValueError(f"at least {self.signatures} `signers`, a public key by each name, for so many signatures")
        return self

    @model_validator(mode="after")
    def _check_holdout_and_changes(self) -> ApplyPolicyModel:
        if self.by is AppliedBy.JOB and self.holdout is HoldOut.OPTIONAL:
            raise ValueError("`holdout: required` where the job applies by itself")
        return self

    @property
    def policy(self) -> ApplyPolicy:
        """As the gates take it; nothing is written unseen and untested unless somebody looks at it first."""
        wanted = self.holdout or (HoldOut.REQUIRED if self.by is AppliedBy.JOB else HoldOut.OPTIONAL)
        return ApplyPolicy(**{**self.model_dump(), "holdout": wanted})


def max_change_faults(model: ApplyPolicyModel, axes: Collection[str]) -> Iterator[Fault]:
    """Bounds of axes that the cell does not have: misspelt, they would bound nothing."""
    for name in model.max_change:
        if name not in axes:
            yield Fault(("policy", "apply", "max_change", name), f"axis {name!r}", f"one of {', '.join(axes)}")


# Where a cell keeps what became of its calibrations: `history` of the cell file.


@dataclass(frozen=True, slots=True)
class HistoryPlace:
    """Files of a cell's history, absolute.

    Attributes:
        store: SQLite file with every calibration.
        audit: hash-chained record of whatever was asked of the controller.
    """

    store: Path
    audit: Path


class HistoryModel(StrictModel):
    """`history`: file names relative to the cell file; beside it and by its name where not given."""

    store: str | None = None
    audit: str | None = None


def history_place(model: HistoryModel, cell_file: Path) -> HistoryPlace:
    """Where the history of the cell in `cell_file` is."""
    folder, stem = cell_file.parent, cell_file.stem
    return HistoryPlace(
        (folder / (model.store or f"{stem}.history.sqlite")).resolve(),
        (folder / (model.audit or f"{stem}.audit.jsonl")).resolve(),
    )
