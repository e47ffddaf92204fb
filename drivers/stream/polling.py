"""Torque and temperature of the drives, read a few times a second by SDO alongside the stream.

Nothing waits for an answer. At most one request is on its way; it is sent in a cycle without
set-points, and its answer is taken from the frames that the stream reads anyway. SDO has a lower
priority than SYNC and PDOs, so a request or an answer delays the frames of a cycle by its own
length at most; `daq.config.cell_buses` decides whether a period has room for both. A lost answer is
a missing reading, and so is an abort: the object is read again at its next turn, unless the drive
says that it has none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

import can

from drivers.canopen.network import CanopenNetwork
from drivers.canopen.scale import ScaleReading
from drivers.canopen.sdo import NO_SUCH_OBJECT, upload_answer, upload_request
from drivers.errors import DriverError, ObjectAccessError
from drivers.messages import EventKind, Quantity, SlowReading
from drivers.profiles.profile import Axis, ObjectEntry
from drivers.stream.stream import SyncStream

PERIOD_NS = {Quantity.TORQUE: 200_000_000, Quantity.TEMPERATURE: 1_000_000_000}
"""Time between two readings of an axis: some hundred torques give a slope to a percent;
a motor warms in minutes.
"""
#: Time after which an answer is lost: the SDO servers of drives need some milliseconds
GIVEN_UP_NS = 250_000_000


@dataclass(eq=False, slots=True)
class _Source:
    """One object of one drive."""

    axis: int
    node_id: int
    entry: ObjectEntry
    quantity: Quantity
    per_unit: float
    due_ns: int = 0


class Polling:
    """The slow objects of a prepared network; `found` finds them.

    Args:
        network: prepared.
        beside_stream: whether the bus has room for requests while a stream runs.
    """

    def __init__(self, network: CanopenNetwork, *, beside_stream: bool = True) -> None:
        self._network = network
        self._beside_stream = beside_stream
        self._stream: SyncStream | None = None
        self._keep: Callable[[SlowReading], None] = lambda _: None
        self._asked: _Source | None = None
        self._asked_ns = 0
        self._sources: list[_Source] = []
        self._remarks: list[str] = []

    @classmethod
    def found(cls, network: CanopenNetwork, *, beside_stream: bool = True) -> Polling:
        """Find the objects that the drives really have; no stream of the network runs yet.

        Raises:
            BusError: the bus is lost.
        """
        polling = cls(network, beside_stream=beside_stream)
        for number, (axis, scale) in enumerate(zip(network.axes, network.scales(), strict=True)):
            for quantity, (entry, per_unit) in slow_objects(axis, scale).items():
                try:
                    network.objects(axis).read(entry)
                except ObjectAccessError as error:
                    if error.abort_code is None or error.abort_code in NO_SUCH_OBJECT:
                        if error.abort_code is not None:
                            why = ""
                        else:
                            why = f" that can be read ({error.reason})"
                        polling._remarks.append(
                            f"{axis.name}: the drive has no {quantity.value} in {entry}{why}; it "
                            "is not logged"
                        )
                        continue
                    if beside_stream:
                        next_request = "it is asked again in the run"
                    elif quantity is Quantity.TEMPERATURE:
                        next_request = "it is asked again after the run"
                    else:
                        next_request = "it is not asked again"
                    polling._remarks.append(
                        f"{axis.name}: the drive refused its {quantity.value} in {entry} at first "
                        f"({error.reason}); {next_request}"
                    )
                source = _Source(number, axis.node_id, entry, quantity, per_unit)
                polling._sources.append(source)
                network.link.listen(axis.node_id, partial(polling._take, source))
        return polling

    @property
    def remarks(self) -> tuple[str, ...]:
        """Objects that were refused or are not there, in words; the recording may add some."""
        return tuple(self._remarks)

    def __bool__(self) -> bool:
        """Whether any drive has such an object."""
        return bool(self._sources)

    def temperatures(self, time_ns: int) -> tuple[SlowReading, ...]:
        """Read every temperature now, while no stream runs;
        what cannot be read is missing, a lost bus included.

        After a run all samples are there: a temperature must not cost them.

        Args:
            time_ns: on the clock of the samples [ns].
        """
        self._asked = None
        found = []
        for source in self._sources:
            if source.quantity is Quantity.TEMPERATURE:
                with suppress(DriverError):
                    raw = self._network.link.objects(source.node_id).read(source.entry)
                    found.append(
                        SlowReading(time_ns, source.axis, source.quantity, raw * source.per_unit)
                    )
        return tuple(found)

    def begin(self, stream: SyncStream, keep: Callable[[SlowReading], None]) -> None:
        """Pass readings on from now on, made alongside a stream until it stops the axes,
        if the bus has room.
        """
        if self._beside_stream:
            self._stream = stream
            self._keep = keep
            stream.bus.low_priority = self._request

    def _request(self, now_ns: int) -> Sequence[can.Message]:
        """Return the request that is due; none while another one waits for its answer."""
        if self._asked is not None and now_ns - self._asked_ns < GIVEN_UP_NS:
            return ()
        self._asked = None
        source = min(self._sources, key=lambda one: one.due_ns, default=None)
        if source is None or source.due_ns > now_ns:
            return ()
        # From now on: after a pause nothing is caught up
        source.due_ns = now_ns + PERIOD_NS[source.quantity]
        self._asked = source
        self._asked_ns = now_ns
        return (upload_request(source.node_id, source.entry),)

    def _take(self, source: _Source, data: bytearray) -> None:
        """Keep the value of an answer to the request on its way;
        other answers are the business of others.
        """
        answer = upload_answer(bytes(data), source.entry)
        if answer is None or source is not self._asked or self._stream is None:
            return
        self._asked = None
        if answer.value is not None:
            # The drive read its object somewhere between the request and this answer.
            time_ns = (self._asked_ns + self._stream.time_ns) // 2
            self._keep(
                SlowReading(time_ns, source.axis, source.quantity, answer.value * source.per_unit)
            )
        elif answer.bits is not None:
            bits = f"{answer.bits} bits, expected {source.entry.bits}"
            self._drop(source, f"answers with {bits}: correct the drive profile")
        elif answer.abort_code in NO_SUCH_OBJECT:
            self._drop(source, "is no longer there")

    def _drop(self, source: _Source, why: str) -> None:
        """Ask no more for an object, and say so in the log and in the remarks."""
        self._sources.remove(source)
        name = self._network.axes[source.axis].name
        entry = source.entry
        text = f"{name}: the {source.quantity.value} in {entry} {why}; it is not logged"
        self._remarks.append(text)
        if self._stream is not None:
            self._stream.bus.report(source.axis, EventKind.CAPTURE, entry.index, text)


def slow_objects(axis: Axis, scale: ScaleReading) -> dict[Quantity, tuple[ObjectEntry, float]]:
    """Return the slow objects of an axis, each with its unit.

    A torque has a unit only where the drive reports the rated torque: it is in thousandths of it
    (CiA 402-2, 6077h).
    """
    found: dict[Quantity, tuple[ObjectEntry, float]] = {}
    profile = axis.profile
    if profile.torque is not None and scale.rated_torque_nm is not None:
        found[Quantity.TORQUE] = profile.torque, 1e-3 * scale.rated_torque_nm
    if profile.temperature is not None:
        found[Quantity.TEMPERATURE] = profile.temperature.entry, profile.temperature.kelvin_per_unit
    return found
