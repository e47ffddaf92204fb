"""Set one amplifier up for a recording, and restore afterwards the settings that it had before.

The objects that a recording needs are compared with those that the drive has, before anything is
written.

The amplifier also watches the recorder, so that it stops by itself when the recorder is killed,
hangs or is cut off. The recorder sends a heartbeat while axes have power; the amplifier watches it
(CiA 301, consumer heartbeat time 1016h, which begins with the first heartbeat). When none comes, it
acts by its abort connection option code (CiA 402-2, 6007h): quick stop.

A heartbeat does not identify its sender. Another device with the recorder's node id would keep the
axes running after the recorder was killed. The recorder therefore takes an id that no device uses,
and a foreign heartbeat with it is a fault. The watch raises ObjectAccessError only when the
amplifier does not answer; a refusal is no reason not to record.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import partial

from drivers.canopen.link import Link
from drivers.canopen.pdo import (
    CONTROLWORD,
    NOT_VALID,
    PDO_BYTES,
    PDOS,
    PROFILE_ACCELERATION,
    PROFILE_DECELERATION,
    PROFILE_VELOCITY,
    STATUSWORD,
    TARGET_POSITION,
    AxisPdos,
    Direction,
    PdoRecord,
    fixed_feedback,
    fixed_setpoints,
    read_pdo_record,
    turn_off,
    wanted_pdos,
    write_pdo_record,
)
from drivers.canopen.scale import ScaleReading
from drivers.canopen.sdo import NO_SUCH_OBJECT, ObjectAccess
from drivers.errors import (
    BusError,
    DriverError,
    NodeMisplaced,
    ObjectAccessError,
    SetupRefused,
)
from drivers.profiles.profile import Axis, DriveProfile, Identity, ObjectEntry

HEARTBEAT_TIME = ObjectEntry(0x1017, 0, 16)
MODE_OF_OPERATION = ObjectEntry(0x6060, 0, 8, signed=True)
MODE_DISPLAY = ObjectEntry(0x6061, 0, 8, signed=True)
PROFILE_POSITION_MODE = 1
CONSUMERS = ObjectEntry(0x1016, 0, 8)
SUPPORTED_MODES = ObjectEntry(0x6502, 0, 32)
SYNC_COUNTER = ObjectEntry(0x1019, 0, 8)
GUARD_TIME = ObjectEntry(0x100C, 0, 16)
ABORT_CONNECTION = ObjectEntry(0x6007, 0, 16, signed=True)
QUICK_STOP_ON_LOSS = 3
SMALL_PDO_BYTES = 6  #: Tried where a drive refuses PDOs of eight bytes
MOST_CONSUMERS = 127  #: Entries that 1016h can have (CiA 301)

HEARTBEATS_NEEDED = (
    "its NMT state and its loss would not be known without heartbeats, and node guarding (100Ch) "
    "is not supported: use a firmware of the drive that has heartbeats"
)

MODE_REMEDY = (
    "is another controller, a fault or a switch of the drive in the way? choose the mode with its "
    "own tool"
)

Consumers = tuple[tuple[ObjectEntry, int], ...]
"""Entries of 1016h and their values: node id of a heartbeat producer << 16 | time in ms."""


def try_twice(step: Callable[[], object], problems: list[DriverError]) -> None:
    """Do a step of closing a network, once more if the bus fails during it.

    A controller that goes off the bus, the failure of one of several buses, or a misplaced node is
    reported at any time, and the step may still be possible. The report is appended to `problems`
    once.

    Raises:
        DriverError: of the step; BusError if the bus failed again.
    """
    try:
        step()
    except (BusError, NodeMisplaced) as problem:
        if str(problem) not in map(str, problems):
            problems.append(problem)
        step()


def producer_of(value: int) -> int:
    """Return the node id that an entry of 1016h watches, 0 where it watches none."""
    return value >> 16 & 0x7F if value & 0xFFFF else 0


def read_consumers(access: ObjectAccess) -> Consumers | None:
    """Read 1016h up to the first entry that cannot be read;
    None where the amplifier has no such object.
    """
    found: list[tuple[ObjectEntry, int]] = []
    try:
        for sub in range(1, min(access.read(CONSUMERS), MOST_CONSUMERS) + 1):
            entry = ObjectEntry(CONSUMERS.index, sub, 32)
            found.append((entry, access.read(entry)))
    except ObjectAccessError as error:
        if error.abort_code is None:
            raise
        return tuple(found) or None
    return tuple(found)


Profiles = Callable[[], Sequence[DriveProfile]]
"""Returns the profiles from which one that fits a drive is suggested."""


def needs_of(profile: DriveProfile) -> dict[ObjectEntry, str]:
    """Return the objects without which a drive cannot be recorded with a profile,
    and what each is for, in messages.

    1016h, 6007h and 6084h may be missing.
    """
    scale = profile.current_scale
    switch = () if scale.switch is None else (scale.switch,)
    return {
        profile.position: "position",
        profile.current: "current",
        STATUSWORD: "statusword",
        CONTROLWORD: "controlword",
        TARGET_POSITION: "target position",
        PROFILE_VELOCITY: "profile velocity",
        PROFILE_ACCELERATION: "profile acceleration",
        MODE_OF_OPERATION: "mode of operation",
        MODE_DISPLAY: "mode display",
        HEARTBEAT_TIME: "heartbeat period",
        **dict.fromkeys((*scale.objects, *switch), "scale of the current"),
    }


_PDO_PARAMETERS = {
    range(0x1400, 0x1600): "parameters of RPDO",
    range(0x1600, 0x1800): "mapping of RPDO",
    range(0x1800, 0x1A00): "parameters of TPDO",
    range(0x1A00, 0x1C00): "mapping of TPDO",
}
_PURPOSES = {
    0x1016: "watch over the recorder",
    0x1018: "identity",
    ABORT_CONNECTION.index: "stop when the recorder is lost",
    PROFILE_DECELERATION.index: "profile deceleration",
}


def purpose_of(entry: str, profile: DriveProfile) -> str:
    """Say what a recording needs an object for, as `ObjectAccessError.entry` names it;
    empty for one of no purpose.
    """
    for needed, purpose in needs_of(profile).items():
        if str(needed) == entry:
            return purpose
    try:
        index = int(entry[:4], 16)
    except ValueError:
        return ""
    for indices, purpose in _PDO_PARAMETERS.items():
        if index in indices:
            return f"{purpose}{index - indices.start + 1}"
    return _PURPOSES.get(index, "")


def refusal(error: ObjectAccessError, axis: Axis) -> SetupRefused:
    """Return the error of an object without which a drive cannot be set up,
    with what it is for and what to do.
    """
    purpose = purpose_of(error.entry, axis.profile)
    what = f" ({purpose})" if purpose else ""
    return SetupRefused(
        axis,
        f"found object {error.entry}{what} refused: {error.reason}",
        expected="an answer, as from the other objects that a recording needs",
        remedy="nothing has moved: is the drive being set up or updated by another tool, or in a "
        "state that locks its objects? switch it off and on, then try again",
    )


@dataclass(frozen=True, slots=True)
class Misfit:
    """What a drive lacks of its profile."""

    found: str  #: objects that it does not have, or of another size
    expected: str  #: instead
    remedy: str  #: what to do

    def __str__(self) -> str:
        return f"found {self.found}; expected {self.expected}; {self.remedy}"


def misfit(access: ObjectAccess, profile: DriveProfile, others: Profiles = tuple) -> Misfit | None:
    """Describe the objects of a profile that a drive does not have, and name a profile that fits;
    None if it has all.

    Raises:
        ObjectAccessError: the drive does not answer.
    """
    lacking = _lacking(access, profile)
    if not lacking:
        return None
    found = ", ".join(lacking)
    expected = f"every object of profile {profile.name}"
    if any(str(HEARTBEAT_TIME) in one for one in lacking):
        return Misfit(found, expected, HEARTBEATS_NEEDED)
    advised = []
    for other in others():
        if other.name != profile.name and not _lacking(access, other):
            advised.append(f"`{other.name}` ({_difference(other, profile)})")
    if advised:
        advice = " or ".join(advised)
        remedy = f"use a profile that fits this drive: {advice}"
    else:
        remedy = "no shipped profile fits this drive: write one with the objects of its manual"
    return Misfit(found, expected, remedy)


def why_no_heartbeat(access: ObjectAccess) -> str:
    """Say why a drive may send no heartbeat, by its objects, and what to do.

    Raises:
        ObjectAccessError: the drive does not answer.
    """
    period_ms = access.read_optional(HEARTBEAT_TIME, any_abort=True)
    period = "none" if period_ms is None else period_ms
    found = f"it answers SDO and sends no heartbeat (1017h = {period})"
    guard_ms = access.read_optional(GUARD_TIME, any_abort=True)
    if guard_ms is not None:
        found += f", and has node guarding (100Ch = {guard_ms})"
    return f"{found}; {HEARTBEATS_NEEDED}, or switch node guarding off in it"


def _lacking(access: ObjectAccess, profile: DriveProfile) -> tuple[str, ...]:
    found = []
    for entry, purpose in needs_of(profile).items():
        try:
            bits = 8 * len(access.read_bytes(entry.index, entry.subindex))
        except ObjectAccessError as error:
            if error.abort_code is None:
                raise
            if error.abort_code in NO_SUCH_OBJECT:
                found.append(f"no object {entry} ({purpose})")
            continue  # an object that cannot be read now exists
        if bits < entry.bits:
            found.append(f"object {entry} ({purpose}) of {bits} bits instead of {entry.bits}")
    return tuple(found)


def _difference(other: DriveProfile, profile: DriveProfile) -> str:
    """Describe the objects by which another profile differs."""
    same = needs_of(profile)
    parts = []
    for entry, purpose in needs_of(other).items():
        if same.get(entry) != purpose:
            parts.append(f"{purpose} from {entry}")
    if other.rated is not None:
        rated_current = None if profile.rated is None else profile.rated.current
        if other.rated.current != rated_current:
            parts.append(f"rated current from {other.rated.current}")
    return ", ".join(parts) or "the same objects in other units"


class HeartbeatGuard:
    """The watch of an amplifier over the recorder, by an entry of its 1016h (`consumers`).

    The entry is free, or `left_over` shows that it watches a killed recorder.
    """

    def __init__(
        self, access: ObjectAccess, consumers: Consumers | None, left_over: Callable[[int], bool]
    ) -> None:
        self.lack = ""  #: Missing capability, in words; empty when nothing is missing
        self.stays = False  #: Whether its values stay when all other settings are restored
        self._access = access
        self._is_over = False
        self._consumer: ObjectEntry | None = None
        self._consumer_before = 0
        self._option_before: int | None = None
        for entry, value in consumers or ():
            if (ours := left_over(value)) or not value & 0xFFFF:
                self._consumer = entry
                self._consumer_before = 0 if ours else value
                break
        else:
            free = "" if consumers is None else "free "
            self.lack = f"no {free}1016h: it does NOT stop by itself when the recorder is killed"
            return
        self._option_before = access.read_optional(ABORT_CONNECTION, any_abort=True)
        if self._option_before is None:
            self.lack = (
                "no 6007h: when the recorder is killed it stops in the way that its maker decided"
            )

    @property
    def watching(self) -> bool:
        """Whether the amplifier stops by itself when the recorder is killed."""
        return self._consumer is not None and not self._is_over

    @property
    def is_over(self) -> bool:
        """Whether the watch was taken off since it was armed."""
        return self._consumer is not None and self._is_over

    def end(self) -> None:
        """Restore the original values as far as possible; the watch then has to be armed again."""
        self._is_over = True
        for _, restore in self.restoring():
            # A failure is tried again, and reported, when the network closes.
            with suppress(DriverError):
                restore()

    def describe(self, silence_ms: int) -> str:
        """Describe the guard in words, for the log."""
        if self._consumer is None:
            return self.lack
        text = f"watches the recorder by {self._consumer}, {silence_ms} ms"
        if self.lack:
            text += f"; {self.lack}"
        return text

    def arm(self, recorder_id: int, silence_ms: int) -> None:
        """Let the amplifier quick stop after this silence of the recorder,
        counted from its first heartbeat.

        A refused write is reported in `lack`; the recording goes on.
        """
        self._is_over = False
        if self._consumer is None:
            return
        if self._option_before is not None and (
            refused := self._refused(ABORT_CONNECTION, QUICK_STOP_ON_LOSS)
        ):
            before = self._option_before
            self._option_before = None
            self.lack = (
                f"6007h = {before} rules how it stops when the recorder is killed: 3 is {refused}"
            )
        if refused := self._refused(self._consumer, recorder_id << 16 | silence_ms):
            if self._option_before is not None:
                self._access.write(ABORT_CONNECTION, self._option_before)
            self.lack = (
                f"it does NOT stop by itself when the recorder is killed: 1016h is {refused}"
            )
            self._consumer = None

    def _refused(self, entry: ObjectEntry, value: int) -> str:
        try:
            self._access.write(entry, value)
        except ObjectAccessError as error:
            if error.abort_code is None:
                raise
            return error.reason
        return ""

    def restoring(self) -> Iterator[tuple[str, Callable[[], object]]]:
        """Yield the steps that restore the original values, and their names."""
        if self._consumer is None:
            return
        yield "1016h", partial(self._access.write, self._consumer, self._consumer_before)
        if self._option_before is not None:
            yield "6007h", partial(self._access.write, ABORT_CONNECTION, self._option_before)


class AxisSetup:
    """The settings of one amplifier; each step keeps the original value first,
    so a half-done setup can be undone.
    """

    def __init__(self, link: Link, axis: Axis, guard: HeartbeatGuard) -> None:
        self.guard = guard  #: How the amplifier watches the recorder
        self._link = link
        self._axis = axis
        self._access = link.objects(axis.node_id)
        self._before: dict[ObjectEntry, int] = {}  # single settings that were changed
        self.pdos = AxisPdos((), ())  #: As they are mapped
        self._absent: tuple[ObjectEntry, ...] = ()
        self._found: dict[Direction, tuple[PdoRecord, ...]] = {}
        self._pdos_before: dict[str, PdoRecord] = {}

    @property
    def beats(self) -> bool:
        """Whether the amplifier was asked for heartbeats, which confirm its NMT state."""
        return HEARTBEAT_TIME in self._before

    def check(self, profiles: Profiles) -> None:
        """Check, before anything is written, that the drive has the objects and the PDOs that its
        profile needs.

        Raises:
            SetupRefused: it does not; `profiles` are those from which one that fits is named.
            ObjectAccessError: the drive does not answer.
        """
        access = self._access
        axis = self._axis
        lacking = misfit(access, axis.profile, profiles)
        if lacking is not None:
            raise SetupRefused(
                axis, f"found {lacking.found}", expected=lacking.expected, remedy=lacking.remedy
            )
        if access.read_optional(PROFILE_DECELERATION) is None:
            # Such a drive brakes with its profile acceleration
            self._absent = (PROFILE_DECELERATION,)
        for direction in Direction:
            read = (read_pdo_record(access, direction, number) for number in range(PDOS))
            self._found[direction] = tuple(record for record in read if record is not None)
        self.pdos = self._wanted(PDO_BYTES)

    def _wanted(self, most_bytes: int) -> AxisPdos:
        numbers = {}
        for direction, found in self._found.items():
            numbers[direction] = [record.number for record in found]
        try:
            return wanted_pdos(self._axis, numbers, self._absent, most_bytes)
        except ValueError as error:
            raise SetupRefused(
                self._axis, f"PDO: profile {self._axis.profile.name}: {error}"
            ) from error

    def send_heartbeats(self, period_ms: int) -> None:
        """Let the amplifier send heartbeats.

        Raises:
            SetupRefused: it refuses the period.
            ObjectAccessError: it does not answer.
        """
        self._change(HEARTBEAT_TIME, period_ms, f"heartbeats of {period_ms} ms", HEARTBEATS_NEEDED)
        self._link.count_beats(self._axis.node_id)

    def expect_plain_sync(self) -> None:
        """Let the amplifier answer SYNC without a counter, as it is sent.

        Raises:
            SetupRefused: it goes on waiting for a counter.
            ObjectAccessError: it does not answer.
        """
        counter = self._access.read_optional(SYNC_COUNTER, any_abort=True)
        if counter:
            remedy = (
                f"it waits for SYNC with a counter (1019h = {counter}): set it to 0 with the "
                "drive's own tool"
            )
            self._change(SYNC_COUNTER, 0, "SYNC without a counter, 0", remedy)

    def _read(self, entry: ObjectEntry, expected: str, remedy: str) -> int:
        with self._named(entry, "reading", expected, remedy):
            return self._access.read(entry)

    def _change(self, entry: ObjectEntry, value: int, expected: str, remedy: str) -> None:
        """Write a setting whose value before is restored at the end."""
        is_first = entry not in self._before
        if is_first:
            self._before[entry] = self._read(entry, expected, remedy)
        try:
            with self._named(entry, "writing", expected, remedy):
                self._access.write(entry, value)
        except SetupRefused:
            if is_first:
                del self._before[entry]  # it was not changed; without an answer, it may have been
            raise

    @contextmanager
    def _named(self, entry: ObjectEntry, action: str, expected: str, remedy: str) -> Iterator[None]:
        """Say of an object that the drive refuses what it is for, and what to do.

        Raises:
            SetupRefused: the drive refuses it.
            ObjectAccessError: the drive does not answer.
        """
        try:
            yield
        except ObjectAccessError as error:
            if error.abort_code is None:
                raise
            found = f"{action} {entry} is refused ({error.reason})"
            raise SetupRefused(
                self._axis, f"found {found}", expected=expected, remedy=remedy
            ) from error

    def map_pdos(self) -> None:
        """Map position, current and statusword into TPDOs and the set-points into RPDOs;
        all other PDOs go off.

        Where the drive refuses that, PDOs of six bytes are tried, and its own PDOs are used if they
        carry the same.

        Raises:
            SetupRefused: a mapping is impossible, was refused, or reads back differently.
        """
        tpdos = self._found[Direction.TPDO]
        rpdos = self._found[Direction.RPDO]
        own_feedback = fixed_feedback(self._axis, tpdos)
        feedback = self._map(lambda pdos: pdos.feedback, tpdos, own_feedback)
        own_setpoints = fixed_setpoints(rpdos, self._absent)
        setpoints = self._map(lambda pdos: pdos.setpoints, rpdos, own_setpoints)
        self.pdos = AxisPdos(feedback, setpoints)

    def _map(
        self,
        used: Callable[[AxisPdos], tuple[PdoRecord, ...]],
        found: Sequence[PdoRecord],
        own: tuple[PdoRecord, ...],
    ) -> tuple[PdoRecord, ...]:
        """Map the PDOs of one direction; returns those of its own where the drive refuses
        others.
        """
        try:
            return self._write(used(self._wanted(PDO_BYTES)), found)
        except SetupRefused as refused:
            if getattr(refused.__cause__, "abort_code", None) is None:
                raise
            for most_bytes in (SMALL_PDO_BYTES, None):
                with suppress(SetupRefused):
                    if pdos := own if most_bytes is None else used(self._wanted(most_bytes)):
                        return self._write(pdos, found)
            raise

    def _write(
        self, pdos: tuple[PdoRecord, ...], found: Sequence[PdoRecord]
    ) -> tuple[PdoRecord, ...]:
        wanted = {record.number: record for record in pdos}
        for before in found:
            if before.number in wanted:
                self._pdos_before.setdefault(before.name, before)
                write_pdo_record(self._access, wanted[before.number])
            elif not before.cob_id & NOT_VALID:
                self._pdos_before.setdefault(before.name, before)
                turn_off(self._access, before)  # a drive's default PDOs would come between ours
        return pdos

    def set_mode(self, within_s: float) -> None:
        """Select profile position mode, and wait until 6061h shows it.

        Raises:
            SetupRefused: the amplifier refuses the mode, or 6061h does not show it in time.
            ObjectAccessError: the amplifier does not answer.
        """
        expected = "profile position mode (1), in which the drive makes the moves by itself"
        self._change(MODE_OF_OPERATION, PROFILE_POSITION_MODE, expected, self._mode_remedy())
        deadline = self._link.clock() + round(within_s * 1e9)
        while True:
            shown = self._read(MODE_DISPLAY, expected, MODE_REMEDY)
            if shown == PROFILE_POSITION_MODE:
                return
            if self._link.clock() >= deadline:
                raise SetupRefused(
                    self._axis,
                    f"found mode {shown} in 6061h, {within_s:g} s after it was asked for another",
                    expected=expected,
                    remedy=MODE_REMEDY,
                )
            self._link.pass_time()

    def _mode_remedy(self) -> str:
        """Say what to do where the mode is refused, by bit 0 of the reported modes (6502h)."""
        supported = self._access.read_optional(SUPPORTED_MODES, any_abort=True)
        if supported is None or supported & 1:
            return MODE_REMEDY
        return (
            f"the drive does not have it (6502h = {supported:#x}, bit 0 is 0): this firmware "
            "cannot be recorded"
        )

    def restore(self, problems: list[DriverError]) -> tuple[str, ...]:
        """Restore all settings; returns the names of those that are left.

        They are left when the amplifier refuses them or falls silent, when the time for closing is
        over, or when the bus fails again and again. Failures are appended to `problems`.
        """
        steps = list(self._restoring())
        unreached: list[str] = []
        for number, (name, step) in enumerate(steps):
            left = tuple(name for name, _ in steps[number:])
            if self._link.allowed_s(1.0) <= 0.0:
                return (*unreached, *left)
            try:
                try_twice(step, problems)
            except BusError:
                unreached.append(name)
            except DriverError as problem:
                in_time = self._link.allowed_s(1.0) > 0.0
                silent = isinstance(problem, ObjectAccessError) and problem.abort_code is None
                if in_time or not silent:
                    problems.append(problem)
                if silent:
                    return (*unreached, *left)
                unreached.append(name)
        return tuple(unreached)

    def _restoring(self) -> Iterator[tuple[str, Callable[[], object]]]:
        """Yield the steps that restore all settings, and their names; the heartbeat last."""
        for record in self._pdos_before.values():
            yield record.name, partial(write_pdo_record, self._access, record)
        for entry in (SYNC_COUNTER, MODE_OF_OPERATION):
            if entry in self._before:
                yield f"{entry.index:04X}h", partial(self._access.write, entry, self._before[entry])
        if not self.guard.stays:
            yield from self.guard.restoring()
        if HEARTBEAT_TIME in self._before:
            yield "1017h", partial(self._access.write, HEARTBEAT_TIME, self._before[HEARTBEAT_TIME])

    def describe(
        self, identity: Identity, scale: ScaleReading, silence_ms: int
    ) -> dict[str, object]:
        """Return what the drive reported during the setup, for the log."""
        profile = self._axis.profile
        return {
            "node_id": self._axis.node_id,
            **asdict(identity),
            "profile": profile.name,
            # The recorded current: without both, a gain of this log cannot be compared with
            # another's.
            "amplitude": profile.amplitude.value,
            "tap": profile.tap.value,
            "signal": profile.signal,
            "scale_objects": scale.objects,
            "ampere_per_unit": scale.ampere_per_unit,
            "rated_current_a": scale.rated_current_a,
            "rated_torque_nm": scale.rated_torque_nm,
            "scale_warnings": list(scale.warnings),
            "guard": self.guard.describe(silence_ms),
            "mode_before": self._before.get(MODE_OF_OPERATION),
            "mapping": [str(record) for record in self.pdos.feedback + self.pdos.setpoints],
            "mapping_before": [str(record) for record in self._pdos_before.values()],
        }
