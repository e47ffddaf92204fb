"""Effects of one's own in the search: found where they are, not where they are not,
and beside mistakes of geometry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import pytest

import ident
from ident.arrays import FloatArray
from ident.data.dataset import Dataset
from ident.discovery import geometry_check
from ident.discovery.candidates import FamilyTrials
from ident.discovery.evidence import Evidence
from ident.discovery.gates import Gates
from ident.discovery.loop import find_effects
from ident.discovery.search import rank_families
from tests.ident.recordings import MOUNTED, Truth, acting_on, bent, gathered, record

pytestmark = pytest.mark.slow

GATES = Gates(draws=199)
COSINE_NM = 9.0
SINE_NM = -6.0
DRY_NM = 12.0  #: more than the lobes are high: friction brakes everywhere
LOBES = 2.7
COARSE_LOBES = (1.5, 4.0, 9.0)


@dataclass(frozen=True, slots=True)
class LobedFriction(ident.Effect):
    """τ = sign(q̇) · (a cos ηq + b sin ηq)."""

    name = "lobed-friction"
    declares = ident.Property.ODD_IN_VELOCITY
    abscissa = ident.Abscissa.POSITION
    coefficients = (ident.Column("cosine", "Nm"), ident.Column("sine", "Nm"))
    needs_revolute = True

    lobes: Annotated[float, ident.Range(1.5, 12.0)]  #: η

    def columns(self, signals: ident.Signals, axis: int) -> FloatArray:
        """Columns, shape (2, k)."""
        angle_rad = self.lobes * signals.position_rad[axis]
        direction = np.sign(signals.velocity_rad_s[axis])
        cosine_and_sine = np.stack((np.cos(angle_rad), np.sin(angle_rad)))
        return np.asarray(cosine_and_sine * direction)


OWN = tuple(LobedFriction(lobes) for lobes in (2.0, 3.0, 4.0))


def _lobed(data: Dataset) -> FloatArray:
    position_rad = data.position_rad[:, 1]
    size_nm = COSINE_NM * np.cos(LOBES * position_rad) + SINE_NM * np.sin(LOBES * position_rad)
    velocity_sign = np.sign(data.velocity_rad_s[:, 1])
    torque_nm = (DRY_NM + size_nm) * velocity_sign
    return acting_on(1, 3, torque_nm)


def test_it_is_found_where_it_is_and_its_setting_is_refined(
    small: Evidence, small_truth: Truth
) -> None:
    rng = np.random.default_rng(0)
    steps = find_effects(bent(small, small_truth, _lobed), rng, GATES, own_effects=OWN)
    (placed,) = steps[-1].after.effects
    assert isinstance(placed.effect, LobedFriction)
    assert placed.axis == 1
    assert placed.effect.lobes == pytest.approx(LOBES, abs=0.1)  # it was among none of those given
    estimate = steps[-1].after.estimate
    values = dict(
        zip((column.name for column in estimate.unknowns), estimate.parameters, strict=True)
    )
    found = [values[column.name] for column in placed.columns]
    assert found == pytest.approx([COSINE_NM, SINE_NM], abs=1.0)


def test_a_coarse_grid_is_refined_before_rivals_are_compared(
    small: Evidence, small_truth: Truth
) -> None:
    """No value that is given is near the true one: terms without a name explain more than each."""
    coarse = tuple(LobedFriction(lobes) for lobes in COARSE_LOBES)
    rng = np.random.default_rng(0)
    steps = find_effects(bent(small, small_truth, _lobed), rng, GATES, own_effects=coarse)
    (placed,) = steps[-1].after.effects
    assert isinstance(placed.effect, LobedFriction)
    assert placed.axis == 1
    assert placed.effect.lobes == pytest.approx(LOBES, abs=0.1)


def test_it_is_not_found_where_it_is_not(small: Evidence) -> None:
    rng = np.random.default_rng(0)
    steps = find_effects(small, rng, GATES, own_effects=OWN)
    last_step = steps[-1]
    assert last_step.after.effects == ()
    findings = steps[0].findings
    assert "lobed-friction" in {finding.effect.name for finding in findings}


@dataclass(frozen=True, slots=True)
class TightSpot(ident.Effect):
    """τ = a sign(q̇) exp(−((q − c)/w)²): friction where something rubs."""

    name = "tight-spot"
    declares = ident.Property.ODD_IN_VELOCITY
    abscissa = ident.Abscissa.POSITION
    coefficients = (ident.Column("friction", "Nm", least=0.0),)

    centre_rad: Annotated[float, ident.Range(-4.0, 4.0)]  #: c
    width_rad: Annotated[float, ident.Range(0.02, 3.0)]  #: w

    def columns(self, signals: ident.Signals, axis: int) -> FloatArray:
        """Columns, shape (1, k)."""
        position_difference_rad = signals.position_rad[axis] - self.centre_rad
        distance = position_difference_rad / self.width_rad
        velocity_sign = np.sign(signals.velocity_rad_s[axis])
        return np.asarray(velocity_sign * np.exp(-(distance**2)))[None]


@dataclass(frozen=True, slots=True)
class StayingSpot(TightSpot):
    """The same, whose settings stay as they are given."""

    name = "staying-spot"
    refined = ()


CENTRE_RAD = 0.4
WIDTH_RAD = 0.45
SPOT_NM = 12.0


def _rubbing(data: Dataset) -> FloatArray:
    position_difference_rad = data.position_rad[:, 1] - CENTRE_RAD
    distance = position_difference_rad / WIDTH_RAD
    velocity_sign = np.sign(data.velocity_rad_s[:, 1])
    torque_nm = SPOT_NM * np.exp(-(distance**2)) * velocity_sign
    return acting_on(1, 3, torque_nm)


def test_two_real_settings_are_refined_and_nothing_joins_for_the_rest(
    small: Evidence, small_truth: Truth
) -> None:
    """At the values that are given, a rest would stay, and be taken for another friction."""
    given = tuple(TightSpot(centre_rad, 0.8) for centre_rad in (-1.0, 0.0, 1.0))
    rng = np.random.default_rng(0)
    steps = find_effects(bent(small, small_truth, _rubbing), rng, GATES, own_effects=given)
    (placed,) = steps[-1].after.effects
    assert isinstance(placed.effect, TightSpot)
    assert placed.axis == 1
    assert placed.effect.centre_rad == pytest.approx(CENTRE_RAD, abs=0.05)
    assert placed.effect.width_rad == pytest.approx(WIDTH_RAD, abs=0.05)


def test_which_settings_are_refined_is_for_the_class_to_say() -> None:
    refined = TightSpot(0.0, 0.8).refined
    assert refined == ("centre_rad", "width_rad")
    refined_once_chosen = TightSpot(0.0, 0.8).refined_once_chosen
    assert refined_once_chosen == ("centre_rad", "width_rad")
    assert StayingSpot(0.0, 0.8).refined == ()
    assert LobedFriction(2.0).refined == ()  # one alone is refined between its neighbours


@dataclass(frozen=True, slots=True)
class WritingFriction(LobedFriction):
    """The same, which changes the positions of everybody."""

    name = "writing-friction"

    def columns(self, signals: ident.Signals, axis: int) -> FloatArray:
        """Columns, shape (2, k)."""
        angle_rad = signals.position_rad[axis]
        angle_rad *= self.lobes
        return np.stack((np.cos(angle_rad), np.sin(angle_rad)))


def test_one_that_writes_into_the_signals_is_refused(small: Evidence) -> None:
    """Every effect reads the same arrays: the search would go on with other positions."""
    rng = np.random.default_rng(0)
    own_effects = [WritingFriction(2.0)]
    with pytest.raises(
        ident.EffectRefused,
        match=r"'writing-friction': found ValueError .*read-only.* copy what "
        r"it changes",
    ):
        find_effects(small, rng, GATES, own_effects=own_effects)


def test_mistakes_of_the_description_compete_with_it(
    small_truth: Truth, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A zero that is off by 2° is a suspect, which must stand beside every other effect."""
    rng = np.random.default_rng(5)
    runs: list[ident.Run] = []
    for number in range(4):
        run = record(
            small_truth, f"run{number}", rng, MOUNTED if number % 2 else None, noise_a=0.03
        )
        position_rad = run.position_rad + np.radians([0.0, 2.0, 0.0])
        runs.append(replace(run, position_rad=position_rad))
    mistaken = gathered(small_truth, tuple(runs))
    tested: set[str] = set()

    def watched(problem: Any, trials: Sequence[FamilyTrials], *rest: Any) -> Any:
        for one in trials:
            tested.update(effect.name for effect, _ in one.members)
        return rank_families(problem, trials, *rest)

    monkeypatch.setattr(geometry_check, "rank_families", watched)
    (found,) = geometry_check.check_geometry(
        mistaken, np.random.default_rng(0), GATES, OWN
    ).mistakes
    assert (found.effect.name, found.axis) == ("zero-offset", 1)
    assert {"lobed-friction", "zero-offset", "spring"} <= tested
