"""The ampere value of a drive's raw unit, read at connect and compared with the motor's rated
values.

A gain is Nm per ampere. A wrong ampere value passes every later check and makes all gains of the
axis wrong by one factor, so it is compared with the motor's rated values in the drive and with the
nameplate in the cell configuration.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from drivers.canopen.sdo import ObjectAccess
from drivers.errors import SetupRefused
from drivers.profiles.profile import Amplitude, DriveProfile

SMALLEST_RATED_A = 0.01
LARGEST_RATED_A = 1000.0
"""Range of servo motors; a value outside was entered in another unit than mA."""
#: Least number of raw units in the rated current; with fewer, one unit is more than 5 % of it
MIN_STEPS = 20.0
#: Ratio of two torque constants that tolerances of Kt and a gear's efficiency explain
LARGEST_KT_RATIO = 1.25
#: Two torque constants whose ratio is √2 or 1/√2, up to this factor, count in peak and RMS ampere
_AMPLITUDE_TOLERANCE = 1.08


@dataclass(frozen=True, slots=True)
class _RatedValues:
    """Rated values of the motor, as the drive reports them."""

    current_a: float | None  #: None where the drive reports none
    torque_nm: float | None  #: None where the drive reports none
    warnings: tuple[str, ...]  #: checks that values which are not reported make impossible


@dataclass(frozen=True, slots=True)
class ScaleReading:
    """Current scale and motor data of a drive."""

    ampere_per_unit: float  #: of the mapped current object [A]
    objects: dict[str, int]  #: values of the scale objects, by object
    rated_current_a: float | None  #: rated current of the motor, None where the drive reports none
    rated_torque_nm: float | None  #: rated torque of the motor, None where the drive reports none
    warnings: tuple[str, ...]  #: missing checks and doubtful values, with the evidence

    @property
    def torque_constant_nm_per_a(self) -> float | None:
        """Kt = rated torque / rated current [Nm/A]; None where the drive does not report both."""
        if self.rated_current_a is None or self.rated_torque_nm is None:
            return None
        return self.rated_torque_nm / self.rated_current_a


def read_scale(access: ObjectAccess, profile: DriveProfile) -> ScaleReading:
    """Read the scale of a drive's current, and check it against the rated current in the drive.

    Raises:
        SetupRefused: a scale object is zero, the rated current is not that of a servo motor, or it
            does not fit the range or the resolution of the current object.
        ObjectAccessError: a scale object cannot be read.
    """

    def implausible(found: str, expected: str, remedy: str) -> SetupRefused:
        return SetupRefused(
            access, f"profile {profile.name}: found {found}", expected=expected, remedy=remedy
        )

    scale = profile.current_scale
    current = profile.current
    values = {str(entry): access.read(entry) for entry in scale.objects}
    for name, value in values.items():
        if value <= 0:
            remedy = (
                "the drive was not set up for its motor, so its current has no scale: enter the "
                "motor's rated current and torque in the drive"
            )
            raise implausible(f"{name} = {value}", "the motor's rated value", remedy)
    if scale.switch is None:
        switch_value = 0
    else:
        switch_value = access.read(scale.switch)
    try:
        ampere_per_unit = scale.ampere_per_unit(tuple(values.values()), switch_value)
    except IndexError as error:
        remedy = (
            "this firmware scales its current in a way that is not in the profile; complete "
            "the profile"
        )
        expected = f"0 to {len(scale.weights) - 1}"
        raise implausible(f"{scale.switch} = {switch_value}", expected, remedy) from error
    if scale.switch is not None:
        values[str(scale.switch)] = switch_value
    rated = _read_rated(access, profile)
    rated_a = rated.current_a
    if rated_a is not None:
        if not SMALLEST_RATED_A <= rated_a <= LARGEST_RATED_A:
            expected = f"{SMALLEST_RATED_A:g} to {LARGEST_RATED_A:g} A"
            remedy = "was it entered in another unit than the drive's manual says?"
            raise implausible(f"a rated current of {rated_a:g} A", expected, remedy)
        steps = rated_a / ampere_per_unit
        magnitude_bits = current.bits
        if current.signed:
            magnitude_bits -= 1
        largest_raw = 2**magnitude_bits - 1
        if not MIN_STEPS <= steps <= largest_raw:
            found = (
                f"a rated current of {rated_a:g} A in steps of {ampere_per_unit:.4g} A, "
                f"{steps:.3g} of them"
            )
            expected = f"{MIN_STEPS:g} to {largest_raw} steps, the range of {current}"
            remedy = (
                "the scale is not this drive's, or the rated current is not its motor's: check "
                "profile and set-up"
            )
            raise implausible(found, expected, remedy)
    return ScaleReading(
        ampere_per_unit=ampere_per_unit,
        objects=values,
        rated_current_a=rated_a,
        rated_torque_nm=rated.torque_nm,
        warnings=rated.warnings,
    )


def check_nameplate(
    reading: ScaleReading, amplitude: Amplitude, motor_nm_per_a: float
) -> tuple[str, ...]:
    """Compare the drive's Kt = rated torque / rated current with that of the nameplate.

    Args:
        reading, amplitude: of the drive, and of its profile.
        motor_nm_per_a: torque constant of the motor by the nameplate [Nm/A]: nameplate gain / gear
            ratio; its sign does not matter.

    Returns:
        Warnings for a poor fit. None where the drive does not report both values: `reading` has a
        warning of that.
    """
    reported = reading.torque_constant_nm_per_a
    nameplate_nm_per_a = abs(motor_nm_per_a)
    if reported is None:
        return ()
    ratio = reported / nameplate_nm_per_a
    if 1.0 / LARGEST_KT_RATIO < ratio < LARGEST_KT_RATIO:
        return ()
    evidence = (
        f"{reported:.4g} Nm/A by the drive ({reading.rated_torque_nm:g} Nm / "
        f"{reading.rated_current_a:g} A), {nameplate_nm_per_a:.4g} Nm/A by the nameplate in the "
        f"cell file, {ratio:.3g} times"
    )
    # Peak and RMS differ by √2 or by 1/√2.
    log_distance = abs(abs(math.log(ratio)) - math.log(math.sqrt(2.0)))
    if log_distance < math.log(_AMPLITUDE_TOLERANCE):
        hint = (
            "near √2: one of them counts peak and the other RMS ampere (this profile: "
            f"{amplitude.value})"
        )
    else:
        hint = "another motor, or a wrong nameplate"
    return (f"torque constants differ: {evidence}; {hint}",)


def _read_rated(access: ObjectAccess, profile: DriveProfile) -> _RatedValues:
    """Read rated current and torque of the motor."""
    rated = profile.rated
    if rated is None:
        warning = f"profile {profile.name} has no rated current; the ampere cannot be checked"
        return _RatedValues(None, None, (warning,))
    # A drive gives its torque in thousandths of the rated torque: without that it has no unit. Each
    # of the warnings below says so.
    not_logged = ""
    if profile.torque is not None:
        not_logged = f", and its torque ({profile.torque}) is not logged"
    current_raw = access.read_optional(rated.current)
    if not current_raw:  # 0 is "not entered"
        warning = (
            f"drive reports no rated current ({rated.current}); the ampere cannot be "
            f"checked{not_logged}"
        )
        return _RatedValues(None, None, (warning,))
    current_a = current_raw * rated.ampere_per_unit
    if rated.torque is None:
        missing = "no rated torque"
    else:
        torque_raw = access.read_optional(rated.torque)
        if torque_raw is not None and torque_raw > 0:
            return _RatedValues(current_a, torque_raw * rated.newton_metre_per_unit, ())
        if torque_raw is not None and torque_raw < 0:
            missing = f"drive reports a rated torque below zero ({rated.torque} = {torque_raw})"
        else:
            missing = f"drive reports no rated torque ({rated.torque})"
    warning = (
        f"{missing}; the torque constant cannot be checked (no gain depends on this){not_logged}"
    )
    return _RatedValues(current_a, None, (warning,))
