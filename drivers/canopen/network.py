"""The amplifiers of one cell: found, checked, set up for recording and moving,
and restored afterwards.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import partial
from typing import Self

import can

from drivers.canopen.bus import BusAddress
from drivers.canopen.link import (
    HEARTBEAT,
    LISTEN_S,
    LSS,
    Link,
    NmtCommand,
    NmtState,
    command_name,
    never,
)
from drivers.canopen.node_scan import FoundNode, answering, free_ids, read_identity, scan_link
from drivers.canopen.pdo import CONTROLWORD, HEARTBEAT_MS, STATUSWORD, AxisPdos, wanted_pdos
from drivers.canopen.scale import ScaleReading, read_scale
from drivers.canopen.sdo import SDO_REQUEST, Clock, ObjectAccess, SdoPolicy, download_request
from drivers.canopen.setup import (
    AxisSetup,
    HeartbeatGuard,
    Profiles,
    producer_of,
    read_consumers,
    refusal,
    try_twice,
    why_no_heartbeat,
)
from drivers.canopen.split_bus import CellAddress, open_cell_bus
from drivers.errors import (
    POWERED,
    WHILE,
    BusBusy,
    BusError,
    DriverError,
    MotionRefused,
    NodeMissing,
    ObjectAccessError,
    SetupRefused,
    StateRefused,
    node_label,
)
from drivers.messages import Sample
from drivers.profiles.cia402 import (
    FAULT_RESET_SEQUENCE,
    POWERLESS,
    ControlCommand,
    Goal,
    State,
    decode,
    next_command,
)
from drivers.profiles.profile import Axis, Identity

ASKED_AT_ONCE = 8  #: Candidates for the recorder's node id that are tried together
#: The recorder takes the highest free id: this one or a higher one on any usual bus
LOWEST_USUAL_ID = 112
#: Of other buses or misplaced nodes, behind which the axes of the buses that are left are stopped
FAILURES_OF_A_STOP = 3
REQUESTS_WHILE_CLOSING = 2  #: To each node that is asked whether it answers
SECOND_ANSWER_S = 0.05  #: For the answer of a second device with one node id
#: An encoder at rest flickers, and an axis may sink onto its brake between two readings
STANDSTILL_COUNTS = 1024


@dataclass(frozen=True, slots=True)
class Bounds:
    """Time limits of a network [s]."""

    answer_s: float = 1.0  #: until every node answered the search
    #: Until nodes that do not answer while the network closes are given up, all of them together.
    silence_s: float = 0.5
    #: For other masters before the first frame is sent; each SYNC period of theirs must fit.
    listen_s: float = LISTEN_S
    nmt_s: float = 2.0  #: until a heartbeat confirms an NMT state
    mode_s: float = 1.0  #: until 6061h shows the requested mode
    disable_s: float = 2.0  #: until an axis is without power when the network closes
    #: For devices with the node ids that the recorder may take. With `listen_s` before it, longer
    #: than `guard_ms` of a cell whose SYNC has a usual period: a slower heartbeat could not replace
    #: the recorder's.
    free_s: float = 0.35
    #: For the stop of the axes, and as long again for closing the network, which stops what was not
    #: confirmed and restores the settings; whatever is not restored by then is named.
    closing_s: float = 10.0


SignalBlocker = Callable[[], AbstractContextManager[Callable[[], bool] | None]]
"""Returns a context in which no signal interrupts stopping and restoring the axes.

It yields None, or a function that returns whether the operator has asked a second time: restoring
is then given up.
"""
DEFAULT_BOUNDS = Bounds()
DEFAULT_POLICY = SdoPolicy()


def _unrestored(axes: Sequence[Axis]) -> str:
    """Return the note on the error of axes that could not be reached."""
    settings = f"settings of {', '.join(map(node_label, axes))} not restored"
    return (
        f"{WHILE}closing the network: {settings}; switch these drives off and on before "
        "they are used"
    )


def _try_to_close(step: Callable[[], object], problems: list[DriverError]) -> None:
    """Do a step of closing; append its failure to the others, and go on."""
    try:
        try_twice(step, problems)
    except DriverError as problem:
        if str(problem) not in map(str, problems):
            problems.append(problem)


@contextmanager
def open_cell(
    address: CellAddress | str, axes: Sequence[Axis], *, guard_ms: int = 500
) -> Iterator[CanopenNetwork]:
    """Open the bus of a cell and set up its amplifiers; no axis gets power.

    Leaving the context disables all axes and restores every changed object.

    Args:
        address: of the bus or buses, or of one bus as text: ``"socketcan:can0"``.
        axes: the amplifiers, in the order of the samples' columns.
        guard_ms: silence of this program after which the amplifiers stop by themselves.

    Raises:
        DriverError: as `CanopenNetwork.prepare`.
    """
    place = BusAddress.parse(address) if isinstance(address, str) else address
    with CanopenNetwork(place, tuple(axes), guard_ms=guard_ms) as network:
        network.prepare()
        yield network


class CanopenNetwork:
    """The axes of a cell, as a context manager.

    Leaving it disables all axes and restores all settings.

    Methods that use the bus raise BusError when it is lost, and ObjectAccessError when an axis does
    not answer.

    Args:
        address: of the bus, or of the buses that share the axes.
        axes: the amplifiers, in the order of the samples' columns.
        heartbeat_ms: period of every node's heartbeat, and of ours while axes have power.
        guard_ms: silence of ours after which the amplifiers stop by themselves
            (drivers/canopen/setup.py).
        bounds, policy: time limits.
        clock: monotonic time [ns].
        opener: opens the bus of an address, or of several as one.
        block_signals: keeps signals from interrupting the stop of the axes.
        profiles: those from which one is named that fits a drive, where the configured one does
            not.
    """

    def __init__(
        self,
        address: CellAddress,
        axes: tuple[Axis, ...],
        *,
        heartbeat_ms: int = HEARTBEAT_MS,
        guard_ms: int = 500,
        bounds: Bounds = DEFAULT_BOUNDS,
        policy: SdoPolicy = DEFAULT_POLICY,
        clock: Clock = time.monotonic_ns,
        opener: Callable[[CellAddress], can.BusABC] = open_cell_bus,
        block_signals: SignalBlocker = nullcontext,
        profiles: Profiles = tuple,
    ) -> None:
        self.axes = axes
        self.profiles = profiles
        self.block_signals = block_signals
        self.heartbeat_ms = heartbeat_ms
        self.guard_ms = guard_ms
        self.bounds = bounds
        self.link = Link(address, policy, clock, opener)
        self.node_ids = tuple(axis.node_id for axis in axes)
        self.link.names = {axis.node_id: axis.name for axis in axes}
        # The highest id is the least likely to be a drive's; `prepare` checks that it is free.
        #: Nodes that have had power, and are not confirmed without it since
        self.powered: set[int] = set()
        self.recorder_id = next((n for n in range(127, 0, -1) if n not in self.node_ids), 0)
        self._setups: dict[int, AxisSetup] = {}
        self._readback: dict[str, object] = {}
        self._scales: tuple[ScaleReading, ...] = ()

    def __enter__(self) -> Self:
        self.link.open()
        return self

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        problems: list[DriverError] = []
        is_restored = False
        try:
            with self.block_signals() as asked_again:
                if self._setups:
                    problems = self._restore(asked_again or never)
                is_restored = True
        except BaseException as cut:
            # A signal that came while they were restored is raised after that.
            if not is_restored:
                cut.add_note(
                    f"{WHILE}closing the network: it was cut short, and not every axis has "
                    "its settings back"
                )
            self._close_link(problems)
            self._note(cut, problems)
            raise
        self._close_link(problems)
        if error is not None:
            self._note(error, problems)
        elif problems:
            self._note(problems[0], problems[1:])
            raise problems[0]

    def _close_link(self, problems: list[DriverError]) -> None:
        """Close the bus; a failure is one more among the others, which the operator has to read."""
        try:
            self.link.close()
        except BusError as problem:
            problems.append(problem)

    def _note(self, error: BaseException, problems: Sequence[DriverError]) -> None:
        """Attach failures to close the network, with their own notes,
        and the axes that may still have power.
        """
        for problem in problems:
            error.add_note(f"{WHILE}closing the network: {problem}")
            for note in getattr(problem, "__notes__", ()):
                error.add_note(note)
        powered = [node_label(axis) for axis in self.axes if axis.node_id in self.powered]
        if powered:
            error.add_note(POWERED + ", ".join(powered))

    def objects(self, axis: Axis) -> ObjectAccess:
        """Return access to the object dictionary of an axis."""
        return self.link.objects(axis.node_id)

    def see(self, axis: Axis, state: State) -> None:
        """Remember whether an axis has power."""
        if state in POWERLESS:
            self.powered.discard(axis.node_id)
        else:
            self.powered.add(axis.node_id)

    def begin_closing(self) -> None:
        """Let everything from here on end within `Bounds.closing_s`; the first call counts.

        Leaving the network begins a limit of its own.
        """
        if self.link.deadline_ns is None:
            self.link.deadline_ns = self.link.clock() + round(self.bounds.closing_s * 1e9)

    def end_closing(self) -> None:
        """Lift the time limit of `begin_closing`:
        the axes have no power, and the network stays open.
        """
        self.link.deadline_ns = None

    def scan(
        self, node_ids: Sequence[int] = range(1, 128), wait_s: float = 0.5
    ) -> tuple[FoundNode, ...]:
        """Find the nodes on the bus; changes nothing.

        Raises:
            BusBusy: another master commands this bus, and may be moving its axes; nothing was sent.
        """
        self.require_quiet()
        return scan_link(self.link, node_ids, wait_s)

    def check_identities(self) -> tuple[Identity, ...]:
        """Compare 1018h of every axis with its configuration.

        Raises:
            NodeMissing: a node does not answer.
            SetupRefused: another amplifier than the configured one.
            ObjectAccessError: a node does not report its identity.
        """
        answered = answering(self.link, self.node_ids, self.bounds.answer_s)
        if missing := [axis for axis in self.axes if axis.node_id not in answered]:
            raise NodeMissing(missing, answered, self.bounds.answer_s)
        with self._second_device_named(), self._refusals_named():
            identities = tuple(read_identity(self.objects(axis)) for axis in self.axes)
        self._require_own_ids(0)
        for axis, found in zip(self.axes, identities, strict=True):
            if axis.identity is not None and (differing := axis.identity.differences(found)):
                raise SetupRefused(
                    axis,
                    f"{differing[0]}; was an amplifier exchanged? correct the configuration only "
                    "after checking the hardware",
                )
        return identities

    @contextmanager
    def _second_device_named(self) -> Iterator[None]:
        """Where a node refuses, look for a second device with its node id first:
        that one may have refused.
        """
        try:
            yield
        except (ObjectAccessError, SetupRefused):
            self.link.wait(SECOND_ANSWER_S)
            self._require_own_ids(0)
            raise

    @contextmanager
    def _refusals_named(self) -> Iterator[None]:
        """Say of an object that an axis refuses while it is set up what it is for."""
        try:
            yield
        except ObjectAccessError as error:
            axis = next((axis for axis in self.axes if axis.node_id == error.node_id), None)
            if error.abort_code is None or axis is None:
                raise
            raise refusal(error, axis) from error

    def _require_own_ids(self, period_ms: int) -> None:
        """Refuse an axis whose node id another device has too;
        `period_ms` is that of its heartbeat, 0 if unknown.
        """
        for axis in self.axes:
            if shared := self.link.shared_id(axis.node_id, period_ms):
                raise SetupRefused(
                    axis,
                    f"found {shared}",
                    expected="one device with this node id",
                    remedy="two have it, and both would move: nothing has moved, give one of them "
                    "another node id",
                )

    def prepare(self) -> None:
        """Set every node up: identity, heartbeats, PRE-OPERATIONAL, mapping, profile position mode,
        OPERATIONAL.

        No axis gets power. The original values are restored when the network is left, also after an
        error.

        Raises:
            BusBusy: another master commands this bus (nothing was sent), or no node id is free for
                the recorder.
            NodeMissing, SetupRefused, StateRefused, ObjectAccessError, BusError: see
                drivers/errors.py.
        """
        self.require_quiet()
        with self._second_device_named(), self._refusals_named():
            self._set_up()

    def _set_up(self) -> None:
        identities = self.check_identities()
        consumers = [read_consumers(self.objects(axis)) for axis in self.axes]
        if self.link.own_id is None:
            watched: list[int] = []
            for entries in consumers:
                watched += [value for _, value in entries or ()]
            self._take_recorder_id(watched)
        new: dict[int, AxisSetup] = {}
        for axis, entries in zip(self.axes, consumers, strict=True):
            if axis.node_id not in self._setups:
                guard = HeartbeatGuard(self.objects(axis), entries, self.was_ours)
                new[axis.node_id] = AxisSetup(self.link, axis, guard)
        for setup in new.values():
            setup.check(self.profiles)
        self._require_own_ids(0)
        self._setups.update(new)
        for setup in self._setups.values():
            setup.send_heartbeats(self.heartbeat_ms)
            setup.expect_plain_sync()
            setup.guard.arm(self.recorder_id, self.guard_ms)
        self._command_all(NmtCommand.ENTER_PRE_OPERATIONAL, NmtState.PRE_OPERATIONAL)
        for axis in self.axes:
            setup = self._setups[axis.node_id]
            self.disable(axis)
            setup.map_pdos()
            setup.set_mode(self.bounds.mode_s)
        for axis, identity, scale in zip(self.axes, identities, self.scales(), strict=True):
            self._readback[axis.name] = self._setups[axis.node_id].describe(
                identity, scale, self.guard_ms
            )
        self._command_all(NmtCommand.START, NmtState.OPERATIONAL)
        for node_id in self.node_ids:
            # SYNC has been sent meanwhile: with it a cell in lockstep, and its heartbeats, may be
            # faster than time.
            self.link.count_beats(node_id)
        self.link.hear_beats(self.heartbeat_ms)
        self._require_own_ids(self.heartbeat_ms)
        self.link.narrow()

    @property
    def pdos(self) -> tuple[AxisPdos, ...]:
        """PDOs of each axis: as they are mapped, or before `prepare` as they will be on most
        drives.
        """
        pdos = []
        for axis in self.axes:
            setup = self._setups.get(axis.node_id)
            pdos.append(wanted_pdos(axis) if setup is None else setup.pdos)
        return tuple(pdos)

    def _take_recorder_id(self, watched: Sequence[int]) -> None:
        """Choose the highest node id that no device uses,
        and that no amplifier waits for by its entries of 1016h.
        """
        # An amplifier that waits for a device which is off now would take our heartbeat for that
        # device's.
        awaited = {producer_of(value) for value in watched if value & 0xFFFF != self.guard_ms}
        left = [n for n in range(127, 0, -1) if n not in awaited and n not in self.node_ids]
        while left := [n for n in left if n not in self.link.heard]:
            asked = left[:ASKED_AT_ONCE]
            left = left[ASKED_AT_ONCE:]
            if free := free_ids(self.link, asked, self.bounds.free_s):
                self.recorder_id = self.link.own_id = free[0]
                return
        raise BusBusy(
            str(self.link.address),
            "no free node id for the recorder: all of 1 to 127 belong to axes or other devices, or "
            "an axis waits for them (1016h)",
            "an id that only the recorder uses, because another device's heartbeat would keep the "
            "axes running",
            "nothing has moved; take one of the other devices off the bus while recording",
        )

    def was_ours(self, value: int) -> bool:
        """Whether an entry of 1016h still watches a recorder that was killed,
        and no device that is present.

        That recorder may have used another node id, because of another device.
        """
        producer = producer_of(value)
        usual = producer >= LOWEST_USUAL_ID and value & 0xFFFF == self.guard_ms
        present = {0, *self.link.heard, *self.node_ids}
        return producer not in present and (producer == self.recorder_id or usual)

    def require_quiet(self) -> None:
        """Listen for a while before the first frame is sent.

        Raises:
            BusBusy: another master commands this bus.
        """
        self.link.require_quiet(self.bounds.listen_s)

    def other_master(self) -> str:
        """Describe SDO requests of another master since `require_quiet`; empty without any."""
        asked = [number for number in sorted(self.link.foreign) if SDO_REQUEST < number < HEARTBEAT]
        seen = [command_name(number, self.link.names) for number in asked if number not in LSS]
        if seen:
            return f"another master was on the bus: {', '.join(seen)}"
        return ""

    def guard(self) -> None:
        """Start our heartbeat: from now on the amplifiers quick stop by themselves when we fall
        silent.

        Raises:
            BusBusy: a device has come that has the same node id.
            MotionRefused: the watch over the recorder ended with a motion before.
        """
        ended = []
        for axis in self.axes:
            setup = self._setups.get(axis.node_id)
            if setup is not None and setup.guard.is_over:
                ended.append(axis.name)
        if ended:
            raise MotionRefused(
                f"{', '.join(ended)} no longer watching the recorder: the motion before ended that",
                expected="that every axis that can watches the recorder's heartbeat (1016h)",
                remedy="nothing has moved; prepare the network again before another motion",
            )
        for identifier in filter(self.link.is_own, self.link.foreign):
            raise BusBusy.by_own_id(self.link.address, identifier)
        self.link.start_heartbeat(self.recorder_id, self.heartbeat_ms)

    def unguard(self) -> None:
        """End the guard once all axes are known to stand still,
        so that a slow end of a run does not trip it.

        Without it the guard ends when the network closes, axis by axis, after each was disabled.
        """
        for node_id, setup in self._setups.items():
            if node_id not in self.link.silent:
                setup.guard.end()
        self.link.stop_heartbeat()

    def unguarded(self) -> tuple[str, ...]:
        """Report the amplifiers of the prepared network that do not stop by themselves when the
        recorder is killed.
        """
        lacks = []
        for axis in self.axes:
            setup = self._setups.get(axis.node_id)
            if setup is not None and setup.guard.lack:
                lacks.append(f"{axis.name}: {setup.guard.lack}")
        return tuple(lacks)

    def without_guard(self) -> tuple[str, ...]:
        """Return the names of the axes of the prepared network that go on moving when the recorder
        is killed.
        """
        return tuple(
            axis.name for axis in self.axes if not self._setups[axis.node_id].guard.watching
        )

    def find_silent(self, axes: Sequence[Axis]) -> NodeMissing | None:
        """Ask all these axes at once for an answer; those without one are skipped from then on.

        One answer may get lost, so those without one are asked again.
        """
        asked = [axis.node_id for axis in axes]
        unanswered = [node_id for node_id in asked if node_id not in self.link.silent]
        answered: list[int] = []
        wait_s = self.bounds.silence_s / REQUESTS_WHILE_CLOSING
        for _ in range(REQUESTS_WHILE_CLOSING):
            answered += answering(self.link, unanswered, wait_s)
            unanswered = [node_id for node_id in unanswered if node_id not in answered]
            if not unanswered:
                break
        missing = [axis for axis in axes if axis.node_id not in answered]
        self.link.silent.update(axis.node_id for axis in missing)
        if missing:
            return NodeMissing(missing, tuple(sorted(answered)), self.bounds.silence_s)
        return None

    def stop_unheard(self, node_ids: Sequence[int]) -> None:
        """Request quick stop of nodes that do not answer, without waiting for any answer."""
        for node_id in node_ids:
            request = download_request(node_id, CONTROLWORD, ControlCommand.QUICK_STOP)
            with suppress(DriverError):
                self.link.send((request,))

    def _stop_pdos_unheard(self, node_ids: Sequence[int]) -> None:
        """Command PRE-OPERATIONAL of nodes that do not answer, without waiting for a heartbeat."""
        for node_id in node_ids:
            with suppress(DriverError):
                self.link.command_nmt(node_id, NmtCommand.ENTER_PRE_OPERATIONAL)

    def check_feedback(self, sample: Sample) -> None:
        """Compare the positions in a sample of axes at standstill with those read by SDO.

        Raises:
            SetupRefused: a PDO carries another value.
            ObjectAccessError: an axis does not answer.
        """
        for axis, by_pdo in zip(self.axes, sample.position_counts, strict=True):
            entry = axis.profile.position
            by_sdo = self.objects(axis).read(entry)
            if abs(by_sdo - by_pdo) > STANDSTILL_COUNTS:
                raise SetupRefused(
                    axis,
                    f"object {entry} is {by_sdo} by SDO and {by_pdo} in its PDO at standstill, "
                    f"expected at most {STANDSTILL_COUNTS} apart; another device sends with this "
                    "COB-ID, or the mapping is not what it reads back as",
                )

    def _command_all(self, command: NmtCommand, state: NmtState) -> None:
        # To each of our nodes, not to the whole bus: there may be others on it.
        since = {node_id: self.link.command_nmt(node_id, command) for node_id in self.node_ids}
        for node_id, since_ns in since.items():
            waited_s = (self.link.clock() - since_ns) * 1e-9
            try:
                self.link.confirm_nmt(
                    node_id, state, since_ns, max(self.bounds.nmt_s - waited_s, 0.0)
                )
            except StateRefused as refused:
                access = self.link.objects(node_id)
                if node_id in self.link.nmt:
                    raise
                raise StateRefused(
                    access, refused.asked, refused.found, remedy=why_no_heartbeat(access)
                ) from refused

    def ampere_per_unit(self) -> tuple[float, ...]:
        """Return ampere per raw unit of each axis' current object,
        from the drives' own scale objects.

        Raises:
            ObjectAccessError, SetupRefused: as `scales`.
        """
        return tuple(reading.ampere_per_unit for reading in self.scales())

    def scales(self) -> tuple[ScaleReading, ...]:
        """Return the current scale and the motor's rated values in each drive, read once.

        Raises:
            ObjectAccessError, SetupRefused: as `drivers.canopen.scale.read_scale`.
        """
        if not self._scales:
            self._scales = tuple(read_scale(self.objects(axis), axis.profile) for axis in self.axes)
        return self._scales

    def readback(self) -> dict[str, object]:
        """Return what the drives reported during `prepare`, by axis name, for the log."""
        return dict(self._readback)

    def statuswords(self) -> tuple[int, ...]:
        """Read 6041h of every axis by SDO."""
        return tuple(self.objects(axis).read(STATUSWORD) for axis in self.axes)

    def reset_faults(self) -> None:
        """Reset the faults of all axes; an operator's decision, never taken by a recording itself.

        Raises:
            StateRefused: an axis is still in fault.
        """
        for axis in self.axes:
            access = self.objects(axis)
            if decode(access.read(STATUSWORD)) is not State.FAULT:
                continue
            for command in FAULT_RESET_SEQUENCE:
                access.write(CONTROLWORD, command)
                self.link.pass_time()
            statusword = access.read(STATUSWORD)
            if decode(statusword) is State.FAULT:
                raise StateRefused(axis, "fault reset", str(State.FAULT), statusword)

    def begin_stop(self, axes: Sequence[Axis]) -> int:
        """Request quick stop by SDO of all these axes;
        `disable`, which waits for each, reports failures.

        Returns:
            Time by the network's clock until which the ramps of these axes may take [ns]; they
            brake at the same time.
        """
        for axis in axes:
            access = self.objects(axis)
            with suppress(DriverError):
                state = decode(access.read(STATUSWORD))
                self.see(axis, state)
                if state not in POWERLESS:
                    access.write(CONTROLWORD, next_command(state, Goal.QUICK_STOP))
        return self.link.clock() + self._disable_ns

    @property
    def _disable_ns(self) -> int:
        return round(self.bounds.disable_s * 1e9)

    def disable(
        self, axis: Axis, goal: Goal = Goal.QUICK_STOP, ramp_end_ns: int | None = None
    ) -> None:
        """Quick stop one axis by SDO, then remove its power, and confirm both by its statusword.

        Args:
            axis: to disable.
            goal: SWITCH_ON_DISABLED removes the power of an axis that is known to stand still,
                without quick stop.
            ramp_end_ns: until which a quick stop that was requested before may take, as of
                `begin_stop`; None where it is requested now.

        Raises:
            StateRefused: not reached within ``bounds.disable_s``.
            ObjectAccessError: it does not answer.
        """
        access = self.objects(axis)
        end_ns = self.link.clock() + self._disable_ns
        while True:
            statusword = access.read(STATUSWORD)
            state = decode(statusword)
            self.see(axis, state)
            if state in POWERLESS:
                return
            now_ns = self.link.clock()
            is_over = now_ns >= end_ns
            if goal is Goal.QUICK_STOP:
                if state is State.QUICK_STOP_ACTIVE and ramp_end_ns is not None:
                    is_over = now_ns >= ramp_end_ns
                if is_over:
                    # The ramp did not end by itself: some drives stay in QUICK STOP ACTIVE (605Ah =
                    # 5..8).
                    goal = Goal.SWITCH_ON_DISABLED
                    end_ns = now_ns + self._disable_ns
            elif is_over:
                raise StateRefused(axis, str(State.SWITCH_ON_DISABLED), str(state), statusword)
            access.write(CONTROLWORD, next_command(state, goal))
            self.link.pass_time()

    def _keep_watch(self, axis: Axis, problems: Sequence[DriverError]) -> None:
        """Let an amplifier that could not be disabled go on watching the recorder.

        Its heartbeat ends with the network: this is what may still stop the axis.
        """
        guard = self._setups[axis.node_id].guard
        if axis.node_id in self.powered and guard.watching and self.link.sends_heartbeat:
            guard.stays = True
            problems[-1].add_note(
                f"{WHILE}closing the network: the watch of {node_label(axis)} (1016h) is "
                "not restored: it stops the axis when the recorder falls silent; switch this drive "
                "off and on before it is used"
            )

    def _restore(self, asked_again: Callable[[], bool]) -> list[DriverError]:
        """Disable, PRE-OPERATIONAL, restore, all within one time limit; every axis is tried.

        Returns the failures.
        """
        self.end_closing()  # a stop may have used up its own limit
        self.begin_closing()
        problems: list[DriverError] = []
        axes = [axis for axis in self.axes if axis.node_id in self._setups]
        for _ in range(FAILURES_OF_A_STOP + 1):
            try:
                # One time limit for all: asked in turn, six dead nodes would take a minute and
                # more.
                silent = self.find_silent(axes)
                break
            except DriverError as problem:
                # A failure of one of several buses is reported once, and then the others go on.
                if str(problem) not in map(str, problems):
                    problems.append(problem)
        else:
            problems[-1].add_note(_unrestored(axes))
            self._setups.clear()
            return problems
        if silent is not None:
            silent.add_note(_unrestored([axis for axis in axes if axis.node_id in silent.node_ids]))
            problems.append(silent)
            self.stop_unheard(silent.node_ids)
            self._stop_pdos_unheard(silent.node_ids)
            axes = [axis for axis in axes if axis.node_id not in silent.node_ids]
        ramp_end_ns = self.begin_stop(axes)
        for axis in axes:
            _try_to_close(partial(self.disable, axis, ramp_end_ns=ramp_end_ns), problems)
        since_ns = self.link.clock()
        for axis in axes:
            stop_pdos = partial(
                self.link.command_nmt, axis.node_id, NmtCommand.ENTER_PRE_OPERATIONAL
            )
            _try_to_close(stop_pdos, problems)
        self.link.given_up = asked_again
        left: dict[str, tuple[str, ...]] = {}
        for axis in axes:
            left_s = max(self.bounds.nmt_s - (self.link.clock() - since_ns) * 1e-9, 0.0)
            if self._setups[axis.node_id].beats and self.link.allowed_s(left_s) > 0.0:
                confirm = partial(
                    self.link.confirm_nmt,
                    axis.node_id,
                    NmtState.PRE_OPERATIONAL,
                    since_ns,
                    left_s,
                )
                _try_to_close(confirm, problems)
            self._keep_watch(axis, problems)
            left[axis.name] = self._setups[axis.node_id].restore(problems)
        if any(left.values()):
            if asked_again():
                cause = "asked a second time"
            else:
                cause = "refused, no answer, a failure of the bus, or the time limit was over"
            not_restored = {name: ", ".join(steps) for name, steps in left.items() if steps}
            names = "; ".join(f"{name}: {steps}" for name, steps in not_restored.items())
            remedy = "switch these drives off and on before they are used"
            text = f"settings not restored ({cause}): {names}; {remedy}"
            problems.append(BusError(str(self.link.address), text))
        self._setups.clear()
        return problems
