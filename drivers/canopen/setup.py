"""Set one amplifier up for a recording, and restore afterwards the settings that it had before."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from functools import partial

from drivers.canopen.link import Link
from drivers.canopen.pdo import (
    NOT_VALID,
    PDOS,
    SETPOINT_PDOS,
    STATUSWORD,
    Direction,
    PdoRecord,
    feedback_entries,
    pack,
    read_record,
    records,
    write_record,
)
from drivers.errors import SetupRefused, StateRefused
from drivers.motion.guard import Guard
from drivers.profiles.profile import Axis, Identity, ObjectEntry
from drivers.profiles.scale import ScaleReading

HEARTBEAT_TIME = ObjectEntry(0x1017, 0, 16, signed=False)
MODE_OF_OPERATION = ObjectEntry(0x6060, 0, 8, signed=True)
MODE_DISPLAY = ObjectEntry(0x6061, 0, 8, signed=True)
PROFILE_POSITION_MODE = 1


class AxisSetup:
    """The settings of one amplifier; each step keeps the original value first, so a half-done setup can be undone."""

    def __init__(self, link: Link, axis: Axis, guard: Guard) -> None:
        self.guard = guard  #: How the amplifier watches the recorder
        self._link = link
        self._axis = axis
        self._access = link.objects(axis.node_id)
        self._heartbeat_ms: int | None = None
        self._mode: int | None = None
        self._pdos_before: dict[str, PdoRecord] = {}
        self._pdos: tuple[PdoRecord, ...] = ()

    def send_heartbeats(self, period_ms: int) -> None:
        """Let the amplifier send heartbeats."""
        if self._heartbeat_ms is None:
            self._heartbeat_ms = self._access.read(HEARTBEAT_TIME)
        self._access.write(HEARTBEAT_TIME, period_ms)

    def map_pdos(self) -> None:
        """Map position, current and statusword into TPDOs and the set-points into RPDOs; all other PDOs go off.

        Raises:
            SetupRefused: a mapping is impossible, was refused, or reads back differently.
        """
        axis, node_id = self._axis, self._axis.node_id
        try:
            feedback = pack(feedback_entries(axis))
        except ValueError as error:
            raise SetupRefused(axis, f"TPDO: profile {axis.profile.name}: {error}") from error
        wanted = {
            Direction.TPDO: records(Direction.TPDO, node_id, feedback),
            Direction.RPDO: records(Direction.RPDO, node_id, SETPOINT_PDOS),
        }
        for direction, pdos in wanted.items():
            for number in range(PDOS):
                found = read_record(self._access, direction, number)
                if found is None:
                    if number < len(pdos):
                        raise SetupRefused(axis, f"{pdos[number].name}: the drive has no such PDO")
                elif number < len(pdos):
                    self._pdos_before.setdefault(found.name, found)
                    write_record(self._access, pdos[number])
                elif not found.cob_id & NOT_VALID:
                    self._pdos_before.setdefault(found.name, found)
                    # A drive's default PDOs would come between ours.
                    write_record(self._access, replace(found, cob_id=found.cob_id | NOT_VALID))
        self._pdos = wanted[Direction.TPDO] + wanted[Direction.RPDO]

    def set_mode(self, within_s: float) -> None:
        """Select profile position mode, and wait until 6061h shows it; StateRefused where it does not in time."""
        access = self._access
        if self._mode is None:
            self._mode = access.read(MODE_OF_OPERATION)
        access.write(MODE_OF_OPERATION, PROFILE_POSITION_MODE)
        deadline = self._link.clock() + round(within_s * 1e9)
        while (shown := access.read(MODE_DISPLAY)) != PROFILE_POSITION_MODE:
            if self._link.clock() >= deadline:
                found = f"mode {shown} in 6061h"
                raise StateRefused(self._axis, "profile position mode (1)", found, access.read(STATUSWORD))
            self._link.pass_time()

    def restoring(self) -> Iterator[Callable[[], object]]:
        """Yield the steps that restore all settings; the heartbeat last."""
        for record in self._pdos_before.values():
            yield partial(write_record, self._access, record)
        if self._mode is not None:
            yield partial(self._access.write, MODE_OF_OPERATION, self._mode)
        yield self.guard.disarm
        if self._heartbeat_ms is not None:
            yield partial(self._access.write, HEARTBEAT_TIME, self._heartbeat_ms)

    def describe(self, identity: Identity, scale: ScaleReading, silence_ms: int) -> dict[str, object]:
        """Return what the drive reported during the setup, for the log."""
        profile = self._axis.profile
        return {
            "node_id": self._axis.node_id,
            **asdict(identity),
            "profile": profile.name,
            # The recorded current: without both, a gain of this log cannot be compared with another's.
            "amplitude": profile.amplitude.value,
            "tap": profile.tap.value,
            "signal": profile.signal,
            "scale_objects": scale.objects,
            "ampere_per_unit": scale.ampere_per_unit,
            "rated_current_a": scale.rated_current_a,
            "rated_torque_nm": scale.rated_torque_nm,
            "scale_warnings": list(scale.warnings),
            "guard": self.guard.describe(silence_ms),
            "mode_before": self._mode,
            "mapping": [str(record) for record in self._pdos],
            "mapping_before": [str(record) for record in self._pdos_before.values()],
        }
