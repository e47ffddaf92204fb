"""The cells of the effects study: which plant does what beyond the declared model.

An effect is made by the plant's own physics (drivers/simulation/effects.py), by parameters that a
mechanic would know; nothing here comes from the formulas that the search tries.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import chain

from drivers.simulation.spec import CellSpec, UndeclaredEffect
from tests.studies.study_cells import spec_of, world_cell

SMALL = 0.4


@dataclass(frozen=True, slots=True)
class EffectCase:
    """One simulated cell of the study.

    Attributes:
        name: of its file.
        seed: of its truth and its noise; cases of one seed differ in their effects alone.
        effects: of the plant.
    """

    name: str
    seed: int
    effects: tuple[UndeclaredEffect, ...]

    def spec(self, world: str, payload: str | None, run: int) -> CellSpec:
        """The plant of one of its runs, in one of WORLDS."""
        cell = world_cell(self.seed, world)
        return replace(spec_of(cell, payload, run), effects=self.effects)


def _effect(name: str, joint: int, **parameters: float) -> UndeclaredEffect:
    return UndeclaredEffect(name, joint - 1, parameters)


SINGLE_EFFECTS = (
    (
        _effect("stribeck", 2, rise_nm=4.0, speed_rad_s=0.25),
        _effect("stribeck", 4, rise_nm=1.2, speed_rad_s=0.2),
    ),
    (
        _effect("nonlinear-viscous", 1, torque_at_1_rad_s_nm=4.0, exponent=1 / 3),
        _effect("nonlinear-viscous", 3, torque_at_1_rad_s_nm=2.0, exponent=2.0),
    ),
    (
        _effect("asymmetric-viscous", 2, coefficient_nm_s_rad=2.0),
        _effect("asymmetric-viscous", 5, coefficient_nm_s_rad=0.5),
    ),
    (_effect("load-friction", 3, coefficient=0.12), _effect("load-friction", 2, coefficient=0.08)),
    (
        _effect("warm-up", 1, cold_fraction=0.6, time_constant_s=60.0),
        _effect("warm-up", 4, cold_fraction=0.6, time_constant_s=40.0),
    ),
    (
        _effect("presliding", 2, torque_nm=6.0, distance_rad=0.06),
        _effect("presliding", 4, torque_nm=1.6, distance_rad=0.08),
    ),
    (
        _effect(
            "backlash", 3, gap_rad=0.005, stiffness_nm_per_rad=20000.0, damping_nm_s_per_rad=30.0
        ),
        _effect(
            "backlash", 2, gap_rad=0.004, stiffness_nm_per_rad=40000.0, damping_nm_s_per_rad=100.0
        ),
    ),
    (
        _effect("elasticity", 1, stiffness_nm_per_rad=12000.0, damping_nm_s_per_rad=60.0),
        _effect("elasticity", 3, stiffness_nm_per_rad=5000.0, damping_nm_s_per_rad=20.0),
    ),
    (
        _effect("spring", 2, stiffness_nm_per_rad=12.0, rest_rad=0.2),
        _effect("spring", 3, stiffness_nm_per_rad=6.0, rest_rad=1.0),
    ),
    (
        _effect("position-friction", 3, amplitude_nm=2.0, phase_rad=0.4),
        _effect("position-friction", 5, amplitude_nm=0.9, phase_rad=-1.0),
    ),
    (
        _effect("cogging", 4, amplitude_nm=1.2, order=1.0, phase_rad=0.5),
        _effect("cogging", 6, amplitude_nm=0.8, order=2.0, phase_rad=-0.7),
    ),
    (_effect("saturation", 2, half_current_a=9.0), _effect("saturation", 3, half_current_a=8.0)),
    (_effect("lag", 1, time_constant_s=0.008), _effect("lag", 3, time_constant_s=0.008)),
    (
        _effect("coupling", 4, other_axis=5.0, coulomb_nm=0.9, viscous_nm_s_rad=0.4),
        _effect("coupling", 3, other_axis=2.0, coulomb_nm=2.0, viscous_nm_s_rad=1.0),
    ),
)
"""Each family on two axes."""


def _cable(
    name: str,
    joint: int,
    other: int,
    radii_m: tuple[float, float],
    stiffness_nm: float,
    rest: float,
) -> UndeclaredEffect:
    """A cable around two joints; its stiffness at the first of them,
    and the way at rest in radians of that joint.
    """
    stiffness_n_per_m = stiffness_nm / radii_m[0] ** 2
    rest_m = rest * abs(radii_m[0])
    return _effect(
        name,
        joint,
        other_axis=float(other),
        radius_m=radii_m[0],
        other_radius_m=radii_m[1],
        stiffness_n_per_m=stiffness_n_per_m,
        rest_m=rest_m,
    )


FURTHER_EFFECTS = (
    _cable("cable", 2, 3, (0.12, 0.08), 14.0, 0.3),
    _cable("cable", 4, 5, (0.05, -0.05), 2.0, 0.0),
    _cable("cable", 1, 2, (0.10, 0.15), 8.0, -0.2),
    _cable("slack-cable", 2, 3, (0.10, 0.10), 25.0, 0.3),
    _cable("slack-cable", 3, 4, (-0.06, 0.05), 8.0, -0.2),
    _cable("slack-cable", 5, 6, (0.05, 0.04), 2.5, 0.2),
    _effect("offset-drift", 1, offset_nm=3.0, time_constant_s=120.0),
    _effect("offset-drift", 2, offset_nm=-6.0, time_constant_s=60.0),
    _effect("offset-drift", 3, offset_nm=4.0, time_constant_s=240.0),
    _effect("offset-drift", 4, offset_nm=1.0, time_constant_s=90.0),
    _effect("offset-drift", 5, offset_nm=-1.0, time_constant_s=40.0),
    _effect("offset-drift", 6, offset_nm=0.8, time_constant_s=150.0),
    _effect("backlash", 1, gap_rad=0.004, stiffness_nm_per_rad=40000.0, damping_nm_s_per_rad=100.0),
    _effect("backlash", 1, gap_rad=0.006, stiffness_nm_per_rad=20000.0, damping_nm_s_per_rad=60.0),
    _effect("backlash", 4, gap_rad=0.008, stiffness_nm_per_rad=3000.0, damping_nm_s_per_rad=4.0),
    _effect("backlash", 4, gap_rad=0.012, stiffness_nm_per_rad=2000.0, damping_nm_s_per_rad=3.0),
    _effect("backlash", 5, gap_rad=0.008, stiffness_nm_per_rad=2500.0, damping_nm_s_per_rad=3.0),
    _effect("backlash", 5, gap_rad=0.014, stiffness_nm_per_rad=1500.0, damping_nm_s_per_rad=2.0),
)
"""Cables over two joints, offsets that drift, and free play where no weight holds the flanks
together.
"""

_SIZES = frozenset(
    {
        "rise_nm",
        "torque_at_1_rad_s_nm",
        "coefficient_nm_s_rad",
        "coefficient",
        "cold_fraction",
        "torque_nm",
        "gap_rad",
        "amplitude_nm",
        "coulomb_nm",
        "viscous_nm_s_rad",
        "time_constant_s",
    }
)


def _smaller(effect: UndeclaredEffect) -> UndeclaredEffect:
    """The same effect at SMALL of its size: what it adds to the torque, not how it is shaped."""
    parameters = dict(effect.parameters)
    if effect.name == "saturation":
        parameters["half_current_a"] /= SMALL**0.5
    elif effect.name == "elasticity":
        parameters["stiffness_nm_per_rad"] /= SMALL
    else:
        sizes = _SIZES - ({"time_constant_s"} if effect.name == "warm-up" else set())
        parameters = {
            key: value * (SMALL if key in sizes else 1.0) for key, value in parameters.items()
        }
    if effect.name == "spring":
        parameters["stiffness_nm_per_rad"] *= SMALL
    return replace(effect, parameters=parameters)


SINGLES = tuple(
    EffectCase(f"single-{number:02d}-{effect.name}-J{effect.axis + 1}", 2001 + number, (effect,))
    for number, effect in enumerate(chain.from_iterable(SINGLE_EFFECTS))
)
FURTHER = tuple(
    EffectCase(f"further-{number:02d}-{effect.name}-J{effect.axis + 1}", 2301 + number, (effect,))
    for number, effect in enumerate(FURTHER_EFFECTS)
)
CLEAN = tuple(EffectCase(f"clean-{number:02d}", 2001 + number, ()) for number in range(28))
"""The same cells without their effect:
the clean floor of each seed, and the count of false effects.
"""
SMALLS = tuple(
    EffectCase(
        f"small-{number:02d}-{pair[0].name}-J{pair[0].axis + 1}",
        2001 + 2 * number,
        (_smaller(pair[0]),),
    )
    for number, pair in enumerate(SINGLE_EFFECTS)
)


def _pair(number: int, kind: str, first: UndeclaredEffect, second: UndeclaredEffect) -> EffectCase:
    seed = 2101 + number
    return EffectCase(f"{kind}-{number:02d}-{first.name}-{second.name}", seed, (first, second))


APART = tuple(
    _pair(number, "apart", SINGLE_EFFECTS[one][a], SINGLE_EFFECTS[other][b])
    for number, (one, a, other, b) in enumerate(
        (
            (0, 0, 3, 0),
            (1, 0, 10, 1),
            (2, 0, 9, 0),
            (3, 1, 13, 0),
            (4, 0, 8, 1),
            (5, 1, 11, 0),
            (7, 0, 0, 1),
            (9, 1, 1, 0),
            (12, 0, 3, 0),
            (11, 1, 8, 0),
        )
    )
)
"""Two effects on different axes."""
TOGETHER = tuple(
    _pair(number, "together", first, second)
    for number, (first, second) in enumerate(
        (
            (
                _effect("stribeck", 2, rise_nm=4.0, speed_rad_s=0.25),
                _effect("spring", 2, stiffness_nm_per_rad=12.0, rest_rad=0.2),
            ),
            (
                _effect("load-friction", 3, coefficient=0.12),
                _effect("position-friction", 3, amplitude_nm=2.0, phase_rad=0.4),
            ),
            (
                _effect("asymmetric-viscous", 2, coefficient_nm_s_rad=2.0),
                _effect("load-friction", 2, coefficient=0.08),
            ),
            (
                _effect("nonlinear-viscous", 1, torque_at_1_rad_s_nm=4.0, exponent=1 / 3),
                _effect("lag", 1, time_constant_s=0.008),
            ),
            (
                _effect("cogging", 4, amplitude_nm=1.2, order=1.0, phase_rad=0.5),
                _effect("stribeck", 4, rise_nm=1.2, speed_rad_s=0.2),
            ),
            (
                _effect("saturation", 2, half_current_a=9.0),
                _effect("asymmetric-viscous", 2, coefficient_nm_s_rad=2.0),
            ),
            (
                _effect("warm-up", 1, cold_fraction=0.6, time_constant_s=60.0),
                _effect("spring", 1, stiffness_nm_per_rad=8.0, rest_rad=0.2),
            ),
            (
                _effect("position-friction", 5, amplitude_nm=0.9, phase_rad=-1.0),
                _effect("asymmetric-viscous", 5, coefficient_nm_s_rad=0.5),
            ),
            (
                _effect("spring", 3, stiffness_nm_per_rad=6.0, rest_rad=1.0),
                _effect("load-friction", 3, coefficient=0.12),
            ),
            (
                _effect("lag", 3, time_constant_s=0.008),
                _effect("asymmetric-viscous", 3, coefficient_nm_s_rad=1.5),
            ),
        )
    )
)
"""Two effects on the same axis."""
