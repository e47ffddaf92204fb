"""From a calibration to the currents that a planned motion needs, with the payload and without.

python examples/predict_current.py
"""

from __future__ import annotations

import numpy as np
from gains_from_arrays import DISC, NAMEPLATE_NM_A
from gains_from_arrays import main as identify_gains

import ident

RATE_HZ = 500.0


def main() -> None:
    """Calibrate, plan a swing of all axes, and print the largest current of each motor."""
    found = identify_gains()
    calibration = ident.calibration_of(found, ("J1", "J2", "J3"), NAMEPLATE_NM_A)

    # A swing of 60 degrees and back in two seconds: q, dq/dt and d²q/dt², shape (n_samples,
    # n_axes).
    time_s = np.arange(0.0, 2.0, 1.0 / RATE_HZ)[:, None]
    swing_rad, rate = np.radians([60.0, 60.0, 60.0]), np.pi
    motion = ident.Motion(
        swing_rad * (1.0 - np.cos(rate * time_s)) / 2.0,
        swing_rad * rate * np.sin(rate * time_s) / 2.0,
        swing_rad * rate**2 * np.cos(rate * time_s) / 2.0,
    )
    # The mass is known from the scale, and with the rest of the payload's inertia part of the
    # calibration by now.
    for payload in (None, DISC):
        planned = ident.planned(motion, RATE_HZ, payload)
        current_a = ident.predict_current(calibration, found.model, planned)
        largest = ", ".join(f"{value:.2f} A" for value in np.abs(current_a).max(axis=0))
        print(f"{'with the disc' if payload else 'without load':13}: largest currents {largest}")


if __name__ == "__main__":
    main()
