"""The dictionary of effects beyond rigid links, viscous and dry friction and offset."""

from __future__ import annotations

from ident.effects.asymmetric_viscous import AsymmetricViscous
from ident.effects.cogging import Cogging
from ident.effects.effect import Effect
from ident.effects.lag import Lag
from ident.effects.load_friction import LoadFriction
from ident.effects.nonlinear_viscous import NonlinearViscous
from ident.effects.position_friction import PositionFriction
from ident.effects.saturation import Saturation
from ident.effects.spring import Spring
from ident.effects.stribeck import Stribeck

EFFECTS: tuple[tuple[Effect, ...], ...] = (
    tuple(Stribeck(speed_rad_s) for speed_rad_s in (0.05, 0.08, 0.12, 0.2, 0.3, 0.5)),
    tuple(NonlinearViscous(exponent) for exponent in (1 / 3, 0.5, 2.0, 3.0)),
    (AsymmetricViscous(),),
    (LoadFriction(),),
    (Spring(),),
    (PositionFriction(),),
    tuple(Cogging(order) for order in (1, 2, 3, 4, 5, 6, 8, 10, 12)),
    (Saturation(),),
    (Lag(),),
)
"""A family a row; within it, the candidates of its searched parameters. Adding an effect is a file and a line here."""
