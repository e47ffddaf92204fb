"""Limits of plausible numbers: one table for cell files,
for commissioning and for the diagnoses of a fit.

A number beyond its limit is in another unit, of another axis or mistyped; no property of a robot
explains it.
"""

from __future__ import annotations

GAIN_RANGE = (0.7, 1.3)
"""An identified gain relative to its nameplate, by tolerances of the motor and losses of the gear.

Those of the paper differ by up to 30 % (Table 2, J4).
"""
CURRENT_RANGE = (0.7, 1.3)
"""Torque of an axis, by its current and its gain, relative to the predicted one:
a gain drifts no further in years.
"""
NAMEPLATE_RATIO = 3.0
"""Largest ratio of two sources of a gain that nothing identified, and smallest inverse: nameplate,
N·Kt of the motor's data, the controller's. What is beyond is refused before anything moves.
"""
WEIGHT_RATIO = 3.0
"""Largest ratio of a payload's weight by fixed gains to its declared one, and smallest inverse.

Gains at the ends of GAIN_RANGE and friction that is not declared change the weight, too.
"""
UNIT_RATIO = 30.0  #: Ratio of all gains to their nameplates that no drive explains, only a unit
LARGEST_GAIN_STD = 0.1
"""Relative σ of every gain at once.

Twenty short moves give 0.02; a payload in the wrong runs 0.25 and more.
"""
TORQUE_RATIO = 10.0  #: Torque on every axis (root mean square), relative to the URDF's effort limit
GRAVITY_M_S2 = (9.7, 9.9)  #: Size of gravity anywhere on Earth [m/s²]
#: The strongest arms carry 2300 kg; a cell that carries more states its rated payload
HEAVIEST_PAYLOAD_KG = 2500.0
#: Mass of the heaviest payload relative to the lightest: g read as kg makes it 1000
PAYLOAD_RATIO = 200.0
#: Largest tolerance of a payload's mass, relative to it: a wrong weight scales all gains alike
TOLERANCE_SHARE = 0.1
FARTHEST_DEG, FARTHEST_MM = 720.0, 100_000.0  #: Largest joint position
SHORTEST_DEG, SHORTEST_MM = 0.2, 5.0  #: Smallest range of a joint
SHORTEST_OF_ALL_DEG = 12.6
"""Smallest range of the widest joint: four π, so that ±2π rad written as degrees are below it.

No moves within a few degrees on every axis identify a gain.
"""
SPEED = (0.01, 1e5)
ACCELERATION = (0.1, 1e7)
"""Largest speed and acceleration of a joint, from the slowest positioner to a spindle [deg/s and
deg/s², or mm].
"""
#: Reduction of a motor [rad/rad, or rad/m: a fine screw behind a gear box has a million]
RATIO = (0.01, 1e7)
SMALLEST_COUPLING = 1e-6  #: Any other number of its row, in the same unit
LEAD_MM = (0.01, 1e4)  #: Travel of one turn of a screw or pinion
TEMPERATURES_C = (-60.0, 250.0)  #: Of a drive or a motor; kelvin above -23 °C are more
GAIN = (1e-5, 1e7)  #: Size of a drive gain [Nm/A or N/A]
RAW_GAIN = (1e-9, 1e9)  #: The same per unit of another current, such as thousandths or increments
LIGHTEST_PAYLOAD_KG = 1e-3  #: Mass of a payload; lighter ones show no gain
#: Distance of a payload's centre of mass from its frame: longer than any tool
FARTHEST_CENTRE_M = 3.0
#: Radius of gyration √(I/m) of a payload, also about the joint that carries it
LARGEST_GYRATION_M = 5.0


def range_text(bounds: tuple[float, float]) -> str:
    """Write a range for a message: what it says is what is tested."""
    return f"{bounds[0]:g} to {bounds[1]:g}"


def format_at_limit(value: float, limit: float, digits: int, form: str = "f") -> str:
    """Format a number with as many digits as show on which side of a limit it is.

    1.004 is above a limit of 1, and "1.00" would not say so.

    Args:
        value: number that is compared by its size.
        limit: it is compared with, as it is written elsewhere in the message.
        digits: of the format, where these are enough.
        form: of the format: ``f``, ``g``, or ``+f`` with the sign of positive numbers, too.
    """
    sign = form[:-1]
    kind = form[-1]
    is_beyond = abs(value) > limit
    text = ""
    for precision in range(digits, 18):
        text = f"{value:{sign}.{precision}{kind}}"
        if (abs(float(text)) > limit) == is_beyond:
            break
    return text


def within(value: float, bounds: tuple[float, float]) -> bool:
    """Whether a number is in a range; NaN is in none."""
    return bounds[0] <= value <= bounds[1]
