"""The derivative of the gains to the payload's mass is what a refit with another mass gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ident.arrays import FloatArray
from ident.data.run import Run
from ident.discovery.evidence import gather, with_effects
from ident.effects.effect import PlacedEffect
from ident.effects.friction import LoadFriction
from ident.equations.system import System
from ident.estimators.estimate import Estimate, Identification
from ident.estimators.identify import identify
from ident.estimators.payload_mass import mass_responses
from ident.model.bodies import Payload
from tests.ident.recordings import CONDITIONING, MOUNTED, PAYLOAD_TRUTH, Truth, record

pytestmark = pytest.mark.slow

STEP = 0.01  #: Share of the mass between the refits and the fit
DRAWING = {name: PAYLOAD_TRUTH[name] for name in ("m", "mx", "my", "mz")}
METHODS = [("ml", 0.005), ("iv", 0.005), ("ls", 0.02), ("wls", 0.02), ("tls", 0.02)]
"""Those of the joints' equations are differentiated in the motors',
which coupled axes weight a little otherwise.
"""
KNOWN = {"mass": {"m": PAYLOAD_TRUTH["m"]}, "centre": DRAWING, "all": PAYLOAD_TRUTH}
CASES = [(*METHODS[0], known) for known in KNOWN] + [(*method, "all") for method in METHODS[1:]]
"""What is known of the payload is a matter of the equations, not of the method:
one method tries all three.
"""


@pytest.fixture(scope="module")
def runs(truth: Truth) -> tuple[Run, ...]:
    """Two runs without and two with load, with noise."""
    return tuple(
        record(
            truth,
            f"r{seed}",
            np.random.default_rng(seed),
            MOUNTED if seed % 2 else None,
            noise_a=0.1,
            seconds=22.0,
        )
        for seed in range(4)
    )


def _fitted(
    truth: Truth, runs: tuple[Run, ...], known: dict[str, float], factor: float, method: str = "ml"
) -> Identification:
    wrong = Payload(MOUNTED.name, MOUNTED.mounting, {**known, "m": factor * known["m"]})
    carried = [run if run.payload is None else replace(run, payload=wrong) for run in runs]
    return identify(truth.model, carried, CONDITIONING, method=method, keep_rows=method == "ml")


def _refitted(
    truth: Truth, runs: tuple[Run, ...], known: dict[str, float], method: str
) -> tuple[FloatArray, FloatArray]:
    """Derivatives of gains and of parameters to the mass, from two refits."""
    above = _fitted(truth, runs, known, 1.0 + STEP, method).estimate
    below = _fitted(truth, runs, known, 1.0 - STEP, method).estimate
    between_kg = 2.0 * STEP * known["m"]
    gain_difference = above.gains - below.gains
    parameter_difference = above.parameters - below.parameters
    return gain_difference / between_kg, (parameter_difference) / between_kg


@pytest.mark.parametrize(("method", "tolerance", "known"), CASES)
def test_the_derivative_is_that_of_refits_with_another_mass(
    truth: Truth, runs: tuple[Run, ...], method: str, tolerance: float, known: str
) -> None:
    found = _fitted(truth, runs, KNOWN[known], 1.0, method)
    (response,) = mass_responses(found.system, found.estimate)
    assert (response.payload, response.mass_kg) == ("disc", PAYLOAD_TRUTH["m"])
    gains = found.estimate.gains
    relative = response.gain_per_kg * response.mass_kg / gains
    gains_per_kg, parameters_per_kg = _refitted(truth, runs, KNOWN[known], method)
    expected = gains_per_kg * response.mass_kg / gains
    # In σ of each parameter: some of them are far larger than others.
    std = found.estimate.parameters_std
    refitted = parameters_per_kg / std
    difference = response.parameters_per_kg / std - refitted
    largest_absolute_difference = np.abs(difference).max()
    largest_absolute_refitted = np.abs(refitted).max()
    assert largest_absolute_difference < 0.03 * largest_absolute_refitted
    assert relative == pytest.approx(expected, abs=tolerance)
    if known == "mass":
        assert relative == pytest.approx(np.ones(6), abs=0.001)
    else:
        # The drawing contradicts a wrong mass, and the axes answer in their own ways.
        assert np.ptp(relative) > 0.2
        assert np.all(relative < 0.9)


def test_effects_in_the_model_are_differentiated_too(truth: Truth, runs: tuple[Run, ...]) -> None:
    effect = (PlacedEffect(LoadFriction(0), 2),)

    def with_effect(factor: float) -> Identification:
        return with_effects(gather(_fitted(truth, runs, DRAWING, factor)), effect).identification

    found = with_effect(1.0)
    (response,) = mass_responses(found.system, found.estimate)
    change = with_effect(1.0 + STEP).estimate.gains - with_effect(1.0 - STEP).estimate.gains
    gains = found.estimate.gains
    expected = change / (2.0 * STEP * gains)
    # The column of the effect is the load that the model predicts, which answers to the mass as
    # well.
    assert response.gain_per_kg * DRAWING["m"] / gains == pytest.approx(expected, abs=0.02)


def test_two_bodies_have_a_derivative_each_and_two_mountings_of_one_body_one(
    truth: Truth, runs: tuple[Run, ...]
) -> None:
    def with_payloads(first: Payload, second: Payload) -> Identification:
        carried = [*runs]
        carried[1] = replace(runs[1], payload=first)
        carried[3] = replace(runs[3], payload=second)
        return identify(truth.model, carried, CONDITIONING)

    mass = PAYLOAD_TRUTH["m"]
    turned = replace(MOUNTED, mounting="b")
    (one,) = mass_responses(*_parts(with_payloads(MOUNTED, turned)))
    changed_turned = replace(turned, name="plate")
    two = mass_responses(*_parts(with_payloads(MOUNTED, changed_turned)))
    payloads = [response.payload for response in two]
    assert payloads == ["disc", "plate"]
    assert sum(response.gain_per_kg for response in two) == pytest.approx(one.gain_per_kg, rel=1e-6)
    changed_mounted = replace(MOUNTED, known={"m": mass * (1.0 + STEP)})
    heavier = with_payloads(changed_mounted, replace(turned, name="plate"))
    lighter = with_payloads(
        replace(MOUNTED, known={"m": mass * (1.0 - STEP)}), replace(turned, name="plate")
    )
    gain_difference = heavier.estimate.gains - lighter.estimate.gains
    expected = gain_difference / (2.0 * STEP * mass)
    gain_per_kg = two[0].gain_per_kg
    assert gain_per_kg / heavier.estimate.gains == pytest.approx(
        expected / heavier.estimate.gains, abs=0.003
    )


def _parts(found: Identification) -> tuple[System, Estimate]:
    return found.system, found.estimate


def test_fixed_gains_do_not_depend_on_a_mass(truth: Truth, runs: tuple[Run, ...]) -> None:
    found = identify(truth.model, runs, CONDITIONING, fixed_gains=truth.gains)
    assert mass_responses(found.system, found.estimate) == ()
