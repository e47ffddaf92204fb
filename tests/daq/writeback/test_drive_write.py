"""Gains written into the objects of simulated drives:
without power, read back, saved, all or none, and back again.
"""

from __future__ import annotations

import errno
import json
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from daq.config.cell import Cell
from daq.config.controller import Controller, GainObject
from daq.errors import (
    CalibrationRefused,
    ConfigurationInconsistent,
    ControllerChanged,
    ControllerUnfit,
    OutputFailed,
)
from daq.ledger.audit import AuditAction, Content, read, verify
from daq.ledger.ledger import Ledger, acknowledge, plan_rename, read_history, rename_cell
from daq.ledger.names import drives_of
from daq.writeback.drive_target import (
    DriveEdit,
    DriveNote,
    DriveRecord,
    DriveTarget,
    read_record,
    read_records,
    record_folder,
    write_record,
)
from daq.writeback.gates.gate import Gate
from daq.writeback.request import Request
from daq.writeback.target import Proposal, Written, apply, propose, rollback
from drivers.canopen.bus import BusAddress
from drivers.canopen.network import CanopenNetwork
from drivers.canopen.parameters import Saving
from drivers.canopen.pdo import CONTROLWORD
from drivers.canopen.sdo import ObjectAccess
from drivers.errors import (
    BusBusy,
    DriverError,
    ObjectAccessError,
    ParameterRefused,
    ParametersMixed,
    SetupRefused,
)
from drivers.profiles.profile import Mapping, ObjectEntry, ParameterKind
from drivers.simulation.cell import SimulatedCell
from drivers.simulation.faults import FaultKind, FaultSpec
from drivers.simulation.hub import Hub
from drivers.simulation.node import NmtCommand, NmtState
from ident.calibration import Calibration
from tests.daq.calibrations import AXES, IDENTIFIED, NAMEPLATE, demo_calibration, of_first_axes
from tests.daq.drives import (
    REAL,
    WHOLE,
    Listener,
    demo_cell,
    entered_gain,
    network_of,
    saved_gain,
    simulated,
)

NOW = datetime(2025, 1, 2, 3, 4, 5, tzinfo=UTC)
GAIN = ObjectEntry(0x2003, 1, 32, signed=True)
IN_DRIVES = pytest.approx(NAMEPLATE)
NEW = pytest.approx(IDENTIFIED)
NEW = pytest.approx(IDENTIFIED)
WRITERS = multiprocessing.get_context("forkserver")
WRITERS.set_forkserver_preload([__name__])


@pytest.fixture
def address(request: pytest.FixtureRequest) -> BusAddress:
    return BusAddress("virtual", request.node.nodeid)


@pytest.fixture
def listener(address: BusAddress) -> Iterator[Listener]:
    heard = Listener(address)
    yield heard
    heard.close()


def _propose(
    cell: Cell,
    network: CanopenNetwork,
    calibration: Calibration | None = None,
    base: str | None = None,
) -> Proposal[DriveEdit]:
    request = Request(
        calibration or demo_calibration(), NOW, accepts_changed_configuration=True, base=base
    )
    target = DriveTarget(cell, network)
    return propose(target, request)


def _apply(
    proposal: Proposal[DriveEdit], target: DriveTarget, audit: Path | None = None
) -> Written:
    """Write a proposal, in a network that may be another than the one it was planned in."""
    changed_proposal = replace(proposal, target=target)
    written = apply(changed_proposal, NOW, audit=audit, who="T")
    assert written is not None
    return written


def _write(
    cell: Cell,
    address: BusAddress,
    saving: Saving = Saving.KNOWN,
    mapping: Mapping = Mapping.STORED,
) -> Written:
    """Look, and then write, each in a network of its own, as two commands do."""
    with network_of(cell, address, mapping) as network:
        proposal = _propose(cell, network)
    assert proposal.refusals == ()
    assert cell.history is not None
    with network_of(cell, address, mapping) as network:
        target = DriveTarget(cell, network, saving)
        return _apply(proposal, target, cell.history.audit)


def _backup(written: Written) -> Path:
    assert written.backup is not None
    return written.backup


def _gains(simulation: SimulatedCell) -> list[float]:
    return [entered_gain(node) for node in simulation.nodes]


def _saved(simulation: SimulatedCell) -> list[float]:
    return [saved_gain(node) for node in simulation.nodes]


def _first_written(count: int) -> object:
    """Gains of the drives where only the first ones are identified, to compare with."""
    written = IDENTIFIED[:count]
    left = NAMEPLATE[count:]
    return pytest.approx([*written, *left])


def _enter_in_j5(network: CanopenNetwork, word: int) -> None:
    """Write the gain of J5 as someone else does."""
    objects = network.link.objects(5)
    objects.write(GAIN, word)


def _roll_back(cell: Cell, network: CanopenNetwork, audit: Path) -> None:
    target = DriveTarget(cell, network)
    rollback(target, NOW, audit=audit, who="T")


def _acknowledge_gearbox(cell: Cell) -> None:
    """Something under the name of a cell, without which there is nothing to rename."""
    ledger = Ledger.of(cell)
    assert ledger is not None
    acknowledge(ledger, "J1", since=NOW, at=NOW, who="T", why="new gearbox")


def _rename_demo(ledger: Ledger, at: datetime = NOW) -> None:
    planned = plan_rename(ledger, "demo")
    rename_cell(ledger, planned, who="T", at=at)


def test_gains_are_written_read_back_and_saved(
    address: BusAddress, listener: Listener, tmp_path: Path
) -> None:
    cell = demo_cell(tmp_path)
    with simulated(address) as simulation:
        before = [node.saved for node in simulation.nodes]
        written = _write(cell, address)
        new_gains = [change.parameter.value(change.new) / 1000.0 for change in written.parameters]
        assert new_gains == NEW
        assert all(change.saved for change in written.parameters)
        assert _gains(simulation) == NEW
        # A drive that loses its power comes back with what it saved: the gain, and the mapping of
        # before.
        for node in simulation.nodes:
            node.command_nmt(NmtCommand.RESET_NODE, 0.0)
        assert _gains(simulation) == NEW
        pdos = [node.saved.pdos for node in simulation.nodes]
        expected = [stored.pdos for stored in before]
        assert pdos == expected
    nodes = [node for node, *_ in listener.downloads()]
    once = [1, 2, 3, 4, 5, 6]
    assert nodes == once + once


def test_nothing_but_the_gain_and_the_save_is_ever_sent(
    address: BusAddress, listener: Listener, tmp_path: Path
) -> None:
    """No controlword, no NMT, no SYNC, no PDO and no heartbeat: nothing can move."""
    with simulated(address):
        listener.frames()
        _write(demo_cell(tmp_path), address)
    heard = listener.frames()
    identifiers = set()
    written = set()
    for frame in heard:
        is_answer = 0x580 < frame.arbitration_id < 0x600
        is_heartbeat = frame.arbitration_id >= 0x700
        if is_answer or is_heartbeat:
            continue
        identifiers.add(frame.arbitration_id)
        is_download = frame.data[0] >> 5 == 1
        if is_download:
            index = int.from_bytes(frame.data[1:3], "little")
            written.add(index)
    assert identifiers == {0x601, 0x602, 0x603, 0x604, 0x605, 0x606}
    assert written == {0x2003, 0x1010}
    assert CONTROLWORD.index not in written


def test_a_dry_run_writes_nothing(address: BusAddress, listener: Listener, tmp_path: Path) -> None:
    cell = demo_cell(tmp_path)
    with simulated(address), network_of(cell, address) as network:
        proposal = _propose(cell, network)
    assert listener.downloads() == []
    assert list(tmp_path.iterdir()) == []
    current_gains = [change.current_gain for change in proposal.edit.changes]
    assert current_gains == IN_DRIVES
    assert [change.new for change in proposal.edit.changes] == NEW
    assert proposal.edit.changes[3].key == "J4, 2003h:01"
    assert proposal.edit.before != proposal.edit.after


def test_a_real_object_and_another_sign_and_unit(address: BusAddress, tmp_path: Path) -> None:
    negative = replace(REAL, factor=-0.5)
    cell = demo_cell(tmp_path, REAL, REAL, REAL, negative, REAL, REAL)
    entered = list(NAMEPLATE)
    entered[3] = 5.76
    with simulated(address, entered=tuple(entered)) as simulation:
        written = _write(cell, address)
        gain_of_j4 = entered_gain(simulation.nodes[3], REAL)
        gain_of_j1 = entered_gain(simulation.nodes[0], REAL)
        assert gain_of_j4 == pytest.approx(4.605, rel=1e-6)
        assert gain_of_j1 == pytest.approx(33.9, rel=1e-6)
    parameter = written.parameters[0].parameter
    assert parameter.kind is ParameterKind.F32


def test_written_to_ram_alone_is_gone_with_the_power(address: BusAddress, tmp_path: Path) -> None:
    with simulated(address) as simulation:
        written = _write(demo_cell(tmp_path), address, Saving.RAM, Mapping.UNKNOWN)
        assert not any(change.saved for change in written.parameters)
        assert _gains(simulation) == NEW
        assert _saved(simulation) == IN_DRIVES
        # A value in RAM is no reason not to save it the next time.
        parameters = _write(demo_cell(tmp_path), address).parameters
        assert all(change.saved for change in parameters)
        assert _saved(simulation) == NEW


@pytest.mark.parametrize("axis", [0, 4])
def test_an_axis_with_power_is_refused_and_nothing_is_written(
    address: BusAddress, listener: Listener, tmp_path: Path, axis: int
) -> None:
    cell = demo_cell(tmp_path)
    number = axis + 1
    with simulated(address) as simulation:
        with network_of(cell, address) as network:
            proposal = _propose(cell, network)
            objects = network.link.objects(number)
            for command in (0x06, 0x07, 0x0F):
                objects.write(CONTROLWORD, command)
        listener.frames()
        with (
            network_of(cell, address) as network,
            pytest.raises(
                ParameterRefused,
                match=rf"J{number} \(node {number}\): "
                r"OPERATION ENABLED",
            ),
        ):
            _apply(proposal, DriveTarget(cell, network))
        assert listener.downloads() == []
        assert _gains(simulation) == IN_DRIVES
    assert read_records(record_folder(cell)) == ()


def test_power_that_comes_midway_ends_it_and_the_rest_is_put_back(
    address: BusAddress, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = demo_cell(tmp_path)

    def enable_2(access: ObjectAccess) -> None:
        if access.node_id == 2:
            for command in (0x06, 0x07, 0x0F):
                write(access, CONTROLWORD, command)

    write = _after_gain(monkeypatch, enable_2)
    with simulated(address) as simulation:
        with pytest.raises(
            ParametersMixed,
            match=r"restored in J1, and NOT confirmed where J2 "
            r"\(node 2\)",
        ):
            _write(cell, address)
        first, second, *others = _gains(simulation)
        assert first == pytest.approx(NAMEPLATE[0])
        assert second == pytest.approx(IDENTIFIED[1])
        assert others == pytest.approx(NAMEPLATE[2:])
        assert _saved(simulation) == IN_DRIVES


Write = Callable[[ObjectAccess, ObjectEntry, int], None]


def _after_gain(monkeypatch: pytest.MonkeyPatch, then: Callable[[ObjectAccess], None]) -> Write:
    """Let something happen after each write of a gain; the write as it was."""
    write = ObjectAccess.write

    def written(access: ObjectAccess, entry: ObjectEntry, value: int) -> None:
        write(access, entry, value)
        if entry.index == 0x2003:
            then(access)

    monkeypatch.setattr(ObjectAccess, "write", written)
    return write


@pytest.mark.parametrize(
    "kind", [FaultKind.REFUSES_WRITE, FaultKind.REFUSES_SAVE], ids=lambda kind: kind.value
)
def test_an_abort_on_axis_3_puts_the_old_values_back_and_saves_them(
    address: BusAddress, tmp_path: Path, kind: FaultKind
) -> None:
    cell = demo_cell(tmp_path)
    with simulated(address, FaultSpec(kind, 2)) as simulation:
        with pytest.raises(
            ObjectAccessError,
            match=r"J3 \(node 3\): object "
            r"(2003h:01|1010h:01): aborted",
        ) as caught:
            _write(cell, address)
        names = ", ".join(AXES[:3])
        if kind is FaultKind.REFUSES_SAVE:
            names = ", ".join(AXES)
        notes = caught.value.__notes__
        assert notes == [f"kept: the previous values are restored in {names}"]
        assert _gains(simulation) == IN_DRIVES
        assert _saved(simulation) == IN_DRIVES


def test_a_drive_that_falls_silent_is_named_and_the_others_are_put_back(
    address: BusAddress, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = demo_cell(tmp_path)
    with simulated(address) as simulation:

        def stop(access: ObjectAccess) -> None:
            if access.node_id == 3:
                simulation.nodes[2].nmt = NmtState.STOPPED

        _after_gain(monkeypatch, stop)
        # Where the host is late, the search for silent nodes can end before this node counts as
        # one.
        silent = r"the node does not answer|no answer within 0\.3 s, asked 3 times"
        with pytest.raises(
            ParametersMixed,
            match=r"J3 \(node 3\): object 2003h:01: "
            rf"({silent})",
        ) as caught:
            _write(cell, address)
        assert caught.value.restored == ("J1", "J2")
        assert isinstance(caught.value.__cause__, ObjectAccessError)
        third_written = list(NAMEPLATE)
        third_written[2] = IDENTIFIED[2]
        assert _gains(simulation) == pytest.approx(third_written)
        # It comes back, and the record leads back.
        simulation.nodes[2].nmt = NmtState.OPERATIONAL
        monkeypatch.undo()
        with network_of(cell, address) as network:
            rollback(DriveTarget(cell, network), NOW)
        assert _gains(simulation) == IN_DRIVES
        assert _saved(simulation) == IN_DRIVES


@pytest.mark.slow
@pytest.mark.parametrize("made", [False, True], ids=["aborted", "answer lost"])
def test_whichever_transfer_fails_the_old_values_stay_everywhere(
    address: BusAddress, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, made: bool
) -> None:
    """Every SDO transfer of the path fails once, before it was made or after;
    only the whole way changes all.

    Of three drives: the first, one in between and the last; the others are on the bus and left
    alone.
    """
    every_axis = demo_cell(tmp_path)
    count = 3
    left = 0
    objects = (WHOLE,) * count
    controller = Controller(objects=objects)
    axes = every_axis.axes[:count]
    cell = replace(every_axis, axes=axes, controller=controller)
    changed = _first_written(count)

    def failing(transfer: Callable[..., int | None]) -> Callable[..., int | None]:
        def tried(access: ObjectAccess, entry: ObjectEntry, *value: int) -> int | None:
            nonlocal left
            left -= 1
            if left == 0 and not made:
                raise ObjectAccessError(access.node_id, str(entry), "aborted", 0x08000020)
            result = transfer(access, entry, *value)
            if left == 0:
                raise ObjectAccessError(access.node_id, str(entry), "no answer")
            return result

        return tried

    with simulated(address) as simulation:
        with network_of(cell, address) as network:
            calibration = of_first_axes(demo_calibration(), count)
            proposal = _propose(cell, network, calibration)
        assert proposal.refusals == ()
        monkeypatch.setattr(ObjectAccess, "read", failing(ObjectAccess.read))
        monkeypatch.setattr(ObjectAccess, "write", failing(ObjectAccess.write))
        failed = 0
        while True:
            left = failed + 1
            with network_of(cell, address) as network:
                network.bounds = replace(network.bounds, listen_s=0.0)
                try:
                    _apply(proposal, DriveTarget(cell, network))
                except DriverError:
                    failed += 1
                else:
                    break
            assert _gains(simulation) == IN_DRIVES
            assert _saved(simulation) == IN_DRIVES
        assert left > 0  # no transfer was left to fail
        assert _gains(simulation) == changed
        assert _saved(simulation) == changed
    assert failed > 25 * count


@pytest.mark.parametrize(
    "kind", [FaultKind.SECOND_MASTER, FaultKind.SDO_MASTER], ids=lambda kind: kind.value
)
def test_a_foreign_master_is_refused(address: BusAddress, tmp_path: Path, kind: FaultKind) -> None:
    cell = demo_cell(tmp_path)
    with simulated(address, FaultSpec(kind, 1)) as simulation:
        with network_of(cell, address) as network, pytest.raises(BusBusy):
            _propose(cell, network)
        assert _gains(simulation) == IN_DRIVES


def test_a_foreign_master_that_comes_midway_ends_it(
    address: BusAddress, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = demo_cell(tmp_path)

    device_type = ObjectEntry(0x1000, 0, 32, signed=False)

    def greet(access: ObjectAccess) -> None:
        if access.node_id == 3:
            with network_of(cell, address) as other:
                other.link.objects(1).read(device_type)

    _after_gain(monkeypatch, greet)
    with simulated(address) as simulation:
        with pytest.raises(BusBusy) as caught:
            _write(cell, address)
        assert "kept: the previous values are restored in J1, J2, J3" in caught.value.__notes__
        assert _gains(simulation) == IN_DRIVES


def test_another_drive_is_refused(address: BusAddress, tmp_path: Path) -> None:
    cell = demo_cell(tmp_path)
    faulty = simulated(address, FaultSpec(FaultKind.OTHER_SERIAL, 5))
    refused = pytest.raises(SetupRefused, match="node 6")
    with faulty, network_of(cell, address) as network, refused:
        _propose(cell, network)


def test_a_drive_that_keeps_something_else_is_found(
    address: BusAddress, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = ObjectAccess.write
    cell = demo_cell(tmp_path)
    gain_of_j4 = 2**32 - 9210

    def rounding(access: ObjectAccess, entry: ObjectEntry, value: int) -> None:
        is_gain = entry.index == 0x2003 and access.node_id == 4
        if is_gain and value == gain_of_j4:
            value += 1
        write(access, entry, value)

    monkeypatch.setattr(ObjectAccess, "write", rounding)
    with simulated(address) as simulation:
        with pytest.raises(
            ParameterRefused,
            match=r"reads back as -9209 .*written "
            r"was -9210",
        ) as caught:
            _write(cell, address)
        assert caught.value.__notes__ == [
            "kept: the previous values are restored in J1, J2, J3, J4"
        ]
        assert _gains(simulation) == IN_DRIVES


def test_what_a_killed_recording_left_is_not_saved(
    address: BusAddress, listener: Listener, tmp_path: Path
) -> None:
    cell = demo_cell(tmp_path)
    with simulated(address) as simulation:
        with network_of(cell, address) as network:
            proposal = _propose(cell, network)
        killed = network_of(cell, address)
        killed.link.open()
        killed.prepare()
        killed.link.close()
        for node in simulation.nodes:
            node.inject(FaultKind.NO_GUARD)  # the mapping alone must be enough
        listener.frames()
        with (
            network_of(cell, address) as network,
            pytest.raises(ParameterRefused, match="TPDO1: COB-ID 00000181h"),
        ):
            _apply(proposal, DriveTarget(cell, network))
        assert listener.downloads() == []
        assert _saved(simulation) == IN_DRIVES
        # Categories of their own do not keep the mapping, and RAM keeps nothing.
        with network_of(cell, address, Mapping.SEPARATE) as network:
            target = DriveTarget(cell, network)
            assert _apply(proposal, target).parameters[0].saved
        assert _gains(simulation) == NEW


@pytest.mark.parametrize("recorder_id", [127, 126], ids=["usual", "127 was a device's"])
def test_a_drive_that_still_waits_for_a_recorder_is_not_saved(
    address: BusAddress, tmp_path: Path, recorder_id: int
) -> None:
    """Killed before the mapping was touched:
    1016h would stop the axis for want of a recorder, for ever.
    """
    cell = demo_cell(tmp_path)
    with simulated(address) as simulation, network_of(cell, address) as network:
        proposal = _propose(cell, network)
        consumer = ObjectEntry(0x1016, 1, 32, signed=False)
        awaited = recorder_id << 16 | 500
        network.link.objects(2).write(consumer, awaited)
        with pytest.raises(
            ParameterRefused,
            match=rf"J2 \(node 2\): .*1016h:01 = 00{recorder_id:02X}01F4h "
            r"watches the recorder",
        ):
            _apply(proposal, DriveTarget(cell, network))
        assert _gains(simulation) == IN_DRIVES


def test_a_save_of_which_nothing_is_known_is_refused_unless_asked_for(
    address: BusAddress, tmp_path: Path
) -> None:
    cell = demo_cell(tmp_path)
    with simulated(address) as simulation:
        with pytest.raises(
            ParameterRefused,
            match=r"J1 \(node 1\): "
            r".*`Saving\.RAM`.*`Saving\.ANY`",
        ):
            _write(cell, address, mapping=Mapping.UNKNOWN)
        assert _gains(simulation) == IN_DRIVES
        parameters = _write(cell, address, Saving.ANY, Mapping.UNKNOWN).parameters
        assert all(change.saved for change in parameters)
        assert _saved(simulation) == NEW


def test_a_profile_without_a_save_is_refused(address: BusAddress, tmp_path: Path) -> None:
    cell = demo_cell(tmp_path)
    with simulated(address) as simulation, network_of(cell, address) as network:
        axes = []
        for axis in network.axes:
            without_save = replace(axis.profile, save=None)
            axes.append(replace(axis, profile=without_save))
        network.axes = tuple(axes)
        proposal = _propose(cell, network)
        target = DriveTarget(cell, network, Saving.ANY)
        with pytest.raises(ParameterRefused, match="is not described in its profile"):
            _apply(proposal, target)
        assert _gains(simulation) == IN_DRIVES


def test_the_gates_are_those_of_a_file(
    address: BusAddress, listener: Listener, tmp_path: Path
) -> None:
    cell = demo_cell(tmp_path)
    calibration = demo_calibration()
    first, *others = calibration.gains
    far_gain = replace(first, value=60.0)
    far = replace(calibration, gains=(far_gain, *others))
    with simulated(address), network_of(cell, address) as network:
        base = "0" * 64
        proposal = _propose(cell, network, far, base=base)
        expected = [Gate.BASE, Gate.CHANGE, Gate.NAMEPLATE]
        gates = [refusal.gate for refusal in proposal.refusals]
        assert gates == expected
        base_sha256 = _propose(cell, network).edit.base_sha256
        reviewed = _propose(cell, network, base=base_sha256)
        assert reviewed.refusals == ()
        target = DriveTarget(cell, network)
        audit = tmp_path / "audit"
        with pytest.raises(CalibrationRefused, match="3 failed checks"):
            _apply(proposal, target, audit)
        *first_five, last = calibration.gains
        other_axis = replace(last, axis="J9")
        strange = replace(calibration, gains=(*first_five, other_axis))
        with pytest.raises(CalibrationRefused, match="one for each axis of the cell"):
            _propose(cell, network, strange)
        nowhere = replace(cell, controller=None)
        with pytest.raises(ConfigurationInconsistent, match="no objects in the drives"):
            _propose(nowhere, network)
    assert listener.downloads() == []
    path = tmp_path / "audit"
    actions = [entry.action for entry in read(path)]
    assert actions == [AuditAction.REFUSED]


@pytest.mark.parametrize(
    ("gain_object", "says"),
    [
        (
            GainObject(index=0x2003, subindex=1, type=ParameterKind.I32, factor=1.0),
            "± 0.14, which the number 34 does not represent",
        ),
        (
            GainObject(index=0x2003, subindex=1, type=ParameterKind.I32, factor=1e9),
            "does not fit i32",
        ),
        (
            GainObject(index=0x2003, subindex=1, type=ParameterKind.I32, factor=1e-3),
            "the number 0 does not represent",
        ),
        (
            GainObject(index=0x2003, subindex=1, type=ParameterKind.U32, factor=-1.0),
            "does not fit u32",
        ),
    ],
)
def test_an_object_that_cannot_hold_the_gain_is_refused(
    address: BusAddress, tmp_path: Path, gain_object: GainObject, says: str
) -> None:
    calibration = demo_calibration()
    first, *others = calibration.gains
    changed_gain = replace(first, value=33.7, std=0.135)
    changed = replace(calibration, gains=(changed_gain, *others))
    cell = demo_cell(tmp_path, *(gain_object,) * 6)
    with (
        simulated(address),
        network_of(cell, address) as network,
        pytest.raises(ControllerUnfit) as caught,
    ):
        _propose(cell, network, changed)
    assert says in str(caught.value)


def test_a_drive_that_someone_changed_since_the_dry_run_is_refused(
    address: BusAddress, tmp_path: Path
) -> None:
    cell = demo_cell(tmp_path)
    with simulated(address) as simulation, network_of(cell, address) as network:
        proposal = _propose(cell, network)
        _enter_in_j5(network, 18000)
        with pytest.raises(ControllerChanged, match="take a new dry run"):
            _apply(proposal, DriveTarget(cell, network))
        assert _gains(simulation)[4] == 18.0
    assert read_records(record_folder(cell)) == ()


def test_back_and_forth(address: BusAddress, tmp_path: Path) -> None:
    cell = demo_cell(tmp_path)
    assert cell.history is not None
    with simulated(address) as simulation:
        written = _write(cell, address)
        record = read_record(_backup(written))
        first, second, *_ = record.drives
        assert (first.axis, first.serial, first.old, first.new) == ("J1", 1001, 32960, 33900)
        assert (second.axis, second.serial, second.old, second.new) == ("J2", 1002, 32960, 32400)
        for minutes, expected in ((1, IN_DRIVES), (2, NEW), (2, IN_DRIVES)):
            with network_of(cell, address) as network:
                now = NOW + timedelta(minutes=minutes)
                target = DriveTarget(cell, network)
                rollback(target, now, audit=cell.history.audit, who="T")
            assert _gains(simulation) == expected
            assert _saved(simulation) == expected
    records = read_records(record_folder(cell))
    assert len(records) == 4
    actions = [entry.action for entry in read(cell.history.audit)]
    write = [AuditAction.APPLY_BEGUN, AuditAction.APPLIED, AuditAction.CALIBRATION_ENTERED]
    way_back = [AuditAction.ROLLBACK_BEGUN, AuditAction.ROLLED_BACK]
    assert actions == write + 3 * way_back
    assert verify(cell.history.audit).open_writes == ()


def test_a_write_under_the_old_name_of_a_renamed_cell_is_rolled_back(
    address: BusAddress, tmp_path: Path
) -> None:
    cell = demo_cell(tmp_path)
    press = replace(cell, name="press")
    ledger = Ledger.of(press)
    assert ledger is not None
    with simulated(address) as simulation:
        _write(cell, address)
        with (
            network_of(press, address) as network,
            pytest.raises(
                ControllerUnfit,
                match=r"a write to cell 'demo' at 2025-01-02.*; expected one to the "
                r"drives of the cell that is called 'press' now",
            ),
        ):
            _roll_back(press, network, ledger.audit)
        _rename_demo(ledger)
        with network_of(press, address) as network:
            _roll_back(press, network, ledger.audit)
        assert _gains(simulation) == IN_DRIVES
    events = read_history(ledger).events
    targets = [event.target for event in events]
    expected = [drives_of("press")] * 2
    assert targets == expected


def test_the_old_file_of_a_renamed_cell_writes_nothing(address: BusAddress, tmp_path: Path) -> None:
    demo = demo_cell(tmp_path)
    press = replace(demo, name="press")
    ledger = Ledger.of(press)
    assert ledger is not None
    _acknowledge_gearbox(demo)
    _rename_demo(ledger)
    with simulated(address) as simulation, network_of(demo, address) as network:
        before = _gains(simulation)
        proposal = _propose(demo, network)
        with pytest.raises(
            CalibrationRefused,
            match=r"cell 'demo': found a robot that was renamed to 'press' at 2025-.*; expected a "
            r"cell file with its present name; .*write its present name 'press'",
        ):
            apply(proposal, NOW, audit=ledger.audit, who="T")
        assert _gains(simulation) == before
        of_present_name = replace(demo_calibration(), cell="press")
        assert _propose(press, network, of_present_name).refusals == ()


@pytest.mark.parametrize("renamed_after_s", [-60, 60])
def test_a_record_belongs_to_the_cell_that_had_its_name_at_that_time(
    address: BusAddress, tmp_path: Path, renamed_after_s: int
) -> None:
    demo = demo_cell(tmp_path)
    press = replace(demo, name="press")
    ledger = Ledger.of(press)
    assert ledger is not None
    renamed_at = NOW + timedelta(seconds=renamed_after_s)
    _acknowledge_gearbox(demo)
    with simulated(address) as simulation:
        with network_of(demo, address) as network:
            proposal = _propose(demo, network)
        if renamed_after_s < 0:
            _rename_demo(ledger, renamed_at)
        with network_of(demo, address) as network:
            _apply(proposal, DriveTarget(demo, network), ledger.audit)
        if renamed_after_s > 0:
            _rename_demo(ledger, renamed_at)
        written = _gains(simulation)
        owner = press
        other = demo
        if renamed_after_s < 0:
            owner = demo
            other = press
        with (
            network_of(other, address) as network,
            pytest.raises(ControllerUnfit, match=f"expected .* called '{other.name}' now"),
        ):
            _roll_back(other, network, ledger.audit)
        assert _gains(simulation) == written
        with network_of(owner, address) as network:
            _roll_back(owner, network, ledger.audit)
        assert _gains(simulation) == IN_DRIVES


def test_a_rollback_that_would_lose_what_someone_did_is_refused(
    address: BusAddress, tmp_path: Path
) -> None:
    cell = demo_cell(tmp_path)
    with simulated(address) as simulation, network_of(cell, address) as network:
        with pytest.raises(CalibrationRefused, match="no record"):
            rollback(DriveTarget(cell, network), NOW)
        written = _write(cell, address)
        _enter_in_j5(network, 18000)
        with pytest.raises(
            ControllerChanged, match="found 18000; expected 16300 as drivegain wrote it, or 18480"
        ):
            rollback(DriveTarget(cell, network), NOW)
        _enter_in_j5(network, 16300)
        body = json.loads(_backup(written).read_text())
        body["drives"][0]["old"] = 99999
        _backup(written).write_text(json.dumps(body))
        with pytest.raises(ControllerUnfit, match="as it says"):
            rollback(DriveTarget(cell, network), NOW)
        assert _gains(simulation) == NEW
        _backup(written).write_text("{}")
        with pytest.raises(ControllerUnfit, match="the record of a write to drives"):
            rollback(DriveTarget(cell, network), NOW)


def test_a_gain_that_someone_entered_in_a_drive_is_reviewed_first(
    address: BusAddress, tmp_path: Path
) -> None:
    """The newest record holds the value that drivegain left there:
    that, or the one before it, is no surprise.
    """
    cell = demo_cell(tmp_path)
    with simulated(address), network_of(cell, address) as network:
        first = _propose(cell, network)
        assert first.refusals == ()  # no record: nothing to compare with
        written = _write(cell, address)
        for word in (16300, 18480):
            _enter_in_j5(network, word)
            assert _propose(cell, network).refusals == ()
        _enter_in_j5(network, 18000)
        changed = _propose(cell, network)
        (refusal,) = changed.refusals
        assert refusal.gate is Gate.BASE
        assert refusal.subject == "J5, 2003h:01"
        assert refusal.found == "18000"
        assert "16300" in refusal.expected
        reviewed = _propose(cell, network, base=changed.edit.base_sha256)
        assert reviewed.refusals == ()
        of_first = _propose(cell, network, base=first.edit.base_sha256)
        gates = [refusal.gate for refusal in of_first.refusals]
        assert gates == [Gate.BASE]

        _enter_in_j5(network, 16300)
        backup = _backup(written)
        backup.write_text("{}")
        unread = _propose(cell, network)
        (refusal,) = unread.refusals
        assert refusal.gate is Gate.BASE
        assert refusal.subject == str(backup)
        reviewed = _propose(cell, network, base=unread.edit.base_sha256)
        assert reviewed.refusals == ()


def test_an_exchanged_drive_gets_no_old_gain(address: BusAddress, tmp_path: Path) -> None:
    cell = demo_cell(tmp_path)
    with simulated(address):
        _write(cell, address)
    first, *others = cell.axes
    exchanged = replace(first, identity=None)
    new = replace(cell, axes=(exchanged, *others))
    fault_spec = FaultSpec(FaultKind.OTHER_SERIAL, 0)
    with simulated(address, fault_spec, entered=IDENTIFIED) as simulation:
        with (
            network_of(new, address) as network,
            pytest.raises(ControllerChanged, match="serial number 1002"),
        ):
            rollback(DriveTarget(new, network), NOW)
        assert _gains(simulation) == NEW


@pytest.mark.parametrize("writes", [0, 1, 3, 6, 8])
def test_after_a_kill_the_record_says_what_was_there_and_leads_back(
    tmp_path: Path, writes: int
) -> None:
    """SIGKILL after so many writes, saves among them."""
    cell = demo_cell(tmp_path)
    assert cell.history is not None
    with Hub(("can0",)) as hub, simulated(hub.address()) as simulation:
        arguments = (tmp_path, hub.address(), writes)
        process = WRITERS.Process(target=_write_until_killed, args=arguments)
        process.start()
        process.join()
        assert process.exitcode == -signal.SIGKILL
        assert _gains(simulation) == _first_written(min(writes, 6))
        (path,) = read_records(record_folder(cell))
        drives = read_record(path).drives
        old_gains = [note.parameter.value(note.old) / 1000.0 for note in drives]
        assert old_gains == IN_DRIVES
        (left,) = verify(cell.history.audit).open_writes
        assert left.begun.action is AuditAction.APPLY_BEGUN
        # The audit log sees no drive: it does not say that they have neither gain.
        assert left.content is Content.UNKNOWN
        with network_of(cell, hub.address()) as network:
            if writes:
                rollback(DriveTarget(cell, network), NOW)
            else:
                with pytest.raises(CalibrationRefused, match="nothing needs to be undone"):
                    rollback(DriveTarget(cell, network), NOW)
        assert _gains(simulation) == IN_DRIVES
        assert _saved(simulation) == IN_DRIVES


def test_a_rollback_behind_a_write_that_was_not_made_leaves_the_write_before(
    address: BusAddress, tmp_path: Path
) -> None:
    """A cut cable, or a kill before the first drive, leaves a record and the gains before it."""
    cell = demo_cell(tmp_path)
    with simulated(address) as simulation:
        _write(cell, address)
        record_without_write = _record_of_higher_gains(_last_record(cell))
        write_record(record_folder(cell), cell.name, NOW, "T", record_without_write)
        with (
            network_of(cell, address) as network,
            pytest.raises(CalibrationRefused, match=r"begun by T at .*nothing needs to be undone"),
        ):
            rollback(DriveTarget(cell, network), NOW)
        assert _gains(simulation) == NEW
        assert _saved(simulation) == NEW


def test_a_rollback_that_was_not_made_is_made_by_the_next_one(
    address: BusAddress, tmp_path: Path
) -> None:
    cell = demo_cell(tmp_path)
    with simulated(address) as simulation:
        _write(cell, address)
        way_back = []
        for note in _last_record(cell).drives:
            way_back.append(note.model_copy(update={"old": note.new, "new": note.old}))
        write_record(record_folder(cell), cell.name, NOW, "T", tuple(way_back))
        with network_of(cell, address) as network:
            rollback(DriveTarget(cell, network), NOW)
        assert _gains(simulation) == IN_DRIVES
        assert _saved(simulation) == IN_DRIVES


def _last_record(cell: Cell) -> DriveRecord:
    *_, newest = read_records(record_folder(cell))
    return read_record(newest)


def _record_of_higher_gains(record: DriveRecord) -> tuple[DriveNote, ...]:
    """What the record of a next write says, to gains one unit above those that are written."""
    drives = []
    for note in record.drives:
        higher = {"old": note.new, "new": note.new + 1}
        drives.append(note.model_copy(update=higher))
    return tuple(drives)


def _write_until_killed(folder: Path, address: BusAddress, writes: int) -> None:
    made = 0
    write = ObjectAccess.write

    def counted(access: ObjectAccess, entry: ObjectEntry, value: int) -> None:
        nonlocal made
        if made == writes:
            os.kill(os.getpid(), signal.SIGKILL)
        made += 1
        write(access, entry, value)

    ObjectAccess.write = counted  # type: ignore[method-assign, assignment]
    _write(demo_cell(folder), address)


def test_a_record_that_the_disk_refuses_leaves_the_drives_and_says_so(
    address: BusAddress, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = demo_cell(tmp_path)

    def full(*_: object) -> Path:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("daq.writeback.drive_target.write_record", full)
    with simulated(address) as simulation:
        with pytest.raises(OutputFailed, match="nothing was written to the drives") as caught:
            _write(cell, address)
        assert "not known" not in str(caught.value)
        assert _gains(simulation) == IN_DRIVES
        assert _saved(simulation) == IN_DRIVES
    assert cell.history is not None
    actions = [entry.action for entry in read(cell.history.audit)]
    assert actions == [AuditAction.APPLY_BEGUN, AuditAction.FAILED]
