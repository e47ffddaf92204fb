"""The cells of the effects study: which plant does what beyond the declared model.

An effect is made by the plant's own physics (drivers/simulation/effects.py), by parameters that a
mechanic would know; nothing here comes from the formulas that the search tries.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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


def _flexible_drive(
    name: str, joint: int, stiffness_nm_per_rad: float, damping_nm_s_per_rad: float, **gap: float
) -> UndeclaredEffect:
    return _effect(
        name,
        joint,
        **gap,
        stiffness_nm_per_rad=stiffness_nm_per_rad,
        damping_nm_s_per_rad=damping_nm_s_per_rad,
    )


def _backlash(
    joint: int, gap_rad: float, stiffness_nm_per_rad: float, damping_nm_s_per_rad: float
) -> UndeclaredEffect:
    return _flexible_drive(
        "backlash", joint, stiffness_nm_per_rad, damping_nm_s_per_rad, gap_rad=gap_rad
    )


def _offset_drift(joint: int, offset_nm: float, time_constant_s: float) -> UndeclaredEffect:
    return _effect("offset-drift", joint, offset_nm=offset_nm, time_constant_s=time_constant_s)


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


STRIBECK_J2 = _effect("stribeck", 2, rise_nm=4.0, speed_rad_s=0.25)
STRIBECK_J4 = _effect("stribeck", 4, rise_nm=1.2, speed_rad_s=0.2)
NONLINEAR_J1 = _effect("nonlinear-viscous", 1, torque_at_1_rad_s_nm=4.0, exponent=1 / 3)
NONLINEAR_J3 = _effect("nonlinear-viscous", 3, torque_at_1_rad_s_nm=2.0, exponent=2.0)
ASYMMETRIC_J2 = _effect("asymmetric-viscous", 2, coefficient_nm_s_rad=2.0)
ASYMMETRIC_J3 = _effect("asymmetric-viscous", 3, coefficient_nm_s_rad=1.5)
ASYMMETRIC_J5 = _effect("asymmetric-viscous", 5, coefficient_nm_s_rad=0.5)
LOAD_FRICTION_J2 = _effect("load-friction", 2, coefficient=0.08)
LOAD_FRICTION_J3 = _effect("load-friction", 3, coefficient=0.12)
WARM_UP_J1 = _effect("warm-up", 1, cold_fraction=0.6, time_constant_s=60.0)
WARM_UP_J4 = _effect("warm-up", 4, cold_fraction=0.6, time_constant_s=40.0)
PRESLIDING_J2 = _effect("presliding", 2, torque_nm=6.0, distance_rad=0.06)
PRESLIDING_J4 = _effect("presliding", 4, torque_nm=1.6, distance_rad=0.08)
ELASTICITY_J1 = _flexible_drive("elasticity", 1, 12000.0, 60.0)
ELASTICITY_J3 = _flexible_drive("elasticity", 3, 5000.0, 20.0)
BACKLASH_J2 = _backlash(2, 0.004, 40000.0, 100.0)
BACKLASH_J3 = _backlash(3, 0.005, 20000.0, 30.0)
SPRING_J1 = _effect("spring", 1, stiffness_nm_per_rad=8.0, rest_rad=0.2)
SPRING_J2 = _effect("spring", 2, stiffness_nm_per_rad=12.0, rest_rad=0.2)
SPRING_J3 = _effect("spring", 3, stiffness_nm_per_rad=6.0, rest_rad=1.0)
POSITION_FRICTION_J3 = _effect("position-friction", 3, amplitude_nm=2.0, phase_rad=0.4)
POSITION_FRICTION_J5 = _effect("position-friction", 5, amplitude_nm=0.9, phase_rad=-1.0)
COGGING_J4 = _effect("cogging", 4, amplitude_nm=1.2, order=1.0, phase_rad=0.5)
COGGING_J6 = _effect("cogging", 6, amplitude_nm=0.8, order=2.0, phase_rad=-0.7)
SATURATION_J2 = _effect("saturation", 2, half_current_a=9.0)
SATURATION_J3 = _effect("saturation", 3, half_current_a=8.0)
LAG_J1 = _effect("lag", 1, time_constant_s=0.008)
LAG_J3 = _effect("lag", 3, time_constant_s=0.008)
COUPLING_J3 = _effect("coupling", 3, other_axis=2.0, coulomb_nm=2.0, viscous_nm_s_rad=1.0)
COUPLING_J4 = _effect("coupling", 4, other_axis=5.0, coulomb_nm=0.9, viscous_nm_s_rad=0.4)

SINGLE_EFFECTS = (
    (STRIBECK_J2, STRIBECK_J4),
    (NONLINEAR_J1, NONLINEAR_J3),
    (ASYMMETRIC_J2, ASYMMETRIC_J5),
    (LOAD_FRICTION_J3, LOAD_FRICTION_J2),
    (WARM_UP_J1, WARM_UP_J4),
    (PRESLIDING_J2, PRESLIDING_J4),
    (BACKLASH_J3, BACKLASH_J2),
    (ELASTICITY_J1, ELASTICITY_J3),
    (SPRING_J2, SPRING_J3),
    (POSITION_FRICTION_J3, POSITION_FRICTION_J5),
    (COGGING_J4, COGGING_J6),
    (SATURATION_J2, SATURATION_J3),
    (LAG_J1, LAG_J3),
    (COUPLING_J4, COUPLING_J3),
)
"""Each family on two axes."""
APART_EFFECTS = (
    (STRIBECK_J2, LOAD_FRICTION_J3),
    (NONLINEAR_J1, COGGING_J6),
    (ASYMMETRIC_J2, POSITION_FRICTION_J3),
    (LOAD_FRICTION_J2, COUPLING_J4),
    (WARM_UP_J1, SPRING_J3),
    (PRESLIDING_J4, SATURATION_J2),
    (ELASTICITY_J1, STRIBECK_J4),
    (POSITION_FRICTION_J5, NONLINEAR_J1),
    (LAG_J1, LOAD_FRICTION_J3),
    (SATURATION_J3, SPRING_J2),
)
"""Two effects on different axes."""
TOGETHER_EFFECTS = (
    (STRIBECK_J2, SPRING_J2),
    (LOAD_FRICTION_J3, POSITION_FRICTION_J3),
    (ASYMMETRIC_J2, LOAD_FRICTION_J2),
    (NONLINEAR_J1, LAG_J1),
    (COGGING_J4, STRIBECK_J4),
    (SATURATION_J2, ASYMMETRIC_J2),
    (WARM_UP_J1, SPRING_J1),
    (POSITION_FRICTION_J5, ASYMMETRIC_J5),
    (SPRING_J3, LOAD_FRICTION_J3),
    (LAG_J3, ASYMMETRIC_J3),
)
"""Two effects on the same axis."""

CABLES = (
    _cable("cable", 2, 3, (0.12, 0.08), 14.0, 0.3),
    _cable("cable", 4, 5, (0.05, -0.05), 2.0, 0.0),
    _cable("cable", 1, 2, (0.10, 0.15), 8.0, -0.2),
    _cable("slack-cable", 2, 3, (0.10, 0.10), 25.0, 0.3),
    _cable("slack-cable", 3, 4, (-0.06, 0.05), 8.0, -0.2),
    _cable("slack-cable", 5, 6, (0.05, 0.04), 2.5, 0.2),
)
"""Cables over two joints."""
OFFSET_DRIFTS = (
    _offset_drift(1, 3.0, 120.0),
    _offset_drift(2, -6.0, 60.0),
    _offset_drift(3, 4.0, 240.0),
    _offset_drift(4, 1.0, 90.0),
    _offset_drift(5, -1.0, 40.0),
    _offset_drift(6, 0.8, 150.0),
)
"""Offsets of the current that drift."""
FREE_PLAY = (
    _backlash(1, 0.004, 40000.0, 100.0),
    _backlash(1, 0.006, 20000.0, 60.0),
    _backlash(4, 0.008, 3000.0, 4.0),
    _backlash(4, 0.012, 2000.0, 3.0),
    _backlash(5, 0.008, 2500.0, 3.0),
    _backlash(5, 0.014, 1500.0, 2.0),
)
"""Backlash where no weight holds the flanks together."""
FURTHER_EFFECTS = (*CABLES, *OFFSET_DRIFTS, *FREE_PLAY)

SIZES = frozenset(
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
"""Parameters that an effect's torque is proportional to."""


def _smaller(effect: UndeclaredEffect) -> UndeclaredEffect:
    """The same effect at SMALL of its size: what it adds to the torque, not how it is shaped."""
    parameters = dict(effect.parameters)
    match effect.name:
        case "saturation":
            parameters["half_current_a"] /= SMALL**0.5
        case "elasticity":
            parameters["stiffness_nm_per_rad"] /= SMALL
        case "spring":
            parameters["stiffness_nm_per_rad"] *= SMALL
        case "warm-up":
            parameters["cold_fraction"] *= SMALL
        case _:
            for name in SIZES & parameters.keys():
                parameters[name] *= SMALL
    return replace(effect, parameters=parameters)


def _single(kind: str, number: int, seed: int, effect: UndeclaredEffect) -> EffectCase:
    """A cell with one effect, named by its family and joint."""
    joint = effect.axis + 1
    name = f"{kind}-{number:02d}-{effect.name}-J{joint}"
    return EffectCase(name, seed, (effect,))


def _singles() -> Iterator[EffectCase]:
    effects = chain.from_iterable(SINGLE_EFFECTS)
    for number, effect in enumerate(effects):
        yield _single("single", number, 2001 + number, effect)


def _further() -> Iterator[EffectCase]:
    for number, effect in enumerate(FURTHER_EFFECTS):
        yield _single("further", number, 2301 + number, effect)


def _clean() -> Iterator[EffectCase]:
    for number in range(28):
        yield EffectCase(f"clean-{number:02d}", 2001 + number, ())


def _smalls() -> Iterator[EffectCase]:
    """The first effect of each family, with the seed that it has in SINGLES."""
    for number, (first, _) in enumerate(SINGLE_EFFECTS):
        small = _smaller(first)
        yield _single("small", number, 2001 + 2 * number, small)


def _pairs(
    kind: str, pairs: Sequence[tuple[UndeclaredEffect, UndeclaredEffect]]
) -> Iterator[EffectCase]:
    for number, (first, second) in enumerate(pairs):
        name = f"{kind}-{number:02d}-{first.name}-{second.name}"
        yield EffectCase(name, 2101 + number, (first, second))


SINGLES = tuple(_singles())
FURTHER = tuple(_further())
CLEAN = tuple(_clean())
"""The same cells without their effect:
the clean floor of each seed, and the count of false effects.
"""
SMALLS = tuple(_smalls())
APART = tuple(_pairs("apart", APART_EFFECTS))
TOGETHER = tuple(_pairs("together", TOGETHER_EFFECTS))
