"""A simulated cell whose payload somebody exchanges between two runs: only while no axis has power."""

from __future__ import annotations

import time
from collections.abc import Callable

import can

from drivers.simulated.cell import SimulatedCell
from drivers.simulated.power_state import PowerState
from drivers.simulated.spec import CellSpec

POWERED = (
    PowerState.SWITCHED_ON,
    PowerState.OPERATION_ENABLED,
    PowerState.QUICK_STOP_ACTIVE,
    PowerState.FAULT_REACTION_ACTIVE,
)

Mounted = Callable[[], CellSpec | None]
"""The cell as it is mounted now, None where nobody knows better than before."""


class MountingCell(SimulatedCell):
    """As a simulated cell; what is mounted is asked before every frame while all axes are without power.

    So whoever changes it, and then asks the cell anything, finds it changed; and what is changed while an axis has
    power waits until none has. The loops stay tuned as they were, as those of real drives do.
    """

    def __init__(
        self, spec: CellSpec, bus: can.BusABC, mounted: Mounted, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """As a simulated cell.

        Args:
            spec: the truth of the cell, as it is mounted at power-on.
            bus: of it.
            mounted: tells what is mounted; another object is another mounting. It must not take long.
            clock: seconds.
        """
        super().__init__(spec, bus, clock)
        self._mounted, self._spec = mounted, spec

    def _next_frame(self) -> can.Message | None:
        message = super()._next_frame()
        if not any(node.drive.state in POWERED for node in self.nodes):
            spec = self._mounted()
            if spec is not None and spec is not self._spec:
                self._spec = spec
                self.plant.mount(spec)
        return message
