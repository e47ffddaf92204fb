"""Packing of objects into PDOs, and the payload's constant offsets."""

from __future__ import annotations

from itertools import chain

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.canopen.pdo import SETPOINT_PDOS, Direction, pack, record_payload, records, word
from drivers.profiles.profile import ObjectEntry

entries = st.builds(
    ObjectEntry,
    st.integers(0x2000, 0x6FFF),
    st.integers(0, 255),
    st.sampled_from((8, 16, 32)),
    st.booleans(),
)


@given(st.lists(entries, max_size=6))
def test_everything_is_packed_once_and_fits(objects: list[ObjectEntry]) -> None:
    pdos = pack(objects)
    packed = list(chain.from_iterable(pdos))
    expected = sorted(map(word, packed))
    assert sorted(map(word, objects)) == expected
    for pdo in pdos:
        assert sum(entry.bits for entry in pdo) <= 64
    # First fit: what opened a later PDO had no room in an earlier one.
    for number, pdo in enumerate(pdos[1:], start=1):
        for earlier in pdos[:number]:
            bits = pdo[0].bits
            assert sum(entry.bits for entry in earlier) + bits > 64


@given(st.lists(entries, min_size=1, max_size=6, unique_by=word), st.data())
def test_layout_decodes_what_a_drive_would_send(
    objects: list[ObjectEntry], data: st.DataObject
) -> None:
    for pdo in pack(objects):
        values = []
        for entry in pdo:
            values.append(
                data.draw(
                    st.integers(-(1 << entry.bits - 1), (1 << entry.bits - 1) - 1)
                    if entry.signed
                    else st.integers(0, (1 << entry.bits) - 1)
                )
            )
        payload = b"".join(
            value.to_bytes(entry.bits // 8, "little", signed=entry.signed)
            for value, entry in zip(values, pdo, strict=True)
        )
        (record,) = records(Direction.TPDO, 1, (pdo,))
        layout, carried = record_payload(record, pdo)
        assert carried == pdo
        assert list(layout.unpack(payload)) == values


def test_what_cannot_be_packed_is_refused() -> None:
    object_entry = ObjectEntry(0x2000, 0, 24, signed=True)
    with pytest.raises(ValueError, match="24 bits"):
        pack([object_entry])
    object_entries = [ObjectEntry(0x2000 + n, 0, 32, signed=True) for n in range(9)]
    with pytest.raises(ValueError, match="5 PDOs"):
        pack(object_entries)


def test_setpoints_have_the_predefined_cob_ids() -> None:
    cob_ids = [record.cob_id for record in records(Direction.RPDO, 5, SETPOINT_PDOS)]
    assert cob_ids == [
        0x205,
        0x305,
        0x405,
    ]
    # The target first
    assert records(Direction.RPDO, 5, SETPOINT_PDOS)[0].entries == (0x607A0020, 0x60400010)
