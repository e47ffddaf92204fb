"""The dictionary of effects beyond rigid links, viscous and dry friction and offset.

To add an effect, look for it among the settings of the others first; a test refuses the same
columns twice. Then:

1. Write one class in the chapter of its physics (`friction`, `position`, `transmission`,
   `electrical`). It derives from `Effect`; its docstring states equation, sign, source and
   signature; the class sets `name`, `declares`, `abscissa` and `coefficients` (and `side`, if it
   does not act on its joint) and defines `columns`. Fields with a `Range` are its searched
   parameters.
2. Add its family to EFFECTS, with the values of its searched parameters that the search tries.

Search, refit, prediction, calibration files and reports then know it. The tests ask for one thing
more: a recording with the effect, planted by a formula of your own, in
`tests/ident/discovery/test_planted.py`. A phrase for reports may go into
`daq/report/effect_names.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product

import numpy as np

from ident.effects import electrical, friction, geometry_corrections, position, transmission
from ident.effects.effect import Effect
from ident.effects.signals import Abscissa
from ident.effects.unnamed import Periodic, Smooth

Family = tuple[Effect, ...]
"""Effects of one name, with the values of their searched parameters that the search tries."""


def family(effect: Callable[..., Effect], **values: Sequence[float]) -> Family:
    """Make an effect with every combination of values of its searched parameters.

    Args:
        effect: the class.
        values: of each parameter, by its name; those of the last one change fastest.
    """
    members: list[Effect] = []
    for combination in product(*values.values()):
        settings = dict(zip(values, combination, strict=True))
        members.append(effect(**settings))
    return tuple(members)


ORDERS = (1, 2, 3, 4, 5, 6, 8, 10, 12)
PAIRED = range(2, 13)
"""Higher number of a pair of joints; pairs that a robot lacks are left out of its search."""

LATE_S = (0.001, 0.004, 0.012, 0.05)
EARLY_S = (0.001, 0.003, 0.01)
"""Time constants of a late current, and of an early one; those between are found by refinement."""

FADING_S = (20.0, 40.0, 80.0, 160.0, 320.0, 900.0)  #: Time constants of what fades after power-on
CABLE_DIRECTIONS_RAD = (np.pi / 4 * np.arange(-3, 4, 2)).tolist()
"""Directions of a slack cable over two joints: both make as much of its way, in either sense."""

LAGS = (
    *family(electrical.Lag, filter_s=LATE_S, backwards=(0,)),
    *family(electrical.Lag, filter_s=EARLY_S, backwards=(1,)),
)
TIME_SKEWS = (
    *family(electrical.TimeSkew, filter_s=LATE_S, backwards=(0,)),
    *family(electrical.TimeSkew, filter_s=EARLY_S, backwards=(1,)),
)

HINGE_STARTS_RAD = np.linspace(-2.5, 2.5, 11).tolist()
COUNTERBALANCE_PHASES_RAD = np.linspace(-np.pi, np.pi, 6, endpoint=False).tolist()

EFFECTS: tuple[Family, ...] = (
    family(friction.Stribeck, speed_rad_s=(0.05, 0.08, 0.12, 0.2, 0.3, 0.5)),
    family(friction.NonlinearViscous, exponent=(1 / 3, 0.5, 2.0, 3.0)),
    family(friction.AsymmetricViscous),
    family(friction.LoadFriction, speed_exponent=(0, 1)),
    family(position.Spring),
    family(position.PassiveSpring),
    family(friction.PositionFriction),
    family(electrical.Cogging, order=ORDERS),
    family(transmission.Ripple, order=(0.5,)),  # and periods of ident.discovery.ripple
    electrical.Saturation(two_terms=1).forms,
    family(electrical.OffsetDrift, time_constant_s=FADING_S, whole_session=(0, 1)),
    LAGS,
    TIME_SKEWS,
    family(friction.WarmUp, time_constant_s=FADING_S, whole_session=(0, 1)),
    family(friction.TemperatureFriction),
    family(friction.PassiveFriction),
    family(friction.Presliding, distance_rad=(0.005, 0.01, 0.02, 0.04, 0.08, 0.16)),
    family(transmission.Backlash, share=(0.02, 0.05, 0.15, 0.4)),
    family(transmission.Elasticity),
    family(transmission.Efficiency, friction_share=(0.5, 1.0)),
    family(friction.Coupling, other_axis=PAIRED, sense=(1, -1)),
    family(transmission.InertialCoupling, other_axis=PAIRED),
    family(position.Hinge, start_rad=HINGE_STARTS_RAD, sense=(1, -1)),
    family(position.Cable, other_axis=PAIRED),
    # and directions of ident.discovery.cables
    family(position.SlackCable, other_axis=PAIRED, direction_rad=CABLE_DIRECTIONS_RAD),
    family(position.Compensator, order=(1, 2)),
    # and geometries of ident.discovery.balancer
    family(position.Counterbalance, ratio=(0.2, 0.5), phase_rad=COUNTERBALANCE_PHASES_RAD),
)
"""One family a row, with the values of its searched parameters that the search tries.

Where modules of `ident.discovery` are named, they propose more, by what fits the residual best.
"""

GEOMETRY: tuple[Family, ...] = (
    family(geometry_corrections.ZeroOffset),
    family(geometry_corrections.GravityDirection),
    family(geometry_corrections.LatePosition),
)
"""What the description may have wrong: effects that correct it (`geometry_corrections`)."""

SMOOTH_VARIABLES = tuple(
    variable for variable in Abscissa if variable is not Abscissa.OTHER_ACCELERATION
)
"""Variables of a smooth term; what follows the acceleration of another joint is its inertia."""
UNNAMED: Family = (Periodic(), *(Smooth(variable) for variable in SMOOTH_VARIABLES))
"""Terms that fit anything: for structure in a residual that no name explains."""
