"""Structure without a name: found as a smooth or periodic term on the right axis and variable;
detection limits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from ident.data.dataset import Dataset
from ident.discovery import loop
from ident.discovery.evidence import Evidence, with_effects
from ident.discovery.gates import Gates
from ident.discovery.loop import Step, find_effects
from ident.discovery.search import choose_effect, rank_effects
from ident.discovery.structure import detection_limits_nm
from ident.effects.dictionary import EFFECTS
from ident.effects.effect import Effect
from ident.effects.signals import Abscissa
from ident.effects.unnamed import Smooth
from tests.ident.recordings import Truth, acting_on, bent, search_problem_of, training_error

pytestmark = pytest.mark.slow

FloatArray = NDArray[np.float64]
Torque = Callable[[Dataset], FloatArray]
GATES = Gates(draws=199)


def _without(*names: str) -> tuple[tuple[Effect, ...], ...]:
    return tuple(family for family in EFFECTS if family[0].name not in names)


def _needing(small: Evidence, truth: Truth, axis: int, torque: Torque) -> Evidence:
    return bent(small, truth, lambda data: acting_on(axis, 3, torque(data)))


def _loop(start: Evidence, families: tuple[tuple[Effect, ...], ...] = EFFECTS) -> Sequence[Step]:
    rng = np.random.default_rng(0)
    return find_effects(start, rng, GATES, families, geometry=())


def _low_speed(axis: int) -> Torque:
    return lambda data: (
        7.0
        * np.sign(data.velocity_rad_s[:, axis])
        * np.exp(-np.abs(data.velocity_rad_s[:, axis]) / 0.3)
    )


def _ripples(data: Dataset) -> FloatArray:
    q = data.position_rad[:, 1]
    return np.asarray(6.0 * np.sin(3.0 * q) * np.exp(-(q**2)))


def _bump(data: Dataset) -> FloatArray:
    v = data.velocity_rad_s[:, 2]
    return np.asarray(5.0 * np.sign(v) * np.exp(-(((np.abs(v) - 1.5) / 0.5) ** 2)))


def _cogs(data: Dataset) -> FloatArray:
    return np.asarray(4.0 * np.sin(120.0 * data.position_rad[:, 0]))


@dataclass(frozen=True)
class Nameless:
    """A torque of one axis that no family left in the dictionary is of."""

    axis: int
    torque: Torque
    removed: tuple[str, ...]
    name: str


NAMELESS = (
    Nameless(1, _ripples, (), "smooth-position"),
    Nameless(2, _bump, (), "smooth-velocity"),
    Nameless(1, _low_speed(1), ("stribeck", "nonlinear-viscous"), "smooth-velocity"),
    Nameless(
        0,
        lambda data: 4.0 * np.sin(120.0 * data.position_rad[:, 0]),
        ("cogging", "ripple"),
        "periodic-motor-angle",
    ),
)


@pytest.mark.parametrize(
    "case", NAMELESS, ids=("ripples", "bump", "stribeck removed", "cogging removed")
)
def test_what_has_no_name_is_found_on_its_axis_against_its_variable(
    small: Evidence, small_truth: Truth, case: Nameless, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "MAX_EFFECTS", 1)
    start = _needing(small, small_truth, case.axis, case.torque)
    families = _without(*case.removed)
    step = _loop(start, families)[0]
    found = [step.accepted, *(aside.finding for aside in step.set_aside)]
    term = next(
        one for one in found if one and (one.effect.name, one.axis) == (case.name, case.axis)
    )
    # Most of the excess of that axis' squared error is gone with it.
    joined = with_effects(start, (term.placed,))
    before, after, clean = (training_error(e).axes[case.axis] ** 2 for e in (start, joined, small))
    assert before - after > 0.6 * (before - clean)
    # It bends a gain, or is in the model.
    gain_difference = joined.estimate.gains - start.estimate.gains
    moved = np.abs(gain_difference) > start.estimate.gains_std
    assert moved.any() == (term is not step.accepted)


def test_a_name_that_is_right_wins_over_a_term_that_fits_anything(
    small: Evidence, small_truth: Truth
) -> None:
    steps = _loop(_needing(small, small_truth, 1, _low_speed(1)))
    assert [(step.accepted.effect.name, step.accepted.axis) for step in steps if step.accepted] == [
        ("stribeck", 1)
    ]
    structures = steps[0].structures
    assert any(finding.passed for finding in structures)  # it was asked, and had its say


@pytest.mark.parametrize(
    "variable", [Abscissa.VELOCITY, Abscissa.POSITION, Abscissa.LOAD, Abscissa.TIME]
)
@pytest.mark.parametrize("signed", [0, 1])
def test_no_variable_is_lost_because_a_part_of_its_term_is_declared(
    small: Evidence, variable: Abscissa, signed: int
) -> None:
    """Offset and dry friction are a constant times one and times sign(q̇):
    the rest of the term must still be tried.
    """
    search_problem = search_problem_of(small)
    limits = {Abscissa.VELOCITY: (0.0, 3.0), Abscissa.TIME: (0.0, 20.0)}.get(variable, (-1.0, 1.0))
    for at_rows in (False, True):
        families = [(Smooth(variable, *limits, signed),)]
        assert search_problem.test(families, 1, at_rows=at_rows)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_detection_limit_parts_what_is_found_from_what_is_not(
    small: Evidence, small_truth: Truth, axis: int
) -> None:
    limit = detection_limits_nm(search_problem_of(small), GATES)[axis]
    families = tuple(
        family for family in EFFECTS if family[0].name in {"cogging", "stribeck", "spring"}
    )

    def found(times: float) -> tuple[str, int] | None:
        ratio = small_truth.model.drive_train.ratio[axis, axis]
        start = _needing(
            small, small_truth, axis,
            lambda data: times * limit * np.sqrt(2.0) * np.sin(3.0 * ratio * data.position_rad[:, axis]),  # noqa: E501
        )  # fmt: skip
        rng = np.random.default_rng(0)
        findings = rank_effects(search_problem_of(start), rng, GATES, families)
        best = choose_effect(findings)
        return None if best is None else (best.effect.name, best.axis)

    assert found(3.0) == ("cogging", axis)
    assert found(0.3) is None
