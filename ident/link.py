"""The ten inertial parameters of a link, in the paper's order; a payload is a link too (paper §2.2)."""

LINK_PARAMETERS = ("Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz", "mx", "my", "mz", "m")
"""Inertia about the link frame's origin, first moments, mass."""

LINK_UNITS = ("kg m²",) * 6 + ("kg m",) * 3 + ("kg",)
"""Of the same."""
