"""Answers of an SDO upload, by the tables of CiA 301."""

from __future__ import annotations

import pytest

from drivers.canopen.sdo import UploadAnswer, upload_answer, upload_request
from drivers.profiles.profile import ObjectEntry

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
