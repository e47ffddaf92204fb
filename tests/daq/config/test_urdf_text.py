"""The text of a URDF: by its byte order mark, by its declaration, and without either."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from daq.config.cell import model_of
from daq.config.cell_file import load_cell
from daq.config.urdf_text import urdf_text
from daq.environment import shipped_configurations
from daq.errors import ConfigurationInconsistent

ROBOT = '<robot name="Ärm"><link name="Ä"/><link name="Ö"/></robot>'


def _declaration(encoding: str) -> str:
    return f'<?xml version="1.0" encoding="{encoding}"?>\n'


@pytest.mark.parametrize("encoding", ["ISO-8859-1", "windows-1252", "UTF-8", "cp437", "utf-8"])
def test_a_declared_encoding_decides(encoding: str) -> None:
    text = _declaration(encoding) + ROBOT
    assert urdf_text(text.encode(encoding), "arm.urdf") == text


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_byte_order_mark_decides(encoding: str) -> None:
    text = _declaration("ISO-8859-1") + ROBOT
    assert urdf_text(text.encode(encoding), "arm.urdf") == text


@pytest.mark.parametrize("encoding", ["utf-8", "cp1252"])
@pytest.mark.parametrize("declaration", ["", _declaration("UTF-8")])
def test_names_stay_apart_without_a_declaration_and_with_a_wrong_one_of_utf_8(
    encoding: str, declaration: str
) -> None:
    text = declaration + ROBOT
    assert urdf_text(text.encode(encoding), "arm.urdf") == text


def test_lines_before_the_declaration_are_left_out() -> None:
    text = _declaration("UTF-8") + ROBOT
    data = b"\n  \n" + text.encode()
    assert urdf_text(data, "arm.urdf") == text


@pytest.mark.parametrize(
    ("encoding", "message"),
    [
        ("klingon", "found the encoding 'klingon', which is not known"),
        ("us-ascii", "byte 55 is not in the declared"),
        ("punycode", r"byte.* not in the declared encoding 'punycode'"),
        ("undefined", "bytes that are not in the declared encoding 'undefined'"),
        ("idna", r"byte.* not in the declared encoding 'idna'"),
        ("hex", "found the encoding 'hex', which is not known"),
    ],
)
def test_what_the_declaration_does_not_explain_is_refused(encoding: str, message: str) -> None:
    data = (_declaration(encoding) + ROBOT).encode("latin-1")
    with pytest.raises(ConfigurationInconsistent, match=message) as caught:
        urdf_text(data, "arm.urdf")
    assert "save it as UTF-8" in caught.value.remedy


@pytest.fixture
def cell_path(tmp_path: Path) -> Path:
    """A copy of a shipped cell."""
    shutil.copytree(shipped_configurations(), tmp_path / "configs")
    return tmp_path / "configs/cells/rx90.yaml"


def test_a_cell_is_read_with_links_that_only_the_declaration_tells_apart(cell_path: Path) -> None:
    urdf = cell_path.parents[1] / "robots/rx90.urdf"
    text = urdf.read_text(encoding="utf-8")
    for plain, accented in (("link1", "Ä"), ("link2", "Ö")):
        assert plain in text
        text = text.replace(plain, accented)
    if text.startswith("<?xml"):
        body = text.partition("?>")[2]
    else:
        body = text
    encoded_body = (_declaration("ISO-8859-1") + body).encode("latin-1")
    urdf.write_bytes(encoded_body)
    assert "Ö" in load_cell(cell_path).urdf


@pytest.mark.parametrize(
    ("content", "found", "expected"),
    [
        (
            '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:arm/></robot>',
            "xacro that is not",
            "`xacro robot",
        ),
        ('<robot name="r"/>', "the URDF has no <link>", "the links of an arm"),
        ("<sdf/>", "its outermost element is <sdf>", "<robot>"),
    ],
)
def test_the_advice_is_about_the_urdf(
    cell_path: Path, content: str, found: str, expected: str
) -> None:
    rx90_path = cell_path.parents[1] / "robots/rx90.urdf"
    rx90_path.write_text(content, encoding="utf-8")
    with pytest.raises(ConfigurationInconsistent) as caught:
        load_cell(cell_path)
    assert found in caught.value.found
    assert expected in caught.value.expected
    assert "hold" not in caught.value.expected
    assert "the URDF that it names" in caught.value.remedy


@pytest.mark.parametrize("text", [b"hello", b"../description/arm.urdf\n"])
def test_a_file_with_a_name_in_it_is_no_urdf(text: bytes) -> None:
    """The reader of `ident` took it for its argument, and gave advice in Python."""
    with pytest.raises(ConfigurationInconsistent, match=r"one line of text.*not a file with its"):
        urdf_text(text, "arm.urdf")


def test_a_byte_order_mark_and_an_entity_of_its_own_are_read(cell_path: Path) -> None:
    urdf = cell_path.parents[1] / "robots/rx90.urdf"
    expected = [joint.translation_m for joint in model_of(load_cell(cell_path)).robot.joints]
    text = urdf.read_text(encoding="utf-8")
    _, _, body = text.partition("<robot")
    assert "0.45" in body
    named = body.replace("0.45", "&reach;")
    entity = '<!DOCTYPE robot [<!ENTITY reach "0.45">]>\n<robot'
    urdf.write_text(entity + named, encoding="utf-8-sig")
    actual = [joint.translation_m for joint in model_of(load_cell(cell_path)).robot.joints]
    np.testing.assert_array_equal(actual, expected)
