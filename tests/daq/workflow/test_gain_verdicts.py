"""Verdict of a fit on each gain: its own σ, what identified it, and moves that would help."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from daq.config.cell import Cell
from daq.config.cell_file import load_cell
from daq.environment import shipped_configurations
from daq.log.reader import LossyLogs
from daq.workflow import fit as fit_module
from daq.workflow.fit import Fit, fit
from daq.workflow.verdicts import gain_verdicts, needed_verdicts
from ident.data.run import Run
from ident.planning.gain_verdict import GOOD_PERCENT, Visibility
from tests.ident.recordings import MOUNTED, record, tx40_truth


@pytest.fixture(scope="module")
def fitted() -> Iterator[Fit]:
    """Short and noisy: some gains are weak."""
    truth = tx40_truth()
    rng = np.random.default_rng(6)
    demo_path = shipped_configurations() / "cells" / "demo.yaml"
    cell = load_cell(demo_path)
    runs = {
        name: replace(record(truth, name, rng, payload, noise_a=0.6, seconds=14.0), digest=name)
        for name, payload in (("bare", None), ("loaded", MOUNTED))
    }

    def load(
        path: Path, other: Cell | None = None, _lossy: LossyLogs = LossyLogs.REFUSED
    ) -> tuple[Run, Cell]:
        return runs[path.name], other or cell

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit_module, "load_run", load)
        logs = (Path("bare"), Path("loaded"))
        yield fit(logs)


@pytest.mark.slow
def test_the_deviations_are_the_fits_own_and_weak_gains_get_advice(fitted: Fit) -> None:
    estimate = fitted.identification.estimate
    found = gain_verdicts(fitted)
    absolute_gain = np.abs(estimate.gains)
    own = 100.0 * estimate.gains_std / absolute_gain
    std_percent = [gain.std_percent for gain in found]
    assert std_percent == pytest.approx(own.tolist())
    assert (not needed_verdicts(fitted)) == bool(np.all(own <= GOOD_PERCENT))
    weak = [gain for gain in found if gain.verdict is not Visibility.GOOD]
    assert weak
    for gain in weak:
        assert gain.advice is not None
        assert gain.advice.std_percent < gain.std_percent


@pytest.mark.slow
def test_gravity_does_not_act_on_the_vertical_axis(fitted: Fit) -> None:
    found = gain_verdicts(fitted)
    expected = [False, True, True, True, True, True]
    assert [gain.gravity_acts for gain in found] == expected
    assert "J1 is identifiable only through inertia" in found[0].words("J1")
