"""From arrays to effects to a prediction with `import ident` alone:
found effects are part of the calibration.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import ident
from ident.data.conditioning import Conditioning
from ident.discovery.before_after import error_on
from ident.effects.effect import ALL_AXES
from ident.effects.electrical import TimeSkew
from ident.effects.friction import Coupling
from ident.equations.rows import decimate_rows
from ident.prediction import placed_effect
from tests.ident.recordings import Truth

AXES = ("J1", "J2", "J3")
NAMEPLATE = (32.0, 34.0, -23.0)
DELAY_S = 0.008


@pytest.fixture(scope="module")
def late(small_runs: tuple[ident.Run, ...]) -> tuple[ident.Run, ...]:
    """Recordings whose currents were sampled eight milliseconds after their positions."""
    rate_hz = small_runs[0].rate_hz
    samples = round(DELAY_S * rate_hz)
    return tuple(
        replace(
            run,
            name=f"late {run.name}",
            time_s=run.time_s[samples:],
            position_rad=run.position_rad[samples:],
            current_a=run.current_a[:-samples],
        )
        for run in small_runs
    )


@pytest.fixture(scope="module")
def searched(
    small_truth: Truth, late: tuple[ident.Run, ...]
) -> tuple[ident.Identification, tuple[ident.Step, ...]]:
    """First estimate, and the turns of the search."""
    found = ident.identify(small_truth.model, late[:3], Conditioning(), holdout=late[3:])
    families = ((TimeSkew(),), (Coupling(2, 1), Coupling(3, 1)))
    evidence = ident.gather(found, late[:3], late[3:])
    rng = np.random.default_rng(0)
    return found, ident.find_effects(evidence, rng, families=families)


@pytest.mark.slow
def test_what_is_left_of_the_currents_is_that_of_the_held_out_rows(
    searched: tuple[ident.Identification, tuple[ident.Step, ...]],
) -> None:
    found, steps = searched
    held = steps[-1].after.holdout
    assert held is not None
    estimate = steps[-1].after.estimate
    left = np.sqrt(error_on(held, estimate).left / held.motor_use.sum(axis=1))
    calibration = ident.calibration_of(found, AXES, NAMEPLATE, steps=steps)
    assert calibration.current_residual == pytest.approx(left, rel=1e-5)


def test_a_skew_found_on_all_axes_is_predicted(
    searched: tuple[ident.Identification, tuple[ident.Step, ...]], late: tuple[ident.Run, ...]
) -> None:
    found, steps = searched
    calibration = ident.calibration_of(found, AXES, NAMEPLATE, steps=steps)
    (skew,) = calibration.effects
    assert (skew.name, skew.axis) == ("time-skew", ALL_AXES)
    coefficient = skew.coefficients[0].value
    assert coefficient == pytest.approx(DELAY_S, rel=0.1)
    assert skew.error_after_percent < 0.97 * skew.error_before_percent
    estimate = steps[-1].after.estimate
    gain = calibration.gains[1].value
    assert gain == pytest.approx(estimate.gains[1])
    data = ident.differentiate(late[3], found.model.drive_train, found.conditioning)

    def left(of: ident.Calibration) -> float:
        difference = ident.predict_current(of, found.model, data) - data.current_a
        rest = np.where(data.moving, difference, 0.0)
        return float(np.linalg.norm(decimate_rows(data, found.conditioning, rest.T)))

    without = ident.calibration_of(found, AXES, NAMEPLATE)
    assert without.effects == ()
    assert left(calibration) < 0.98 * left(without)


def test_errors_without_a_held_out_run_are_those_of_left_out_moves(
    searched: tuple[ident.Identification, tuple[ident.Step, ...]],
) -> None:
    found, steps = searched
    blind = tuple(replace(step, after=replace(step.after, holdout=None)) for step in steps)
    calibration = ident.calibration_of(replace(found, holdout=None), AXES, NAMEPLATE, steps=blind)
    (skew,) = calibration.effects
    assert steps[0].accepted is not None
    assert skew.error_before_percent == steps[0].accepted.error_before_percent


def test_an_identification_with_effects_needs_the_turns_of_the_search(
    searched: tuple[ident.Identification, tuple[ident.Step, ...]],
) -> None:
    _, steps = searched
    after = steps[-1].after
    with pytest.raises(ident.ModelError, match=r"'time-skew time 1'.*steps=find_effects"):
        ident.calibration_of(after.identification, AXES, NAMEPLATE)


def test_only_an_effect_on_all_motors_is_on_all_axes(
    searched: tuple[ident.Identification, tuple[ident.Step, ...]],
) -> None:
    found, steps = searched
    calibration = ident.calibration_of(found, AXES, NAMEPLATE, steps=steps)
    accepted = calibration.effects[0]
    placed, _ = placed_effect(accepted, calibration)
    last_step = steps[-1]
    assert placed in last_step.after.effects
    spring = replace(calibration.effects[0], name="spring")
    with pytest.raises(
        ident.EffectRefused, match="'spring' acts on axis 'all axes'; there are J1, J2, J3"
    ):
        placed_effect(spring, calibration)
