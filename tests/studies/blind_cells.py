"""Cells of the effects study that nobody has chosen:
count, family, axis and size of their effects are drawn.

A seed that the author of a change has not run before shows what the search does beyond the cells
that it was made on. Sizes are relative to the axis (its friction, inertia, rated current), around
those of `effect_cells.SINGLE_EFFECTS`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence

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


def _nonlinear(axis: AxisSpec, size: float, rng: np.random.Generator) -> dict[str, float]:
    exponent = float(rng.choice([1 / 3, 2.0]))
    return {
        "torque_at_1_rad_s_nm": (0.7 if exponent < 1.0 else 0.3) * size * _dry_nm(axis),
        "exponent": exponent,
    }


FAMILIES: dict[str, Draw] = {
    "stribeck": lambda axis, size, rng: {
        "rise_nm": 0.55 * size * _dry_nm(axis),
        "speed_rad_s": float(rng.uniform(0.15, 0.3)),
    },
    "nonlinear-viscous": _nonlinear,
    "asymmetric-viscous": lambda axis, size, _: {
        "coefficient_nm_s_rad": min(0.9, 0.45 * size) * _viscous_nm_s_rad(axis)
    },
    "load-friction": lambda _, size, __: {"coefficient": 0.1 * size},
    "warm-up": lambda _, size, rng: {
        "cold_fraction": 0.6 * size,
        "time_constant_s": float(rng.uniform(40.0, 100.0)),
    },
    "presliding": lambda axis, size, rng: {
        "torque_nm": min(0.95, 0.8 * size) * axis.coulomb_nm,
        "distance_rad": float(rng.uniform(0.04, 0.1)),
    },
    "backlash": lambda axis, size, _: {
        "gap_rad": 0.0045 * size,
        "stiffness_nm_per_rad": 150_000.0 * axis.motor_inertia_kg_m2,
        "damping_nm_s_per_rad": 300.0 * axis.motor_inertia_kg_m2,
    },
    "elasticity": lambda axis, size, _: {
        "stiffness_nm_per_rad": 45_000.0 * axis.motor_inertia_kg_m2 / size,
        "damping_nm_s_per_rad": 200.0 * axis.motor_inertia_kg_m2,
    },
    "spring": lambda axis, size, rng: {
        "stiffness_nm_per_rad": 1.3 * size * _dry_nm(axis),
        "rest_rad": float(rng.uniform(-1.0, 1.0)),
    },
    "position-friction": lambda axis, size, rng: {
        "amplitude_nm": 0.33 * size * _dry_nm(axis),
        "phase_rad": float(rng.uniform(-math.pi, math.pi)),
    },
    "cogging": lambda axis, size, rng: {
        "amplitude_nm": 0.5 * size * _dry_nm(axis),
        "order": float(rng.choice([1, 2, 3, 4, 6])),
        "phase_rad": float(rng.uniform(-math.pi, math.pi)),
    },
    "saturation": lambda axis, size, _: {
        "half_current_a": 4.2 * axis.rated_current_a / math.sqrt(size)
    },
    "lag": lambda _, size, __: {"time_constant_s": 0.008 * size},
    "coupling": lambda axis, size, _: {
        "coulomb_nm": 0.35 * size * _dry_nm(axis),
        "viscous_nm_s_rad": 0.5 * size * _viscous_nm_s_rad(axis),
    },
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
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,)))
        truth = int(rng.integers(10_000, 2**31))
        while True:
            effects = tuple(
                _drawn(clean.axes, rng)
                for _ in range(rng.choice(len(EFFECT_COUNTS), p=EFFECT_COUNTS))
            )
            if len({(effect.name, effect.axis) for effect in effects}) < len(effects):
                continue
            case = EffectCase(f"blind-{seed}-{number:02d}", truth, effects)
            try:
                spec = case.spec("measurement", None, 0)
                Plant(spec)
            except SpecInvalid:  # two flexible drives on one motor
                continue
            break
        cases.append(case)
    return tuple(cases)


def _drawn(axes: Sequence[AxisSpec], rng: np.random.Generator) -> UndeclaredEffect:
    name = str(rng.choice(list(FAMILIES)))
    axis = int(rng.integers(len(axes)))
    size = float(np.exp(rng.uniform(*np.log(SIZE))))
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
        missed = [one for one in true if one not in named]
        spare = [one for one in named if one not in true]
        for one in set(true) & set(named):
            pairs[_family(one), _family(one)] += 1
        for one in missed:
            other = next((name for name in spare if set(_axes(name)) & set(_axes(one))), None)
            if other is not None:
                spare.remove(other)
            pairs[_family(one), NOTHING if other is None else _family(other)] += 1
        for one in spare:
            pairs[NOTHING, _family(one)] += 1
    rows, columns = (
        sorted({pair[side] for pair in pairs}, key=lambda name: (name == NOTHING, name))
        for side in (0, 1)
    )
    lines = ["| true \\ named | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    texts = ([str(pairs[row, column] or "") for column in columns] for row in rows)
    return "\n".join(
        [
            *lines,
            *(f"| {row} | {' | '.join(cells)} |" for row, cells in zip(rows, texts, strict=True)),
        ]
    )


def _family(placed: str) -> str:
    return placed.partition(" on ")[0]


def _axes(placed: str) -> list[str]:
    return placed.partition(" on ")[2].split("+")
