"""What is wrong with who shall send SYNC."""

from __future__ import annotations

from collections.abc import Iterator

from daq.configuration.cell import KERNEL, RECORDER, Pacing
from daq.configuration.cell_schema import CellModel
from daq.configuration.yaml_file import Fault

KERNEL_INTERFACE = "socketcan"


def producer_faults(model: CellModel) -> Iterator[Fault]:
    """A producer that there is not, or that cannot pace this bus."""
    if model.sync is None or model.sync.producer == RECORDER:
        return
    path, producer = ("sync", "producer"), model.sync.producer
    interfaces = [bus.interface for bus in model.buses]
    if len(interfaces) > 1:
        expected = f"{RECORDER}: nobody else sends SYNC on several buses at once"
        yield Fault(path, f"{producer} with {len(interfaces)} buses", expected)
    if model.sync.pacing is Pacing.LOCKSTEP:
        expected = f"{RECORDER}, or pacing timed: in lockstep the next SYNC waits for the answers"
        yield Fault(path, f"{producer} with pacing lockstep", expected)
    if producer == KERNEL:
        if set(interfaces) != {KERNEL_INTERFACE}:
            expected = f"a bus of interface {KERNEL_INTERFACE}, whose broadcast manager sends it"
            yield Fault(path, f"{KERNEL} on {' + '.join(interfaces) or 'no bus'}", expected)
    elif producer not in (names := [axis.name for axis in model.axes]):
        yield Fault(path, producer, f"{RECORDER}, {KERNEL}, or an axis ({', '.join(names)})")
