"""In which objects and units a simulated amplifier tells its current: the standard's, or those of a make.

Only what a recording reads differs (current, rated values); states, moves and limits stay those of CiA 402. The units
are written down here from the makes' side, not taken from the drive profiles, so that a wrong scale is found out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from drivers.simulated.amplifier import AmplifierSet
from drivers.simulated.object_dictionary import Dictionary, Entry, Kind, Mappable
from drivers.simulated.spec import AxisSpec, Dialect

_LIMITS = {Kind.I16: (-(2**15), 2**15 - 1), Kind.I32: (-(2**31), 2**31 - 1)}


class Signal(Enum):
    """What of the current loop an object tells."""

    REFERENCE = "reference"
    ACTUAL = "actual"


@dataclass(frozen=True, slots=True)
class CurrentObject:
    """An object that tells a current in a unit of its own: current / step, rounded, at most what it can hold."""

    key: tuple[int, int]
    kind: Kind
    step_a: float
    signal: Signal

    def source(self, amplifiers: AmplifierSet, index: int) -> Callable[[], int]:
        """Its value at any time, of the amplifier of that index."""
        lowest, highest = _LIMITS[self.kind]
        told_a = amplifiers.reported_a if self.signal is Signal.REFERENCE else amplifiers.actual_a

        def value() -> int:
            return max(lowest, min(highest, round(float(told_a[index]) / self.step_a)))

        return value


def current_objects(axis: AxisSpec) -> tuple[CurrentObject, ...]:
    """What an amplifier tells of its current beside, or in place of, 6074h, 6077h and 6078h of the standard."""
    reference, actual = Signal.REFERENCE, Signal.ACTUAL
    by_dialect: dict[Dialect, tuple[CurrentObject, ...]] = {
        Dialect.CIA402: (),
        Dialect.EPOS4: (
            CurrentObject((0x30D0, 0), Kind.I32, 1e-3, reference),  # mA
            CurrentObject((0x30D1, 1), Kind.I32, 1e-3, actual),
            CurrentObject((0x30D1, 2), Kind.I32, 1e-3, actual),
        ),
        Dialect.COPLEY: (
            CurrentObject((0x221D, 0), Kind.I16, 0.01, reference),  # 10 mA
            CurrentObject((0x221C, 0), Kind.I16, 0.01, actual),
        ),
        # 65520 internal units are twice the peak current.
        Dialect.IPOS: (CurrentObject((0x6077, 0), Kind.I16, 2.0 * axis.peak_current_a / 65520.0, actual),),
        # 3280 digits are the peak current.
        Dialect.AX2000: (CurrentObject((0x6074, 0), Kind.I16, axis.peak_current_a / 3280.0, reference),),
    }
    return by_dialect[axis.dialect]


_ABSENT: dict[Dialect, frozenset[int]] = {
    Dialect.CIA402: frozenset(),
    Dialect.EPOS4: frozenset({0x6073, 0x6074, 0x6075, 0x6078}),
    Dialect.COPLEY: frozenset({0x6073, 0x6074, 0x6075, 0x6076, 0x6077, 0x6078}),
    Dialect.IPOS: frozenset({0x6073, 0x6074, 0x6075, 0x6076, 0x6078}),
    Dialect.AX2000: frozenset({0x6073, 0x6075, 0x6076, 0x6078}),
}


def translated(dictionary: Dictionary, axis: AxisSpec) -> Dictionary:
    """A dictionary of the standard with the objects of a make in it, and without those that the make lacks."""
    objects = {key: entry for key, entry in dictionary.items() if key[0] not in _ABSENT[axis.dialect]}
    for told in current_objects(axis):
        objects[told.key] = Entry(told.kind, mappable=Mappable.TRANSMIT)
    if axis.dialect is Dialect.EPOS4:
        objects[0x3001, 1] = Entry(Kind.U32, round(1000 * axis.rated_current_a), writable=True)
    if axis.dialect is Dialect.COPLEY:
        objects[0x2240, 0] = Entry(Kind.I32, mappable=Mappable.TRANSMIT)  # the motor's encoder
    if axis.dialect is Dialect.AX2000:
        objects[0x3529, 1] = Entry(Kind.I32, round(1000 * axis.peak_current_a))
    return objects
