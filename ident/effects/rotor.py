"""The rotor in the load: a loss at the gear grows with the torque behind it,
and the rotor is before it.

A base parameter is named after its leading standard one. On an axis whose rotor moves as its link
does, as on the first two axes of a serial arm and on the cranks of a closed chain, the rotor's
inertia Ia is part of a base parameter of the links. The predicted torque for links and payload τ_L
then contains Ia q̈, and a loss that multiplies it is wrong:

    c |τ_L − Ia q̈| sign(q̇)   is in the current,   c |τ_L| sign(q̇)   would be fitted.

The motion alone does not show how a base parameter divides into link and rotor; the loss does.
Around a first guess J, with d = c (Ia − J),

    c |τ_L − Ia q̈|  ≈  c |τ_L − J q̈| − d q̈ sign(τ_L − J q̈).

Both columns are linear, so c and d are fitted together with everything else, and the σ of c, and
that of the gains, contains what the data leave open about the rotor. J + d/c is the next guess; at
the last one d is zero within its σ (Gauss-Newton). Effects that speak of the load or the inertia
behind the gear, as `elasticity`, then leave J out, too.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from ident.arrays import FloatArray
from ident.effects.effect import PlacedEffect
from ident.effects.signals import Signals

DIGITS = 4  #: Of a rotor's inertia, as a calibration shows it


def loss_columns(
    signals: Signals,
    axis: int,
    torque_nm: FloatArray,
    rubbing: FloatArray,
    inertia_kg_m2: float,
    *,
    with_rotor: bool,
) -> FloatArray:
    """Columns of a loss that grows with the torque behind a gear, shape (1 or 2, k).

    Args:
        signals: of a run.
        axis: index of the joint.
        torque_nm: torque at the joint that contains the rotor's, shape (k,).
        rubbing: direction of the loss, with its dependence on speed, shape (k,).
        inertia_kg_m2: J, the present guess of the rotor's inertia.
        with_rotor: whether the column of d is there.
    """
    acceleration_rad_s2 = signals.acceleration_rad_s2[axis]
    through_nm = torque_nm - inertia_kg_m2 * acceleration_rad_s2
    loss = np.abs(through_nm) * rubbing
    if not with_rotor:
        return np.asarray(loss[None])
    remainder = -acceleration_rad_s2 * np.sign(through_nm) * rubbing
    return np.stack((loss, remainder))


def least_rotor_rest(inertia_kg_m2: float) -> float:
    """Return the least d that is possible beside a guess J of a rotor's inertia [kg m²].

    A rotor's inertia J + d/c is not negative. Beside J = 0 that is d ≥ 0; beside any other J, d is
    zero within its σ, because J follows it.
    """
    return 0.0 if inertia_kg_m2 == 0.0 else -math.inf


def next_inertia(inertia_kg_m2: float, coefficients: FloatArray, largest_kg_m2: float) -> float:
    """Return the next guess J + d/c of a rotor's inertia [kg m²], between zero and the largest;
    J where c is not > 0.

    Args:
        inertia_kg_m2: J.
        coefficients: c and d, shape (2,).
        largest_kg_m2: largest inertia that the rotor can have.
    """
    loss, remainder = coefficients
    if not loss > 0.0:
        return inertia_kg_m2
    guess = float(np.clip(inertia_kg_m2 + remainder / loss, 0.0, largest_kg_m2))
    return float(f"{guess:.{DIGITS}g}")


def known_rotors(effects: Iterable[PlacedEffect], axes: int) -> tuple[float, ...]:
    """Return the inertia of each axis' rotor that losses of a model show [kg m²],
    0 where none does; empty without any.

    Args:
        effects: of the model; the first loss on an axis counts.
        axes: number of axes.
    """
    known: dict[int, float] = {}
    for placed in effects:
        inertia_kg_m2 = placed.effect.known_rotor_kg_m2
        if inertia_kg_m2:
            known.setdefault(placed.axis, inertia_kg_m2)
    if not known:
        return ()
    return tuple(known.get(axis, 0.0) for axis in range(axes))


def beside_rotors(signals: Signals, effects: Iterable[PlacedEffect]) -> Signals:
    """Return signals of a run that know the rotors which losses of the model show."""
    known = known_rotors(effects, len(signals.current_a))
    if known:
        return replace(signals, rotor_inertia_kg_m2=known)
    return signals


def beside_rotor(signals: Signals, axis: int, inertia_kg_m2: float) -> Signals:
    """Return signals of a run that know the rotor of one axis;
    the same signals for an inertia of 0.
    """
    if not inertia_kg_m2:
        return signals
    known = [signals.rotor_inertia(index) for index in range(len(signals.current_a))]
    known[axis] = inertia_kg_m2
    return replace(signals, rotor_inertia_kg_m2=tuple(known))
