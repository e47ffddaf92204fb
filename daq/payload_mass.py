"""The payload's mass, entered twice: once in the cell file, once from the scale. All gains are in proportion to it."""

from __future__ import annotations

from collections.abc import Iterable

from daq.configuration.cell import Cell, WeighedPayload
from daq.errors import UsageError
from ident.payload import Payload

_ROUNDING_KG = 1e-9
"""Two spellings of one number are one number."""


def tolerance_kg(payloads: Iterable[WeighedPayload], name: str) -> float:
    """How far two weighings of a body may differ [kg]; 0 for one that the cell does not have."""
    return next((payload.mass_tolerance_kg for payload in payloads if payload.name == name), 0.0)


def agree(one_kg: float, other_kg: float, within_kg: float) -> bool:
    """Whether two weighings are of the same body."""
    return abs(one_kg - other_kg) <= within_kg + _ROUNDING_KG


def check_entered_mass(cell: Cell, payload: Payload | None, entered_kg: float | None) -> None:
    """Refuse a mass from the scale that is not the cell file's, before anything moves.

    Args:
        cell: with the tolerance.
        payload: that is mounted, with the mass of the cell file.
        entered_kg: from the scale; None where nobody entered one.

    Raises:
        UsageError: it differs by more than the payload's `mass_tolerance_kg`, or nothing is mounted.
    """
    if entered_kg is None:
        return
    if payload is None:
        raise UsageError(
            "--mass",
            found=f"{entered_kg:g} kg and no payload",
            expected="the mass of what is mounted",
            remedy="name the payload too, or leave out its mass",
        )
    declared_kg, within_kg = payload.known["m"], tolerance_kg(cell.payloads, payload.name)
    if not agree(entered_kg, declared_kg, within_kg):
        raise UsageError(
            f"payload {payload.name!r}",
            found=f"{entered_kg:g} kg from the scale",
            expected=f"{declared_kg:g} kg within {within_kg:g} kg, as in the cell file",
            remedy="weigh it again and correct the wrong one of the two: all gains are in proportion to this mass",
        )
