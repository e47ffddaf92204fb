"""Gates of what a calibration says of the axes, held against the cell: unit and nameplate of each gain."""

from __future__ import annotations

import math
from collections.abc import Iterator

from daq.configuration.cell import Axis
from daq.write_back.gates import Gate, Refusal
from ident.calibration import Calibration, Gain

_SPELLING = 1e-9
"""Two spellings of one number are one number."""


def axis_refusals(calibration: Calibration, axes: tuple[Axis, ...]) -> Iterator[Refusal]:
    """Closed where the calibration speaks of other axes than the cell has.

    Its own nameplate bounds the gain and is what the hold-out is compared with, so it must be the cell's.

    Args:
        calibration: to be written.
        axes: of the cell as it is now.
    """
    declared = {axis.name: axis for axis in axes}
    for gain in calibration.gains:
        axis = declared.get(gain.axis)
        if axis is not None:
            yield from _refusals(gain, axis)


def _refusals(gain: Gain, axis: Axis) -> Iterator[Refusal]:
    if gain.unit != axis.gain_unit:
        yield Refusal(
            Gate.UNIT,
            gain.axis,
            f"a gain in {gain.unit!r}",
            f"{axis.gain_unit!r}, as the cell file has it",
            "fit the logs again with --cell",
        )
    # A nameplate that is no number has a gate of its own.
    if math.isfinite(gain.nameplate) and not math.isclose(gain.nameplate, axis.nameplate_gain, rel_tol=_SPELLING):
        yield Refusal(
            Gate.NAMEPLATE,
            gain.axis,
            f"compared with a nameplate of {gain.nameplate:g}",
            f"{axis.nameplate_gain:g} {axis.gain_unit}, the cell's",
            "fit the logs again with --cell: bounds and hold-out are compared with the nameplate",
        )
