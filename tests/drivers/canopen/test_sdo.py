"""Answers of an SDO upload, by the tables of CiA 301."""

from __future__ import annotations

import pytest

from drivers.canopen.link import Link
from drivers.canopen.sdo import SdoPolicy, UploadAnswer, upload_answer, upload_request
from drivers.errors import ObjectAccessError
from drivers.profiles.profile import ObjectEntry
from tests.drivers.hostile import NAME, Hostile, about
from tests.drivers.scripted import ADDRESS, FakeClock, ScriptedBus, ScriptedNode

TORQUE = ObjectEntry(0x6077, 0, 16, signed=True)


@pytest.mark.parametrize(
    ("answer", "expected"),
    [
        ("4b 77 60 00 fe ff 00 00", UploadAnswer(-2, 16)),
        ("43 77 60 00 fe ff ff ff", UploadAnswer(-2, 32)),
        ("42 77 60 00 fe ff 00 00", UploadAnswer(-2, 32)),
        ("4f 77 60 00 fe 00 00 00", UploadAnswer(None, 8)),
        ("41 77 60 00 10 00 00 00", UploadAnswer()),
        ("80 77 60 00 11 00 09 06", UploadAnswer(abort_code=0x0609_0011)),
        ("4b 78 60 00 fe ff 00 00", None),
        ("4b 77 60 01 fe ff 00 00", None),
        ("4b 77 60 00 fe ff", None),
        ("", None),
    ],
    ids=[
        "two bytes",
        "four bytes",
        "size not indicated",
        "too short",
        "segmented",
        "abort",
        "other object",
        "other sub-index",
        "six bytes",
        "no bytes",
    ],
)
def test_an_answer_is_read_by_its_command_byte(answer: str, expected: UploadAnswer | None) -> None:
    assert upload_answer(bytes.fromhex(answer), TORQUE) == expected


def test_a_request_names_the_object() -> None:
    request = upload_request(5, TORQUE)
    assert request.arbitration_id == 0x605
    assert request.data.hex(" ") == "40 77 60 00 00 00 00 00"


@pytest.mark.parametrize(("segment_s", "is_read"), [(0.1, True), (0.3, False)])
def test_a_text_of_ten_segments_has_two_seconds(segment_s: float, is_read: bool) -> None:
    """Segments of seven bytes; the command byte of the last has bit 0 set (CiA 301)."""
    left = 10

    def slow(data: bytes, bus: ScriptedBus) -> bytes | None:
        nonlocal left
        if data[0] >> 5 == 3:
            left -= 1
            bus.clock.now_ns += round(segment_s * 1e9)
            last = left == 0
            return bytes((data[0] & 0x10 | last,)) + b"segment"
        if about(data) == NAME:
            return bytes((0x41, *data[1:4])) + (70).to_bytes(4, "little")
        return None

    clock = FakeClock()
    bus = ScriptedBus((), clock)
    bus.nodes = (Hostile(1, bus, slow),)
    link = Link(ADDRESS, SdoPolicy(timeout_s=0.5, transfer_s=2.0), clock, lambda _: bus)
    link.open()
    access = link.objects(1)
    if is_read:
        assert access.read_bytes(NAME, 0) == b"segment" * 10
        return
    with pytest.raises(ObjectAccessError, match=r"found 70 bytes and no end, .* within 2 s"):
        access.read_bytes(NAME, 0)
    assert left == 3


def test_answers_that_nobody_waits_for_are_not_stored() -> None:
    """A stream reads slow objects for as long as a run lasts, and their answers by itself."""
    clock = FakeClock()
    bus = ScriptedBus((ScriptedNode(1),), clock)
    link = Link(ADDRESS, SdoPolicy(), clock, lambda _: bus)
    link.open()
    access = link.objects(1)
    rated_current = ObjectEntry(0x6075, 0, 32)
    access.read(rated_current)
    for _ in range(100):
        link.send((upload_request(1, TORQUE),))
        link.pump(0.0)
    assert access._client.responses.qsize() == 0
    assert access.read(rated_current) == 2000
