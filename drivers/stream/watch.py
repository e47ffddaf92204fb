"""Watch the drives while a stream runs: their reports become events, and some of them faults.

Watching raises no error: the stream raises a fault after it has returned the sample that shows it.
Frozen data are detected in two ways: neither position nor current of a moving axis changes by one
count, or an amplifier's toggle bit does not toggle.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from drivers.canopen.link import LSS, NmtState, command_name, nmt_name
from drivers.canopen.network import CanopenNetwork
from drivers.canopen.sdo import SDO_REQUEST
from drivers.errors import BusBusy, DriveFault, node_label
from drivers.messages import CellEvent, EventKind, Sample
from drivers.move import Move, Trapezoid
from drivers.profiles.cia402 import (
    FAULTY,
    STATE_BITS,
    STATUS_FAULT,
    STATUS_FOLLOWING_ERROR,
    State,
    decode,
)
from drivers.profiles.profile import Axis
from drivers.stream.cycles import CycleBus

#: Duration of exactly equal values that is reported, in the time of the samples. A loop that fights
#: friction changes its current at once, and a measured current has noise.
FROZEN_S = 0.05
#: Least distance of the set-point in this time. One that creeps or has just begun proves nothing.
FROZEN_COUNTS = 64
#: Time without a toggle that is reported: so many update periods of the amplifier, and at least so
#: many cycles. Less may be the difference of two timers.
STALE_PERIODS = 2
HEARTBEAT_PERIODS = 2.0  #: Silence after which a node is lost
#: Duration of an active limit that is reported. A current that saturates in a ramp is masked by the
#: fit; a limit that is active longer is not that of a ramp.
LIMIT_S = 0.5
_WATCHED_BITS = STATE_BITS | STATUS_FOLLOWING_ERROR


class FrozenData:
    """Detection of moving axes whose data do not change.

    Args:
        move: the move that the axes make. It counts as begun with the first sample.
        start_counts: position of every axis before the move.
        axes: indices of the axes that move.
        period_ns: period of the samples.
    """

    def __init__(
        self,
        move: Move,
        start_counts: Sequence[int],
        axes: Sequence[int],
        period_ns: int,
    ) -> None:
        self._paths: dict[int, Trapezoid] = {}
        for axis in axes:
            self._paths[axis] = move.path(axis, start_counts[axis])
        self._period_s = period_ns * 1e-9
        self._first_cycle: int | None = None
        # By axis: position and current of the last sample, and the time of the first sample with
        # the same values.
        self._last_values: dict[int, tuple[int, int]] = {}
        self._unchanged_since_s: dict[int, float] = {}

    def frozen(self, sample: Sample) -> tuple[int, ...]:
        """Return the axes whose values have not changed for too long.

        It must be called once for every sample.
        """
        if self._first_cycle is None:
            self._first_cycle = sample.cycle
        now_s = (sample.cycle - self._first_cycle) * self._period_s
        found = []
        for axis, path in self._paths.items():
            values = (sample.position_counts[axis], sample.current_raw[axis])
            is_missing = sample.missing >> axis & 1
            if is_missing or values != self._last_values.get(axis):
                self._last_values[axis] = values
                self._unchanged_since_s[axis] = now_s
                continue
            since_s = self._unchanged_since_s[axis]
            if now_s - since_s < FROZEN_S:
                continue
            set_points, _, _ = path.at(np.array([since_s, now_s]))
            distance_counts = abs(set_points[1, 0] - set_points[0, 0])
            if distance_counts >= FROZEN_COUNTS:
                found.append(axis)
        return tuple(found)


@dataclass(frozen=True, slots=True)
class _ToggleBit:
    """The toggle bit of one axis."""

    axis: int  #: index of the axis
    node: Axis  #: its amplifier
    bit: int  #: number of the bit in the statusword
    allowed_ns: int  #: longest time without a toggle


@dataclass(slots=True)
class _ToggleState:
    """State of a toggle bit."""

    value: int  #: 0 or 1
    since_ns: int  #: time of its last change
    cycles: int = 0  #: number of cycles since
    is_reported: bool = False  #: whether it was reported since


class ToggleBits:
    """Detection of axes whose toggle bit does not toggle."""

    def __init__(self, axes: Sequence[Axis]) -> None:
        self._bits: list[_ToggleBit] = []
        for index, node in enumerate(axes):
            bit = node.profile.toggle_bit
            if bit is not None:
                allowed_ns = STALE_PERIODS * 1000 * node.profile.update_period_us
                self._bits.append(_ToggleBit(index, node, bit, allowed_ns))
        self._states: dict[int, _ToggleState] = {}  # by axis

    def stale(
        self,
        time_ns: int,
        statuswords: Sequence[int],
        missing: int,
    ) -> Iterator[tuple[int, int, DriveFault]]:
        """Yield (index, bit, fault) of each axis whose bit has not toggled for too long.

        It must be called in every cycle. After a cycle in which an axis is missing (bit i for axis
        i) its interval starts again.
        """
        for watched in self._bits:
            is_missing = missing >> watched.axis & 1
            if is_missing:
                self._states.pop(watched.axis, None)
                continue
            word = statuswords[watched.axis]
            value = word >> watched.bit & 1
            state = self._states.get(watched.axis)
            if state is None or value != state.value:
                self._states[watched.axis] = _ToggleState(value, time_ns)
                continue
            state.cycles += 1
            elapsed_ns = time_ns - state.since_ns
            is_long = elapsed_ns >= watched.allowed_ns
            is_stale = is_long and state.cycles >= STALE_PERIODS
            if is_stale and not state.is_reported:
                state.is_reported = True
                elapsed_ms = elapsed_ns * 1e-6
                fault = DriveFault(
                    watched.node,
                    f"statusword bit {watched.bit} has not toggled for {state.cycles} cycles, "
                    f"{elapsed_ms:g} ms; its data are old",
                    remedy="restart the drive, and check toggle_bit and update_period_us of its "
                    "profile",
                )
                yield watched.axis, watched.bit, fault


@dataclass(frozen=True, slots=True)
class _LastHeartbeat:
    """The last heartbeat of a node, and when its silence began."""

    heard_ns: int  #: time of the heartbeat by the clock; 0 before the first one
    #: By the clock: that heartbeat, or the report of a silence after it
    silent_since_clock_ns: int
    silent_since_sample_ns: int  #: the same in the time of the samples


class Watch:
    """Watch on the drives of a network: statuswords, heartbeats and events of each cycle.

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
        self._real_time = real_time
        self._has_begun = False  # whether the first cycle has been processed
        self._statuswords = (0,) * len(network.axes)
        # Bit i for an axis i without an answer so far.
        self._unheard_mask = (1 << len(network.axes)) - 1
        self._limited_since_ns: dict[int, int] = {}  # by axis
        self._toggle_bits = ToggleBits(network.axes)
        self._allowed_silence_ns = round(network.heartbeat_ms * 1e6 * HEARTBEAT_PERIODS)
        self._next_heartbeat_check_ns = 0
        self._heartbeats: dict[int, _LastHeartbeat] = {}  # by node id
        self._reported_shared_ids: set[int] = set()

    def cycle(self, statuswords: tuple[int, ...], missing: int) -> None:
        """Process one cycle: its statuswords, and bit i for a missing axis i."""
        time_ns = self._bus.time_ns
        # First, because an EMCY has the cause and the statusword only the state.
        self.note_events()
        if self._unheard_mask or statuswords != self._statuswords:
            self._note_statuswords(statuswords, missing)
        self._check_limits(time_ns)
        for axis, bit, fault in self._toggle_bits.stale(time_ns, statuswords, missing):
            self._bus.report(axis, EventKind.FROZEN, bit, str(fault))
            self._bus.faults.append(fault)
        clock_ns = self._bus.clock()
        if clock_ns >= self._next_heartbeat_check_ns and self._allowed_silence_ns > 0:
            # Not in every cycle: eight times in that silence are enough.
            self._next_heartbeat_check_ns = clock_ns + self._allowed_silence_ns // 8
            self._check_heartbeats(time_ns, clock_ns)
        self._has_begun = True

    def _check_limits(self, time_ns: int) -> None:
        """Report limits that have been active for more than LIMIT_S, and add a fault for each."""
        for axis, since_ns in tuple(self._limited_since_ns.items()):
            word = self._statuswords[axis]
            if decode(word) is not State.OPERATION_ENABLED:
                # An axis that is not enabled does not move: its limit is no reason to stop.
                self._limited_since_ns[axis] = time_ns
                continue
            active_ns = time_ns - since_ns
            if active_ns <= LIMIT_S * 1e9:
                continue
            # Reported once, until the limit becomes active again
            del self._limited_since_ns[axis]
            node = self._network.axes[axis]
            active_s = active_ns * 1e-9
            text = f"{node.name}: a limit has been active for {active_s:.3f} s"
            self._bus.report(axis, EventKind.LIMIT, word, text)
            fault = DriveFault(
                node,
                f"a limit has been active for {LIMIT_S:g} s, statusword {word:#06x}",
                word,
                remedy="check limit switches, position, speed and current limits, or use slower "
                "moves",
            )
            self._bus.faults.append(fault)

    def _note_statuswords(self, statuswords: tuple[int, ...], missing: int) -> None:
        """Report changes of the statuswords."""
        previous_words = self._statuswords
        self._statuswords = statuswords
        for axis, word in enumerate(statuswords):
            axis_mask = 1 << axis
            is_first = bool(self._unheard_mask & axis_mask)
            if is_first and missing & axis_mask:
                continue  # no word was received yet
            self._unheard_mask &= ~axis_mask
            if is_first:
                self._report_state(axis, word)
                # A limit that is active from the start is reported as well.
                changed = word
            else:
                changed = word ^ previous_words[axis]
                if changed & _WATCHED_BITS:
                    self._report_state(axis, word)
                    self._note_faults(axis, word, changed)
            saturation_bit = self._network.axes[axis].profile.saturation_bit
            if saturation_bit is None:
                continue
            saturation_mask = 1 << saturation_bit
            if changed & saturation_mask:
                is_active = bool(word & saturation_mask)
                self._note_limit(axis, word, is_active=is_active)

    def _report_state(self, axis: int, word: int) -> None:
        """Report the state of an axis."""
        text = self._state_text(axis, word)
        self._bus.report(axis, EventKind.STATE, word, text)

    def _state_text(self, axis: int, word: int) -> str:
        """Describe the state of an axis, with its statusword."""
        name = self._network.axes[axis].name
        return f"{name}: {decode(word)}, statusword {word:04X}h"

    def _note_faults(self, axis: int, word: int, changed: int) -> None:
        """Add the faults that bits of a statusword show since they changed.

        The first answer of an axis is left out: a fault in it was there before this recording.
        """
        node = self._network.axes[axis]
        state = decode(word)
        if state in FAULTY and changed & STATUS_FAULT:
            self._bus.faults.append(DriveFault(node, str(state), word))
        if changed & word & STATUS_FOLLOWING_ERROR:
            text = self._state_text(axis, word)
            self._bus.report(axis, EventKind.FOLLOWING_ERROR, word, text)
            self._bus.faults.append(DriveFault(node, "following error", word))

    def _note_limit(self, axis: int, word: int, *, is_active: bool) -> None:
        """Report a limit that has become active or inactive."""
        name = self._network.axes[axis].name
        if is_active:
            text = f"{name}: a limit is active"
            self._bus.report(axis, EventKind.LIMIT, word, text)
            self._limited_since_ns[axis] = self._bus.time_ns
        else:
            text = f"{name}: the limit is no longer active"
            self._bus.report(axis, EventKind.LIMIT, word, text)
            self._limited_since_ns.pop(axis, None)

    def note_events(self) -> None:
        """Report the events of the nodes since the last cycle."""
        for event in self._link.take_events(self._bus.time_ns, self._network.node_ids):
            self._bus.emit(event)
            if event.kind is EventKind.BUS_BUSY:
                self._note_other_sender(event.code)
            # Until the first cycle is processed, an event may be from before this recording.
            if event.axis is not None and self._has_begun:
                node = self._network.axes[event.axis]
                self._note_fault_of_node(node, event)

    def _note_other_sender(self, identifier: int) -> None:
        """Add a fault for frames of another device if it may move the robot.

        A device that only reads disturbs the bus: it is reported, but it is no fault.
        """
        address = self._link.address
        if self._link.is_own(identifier):
            self._bus.faults.append(BusBusy.by_own_id(address, identifier))
            return
        is_command = identifier < SDO_REQUEST or identifier in LSS
        is_write = identifier in self._link.written
        if is_command or is_write:
            description = self._link.written.get(identifier)
            if not description:
                description = command_name(identifier, self._link.names)
            self._bus.faults.append(BusBusy.by_master(address, description))

    def _note_fault_of_node(self, node: Axis, event: CellEvent) -> None:
        """Add a fault for an EMCY of a node, and for an NMT state other than OPERATIONAL."""
        if event.kind is EventKind.EMCY:
            reason = event.text.removeprefix(f"{node_label(node)}: ")
            self._bus.faults.append(DriveFault(node, reason, emcy_code=event.code))
        elif event.kind is EventKind.NMT and event.code != NmtState.OPERATIONAL:
            reason = f"left OPERATIONAL, is {nmt_name(event.code)}"
            self._bus.faults.append(DriveFault(node, reason))

    def _check_node_id(self, node: Axis) -> None:
        """Add a fault if a second device has the node id of an axis."""
        reason = self._link.shared_id(node.node_id, self._network.heartbeat_ms)
        if reason:
            self._reported_shared_ids.add(node.node_id)
            remedy = "two devices have this node id: give one of them another"
            self._bus.faults.append(DriveFault(node, reason, remedy=remedy))

    def _check_heartbeats(self, time_ns: int, clock_ns: int) -> None:
        """Report nodes that are silent by the clock *and* in the time of the samples.

        In lockstep the samples' time runs faster or slower than the clock, and each of the two
        alone would raise false alarms.
        """
        for axis, node in enumerate(self._network.axes):
            node_id = node.node_id
            if self._real_time and node_id not in self._reported_shared_ids:
                self._check_node_id(node)
            heard_ns = self._link.heard_ns.get(node_id, 0)
            last = self._heartbeats.get(node_id)
            if last is None or last.heard_ns != heard_ns:
                silent_since_ns = heard_ns
                if not self._has_begun:
                    # Before the first cycle the bus was not read: silence counts from now on.
                    silent_since_ns = clock_ns
                self._heartbeats[node_id] = _LastHeartbeat(
                    heard_ns=heard_ns,
                    silent_since_clock_ns=silent_since_ns,
                    silent_since_sample_ns=time_ns,
                )
                continue
            silent_by_clock_ns = clock_ns - last.silent_since_clock_ns
            silent_by_samples_ns = time_ns - last.silent_since_sample_ns
            silent_ns = min(silent_by_clock_ns, silent_by_samples_ns)
            if silent_ns > self._allowed_silence_ns:
                reason = f"no heartbeat for {silent_ns * 1e-9:.3f} s"
                text = f"{node_label(node)}: {reason}"
                self._bus.report(axis, EventKind.HEARTBEAT_LOST, node_id, text)
                self._bus.faults.append(DriveFault(node, reason))
                # The next report comes after another such silence.
                self._heartbeats[node_id] = _LastHeartbeat(
                    heard_ns=heard_ns,
                    silent_since_clock_ns=clock_ns,
                    silent_since_sample_ns=time_ns,
                )
