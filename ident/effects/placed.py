"""An effect and the axis that it acts on."""

from __future__ import annotations

from dataclasses import dataclass

from ident.effects.effect import Effect
from ident.model import Column


@dataclass(frozen=True, slots=True)
class PlacedEffect:
    """An effect on an axis (index from 0)."""

    effect: Effect
    axis: int

    @property
    def columns(self) -> tuple[Column, ...]:
        """Its linear parameters, named after effect, axis and settings: an axis may have cogging of two orders."""
        name, number = self.effect.name, self.axis + 1
        settings = ", ".join(f"{key} {value:.6g}" for key, value in self.effect.settings.items())
        suffix = f" ({settings})" if settings else ""
        return tuple(
            Column(f"{name} {column.name} {number}{suffix}", column.unit) for column in self.effect.coefficients
        )
