"""Watching the drives while a stream runs: what they say becomes events, and some of it faults.

Watching never raises: a fault waits until the sample that shows it has been handed out.
"""

from __future__ import annotations

from collections import deque

from drivers.errors import BusBusy, DriveFault, DriverError, HeartbeatLost, LimitActive, RecorderIdTaken
from drivers.event import CellEvent, EventKind, EventSink
from drivers.frozen import ToggleBits
from drivers.link import HEARTBEAT, SDO_REQUEST, NmtState, command_name, nmt_name
from drivers.network import CanopenNetwork
from drivers.state import STATE_BITS, STATUS_FAULT, STATUS_FOLLOWING_ERROR, State, decode

HEARTBEAT_PERIODS = 2.0
"""Silence after which a node is lost."""
LIMIT_S = 0.5
"""A current that saturates in a ramp is masked by the fit; a limit that acts longer is no ramp any more."""
_WATCHED_BITS = STATE_BITS | STATUS_FOLLOWING_ERROR


class Watch:
    """What the drives of a network last said, and the faults that nobody was told yet.

    Attributes:
        faults: in the order in which they were seen.
    """

    def __init__(self, network: CanopenNetwork, on_event: EventSink) -> None:
        self.faults: deque[DriverError] = deque()
        self._network = network
        self._link = network.link
        self._on_event = on_event
        self._statuswords = (0,) * len(network.axes)
        self._unheard = (1 << len(network.axes)) - 1
        self._begun = False
        self._allowed_silence_ns = round(network.heartbeat_ms * 1e6 * HEARTBEAT_PERIODS)
        self._next_heartbeat_check_ns = 0
        self._heard_at: dict[int, tuple[int, int, int]] = {}
        self._limited_since_ns: dict[int, int] = {}
        self._toggle_bits = ToggleBits(network.axes)

    def cycle(self, time_ns: int, clock_ns: int, statuswords: tuple[int, ...], missing: int) -> None:
        """See to everything after one cycle.

        Args:
            time_ns: of the samples.
            clock_ns: by the clock.
            statuswords: of all axes.
            missing: bit i is set when axis i did not answer this cycle.
        """
        if self._link.has_events:
            self.note_events(time_ns)  # first: an EMCY says why, the statusword only that
        if self._unheard or statuswords != self._statuswords:
            self._note_statuswords(time_ns, statuswords, missing)
        if self._limited_since_ns:
            self._check_limits(time_ns)
        if self._toggle_bits:
            for axis, stale in self._toggle_bits.stale(time_ns, statuswords, missing):
                self._on_event(CellEvent(time_ns, axis, EventKind.FROZEN, stale.bit, str(stale)))
                self.faults.append(stale)
        if clock_ns >= self._next_heartbeat_check_ns and self._allowed_silence_ns > 0:
            self._next_heartbeat_check_ns = clock_ns + self._allowed_silence_ns // 8
            self._check_heartbeats(time_ns, clock_ns)
        self._begun = True

    def _note_statuswords(self, time_ns: int, statuswords: tuple[int, ...], missing: int) -> None:
        before, self._statuswords = self._statuswords, statuswords
        for axis, word in enumerate(statuswords):
            first = bool(self._unheard >> axis & 1)
            if first and missing >> axis & 1:
                continue  # the word is nobody's yet
            self._unheard &= ~(1 << axis)
            # Of an axis's first answer everything is news, but a fault from before is not this recording's.
            changed = _WATCHED_BITS if first else word ^ before[axis]
            saturation = self._network.axes[axis].profile.saturation_bit
            if changed & _WATCHED_BITS:
                state = decode(word)
                text = f"{self._network.axes[axis].name}: {state}, statusword {word:04X}h"
                self._on_event(CellEvent(time_ns, axis, EventKind.STATE, word, text))
                if not first and changed & STATUS_FAULT and state in (State.FAULT, State.FAULT_REACTION_ACTIVE):
                    self.faults.append(DriveFault(self._network.node_ids[axis], str(state), word))
                if not first and changed & word & STATUS_FOLLOWING_ERROR:
                    self._on_event(CellEvent(time_ns, axis, EventKind.FOLLOWING_ERROR, word, text))
                    self.faults.append(DriveFault(self._network.node_ids[axis], "following error", word))
            if saturation is not None and (word ^ (0 if first else before[axis])) >> saturation & 1:
                acts = "a limit acts" if word >> saturation & 1 else "the limit acts no more"
                text = f"{self._network.axes[axis].name}: {acts}"
                self._on_event(CellEvent(time_ns, axis, EventKind.LIMIT, word, text))
                if word >> saturation & 1:
                    self._limited_since_ns[axis] = time_ns
                else:
                    self._limited_since_ns.pop(axis, None)

    def _check_limits(self, time_ns: int) -> None:
        for axis, since_ns in tuple(self._limited_since_ns.items()):
            word = self._statuswords[axis]
            if decode(word) is not State.OPERATION_ENABLED:
                self._limited_since_ns[axis] = time_ns  # what limits nothing is no reason to stop
            elif (acted_ns := time_ns - since_ns) > LIMIT_S * 1e9:
                del self._limited_since_ns[axis]
                text = f"{self._network.axes[axis].name}: a limit acts for {acted_ns * 1e-9:.3f} s"
                self._on_event(CellEvent(time_ns, axis, EventKind.LIMIT, word, text))
                self.faults.append(LimitActive(self._network.node_ids[axis], LIMIT_S, word))

    def note_events(self, time_ns: int) -> None:
        """What the nodes said of themselves since the last cycle, at a time of the samples."""
        for event in self._link.take_events(time_ns, self._network.node_ids):
            self._on_event(event)
            if event.kind is EventKind.BUS_BUSY and event.code < SDO_REQUEST:
                # Whoever only asks a drive something disturbs, and is told; one who commands would move the robot.
                self.faults.append(BusBusy(str(self._link.address), command_name(event.code)))
            elif event.kind is EventKind.BUS_BUSY and event.code >= HEARTBEAT:
                self.faults.append(RecorderIdTaken.by_another(event.code - HEARTBEAT))
            if event.axis is None:
                continue
            node_id = self._network.node_ids[event.axis]
            if event.kind is EventKind.EMCY and self._begun:
                reason = event.text.removeprefix(f"node {node_id}: ")
                self.faults.append(DriveFault(node_id, reason, emcy_code=event.code))
            elif event.kind is EventKind.NMT and event.code != NmtState.OPERATIONAL and self._begun:
                self.faults.append(DriveFault(node_id, f"left OPERATIONAL, is {nmt_name(event.code)}"))

    def _check_heartbeats(self, time_ns: int, clock_ns: int) -> None:
        """A node is lost when it is silent by the clock *and* in the time of the samples.

        In lockstep the samples' time runs faster or slower than the clock, and either alone would be a false alarm.
        """
        for axis, node_id in enumerate(self._network.node_ids):
            # Silence counts from the first cycle on: before it nobody read the bus.
            heard_ns = self._link.heard_ns.get(node_id, 0)
            known_ns, since_clock_ns, since_time_ns = self._heard_at.get(node_id, (-1, 0, 0))
            if known_ns != heard_ns:
                begin_ns = heard_ns if self._begun else clock_ns
                self._heard_at[node_id] = (heard_ns, begin_ns, time_ns)
                continue
            silent_ns = min(clock_ns - since_clock_ns, time_ns - since_time_ns)
            if silent_ns > self._allowed_silence_ns:
                text = f"node {node_id}: no heartbeat for {silent_ns * 1e-9:.3f} s"
                self._on_event(CellEvent(time_ns, axis, EventKind.HEARTBEAT_LOST, node_id, text))
                self.faults.append(HeartbeatLost(node_id, silent_ns * 1e-9))
                self._heard_at[node_id] = (heard_ns, clock_ns, time_ns)
