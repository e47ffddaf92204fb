"""The dictionary of effects beyond rigid links, viscous and dry friction and offset.

Before an effect is added: it may exist as a setting of another one, and a test refuses two effects
with the same columns. Then:

1. Write one class in the chapter of its physics (`friction`, `position`, `transmission`,
   `electrical`). It derives from `Effect`; its docstring states equation, sign, source and
   signature; the class sets `name`, `declares`, `abscissa` and `coefficients` (and `side`, if it
   does not act on its joint) and defines `columns`. Fields with a `Range` are its searched
   parameters.
2. Add its family to EFFECTS, with the values of its searched parameters that the search tries.

Search, refit, prediction, calibration files and reports then know it. The tests ask for more:

- a recording with the effect, planted by a formula of your own, in
  `tests/ident/discovery/test_planted.py`;
- its name in `EITHER_SIGN` of `tests/ident/discovery/test_gates.py`, if a coefficient may be
  negative;
- its name in `tests/ident/discovery/test_braking.py`, if it is friction by speed and position;
- a row in `docs/explanation/effects.md`.

A phrase for reports may go into `daq/report/effect_names.py`.
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
    """Make a family: an effect with every combination of values of its searched parameters.

    Args:
        effect: the class.
        values: of each parameter, by its name; those of the last one change fastest.
    """
    members: list[Effect] = []
    for combination in product(*values.values()):
        settings = dict(zip(values, combination, strict=True))
        members.append(effect(**settings))
    return tuple(members)


MOTOR_ORDERS = (1, 2, 3, 4, 5, 6, 8, 10, 12)
"""Orders of cogging: periods per motor revolution."""
SECOND_JOINTS = range(2, 13)
"""Number of an effect's second joint; the search leaves out pairs that a robot lacks."""

LATE_S = (0.001, 0.004, 0.012, 0.05)
"""Time constants of a late current; refinement finds the values between."""
EARLY_S = (0.001, 0.003, 0.01)
"""Time constants of an early current; refinement finds the values between."""

FADING_S = (20.0, 40.0, 80.0, 160.0, 320.0, 900.0)
"""Time constants of effects that fade after power-on."""
CABLE_DIRECTIONS_RAD = (np.pi / 4 * np.arange(-3, 4, 2)).tolist()
"""Directions of a slack cable over two joints: −135°, −45°, 45° and 135°.

Each joint makes an equal share of its path, in the same sense or in opposite ones.
"""
#: Positions beyond which a hinge acts
HINGE_STARTS_RAD = np.linspace(-2.5, 2.5, 11).tolist()
COUNTERBALANCE_PHASES_RAD = np.linspace(-np.pi, np.pi, 6, endpoint=False).tolist()

LAGS = (
    *family(electrical.Lag, filter_s=LATE_S, backwards=(0,)),
    *family(electrical.Lag, filter_s=EARLY_S, backwards=(1,)),
)
TIME_SKEWS = (
    *family(electrical.TimeSkew, filter_s=LATE_S, backwards=(0,)),
    *family(electrical.TimeSkew, filter_s=EARLY_S, backwards=(1,)),
)

EFFECTS: tuple[Family, ...] = (
    family(friction.Stribeck, speed_rad_s=(0.05, 0.08, 0.12, 0.2, 0.3, 0.5)),
    family(friction.NonlinearViscous, exponent=(1 / 3, 0.5, 2.0, 3.0)),
    family(friction.AsymmetricViscous),
    family(friction.LoadFriction, speed_exponent=(0, 1)),
    family(position.Spring),
    family(position.PassiveSpring),
    family(friction.PositionFriction),
    family(electrical.Cogging, order=MOTOR_ORDERS),
    # ident.discovery.ripple proposes more periods.
    family(transmission.Ripple, order=(0.5,)),
    # The form of one term, and that of two
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
    family(friction.Coupling, other_axis=SECOND_JOINTS, sense=(1, -1)),
    family(transmission.InertialCoupling, other_axis=SECOND_JOINTS),
    family(position.Hinge, start_rad=HINGE_STARTS_RAD, sense=(1, -1)),
    family(position.Cable, other_axis=SECOND_JOINTS),
    # ident.discovery.cables proposes more directions.
    family(position.SlackCable, other_axis=SECOND_JOINTS, direction_rad=CABLE_DIRECTIONS_RAD),
    family(position.Compensator, order=(1, 2)),
    # ident.discovery.balancer proposes more geometries.
    family(position.Counterbalance, ratio=(0.2, 0.5), phase_rad=COUNTERBALANCE_PHASES_RAD),
)
"""Families in the order of the search, with the values of their searched parameters that it tries.

Modules of `ident.discovery` propose more values of some, by what fits the residual best.
"""

GEOMETRY: tuple[Family, ...] = (
    family(geometry_corrections.ZeroOffset),
    family(geometry_corrections.GravityDirection),
    family(geometry_corrections.LatePosition),
)
"""Effects that correct the geometry of the robot's description (`geometry_corrections`)."""

SMOOTH_VARIABLES = tuple(
    variable for variable in Abscissa if variable is not Abscissa.OTHER_ACCELERATION
)
"""Variables of a smooth term; one of another joint's acceleration is inertial coupling."""
SMOOTH_TERMS = tuple(Smooth(variable) for variable in SMOOTH_VARIABLES)

UNNAMED: Family = (Periodic(), *SMOOTH_TERMS)
"""Terms that fit anything, for structure in a residual that no named effect explains."""
