"""Effects that a cell file declares: read, checked,
and part of a fit by any estimator but instruments.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from daq.config.cell import Cell, DeclaredEffect
from daq.config.cell_file import load_cell
from daq.errors import ConfigurationInconsistent, UsageError
from daq.workflow.fit import declared_effects, refuse_effects, with_effects_of_cell
from ident.effects.effect import PlacedEffect
from ident.effects.position import Counterbalance
from ident.estimators.identify import identify
from ident.estimators.method import Method
from tests.conftest import CHECKOUT
from tests.ident.balanced import AXIS, CONDITIONING, GAINS, heavy_model, heavy_runs

CELL = load_cell(CHECKOUT / "configs/cells/kr270.yaml")


def _declaring(*effects: DeclaredEffect) -> Cell:
    return replace(CELL, effects=effects)


def test_the_shipped_cell_declares_its_balancer() -> None:
    settings = {"ratio": 0.25, "phase_rad": -1.57}
    expected = (DeclaredEffect("counterbalance", AXIS, settings),)
    assert CELL.effects == expected
    assert declared_effects(CELL) == (PlacedEffect(Counterbalance(0.25, -1.57), AXIS),)


def test_settings_that_are_not_given_are_those_of_the_dictionary() -> None:
    cell = _declaring(DeclaredEffect("gravity-compensator", 2, {}))
    (placed,) = declared_effects(cell)
    assert placed.effect.settings == {"order": 1}


@pytest.mark.parametrize(
    ("effect", "message"),
    [
        (DeclaredEffect("counterweight", 1, {}), "no such effect; expected one of stribeck"),
        (
            DeclaredEffect("counterbalance", 1, {"length": 0.2}),
            "settings length; expected ratio, phase_rad",
        ),
        (
            DeclaredEffect("counterbalance", 1, {"ratio": 1.4}),
            "ratio = 1.4; it lies between 0.05 and 0.95",
        ),
        (DeclaredEffect("cogging", 1, {"order": 2.5}), "2.5; expected a whole number"),
        (DeclaredEffect("coupling", 1, {"other_axis": 9}), "number of another of the 6 axes"),
    ],
)
def test_an_effect_that_cannot_be_is_refused(effect: DeclaredEffect, message: str) -> None:
    with pytest.raises(ConfigurationInconsistent, match=f"{effect.name} on J2.*{message}"):
        declared_effects(_declaring(effect))


@pytest.mark.parametrize(
    ("new", "message"),
    [
        ("axis: J9", "'J9'; expected one of J1"),
        ("axis: J2\n  - name: counterbalance\n    axis: J2", "J2 twice"),
    ],
)
def test_the_place_of_an_effect_is_checked_with_the_file(
    tmp_path: Path, new: str, message: str
) -> None:
    text = (CHECKOUT / "configs/cells/kr270.yaml").read_text(encoding="utf-8")
    changed_text = text.replace("../", f"{CHECKOUT}/configs/")
    text = changed_text.replace("axis: J2", new, 1)
    (tmp_path / "cell.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigurationInconsistent, match=message):
        load_cell(tmp_path / "cell.yaml")


def test_what_would_leave_the_effects_out_is_refused() -> None:
    refuse_effects(_declaring(), "--cases")
    with pytest.raises(UsageError, match="counterbalance on J2"):
        refuse_effects(CELL, "--cases")


@pytest.mark.slow
def test_a_fit_with_given_gains_has_the_effect_too() -> None:
    runs = heavy_runs(balanced=True)
    start = identify(
        heavy_model(),
        runs,
        CONDITIONING,
        method=Method.WLS,
        fixed_gains=GAINS,
        keep_rows=True,
        judge=False,
    )
    (step,) = with_effects_of_cell(start, declared_effects(CELL), CELL.axis_names)
    after = step.after.identification
    assert after.estimate.method is Method.WLS
    assert np.array_equal(after.estimate.gains, GAINS)
    assert after.training_error.axes[AXIS] < 0.5 * start.training_error.axes[AXIS]
