"""What each number of an exported model rests on: the data of the fit, or the prior."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from daq.report.document import Report
from daq.workflow.full_choice import FullChoice
from ident.model.bodies import LOADED
from ident.physical.full_parameters import RestsOn


class ChosenParameter(Report):
    """Standard parameter of the bodies that were written."""

    name: str
    value: float
    unit: str
    basis: str
    """`data` or `prior`: which of the two has the larger part in its variance"""
    prior_share: float
    """the prior's part, 0 to 1"""


def chosen_parameters(choice: FullChoice) -> Iterator[ChosenParameter]:
    """Yield the standard parameters of the robot without a payload."""
    for number, column in enumerate(choice.model.columns):
        if column.name.endswith(LOADED):
            continue  # what a payload adds to friction is no part of the robot without one
        yield ChosenParameter.of(
            column,
            value=float(choice.standard[number]),
            basis=choice.basis[number].value,
            prior_share=float(np.clip(choice.shares[number], 0.0, 1.0)),
        )


def choice_remarks(choice: FullChoice) -> Iterator[str]:
    """Say for the head of a model where its bodies come from, and which numbers are the prior's."""
    change = choice.torque_change_percent.total
    yield f"Bodies: {choice.chosen_by.value}; torque changed by {change:.2g} %"
    by_prior = names_by_prior(choice)
    if by_prior:
        yield f"By the prior, not measured: {', '.join(by_prior)}"


def names_by_prior(choice: FullChoice) -> list[str]:
    """Names of the parameters in the report that rest on the prior."""
    names: list[str] = []
    for parameter in chosen_parameters(choice):
        if parameter.basis == RestsOn.PRIOR.value:
            names.append(parameter.name)
    return names
