"""Watch the drives while a stream runs: their reports become events, and some of them faults.

Watching never raises: a fault waits until the sample that shows it has been returned. Frozen data
are recognised in two ways: neither position nor current of a moving axis changes by one count, or
an amplifier's toggle bit does not toggle.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from drivers.canopen.link import LSS, NmtState, command_name, nmt_name
from drivers.canopen.network import CanopenNetwork
from drivers.canopen.sdo import SDO_REQUEST
from drivers.errors import BusBusy, DriveFault, node_label
from drivers.messages import EventKind, Sample
from drivers.move import Move
from drivers.profiles.cia402 import STATE_BITS, STATUS_FAULT, STATUS_FOLLOWING_ERROR, State, decode
from drivers.profiles.profile import Axis
from drivers.stream.cycles import CycleBus

FROZEN_S = 0.05
"""Duration of exactly equal values, in the time of the samples.

A loop that fights friction changes its current at once, and a measured current has noise.
"""
#: Least distance of the set-point meanwhile: one that creeps or has just begun proves nothing
FROZEN_COUNTS = 64
STALE_PERIODS = 2
"""Of the amplifier's update period, and of SYNC, without a toggle;
less may be the difference of two timers.
"""
HEARTBEAT_PERIODS = 2.0  #: Silence after which a node is lost
LIMIT_S = 0.5
"""A current that saturates in a ramp is masked by the fit;
a limit that is active longer is no ramp any more.
"""
_WATCHED_BITS = STATE_BITS | STATUS_FOLLOWING_ERROR


class FrozenData:
    """Finds moving axes whose data do not change;
    made when the set-points of a move are sent, from these positions.
    """

    def __init__(
        self, move: Move, start_counts: Sequence[int], axes: Sequence[int], period_ns: int
    ) -> None:
        self._paths = {axis: move.path(axis, start_counts[axis]) for axis in axes}
        self._period_s = period_ns * 1e-9
        self._begin: int | None = None
        self._last: dict[int, tuple[int, int, int]] = {}

    def frozen(self, sample: Sample) -> tuple[int, ...]:
        """Return the axes whose values have not changed for too long; takes every sample once."""
        if self._begin is None:
            self._begin = sample.cycle
        found = []
        for axis, path in self._paths.items():
            values = (sample.position_counts[axis], sample.current_raw[axis])
            last = self._last.get(axis)
            if last is None or last[:2] != values or sample.missing >> axis & 1:
                self._last[axis] = (*values, sample.cycle)
                continue
            since_s, now_s = (
                (cycle - self._begin) * self._period_s for cycle in (last[2], sample.cycle)
            )
            if now_s - since_s >= FROZEN_S:
                positions, _, _ = path.at(np.array([since_s, now_s]))
                if abs(positions[1, 0] - positions[0, 0]) >= FROZEN_COUNTS:
                    found.append(axis)
        return tuple(found)


class ToggleBits:
    """Finds axes whose toggle bit does not toggle."""

    def __init__(self, axes: Sequence[Axis]) -> None:
        self._bits = tuple(
            (
                number,
                axis,
                axis.profile.toggle_bit,
                STALE_PERIODS * 1000 * axis.profile.update_period_us,
            )
            for number, axis in enumerate(axes)
            if axis.profile.toggle_bit is not None
        )
        # For each axis: the bit, the time of its last change, cycles since, whether that was
        # reported.
        self._last: dict[int, tuple[int, int, int, bool]] = {}

    def stale(
        self, time_ns: int, statuswords: Sequence[int], missing: int
    ) -> Iterator[tuple[int, int, DriveFault]]:
        """Yield (index, bit, fault) of each axis whose bit has not toggled for too long;
        call in every cycle.

        The interval of a missing axis (bit i for axis i) starts anew.
        """
        for axis, node, bit, allowed_ns in self._bits:
            if missing >> axis & 1:
                self._last.pop(axis, None)
                continue
            value = statuswords[axis] >> bit & 1
            before, since_ns, cycles, reported = self._last.get(axis, (-1, 0, 0, False))
            if value != before:
                self._last[axis] = (value, time_ns, 0, False)
                continue
            stale = cycles + 1 >= STALE_PERIODS and time_ns - since_ns >= allowed_ns
            self._last[axis] = (value, since_ns, cycles + 1, reported or stale)
            if stale and not reported:
                still = f"{cycles + 1} cycles, {(time_ns - since_ns) * 1e-6:g} ms"
                reason = f"statusword bit {bit} has not toggled for {still}; its data are old"
                remedy = (
                    "restart the drive, and check toggle_bit and update_period_us of its profile"
                )
                yield axis, bit, DriveFault(node, reason, remedy=remedy)


class Watch:
    """Last reports of a network's drives.

    Args:
        network: of the drives.
        bus: receives what they report, and the faults.
        real_time: whether the drives' time is that of the clock; in lockstep their heartbeats may
            come faster.
    """

    def __init__(self, network: CanopenNetwork, bus: CycleBus, *, real_time: bool) -> None:
        self._network = network
        self._link = network.link
        self._bus = bus
        self._statuswords = (0,) * len(network.axes)
        self._unheard = (1 << len(network.axes)) - 1
        self._begun = False
        self._allowed_silence_ns = round(network.heartbeat_ms * 1e6 * HEARTBEAT_PERIODS)
        self._next_heartbeat_check_ns = 0
        self._real_time = real_time
        self._shared: set[int] = set()  # nodes of which it was reported
        self._heard_at: dict[int, tuple[int, int, int]] = {}
        self._limited_since_ns: dict[int, int] = {}
        self._toggle_bits = ToggleBits(network.axes)

    def cycle(self, statuswords: tuple[int, ...], missing: int) -> None:
        """Process one cycle: its statuswords, and bit i for a missing axis i."""
        time_ns = self._bus.time_ns
        self.note_events()  # first: an EMCY has the cause, the statusword only the state
        if self._unheard or statuswords != self._statuswords:
            self._note_statuswords(statuswords, missing)
        for axis, since_ns in tuple(self._limited_since_ns.items()):
            word = self._statuswords[axis]
            if decode(word) is not State.OPERATION_ENABLED:
                # A limit without motion is no reason to stop
                self._limited_since_ns[axis] = time_ns
            elif (active_ns := time_ns - since_ns) > LIMIT_S * 1e9:
                del self._limited_since_ns[axis]
                node = self._network.axes[axis]
                text = f"{node.name}: a limit has been active for {active_ns * 1e-9:.3f} s"
                self._bus.report(axis, EventKind.LIMIT, word, text)
                reason = f"a limit has been active for {LIMIT_S:g} s, statusword {word:#06x}"
                remedy = (
                    "check limit switches, position, speed and current limits, or use slower moves"
                )
                self._bus.faults.append(DriveFault(node, reason, word, remedy=remedy))
        for axis, bit, stale in self._toggle_bits.stale(time_ns, statuswords, missing):
            self._bus.report(axis, EventKind.FROZEN, bit, str(stale))
            self._bus.faults.append(stale)
        clock_ns = self._bus.clock()
        if clock_ns >= self._next_heartbeat_check_ns and self._allowed_silence_ns > 0:
            self._next_heartbeat_check_ns = clock_ns + self._allowed_silence_ns // 8
            self._check_heartbeats(time_ns, clock_ns)
        self._begun = True

    def _note_statuswords(self, statuswords: tuple[int, ...], missing: int) -> None:
        before = self._statuswords
        self._statuswords = statuswords
        for axis, word in enumerate(statuswords):
            first = bool(self._unheard >> axis & 1)
            if first and missing >> axis & 1:
                continue  # no word was received yet
            self._unheard &= ~(1 << axis)
            # The first answer of an axis is reported whole, but a fault from before is not this
            # recording's.
            changed = _WATCHED_BITS if first else word ^ before[axis]
            node = self._network.axes[axis]
            saturation = node.profile.saturation_bit
            if changed & _WATCHED_BITS:
                state = decode(word)
                text = f"{node.name}: {state}, statusword {word:04X}h"
                self._bus.report(axis, EventKind.STATE, word, text)
                if (
                    not first
                    and changed & STATUS_FAULT
                    and state in (State.FAULT, State.FAULT_REACTION_ACTIVE)
                ):
                    self._bus.faults.append(DriveFault(node, str(state), word))
                if not first and changed & word & STATUS_FOLLOWING_ERROR:
                    self._bus.report(axis, EventKind.FOLLOWING_ERROR, word, text)
                    self._bus.faults.append(DriveFault(node, "following error", word))
            if saturation is not None and (word ^ (0 if first else before[axis])) >> saturation & 1:
                if word >> saturation & 1:
                    active = "a limit is active"
                else:
                    active = "the limit is no longer active"
                self._bus.report(axis, EventKind.LIMIT, word, f"{node.name}: {active}")
                if word >> saturation & 1:
                    self._limited_since_ns[axis] = self._bus.time_ns
                else:
                    self._limited_since_ns.pop(axis, None)

    def note_events(self) -> None:
        """Report the events of the nodes since the last cycle."""
        for event in self._link.take_events(self._bus.time_ns, self._network.node_ids):
            self._bus.emit(event)
            if event.kind is EventKind.BUS_BUSY and self._link.is_own(event.code):
                self._bus.faults.append(BusBusy.by_own_id(self._link.address, event.code))
            elif event.kind is EventKind.BUS_BUSY and (
                event.code < SDO_REQUEST or event.code in LSS or event.code in self._link.written
            ):
                # A reader only disturbs, and is reported; a device that commands or writes could
                # move the robot.
                seen = self._link.written.get(event.code) or command_name(
                    event.code, self._link.names
                )
                self._bus.faults.append(BusBusy.by_master(self._link.address, seen))
            if event.axis is None:
                continue
            node = self._network.axes[event.axis]
            if event.kind is EventKind.EMCY and self._begun:
                reason = event.text.removeprefix(f"{node_label(node)}: ")
                self._bus.faults.append(DriveFault(node, reason, emcy_code=event.code))
            elif event.kind is EventKind.NMT and event.code != NmtState.OPERATIONAL and self._begun:
                self._bus.faults.append(
                    DriveFault(node, f"left OPERATIONAL, is {nmt_name(event.code)}")
                )

    def _check_node_id(self, axis: int, node: Axis) -> None:
        """Report a second device with the node id of an axis."""
        if shared := self._link.shared_id(node.node_id, self._network.heartbeat_ms):
            self._shared.add(node.node_id)
            remedy = "two devices have this node id: give one of them another"
            self._bus.faults.append(DriveFault(node, shared, remedy=remedy))

    def _check_heartbeats(self, time_ns: int, clock_ns: int) -> None:
        """Report nodes that are silent by the clock *and* in the time of the samples.

        In lockstep the samples' time runs faster or slower than the clock, and either alone would
        be a false alarm.
        """
        for axis, node in enumerate(self._network.axes):
            node_id = node.node_id
            if self._real_time and node_id not in self._shared:
                self._check_node_id(axis, node)
            # Silence counts from the first cycle on: before it the bus was not read.
            heard_ns = self._link.heard_ns.get(node_id, 0)
            known_ns, since_clock_ns, since_time_ns = self._heard_at.get(node_id, (-1, 0, 0))
            if known_ns != heard_ns:
                begin_ns = heard_ns if self._begun else clock_ns
                self._heard_at[node_id] = (heard_ns, begin_ns, time_ns)
                continue
            silent_ns = min(clock_ns - since_clock_ns, time_ns - since_time_ns)
            if silent_ns > self._allowed_silence_ns:
                reason = f"no heartbeat for {silent_ns * 1e-9:.3f} s"
                text = f"{node_label(node)}: {reason}"
                self._bus.report(axis, EventKind.HEARTBEAT_LOST, node_id, text)
                self._bus.faults.append(DriveFault(node, reason))
                self._heard_at[node_id] = (heard_ns, clock_ns, time_ns)
