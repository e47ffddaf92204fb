"""Cells of the effects study that nobody has chosen:
count, family, axis and size of their effects are drawn.

A seed that the author of a change has not run before shows what the search does beyond the cells
that it was made on. Sizes are relative to the axis (its friction, inertia, rated current), around
those of `effect_cells.SINGLE_EFFECTS`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from daq.simulation.simulation_file import load_simulation, shipped_simulation
from drivers.simulation.plant import Plant
from drivers.simulation.spec import AxisSpec, SpecInvalid, UndeclaredEffect
from tests.studies.effect_cells import EffectCase

EFFECT_COUNTS = (0.3, 0.4, 0.2, 0.1)
"""Probabilities of none, one, two and three effects."""
SIZE = (0.4, 1.6)
"""Range of the relative size, logarithmically uniform."""
NOTHING = "–"

Draw = Callable[[AxisSpec, float, np.random.Generator], dict[str, float]]
"""Parameters of an effect on an axis, for a relative size."""


def _dry_nm(axis: AxisSpec) -> float:
    return axis.coulomb_nm + axis.motor_coulomb_nm


def _viscous_nm_s_rad(axis: AxisSpec) -> float:
    return axis.viscous_nm_s_rad + axis.motor_viscous_nm_s_rad


def _stribeck(axis: AxisSpec, size: float, rng: np.random.Generator) -> dict[str, float]:
    rise_nm = 0.55 * size * _dry_nm(axis)
    speed_rad_s = float(rng.uniform(0.15, 0.3))
    return {"rise_nm": rise_nm, "speed_rad_s": speed_rad_s}


def _nonlinear(axis: AxisSpec, size: float, rng: np.random.Generator) -> dict[str, float]:
    exponent = float(rng.choice([1 / 3, 2.0]))
    if exponent < 1.0:
        share = 0.7
    else:
        share = 0.3
    torque_nm = share * size * _dry_nm(axis)
    return {"torque_at_1_rad_s_nm": torque_nm, "exponent": exponent}


def _asymmetric(axis: AxisSpec, size: float, _: np.random.Generator) -> dict[str, float]:
    share = min(0.9, 0.45 * size)
    return {"coefficient_nm_s_rad": share * _viscous_nm_s_rad(axis)}


def _load_friction(_: AxisSpec, size: float, __: np.random.Generator) -> dict[str, float]:
    return {"coefficient": 0.1 * size}


def _warm_up(_: AxisSpec, size: float, rng: np.random.Generator) -> dict[str, float]:
    time_constant_s = float(rng.uniform(40.0, 100.0))
    return {"cold_fraction": 0.6 * size, "time_constant_s": time_constant_s}


def _presliding(axis: AxisSpec, size: float, rng: np.random.Generator) -> dict[str, float]:
    torque_nm = min(0.95, 0.8 * size) * axis.coulomb_nm
    distance_rad = float(rng.uniform(0.04, 0.1))
    return {"torque_nm": torque_nm, "distance_rad": distance_rad}


def _backlash(axis: AxisSpec, size: float, _: np.random.Generator) -> dict[str, float]:
    inertia_kg_m2 = axis.motor_inertia_kg_m2
    return {
        "gap_rad": 0.0045 * size,
        "stiffness_nm_per_rad": 150_000.0 * inertia_kg_m2,
        "damping_nm_s_per_rad": 300.0 * inertia_kg_m2,
    }


def _elasticity(axis: AxisSpec, size: float, _: np.random.Generator) -> dict[str, float]:
    inertia_kg_m2 = axis.motor_inertia_kg_m2
    return {
        "stiffness_nm_per_rad": 45_000.0 * inertia_kg_m2 / size,
        "damping_nm_s_per_rad": 200.0 * inertia_kg_m2,
    }


def _spring(axis: AxisSpec, size: float, rng: np.random.Generator) -> dict[str, float]:
    stiffness_nm_per_rad = 1.3 * size * _dry_nm(axis)
    rest_rad = float(rng.uniform(-1.0, 1.0))
    return {"stiffness_nm_per_rad": stiffness_nm_per_rad, "rest_rad": rest_rad}


def _position_friction(axis: AxisSpec, size: float, rng: np.random.Generator) -> dict[str, float]:
    amplitude_nm = 0.33 * size * _dry_nm(axis)
    phase_rad = float(rng.uniform(-math.pi, math.pi))
    return {"amplitude_nm": amplitude_nm, "phase_rad": phase_rad}


def _cogging(axis: AxisSpec, size: float, rng: np.random.Generator) -> dict[str, float]:
    amplitude_nm = 0.5 * size * _dry_nm(axis)
    order = float(rng.choice([1, 2, 3, 4, 6]))
    phase_rad = float(rng.uniform(-math.pi, math.pi))
    return {"amplitude_nm": amplitude_nm, "order": order, "phase_rad": phase_rad}


def _saturation(axis: AxisSpec, size: float, _: np.random.Generator) -> dict[str, float]:
    half_current_a = 4.2 * axis.rated_current_a / math.sqrt(size)
    return {"half_current_a": half_current_a}


def _lag(_: AxisSpec, size: float, __: np.random.Generator) -> dict[str, float]:
    return {"time_constant_s": 0.008 * size}


def _coupling(axis: AxisSpec, size: float, _: np.random.Generator) -> dict[str, float]:
    coulomb_nm = 0.35 * size * _dry_nm(axis)
    viscous_nm_s_rad = 0.5 * size * _viscous_nm_s_rad(axis)
    return {"coulomb_nm": coulomb_nm, "viscous_nm_s_rad": viscous_nm_s_rad}


FAMILIES: dict[str, Draw] = {
    "stribeck": _stribeck,
    "nonlinear-viscous": _nonlinear,
    "asymmetric-viscous": _asymmetric,
    "load-friction": _load_friction,
    "warm-up": _warm_up,
    "presliding": _presliding,
    "backlash": _backlash,
    "elasticity": _elasticity,
    "spring": _spring,
    "position-friction": _position_friction,
    "cogging": _cogging,
    "saturation": _saturation,
    "lag": _lag,
    "coupling": _coupling,
}
"""Parameters of every family of the simulated plant; `coupling` gets its other joint besides."""


def blind_cases(seed: int, count: int) -> tuple[EffectCase, ...]:
    """Draw cells; the first of a seed are the same, however many are drawn.

    Raises:
        ConfigurationError: from the clean cell's file.
    """
    clean = load_simulation(shipped_simulation("clean"))
    cases = []
    for number in range(count):
        sequence = np.random.SeedSequence(seed, spawn_key=(number,))
        rng = np.random.default_rng(sequence)
        truth = int(rng.integers(10_000, 2**31))
        name = f"blind-{seed}-{number:02d}"
        case = None
        while case is None or not _can_be_built(case):
            effects = _drawn_effects(clean.axes, rng)
            case = EffectCase(name, truth, effects)
        cases.append(case)
    return tuple(cases)


def _can_be_built(case: EffectCase) -> bool:
    """Whether no effect is on its axis twice, and no motor has two flexible drives."""
    places = {(effect.name, effect.axis) for effect in case.effects}
    if len(places) < len(case.effects):
        return False
    try:
        spec = case.spec("measurement", None, 0)
        Plant(spec)
    except SpecInvalid:
        return False
    return True


def _drawn_effects(
    axes: Sequence[AxisSpec], rng: np.random.Generator
) -> tuple[UndeclaredEffect, ...]:
    count = rng.choice(len(EFFECT_COUNTS), p=EFFECT_COUNTS)
    return tuple(_drawn(axes, rng) for _ in range(count))


def _drawn(axes: Sequence[AxisSpec], rng: np.random.Generator) -> UndeclaredEffect:
    name = str(rng.choice(list(FAMILIES)))
    axis = int(rng.integers(len(axes)))
    logarithm = rng.uniform(*np.log(SIZE))
    size = float(np.exp(logarithm))
    if name == "coupling":
        axis = max(axis, 1)
    parameters = FAMILIES[name](axes[axis], size, rng)
    if name == "coupling":
        parameters["other_axis"] = float(axis)  # the joint before it, counted from 1
    return UndeclaredEffect(name, axis, parameters)


def confusion(cells: Sequence[tuple[tuple[str, ...], tuple[str, ...]]]) -> str:
    """Return a Markdown table of true effects against what was named.

    An effect that was named on its axis is found. Of the other names, each true effect takes one on
    its own axis, or is missed; what is left over is false.

    Args:
        cells: true effects and named ones of each cell, as `family on J3`.
    """
    pairs: Counter[tuple[str, str]] = Counter()
    for true, named in cells:
        pairs.update(_pairs_of(true, named))
    true_families = {true for true, _ in pairs}
    named_families = {named for _, named in pairs}
    columns = _nothing_last(named_families)
    headings = " | ".join(columns)
    lines = [f"| true \\ named | {headings} |"]
    lines.append("|---" * (len(columns) + 1) + "|")
    for row in _nothing_last(true_families):
        counts = [str(pairs[row, column] or "") for column in columns]
        joined_counts = " | ".join(counts)
        lines.append(f"| {row} | {joined_counts} |")
    return "\n".join(lines)


def _pairs_of(true: Sequence[str], named: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Families of each true effect of a cell and of what was named for it."""
    missed = [one for one in true if one not in named]
    spare = [one for one in named if one not in true]
    for found in set(true) & set(named):
        yield _family(found), _family(found)
    for one in missed:
        taken = _on_an_axis_of(one, spare)
        if taken is None:
            yield _family(one), NOTHING
        else:
            spare.remove(taken)
            yield _family(one), _family(taken)
    for one in spare:
        yield NOTHING, _family(one)


def _on_an_axis_of(effect: str, others: Iterable[str]) -> str | None:
    """The first of the others that is on an axis of this effect."""
    axes = set(_axes(effect))
    for other in others:
        if not axes.isdisjoint(_axes(other)):
            return other
    return None


def _nothing_last(families: Iterable[str]) -> list[str]:
    return sorted(families, key=lambda family: (family == NOTHING, family))


def _family(placed: str) -> str:
    return placed.partition(" on ")[0]


def _axes(placed: str) -> list[str]:
    return placed.partition(" on ")[2].split("+")
