"""Drives of other makers, built on their data sheets:
what they lack is found before anything is written.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest

from daq.environment import shipped_configurations
from drivers.canopen.pdo import Direction, PdoRecord, fixed_setpoints
from drivers.errors import SetupRefused
from drivers.motion.execute import execute
from drivers.stream.stream import SyncStream
from drivers.stream.sync import LockstepSync
from tests.drivers.foreign import MAKES, MOVE, ForeignNode, foreign_cell, shipped
from tests.drivers.scripted import PERIOD_NS, ScriptedBus, permission

pytestmark = pytest.mark.slow  # each drive takes a network of its own


def written(bus: ScriptedBus) -> list[str]:
    """Objects that were written, and NMT commands."""
    found = []
    for frame in bus.sent:
        if frame.arbitration_id == 0 or (
            0x600 < frame.arbitration_id < 0x680 and frame.data[0] >> 5 == 1
        ):
            found.append(f"{frame.arbitration_id:03X} {frame.data.hex(' ')}")
    return found


@pytest.mark.parametrize(("file", "profile"), MAKES.items())
def test_a_drive_of_this_data_sheet_is_set_up_moved_and_restored(
    file: str, profile: str, shared_data: Path
) -> None:
    sheet = shared_data / "eds" / file
    network, bus = foreign_cell(sheet, shipped(profile))
    before = [settings(node) for node in bus.nodes]
    with network:
        network.prepare()
        pacing = LockstepSync(PERIOD_NS, 0.005, clock=bus.clock)
        stream = SyncStream(network, pacing)
        samples = list(execute(network, stream, (MOVE,), permission()))
        for sample in samples:
            assert not sample.missing
        # A drive that acts in its 6040h callback would have gone to the target of before.
        expected = [(3000, 1), (-2000, 1)]
        assert [(node.position, len(node.setpoint_cycles)) for node in bus.nodes] == expected
        position_counts = samples[-1].position_counts
        assert position_counts == (3000, -2000)
    assert [settings(node) for node in bus.nodes] == before


def settings(node: object) -> dict[str, int]:
    assert isinstance(node, ForeignNode)
    keys = [(0x1017, 0), (0x6007, 0), (0x6060, 0), *((0x1016, sub) for sub in range(1, 4))]
    for base in (0x1400, 0x1800):
        for number in node.numbers(base):
            keys += [(base + number, sub) for sub in (1, 2)]
            subs = range(node.value(base + 0x200 + number, 0) + 1)
            keys += [(base + 0x200 + number, sub) for sub in subs]
    found = {}
    for index, sub in keys:
        found[f"{index:04X}h:{sub:02X}"] = node.value(index, sub)
    return found


def test_a_fixed_mapping_that_carries_the_same_is_used_as_it_is(shared_data: Path) -> None:
    sheet = shared_data / "eds" / "pilz_prbt_0_1.dcf"
    network, bus = foreign_cell(sheet, shipped("schunk-pilz-prbt"), fixed=True)
    for node in bus.nodes:
        for base, number, words in (
            (0x1A00, 0, (0x60410010, 0x60770010, 0x60640020)),  # the default in the data sheet
            (0x1600, 0, (0x607A0020, 0x60400010)),
            (0x1601, 0, (0x60810020, 0x60830020)),
        ):
            for sub, value in enumerate((len(words), *words)):
                node.store(base + number, sub, value)
    with network:
        network.prepare()
        entries = network.pdos[0].feedback[0].entries
        assert entries == (0x60410010, 0x60770010, 0x60640020)
        pacing = LockstepSync(PERIOD_NS, 0.005, clock=bus.clock)
        stream = SyncStream(network, pacing)
        samples = list(execute(network, stream, (MOVE,), permission()))
        expected = (3000, -2000)
        assert samples[-1].position_counts == expected
        statusword = samples[-1].statusword
        assert {word & 0x6F for word in statusword} == {0x40}


def test_a_fixed_mapping_that_does_not_carry_the_same_is_refused(shared_data: Path) -> None:
    sheet = shared_data / "eds" / "pilz_prbt_0_1.dcf"
    network, _ = foreign_cell(sheet, shipped("schunk-pilz-prbt"), fixed=True)
    with pytest.raises(SetupRefused, match=r"J1 \(node 1\): TPDO1: writing .*read only"), network:
        network.prepare()


@pytest.mark.parametrize(
    ("file", "missing", "fitting"),
    [
        (
            "pilz_prbt_0_1.dcf",
            "no object 6074h:00 (current)",
            "`schunk-pilz-prbt` (current from 6077h:00)",
        ),
        (
            "Schunk_0_63_cob.dcf",
            "no object 6074h:00 (current)",
            "`schunk-pilz-prbt` (current from 6077h:00)",
        ),
        (
            "maxon_epos4.eds",
            "no object 6074h:00 (current), no object 6075h:00 (scale of the current)",
            "`maxon-epos4` (current from 30D0h:00, rated current from 3001h:01)",
        ),
        (
            "ros2_canopen_cia402_slave.eds",
            "no object 6074h:00 (current)",
            "no shipped profile fits this drive",
        ),
    ],
)
def test_a_profile_that_does_not_fit_is_refused_before_anything_is_written(
    file: str, missing: str, fitting: str, shared_data: Path
) -> None:
    others = tuple(map(shipped, ("elmo-gold", "maxon-epos4", "schunk-pilz-prbt", "copley")))
    sheet = shared_data / "eds" / file
    network, bus = foreign_cell(sheet, shipped("generic-cia402"), profiles=lambda: others)
    with pytest.raises(SetupRefused) as refused, network:
        network.prepare()
    assert missing in str(refused.value)
    assert fitting in str(refused.value)
    assert written(bus) == []


def test_too_few_pdos_are_named_before_anything_is_written(shared_data: Path) -> None:
    sheet = shared_data / "eds" / "pilz_prbt_0_1.dcf"
    network, bus = foreign_cell(sheet, shipped("schunk-pilz-prbt"))
    for node in bus.nodes:
        assert isinstance(node, ForeignNode)
        del node.local.object_dictionary[0x1401]
    with pytest.raises(SetupRefused, match=r"found 1 RPDOs in the drive; expected 2"), network:
        network.prepare()
    assert written(bus) == []


def rpdo(number: int, *entries: int) -> PdoRecord:
    cob_id = 0x201 + 0x100 * number
    return PdoRecord(Direction.RPDO, number, cob_id, 255, entries)


PROFILE_RPDOS = (rpdo(2, 0x60810020, 0x60830020), rpdo(3, 0x60840020))


@pytest.mark.parametrize(
    ("command", "fits"),
    [
        ((rpdo(0, 0x607A0020, 0x60400010),), True),
        ((rpdo(0, 0x607A0020), rpdo(1, 0x60400010)), True),
        ((rpdo(0, 0x60400010, 0x607A0020),), False),
        ((rpdo(0, 0x60400010), rpdo(1, 0x607A0020)), False),
        ((rpdo(0, 0x607A0020, 0x60400010, 0x60600008),), False),
        ((rpdo(0, 0x60400010), rpdo(1, 0x607A0020, 0x60400010)), False),
    ],
    ids=[
        "target first",
        "earlier frame",
        "controlword first",
        "later frame",
        "another object",
        "twice",
    ],
)
def test_own_rpdos_are_used_only_if_the_target_comes_first_and_nothing_else(
    command: tuple[PdoRecord, ...], fits: bool
) -> None:
    used = fixed_setpoints(command + PROFILE_RPDOS)
    numbers = [record.number for record in used]
    expected = [r.number for r in command + PROFILE_RPDOS] if fits else []
    assert numbers == expected
    for record in used:
        assert record.transmission == 1


_ELMO = {"elmo-gold", "generic-cia402", "schunk-pilz-prbt"}
_SCHUNK = {"schunk-pilz-prbt", "beckhoff-el72x1"}
# Profiles whose objects the sheet has; a scale of another make is for a person to see
FITTING: dict[str, set[str]] = {
    "pilz_prbt_0_1.dcf": _SCHUNK,
    "Schunk_0_63_cob.dcf": _SCHUNK,
    "Elmo_cob.dcf": _ELMO,
    "ElmoSimplIQ_cob.dcf": _ELMO,
    "maxon_epos4.eds": {"maxon-epos4"},
    "ros2_canopen_cia402_slave.eds": set(),
}
# technosoft-ipos needs an entry of a person.
PROFILES = sorted(
    path.stem
    for path in (shipped_configurations() / "drives").glob("*.yaml")
    if path.stem != "technosoft-ipos"
)


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("file", FITTING)
def test_each_data_sheet_is_set_up_by_each_profile_or_refused_in_words_and_left_as_it_was(
    file: str, profile: str, shared_data: Path
) -> None:
    others = tuple(map(shipped, PROFILES))
    sheet = shared_data / "eds" / file
    network, bus = foreign_cell(sheet, shipped(profile), profiles=lambda: others)
    before = [settings(node) for node in bus.nodes]
    refused = None
    with contextlib.suppress(SetupRefused), network:
        try:
            network.prepare()
        except SetupRefused as error:
            refused = error
            raise
        assert network.readback().keys() == {"J1", "J2"}
    if refused is not None:
        said = str(refused)
        assert said.startswith("J1 (node 1): found ")
        assert f"; expected every object of profile {profile}; " in said
        assert getattr(refused, "__notes__", []) == []
        assert written(bus) == []
    assert (refused is None) is (profile in FITTING[file])
    assert [settings(node) for node in bus.nodes] == before
