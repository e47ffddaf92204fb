"""What a plant may do that no configuration declares: made by physics, a file each."""

from __future__ import annotations

from dataclasses import MISSING, fields

from drivers.simulated.effects.asymmetric_viscous import AsymmetricViscous
from drivers.simulated.effects.cogging import Cogging
from drivers.simulated.effects.coupling import Coupling
from drivers.simulated.effects.flexible_drive import Backlash, Elasticity
from drivers.simulated.effects.lag import Lag
from drivers.simulated.effects.load_friction import LoadFriction
from drivers.simulated.effects.nonlinear_viscous import NonlinearViscous
from drivers.simulated.effects.position_friction import PositionFriction
from drivers.simulated.effects.presliding import Presliding
from drivers.simulated.effects.saturation import Saturation
from drivers.simulated.effects.spring import Spring
from drivers.simulated.effects.stribeck import Stribeck
from drivers.simulated.effects.warm_up import WarmUp
from drivers.simulated.errors import EffectUnknown
from drivers.simulated.spec import UndeclaredEffect

Effect = (
    Stribeck
    | LoadFriction
    | NonlinearViscous
    | AsymmetricViscous
    | Spring
    | PositionFriction
    | Cogging
    | Saturation
    | Lag
    | WarmUp
    | Presliding
    | Backlash
    | Elasticity
    | Coupling
)

EFFECTS: tuple[tuple[str, type[Effect]], ...] = (
    ("stribeck", Stribeck),
    ("load-friction", LoadFriction),
    ("nonlinear-viscous", NonlinearViscous),
    ("asymmetric-viscous", AsymmetricViscous),
    ("spring", Spring),
    ("position-friction", PositionFriction),
    ("cogging", Cogging),
    ("saturation", Saturation),
    ("lag", Lag),
    ("warm-up", WarmUp),
    ("presliding", Presliding),
    ("backlash", Backlash),
    ("elasticity", Elasticity),
    ("coupling", Coupling),
)
"""Name in a simulation file, and the physics."""

STATE_FIELDS = frozenset({"axis", "bristle", "value_a"})
"""Fields of an effect that are its place or its state, not its parameters."""


def build_effect(effect: UndeclaredEffect, axes: int) -> Effect:
    """The physics of an undeclared effect.

    Args:
        effect: name, joint and parameters.
        axes: number of joints of the cell.

    Raises:
        EffectUnknown: the name, a parameter or the axis does not exist, or a parameter is missing.
    """
    kinds = dict(EFFECTS)
    kind = kinds.get(effect.name)
    if kind is None:
        raise EffectUnknown(f"undeclared effect {effect.name!r} does not exist; there are {', '.join(kinds)}")
    if not 0 <= effect.axis < axes:
        raise EffectUnknown(f"{effect.name}: axis {effect.axis + 1} does not exist; the cell has axes 1 to {axes}")
    known = {f.name: f.default is MISSING for f in fields(kind) if f.init and f.name not in STATE_FIELDS}
    unknown = sorted(set(effect.parameters) - set(known))
    missing = [name for name, needed in known.items() if needed and name not in effect.parameters]
    if unknown or missing:
        raise EffectUnknown(
            f"{effect.name}: "
            + "; ".join(
                text
                for text in (
                    f"unknown parameter {', '.join(unknown)}" if unknown else "",
                    f"missing parameter {', '.join(missing)}" if missing else "",
                )
                if text
            )
            + f"; its parameters are {', '.join(known)}"
        )
    built: Effect = kind(axis=effect.axis, **effect.parameters)
    if isinstance(built, Coupling) and (not 0 <= built.other < axes or built.other == built.axis):
        raise EffectUnknown(f"{effect.name}: other_axis {built.other_axis:g} is not another axis from 1 to {axes}")
    return built
