"""Find bodies that do not exist: of many metres, or with moments of inertia that no mass has."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import hypot, sqrt

import numpy as np

from daq.config.yaml_file import Fault, Location
from ident.plausible import FARTHEST_CENTRE_M, LARGEST_GYRATION_M, within

_OVERFLOWS = 1e100  #: Moments of inertia whose eigenvalues may overflow


def centre_faults(path: Location, centre_m: Sequence[float]) -> Iterator[Fault]:
    """Find a centre of mass in mm."""
    far_m = hypot(*centre_m)
    if not within(far_m, (0.0, FARTHEST_CENTRE_M)):
        found = f"a centre of mass {far_m:.4g} m from the origin"
        yield Fault(path, found, f"at most {FARTHEST_CENTRE_M:g} m; is this in mm?")


def gyration_faults(path: Location, inertia_kg_m2: Sequence[float], mass_kg: float) -> Iterator[Fault]:
    """Find an inertia in kg mm², by its radius of gyration √(I/m)."""
    radius_m = sqrt(max(map(abs, inertia_kg_m2)) / mass_kg)
    if not within(radius_m, (0.0, LARGEST_GYRATION_M)):
        found = f"a radius of gyration √(I/m) of {radius_m:.4g} m"
        yield Fault(path, found, f"at most {LARGEST_GYRATION_M:g} m; is this in kg mm²?")


def moment_faults(path: Location, inertia_kg_m2: Sequence[float]) -> Iterator[Fault]:
    """Find inertias of no body: a principal moment below zero, or above the sum of the other two.

    Args:
        path: of the inertia.
        inertia_kg_m2: xx, xy, xz, yy, yz, zz about the centre of mass.
    """
    if not max(map(abs, inertia_kg_m2)) < _OVERFLOWS:
        return  # `gyration_faults` refuses it
    xx, xy, xz, yy, yz, zz = inertia_kg_m2
    least, middle, largest = np.linalg.eigvalsh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
    margin = 1e-9 * abs(largest)
    if least < -margin or largest > least + middle + margin:
        yield Fault(
            path,
            f"principal moments {least:.4g}, {middle:.4g}, {largest:.4g} kg m²",
            "those of a body about its centre of mass: none below 0, none above the sum of the other two",
        )
