"""What can be wrong with a simulated cell.

DriverError
└── SimulationError       root of the tree of the simulated cell
    ├── SpecInvalid       the cell cannot be built from its description
    ├── EffectUnknown     an undeclared effect or a parameter of it does not exist
    └── FrictionUnsolved  the dry-friction problem was not solved to its tolerance

SdoAbort                  an SDO access that the simulated node refuses: answered on the bus, never raised to a user
"""

from __future__ import annotations

from drivers.errors import DriverError


class SimulationError(DriverError):
    """Root of the tree of the simulated cell."""


class SpecInvalid(SimulationError):
    """The cell cannot be built from its description."""


class EffectUnknown(SimulationError):
    """An undeclared effect or a parameter of it does not exist."""


class FrictionUnsolved(SimulationError):
    """The dry-friction problem was not solved to its tolerance."""

    def __init__(self, time_s: float, residual_rad_s: float, tolerance_rad_s: float) -> None:
        super().__init__(
            f"dry friction at {time_s:.6f} s: residual {residual_rad_s:.3g} rad/s, "
            f"expected at most {tolerance_rad_s:.3g}; "
            "check the inertias and friction of the cell for values that differ by many orders of magnitude"
        )
        self.time_s = time_s
        self.residual_rad_s = residual_rad_s
        self.tolerance_rad_s = tolerance_rad_s


class SdoAbort(Exception):
    """An SDO access that the node refuses, with the abort code of CiA 301."""

    def __init__(self, code: int) -> None:
        super().__init__(f"SDO abort {code:#010x}")
        self.code = code
