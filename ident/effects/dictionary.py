"""The dictionary of effects beyond rigid links, viscous and dry friction and offset.

To add an effect, look for it among the settings of the others first; a test refuses the same
columns twice. Then:

1. Write one class in the chapter of its physics (`friction`, `position`, `transmission`,
   `electrical`). It derives from `Effect`; its docstring states equation, sign, source and
   signature; the class sets `name`, `declares`, `abscissa` and `coefficients` (and `side`, if it
   does not act on its joint) and defines `columns`. Fields with a `Range` are its searched
   parameters.
2. Add one line to EFFECTS: the family, with the values of its searched parameters that the search
   tries.

Search, refit, prediction, calibration files and reports then know it. The tests ask for one thing
more: a recording with the effect, planted by a formula of your own, in
`tests/ident/discovery/test_planted.py`. A phrase for reports may go into
`daq/report/effect_names.py`.
"""

from __future__ import annotations

import numpy as np

from ident.effects import electrical, friction, geometry_corrections, position, transmission
from ident.effects.effect import Effect
from ident.effects.signals import Abscissa
from ident.effects.unnamed import Periodic, Smooth

ORDERS = (1, 2, 3, 4, 5, 6, 8, 10, 12)
PAIRED = range(2, 13)
"""The higher number of a pair of joints;
pairs that a robot does not have are left out of its search.
"""

FILTERS = (
    *((filter_s, 0) for filter_s in (0.001, 0.004, 0.012, 0.05)),
    *((filter_s, 1) for filter_s in (0.001, 0.003, 0.01)),
)
"""Time constants of a late current, and of an early one; those between are found by refinement."""

FADING_S = (20.0, 40.0, 80.0, 160.0, 320.0, 900.0)  #: Time constants of what fades after power-on
CABLE_DIRECTIONS_RAD = (np.pi / 4 * np.arange(-3, 4, 2)).tolist()
"""Directions of a slack cable over two joints: both make as much of its way, in either sense."""

EFFECTS: tuple[tuple[Effect, ...], ...] = (
    tuple(friction.Stribeck(speed_rad_s) for speed_rad_s in (0.05, 0.08, 0.12, 0.2, 0.3, 0.5)),
    tuple(friction.NonlinearViscous(exponent) for exponent in (1 / 3, 0.5, 2.0, 3.0)),
    (friction.AsymmetricViscous(),),
    tuple(friction.LoadFriction(speed_exponent) for speed_exponent in (0, 1)),
    (position.Spring(),),
    (position.PassiveSpring(),),
    (friction.PositionFriction(),),
    tuple(electrical.Cogging(order) for order in ORDERS),
    (transmission.Ripple(0.5),),  # and what the periodogram proposes (ident.discovery.ripple)
    electrical.Saturation(two_terms=1).forms,
    tuple(electrical.OffsetDrift(constant_s, whole) for constant_s in FADING_S for whole in (0, 1)),
    tuple(electrical.Lag(filter_s, backwards) for filter_s, backwards in FILTERS),
    tuple(electrical.TimeSkew(filter_s, backwards) for filter_s, backwards in FILTERS),
    tuple(friction.WarmUp(constant_s, whole) for constant_s in FADING_S for whole in (0, 1)),
    (friction.TemperatureFriction(),),
    (friction.PassiveFriction(),),
    tuple(
        friction.Presliding(distance_rad) for distance_rad in (0.005, 0.01, 0.02, 0.04, 0.08, 0.16)
    ),
    tuple(transmission.Backlash(share) for share in (0.02, 0.05, 0.15, 0.4)),
    (transmission.Elasticity(),),
    tuple(transmission.Efficiency(friction_share) for friction_share in (0.5, 1.0)),
    tuple(friction.Coupling(other, sense) for other in PAIRED for sense in (1, -1)),
    tuple(transmission.InertialCoupling(other) for other in PAIRED),
    tuple(
        position.Hinge(start_rad, sense)
        for start_rad in np.linspace(-2.5, 2.5, 11).tolist()
        for sense in (1, -1)
    ),
    tuple(position.Cable(other) for other in PAIRED),
    tuple(
        position.SlackCable(other, direction_rad)
        for other in PAIRED
        for direction_rad in CABLE_DIRECTIONS_RAD
    ),
    # and what fits the residual best (ident.discovery.cables)
    tuple(position.Compensator(order) for order in (1, 2)),
    # and what fits the residual best (ident.discovery.balancer)
    tuple(
        position.Counterbalance(ratio, phase_rad)
        for ratio in (0.2, 0.5)
        for phase_rad in np.linspace(-np.pi, np.pi, 6, endpoint=False).tolist()
    ),
)
"""One family a row, with the values of its searched parameters that the search tries."""

GEOMETRY: tuple[tuple[Effect, ...], ...] = (
    (geometry_corrections.ZeroOffset(),),
    (geometry_corrections.GravityDirection(),),
    (geometry_corrections.LatePosition(),),
)
"""What the description may have wrong: such an effect corrects it
(`ident.effects.geometry_corrections`).
"""

UNNAMED: tuple[Effect, ...] = (Periodic(), *(Smooth(variable) for variable in Abscissa))
"""Terms that fit anything: what a calibration holds where structure was found that no name
explains.
"""
