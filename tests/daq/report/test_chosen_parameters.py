"""What an exported model says of the numbers that rest on the prior."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from daq.report.chosen_parameters import chosen_parameters, names_by_prior
from ident.model.bodies import LOADED
from ident.model.model import Column
from ident.physical.full_parameters import RestsOn


def test_the_head_and_the_report_name_the_same_parameters() -> None:
    """What a payload adds to friction is no part of the robot without one."""
    column = Column(f"fv1{LOADED}", "Nm/(rad/s)")
    columns = (
        Column("m1", "kg"),
        column,
        Column("fv1", "Nm/(rad/s)"),
    )
    model = SimpleNamespace(columns=columns)
    basis = (RestsOn.PRIOR, RestsOn.PRIOR, RestsOn.DATA)
    shares = np.array([1.0, 1.0, 0.0])
    standard = np.ones(3)
    choice: Any = SimpleNamespace(
        model=model,
        standard=standard,
        basis=basis,
        shares=shares,
    )
    names = [one.name for one in chosen_parameters(choice)]
    assert names == ["m1", "fv1"]
    assert names_by_prior(choice) == ["m1"]
