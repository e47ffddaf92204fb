"""The ampere value of a drive's raw unit, read at connect and held against the motor's name plate.

A gain is Nm per ampere, so an ampere that is none passes through everything unseen: it only makes all gains of the axis
wrong by one factor. What the drive itself says of its motor, and the name plate of the cell, are the two witnesses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from drivers.canopen.sdo import ABORT_DOES_NOT_EXIST, ABORT_NO_SUBINDEX, ObjectAccess
from drivers.errors import DriverError, ObjectAccessError
from drivers.profiles.profile import Amplitude, DriveProfile, ObjectEntry

SMALLEST_RATED_A, LARGEST_RATED_A = 0.01, 1000.0
"""Of servo motors; what is outside was entered in another unit than mA."""
MIN_STEPS = 20.0
"""Raw units in the rated current; with fewer, rounding alone would be 5 % of it."""
GROSS = 5.0
"""Ratio of two name plates from which on one of them is in another unit; no two motors are so unlike on purpose."""
FINE = 1.25
"""Ratio that tolerances of Kt and a gear's efficiency explain."""


class ScaleImplausible(DriverError):
    """A drive's ampere value cannot be true."""

    def __init__(self, node_id: int, profile: str, found: str, expected: str, remedy: str) -> None:
        super().__init__(f"node {node_id}, profile {profile}: found {found}; expected {expected}; {remedy}")
        self.node_id = node_id
        self.profile = profile
        self.found = found
        self.expected = expected


@dataclass(frozen=True, slots=True)
class ScaleReading:
    """What a drive says of its ampere.

    Attributes:
        node_id, profile: whose, by which profile.
        ampere_per_unit: of the mapped current object [A].
        objects: values that it was made of, by object.
        rated_current_a: of the motor, None where the drive does not tell.
        rated_torque_nm: of the motor, None where the drive does not tell.
        warnings: what could not be checked, and what is odd, with the evidence.
    """

    node_id: int
    profile: str
    ampere_per_unit: float
    objects: dict[str, int]
    rated_current_a: float | None
    rated_torque_nm: float | None
    warnings: tuple[str, ...]


def read_scale(access: ObjectAccess, profile: DriveProfile) -> ScaleReading:
    """Read the scale of a drive's current, and check it against the rated current in the drive.

    Raises:
        ScaleImplausible: an object of the scale is zero, the rated current is none of a servo motor, or it does not fit
            the range or the resolution of the current object.
        ObjectAccessError: an object of the scale cannot be read.
    """
    scale = profile.current_scale
    values = {str(entry): access.read(entry) for entry in scale.objects}
    for name, value in values.items():
        if value <= 0:
            raise ScaleImplausible(
                access.node_id,
                profile.name,
                f"{name} = {value}",
                "the motor's rated value",
                "the drive was not set up for its motor, and its current has no scale: enter the motor's name plate",
            )
    choice = 0 if scale.switch is None else access.read(scale.switch)
    try:
        ampere = scale.ampere_per_unit(tuple(values.values()), choice)
    except IndexError as error:
        raise ScaleImplausible(
            access.node_id,
            profile.name,
            f"{scale.switch} = {choice}",
            f"0 to {len(scale.weights) - 1}",
            "this firmware scales its current in a way that the profile does not know; complete the profile",
        ) from error
    if scale.switch is not None:
        values[str(scale.switch)] = choice
    rated_a, rated_nm, warnings = _name_plate(access, profile)
    if rated_a is not None:
        _check_rated(access.node_id, profile, ampere, rated_a)
    return ScaleReading(access.node_id, profile.name, ampere, values, rated_a, rated_nm, warnings)


def check_name_plate(reading: ScaleReading, amplitude: Amplitude, motor_nm_per_a: float) -> tuple[str, ...]:
    """Hold the drive's Kt = rated torque / rated current against the cell's, |nameplate gain / N|.

    Args:
        reading: of the drive.
        amplitude: of its profile.
        motor_nm_per_a: torque constant of the motor by the cell configuration [Nm/A], sign irrelevant.

    Returns:
        Warnings: what cannot be checked, or does not fit well.

    Raises:
        ScaleImplausible: the two differ by a factor of five or more.
    """
    if reading.rated_current_a is None or reading.rated_torque_nm is None:
        return ()  # the reading itself has said so
    reported, declared = reading.rated_torque_nm / reading.rated_current_a, abs(motor_nm_per_a)
    ratio = reported / declared
    evidence = (
        f"{reported:.4g} Nm/A by the drive ({reading.rated_torque_nm:g} Nm / {reading.rated_current_a:g} A), "
        f"{declared:.4g} Nm/A by the cell's nameplate gain, {ratio:.3g} times"
    )
    if not 1.0 / GROSS < ratio < GROSS:
        raise ScaleImplausible(
            reading.node_id,
            reading.profile,
            evidence,
            f"the same torque constant, within a factor of {GROSS:g}",
            "is a rated value in A or Nm instead of mA or mNm, is it another motor's, or is the nameplate gain wrong?",
        )
    if 1.0 / FINE < ratio < FINE:
        return ()
    if any(abs(math.log(ratio * root)) < math.log(1.08) for root in (math.sqrt(2.0), math.sqrt(0.5))):
        hint = f"near √2: one of them counts peak and the other RMS ampere (this profile: {amplitude.value})"
    else:
        hint = "another motor, or a wrong name plate"
    return (f"torque constants differ: {evidence}; {hint}",)


def _name_plate(access: ObjectAccess, profile: DriveProfile) -> tuple[float | None, float | None, tuple[str, ...]]:
    """Rated current [A] and torque [Nm] of the motor, None where the drive does not tell, and what that means."""
    if profile.rated is None:
        return None, None, (f"profile {profile.name} knows no rated current; the ampere cannot be checked",)
    rated = profile.rated
    current = _optional(access, rated.current)
    if current is None:
        return None, None, (f"{rated.current} is not told or 0; the ampere cannot be checked",)
    torque = None if rated.torque is None else _optional(access, rated.torque)
    if torque is None:
        missing = "no rated torque" if rated.torque is None else f"{rated.torque} is not told or 0"
        return current * rated.ampere_per_unit, None, (f"{missing}; the torque constant cannot be checked",)
    return current * rated.ampere_per_unit, torque * rated.newton_metre_per_unit, ()


def _optional(access: ObjectAccess, entry: ObjectEntry) -> int | None:
    """An object that a drive need not have; 0 is "not entered"."""
    try:
        return access.read(entry) or None
    except ObjectAccessError as error:
        if error.abort_code in (ABORT_DOES_NOT_EXIST, ABORT_NO_SUBINDEX):
            return None
        raise


def _check_rated(node_id: int, profile: DriveProfile, ampere: float, rated_a: float) -> None:
    if not SMALLEST_RATED_A <= rated_a <= LARGEST_RATED_A:
        raise ScaleImplausible(
            node_id,
            profile.name,
            f"a rated current of {rated_a:g} A",
            f"{SMALLEST_RATED_A:g} to {LARGEST_RATED_A:g} A",
            "was it entered in another unit than the drive's manual says?",
        )
    steps, entry = rated_a / ampere, profile.current
    most = 2 ** (entry.bits - 1 if entry.signed else entry.bits) - 1
    if not MIN_STEPS <= steps <= most:
        raise ScaleImplausible(
            node_id,
            profile.name,
            f"a rated current of {rated_a:g} A in steps of {ampere:.4g} A, {steps:.3g} of them",
            f"{MIN_STEPS:g} to {most} steps, what {entry} can say",
            "the scale is not this drive's, or the rated current is not its motor's: check profile and set-up",
        )
